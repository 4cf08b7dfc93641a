"""Files to placed fields: names, sharing, background, and inputs that are wrong."""

from dataclasses import replace

import numpy as np
import pytest

from formats.bundle import single_field_bundle
from formats.records import FieldRecord
from formats.scene import SceneGraph, make_node, write_scene
from fusedrf_cli.bridge.scene import background_of, load_scene
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.errors import InvalidInput
from tests.bridge.conftest import FIELDS, PLACES


def test_a_scene_is_its_fields_at_their_places(folder):
    loaded = load_scene(str(folder / "scene.json"))
    assert [p.name for p in loaded.placed] == ["floor", "red", "blue"] and loaded.composition == "max"
    for placed in loaded.placed:
        assert np.array_equal(placed.object_to_world[:3, 3], PLACES[placed.name])
        assert (opened(placed.field).params - FIELDS[placed.name].params).abs().max() < 5e-3  # float16
    assert background_of(loaded).placed.name == "floor"


def test_equal_sources_become_one_field(folder):
    (folder / "twin.rfpack").write_bytes((folder / "red.rfpack").read_bytes())
    nodes = [
        make_node(n, source=s) for n, s in (("a", "red.rfpack"), ("b", "red.rfpack"), ("c", "twin.rfpack"))
    ]
    write_scene(folder / "twins.json", SceneGraph(tuple(nodes)))
    a, b, c = load_scene(str(folder / "twins.json")).placed
    assert a.field is b.field is c.field


def test_the_background_is_the_marked_or_the_largest(folder):
    def background(marked):
        nodes = [make_node(n, source=f"{n}.rfpack", background=n == marked) for n in ("red", "floor")]
        write_scene(folder / "marked.json", SceneGraph(tuple(nodes)), overwrite=True)
        return background_of(load_scene(str(folder / "marked.json"))).placed.name

    assert background("red") == "red" and background(None) == "floor"


def test_groups_place_their_children(folder):
    child = make_node("red", source="red.rfpack", translation=(1, 0, 0))
    write_scene(folder / "group.json", SceneGraph((make_node("group", scale=(2, 2, 2), children=(child,)),)))
    (placed,) = load_scene(str(folder / "group.json")).placed
    np.testing.assert_allclose(
        placed.object_to_world, [[2, 0, 0, 2], [0, 2, 0, 0], [0, 0, 2, 0], [0, 0, 0, 1]]
    )


def test_an_unknown_kind_is_named(folder, run):
    record = FieldRecord("nebula", {"planes": np.zeros(3, np.float32)}, {"aabb": [0, 0, 0, 1, 1, 1]})
    single_field_bundle(record, "cloud").write(folder / "cloud.rfpack")
    with pytest.raises(InvalidInput, match="unknown kind 'nebula'; this version knows .*vm"):
        load_scene(str(folder / "cloud.rfpack"))
    result = run("render", "cloud.rfpack", "-o", "out.png")
    assert result.exit_code == 3 and "nebula" in result.stderr and not (folder / "out.png").exists()


def test_a_malformed_field_is_named(folder):
    arrays, metadata = FIELDS["red"].state()
    arrays.pop("tensor_0.density_line_1")
    single_field_bundle(FieldRecord("vm", arrays, metadata), "red").write(folder / "bad.rfpack")
    with pytest.raises(InvalidInput, match="'vm' field is malformed .*density_line_1"):
        load_scene(str(folder / "bad.rfpack"))


@pytest.mark.parametrize(
    "source, more, says",
    [
        ("gone.rfpack", (), "gone.rfpack"),
        ("../out.rfpack", (), "--allow-outside"),
        ("eye.txt", (), "no bundle"),
    ],
)
def test_a_wrong_source_is_exit_3(folder, run, source, more, says):
    (folder.parent / "out.rfpack").write_bytes((folder / "red.rfpack").read_bytes())
    (folder / "eye.txt").write_text("hello")
    write_scene(folder / "odd.json", SceneGraph((make_node("red", source=source),)))
    result = run("fuse", "odd.json", "-o", "fused.rfpack", *more)
    assert result.exit_code == 3 and says in result.stderr and not (folder / "fused.rfpack").exists()


def test_a_source_outside_is_read_where_allowed(folder, run):
    (folder.parent / "out.rfpack").write_bytes((folder / "red.rfpack").read_bytes())
    write_scene(folder / "odd.json", SceneGraph((make_node("red", source="../out.rfpack"),)))
    assert run("fuse", "odd.json", "-o", "fused.rfpack", "--allow-outside").exit_code == 0


def test_a_source_that_is_replaced_meanwhile_is_read_as_it_was(folder, tmp_path):
    """P7: as many fields as there is room for are in memory; the others are read from the version that was
    opened, good or damaged as what has taken its name may be."""
    loaded = load_scene(str(folder / "scene.json"))
    before = [opened(placed.field).params.clone() for placed in loaded.placed]
    loaded.shelf.resize(0)
    for name in ("floor", "red", "blue"):
        damaged = bytearray((folder / f"{name}.rfpack").read_bytes())
        damaged[-2000:-1000] = bytes(1000)
        (folder / "other").write_bytes(damaged)
        (folder / "other").replace(folder / f"{name}.rfpack")
    for placed, params in zip(loaded.placed, before, strict=True):
        assert opened(placed.field).params.equal(params)


def test_nodes_that_show_a_field_differently_each_count(folder):
    """A field that is thinned has numbers of its own: so many take so many times the memory."""
    red = make_node("n", source="red.rfpack")
    nodes = [replace(red, name=f"n{i}", showing={"opacity": 0.1 * i}) for i in range(1, 9)]
    write_scene(folder / "thinned.json", SceneGraph(tuple(nodes)))
    sizes = load_scene(str(folder / "thinned.json")).sizes
    assert len(sizes) == 8 and len(load_scene(str(folder / "scene.json")).sizes) == 3
