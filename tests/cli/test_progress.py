import os
import pty

import pytest

from fusedrf_cli.progress import NullProgress, Progress

LIVE = """
from fusedrf_cli.progress import Progress
with Progress() as progress:
    progress.phase("learn", 100)
    progress.advance(50, psnr=31.25)
    progress.warn("too [bold]few\\x1b photos")
    progress._bar.refresh()
"""


def test_without_a_terminal_there_is_one_final_line(capsys):
    with Progress(live=False) as progress:
        progress.phase("load")
        progress.phase("learn", 100)
        progress.advance(50, psnr=31.2)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("done in ") and err.endswith(" s)\n") and err.count("\n") == 1
    assert "load 0.0 s, learn 0.0 s" in err


def test_a_phase_that_comes_twice_is_told_once(capsys):
    with Progress(live=False) as progress:
        for name in ("load", "learn", "load"):
            progress.phase(name)
    assert capsys.readouterr().err.count("load") == 1


@pytest.mark.parametrize("options", [{"quiet": True}, {"quiet": True, "live": True}])
def test_quiet_shows_warnings_alone(capsys, options):
    with Progress(**options) as progress:
        progress.phase("load")
        progress.note("a detail")
        progress.tell("a wait")
        progress.warn("too few\nphotos")
    assert capsys.readouterr().err == "Warning: too few\\nphotos\n"
    assert progress.warnings == ["too few\nphotos"]


def test_nothing_is_told_of_a_command_without_phases(capsys):
    Progress(live=False).close()
    assert capsys.readouterr().err == ""


def test_a_failure_is_not_called_done(capsys):
    with pytest.raises(ValueError), Progress(live=False) as progress:
        progress.phase("load")
        raise ValueError
    assert capsys.readouterr().err == ""


@pytest.mark.parametrize("verbose, shown", [(True, "a detail\n"), (False, "")])
def test_notes_are_for_those_who_ask(capsys, verbose, shown):
    Progress(live=False, verbose=verbose).note("a detail")
    assert capsys.readouterr().err == shown


def test_a_wait_is_explained(capsys):
    Progress(live=False).tell("compiling")
    assert capsys.readouterr().err == "compiling\n"


def test_null_progress_shows_nothing_and_keeps_warnings(capsys):
    with NullProgress() as progress:
        progress.phase("load", 3)
        progress.advance(1, psnr=30.0)
        progress.note("a")
        progress.warn("b")
    assert capsys.readouterr() == ("", "")
    assert progress.warnings == ["b"]


def test_on_a_terminal_there_is_a_bar_with_figures(process, monkeypatch):
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.setenv("COLUMNS", "120")
    terminal, end = pty.openpty()
    running = process(LIVE, stderr=end)
    os.close(end)
    assert running.wait(20) == 0
    shown = os.read(terminal, 1 << 16).decode()
    os.close(terminal)
    assert "learn" in shown and "50%" in shown and "psnr 31.25" in shown and "done in " in shown
    assert "too [bold]few\\x1b photos" in shown
