"""Compiled kernels. Import `fusedrf_cli.engine.kernels` only when numbers are to be crunched: it loads
numba."""

import hashlib
import os
import tempfile
from collections.abc import Callable
from contextlib import AbstractContextManager
from pathlib import Path
from types import ModuleType

import numba
from numba.core import event


def kernel_cache() -> Path:
    """The folder compiled kernels are kept in: the user's cache, or a temporary one where that cannot be
    written.

    It is named for the text of what the loops inline: numba only looks for changes in the file of the loop.
    """
    inlined = [Path(__file__).with_name(f"{name}.py") for name in ("bodies", "prefetch", "items")]
    bodies = hashlib.sha256(b"".join(path.read_bytes() for path in inlined)).hexdigest()[:12]
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    wanted = Path(home) / "fusedrf" / "kernels" / bodies
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        probe = tempfile.TemporaryFile(dir=wanted)
        probe.close()
        return wanted
    except OSError:
        fallback = Path(tempfile.gettempdir()) / f"fusedrf-kernels-{os.getuid()}-{bodies}"
        fallback.mkdir(exist_ok=True)
        return fallback


if "NUMBA_CACHE_DIR" not in os.environ:
    numba.config.CACHE_DIR = str(kernel_cache())
# The gradient scatter adds short runs of floats; only superword vectorisation turns those into vector
# instructions (8x).
numba.config.SLP_VECTORIZE = 1

from fusedrf_cli.engine.kernels import cpu  # noqa: E402  (compiles under the settings above)
from fusedrf_cli.engine.kernels.bodies import NO_BLOCK, GridArrays, VMArrays  # noqa: E402


def loops(device: str) -> ModuleType:
    """The module of compiled loops for arrays of a torch device type, "cpu" or "cuda". The first use of the
    latter needs the `[gpu]` extra."""
    if device == "cuda":
        from fusedrf_cli.engine.kernels import cuda

        return cuda
    return cpu


def set_threads(count: int) -> None:
    """Use that many cores, at most as many as numba started with."""
    numba.set_num_threads(min(count, numba.config.NUMBA_NUM_THREADS))


class _First(event.Listener):
    """Calls a function at the first compilation: what the cache holds is not compiled."""

    def __init__(self, tell: Callable[[], None]):
        self.tell, self.told = tell, False

    def on_start(self, found: event.Event) -> None:
        if not self.told:
            self.told = True
            self.tell()

    def on_end(self, found: event.Event) -> None:
        """Nothing."""


def telling_of_compilation(tell: Callable[[], None]) -> AbstractContextManager:
    """Within it `tell` is called once, before the first kernel that has to be compiled."""
    return event.install_listener("numba:compile", _First(tell))


__all__ = [
    "NO_BLOCK",
    "GridArrays",
    "VMArrays",
    "cpu",
    "kernel_cache",
    "loops",
    "set_threads",
    "telling_of_compilation",
]
