"""Where compiled kernels are kept."""

import hashlib
from pathlib import Path

from fusedrf_cli.engine import kernels


def test_cache_is_the_users_and_named_for_the_bodies(tmp_path, monkeypatch):
    """numba does not notice that an inlined function of another file changed: a new bodies.py needs another
    folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    bodies = Path(kernels.__file__).with_name("bodies.py").read_bytes()
    folder = kernels.kernel_cache()
    assert folder.is_dir() and folder.is_relative_to(tmp_path / "fusedrf")
    assert hashlib.sha256(bodies).hexdigest().startswith(folder.name)
    monkeypatch.setattr(Path, "read_bytes", lambda path: bodies + b"#")
    assert kernels.kernel_cache() != folder


def test_cache_that_cannot_be_written_is_made_elsewhere(tmp_path, monkeypatch):
    (tmp_path / "fusedrf").write_text("a file where the folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert kernels.kernel_cache().parent == tmp_path
