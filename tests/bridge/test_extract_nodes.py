"""`extract` from a bundle of nodes of several kinds, turned, stretched, cropped, tinted and in groups: each
node's field is cut by its own kind, and the others keep their bytes."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from formats.bundle import BundleWriter, read_bundle
from formats.images import write_png
from formats.records import FieldRecord
from formats.scene import Node, SceneGraph, make_node
from fusedrf_cli.bridge.rendering import renderable
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.fields.occupancy import placement
from fusedrf_cli.engine.kinds.dense.field import DenseField, DenseShape
from fusedrf_cli.engine.rendering.cameras import framing, framing_lens
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image
from tests.analytic.export import Y0, exported
from tests.analytic.fields import Box, Tint
from tests.analytic.rays import affine, turn
from tests.bridge.conftest import done

SIDE = 48
KINDS = {"floor": "dense", "red": "vm", "blue": "sparse", "green": "vm"}
HALF = {"floor": (1.4, 0.8, 0.2), "red": (0.3, 0.3, 0.3), "blue": (0.3, 0.3, 0.3), "green": (0.2, 0.2, 0.2)}
COLOUR = {"floor": (0.6, 0.6, 0.5), "red": (0.9, 0.1, 0.1), "blue": (0.1, 0.2, 0.9), "green": (0.1, 0.8, 0.2)}
AT = {
    "floor": affine(1.0, (0, 0, -0.7)),
    "red": affine(turn(30, (0, 0, 1)) @ np.diag([1.0, 1.0, 1.5]), (-0.6, 0, 0)),
    "blue": affine(turn(45, (0, 0, 1)), (0.7, 0, -0.1)),
    "green": affine(turn(20), (0.0, 0.55, -0.2)),
}
RED = ("--box", "-1.1,-0.5,-0.45,-0.1,0.5,0.6")
TOP = ("--box", "-1.1,-0.5,0.05,-0.1,0.5,0.6")
CORNER = ("--box", "-1.5,-1,-1,-0.05,1,0.1")  # some of the floor, of the red box the lower part


def solid(kind, half, colour):
    """A box of density 20 and one colour around its origin."""
    if kind != "dense":
        return exported(Box(20.0, half, tint=Tint.of(*colour)), kind, (17, 17, 17))
    box = np.concatenate([-np.array(half), half])
    field = DenseField.create(DenseShape(0), box, (17, 17, 17), torch.Generator())
    index = np.arange(17**3)
    logits = torch.logit(torch.tensor(colour, dtype=torch.float32)) / Y0
    field.fill_vertices(
        index, np.full(17**3, np.log(np.expm1(20.0 / field.scale))), logits.expand(17**3, 3).numpy()
    )
    return field


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """three.rfpack: a floor, and on it boxes of other kinds; rich.rfpack: a group that adds, in it a tinted
    and a cropped node, a copy of the red one, and a hidden node."""
    folder = tmp_path_factory.mktemp("kinds")
    fields = {name: solid(kind, HALF[name], COLOUR[name]) for name, kind in KINDS.items()}
    for name, rich in (("three", False), ("rich", True)):
        writer = BundleWriter()
        nodes = {
            n: make_node(n, field=writer.add_field(FieldRecord(f.kind, *f.state())), matrix=AT[n])
            for n, f in fields.items()
        }
        if rich:
            dimmed = {"crop": [-1, -1, -1, 0.1, 1, 1], "opacity": 0.5}
            inner = (
                replace(nodes["red"], showing={"tint": [1.0, 0.5, 0.5]}),
                make_node("green", field=nodes["green"].field, matrix=AT["green"], showing=dimmed),
            )
            words = {"translation": [0, 0.1, 0]}, False, inner, {}, {"tint": [1.0, 1.0, 0.5]}
            group = Node("pair", None, None, *words, composition="add")
            twin = make_node("twin", field=nodes["red"].field, matrix=affine(1.0, (0.6, 0.3, 0.6)))
            hidden = make_node(
                "hidden", field=nodes["green"].field, translation=(0, 0, 2), showing={"visible": False}
            )
            graph = SceneGraph((nodes["floor"], group, nodes["blue"], twin, hidden))
        else:
            graph = SceneGraph((nodes["floor"], nodes["red"], nodes["blue"]))
        writer.write(folder / f"{name}.rfpack", graph)
    frames = [
        {"file_path": f"{c.name}.png", "transform_matrix": c.camera_to_world.tolist()} for c in cameras()
    ]
    lens = cameras()[0]
    spec = {"w": SIDE, "h": SIDE, "fl_x": lens.fl_x, "fl_y": lens.fl_y, "frames": frames}
    (folder / "cameras.json").write_text(json.dumps(spec))
    return folder


@pytest.fixture
def folder(made, tmp_path):
    return shutil.copytree(made, tmp_path / "kinds")


def cameras():
    """Four around all of it, above and below."""
    lens, box = framing_lens(SIDE, SIDE), np.array([-1.4, -0.8, -0.9, 1.4, 0.8, 0.5])
    return [
        framing(box, lens, np.pi / 2 * i + 0.3, (0.5, -0.3)[i % 2]).camera(lens, name=f"v{i}")
        for i in range(4)
    ]


def shots(path):
    field, origin = renderable(load_scene(str(path)))
    return [render_image(field, camera, origin=origin) for camera in cameras()]


def pixels(path):
    return np.stack([shot.over((1, 1, 1)) for shot in shots(path)])


def densities(path, points, dirs):
    """σ at points of the world."""
    field, origin = renderable(load_scene(str(path)))
    at = placement(np.asarray(origin, np.float64))
    assert np.allclose(at[:3, :3], np.eye(3)) or len(read_bundle(path).scene.leaves()) == 1
    inverse = np.linalg.inv(at)
    d = dirs @ inverse[:3, :3].T
    length = np.linalg.norm(d, axis=1)
    x = points @ inverse[:3, :3].T + inverse[:3, 3]
    sigma = field.query(torch.from_numpy(x), torch.from_numpy(d / length[:, None]), False)[0]
    return sigma.numpy() * length


def members(path) -> dict[str, str]:
    """The fields of nodes, by their names: those of equal bytes have one name."""
    return {leaf.name: leaf.field for leaf in read_bundle(path).scene.leaves()}


@pytest.mark.parametrize("words", [RED, TOP, CORNER], ids=["a node", "a part of one", "parts of two"])
def test_together_they_show_what_it_showed(folder, report, words):
    """At every point that is a voxel away from the cut, as the denser of the two; nodes that are not cut keep
    their bytes."""
    said = report("extract", "three.rfpack", *words, "-o", "object.rfpack")
    report("extract", "three.rfpack", *words, "--invert", "-o", "rest.rfpack")
    rng = np.random.default_rng(0)
    points = rng.uniform([-1.4, -0.8, -0.9], [1.4, 0.8, 0.6], (4000, 3))
    dirs = rng.normal(size=points.shape)
    dirs /= np.linalg.norm(dirs, axis=1)[:, None]
    before, found, rest = (
        densities(folder / f"{name}.rfpack", points, dirs) for name in ("three", "object", "rest")
    )
    box = np.array([float(x) for x in words[1].split(",")])
    outside = np.maximum(box[:3] - points, points - box[3:]).max(1)
    away = np.abs(outside) > 0.06
    np.testing.assert_allclose(np.maximum(found, rest)[away], before[away], rtol=2e-3, atol=2e-3)
    assert (np.maximum(found, rest) < before - 0.01).mean() < 0.002
    was, left = members(folder / "three.rfpack"), members(folder / "rest.rfpack")
    cut = {"red"} if words != CORNER else {"red", "floor"}
    assert {name: left[name] for name in left if name not in cut} == {n: was[n] for n in was if n not in cut}
    inside = outside < -0.1
    assert rest[inside].max() < 0.01 and found[inside & (before > 1)].min() > 1
    assert said["nodes"] == (2 if words == CORNER else 1)


def test_a_node_that_lies_in_the_shape_is_taken_as_it_is(folder, report):
    report("extract", "three.rfpack", *RED, "-o", "object.rfpack")
    report("extract", "three.rfpack", *RED, "--invert", "-o", "rest.rfpack")
    was, scene = members(folder / "three.rfpack"), read_bundle(folder / "object.rfpack").scene
    (leaf,) = scene.leaves()
    assert (leaf.name, leaf.field) == ("object", was["red"])
    np.testing.assert_array_equal(leaf.object_to_world, AT["red"])
    left = members(folder / "rest.rfpack")
    assert left == {name: was[name] for name in ("floor", "blue")}
    report("add", "rest.rfpack", "object.rfpack", "--name", "red", "-o", "again.rfpack")
    assert members(folder / "again.rfpack") == was
    assert psnr(pixels(folder / "again.rfpack"), pixels(folder / "three.rfpack")) > 60


def test_parts_of_two_nodes_are_one_object(folder, report):
    report("extract", "three.rfpack", *CORNER, "-o", "object.rfpack")
    scene = read_bundle(folder / "object.rfpack").scene
    assert [node.name for node in scene.nodes] == ["object"]
    assert set(members(folder / "object.rfpack")) == {"object/floor", "object/red"}
    kinds = [record.kind for record in read_bundle(folder / "object.rfpack").fields.values()]
    assert sorted(kinds) == ["dense", "vm"]


@pytest.mark.parametrize("name", ["red", "blue"])
def test_masks_of_an_object_that_touches_the_floor(folder, report, name):
    """Of what the object stands on, nothing comes along."""
    done(folder, "extract", "three.rfpack", "--name", name, "-o", "alone.rfpack")
    (folder / "masks").mkdir()
    truth, whole = shots(folder / "alone.rfpack"), shots(folder / "three.rfpack")
    for camera, one, all_of_it in zip(cameras(), truth, whole, strict=True):
        seen = (one.opacity > 0.5) & (one.depth < all_of_it.depth + 0.1)
        mask = np.where(seen[..., None], 255, 0).astype(np.uint8).repeat(3, 2)
        write_png(folder / "masks" / f"{camera.name}.png", mask)
    words = ("--masks", "masks", "--cameras", "cameras.json", "-o", "object.rfpack", "--preview", "look")
    said = report("extract", "three.rfpack", *words)
    assert said["sure"] > 0.8 and said["nodes"] == 1 and said["kind"] == KINDS[name]
    for one, other in zip(shots(folder / "object.rfpack"), truth, strict=True):
        found, true = one.opacity > 0.5, other.opacity > 0.5
        assert (found & true).sum() / (found | true).sum() > 0.85
    assert {path.name.split("_")[1] for path in (folder / "look").iterdir()} == {
        "marked.png", "object.png", "rest.png"
    }  # fmt: skip


def test_a_group_by_its_name_is_that_subtree(folder, report):
    """With its rule, its crops and tints; what is left is the bundle without it."""
    report("extract", "rich.rfpack", "--name", "pair", "-o", "pair.rfpack")
    report("extract", "rich.rfpack", "--name", "pair", "--invert", "-o", "rest.rfpack")
    report("delete", "rich.rfpack", "pair", "-o", "less.rfpack")
    was, found = (read_bundle(folder / f"{name}.rfpack").scene for name in ("rich", "pair"))
    assert found.nodes == tuple(node for node in was.nodes if node.name == "pair")
    less, rest = (read_bundle(folder / f"{name}.rfpack") for name in ("less", "rest"))
    assert less.scene.nodes == rest.scene.nodes and less.fields.keys() == rest.fields.keys()
    report("add", "rest.rfpack", "pair.rfpack", "--name", "pair", "-o", "again.rfpack")
    assert psnr(pixels(folder / "again.rfpack"), pixels(folder / "rich.rfpack")) > 60


def test_what_is_hidden_has_to_be_shown_first(run):
    result = run("extract", "rich.rfpack", "--name", "hidden", "-o", "hidden.rfpack")
    assert result.exit_code == 3 and "'hidden' is hidden" in result.stderr


def test_a_node_of_a_group_is_shown_as_it_was(folder, report):
    """Its tint is that of all the nodes around it."""
    report("extract", "rich.rfpack", "--name", "red", "-o", "red.rfpack")
    (was,) = [leaf for leaf in read_bundle(folder / "rich.rfpack").scene.leaves() if leaf.name == "red"]
    (node,) = read_bundle(folder / "red.rfpack").scene.nodes
    (leaf,) = read_bundle(folder / "red.rfpack").scene.leaves()
    assert (node.name, node.field, leaf.tint) == ("red", was.field, (1.0, 0.5, 0.25)) and not node.children
    np.testing.assert_array_equal(leaf.object_to_world, was.object_to_world)


def test_one_of_two_copies_is_cut_and_the_hidden_stay(folder, report):
    """Parts of a tinted and of a cropped node of a group that adds; their copies stay as they are."""
    words = ("--box", "-1.2,-0.5,-0.4,0.3,1.1,0.1")
    report("extract", "rich.rfpack", *words, "-o", "object.rfpack")
    report("extract", "rich.rfpack", *words, "--invert", "-o", "rest.rfpack")
    was, left = members(folder / "rich.rfpack"), members(folder / "rest.rfpack")
    assert left["red"] != was["red"]
    assert {name: left[name] for name in ("floor", "blue", "twin", "hidden")} == {
        name: was[name] for name in ("floor", "blue", "twin", "hidden")
    }
    leaves = {leaf.name: leaf for leaf in read_bundle(folder / "object.rfpack").scene.leaves()}
    assert set(leaves) == {"object/red", "object/green"}
    assert leaves["object/red"].tint == (1.0, 0.5, 0.25) and leaves["object/green"].opacity == 0.5
    assert len(leaves["object/green"].crops) == 1 and leaves["object/red"].groups[0][1] == "add"
    report("compose", "object.rfpack", "rest.rfpack", "-o", "both.json")
    assert psnr(pixels(folder / "both.json"), pixels(folder / "rich.rfpack")) > 35


def test_nodes_of_two_kinds_take_no_more_bytes_than_allowed(folder, report):
    words = ("extract", "three.rfpack", *CORNER, "-o", "object.rfpack", "-w")
    whole = report(*words)["bytes"]
    said = report(*words, "--max-size", str(2 * whole // 3))
    assert said["bytes"] == (folder / "object.rfpack").stat().st_size <= 2 * whole // 3
    assert said["kind"] == "dense, vm" and said["psnr"]["stored"] > 20
    assert set(members(folder / "object.rfpack")) == {"object/floor", "object/red"}
