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
        *("kernels/primitives.py", "kernels/loops.py", "kernels/learning.py", "kernels/prefetch.py"),
        *("spaces/bounded.py", "kernels/bundles.py", "kernels/lens.py"),
        *("encodings/line.py", "decoders/sh_basis.py", "encodings/plane_line.py", "encodings/bricks.py"),
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
with kernels.report_compilation(lambda: told.append(1)):
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


KEPT = """
import os, sys
from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.kernels import locator
locator.PACKAGE = locator.Path(__file__).parent
import numba
exec(compile("@numba.njit(cache=True)\\ndef cube(x):\\n    return x**3", __file__, "exec"))
said, told = [], []
with kernels.report_compilation(lambda: told.append(1), said.append):
    assert cube(2.0) == 8 and cube(3) == 27
print(len(told), *said, sep="\\n")
"""
"""Compiles a function for two types, or loads it; says whether it was compiled, and what was warned of."""


@pytest.fixture
def cube(tmp_path):
    """(cube(), folder): run that script, and where it keeps what it has compiled."""
    (tmp_path / "script.py").write_text(KEPT)
    folder = tmp_path / "cache"
    environment = os.environ | {
        "NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": str(Path(kernels.__file__).parents[3])
    }  # fmt: skip

    def run(before: str = "") -> tuple[bool, list[str]]:
        command = [sys.executable, "-c", f"__file__ = {str(tmp_path / 'script.py')!r}\n{before}\n{KEPT}"]
        done = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        compiled, *said = done.stdout.splitlines()
        return compiled == "1", said

    assert run() == (True, []) and run() == (False, [])
    return run, folder


DAMAGES = {
    "a bit": lambda data: data[:-9] + bytes([data[-9] ^ 4]) + data[-8:],
    "a bit of the checksum": lambda data: bytes([data[0] ^ 1]) + data[1:],
    "cut short": lambda data: data[: len(data) // 2],
    "empty": lambda data: b"",
    "another pickle": lambda data: b"\x80\x04\x8c\x02no\x94.",
}


def test_damaged_kernels_are_compiled_again(cube):
    """With a warning, once, and then they are kept again: what is kept is code."""
    run, folder = cube
    files = sorted(folder.rglob("*.kept"))
    assert len(files) == 2
    for name, damage in DAMAGES.items():
        for file in files:
            file.write_bytes(damage(file.read_bytes()))
        compiled, said = run()
        assert compiled and len(said) == 1 and "are damaged; they are compiled again" in said[0], name
    assert run() == (False, [])


def test_kernels_of_another_function_under_a_name_are_not_run(cube):
    run, folder = cube
    one, other = sorted(folder.rglob("*.kept"))
    one.write_bytes(other.read_bytes())
    assert run()[0] and run() == (False, [])


@pytest.mark.parametrize("trouble", ["a full disk", "a file in the way", "no folder"])
def test_kernels_that_cannot_be_kept_are_compiled_with_one_warning(cube, trouble):
    run, folder = cube
    shutil.rmtree(folder)
    if trouble == "no folder":  # removed while a process runs: made again
        assert run() == (True, []) and run() == (False, [])
        return
    before = ""
    if trouble == "a full disk":
        before = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))\n"
        before += "import signal; signal.signal(signal.SIGXFSZ, signal.SIG_IGN)"
    else:
        folder.write_text("")
    compiled, said = run(before)
    assert compiled and len(said) == 1 and "cannot be kept" in said[0]
    assert not [path for path in folder.rglob("*") if path.is_file()]
