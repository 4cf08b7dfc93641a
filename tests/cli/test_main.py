import errno
import signal
import time

import pytest

from formats.errors import FormatError, NewerVersion
from fusedrf_cli.errors import (
    FusedRFError,
    InvalidInput,
    NumericFailure,
    QualityNotReached,
    ResourceProblem,
    UsageProblem,
)

MAIN = "from fusedrf_cli.main import main; main()"
HEAVY = {"torch", "trimesh", "rich", "scipy", "skimage", "imageio", "numba"}
# A command line that prints, at its end, which of the slow packages it imported.
IMPORTS = f"""
import atexit
atexit.register(lambda: print(sorted({HEAVY | {"numpy"}!r} & set(sys.modules)), file=sys.stderr))
{MAIN}
"""
# `train` with a bridge that writes half an output and then waits to be stopped.
WAITING = f"""
import time, types
from formats.atomic import atomic_writer
def train(request, progress):
    with atomic_writer(request.output) as file:
        file.write(b"half")
        print("ready", flush=True)
        time.sleep(60)
import fusedrf_cli
fusedrf_cli.bridge = sys.modules["fusedrf_cli.bridge"] = types.SimpleNamespace(train=train)
{MAIN}
"""


@pytest.mark.parametrize(
    "error, code",
    [
        (FusedRFError("no"), 1),
        (UsageProblem("no"), 2),
        (InvalidInput("no"), 3),
        (FormatError("no"), 3),
        (NewerVersion("no"), 4),
        (ResourceProblem("no"), 5),
        (MemoryError(), 5),
        (OSError(errno.ENOSPC, "No space left on device"), 5),
        (PermissionError(errno.EACCES, "Permission denied", "x"), 5),
        (FileNotFoundError(errno.ENOENT, "No such file or directory", "x"), 3),
        (NumericFailure("no"), 6),
        (QualityNotReached("no"), 7),
        (KeyboardInterrupt(), 130),
        (ValueError("a bug"), 1),
    ],
)
def test_each_failure_is_one_line_and_its_exit_code(run, bridge, error, code):
    bridge.error = error
    result = run("train", "chair.rfpack", "-o", "out.rfpack")
    assert result.exit_code == code
    assert result.stdout == ""
    assert result.stderr.startswith("Error: ") and result.stderr.count("\n") == 1


def test_an_error_does_not_move_the_cursor(run, bridge):
    bridge.error = FusedRFError("node 'a\x1b[2J\nb' is odd")
    assert run("train", "chair.rfpack", "-o", "o").stderr == "Error: node 'a\\x1b[2J\\nb' is odd\n"


@pytest.mark.parametrize("words", [("--debug", "train"), ("train", "--debug")])
def test_debug_shows_the_traceback_and_then_the_line(run, bridge, words):
    bridge.error = FusedRFError("no")
    result = run(*words, "chair.rfpack", "-o", "out.rfpack")
    assert result.stderr.startswith("Traceback") and result.stderr.endswith("\nError: no\n")
    assert result.exit_code == 1


@pytest.mark.parametrize(
    "words, hint",
    [
        (("bogus",), "fusedrf --help"),
        (("--bogus",), "fusedrf --help"),
        (("train", "--bogus"), "fusedrf train --help"),
        (("train", "chair.rfpack"), "fusedrf train --help"),
        (("train", "chair.rfpack", "-o", "x", "--sh-degree", "8"), "fusedrf train --help"),
    ],
)
def test_wrong_usage_is_one_line_that_names_the_help(run, words, hint):
    result = run(*words)
    assert result.exit_code == 2
    assert result.stderr.endswith(f"try '{hint}'\n") and result.stderr.count("\n") == 1


def test_no_words_at_all_show_the_help_as_an_error(run):
    result = run()
    assert result.exit_code == 2 and "Exit codes:" in result.stderr and result.stdout == ""


def test_options_come_from_the_environment(run, bridge, monkeypatch):
    monkeypatch.setenv("FUSEDRF_TRAIN_SEED", "7")
    monkeypatch.setenv("FUSEDRF_TRAIN_MAX_SIZE", "2MB")
    run("train", "chair.rfpack", "-o", "out.rfpack")
    _, options = bridge.call
    assert (options["seed"], options["max_size"]) == (7, 2_000_000)


@pytest.mark.parametrize("name, code", [("SIGINT", 130), ("SIGTERM", 143)])
def test_a_signal_leaves_no_output_and_its_code(process, folder, name, code):
    before = set(folder.iterdir())
    running = process(WAITING, "train", "chair.rfpack", "-o", "out.rfpack")
    assert running.stdout.readline() == "ready\n"
    assert len(set(folder.iterdir())) == len(before) + 2  # the temporary and the lock
    running.send_signal(getattr(signal, name))
    _, stderr = running.communicate(timeout=120)
    assert (running.returncode, stderr) == (code, "Error: interrupted\n")
    assert set(folder.iterdir()) == before


def test_a_signal_that_the_caller_ignores_stays_ignored(process):
    ignoring = "import signal; signal.signal(signal.SIGINT, signal.SIG_IGN)\n" + WAITING
    running = process(ignoring, "train", "chair.rfpack", "-o", "out.rfpack")
    running.stdout.readline()
    running.send_signal(signal.SIGINT)
    time.sleep(0.3)
    assert running.poll() is None
    running.terminate()
    running.communicate(timeout=120)
    assert running.returncode == 143


@pytest.mark.parametrize("words", [("--help",), ("info", "chair.rfpack"), ("info", "chair.rfpack", "--json")])
def test_a_reader_that_left_is_no_error_to_speak_of(process, words):
    waiting = f"sys.stdin.read()\n{MAIN}"
    running = process(waiting, *words)
    running.stdout.close()
    running.stdin.close()
    assert running.stderr.read() == ""
    assert running.wait(120) == 128 + signal.SIGPIPE


@pytest.mark.parametrize("words", [("--version",), ("info", "chair.rfpack")])
def test_a_full_disk_behind_stdout_is_one_line(process, words):
    with open("/dev/full", "w") as full:
        running = process(MAIN, *words, stdout=full)
        assert running.communicate(timeout=120)[1] == "Error: No space left on device\n"
    assert running.returncode == 5


@pytest.mark.parametrize(
    "words, allowed",
    [
        (("--help",), set()),
        (("train", "--help"), set()),
        (("info", "chair.rfpack"), {"numpy"}),
        (("validate", "chair.rfpack"), {"numpy"}),
        (("compose", "chair.rfpack", "-t", "1,0,0", "-o", "scene.json"), {"numpy"}),
    ],
)
def test_quick_commands_import_nothing_slow(process, words, allowed):
    running = process(IMPORTS, *words)
    _, stderr = running.communicate(timeout=120)
    assert running.returncode == 0
    assert stderr == f"{sorted(allowed)}\n"


def test_help_loads_little(process):
    """172 modules, of which click takes 60; seconds would be those of whatever else the computer does."""
    counting = "import atexit; atexit.register(lambda: print(len(sys.modules), file=sys.stderr))\n" + MAIN
    assert int(process(counting, "--help").communicate(timeout=120)[1]) < 250
