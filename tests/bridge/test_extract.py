"""`extract` for real: an object out of a field, and what is left without it."""

import itertools
import json
import shutil

import numpy as np
import pytest
import trimesh

from formats.bundle import read_bundle
from formats.camera_set import read_camera_set
from formats.captures import read_capture
from formats.images import write_png
from formats.photos import load_photos
from formats.scene import SceneGraph, make_node, write_scene
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.rendering.cameras import framing, framing_lens
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.progress import NullProgress
from tests.bridge.conftest import FIELDS, PLACES, done, part, write_views

AROUND = "-0.9,-0.4,-0.4,-0.1,0.4,0.4"
SIDE = 64
GIVEN = ("v0", "v2", "v4")


def cameras():
    """Six around both objects, above them and below."""
    lens, box = framing_lens(SIDE, SIDE), np.array([-1.4, -0.8, -0.9, 1.4, 0.8, 0.3])
    return [
        framing(box, lens, np.pi / 3 * i + 0.2, (0.5, -0.3)[i % 2]).camera(lens, name=f"v{i}")
        for i in range(6)
    ]


def shots(path, views):
    scene = load_scene(str(path))
    field, origin = scene.lone() or ((composed := scene.composed()), composed.origin)
    return [render_image(field, camera, origin=origin) for camera in views]


@pytest.fixture(scope="module")
def fused(shop, tmp_path_factory):
    """The shop with the floor and the red box fused as several kinds, masks of the red one, and cameras."""
    folder = shutil.copytree(shop, tmp_path_factory.mktemp("fused") / "shop")
    done(folder, "fuse", "pair.json", "-o", "blocks.rfpack")
    for kind, size in (("vm", "600kB"), ("sparse", "600kB"), ("dense", "3MB")):
        done(
            folder,
            "fuse",
            "pair.json",
            "-o",
            f"{kind}.rfpack",
            "--kind",
            kind,
            "--no-finetune",
            "--max-size",
            size,
        )
    frames = [
        {"file_path": f"{c.name}.png", "transform_matrix": c.camera_to_world.tolist()} for c in cameras()
    ]
    lens = cameras()[0]
    spec = {"w": SIDE, "h": SIDE, "fl_x": lens.fl_x, "fl_y": lens.fl_y, "frames": frames}
    (folder / "cameras.json").write_text(json.dumps(spec))
    nodes = (make_node("red", source="red.rfpack", translation=PLACES["red"]),)
    write_scene(folder / "red.json", SceneGraph(nodes))
    (folder / "masks").mkdir()
    alone = shots(folder / "red.json", cameras())
    whole = shots(folder / "pair.json", cameras())
    for camera, one, all_of_it in zip(cameras(), alone, whole, strict=True):
        if camera.name in GIVEN:
            seen = (one.opacity > 0.5) & (one.depth < all_of_it.depth + 0.1)
            write_png(
                folder / "masks" / f"{camera.name}.png",
                np.where(seen[..., None], 255, 0).astype(np.uint8).repeat(3, 2),
            )
    return folder


@pytest.fixture
def folder(tmp_path, fused):
    return shutil.copytree(fused, tmp_path / "shop")


WAYS = {
    "box": ("--box", AROUND),
    "sphere and box": ("--sphere", "-0.5,0,0,0.6", "--box", "-2,-2,-0.4,2,2,2"),
    "masks": ("--masks", "masks", "--cameras", "cameras.json"),
}


def iou(folder, bundle: str) -> float:
    """Of silhouettes in views that no mask was given of, against the red box alone; the worst."""
    views = [camera for camera in cameras() if camera.name not in GIVEN]
    found, true = (
        [shot.opacity > 0.5 for shot in shots(folder / name, views)] for name in (bundle, "red.json")
    )
    return min((f & t).sum() / (f | t).sum() for f, t in zip(found, true, strict=True))


QUICK = {("blocks", "masks"), ("vm", "box"), ("sparse", "masks"), ("dense", "box")}
EACH_WAY = [
    pytest.param(kind, way, marks=[] if (kind, way) in QUICK else pytest.mark.slow)
    for kind, way in itertools.product(("blocks", "vm", "sparse", "dense"), WAYS)
]


@pytest.mark.parametrize("kind, way", EACH_WAY)
def test_the_object_is_it_and_with_the_rest_it_is_the_field(report, folder, kind, way):
    said = report("extract", f"{kind}.rfpack", *WAYS[way], "-o", "object.rfpack")
    report("extract", f"{kind}.rfpack", *WAYS[way], "--invert", "-o", "rest.rfpack")
    assert iou(folder, "object.rfpack") > (0.9 if kind == "blocks" else 0.8)  # learnt, and coarse
    assert said["sure"] > 0.8 and said["kind"] == ("vm" if kind == "blocks" else kind)
    np.testing.assert_allclose(said["box"], [-0.8, -0.3, -0.3, -0.2, 0.3, 0.3], atol=0.13)
    report("compose", "object.rfpack", "rest.rfpack", "-o", "both.json")
    both, before, rest = (
        np.stack([shot.over((1, 1, 1)) for shot in shots(folder / name, cameras())])
        for name in ("both.json", f"{kind}.rfpack", "rest.rfpack")
    )
    assert psnr(both, before) > 40  # faces of one texel: where samples of a ray begin moves their edges
    red = (rest[..., 0] > 0.6) & (rest[..., 1] < 0.4)
    assert red.mean() < 0.002


def test_points_and_a_hull(report, folder):
    views = {camera.name: camera for camera in cameras()}
    at = {name: pixel(views[name], PLACES["red"]) for name in views}
    floor = pixel(views["v0"], (0.9, 0, -0.5))
    words = [f"--points=v0:{at['v0']}", f"--points=v2:{at['v2']}", f"--points=v0:{floor},out"]
    report("extract", "blocks.rfpack", *words, "--cameras", "cameras.json", "-o", "object.rfpack")
    assert iou(folder, "object.rfpack") > 0.85
    hull = trimesh.creation.box((0.7, 0.7, 0.7))
    hull.apply_translation(PLACES["red"])
    hull.export(folder / "hull.obj")
    report("extract", "blocks.rfpack", "--mesh", "hull.obj", "-o", "object.rfpack", "-w")
    assert iou(folder, "object.rfpack") > 0.9


def pixel(camera, point) -> str:
    x, y, z = (np.array(point) - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    return f"{camera.cx - camera.fl_x * x / z:.1f},{camera.cy + camera.fl_y * y / z:.1f}"


def test_a_part_by_its_name_keeps_its_bytes_and_previews_are_written(report, folder):
    report("extract", "blocks.rfpack", "--name", "red", "-o", "object.rfpack", "--preview", "look")
    assert iou(folder, "object.rfpack") > 0.97
    assert sorted(path.name for path in (folder / "look").iterdir()) == [
        "view_marked.png",
        "view_object.png",
        "view_rest.png",
    ]


def test_the_object_keeps_its_cameras_and_stands_free(report, folder):
    report("train", "photos", "-o", "trained.rfpack", "--holdout", "4")
    report("extract", "trained.rfpack", "--box", "-1,-1,-1,0.02,1,1", "-o", "half.rfpack")
    scene = read_bundle(folder / "half.rfpack").scene
    assert scene.cameras is not None and not read_camera_set(scene.cameras).surroundings
    assert scene.framing[3] < 0.1


@pytest.mark.parametrize(
    "kind", ["blocks", "vm", *(pytest.param(kind, marks=pytest.mark.slow) for kind in ("sparse", "dense"))]
)
def test_no_more_bytes_than_allowed(report, run, folder, kind):
    words = ("extract", f"{kind}.rfpack", "--box", AROUND, "-o", "object.rfpack", "-w")
    whole = report(*words)["bytes"]
    assert report(*words, "--max-size", str(whole + 2500))["bytes"] == whole  # headers are reckoned amply
    said = report(*words, "--max-size", str(whole * 2 // 3))
    assert said["bytes"] == (folder / "object.rfpack").stat().st_size <= whole * 2 // 3
    assert said["psnr"]["stored"] > 20 and iou(folder, "object.rfpack") > 0.75
    kept = (folder / "object.rfpack").read_bytes()
    result = run(*words, "--max-size", "1200")
    assert result.exit_code == 2, result.stderr
    assert "--max-size is too small: the file takes" in result.stderr
    assert (folder / "object.rfpack").read_bytes() == kept


def test_what_is_left_takes_no_more_bytes_than_allowed(report, folder):
    words = ("extract", "blocks.rfpack", "--name", "red", "--invert", "-o", "rest.rfpack", "-w")
    whole = report(*words)["bytes"]
    assert report(*words, "--max-size", str(whole * 2 // 3))["bytes"] <= whole * 2 // 3


BAD = {
    "nothing is told": ((), 2, "say which object"),
    "no cameras": (("--masks", "masks"), 3, "keeps no cameras"),
    "an empty box": (("--box", "5,5,5,6,6,6"), 3, "nothing in the given shape"),
    "no such view": (("--points", "v9:3,3", "--cameras", "cameras.json"), 3, "no view 'v9'"),
    "beside the picture": (("--points", "v0:99,3", "--cameras", "cameras.json"), 2, "lies outside"),
    "at nothing": (("--points", "v0:0,0", "--cameras", "cameras.json"), 3, "nothing to be seen"),
    "only outside": (("--points", "v0:32,32,out", "--cameras", "cameras.json"), 2, "none of them shows"),
    "no point": (("--points", "v0", "--cameras", "cameras.json"), 2, "is not a view's name and a pixel"),
    "no such part": (("--name", "green"), 3, "there is no part 'green'; it holds floor, red"),
    "an open hull": (("--mesh", "open.obj"), 3, "is not closed"),
    "masks of strangers": (
        ("--masks", "strangers", "--cameras", "cameras.json"),
        3,
        "none of its 1 pictures",
    ),
    "masks of another shape": (("--masks", "wide", "--cameras", "cameras.json"), 3, "paint masks on"),
    "black masks": (("--masks", "black", "--cameras", "cameras.json"), 3, "black all over"),
    "no masks": (("--masks", "cameras.json", "--cameras", "cameras.json"), 3, "no folder of pictures"),
    "nothing to mend": (("--box", AROUND, "--fill"), 2, "give --invert too"),
    "a name and more": (("--name", "red", "--box", AROUND), 2, "--name takes a whole part"),
}


@pytest.mark.parametrize("what", BAD)
def test_bad_words_get_one_sentence(run, folder, what):
    words, code, sentence = BAD[what]
    for name, size in (("strangers", (64, 64)), ("wide", (40, 64)), ("black", (64, 64))):
        (folder / name).mkdir()
        stem = "else" if name == "strangers" else "v0"
        write_png(folder / name / f"{stem}.png", np.full((*size, 3), 255 * (name == "wide"), np.uint8))
    (folder / "open.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    result = run("extract", "blocks.rfpack", *words, "-o", "object.rfpack", "--preview", "look")
    assert result.exit_code == code and sentence in result.stderr, result.stderr
    assert result.stderr.count("\n") <= 2 and not (folder / "object.rfpack").exists()
    assert not (folder / "look").exists()


def test_previews_replace_no_other_pictures(report, run, folder):
    words = ("extract", "blocks.rfpack", "--name", "red", "-o", "object.rfpack", "-w", "--preview")
    kept = sorted((folder / "masks").iterdir())
    result = run(*words, "masks")
    assert result.exit_code == 1 and "which is no preview" in result.stderr
    assert sorted((folder / "masks").iterdir()) == kept and not (folder / "object.rfpack").exists()
    for _ in range(2):
        report(*words, "look")


COLUMN = ("--box", "-0.9,-0.4,-0.95,-0.1,0.4,0.4")  # the red box, and the floor below it


def test_what_was_under_it_is_left_empty_or_filled_smoothly(report, folder, picture):
    report("compose", "floor.rfpack", "--translate", "0,0,-0.7", "-o", "floor.json")
    said = report("extract", "blocks.rfpack", *COLUMN, "--invert", "-o", "rest.rfpack")
    assert said["hole"]["unseen"] > 0.5 and not said["hole"]["filled"]
    said = report("extract", "blocks.rfpack", *COLUMN, "--invert", "--fill", "-o", "filled.rfpack")
    assert said["hole"]["filled"]
    floor, rest, filled = (picture(name) for name in ("floor.json", "rest.rfpack", "filled.rfpack"))
    assert psnr(filled, floor) > psnr(rest, floor) + 5


def test_what_was_under_it_is_learnt_from_photos(report, folder, picture):
    """Of photos that show the red box too, whose pixels are left out; of the floor they show enough."""
    report("compose", "floor.rfpack", "--translate", "0,0,-0.7", "-o", "floor.json")
    write_views(folder / "floor", FIELDS["floor"], PLACES["floor"], 48, 16)
    words = ("--invert", "--refit", "floor")
    said = report("extract", "blocks.rfpack", *COLUMN, *words, "-o", "learnt.rfpack")
    assert said["hole"]["photos"] == 32
    report("extract", "blocks.rfpack", *COLUMN, "--invert", "-o", "rest.rfpack")
    floor, rest, learnt = (picture(name) for name in ("floor.json", "rest.rfpack", "learnt.rfpack"))
    assert psnr(learnt, floor) > psnr(rest, floor) + 2


def test_photos_do_not_teach_what_they_do_not_show(tmp_path):
    """Pixels that show the object, and those close to them, are never drawn."""
    write_views(tmp_path / "red")
    capture = read_capture(tmp_path / "red", None)
    cameras = [camera_of(view) for view in capture.train]
    pictures = part("inpainting").photos_without(FIELDS["red"], capture, cameras, NullProgress())
    shown = load_photos(capture.train).pixels[:, 3] > 8
    assert shown.mean() > 0.1 and pictures.ignored[shown].all() and not pictures.ignored.all()


def test_what_is_left_of_a_small_field_does_not_grow(report, folder):
    """Its cells are as wide as texels, along each axis, only where something was taken out."""
    whole = (folder / "blocks.rfpack").stat().st_size
    said = report("extract", "blocks.rfpack", "--box", AROUND, "--invert", "-o", "rest.rfpack")
    assert said["bytes"] < 0.6 * whole  # of two tensors one
    said = report(
        "extract", "blocks.rfpack", "--box", "-0.9,-0.4,-0.95,-0.5,0.4,0.4", "--invert", "-o", "less.rfpack"
    )
    assert said["bytes"] < 1.05 * whole  # both, with a corner of one cut off
