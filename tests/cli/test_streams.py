"""Standard streams that are closed, full or left: no traceback, and outputs are as they were."""

import shlex
import subprocess
import sys

import pytest

from tests.cli.conftest import ROOT

MAIN = f"import sys; sys.path.insert(0, {str(ROOT)!r}); from fusedrf_cli.main import main; main()"
CLOSED = (">&-", "<&-", "2>&-", ">&- 2>&-", "<&- >&- 2>&-", "2>/dev/full")
TO_FILE = ("compose", "chair.rfpack", "-o", "scene.json")


@pytest.fixture
def shell(folder):
    """shell("info chair.rfpack", ">&-") -> a finished process of a command line of a shell."""

    def shell(words: tuple[str, ...], redirections: str) -> subprocess.CompletedProcess:
        line = f"exec {shlex.join([sys.executable, '-c', MAIN, *words])} {redirections}"
        return subprocess.run(["sh", "-c", line], capture_output=True, text=True, timeout=300)

    return shell


@pytest.mark.parametrize("closed", CLOSED)
def test_an_output_is_right_whatever_is_closed(shell, folder, closed):
    """A stream's number that is free would be given to the output, and get what is printed."""
    assert shell(TO_FILE, "").returncode == 0
    right = (folder / "scene.json").read_bytes()
    done = shell((*TO_FILE, "-w"), closed)
    assert (done.returncode, done.stderr) == (0, "") and (folder / "scene.json").read_bytes() == right


@pytest.mark.parametrize("words", [("--help",), ("info", "chair.rfpack"), ("info", "chair.rfpack", "--json")])
def test_a_result_that_nobody_can_get_is_an_error(shell, words):
    done = shell(words, ">&-")
    assert done.returncode == 5 and done.stderr.startswith("Error: standard output is closed")
    assert shell(words, ">&- 2>&-").returncode == 5


@pytest.mark.parametrize("closed", CLOSED)
def test_an_error_keeps_its_code(shell, closed):
    done = shell(("info", "nowhere.rfpack"), closed)
    assert done.returncode == 3 and done.stderr.count("\n") == ("2>" not in closed)


def test_a_closed_input_is_an_empty_one(shell):
    done = shell(("info", "-"), "<&-")
    assert done.returncode == 3 and done.stderr.startswith("Error: standard input: not strict JSON")
