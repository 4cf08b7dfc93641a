"""`info` of captures, photos and meshes: what `train` would read of them."""

import json
from pathlib import Path

import numpy as np
import pytest

from formats.errors import NotACapture, NoViews
from formats.overview import overview
from tests.formats.test_captures import frame, photo, write
from tests.formats.test_masks import keep
from tests.formats.test_readers import binary_model, noisy, photos, ring


def poses() -> list:
    return ring(9, 4, np.array([3.0, -2, 1]))


def capture(folder, **keys) -> None:
    for i in range(9):
        noisy(folder / f"images/{i}.png")
    frames = [frame(f"images/{i}.png", transform_matrix=pose) for i, pose in enumerate(poses())]
    write(folder, frames=[*frames, frame("images/gone.png")], fl_x=80, w=10, h=8, **keys)


def test_a_capture(tmp_path):
    capture(tmp_path, k1=0.1)
    told = overview(tmp_path)
    assert json.loads(json.dumps(told)) == told
    assert (told["format"], told["kind"], told["space"], told["box"]) == (
        "capture",
        "transforms",
        "unbounded",
        None,
    )
    assert told["photos"] == {"to_learn_from": 9, "held_out": 0}
    assert [row["photo"] for row in told["left_out"]] == ["images/gone.png"]
    assert told["sizes"] == [{"size": "10x8", "photos": 9}]
    (lens,) = told["lenses"]
    assert (lens["lens"], lens["focal"], lens["distortion"][0]) == ("pinhole", [80, 80], 0.1)
    assert told["looks_at"] == pytest.approx([3, -2, 1]) and told["up"] == [0, 0, 1]
    assert (told["masks"], told["points"], told["transparent"]) == (0, 0, False)


def test_numbers_that_are_zero_are_told_so(tmp_path):
    """Cameras around the origin, whose axes meet there but for rounding."""
    around = ring(9, 4, np.zeros(3))
    for i in range(9):
        noisy(tmp_path / f"{i}.png")
    frames = [frame(f"{i}.png", transform_matrix=pose) for i, pose in enumerate(around)]
    write(tmp_path, frames=frames, fl_x=80)
    assert overview(tmp_path)["looks_at"] == [0, 0, 0]


def test_masks_and_trouble(tmp_path):
    capture(tmp_path)
    keep(tmp_path / "masks/0.png", np.full((8, 10), 255, np.uint8))
    told = overview(tmp_path)
    assert told["masks"] == 1 and "8 of 9 photos have no mask" in " ".join(told["notes"])
    write(tmp_path, frames=[frame("images/0.png")], fl_x=80)
    assert "3 or more" in overview(tmp_path)["notes"][-1]


def test_photos_without_poses(tmp_path):
    for i in range(3):
        photo(tmp_path / f"{i}.png", (100, 80) if i else (80, 100))
    told = overview(tmp_path)
    assert (told["format"], told["photos"]) == ("photos", {"to_pose": 3})
    assert told["sizes"] == [{"size": "100x80", "photos": 2}, {"size": "80x100", "photos": 1}]
    assert "no poses" in told["notes"][0]


@pytest.mark.parametrize("name", ["Transforms.JSON", "cameras.xml", "above"])
def test_poses_that_are_not_used(tmp_path, name):
    """Of photos whose poses would be estimated."""
    capture(tmp_path)
    if name == "above":
        (note,) = overview(tmp_path / "images")["notes"][1:]
        assert "the folder above it, has poses" in note and "give that folder" in note
        return
    (tmp_path / "transforms.json").rename(tmp_path / name)
    if name == "cameras.xml":
        (tmp_path / name).write_text('<?xml version="1.0"?>\n<document version="2.0.0">\n <chunk>')
    (note,) = overview(tmp_path)["notes"][1:]
    assert name in note and "not used" in note and "; " in note


OTHERS = {
    "groundtruth.txt": "# timestamp tx ty tz qx qy qz qw\n",
    "sfm_data.json": '{"sfm_data_version": "0.3", "views": []}',
    "bundle.out": "# Bundle file v0.3\n",
    "cameras_sphere.npz": "",
    "traj.txt": "1 0 0 0\n",
    "cams/00000000_cam.txt": "extrinsic\n",
}


@pytest.mark.parametrize("name", OTHERS)
@pytest.mark.parametrize("where", ["", "images", "rgb"])
def test_cameras_of_other_programs_are_told(tmp_path, name, where):
    for i in range(3):
        noisy(tmp_path / where / f"{i}.png")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    (tmp_path / name).write_text(OTHERS[name])
    notes = " ".join(overview(tmp_path / where)["notes"])
    said = f"{Path(name).name}, another program's list of cameras, is not used"
    assert f"{said}; export a COLMAP model" in notes
    if where == "rgb":
        with pytest.raises(NotACapture, match=f"in rgb; give that folder; {said}"):
            overview(tmp_path)


def test_a_transforms_json_under_another_ending_is_told(tmp_path):
    capture(tmp_path)
    (tmp_path / "transforms.json").rename(tmp_path / "transforms.json.txt")
    for path in (tmp_path / "images").iterdir():
        path.rename(tmp_path / path.name)
    told = overview(tmp_path)
    assert "transforms.json.txt has poses, which are not used; give that file" in " ".join(told["notes"])
    assert overview(tmp_path / "transforms.json.txt")["photos"]["to_learn_from"] == 9


def test_the_largest_model_is_of_other_photos(tmp_path):
    photos(tmp_path / "images", ("a.png", "b.png"))
    binary_model(tmp_path / "sparse/0", ("a.png", "b.png"))
    binary_model(tmp_path / "sparse/1", ("x.png", "y.png", "z.png"))
    with pytest.raises(NoViews, match=r"sparse/1: names 3 photos.*give the folder .*sparse/0 to read"):
        overview(tmp_path)


def test_a_centre_beside_the_picture(tmp_path):
    capture(tmp_path, cx=20.0, cy=16.0)
    assert "centres of 9 of 9 photos lie outside" in " ".join(overview(tmp_path)["notes"])


def test_a_mesh(tmp_path):
    trimesh = pytest.importorskip("trimesh")
    trimesh.creation.box((2, 4, 6)).export(tmp_path / "box.ply")
    told = overview(tmp_path / "box.ply")
    assert (told["format"], told["kind"], told["surfaces"], told["triangles"]) == ("mesh", "ply", 1, 12)
    assert told["aabb"] == pytest.approx(np.array([-1, -2, -3, 1, 2, 3]), abs=0.13)


def test_what_is_none_of_them(tmp_path):
    (tmp_path / "walk.mp4").write_bytes(b"\0\0\0\x20ftypisom")
    with pytest.raises(NotACapture, match=r"walk\.mp4: is a film"):
        overview(tmp_path / "walk.mp4")
    (tmp_path / "scene.json").write_text('{"format": "rfpack", "nodes": []}')
    assert overview(tmp_path / "scene.json") is None
    assert overview(tmp_path / "nowhere") is None
