"""`compose --crop`, `--opacity`, `--tint` and `--hidden`: what of a node is shown."""

import json
import shutil

import numpy as np
import pytest
import torch

from formats.scene import read_scene
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.scene import open_scene
from tests.bridge.conftest import done

PLACE = ("-t", "0.2,-0.1,0.3", "-s", "2", "-r", "0,0,30")
CROP = [-0.3, -0.3, -0.3, 0.05, 0.3, 0.3]
BALL = [0.0, 0.0, 0.0, 0.25]


@pytest.fixture(scope="module")
def kinds(shop, tmp_path_factory):
    """The red box as several kinds."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("kinds") / "shop")
    for kind, size in (("sparse", "300kB"), ("dense", "1MB")):
        done(
            folder,
            "fuse",
            "red.rfpack",
            "-o",
            f"{kind}.rfpack",
            "--kind",
            kind,
            "--no-finetune",
            "--max-size",
            size,
        )
    shutil.copy(folder / "red.rfpack", folder / "vm.rfpack")
    return folder


@pytest.fixture
def folder(tmp_path, kinds):
    return shutil.copytree(kinds, tmp_path / "shop")


def sigma(folder, scene: str, points: np.ndarray) -> np.ndarray:
    """Of world points (N, 3), as it is asked naively."""
    composed = load_scene(str(folder / scene)).composed()
    at = torch.from_numpy(points - composed.origin)
    return composed.query(at, torch.tensor([[0.0, 0.0, 1.0]]).double().expand(len(at), 3))[0].numpy()


def colour(folder, scene: str, points: np.ndarray) -> np.ndarray:
    """(N, 3), as `sigma`."""
    composed = load_scene(str(folder / scene)).composed()
    at = torch.from_numpy(points - composed.origin)
    return composed.query(at, torch.tensor([[0.0, 0.0, 1.0]]).double().expand(len(at), 3))[1].numpy()


def alike(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether pictures are the same but for some pixels of an outline."""
    return (np.abs(one - other).max(2) < 0.02).mean() > 0.99


def written(flag: str, numbers: list[float]) -> tuple[str, str]:
    return flag, ",".join(map(str, numbers))


def points_of(scene) -> tuple[np.ndarray, np.ndarray]:
    """Points of the object's frame, and where its placement takes them."""
    own = np.random.default_rng(3).uniform(-0.35, 0.35, (4000, 3))
    matrix = scene.leaves()[0].object_to_world
    return own, own @ matrix[:3, :3].T + matrix[:3, 3]


@pytest.mark.parametrize("kind", ["vm", "sparse", "dense"])
@pytest.mark.parametrize("shape", [CROP, BALL], ids=["box", "sphere"])
def test_a_crop_lies_in_the_objects_own_frame_and_changes_nothing_inside(report, folder, kind, shape):
    report("compose", f"{kind}.rfpack", *PLACE, "-o", "whole.json")
    report("compose", f"{kind}.rfpack", *PLACE, *written("--crop", shape), "-o", "part.json")
    own, world = points_of(read_scene(folder / "part.json"))
    whole, part = (sigma(folder, name, world) for name in ("whole.json", "part.json"))
    if len(shape) == 4:
        depth = shape[3] - np.linalg.norm(own - shape[:3], axis=1)
    else:
        depth = np.minimum(own - shape[:3], np.array(shape[3:]) - own).min(1)
    assert part[depth < 0].max() == 0 and whole[depth < 0].max() > 1
    inside = depth > 0
    np.testing.assert_allclose(part[inside], whole[inside], rtol=1e-5, atol=1e-5)
    assert inside.sum() > 50 and whole[inside].max() > 1


def test_crops_and_opacities_of_groups_hold_for_what_is_in_them(report, folder):
    report("compose", "red.rfpack", *written("--crop", CROP), "--opacity", "0.5", "-o", "inner.json")
    report("compose", "inner.json", *PLACE, *written("--crop", BALL), "--opacity", "0.5", "-o", "outer.json")
    report("compose", "red.rfpack", *PLACE, "-o", "whole.json")
    own, world = points_of(read_scene(folder / "outer.json"))
    whole, part = (sigma(folder, name, world) for name in ("whole.json", "outer.json"))
    out = (np.linalg.norm(own, axis=1) > BALL[3]) | (own[:, 0] > CROP[3])
    assert part[out].max() == 0
    np.testing.assert_allclose(part[~out], 0.25 * whole[~out], rtol=1e-4)
    assert open_scene(folder / "outer.json").save(folder / "saved.rfpack", precision="float32")
    np.testing.assert_allclose(sigma(folder, "saved.rfpack", world), part, rtol=1e-3, atol=1e-4)


@pytest.mark.parametrize("kind", ["vm", "sparse", "dense"])
def test_a_tint_multiplies_what_is_seen(report, folder, kind):
    report("compose", f"{kind}.rfpack", *PLACE, "-o", "plain.json")
    report("compose", f"{kind}.rfpack", "--tint", "0.5,1,0", "-o", "inner.json")
    report("compose", "inner.json", *PLACE, "--tint", "0.5,0.5,1", "-o", "tinted.json")
    _, world = points_of(read_scene(folder / "plain.json"))
    plain, tinted = (colour(folder, name, world) for name in ("plain.json", "tinted.json"))
    assert plain.max() > 0.5
    np.testing.assert_allclose(tinted, plain * (0.25, 0.5, 0), rtol=1e-5, atol=1e-6)


def test_a_fused_scene_keeps_tints_through_edits(report, folder, picture):
    words = ("red.rfpack", "--name", "dark", "-t", "0.8,0,0", "--tint", "0.3,0.3,0.3")
    report("compose", "red.rfpack", *words, "-o", "s.json")
    for kind in ("blocks", "vm"):
        report("fuse", "s.json", "-o", f"{kind}.rfpack", "--kind", kind, "--no-finetune", "-w")
        said = report("eval", f"{kind}.rfpack", "--against", "s.json", "--size", "96x96")
        assert said["mean"]["psnr"] > (90 if kind == "blocks" else 20)
    report("move", "blocks.rfpack", "dark", "-t", "0,0.4,0", "-o", "moved.rfpack")
    report("compose", "red.rfpack", *words[:4], "0.8,0.4,0", *words[5:], "-o", "there.json")
    assert alike(picture("moved.rfpack"), picture("there.json"))
    report("delete", "blocks.rfpack", "red", "-o", "left.rfpack")
    report("compose", *words, "-o", "alone.json")
    assert alike(picture("left.rfpack"), picture("alone.json"))


def test_a_hidden_node_is_left_out_and_stays_in_the_scene(report, run, folder):
    report("compose", "red.rfpack", "blue.rfpack", "-t", "1,0,0", "--hidden", "-o", "one.json")
    assert [f.placed.name for f in load_scene(str(folder / "one.json")).fields] == ["red"]
    assert [leaf.name for leaf in read_scene(folder / "one.json").leaves()] == ["red", "blue"]
    assert json.loads((folder / "one.json").read_text())["version"] == "1.2"
    said = report("fuse", "one.json", "-o", "one.rfpack", "--kind", "blocks")
    assert said["nodes"] == 1
    assert said["warnings"] == ["what is hidden was left out: 'blue'; show it to have it fused"]
    report("compose", "red.rfpack", "--hidden", "-o", "none.json")
    result = run("render", "none.json", "-o", "none.png")
    assert result.exit_code == 3 and "nothing of the scene is visible" in result.stderr


def test_a_fused_scene_holds_what_is_shown_and_an_edit_knows_no_more(report, folder):
    report(
        "compose", "floor.rfpack", "-t", "0,0,-0.7", "red.rfpack", *written("--crop", CROP), "-o", "s.json"
    )
    report("fuse", "s.json", "-o", "f.rfpack", "--kind", "vm", "--no-finetune", "--max-size", "600kB")
    beyond = np.array([[0.15, y, 0.0] for y in np.linspace(-0.2, 0.2, 9)])
    inside = beyond - [0.3, 0, 0]
    assert sigma(folder, "f.rfpack", beyond).max() < 1 < sigma(folder, "f.rfpack", inside).min()
    report("delete", "f.rfpack", "floor", "-o", "g.rfpack", "--no-finetune")
    assert sigma(folder, "g.rfpack", beyond).max() < 1


def test_numbers_that_are_stored_anew_are_those_of_what_a_crop_leaves(report, folder):
    """A scene that is kept as it is keeps its crops as well."""
    report("compose", "red.rfpack", *written("--crop", CROP), "blue.rfpack", "-t", "1,0,0", "-o", "s.json")
    report("fuse", "s.json", "-o", "kept.rfpack", "--kind", "blocks")
    report("fuse", "s.json", "-o", "anew.rfpack", "--kind", "blocks", "--precision", "int8", "--no-finetune")
    kept, anew = (load_scene(str(folder / name)) for name in ("kept.rfpack", "anew.rfpack"))
    assert [len(p.crops.items) for p in kept.placed] == [1, 0] and not any(p.crops for p in anew.placed)
    whole = load_scene(str(folder / "red.rfpack"))
    assert kept.fields[0].member == whole.fields[0].member
    beyond = np.array([[0.15, y, 0.0] for y in np.linspace(-0.2, 0.2, 9)])
    inside = beyond - [0.3, 0, 0]
    for name in ("kept.rfpack", "anew.rfpack"):
        assert sigma(folder, name, beyond).max() == 0 and sigma(folder, name, inside).min() > 1


BAD = {
    "crop": ([1, 2, 3], "crop"),
    "crop of five": ([1, 2, 3, 4, 5], "is neither a box"),
    "crop upside down": ([1, 0, 0, 0, 1, 1], "is neither a box"),
    "ball without radius": ([0, 0, 0, 0], "is neither a box"),
    "opacity": (2.0, "opacity"),
    "visible": ("no", "visible"),
    "tint": ([1, 0.5, -0.1], "tint"),
    "tint of two": ([1, 0.5], "tint"),
}


@pytest.mark.parametrize("what", BAD)
def test_what_no_node_shows_is_refused(run, report, folder, what):
    report("compose", "red.rfpack", "-o", "scene.json", "-w")
    scene = json.loads((folder / "scene.json").read_text())
    value, sentence = BAD[what]
    scene |= {"version": "1.2"}
    key = next((key for key in ("opacity", "visible", "tint") if what.startswith(key)), "crop")
    scene["nodes"][0][key] = value
    (folder / "scene.json").write_text(json.dumps(scene))
    result = run("render", "scene.json", "-o", "x.png")
    assert result.exit_code == 3 and sentence in result.stderr and result.stderr.count("\n") == 1


def test_a_crop_that_holds_nothing_says_so(run, report, folder):
    report("compose", "red.rfpack", "--crop", "5,5,5,6,6,6", "-o", "scene.json", "-w")
    result = run("render", "scene.json", "-o", "x.png")
    assert result.exit_code == 3 and "its crop holds nothing of it" in result.stderr
