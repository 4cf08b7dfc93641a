"""Outputs that appear whole or not at all: written to a temporary file beside them, flushed, then renamed."""

import contextlib
import errno
import hashlib
import os
import re
import secrets
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from formats.errors import FormatError, OutputExists, ResourceError

MAX_STEM_BYTES = 200
# Where a file system cannot reserve space, writing finds out whether there is enough.
NO_RESERVING = (errno.EOPNOTSUPP, errno.EINVAL, errno.ENOSYS, errno.ENODEV)
AT_FDCWD, RENAME_EXCHANGE = -100, 2  # <fcntl.h>, <linux/fs.h>
CAUSES = {
    errno.ENOSPC: "the disk is full; free some space or choose another folder",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another folder",
    errno.EACCES: "permission is missing; choose a folder that you may write to",
    errno.EPERM: "permission is missing; choose a folder that you may write to",
    errno.EROFS: "the file system is read-only; choose another folder",
    errno.EISDIR: "a folder of that name is in the way; choose another name",
    errno.EFBIG: "the file is larger than the disk's format allows",
    errno.EIO: "the disk reports an error; use another disk",
}
unfinished: set[Path] = set()
"""Temporary files and folders of this process, which are worth nothing once it ends."""


@contextlib.contextmanager
def atomic_writer(path: Path | str, *, mode: str = "wb", reserve: int = 0) -> Iterator[BinaryIO]:
    """A file object (with a real `.name`) whose content becomes `path` if the block ends without exception.

    `reserve` bytes, at most what will be written, are claimed first: a full disk is found before writing. A
    link is written through. A new file gets mode 0666 less the umask, a replaced one keeps its mode. Any
    exception, KeyboardInterrupt too, leaves the old file and no temporary. Raises ResourceError: disk full,
    read-only, no permission.
    """
    with _temporary(path) as (target, temporary):
        with open(temporary, mode.replace("w", "x"), encoding=None if "b" in mode else "utf-8") as file:
            if reserve:
                _reserve(file.fileno(), reserve)
            yield file
            file.flush()
            os.fsync(file.fileno())
        _keep_mode(target, temporary)
        os.replace(temporary, target)


@contextlib.contextmanager
def atomic_folder(path: Path | str, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary sibling folder that becomes `path` if the block ends without an exception, else is removed.

    An empty folder at `path` is replaced, anything else only with `overwrite` (OutputExists otherwise).
    Flushed and with its mode kept as by `atomic_writer`. Raises ResourceError.
    """
    check_writable(path, overwrite, folders=True)
    with _temporary(path) as (target, temporary):
        temporary.mkdir()
        yield temporary
        _sync_tree(temporary)
        _keep_mode(target, temporary)
        _swap_in(temporary, target)


@contextlib.contextmanager
def _temporary(path: Path | str) -> Iterator[tuple[Path, Path]]:
    """Where a path leads and a new name beside it, of which nothing is left where the block fails; after it
    the names are flushed."""
    target = Path(os.path.realpath(path))
    temporary = temporary_sibling(target)
    unfinished.add(temporary)
    try:
        yield target, temporary
    except BaseException as error:
        with contextlib.suppress(OSError):
            _remove(temporary)
        _explain(error, path, temporary, target)
        raise
    finally:
        unfinished.discard(temporary)
    sync_folder(target.parent)


def check_writable(path: Path | str, overwrite: bool, *, folders: bool = False) -> None:
    """Before any work: a file (with `folders`, or a folder) may be created here.

    Raises OutputExists or ResourceError.
    """
    if not str(path):
        raise ResourceError("the path of the output is empty; name a file")
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise ResourceError(f"{path}: its folder {target.parent} does not exist; create it first")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise ResourceError(f"{path}: cannot write in {target.parent}; choose a folder that you may write to")
    if target.exists() and not target.is_file() and not target.is_dir():
        raise ResourceError(f"{path}: a pipe or device of that name is in the way; choose another name")
    if target.is_dir() and not folders:
        raise ResourceError(f"{path}: {CAUSES[errno.EISDIR]}")
    if not overwrite and target.exists() and not _is_empty_folder(target):
        raise OutputExists(f"{path}: exists already; give -w/--overwrite to replace it, or another name")


def check_space(path: Path | str, needed: int) -> None:
    """Before any work: the disk has room for `needed` bytes. Raises ResourceError."""
    free = shutil.disk_usage(Path(os.path.realpath(path)).parent).free
    if free < needed:
        raise ResourceError(
            f"{path}: needs {needed:,} bytes, but the disk has {free:,} left; free some space or choose "
            "another folder"
        )


def hidden_sibling(target: Path, ending: str) -> Path:
    """`.name.ending` beside `target`, for any name that a file can have."""
    return target.with_name(f"{_hidden_stem(target)}.{ending}")


def remove_unfinished() -> None:
    """Remove the temporaries of this process, which ends without going on."""
    for path in list(unfinished):
        with contextlib.suppress(OSError):
            _remove(path)


def remove_leftovers(path: Path | str) -> None:
    """Remove the temporaries that killed writers of `path` left, of its checkpoint too, and what was written
    under a temporary's name. The caller must hold its lock."""
    target = Path(os.path.realpath(path))
    # A folder that was moved aside may be the only copy: it is removed only when the new one is in place.
    ending = r"\.[0-9a-f]{12}\." + ("(tmp|old)" if target.exists() else "tmp")
    more = r"(\.checkpoint)?"
    leftover = re.compile(rf"\.?{re.escape(_hidden_stem(target))}{more}{ending}{more}({ending})?")
    for candidate in target.parent.iterdir():
        if leftover.fullmatch(candidate.name):
            with contextlib.suppress(OSError):
                _remove(candidate)


def _hidden_stem(target: Path) -> str:
    name = target.name
    if len(os.fsencode(name)) > MAX_STEM_BYTES:
        name = name[:40] + hashlib.sha256(os.fsencode(name)).hexdigest()[:16]
    return f".{name}"


def temporary_sibling(target: Path, ending: str = "tmp") -> Path:
    """A new name beside `target` that the next writer of it removes."""
    return hidden_sibling(target, f"{secrets.token_hex(6)}.{ending}")


def _reserve(descriptor: int, size: int) -> None:
    if not hasattr(os, "posix_fallocate"):
        return
    try:
        os.posix_fallocate(descriptor, 0, size)
    except OSError as error:
        if error.errno not in NO_RESERVING:
            raise


def _keep_mode(target: Path, temporary: Path) -> None:
    with contextlib.suppress(FileNotFoundError):
        mode = target.stat().st_mode
        if stat.S_IFMT(mode) == stat.S_IFMT(temporary.stat().st_mode):  # a folder does not take a file's mode
            os.chmod(temporary, stat.S_IMODE(mode))


def _is_empty_folder(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def _swap_in(temporary: Path, target: Path) -> None:
    """Rename onto `target`. A rename replaces only an empty folder: anything else changes places with
    `temporary`, and moves aside first where the system cannot do that.
    """
    if not target.exists() or _is_empty_folder(target):
        os.replace(temporary, target)
        return
    if _exchange(temporary, target):
        _remove(temporary)
        return
    aside = temporary_sibling(target, "old")
    os.replace(target, aside)
    try:
        os.replace(temporary, target)
    except BaseException:
        os.replace(aside, target)
        raise
    _remove(aside)


def _exchange(one: Path, other: Path) -> bool:
    """Whether two names changed places, in one atomic step (Linux)."""
    import ctypes

    try:
        renameat2 = ctypes.CDLL(None, use_errno=True).renameat2
    except (OSError, AttributeError):
        return False
    return renameat2(AT_FDCWD, os.fsencode(one), AT_FDCWD, os.fsencode(other), RENAME_EXCHANGE) == 0


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink()


def _explain(error: BaseException, path: Path | str, temporary: Path, target: Path) -> None:
    """Turn a failed write of this output into a sentence; an error about another file is left as it is."""
    if not isinstance(error, OSError) or isinstance(error, FormatError) or error.errno not in CAUSES:
        return
    if error.filename is None or str(error.filename).startswith((str(temporary), str(target))):
        raise ResourceError(f"{path}: cannot be written: {CAUSES[error.errno]}") from error


def _sync_tree(folder: Path) -> None:
    """Flush every file in `folder`, and then the names."""
    for copy, _, names in os.walk(folder, topdown=False):
        for name in names:
            sync_file(os.path.join(copy, name))
        sync_folder(Path(copy))


def sync_file(path: Path | str) -> None:
    """Flush a file that somebody else wrote."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sync_folder(folder: Path) -> None:
    """Make the rename itself survive a power loss; where this is not possible, the file is still complete."""
    with contextlib.suppress(OSError):
        sync_file(folder)
