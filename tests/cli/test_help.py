import importlib
import re
import shlex
from pathlib import Path

import click
import pytest

from formats.bundle import read_bundle
from formats.errors import MissingFile
from formats.undo import keep
from fusedrf_cli.main import COMMANDS, cli
from tests.bundles import write_single

WITH_INPUT = [name for name in COMMANDS if name not in ("completion", "kinds")]


def command(name: str) -> click.Command:
    return cli.get_command(click.Context(cli), name)


def examples(text: str) -> list[str]:
    """The lines under `Example:` of a help text."""
    return re.findall(r"^ +fusedrf (.+)$", text.split("Example:")[1].split("Options:")[0], re.MULTILINE)


def test_every_module_of_commands_is_a_command_and_named_so():
    from importlib.resources import files

    modules = {
        path.name[:-3] for path in files("fusedrf_cli.commands").iterdir() if path.name.endswith(".py")
    }
    assert modules - {"__init__"} == set(COMMANDS)
    assert all(command(name).name == name for name in COMMANDS)


def test_the_group_lists_exit_codes_and_commands_in_the_order_of_work(run):
    result = run("--help")
    assert result.exit_code == 0
    assert re.findall(r"^    (\d[\d, ]*)  ", result.stdout, re.MULTILINE) == [*"01234567", "130, 143", "141"]
    assert re.findall(r"^  (\w+) {2,}\S", result.stdout.split("Commands:")[1], re.MULTILINE) == list(COMMANDS)
    assert "..." not in result.stdout.split("Commands:")[1]


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_an_example_that_runs(run, bridge, folder, name):
    result = run(name, "--help")
    assert result.exit_code == 0 and result.stderr == ""
    for file in ("scene.json", "fused.rfpack", "lego.th", "lamp.rfpack", "photos", "masks", "table.glb"):
        (folder / file).write_bytes((folder / "chair.rfpack").read_bytes())
    assert run("compose", "chair.rfpack", "-w", "-o", "scene.json").exit_code == 0
    if name == "undo":
        write_single(
            folder / "fused.rfpack",
            read_bundle(folder / "chair.rfpack").fields.popitem()[1],
            "chair",
            history=[{"event": "moved", "before": keep(folder / "chair.rfpack", folder / "fused.rfpack")}],
            overwrite=True,
        )
    for example in examples(result.stdout):
        words = [word.rstrip("/") for word in shlex.split(example)]
        assert words[0] == name
        if "-o" in words and name != "render":
            words.append("--overwrite")
        outcome = run(*words)
        assert (outcome.exit_code, outcome.stderr) == (0, "")


@pytest.mark.parametrize("name", COMMANDS)
def test_every_option_is_explained(name):
    for parameter in command(name).params:
        assert isinstance(parameter, click.Argument) or parameter.help


@pytest.mark.parametrize("name", WITH_INPUT)
def test_a_missing_input_is_one_line_and_code_3(run, bridge, name):
    others = {
        "add": ["chair.rfpack", "--name", "a"],
        "delete": ["a"],
        "move": ["a", "-t", "1,0,0"],
        "duplicate": ["a", "b"],
        "rename": ["a", "b"],
        "replace": ["a", "chair.rfpack"],
        "eval": ["--against", "chair.rfpack"],
        "convert": ["--kind", "cp"],
    }
    output = [] if name in ("eval", "history", "info", "validate") else ["-o", "out"]
    result = run(name, "nowhere.rfpack", *others.get(name, []), *output)
    assert result.exit_code == MissingFile.exit_code
    assert result.stderr.startswith("Error: nowhere.rfpack: ") and result.stderr.count("\n") == 1
    assert bridge.call is None


def test_the_page_of_commands_is_what_help_says():
    page = (Path(__file__).parents[2] / "docs/commands.md").read_text(encoding="utf-8")
    assert page == importlib.import_module("docs.commands").page(), "run `make docs`"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_what_the_shell_needs(run, shell):
    result = run("completion", shell)
    assert result.exit_code == 0 and f"_FUSEDRF_COMPLETE={shell}_complete" in result.stdout


def test_completion_answers_the_shell(process, monkeypatch):
    monkeypatch.setenv("_FUSEDRF_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", "fusedrf fuse --from")
    monkeypatch.setenv("COMP_CWORD", "2")
    stdout, _ = process("from fusedrf_cli.main import main; main()").communicate(timeout=120)
    assert stdout == "plain,--from-scratch\n"
