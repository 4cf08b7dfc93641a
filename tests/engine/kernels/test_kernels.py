"""Where compiled kernels are kept."""

import hashlib
import os
import subprocess
import sys
from pathlib import Path

from fusedrf_cli.engine import kernels


def test_cache_is_the_users_and_named_for_the_bodies(tmp_path, monkeypatch):
    """numba does not notice that an inlined function of another file changed: new bodies need another
    folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    files = ("bodies.py", "prefetch.py", "items.py")
    inlined = [Path(kernels.__file__).with_name(name).read_bytes() for name in files]
    folder = kernels.kernel_cache()
    assert folder.is_dir() and folder.is_relative_to(tmp_path / "fusedrf")
    assert hashlib.sha256(b"".join(inlined)).hexdigest().startswith(folder.name)
    monkeypatch.setattr(Path, "read_bytes", lambda path: b"#")
    assert kernels.kernel_cache() != folder


def test_compilation_is_told_once_and_what_is_kept_is_not_compiled(tmp_path):
    """Two functions, then the same again in a second process: one call of `tell`, then none."""
    script = """
import numpy as np, sys
from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.kernels import cpu
told = []
with kernels.telling_of_compilation(lambda: told.append(1)):
    rays = np.zeros((1, 3)), np.ones((1, 3))
    cpu.pinhole_rays(np.eye(4), 1.0, 1.0, 0.5, 0.5, 1, 0, np.zeros(1, np.int64), *rays)
sys.exit(len(told))
"""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    runs = [subprocess.run([sys.executable, "-c", script], env=environment).returncode for _ in range(2)]
    assert runs == [1, 0]


def test_cache_that_cannot_be_written_is_made_elsewhere(tmp_path, monkeypatch):
    (tmp_path / "fusedrf").write_text("a file where the folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert kernels.kernel_cache().parent == tmp_path
