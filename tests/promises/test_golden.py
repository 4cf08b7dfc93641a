"""P1: kept bundles of everything that was ever written answer, show and are edited as they were
(tests/promises/golden.py)."""

import json

import numpy as np
import pytest
from click.testing import CliRunner

from formats.bundle import sha256_of
from formats.undo import history_folder
from fusedrf_cli.main import cli
from tests.promises.golden import CASES, KEPT, answers, decibels, drawn, edited, picture, told_for_sure

CLOSE = {"rtol": 2e-4, "atol": 2e-5}  # float32 numbers that are added up in another order
COMPILED_ELSEWHERE = ("cp", "dense-mlp", "vm-mlp")  # in the slow tests: loops of these take long to compile
QUICK_EDITS = ("delete", "move", "undo")
EDITS = [
    pytest.param(name, edit, marks=() if edit in QUICK_EDITS else pytest.mark.slow)
    for name, case in CASES.items()
    for edit in case.edits
]
ANSWERING = [
    pytest.param(name, marks=pytest.mark.slow if name.startswith(COMPILED_ELSEWHERE) else ())
    for name in CASES
]


def kept(name: str) -> dict[str, np.ndarray]:
    """What was answered when the bundle was written."""
    with np.load(KEPT / f"{name}.npz") as found:
        return dict(found)


def check(path, found: dict, prefix: str = "", sure: np.ndarray | slice = slice(None)) -> None:
    """A bundle's answers against those that were kept, at those points that are for `sure`."""
    sigma, rgb = answers(path, found["points"][sure], found["dirs"][sure])
    wanted, colours = found[f"{prefix}sigma"][sure], found[f"{prefix}rgb"][sure]
    there = wanted > 0
    np.testing.assert_allclose(sigma, wanted, rtol=CLOSE["rtol"], atol=CLOSE["atol"] * wanted.max())
    np.testing.assert_allclose(rgb[there], colours[there], **CLOSE)
    assert there.sum() > 10 or prefix


def test_every_kept_bundle_has_its_case_and_is_small():
    files = [path for path in KEPT.rglob("*") if path.is_file()]
    assert {path.stem for path in KEPT.glob("*.rfpack") if path.is_file()} == CASES.keys()
    assert sum(path.stat().st_size for path in files) < 3_500_000


@pytest.mark.parametrize("name", CASES)
def test_it_is_valid(name):
    result = CliRunner().invoke(cli, ["validate", str(KEPT / f"{name}.rfpack")])
    assert result.exit_code == 0, result.stderr


@pytest.mark.parametrize("name", ANSWERING)
def test_it_answers_as_it_did(name, tmp_path):
    """But close to the faces of crops, which were rounded inwards, to cells, and are exact now."""
    path, found = KEPT / f"{name}.rfpack", kept(name)
    sigma, _ = answers(path, found["points"], found["dirs"])
    check(path, found, sure=told_for_sure(CASES[name], found["points"], found["dirs"], sigma, tmp_path))


@pytest.mark.parametrize(("name", "edit"), EDITS)
def test_an_edit_of_it_gives_what_it_gave(name, edit, tmp_path):
    path, words, out = KEPT / f"{name}.rfpack", CASES[name].edits[edit], tmp_path / "out.rfpack"
    edited(path, words, out)
    check(out, kept(name), f"{edit} ")
    if words[0] == "undo":
        assert (history_folder(path) / f"{sha256_of(out)}.rfpack").read_bytes() == out.read_bytes()


def test_the_kept_history_tells_what_was_done():
    result = CliRunner().invoke(cli, ["history", str(KEPT / "blocks-edited.rfpack"), "--json"])
    said = json.loads(result.stdout)
    events = ["fused", "added", "moved", "duplicated", "renamed", "replaced", "deleted"]
    assert [entry["event"] for entry in said["history"]] == events and said["undoable"] == 6


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_it_shows_what_it_showed(name):
    """By its answers along rays; and it is drawn no worse than it was."""
    path, case, found = KEPT / f"{name}.rfpack", CASES[name], kept(name)
    told = picture(path, case)
    assert decibels(told, found["picture"]) >= case.bar
    shown = told if case.cropped else found["picture"]
    assert decibels(drawn(path, case), shown) >= min(found["drawn"] - 1, 45)
