"""Captures: every reader puts one point on the same pixel, every broken capture gets its own sentence."""

import json
import math
import os
from pathlib import Path

import numpy as np
import pytest

from formats.cameras import read_cameras
from formats.captures import is_capture, read_capture, write_capture
from formats.errors import (
    BadImage,
    BadIntrinsics,
    BadJson,
    BadPose,
    BadSchema,
    FormatError,
    MissingFile,
    MixedSizes,
    NoPoses,
    NotACapture,
    NoViews,
    UnsupportedCamera,
)
from formats.images import write_png
from formats.photos import load_images
from formats.views import View, hold_out

# A camera at (4, 1, 2) that looks along world -x with z up: its right is world +y, its back world +x.
POSE = [[0, 0, 1, 4], [1, 0, 0, 1], [0, 1, 0, 2], [0, 0, 0, 1]]
POINT = np.array([0.0, 2.0, 3.0])
# In the camera's frame that is 1 right, 1 up, 4 before: with f = 80, 20 px right of and above (50, 40).
PIXEL = (70.0, 20.0)
SIZE = (100, 80)
ANGLE_X = 2 * math.atan(100 / 2 / 80)
FOV_Y = math.degrees(2 * math.atan(80 / 2 / 80))


def project(view: View, point: np.ndarray) -> tuple[float, float]:
    x, y, z, _ = np.linalg.inv(view.camera_to_world) @ [*point, 1]
    return view.cx + view.fl_x * x / -z, view.cy - view.fl_y * y / -z


def photo(path: Path, size=SIZE, channels: int = 3, level: int = 100) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    pixels = np.full((size[1], size[0], channels), level, np.uint8)
    pixels[-1, -1] = 255 - level  # borders of one colour would be a ground
    write_png(path, pixels)


def on_white(path: Path) -> None:
    """A grey thing that touches no border of a white picture."""
    pixels = np.full((SIZE[1], SIZE[0], 3), 255, np.uint8)
    pixels[20:60, 30:60] = 90
    path.parent.mkdir(parents=True, exist_ok=True)
    write_png(path, pixels)


def write(folder: Path, name: str = "transforms.json", frames=None, **keys) -> Path:
    path = folder / name
    path.write_text(json.dumps({**keys, "frames": frames if frames is not None else [frame("a.png")]}))
    return path


def frame(file: str, **keys) -> dict:
    return {"file_path": file, "transform_matrix": POSE, **keys}


def posed(folder: Path, poses, file: str = "a.png", **keys) -> list[dict]:
    """A frame for each pose, with a photo of its own that is a link to one."""
    names = [f"{i:02d}{Path(file).suffix}" for i in range(len(poses))]
    for name in names:
        (folder / name).unlink(missing_ok=True)
        os.link(folder / file, folder / name)
    return [frame(name, transform_matrix=pose, **keys) for name, pose in zip(names, poses, strict=True)]


def folder_with(folder: Path, **keys) -> Path:
    photo(folder / "a.png")
    write(folder, **{"fl_x": 80, **keys})
    return folder


# --- one point, one pixel -----------------------------------------------------------------------------------

TRANSFORMS = {
    "instant-ngp, pixels": {"fl_x": 80, "w": 100.0, "h": 80.0},
    "instant-ngp, degrees before pixels": {"x_fov": math.degrees(ANGLE_X), "fl_x": 7, "camera_angle_x": 1},
    "instant-ngp, radians": {"camera_angle_x": ANGLE_X, "aabb_scale": 4},
    "nerfstudio": {"fl_x": 80, "fl_y": 80, "cx": 50, "cy": 40, "w": 100, "h": 80, "camera_model": "OPENCV"},
    "only y": {"fl_y": 80},
    "a downscaled copy": {"fl_x": 320, "fl_y": 320, "cx": 200, "cy": 160, "w": 400, "h": 320},
}


@pytest.mark.parametrize("keys", TRANSFORMS.values(), ids=TRANSFORMS)
def test_transforms_pixel(tmp_path, keys):
    photo(tmp_path / "a.png")
    write(tmp_path, **keys)
    (view,) = read_capture(tmp_path).train
    assert project(view, POINT) == pytest.approx(PIXEL)


def test_frame_intrinsics_before_the_files(tmp_path):
    photo(tmp_path / "a.png")
    write(
        tmp_path,
        frames=[frame("a.png", fl_x=80, fl_y=80, cx=50, cy=40)],
        x_fov=11,
        fl_x=5,
        fl_y=6,
        cx=1,
        cy=2,
    )
    (view,) = read_capture(tmp_path).train
    assert project(view, POINT) == pytest.approx(PIXEL)


def test_blender_pixel(tmp_path):
    photo(tmp_path / "train/r_0.png", channels=4)
    write(tmp_path, "transforms_train.json", [frame("./train/r_0", rotation=0.1)], camera_angle_x=ANGLE_X)
    capture = read_capture(tmp_path)
    assert project(capture.train[0], POINT) == pytest.approx(PIXEL)
    assert (capture.kind, capture.opaque, capture.test) == ("blender", True, ())


def camera_path(**keys) -> dict:
    frames = [{"camera_to_world": np.ravel(POSE).tolist(), "fov": FOV_Y, "aspect": 1.25}]
    return {
        "render_width": 100,
        "render_height": 80,
        "camera_type": "Perspective",
        "camera_path": frames,
        **keys,
    }


def test_camera_path_pixel(tmp_path):
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(camera_path()))
    (view,) = read_cameras(path)
    assert project(view, POINT) == pytest.approx(PIXEL)
    assert view.name == "00000"


def test_camera_path_keeps_its_vertical_field_of_view(tmp_path):
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(camera_path(render_width=None)))
    (view,) = read_cameras(path, (300, 160))
    assert project(view, POINT) == pytest.approx((150 + 40, 80 - 40))
    with pytest.raises(BadIntrinsics, match="render_width"):
        read_cameras(path)


@pytest.mark.parametrize("kind", ["fisheye", "equirectangular"])
def test_camera_path_of_another_kind(tmp_path, kind):
    path = tmp_path / "camera_path.json"
    path.write_text(json.dumps(camera_path(camera_type=kind)))
    with pytest.raises(UnsupportedCamera, match=kind):
        read_cameras(path)


def test_cameras_need_no_photo(tmp_path):
    (view,) = read_cameras(write(tmp_path, fl_x=80, w=100, h=80))
    assert project(view, POINT) == pytest.approx(PIXEL)
    assert (view.name, view.image_path) == ("a", None)


def test_cameras_take_the_size_of_the_first_photo(tmp_path):
    photo(tmp_path / "b.png")
    path = write(tmp_path, frames=[frame("a.png"), frame("b.png")], camera_angle_x=ANGLE_X)
    assert [project(view, POINT) for view in read_cameras(path)] == [pytest.approx(PIXEL)] * 2


def test_cameras_at_another_size_keep_the_horizontal_field_of_view(tmp_path):
    path = write(tmp_path, fl_x=80, w=100, h=80)
    (view,) = read_cameras(path, (200, 200))
    assert project(view, POINT) == pytest.approx((140, 100 - 40))
    assert (view.width, view.height) == (200, 200)


def test_cameras_without_any_size(tmp_path):
    with pytest.raises(BadIntrinsics, match="frame 0"):
        read_cameras(write(tmp_path, fl_x=80))


# --- what the files may look like ---------------------------------------------------------------------------


def test_comments_and_backslashes(tmp_path):
    photo(tmp_path / "images/a.png")
    text = json.dumps({"fl_x": 80, "note": "no // comment", "frames": [frame("images\\a.png")]})
    (tmp_path / "transforms.json").write_text("// one\n" + text.replace(', "note"', ', /* two\n */ "note"'))
    assert read_capture(tmp_path).train[0].image_path == tmp_path / "images/a.png"


def test_natural_order(tmp_path):
    files = ["r_10.png", "r_2.png", "r_1.png"]
    for file in files:
        photo(tmp_path / file)
    write(tmp_path, frames=[frame(file) for file in files], fl_x=80)
    assert [view.name for view in read_capture(tmp_path).train] == ["r_1", "r_2", "r_10"]


def test_stems_that_two_folders_share(tmp_path):
    for side in ("left", "right"):
        photo(tmp_path / side / "1.png")
    write(tmp_path, frames=[frame("./left/1.png"), frame("./right/1.png")], fl_x=80)
    assert [view.name for view in read_capture(tmp_path).train] == ["left_1", "right_1"]


def test_missing_photos_are_counted(tmp_path):
    photo(tmp_path / "a.png")
    write(tmp_path, frames=[frame("gone.png"), frame("a.png"), frame("x" * 5000), frame("\0")], fl_x=80)
    capture = read_capture(tmp_path)
    assert len(capture.train) == 1
    assert sorted(capture.missing) == ["\0", "gone.png", "x" * 5000]


def test_splits_by_name(tmp_path):
    for file in "abcd":
        photo(tmp_path / f"{file}.png")
    frames = [frame(f"./{file}.png") for file in "abcd"]
    write(tmp_path, frames=frames, fl_x=80, train_filenames=["a.png", "c.png"], test_filenames=["./b.png"])
    capture = read_capture(tmp_path)
    assert [[view.name for view in part] for part in (capture.train, capture.test)] == [["a", "c"], ["b"]]


def test_val_stands_in_for_train_only(tmp_path):
    for split in ("val", "test"):
        photo(tmp_path / f"{split}.png")
        write(tmp_path, f"transforms_{split}.json", [frame(split)], fl_x=80)
    assert [view.name for view in read_capture(tmp_path).train] == ["val"]
    photo(tmp_path / "train.png")
    write(tmp_path, "transforms_train.json", [frame("train")], fl_x=80)
    capture = read_capture(tmp_path)
    assert [view.name for view in capture.train + capture.test] == ["train", "test"]


def test_one_named_file_is_read_alone(tmp_path):
    for split in ("train", "test"):
        photo(tmp_path / f"{split}.png")
        write(tmp_path, f"transforms_{split}.json", [frame(split)], fl_x=80)
    capture = read_capture(tmp_path / "transforms_test.json")
    assert (capture.train, [view.name for view in capture.test]) == ((), ["test"])


def test_distortion_is_kept(tmp_path):
    bends = {"k1": 0.1, "k2": -0.2, "k3": 0.3, "p1": 0.01, "p2": -0.02}
    (view,) = read_capture(folder_with(tmp_path, **bends)).train
    assert view.distortion == tuple(bends.values())


# --- boxes --------------------------------------------------------------------------------------------------


def test_aabb_scale(tmp_path):
    on_white(tmp_path / "a.png")
    capture = read_capture(write(tmp_path, fl_x=80, aabb_scale=4))
    assert capture.aabb == pytest.approx(np.array([-1, -1, -1, 1, 1, 1]) * 4 / 0.66)


def test_aabb_scale_with_offset(tmp_path):
    """0.5 x + (0.5, 0.25, 0) is kept within 0.5 +- 1, so x runs from -2 to 2, y -1.5 to 2.5, z -1 to 3."""
    on_white(tmp_path / "a.png")
    capture = read_capture(write(tmp_path, fl_x=80, aabb_scale=2, scale=0.5, offset=[0.5, 0.25, 0]))
    assert capture.aabb == pytest.approx([-2, -1.5, -1, 2, 2.5, 3])


@pytest.mark.parametrize(
    "keys", [{"aabb_scale": 0}, {"aabb_scale": "big"}, {"aabb_scale": 1, "offset": [1, 2]}]
)
def test_bad_aabb_scale(tmp_path, keys):
    with pytest.raises(BadSchema, match="aabb_scale"):
        read_capture(folder_with(tmp_path, **keys))


def looking_at(eye, target) -> list:
    back = np.subtract(eye, target) / np.linalg.norm(np.subtract(eye, target))
    right = np.cross([0, 0, 1], back)
    right /= np.linalg.norm(right)
    return [*np.column_stack([right, np.cross(back, right), back, eye]).tolist(), [0, 0, 0, 1]]


# --- what is wrong with it ----------------------------------------------------------------------------------


def pose(change) -> list:
    matrix = np.array(POSE, float)
    change(matrix)
    return matrix.tolist()


BAD_POSES = {
    "NaN": (pose(lambda m: m.__setitem__((0, 3), np.nan)), "NaN"),
    "sheared": (pose(lambda m: m.__setitem__((0, 1), 0.1)), "no rotation"),
    "without an axis": (pose(lambda m: m[:, 0].__imul__(0)), "column lengths 0, 1, 1"),
    "transposed": (np.transpose(POSE).tolist(), "transposed: write its columns as rows"),
    "far away": (pose(lambda m: m.__setitem__((0, 3), 1e300)), "1e.300 from the world's origin"),
    "mirrored": (pose(lambda m: m[:, 0].__imul__(-1)), "mirrored"),
    "projective": (pose(lambda m: m.__setitem__((3, 0), 1.0)), "ends in the row"),
    "short": ([[1, 0, 0]], "numbers"),
    "absent": (None, "4x4"),
    "words": ([["a"] * 4] * 4, "4x4"),
    "huge": ([[10**400] * 4] * 4, "4x4"),
}


@pytest.mark.parametrize("matrix, said", BAD_POSES.values(), ids=BAD_POSES)
def test_bad_pose(tmp_path, matrix, said):
    for name in "ab":
        photo(tmp_path / f"{name}.png")
    path = write(tmp_path, frames=[frame("b.png"), frame("a.png", transform_matrix=matrix)], fl_x=80)
    with pytest.raises(BadPose, match=said) as caught:
        read_capture(tmp_path)
    assert f"{path}: frame 1 (a.png)" in str(caught.value)


def test_three_rows_are_a_pose(tmp_path):
    photo(tmp_path / "a.png")
    write(tmp_path, frames=[frame("a.png", transform_matrix=POSE[:3])], fl_x=80)
    assert project(read_capture(tmp_path).train[0], POINT) == pytest.approx(PIXEL)


@pytest.mark.parametrize(
    "keys",
    [
        {"fl_x": 0},
        {"fl_x": -5},
        {"fl_x": None},
        {"fl_x": "80"},
        {"fl_x": None, "x_fov": 180},
        {"cx": float("inf")},
    ]
    + [{"w": 0, "h": 80}, {"w": 20000, "h": 80}, {"k1": float("nan")}, {"fl_x": True}],
)
def test_bad_intrinsics(tmp_path, keys):
    with pytest.raises(BadIntrinsics, match=r"transforms\.json: frame 0 \(a\.png\)"):
        read_capture(folder_with(tmp_path, **keys))


def test_turned_photo(tmp_path):
    with pytest.raises(BadIntrinsics, match=r"80x100.*a\.png is 100x80"):
        read_capture(folder_with(tmp_path, w=80, h=100))


@pytest.mark.parametrize(
    "keys",
    [
        {"camera_model": "EQUIRECTANGULAR"},
        {"camera_model": "THIN_PRISM_FISHEYE"},
        {"is_fisheye": True, "p1": 0.1},
    ],
)
def test_unsupported_camera(tmp_path, keys):
    with pytest.raises(UnsupportedCamera, match=r"transforms\.json: frame 0 \(a\.png\).*undistort"):
        read_capture(folder_with(tmp_path, **keys))


LENSES = {
    "instant-ngp fisheye": ({"is_fisheye": True, "k1": 0.1, "k4": 0.4}, True, (0.1, 0, 0, 0.4)),
    "nerfstudio fisheye": ({"camera_model": "OPENCV_FISHEYE", "k2": 0.2}, True, (0, 0.2, 0, 0)),
    "eighth power": ({"k1": 0.1, "p2": 0.3, "k4": 0.4}, False, (0.1, 0, 0, 0, 0.3, 0.4)),
    "rational": (
        {"camera_model": "FULL_OPENCV", "k3": 0.3, "k4": 0.4, "k6": 0.6},
        False,
        (0, 0, 0.3, 0, 0, 0, 0.4, 0, 0.6),
    ),
    "rational by its keys": ({"k4": 0.4, "k5": 0.5}, False, (0, 0, 0, 0, 0, 0, 0.4, 0.5, 0)),
}


@pytest.mark.parametrize("keys, fisheye, distortion", LENSES.values(), ids=LENSES)
def test_lenses(tmp_path, keys, fisheye, distortion):
    (view,) = read_capture(folder_with(tmp_path, **keys)).train
    assert (view.fisheye, view.distortion) == (fisheye, distortion)


def test_a_frames_lens_goes_before_the_files(tmp_path):
    for name in "ab":
        photo(tmp_path / f"{name}.png")
    frames = [frame("a.png", camera_model="OPENCV_FISHEYE", k1=0.5), frame("b.png")]
    write(tmp_path, frames=frames, fl_x=80, k1=0.1, camera_model="OPENCV")
    a, b = read_capture(tmp_path).train
    assert (a.fisheye, a.distortion, b.fisheye, b.distortion[0]) == (True, (0.5, 0, 0, 0), False, 0.1)


def test_photos_without_poses(tmp_path):
    photo(tmp_path / "images/1.png")
    assert is_capture(tmp_path)
    with pytest.raises(NoPoses, match="COLMAP"):
        read_capture(tmp_path)


@pytest.mark.parametrize("frames", [[], [frame("gone.png")]])
def test_no_views(tmp_path, frames):
    write(tmp_path, frames=frames, fl_x=80)
    with pytest.raises(NoViews):
        read_capture(tmp_path)


@pytest.mark.parametrize(
    "text, error",
    [
        ("{", BadJson),
        ("[" * 10**5, BadJson),
        ("[]", NotACapture),
        ("{}", BadSchema),
        ('{"frames": [1]}', BadSchema),
    ]
    + [("\x80", BadJson), ('{"frames": [{}], "train_filenames": 3}', BadSchema)],
)
def test_bad_json(tmp_path, text, error):
    (tmp_path / "transforms.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(error, match=r"transforms\.json"):
        read_capture(tmp_path)


def test_nothing_there(tmp_path):
    assert not is_capture(tmp_path / "nothing")
    with pytest.raises(MissingFile, match="nothing"):
        read_capture(tmp_path / "nothing")


def test_a_capture_is_told_from_a_scene(tmp_path):
    scene = tmp_path / "scene.json"
    scene.write_text('{"format": "rfpack", "nodes": []}')
    assert not is_capture(scene)
    assert is_capture(write(tmp_path, "poses.json"))
    assert not is_capture(tmp_path / "empty")


# --- pixels -------------------------------------------------------------------------------------------------


def test_load_images_in_order(tmp_path):
    for i in range(4):
        photo(tmp_path / f"{i}.png", level=i)
    write(tmp_path, frames=[frame(f"{i}.png") for i in range(4)], fl_x=80)
    images = load_images(read_capture(tmp_path).train)
    assert (images.shape, images.dtype) == ((4, 80, 100, 4), np.uint8)
    assert images[:, 5, 5].tolist() == [[i, i, i, 255] for i in range(4)]


def test_mixed_sizes_name_the_first_two(tmp_path):
    for name, size in {"a": (10, 8), "b": (10, 8), "c": (20, 16), "d": (5, 4)}.items():
        photo(tmp_path / f"{name}.png", size)
    write(tmp_path, frames=[frame(f"{name}.png") for name in "abcd"], fl_x=80)
    with pytest.raises(MixedSizes, match=r"a\.png is 10x8 but .*c\.png is 20x16"):
        load_images(read_capture(tmp_path).train)


def test_truncated_photo(tmp_path):
    noise = np.random.default_rng(0).integers(0, 256, (80, 100, 3), np.uint8)
    write_png(tmp_path / "a.png", noise)
    data = (tmp_path / "a.png").read_bytes()
    (tmp_path / "a.png").write_bytes(data[: len(data) // 2])
    write(tmp_path, fl_x=80)
    with pytest.raises(BadImage, match=r"a\.png"):
        load_images(read_capture(tmp_path).train)


def test_load_nothing():
    with pytest.raises(NoViews):
        load_images([])


# --- holding out and writing --------------------------------------------------------------------------------


def test_hold_out(tmp_path):
    for i in range(7):
        photo(tmp_path / f"{i}.png")
    write(tmp_path, frames=[frame(f"{i}.png") for i in range(7)], fl_x=80)
    capture = hold_out(read_capture(tmp_path), 3)
    assert [view.name for view in capture.test] == ["0", "3", "6"]
    assert [view.name for view in capture.train] == ["1", "2", "4", "5"]
    with pytest.raises(NoViews, match="fewer"):
        hold_out(capture, 1)


WRITTEN = {
    "pinholes": [
        (80, 80, (0.0,) * 5, False),
        (81, 80, (0.1, 0, 0, 0, 0), False),
        (80, 79, (0.0,) * 5, False),
    ],
    "all lenses": [
        (80, 80, (0.1, 0.2, 0.3, 0.4), True),
        (80, 80, (0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.6, 0.7, 0.8), False),
        (80, 80, (0.0, 0.0, 0.0, 0.0, 0.0, 0.6), False),
    ],
    "a fisheye among pinholes": [
        (80, 80, (0.1, 0, 0, 0, 0), False),
        (80, 80, (0.0,) * 4, True),
        (80, 80, (0.0,) * 5, False),
    ],
}


@pytest.mark.parametrize("lenses", WRITTEN.values(), ids=WRITTEN)
def test_written_captures_come_back(tmp_path, lenses):
    random = np.random.default_rng(1)
    pixels = random.integers(0, 256, (3, 8, 10, 4), np.uint8)
    pixels[:, [0, -1], :, 3] = 0  # they show something that stands free
    for i in range(3):
        pixels[i, :, : 1 + 2 * i, 3] = 0
    poses = np.array([POSE] * 3, float)
    poses[:, :3, 3] = random.normal(size=(3, 3))
    views = [
        View(f"r_{i}", p, x, y, 4.5, 4.0, 10, 8, k, fisheye)
        for i, (p, (x, y, k, fisheye)) in enumerate(zip(poses, lenses, strict=True))
    ]
    write_capture(tmp_path / "new", views, pixels)
    write_capture(tmp_path / "new", views[:1], pixels[:1], "test")
    capture = read_capture(tmp_path / "new")
    assert (load_images(capture.train) == pixels).all()
    assert (load_images(capture.test) == pixels[:1]).all()
    for view, back in zip(views, capture.train, strict=True):
        assert (back.camera_to_world == view.camera_to_world).all()
        for key in ("name", "fl_x", "fl_y", "cx", "cy", "width", "height", "distortion", "fisheye"):
            assert getattr(back, key) == getattr(view, key)


def test_a_centre_in_shares_of_the_picture(tmp_path):
    photo(tmp_path / "a.png")
    write(tmp_path, fl_x=0.8, fl_y=1.0, cx=0.5, cy=0.5)
    with pytest.raises(BadIntrinsics, match=r"cx and cy are 0\.5 and 0\.5.*in pixels"):
        read_capture(tmp_path)


def test_photos_to_test_with_that_are_not_there(tmp_path):
    """As where only the training photos were downloaded."""
    photo(tmp_path / "train/a.png")
    for split in ("train", "test"):
        write(tmp_path, f"transforms_{split}.json", [frame(f"{split}/a")], fl_x=80)
    capture = read_capture(tmp_path)
    assert (len(capture.train), len(capture.test)) == (1, 0) and "none are held out" in capture.notes[0]


# --- real captures ------------------------------------------------------------------------------------------

DATA = Path(os.environ.get("FUSEDRF_DATA", Path(__file__).parents[3] / "shared/data"))


def real(name: str) -> Path:
    if not (DATA / name).exists():
        pytest.skip(f"{name} is not in the folder named by FUSEDRF_DATA")
    return DATA / name


def test_chair():
    capture = read_capture(real("chair"))
    assert (len(capture.train), len(capture.test), capture.opaque) == (100, 20, False)
    images = load_images(capture.test[:2])
    # The chair stands in the middle of its pictures, and nothing is in their corners.
    assert images[:, 200, 200, 3].tolist() == [255, 255]
    assert images[:, 0, 0, 3].tolist() == [0, 0]


def test_fox():
    capture = read_capture(real("fox"))
    assert (len(capture.train), len(capture.missing), capture.opaque) == (50, 17, True)
    assert capture.missing[0] == "images/0005.jpg"
    assert capture.train[0].distortion[:2] == (0.0578421, -0.0805099)
    assert load_images(capture.train[:2]).shape == (2, 480, 270, 4)
    with pytest.raises(FormatError):
        read_capture(real("fox") / "LICENSE.txt")
