"""Compiled kernels. Import `fusedrf_cli.engine.kernels` only when numbers are to be crunched: it loads numba."""

import os
import tempfile
from pathlib import Path


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


os.environ.setdefault("NUMBA_CACHE_DIR", str(kernel_cache()))

from fusedrf_cli.engine.kernels import cpu  # noqa: E402  (numba reads its cache folder at import)
from fusedrf_cli.engine.kernels.bodies import NO_BLOCK, GridArrays, VMArrays  # noqa: E402

__all__ = ["NO_BLOCK", "GridArrays", "VMArrays", "cpu", "kernel_cache"]
