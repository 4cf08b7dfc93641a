"""Outputs that appear whole or not at all: a sibling temporary, flushed, then renamed."""

import contextlib
import errno
import os
import secrets
import shutil
import stat
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from formats.errors import FormatError, OutputExists, ResourceError

CAUSES = {
    errno.ENOSPC: "the disk is full; free some space or choose another folder",
    errno.EDQUOT: "the disk quota is used up; free some space or choose another folder",
    errno.EACCES: "permission is missing; choose a folder that you may write to",
    errno.EPERM: "permission is missing; choose a folder that you may write to",
    errno.EROFS: "the place is read-only; choose another folder",
    errno.EISDIR: "a folder of that name is in the way; choose another name",
    errno.EFBIG: "the file is larger than the disk's format allows",
    errno.EIO: "the disk reports an error; choose another one",
}


@contextlib.contextmanager
def atomic_writer(path: Path | str, *, mode: str = "wb") -> Iterator[BinaryIO]:
    """A file object (with a real `.name`) whose content becomes `path` if the block ends without exception.

    A link is written through. A new file gets mode 0666 less the umask, a replaced one keeps its mode. Any
    exception, KeyboardInterrupt too, leaves the old file and no temporary. Raises ResourceError: disk full,
    read-only, no permission.
    """
    target = Path(os.path.realpath(path))
    temporary = _sibling(target)
    try:
        with open(temporary, mode.replace("w", "x"), encoding=None if "b" in mode else "utf-8") as file:
            yield file
            file.flush()
            os.fsync(file.fileno())
        _keep_mode(target, temporary)
        os.replace(temporary, target)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink()
        _explain(error, path, temporary, target)
        raise
    _sync_folder(target.parent)


@contextlib.contextmanager
def atomic_folder(path: Path | str, *, overwrite: bool = False) -> Iterator[Path]:
    """A temporary sibling folder that becomes `path` if the block ends without an exception, else is removed.

    An empty folder at `path` is replaced, anything else only with `overwrite` (OutputExists otherwise).
    """
    check_writable(path, overwrite)
    target = Path(os.path.realpath(path))
    temporary = _sibling(target)
    try:
        temporary.mkdir()
        yield temporary
        _swap_in(temporary, target)
    except BaseException as error:
        shutil.rmtree(temporary, ignore_errors=True)
        _explain(error, path, temporary, target)
        raise
    _sync_folder(target.parent)


def check_writable(path: Path | str, overwrite: bool) -> None:
    """Before any work: `path` may be created here. Raises OutputExists or ResourceError."""
    target = Path(os.path.realpath(path))
    if not target.parent.is_dir():
        raise ResourceError(f"{path}: its folder {target.parent} does not exist; create it first")
    if not os.access(target.parent, os.W_OK | os.X_OK):
        raise ResourceError(f"{path}: cannot write in {target.parent}; choose a folder that you may write to")
    if not overwrite and target.exists() and not _is_empty_folder(target):
        raise OutputExists(f"{path}: exists already; give -w/--overwrite to replace it, or another name")


def _sibling(target: Path) -> Path:
    return target.with_name(f".{target.name[:80]}.{secrets.token_hex(6)}.tmp")


def _keep_mode(target: Path, temporary: Path) -> None:
    with contextlib.suppress(FileNotFoundError):
        os.chmod(temporary, stat.S_IMODE(target.stat().st_mode))


def _is_empty_folder(path: Path) -> bool:
    return path.is_dir() and not any(path.iterdir())


def _swap_in(temporary: Path, target: Path) -> None:
    """Rename onto `target`; what stood there moves aside first: a rename replaces only an empty folder."""
    if not target.exists() or _is_empty_folder(target):
        os.replace(temporary, target)
        return
    aside = _sibling(target)
    os.replace(target, aside)
    try:
        os.replace(temporary, target)
    except BaseException:
        os.replace(aside, target)
        raise
    if aside.is_dir():
        shutil.rmtree(aside, ignore_errors=True)
    else:
        aside.unlink()


def _explain(error: BaseException, path: Path | str, temporary: Path, target: Path) -> None:
    """Turn a failed write of this output into a sentence; an error about some other file is none of ours."""
    if not isinstance(error, OSError) or isinstance(error, FormatError) or error.errno not in CAUSES:
        return
    if error.filename is None or str(error.filename).startswith((str(temporary), str(target))):
        raise ResourceError(f"{path}: cannot be written: {CAUSES[error.errno]}") from error


def _sync_folder(folder: Path) -> None:
    """Make the rename itself survive a power loss; where that cannot be, the file is whole either way."""
    with contextlib.suppress(OSError):
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
