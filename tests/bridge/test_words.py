"""Every command calls its verb of the bridge with a request that has every word."""

import dataclasses
import inspect

import pytest
from click.testing import CliRunner

from fusedrf_cli import bridge
from fusedrf_cli.main import cli

CALLS = {
    "pose": ("pose", "in", "-o", "out"),
    "train": ("train", "in", "-o", "out"),
    "fuse": ("fuse", "in", "-o", "out"),
    "add": ("add", "in", "in", "-o", "out", "--name", "n"),
    "delete": ("delete", "in", "n", "-o", "out"),
    "render": ("render", "in", "-o", "out"),
    "chart": ("chart", "in", "-o", "out"),
    "evaluate": ("eval", "in", "--against", "in"),
}


@pytest.mark.parametrize("verb", CALLS)
def test_a_command_says_every_word_of_its_verb(verb, tmp_path, monkeypatch):
    """Requests have no defaults, so that a word that is not said is a TypeError."""
    asked = inspect.signature(getattr(bridge, verb)).parameters["request"].annotation
    assert all(f.default is dataclasses.MISSING for f in dataclasses.fields(asked))
    calls = []
    monkeypatch.setattr(bridge, verb, lambda request, progress: calls.append(request) or {})
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").write_text("")
    result = CliRunner().invoke(cli, CALLS[verb])
    assert result.exit_code == 0, result.output
    assert type(calls[0]) is asked
