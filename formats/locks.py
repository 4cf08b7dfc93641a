"""One writer per output: a lock file beside it, held from reading to writing, which ends with its process;
and temporary folders that are locked as long as their process lives."""

import contextlib
import errno
import os
import shutil
import stat
import tempfile
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path

from formats.atomic import hidden_sibling, remove_leftovers, unfinished
from formats.errors import FormatWarning, ResourceError

ENDING = "fusedrf-lock"
NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL)


@contextlib.contextmanager
def output_lock(path: Path | str, waiting: Callable[[str], None] | None = None) -> Iterator[None]:
    """In this block no other fusedrf writes `path`; temporaries that killed writers left are removed.

    Another writer makes this one wait, after a call of `waiting` with a sentence, or without `waiting` raises
    ResourceError. The lock is the kernel's (flock) on a hidden file beside `path`: a killed holder leaves the
    file but not the lock. Where the file system has no locks, FormatWarning.
    """
    from filelock import FileLock, Timeout

    target = Path(os.path.realpath(path))
    beside = hidden_sibling(target, ENDING)
    lock = FileLock(beside, fallback_to_soft=False)
    try:
        try:
            lock.acquire(timeout=0)
        except Timeout:
            if waiting is None:
                raise
            waiting(f"{path}: waiting for another fusedrf that is writing it")
            lock.acquire()
    except Timeout as error:
        raise ResourceError(
            f"{path}: another fusedrf is writing it; wait until it has finished, or choose another name"
        ) from error
    except PermissionError as error:
        raise ResourceError(
            f"{path}: the lock {beside} belongs to another user; wait until it is removed"
        ) from error
    except OSError as error:
        if error.errno not in NO_LOCKS:
            raise
        text = f"{path}: its file system has no locks; make sure that nothing else writes it now"
        warnings.warn(text, FormatWarning, 3)
        yield
        return
    unfinished.add(beside)
    try:
        remove_leftovers(target)
        yield
    finally:
        unfinished.discard(beside)
        # Before the release: a process waiting for the lock sees that the file is gone, and makes a new one.
        with contextlib.suppress(OSError):
            beside.unlink()
        lock.release()


@contextlib.contextmanager
def temporary_folder(prefix: str) -> Iterator[Path]:
    """A new folder for temporary files, which ends with the block. Those of this prefix that this user's
    killed processes left are removed."""
    for path in Path(tempfile.gettempdir()).glob(f"{prefix}*"):
        if _abandoned(path):
            shutil.rmtree(path, ignore_errors=True)
    new = Path(tempfile.mkdtemp(prefix="fusedrf-new-"))
    folder = new.with_name(new.name.replace("fusedrf-new-", prefix))
    unfinished.add(folder)
    with _locked(new):
        try:
            yield new.rename(folder)  # only now, locked, it has a name that others look for
        finally:
            shutil.rmtree(folder, ignore_errors=True)
            unfinished.discard(folder)


def _abandoned(folder: Path) -> bool:
    """Whether a temporary folder is this user's, and no process holds it."""
    try:
        status = folder.lstat()
        if not stat.S_ISDIR(status.st_mode) or status.st_uid != os.getuid():
            return False
        with _locked(folder) as is_locked:
            return is_locked
    except OSError:
        return False


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[bool]:
    """Lock a folder for this block; whether nobody else had locked it."""
    import fcntl

    descriptor = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        is_locked = True
    except OSError:
        is_locked = False
    try:
        yield is_locked
    finally:
        os.close(descriptor)
