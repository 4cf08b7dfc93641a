"""Where compiled kernels are kept."""

import os
import shutil
import stat
import subprocess
import sys
import time
from pathlib import Path

import numba
import pytest

from fusedrf_cli.engine import kernels


def test_cache_is_the_users_and_named_for_what_is_inlined(tmp_path, monkeypatch):
    """numba does not notice that an inlined function of another file changed: new text needs another
    folder."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    folder = kernels.kernel_cache()
    assert folder.is_dir() and folder.is_relative_to(tmp_path / "fusedrf")
    read, engine = Path.read_bytes, Path(kernels.__file__).parent.parent
    changed = [
        *("kernels/parts.py", "kernels/loops.py", "kernels/prefetch.py", "spaces/bounded.py"),
        *(f"kinds/{kind}/bodies.py" for kind in ("vm", "sparse", "vm_mlp")),
    ]
    folders = {folder}
    for name in changed:
        monkeypatch.setattr(Path, "read_bytes", lambda p, n=name: b"#" if p == engine / n else read(p))
        folders.add(kernels.kernel_cache())
    assert len(folders) == len(changed) + 1


SCRIPT = """
import sys
import numpy as np
from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.kernels import cpu
told = []
with kernels.telling_of_compilation(lambda: told.append(1)):
    rays = np.zeros((1, 3)), np.ones((1, 3))
    cpu.lens_rays(np.eye(4), 1.0, 1.0, 0.5, 0.5, (0.0,) * 9, False, 1, 0, np.zeros(1, np.int64), *rays)
print(cpu.__file__)
sys.exit(len(told))
"""
"""Compiles two functions, or loads them; its exit code is how often it was told of compilation."""


def test_compilation_is_told_once_and_what_is_kept_is_not_compiled(tmp_path):
    """Two functions, then the same again in a second process: one call of `tell`, then none."""
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path)}
    runs = [subprocess.run([sys.executable, "-c", SCRIPT], env=environment).returncode for _ in range(2)]
    assert runs == [1, 0]


def test_another_copy_of_the_code_compiles_nothing(tmp_path):
    """Clones and worktrees share what one of them has compiled."""
    environment = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "PYTHONPATH")}
    runs = []
    for name in ("one", "other"):
        shutil.copytree(Path(kernels.__file__).parents[2], tmp_path / name / "fusedrf_cli")
        paths = {"PYTHONPATH": str(tmp_path / name), "XDG_CACHE_HOME": str(tmp_path / "cache")}
        command = [sys.executable, "-c", SCRIPT]
        run = subprocess.run(command, env=environment | paths, cwd=tmp_path, capture_output=True, text=True)
        assert run.stdout.startswith(str(tmp_path / name)), run.stderr
        runs.append(run.returncode)
    assert runs == [1, 0]


def test_cache_that_cannot_be_written_is_made_elsewhere(tmp_path, monkeypatch):
    (tmp_path / "fusedrf").write_text("a file where the folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    assert kernels.kernel_cache().parent == tmp_path


def elsewhere(monkeypatch, tmp_path) -> Path:
    """A temporary folder, and a user's cache that cannot be made."""
    (tmp_path / "fusedrf").write_text("a file where the folder should be")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def test_a_temporary_cache_is_found_again_and_private(tmp_path, monkeypatch):
    elsewhere(monkeypatch, tmp_path)
    folder = kernels.kernel_cache()
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700 and kernels.kernel_cache() == folder


@pytest.mark.parametrize("trap", ["open to others", "a link", "another user's", "a file"])
def test_a_temporary_cache_that_another_user_may_have_filled_is_not_used(tmp_path, monkeypatch, trap):
    """Its name can be known, and what is in it is run."""
    elsewhere(monkeypatch, tmp_path)
    folder = kernels.temporary_cache("0123")
    if trap == "open to others":
        folder.chmod(0o777)
    elif trap == "a link":
        folder.rename(tmp_path / "theirs")
        folder.symlink_to(tmp_path / "theirs")
    elif trap == "another user's":
        monkeypatch.setattr(kernels, "is_ours", lambda *_, **__: False)
    else:
        folder.rmdir()
        folder.write_text("")
    found = kernels.temporary_cache("0123")
    assert found != folder and stat.S_IMODE(found.stat().st_mode) == 0o700 and not any(found.iterdir())


def test_ours_is_what_we_own(tmp_path, monkeypatch):
    assert kernels.is_ours(tmp_path, others=0)
    another = os.getuid() + 1
    monkeypatch.setattr(os, "getuid", lambda: another)
    assert not kernels.is_ours(tmp_path, others=0)


def test_a_users_cache_that_others_may_write_is_not_used(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    kernels.kernel_cache().chmod(0o777)
    assert kernels.kernel_cache().parent == tmp_path


def test_the_working_clock_stands_still_while_something_is_compiled():
    started, worked = time.monotonic(), kernels.working_time()

    @numba.njit
    def cube(x):
        return x**3

    assert cube(2.0) == 8
    compiled = kernels._compiling.duration
    passed = time.monotonic() - started
    assert 0 < compiled and kernels.working_time() - worked < passed - 0.5 * min(compiled, passed)
