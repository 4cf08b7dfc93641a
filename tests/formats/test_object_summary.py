"""The objects that a bundle's graph and its history tell of."""

import json

import numpy as np
import pytest

from formats.bundle import BundleWriter, read_summary
from formats.records import FieldRecord
from formats.scene import SceneGraph, make_node

ORIGIN = (0.0, 0.0, 10.0)
"""Of the fused field's frame, in the world."""


def moved(x: float = 0.0, y: float = 0.0, z: float = 0.0, scale: float = 1.0) -> list:
    matrix = np.diag([scale, scale, scale, 1.0])
    matrix[:3, 3] = x, y, z
    return matrix.tolist()


def block(name: str, tensor: int, *place: float) -> dict:
    return {"name": name, "tensor": tensor, "object_to_field": moved(*place)}


def entry(name: str, *place: float) -> dict:
    x, y, z = (*place, 0.0, 0.0, 0.0)[:3]
    return {
        "name": name,
        "object_to_world": moved(*place),
        "aabb": [x - 1, y - 1, z - 1, x + 1, y + 1, z + 1],
    }


def blocks_of(*blocks: dict) -> FieldRecord:
    """A field with two tensors, placed by blocks; the boxes of the tensors are 2 x 2 x 2 and 1 x 1 x 4."""
    arrays = {
        "tensor_0.plane": np.ones((4, 4), np.float32),
        "tensor_0.line": np.ones((2, 4), np.float32),
        "tensor_1.plane": np.ones((4, 15), np.float32),
    }
    tensors = [{"aabb": [-1, -1, -1, 1, 1, 1]}, {"aabb": [0, 0, 0, 1, 1, 4]}]
    return FieldRecord("vm", arrays, {"aabb": [-9, -9, -9, 9, 9, 9], "blocks": blocks, "tensors": tensors})


def objects(path, record: FieldRecord, *history: dict, name: str = "fused") -> list[dict]:
    writer = BundleWriter()
    node = make_node(name, field=writer.add_field(record), translation=ORIGIN)
    writer.write(path / "a.rfpack", SceneGraph((node,), history=history))
    summary = read_summary(path / "a.rfpack")
    assert json.loads(json.dumps(summary["objects"])) == summary["objects"]
    return summary["objects"]


def test_nodes_are_objects_with_bytes_of_their_own(tmp_path):
    record = blocks_of(block("cup", 0, 1, 2, 3), block("pole", 1, 0, 0, 0, 2))
    cup, pole = objects(tmp_path, record, {"event": "fused", "nodes": [entry("cup"), entry("pole")]})
    sizes = {f["member"]: f["bytes"] for f in read_summary(tmp_path / "a.rfpack")["fields"]}
    assert (cup["name"], cup["kind"], cup["shared_by"]) == ("cup", "vm", 1)
    assert {cup["bytes"], pole["bytes"]} == set(sizes.values())
    assert cup["object_to_world"] == moved(1, 2, 13)  # in the world, not in the fused field's frame
    assert (cup["world_aabb"], cup["size"]) == ([0, 1, 12, 2, 3, 14], [2, 2, 2])
    assert (pole["world_aabb"], pole["size"]) == ([0, 0, 10, 2, 2, 18], [2, 2, 8])


def test_copies_share_their_bytes(tmp_path):
    record = blocks_of(block("cup", 0), block("cup 2", 0, 5), block("pole", 1))
    history = {"event": "fused", "nodes": [entry(name) for name in ("cup", "cup 2", "pole")]}
    found = objects(tmp_path, record, history)
    assert [(o["name"], o["shared_by"]) for o in found] == [("cup", 2), ("cup 2", 2), ("pole", 1)]
    assert found[0]["bytes"] == found[1]["bytes"]


def test_what_was_distilled_together_has_a_place_but_no_bytes(tmp_path):
    """The one block of a distilled field goes by the field's own name."""
    record = blocks_of(block("fused", 0))
    cup, pole = objects(tmp_path, record, {"event": "fused", "nodes": [entry("cup", 1, 2, 3), entry("pole")]})
    assert cup == {
        "name": "cup", "kind": "vm", "object_to_world": moved(1, 2, 3),
        "world_aabb": [0, 1, 2, 2, 3, 4], "size": [2, 2, 2], "bytes": None, "shared_by": None,
        "inside": "fused",
    }  # fmt: skip
    assert (pole["name"], pole["bytes"]) == ("pole", None)


def test_a_field_without_blocks_is_described_by_its_history(tmp_path):
    record = FieldRecord("bricks", {"a": np.ones(3, np.float32)})
    found = objects(tmp_path, record, {"event": "fused", "nodes": [entry("cup"), entry("pole")]})
    assert [(o["name"], o["kind"], o["bytes"]) for o in found] == [
        ("cup", "bricks", None),
        ("pole", "bricks", None),
    ]


def test_the_history_is_followed(tmp_path):
    """Fused, one taken out, one put in: the nodes and what the base holds."""
    history = (
        {"event": "fused", "nodes": [entry("cup"), entry("pole")]},
        {"event": "deleted", "names": ["cup"]},
        {"event": "added", "nodes": [entry("jug")]},
    )
    record = blocks_of(block("fused", 0), block("restored", 1), block("jug", 1))
    found = objects(tmp_path, record, *history)
    assert [(o["name"], o["bytes"] is None) for o in found] == [("jug", False), ("pole", True)]


def test_a_group_is_described_by_its_parts(tmp_path):
    """Once they are all deleted, the group is gone though no entry names it."""
    history = {"event": "fused", "nodes": [entry("shelf"), entry("pole")]}
    parts = block("shelf/cup", 0, 1), block("shelf/jug", 0, 2), block("pole", 1)
    found = objects(tmp_path, blocks_of(*parts), history)
    assert [o["name"] for o in found] == ["shelf/cup", "shelf/jug", "pole"]


def test_a_trained_field_is_one_object(tmp_path):
    (lamp,) = objects(tmp_path, blocks_of(block("", 0)), name="lamp")
    assert (lamp["name"], lamp["shared_by"], lamp["size"]) == ("lamp", 1, [2, 2, 2])
    assert lamp["bytes"] == read_summary(tmp_path / "a.rfpack")["fields"][0]["bytes"]


def test_what_was_trained_stays_an_object_when_others_are_added(tmp_path):
    record = blocks_of(block("lamp", 0), block("cup", 1))
    found = objects(tmp_path, record, {"event": "added", "nodes": [entry("cup")]}, name="lamp")
    assert [o["name"] for o in found] == ["lamp", "cup"] and all(o["bytes"] for o in found)


def test_every_field_of_a_bundle_is_an_object(tmp_path):
    writer = BundleWriter()
    nodes = [
        make_node(name, field=writer.add_field(FieldRecord("lamp", {"a": np.full(n, n, np.float32)})))
        for name, n in (("one", 1), ("two", 2))
    ]
    writer.write(tmp_path / "a.rfpack", SceneGraph(tuple(nodes)))
    assert [o["name"] for o in read_summary(tmp_path / "a.rfpack")["objects"]] == ["one", "two"]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(
    "history, blocks",
    [
        ({"event": ["fused"], "nodes": {"name": "cup"}, "names": "cup"}, [block("cup", 0)]),
        ({"nodes": [{"name": "cup"}, 7, None, {"name": 1}], "names": [3, {}]}, [block("cup", 0)] * 2),
        ({"nodes": [entry("cup")], "sources": 7, "objects": [3]}, "blocks"),
        ({"nodes": [entry("cup")]}, [None, {"name": "cup"}, block("cup", 10**6), block("cup", -1)]),
        ({"nodes": [entry("cup")]}, [block("/" * 1000, 0), block("x" * 5000, 0)]),
        ({"nodes": [entry("cup", 1e308, 1e308)]}, [block("cup", 1, 1e308, 1e308, 1e308, 1e308)]),
    ],
)
def test_other_contents_than_expected_break_nothing(tmp_path, history, blocks):
    """A history is free-form, and so is a field's metadata: what is no object is passed over."""
    writer = BundleWriter()
    arrays = {"tensor_0.a": np.ones(3, np.float32)}
    record = FieldRecord("vm", arrays, {"blocks": blocks, "tensors": [3, {}]})
    node = make_node("fused", field=writer.add_field(record))
    writer.write(tmp_path / "a.rfpack", SceneGraph((node,), history=(history,)))
    found = read_summary(tmp_path / "a.rfpack")["objects"]
    assert 1 <= len(found) <= 3 and all(isinstance(o["name"], str) for o in found)
