"""Text of hostile files on a terminal: it is shown, and moves nothing."""

import json
import random

import pytest
from click.testing import CliRunner

from formats import errors as format_errors
from formats.scene import SceneGraph, dump_scene, make_node, read_scene, write_scene
from fusedrf_cli import report
from fusedrf_cli.main import cli
from tests.promises.mutations import sealed
from tests.promises.packs import GOLDEN

ESCAPES = {
    "clears the screen": "\x1b[2J",
    "sets the title": "\x1b]0;owned\x07",
    "one-byte escape": "\x9b31m",
    "carriage return": "\rError: none",
    "line": "\nvalid: yes",
    "delete": "\x7f",
    "backwards": "\u202egnp.exe",
    "isolate": "\u2066x",
    "line separator": "\u2028x",
    "null": "\0",
}
HARMLESS = (
    "é",
    "e\u0301",
    "日本語",
    "שלום",
    "👩\u200d🚀 chair",
    "a" * 255,
    "-rf",
    "$(id)",
    "; ls",
    "%s",
    "[red]",
)


def said(*words: str) -> tuple[int, str, str]:
    result = CliRunner().invoke(cli, words)
    return result.exit_code, result.stdout, result.stderr


def moves_nothing(text: str) -> bool:
    return text.replace("\n", "").isprintable()


def with_text(tmp_path, text: str) -> str:
    """The golden pair with `text` wherever a pack may hold free text."""

    def change(scene, field, _):
        content = json.loads(scene)
        content |= {"generator": text, "author": text, "history": [{"event": text, text: text}]}
        return json.dumps(content).encode(), field

    path = tmp_path / "a.rfpack"
    path.write_bytes(sealed((GOLDEN / "pair.rfpack").read_bytes(), change, random.Random(0)))
    return str(path)


@pytest.mark.parametrize("text", ESCAPES.values(), ids=ESCAPES)
def test_free_text_of_a_pack_is_escaped(tmp_path, text):
    """P15."""
    path = with_text(tmp_path, "a" + text)
    code, out, err = said("info", path)
    assert code == 0 and moves_nothing(out) and moves_nothing(err) and len(out.splitlines()) < 30
    code, out, err = said("info", path, "--json")
    assert code == 0 and moves_nothing(out) and out.count("\n") == 1
    assert json.loads(out)["generator"] == "a" + text


@pytest.mark.parametrize("text", ESCAPES.values(), ids=ESCAPES)
def test_names_that_move_the_cursor_are_refused_in_a_sentence_that_does_not(tmp_path, text):
    """P15."""
    content = {"format": "rfpack", "version": "1.0", "nodes": [{"name": "a" + text}]}
    (tmp_path / "s.json").write_text(json.dumps(content))
    for verb in ("info", "validate"):
        code, out, err = said(verb, str(tmp_path / "s.json"))
        assert code == 3 and moves_nothing(err) and err.count("\n") == 1 and moves_nothing(out)


def test_without_the_escapes_they_reach_the_terminal(tmp_path, monkeypatch):
    """P15 with its defences removed: of what people read, of JSON, and of errors."""
    path = with_text(tmp_path, "a\x9b31m")
    with monkeypatch.context() as patch:
        patch.setattr(report, "printable", lambda text: text)
        assert not moves_nothing(said("info", path)[1])
    with monkeypatch.context() as patch:
        patch.setattr(report, "_escaped", lambda text: text)
        assert not moves_nothing(said("info", path, "--json")[1])
    monkeypatch.setattr(format_errors, "printable", lambda text, limit=0: text)
    assert not moves_nothing(str(format_errors.BadName("a\x1b[2J")))


@pytest.mark.parametrize("name", HARMLESS)
def test_names_that_only_look_odd_are_kept(tmp_path, name):
    """P15: as they are, byte for byte; nothing makes a path or a command of them."""
    write_scene(tmp_path / "s.json", SceneGraph((make_node(name),)))
    assert read_scene(tmp_path / "s.json").nodes[0].name == name
    assert json.loads(said("info", str(tmp_path / "s.json"), "--json")[1])["nodes"][0]["name"] == name


@pytest.mark.parametrize("name", ["", "a" * 256, "日" * 86, "a" * 10**6, "\ud800"])
def test_names_that_are_too_long_or_no_text_are_refused(name):
    """P15."""
    with pytest.raises(format_errors.BadName) as caught:
        make_node(name)
    assert len(str(caught.value)) < 200 and str(caught.value).isprintable()


def test_two_spellings_of_one_name_are_one_name():
    """P15: NFC and NFD look alike, and would be two files on one system and one on another."""
    with pytest.raises(format_errors.DuplicateName):
        dump_scene(SceneGraph((make_node("\u00e9"), make_node("e\u0301"))))


def test_a_bar_of_progress_takes_no_markup_and_no_escapes():
    """P15: the live line is drawn by rich, which has a language of its own."""
    import io

    from rich.console import Console

    from fusedrf_cli import progress

    shown = io.StringIO()
    with pytest.MonkeyPatch.context() as patch:
        real = progress._bar

        def bar():
            made = real()
            made.live.console = Console(file=shown, width=200, force_terminal=True, color_system=None)
            return made

        patch.setattr(progress, "_bar", bar)
        with progress.Progress(live=True) as watcher:
            watcher.phase("deleting [bold]x[/bold]\x1b]0;owned\x07", 1.0)
            watcher.advance(1.0)
    assert "[bold]x[/bold]" in shown.getvalue() and "\x1b]0;" not in shown.getvalue()
