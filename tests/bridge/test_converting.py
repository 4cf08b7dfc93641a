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
    "words, components", [((), 32), (("--max-size", "1MB"), 16), (("--ranks", "8,16"), 8)]
)
def test_one_of_components_has_twice_those_of_a_trained_field(report, folder, words, components):
    """But where a size is asked for, or others are. Of density: those of one colour are not stored."""
    report("convert", "red.rfpack", "--kind", "vm", "--time-budget", "0.5", "-o", "out.rfpack", *words)
    (field,) = report("info", "out.rfpack")["fields"]
    assert field["arrays"]["tensor_0.density_line_0"]["shape"][1] == components
