"""`info` of what the commands write: the objects in it, their places and their bytes."""

import numpy as np
import pytest

from tests.bridge.conftest import PLACES

SMALL = ("--seed", "0", "--no-finetune")


def place(part: dict) -> list[float]:
    return [row[3] for row in part["object_to_world"][:3]]


def test_nodes_are_listed_with_their_bytes_through_edits(report, folder):
    report("fuse", "pair.json", "-o", "f.rfpack", "--kind", "blocks", *SMALL)
    report("add", "f.rfpack", "red.rfpack", "--name", "twin", "-t", "0.5,0.5,0", "-o", "g.rfpack")
    report("delete", "g.rfpack", "red", "-o", "h.rfpack", *SMALL)
    said = report("info", "g.rfpack")
    assert {o["name"]: place(o) for o in said["objects"]} == {
        "floor": pytest.approx(PLACES["floor"]),
        "red": pytest.approx(PLACES["red"]),
        "twin": pytest.approx([0.5, 0.5, 0]),
    }
    sharing = {o["name"]: o.pop("shared_by") for o in said["objects"]}
    assert sharing == {"floor": 1, "red": 2, "twin": 2}
    stored = sum(field["bytes"] for field in said["fields"])  # equal objects are stored once
    assert stored == sum(o["bytes"] / sharing[o["name"]] for o in said["objects"])
    left = report("info", "h.rfpack")["objects"]
    assert [o.pop("shared_by") for o in left] == [1, 1]
    assert left == [o for o in said["objects"] if o["name"] != "red"]


@pytest.mark.slow
def test_the_objects_of_a_distilled_field_have_places_alone(report, folder):
    report("fuse", "pair.json", "-o", "f.rfpack", "--kind", "sparse", *SMALL)
    said = report("info", "f.rfpack")["objects"]
    assert [(o["name"], o["kind"], o["bytes"]) for o in said] == [
        ("floor", "sparse", None),
        ("red", "sparse", None),
    ]
    np.testing.assert_allclose([place(o) for o in said], [PLACES["floor"], PLACES["red"]])
    np.testing.assert_allclose(said[1]["size"], 0.6, atol=0.2)  # a box of 0.6 a side, in whole cells
