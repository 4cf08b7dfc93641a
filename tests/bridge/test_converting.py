"""How large a converted field gets."""

import json
from zipfile import ZipFile

import pytest


@pytest.mark.parametrize(
    "words, kind, most", [((), "dense", 50), ((), "vm", 25), (("--max-size", "3MB"), "dense", 3)]
)
def test_vertices_may_take_what_those_of_a_trained_field_do(report, folder, words, kind, most):
    report("convert", "red.rfpack", "--kind", kind, "--time-budget", "0.5", "-o", "out.rfpack", *words)
    with ZipFile(folder / "out.rfpack") as bundle:
        (entry,) = json.loads(bundle.read("scene.json"))["history"]
    assert entry["settings"]["max_size"] == most * 1_000_000


@pytest.mark.parametrize(
    "words, ranks", [((), [32, 48]), (("--max-size", "1MB"), None), (("--ranks", "8,16"), [8, 16])]
)
def test_one_of_components_has_twice_those_of_a_trained_field(report, folder, words, ranks):
    """But where a size is asked for, or others are."""
    report("convert", "red.rfpack", "--kind", "vm", "--time-budget", "0.5", "-o", "out.rfpack", *words)
    with ZipFile(folder / "out.rfpack") as bundle:
        (entry,) = json.loads(bundle.read("scene.json"))["history"]
    assert entry["settings"]["ranks"] == ranks
