"""Files to placed fields: names, sharing, background, and inputs that are wrong."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from formats.records import FieldRecord
from formats.scene import SceneGraph, make_node, write_scene
from fusedrf_cli.bridge.cutting import cut_to_crops
from fusedrf_cli.bridge.scene import background_of, grouped, load_scene
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.errors import InvalidInput
from tests.bridge.conftest import FIELDS, PLACES
from tests.bundles import write_single


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
    write_single(folder / "cloud.rfpack", record, "cloud")
    with pytest.raises(InvalidInput, match="unknown kind 'nebula'; this version knows .*vm"):
        load_scene(str(folder / "cloud.rfpack"))
    result = run("render", "cloud.rfpack", "-o", "out.png")
    assert result.exit_code == 3 and "nebula" in result.stderr and not (folder / "out.png").exists()


def test_a_malformed_field_is_named(folder):
    arrays, metadata = FIELDS["red"].state()
    arrays.pop("tensor_0.density_line_1")
    write_single(folder / "bad.rfpack", FieldRecord("vm", arrays, metadata), "red")
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
    loaded.field_cache.resize(0)
    for name in ("floor", "red", "blue"):
        damaged = bytearray((folder / f"{name}.rfpack").read_bytes())
        damaged[-2000:-1000] = bytes(1000)
        (folder / "other").write_bytes(damaged)
        (folder / "other").replace(folder / f"{name}.rfpack")
    for placed, params in zip(loaded.placed, before, strict=True):
        assert opened(placed.field).params.equal(params)


def test_nodes_that_show_a_field_differently_share_it(folder):
    """Crops, tints and opacities are the nodes'. Only where a field is cut to its crop, to be stored anew,
    are there as many as there are crops."""
    red = make_node("n", source="red.rfpack")

    def showing(i: int) -> dict:
        return {"opacity": 0.1 * i, "tint": [0.1 * i, 1, 1], "crop": [0, 0, 0, 0.05 * (i // 2)]}

    nodes = [replace(red, name=f"n{i}", showing=showing(i)) for i in range(4, 10)]
    write_scene(folder / "shared.json", SceneGraph(tuple(nodes)))
    assert len(load_scene(str(folder / "scene.json")).sizes) == 3
    shared = load_scene(str(folder / "shared.json"))
    assert len(shared.sizes) == 1 and len({p.tint for p in shared.placed}) == 6
    cut = cut_to_crops(shared)
    assert len(cut.sizes) == 3 and not any(p.crops for p in cut.placed)
    whole, parts = opened(shared.placed[0].field), [opened(p.field) for p in cut.placed]
    corner = torch.tensor([[0.2, 0.2, 0.2]]).double(), torch.tensor([[0.0, 0.0, 1.0]]).double()
    assert whole.query(*corner)[0] > 1 and all(part.query(*corner)[0] == 0 for part in parts)
    assert parts[0] is parts[1]


class Fog:
    """One density everywhere in the unit cube, and one colour."""

    kind, voxel_size = "fog", 0.1
    occupancy = OccupancyGrid.full(np.array([0, 0, 0, 1.0, 1, 1]))
    aabb = occupancy.aabb

    def __init__(self, sigma: float, rgb: tuple):
        self.sigma, self.rgb = sigma, rgb

    def query(self, points, dirs, with_colour=True):
        inside = ((points >= 0) & (points <= 1)).all(1)
        return self.sigma * inside.float(), torch.tensor([self.rgb]).repeat(len(points), 1)


def test_groups_of_nodes_have_a_rule_of_their_own():
    """In the middle of three cubes, two of which add up before the densest of that and the third is taken."""
    at = np.eye(4)
    at[:3, 3] = 5, 0, 0
    fogs = {"a": Fog(1.0, (1.0, 0, 0)), "b": Fog(3.0, (0, 1.0, 0)), "c": Fog(3.5, (0, 0, 1.0))}
    placed = [Placed(name, fog, at) for name, fog in fogs.items()]
    point, storage = (
        torch.tensor([[5.5, 0.5, 0.5]], dtype=torch.float64),
        torch.tensor([[0, 0, 1.0]]).double(),
    )
    pair = [(("g", "add"),)] * 2
    cases = {
        "max": ([()] * 3, "max", 3.5, (0, 0, 1)),
        "max of a sum": ([*pair, ()], "max", 4.0, (0.25, 0.75, 0)),
        "sum of a max": ([(("g", "max"),)] * 2 + [()], "add", 6.5, (0, 3 / 6.5, 3.5 / 6.5)),
        "a sum in a sum": ([*pair, ()], "add", 7.5, (1 / 7.5, 3 / 7.5, 3.5 / 7.5)),
        "a sum in a max in a sum": (
            [(("h", "max"), ("h/g", "add"))] * 2 + [(("h", "max"),)], "add", 4.0, (0.25, 0.75, 0)
        ),
    }  # fmt: skip
    for name, (groups, rule, sigma, rgb) in cases.items():
        field = ComposedField(grouped(placed, groups, rule), rule)
        found, colour = field.query(point - torch.from_numpy(field.origin), storage)
        assert float(found[0]) == pytest.approx(sigma), name
        np.testing.assert_allclose(colour[0].numpy(), rgb, atol=1e-6, err_msg=name)
