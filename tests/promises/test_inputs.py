"""Whatever files an input of `train` is made of, a command ends with a sentence of its own."""

import subprocess
import sys
from pathlib import Path

import pytest

from formats.foreign.systems import SYSTEMS
from tests.promises import fuzz_inputs

ROOT = Path(__file__).parents[2]


@pytest.mark.parametrize("make", fuzz_inputs.INPUTS, ids=lambda make: make.__name__)
def test_the_sound_inputs_are_read(make, tmp_path):
    """Else the fuzzer would only see refusals."""
    assert fuzz_inputs.reading(make(tmp_path / "sound")) == ("read", None)


def test_damaged_captures_and_meshes_are_read_or_refused(tmp_path):
    """P18; `make fuzz` takes 10,000."""
    result = fuzz_inputs.readers(200, 0, tmp_path)
    assert result["wrong"] == []
    assert {key.rpartition(" ")[2] for key in result["counts"]} == {"read", "refused"}


def test_damaged_checkpoints_of_other_systems_are_read_or_refused(tmp_path):
    """P18; `make fuzz` takes 2,000 of each. Two systems have files of two formats."""
    result = fuzz_inputs.foreign(10, 0, tmp_path)
    assert result["wrong"] == [] and result["inputs"] == 10 * (len(SYSTEMS) + 2)
    assert {key.rpartition(" ")[2] for key in result["counts"]} == {"read", "refused"}


def test_a_reader_that_breaks_down_is_seen(tmp_path, monkeypatch):
    monkeypatch.setattr(fuzz_inputs, "load_photos", lambda views: 1 / 0)
    assert any("ZeroDivisionError" in one["problem"] for one in fuzz_inputs.readers(30, 0, tmp_path)["wrong"])


@pytest.mark.slow
def test_commands_over_damaged_inputs_end_with_a_sentence():
    """P14, P18, and SIGTERM: by whole commands, in a process of their own, since it forks."""
    words = ("--readers", "0", "--foreign", "0", "--splats", "0", "--commands", "60", "--seed", "1")
    done = subprocess.run([sys.executable, "-m", "tests.promises.fuzz_inputs", *words], cwd=ROOT)
    assert done.returncode == 0
