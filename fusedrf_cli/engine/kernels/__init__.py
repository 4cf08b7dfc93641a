"""Compiled kernels. Import `fusedrf_cli.engine.kernels` only when numbers are to be crunched: it loads numba."""

import os
import tempfile
from pathlib import Path

import numba


def kernel_cache() -> Path:
    """The folder compiled kernels are kept in: the user's cache, or a temporary one where that cannot be written."""
    home = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    wanted = Path(home) / "fusedrf" / "kernels"
    try:
        wanted.mkdir(parents=True, exist_ok=True)
        probe = tempfile.TemporaryFile(dir=wanted)
        probe.close()
        return wanted
    except OSError:
        fallback = Path(tempfile.gettempdir()) / f"fusedrf-kernels-{os.getuid()}"
        fallback.mkdir(exist_ok=True)
        return fallback


if "NUMBA_CACHE_DIR" not in os.environ:
    numba.config.CACHE_DIR = str(kernel_cache())
# The gradient scatter adds short runs of floats; only superword vectorisation turns those into vector instructions (8x).
numba.config.SLP_VECTORIZE = 1

from fusedrf_cli.engine.kernels import cpu  # noqa: E402  (compiles under the settings above)
from fusedrf_cli.engine.kernels.bodies import NO_BLOCK, GridArrays, VMArrays  # noqa: E402

__all__ = ["NO_BLOCK", "GridArrays", "VMArrays", "cpu", "kernel_cache"]
