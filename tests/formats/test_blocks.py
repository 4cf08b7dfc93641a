"""Fields of several objects, as earlier versions wrote them, are read as nodes: every array byte for byte."""

from dataclasses import replace

import numpy as np
import pytest

from formats.bundle import BundleWriter, OpenBundle, read_bundle
from formats.errors import FormatError
from formats.records import FieldRecord, as_stored
from formats.scene import SceneGraph, make_node

AT = np.array([[0, -2, 0, 1], [2, 0, 0, 2], [0, 0, 2, 3], [0, 0, 0, 1.0]])
"""Of the field in the world: turned and scaled."""


def tensor(number: int, rng) -> dict[str, np.ndarray]:
    """Arrays of a tensor; of two, those in bricks and in runs as files have them."""
    arrays = {
        "plane": rng.normal(size=(20, 30, 8)).astype(np.float32),
        "line": rng.normal(size=(9, 8)).astype(np.float32),
        "occupancy": rng.integers(0, 256, 8, np.uint8),
    }
    if number == 1:
        lengths = np.array([70_000, 12], np.int32)
        arrays |= {"detail": rng.normal(size=(70_012, 4)).astype(np.float32), "detail.runs": lengths}
        arrays |= {"detail_held": rng.integers(1, 256, (2, 2), np.uint8)}
    return {f"tensor_{number}.{name}": array for name, array in arrays.items()}


def record_of(blocks: list[dict], count: int = 2, seed: int = 0) -> FieldRecord:
    rng = np.random.default_rng(seed)
    arrays = {name: array for n in range(count) for name, array in tensor(n, rng).items()}
    boxes = [{"aabb": [-1, -1, -1 - n, 1, 1, 1 + n], "n": n} for n in range(count)]
    if count > 1:
        boxes[1]["hashed"] = {"spacings": [0.1], "rows": 64}
    metadata = {"aabb": [-5] * 3 + [5] * 3, "shape": {"rank": 8}, "tensors": boxes, "blocks": blocks}
    needs = {"needs": ["hashed", "held", "runs"]} if count > 1 else {}
    return FieldRecord("vm", arrays, metadata | needs)


def block(name: str, tensor: int = 0, at: np.ndarray | None = None, **more) -> dict:
    return {
        "name": name,
        "tensor": tensor,
        "object_to_field": (np.eye(4) if at is None else at).tolist(),
        **more,
    }


def written(path, record: FieldRecord, *history: dict, precision: str = "float16", **words) -> OpenBundle:
    writer = BundleWriter()
    member = writer.add_field(record, precision)
    node = make_node("fused", field=member, **({"matrix": AT} if not words else words))
    writer.write(path / "a.rfpack", SceneGraph((node,), history=history), overwrite=True)
    assert list(read_bundle(path / "a.rfpack").fields) == [member]
    return OpenBundle(path / "a.rfpack")


def entry(name: str, **more) -> dict:
    return {
        "name": name,
        "object_to_world": np.eye(4).tolist(),
        "aabb": [0] * 3 + [1] * 3,
        "field": "f",
    } | more


@pytest.mark.parametrize("precision", ["float32", "float16", "int8", "int4"])
def test_every_block_is_a_node_and_every_tensor_a_field_with_its_own_bytes(tmp_path, precision):
    shift = np.eye(4)
    shift[:3, 3] = 1, 2, 3
    record = record_of([block("cup", 1), block("pole", 0, shift), block("cup 2", 1, shift, tint=[1, 0.5, 0])])
    bundle = written(tmp_path, record, precision=precision)
    nodes = {node.name: node for node in bundle.scene.nodes}
    assert list(nodes) == ["cup", "pole", "cup 2"] and len(bundle.headers) == 2
    assert nodes["cup"].field == nodes["cup 2"].field != nodes["pole"].field
    np.testing.assert_array_equal(nodes["pole"].node_to_parent, AT @ shift)
    np.testing.assert_array_equal(nodes["cup"].node_to_parent, AT)
    assert nodes["cup 2"].showing == {"tint": [1, 0.5, 0]} and not nodes["cup"].showing
    for name, number in (("cup", 1), ("pole", 0)):
        found = bundle.field(nodes[name].field)
        own = {n: array for n, array in record.arrays.items() if n.startswith(f"tensor_{number}.")}
        assert {n.replace("_0.", f"_{number}.") for n in found.arrays} == set(own)
        for n, array in own.items():
            back = found.arrays[n.replace(f"_{number}.", "_0.")]
            runs = own.get(f"{n}.runs")
            wanted = as_stored(array, precision, n, runs) if array.dtype.kind == "f" else array
            np.testing.assert_array_equal(back, wanted)
        assert found.metadata["tensors"] == [record.metadata["tensors"][number]]
        assert found.metadata["aabb"] == record.metadata["tensors"][number]["aabb"]
        assert found.metadata["shape"] == record.metadata["shape"] and len(found.metadata["blocks"]) == 1
        assert found.metadata.get("needs") == (["hashed", "held", "runs"] if number else None)
    assert [one.name for one in bundle.placed(next(iter(read_bundle(bundle.path).fields)))] == list(nodes)


def test_a_field_of_one_object_is_read_as_it_is(tmp_path):
    record = record_of([block("whatever")], 1)
    bundle = written(tmp_path, record)
    assert bundle.headers.keys() == read_bundle(bundle.path).fields.keys()
    assert [node.name for node in bundle.scene.nodes] == ["fused"]
    bundle = written(tmp_path, record, {"event": "fused", "nodes": [entry("whatever")]})
    assert [node.name for node in bundle.scene.nodes] == ["whatever"]
    bundle = written(tmp_path, record_of([block("whatever", at=AT)], 1))
    np.testing.assert_array_equal(bundle.scene.nodes[0].node_to_parent, AT @ AT)


def test_what_holds_for_the_field_holds_for_its_objects(tmp_path):
    record = record_of([block("cup", 1), block("pole")])
    writer = BundleWriter()
    showing = {"crop": [0, 0, 0, 1], "opacity": 0.5}
    node = make_node("cup", field=writer.add_field(record), matrix=AT, showing=showing, background=True)
    writer.write(tmp_path / "a.rfpack", SceneGraph((node,)))
    scene = OpenBundle(tmp_path / "a.rfpack").scene
    (group,) = scene.nodes
    assert (group.name, group.field, group.showing) == ("cup", None, showing)
    assert [(one.name, one.background) for one in scene.leaves()] == [("cup-2", True), ("pole", True)]
    assert all(one.opacity == 0.5 and len(one.crops) == 1 for one in scene.leaves())


def test_what_stands_for_no_object_goes_by_its_own_name(tmp_path):
    """And leaves theirs to objects, whatever these are called."""
    names = ["fused", "restored", "fused/fused", "", "pole"]
    record = record_of([block(name, n % 2) for n, name in enumerate(names)])
    history = {"event": "fused", "nodes": [entry(name) for name in ("fused", "pole", "inside")]}
    scene = written(tmp_path, record, history).scene
    assert [node.name for node in scene.nodes] == ["fused-2", "restored", "fused", "fused-3", "pole"]
    (told,) = scene.history
    assert told["objects"] == ["fused", "pole"] and [node["name"] for node in told["nodes"]] == ["inside"]


def test_history_keeps_what_fields_were_made_of_and_no_placement(tmp_path):
    record = record_of([block("cup", 1), block("shelf/a"), block("shelf/b")])
    source = {"source": "x.rfpack", "sha256": "0" * 64}
    nodes = [
        entry("cup", kept=True, **source),
        entry("shelf", background=True, **source),
        entry("in", **source),
    ]
    bundle = written(tmp_path, record, {"event": "fused", "kind": "blocks", "nodes": nodes})
    cup, shelf = (bundle.scene.nodes[i].field for i in (0, 1))
    (told,) = bundle.scene.history
    assert told["objects"] == ["cup", "shelf"] and told["nodes"] == [nodes[2]] and told["kind"] == "blocks"
    assert told["sources"] == {cup: {"field": "f"}, shelf: {"field": "f", "instance": "a", **source}}


@pytest.mark.parametrize(
    "change",
    [
        {"blocks": "x"},
        {"blocks": [{"name": "a"}] * 2},
        {"blocks": [block("a"), block("b", 9)]},
        {"blocks": [block("a"), block("b", -1)]},
        {"blocks": [block("a"), block("b", tint=[1, 2, 0])]},
        {"tensors": [{}]},
        {"tensors": [3, 4]},
        {"tensors": None},
    ],
)
def test_what_is_not_well_formed_stays_as_it_is(tmp_path, change):
    record = record_of([block("a"), block("b")])
    bundle = written(tmp_path, replace(record, metadata=record.metadata | change))
    assert bundle.headers.keys() == read_bundle(bundle.path).fields.keys()


def test_nodes_that_are_no_scene_are_refused(tmp_path):
    flat = np.diag([1, 1, 1e-9, 1.0])
    record = record_of([block("a"), block("b", at=flat)])
    with pytest.raises(FormatError, match=r"a\.rfpack: node 'b'.*scales by"):
        written(tmp_path, record)
    names = [block("\x1b" * 3), block("x" * 999), block("a/" * 40)]
    scene = written(tmp_path, record_of(names)).scene
    assert [node.name for node in scene.nodes] == ["fused", "fused-2", "a/" * 40]


def test_a_writer_writes_nodes(tmp_path):
    record = record_of([block("cup", 1), block("pole")])
    writer = BundleWriter()
    scene = SceneGraph((make_node("fused", field=writer.add_field(record, "int8"), matrix=AT),))
    writer.write(tmp_path / "new.rfpack", writer.unfolded(scene))
    old, new = written(tmp_path, record, precision="int8"), OpenBundle(tmp_path / "new.rfpack")
    assert new.headers.keys() == read_bundle(tmp_path / "new.rfpack").fields.keys() == old.headers.keys()
    assert new.scene.nodes == old.scene.nodes and not new.instances


def test_what_is_copied_to_be_read_is_told(tmp_path):
    """Fields that are unfolded lie in memory, beside the file that is mapped."""
    bundle = written(tmp_path, record_of([block("cup", 0), block("pole", 1)]))
    assert bundle.copied == sum(header.size for header in bundle.headers.values()) > 0
    bundle = written(tmp_path, record_of([block("fused", 0)], count=1))
    assert bundle.copied == 0
