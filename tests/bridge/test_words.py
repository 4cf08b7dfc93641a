"""Every command calls its verb of the bridge with exactly the words that the verb takes."""

import inspect

import pytest
from click.testing import CliRunner

from fusedrf_cli import bridge
from fusedrf_cli.main import cli

CALLS = {
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
    signature = inspect.signature(getattr(bridge, verb))
    calls = []

    def note(*words, **options):
        signature.bind(*words, **options)  # a TypeError where they do not fit
        calls.append(options)
        return {}

    monkeypatch.setattr(bridge, verb, note)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "in").write_text("")
    result = CliRunner().invoke(cli, CALLS[verb])
    assert result.exit_code == 0, result.output
    keywords = {p.name for p in signature.parameters.values() if p.kind is p.KEYWORD_ONLY}
    assert set(calls[0]) == keywords
