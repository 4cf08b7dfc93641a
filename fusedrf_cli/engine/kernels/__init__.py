"""Compiled kernels. Import `fusedrf_cli.engine.kernels` only when numbers are to be crunched: it loads
numba."""

import atexit
import contextlib
import hashlib
import os
import shutil
import stat
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from types import ModuleType

import numba
from numba.core import event
from platformdirs import user_cache_path

from fusedrf_cli.engine.kernels import locator
from fusedrf_cli.engine.kernels.threads import ONE_THREAD


def kernel_cache() -> Path:
    """The folder compiled kernels are kept in: the user's cache, or a temporary one where that cannot be
    written. Kernels are code, so a folder that another user could have filled is neither.

    It is named for the text of what the loops inline: numba only looks for changes in the file of the loop.
    Where no folder can be had, nothing is kept.
    """
    digest = hashlib.sha256(b"".join(path.read_bytes() for path in inlined())).hexdigest()[:12]
    digest += "-one" if ONE_THREAD else ""
    folder = user_cache_path("fusedrf") / "kernels" / digest
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = tempfile.TemporaryFile(dir=folder)
        probe.close()
        ours = is_ours(folder, others=stat.S_IWGRP | stat.S_IWOTH)
    except OSError:
        ours = False
    try:
        return folder if ours else temporary_cache(digest)
    except OSError:
        return Path(os.devnull, "kernels")


def inlined() -> list[Path]:
    """Every file of the engine whose functions may be inlined into a loop."""
    engine = Path(__file__).parent.parent
    patterns = "kernels/*.py", "spaces/*.py", "encodings/*.py", "decoders/*.py"
    return sorted(path for pattern in patterns for path in engine.glob(pattern))


def temporary_cache(digest: str) -> Path:
    """A folder in the temporary one that is found again by its name, or a new one that lasts as long as the
    process where that name is another user's or open to others.
    """
    shared = Path(tempfile.gettempdir()) / f"fusedrf-kernels-{os.getuid()}-{digest}"
    with contextlib.suppress(OSError):
        shared.mkdir(mode=0o700, exist_ok=True)
        if is_ours(shared, others=stat.S_IRWXG | stat.S_IRWXO):
            return shared
    private = tempfile.mkdtemp(prefix="fusedrf-kernels-")
    atexit.register(shutil.rmtree, private, ignore_errors=True)
    return Path(private)


def is_ours(folder: Path, others: int) -> bool:
    """Whether `folder` is one, no link, of this user's, and none of the rights `others` are given."""
    status = folder.lstat()
    return stat.S_ISDIR(status.st_mode) and status.st_uid == os.getuid() and not status.st_mode & others


locator.install()
if "NUMBA_CACHE_DIR" not in os.environ:
    numba.config.CACHE_DIR = str(kernel_cache())
# The gradient scatter adds short runs of floats; only superword vectorisation turns those into vector
# instructions (8x).
numba.config.SLP_VECTORIZE = 1

from fusedrf_cli.engine.kernels import cpu  # noqa: E402  (compiles under the settings above)
from fusedrf_cli.engine.kernels.primitives import GridArrays  # noqa: E402


def device_loops(device: str) -> ModuleType | None:
    """The module of compiled loops for arrays of a torch device type, "cpu" or "cuda", or None where there
    are none. The first use of "cuda" needs the `[gpu]` extra."""
    if device == "cuda":
        from fusedrf_cli.engine.kernels import cuda

        return cuda
    return cpu if device == "cpu" else None


def set_threads(count: int) -> None:
    """Use that many cores, at most as many as numba started with."""
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))


class _FirstCompilation(event.Listener):
    """Calls a function at the first compilation: what the cache holds is not compiled."""

    def __init__(self, report: Callable[[], None]):
        self.report, self.told = report, False

    def on_start(self, compile_event: event.Event) -> None:
        if not self.told:
            self.told = True
            self.report()

    def on_end(self, compile_event: event.Event) -> None:
        """Nothing."""


@contextlib.contextmanager
def report_compilation(
    report: Callable[[], None], warn: Callable[[str], None] = warnings.warn
) -> Iterator[None]:
    """Within it `report` is called once, before the first kernel that has to be compiled, and `warn` where
    compiled kernels cannot be kept."""
    before, locator.KernelStore.warn = locator.KernelStore.warn, staticmethod(warn)
    try:
        with event.install_listener("numba:compile", _FirstCompilation(report)):
            yield
    finally:
        locator.KernelStore.warn = staticmethod(before)


_compiling = event.TimingListener()
event.register("numba:compile", _compiling)
event.register("fusedrf:gpu", _compiling)  # what kernels/cuda.py tells of the GPU's compiler


def working_time() -> float:
    """A monotonic clock (s) that stands still while kernels are compiled: a first use takes its time from
    nobody's budget.
    """
    return time.monotonic() - (_compiling.duration if _compiling.done else 0.0)


__all__ = [
    "GridArrays",
    "cpu",
    "device_loops",
    "kernel_cache",
    "set_threads",
    "report_compilation",
    "working_time",
]
