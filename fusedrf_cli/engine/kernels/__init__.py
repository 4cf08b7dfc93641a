"""Compiled kernels. Import `fusedrf_cli.engine.kernels` only when numbers are to be crunched: it loads
numba."""

import hashlib
import os
import tempfile
from pathlib import Path
from types import ModuleType

import numba


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


def is_cold() -> bool:
    """Whether nothing has been compiled yet into the cache folder."""
    folder = Path(numba.config.CACHE_DIR or os.environ["NUMBA_CACHE_DIR"])
    return not folder.is_dir() or not any(folder.iterdir())


__all__ = ["NO_BLOCK", "GridArrays", "VMArrays", "cpu", "is_cold", "kernel_cache", "loops", "set_threads"]
