"""COLMAP, LLFF, Polycam and nerfstudio: one point on one pixel, and a sentence for what cannot be read."""

import json
import struct
from dataclasses import replace
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow
from PIL import ImageOps

from formats import colmap
from formats.captures import is_capture, read_capture
from formats.errors import (
    BadIntrinsics,
    BadMask,
    BadModel,
    BadPose,
    BadSchema,
    FormatError,
    MissingFile,
    MixedSizes,
    NoPoses,
    NoViews,
    UnsupportedCamera,
)
from formats.photos import load_ignored, load_images, load_photos
from formats.points import read_ply_points
from formats.views import check_parallax
from tests.formats.test_captures import PIXEL, POINT, POSE, SIZE, frame, photo, posed, project, real, write

# The same camera as COLMAP says it: x right is world +y, y down is world -z, z forward is world -x.
TO_CAMERA = np.array([[0, 1, 0], [0, 0, -1], [-1, 0, 0]], float)
TRANSLATION = -TO_CAMERA @ [4.0, 1.0, 2.0]
QUATERNION = (0.5, 0.5, 0.5, -0.5)
NAMES = ("b/2.png", "a.png", "10.png")
POINTS = {7: (0.0, 2.0, 3.0), 3: (1.0, 1.0, 2.0), 900: (-96.0, 1.0, 2.0)}
PLACES = list(POINTS.values())


def rotation(quaternion) -> np.ndarray:
    """What a point becomes when it is multiplied by q on the left and by its conjugate on the right."""
    w, v = quaternion[0], np.array(quaternion[1:])
    return np.stack([p + 2 * np.cross(v, np.cross(v, p) + w * p) for p in np.eye(3)], 1)


def test_the_quaternion_of_these_tests():
    assert rotation(QUATERNION) == pytest.approx(TO_CAMERA)


# --- COLMAP -------------------------------------------------------------------------------------------------


def binary_model(
    folder: Path,
    names=NAMES,
    model=1,
    params=(80, 80, 50, 40),
    size=SIZE,
    points=POINTS,
    apart=0.0,
    errors=(0.5,),
) -> None:
    """All cameras at one place, or `apart` from each other; the errors of points are told in turn."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.bin").write_bytes(
        struct.pack("<QIiQQ", 1, 5, model, *size) + struct.pack(f"<{len(params)}d", *params)
    )
    images = struct.pack("<Q", len(names))
    for i, name in enumerate(names):
        moved = TRANSLATION + [i * apart, 0, 0]
        images += struct.pack("<I7dI", 10 * i + 1, *QUATERNION, *moved, 5) + name.encode() + b"\0"
        seen = [*points, 2**64 - 1]
        images += struct.pack("<Q", len(seen)) + b"".join(struct.pack("<ddQ", 1.5, 2.5, p) for p in seen)
    (folder / "images.bin").write_bytes(images)
    cloud = struct.pack("<Q", len(points))
    for (i, p), error in zip(points.items(), cycle(errors), strict=False):
        cloud += struct.pack("<Q3d3BdQ", i, *p, i % 256, 20, 30, error, 2) + struct.pack("<4I", 1, 0, 11, 0)
    (folder / "points3D.bin").write_bytes(cloud)


def text_model(folder: Path, camera="5 PINHOLE 100 80 80 80 50 40", names=NAMES) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cameras.txt").write_text(f"# cameras\n# more\n{camera}\n")
    pose = " ".join(map(str, (*QUATERNION, *TRANSLATION)))
    seen = " ".join(f"1.5 2.5 {p}" for p in (*POINTS, -1))
    lines = [f"{i + 1} {pose} 5 {name}\n{seen if i else ''}\n" for i, name in enumerate(names)]
    (folder / "images.txt").write_text("# images\n" + "".join(lines))
    rows = [f"{i} {' '.join(map(str, p))} {i % 256} 20 30 0.5 1 0 11 0\n" for i, p in POINTS.items()]
    (folder / "points3D.txt").write_text("# points\n" + "".join(rows))


def photos(folder: Path, names=NAMES, size=SIZE) -> None:
    for i, name in enumerate(names):
        photo(folder / name, size, level=40 + i)


@pytest.mark.parametrize("place", ["sparse/0", "sparse", "colmap/sparse/0", "sparse/3"])
@pytest.mark.parametrize("write_model", [binary_model, text_model])
def test_colmap_pixel(tmp_path, write_model, place):
    write_model(tmp_path / place)
    photos(tmp_path / "images")
    assert is_capture(tmp_path)
    for named in (tmp_path, tmp_path / place):
        capture = read_capture(named)
        assert (capture.kind, capture.missing) == ("colmap", ())
        assert [view.name for view in capture.train] == ["10", "a", "2"]
        for view in capture.train:
            assert view.camera_to_world == pytest.approx(np.array(POSE), abs=1e-12)
            assert project(view, POINT) == pytest.approx(PIXEL)
        assert (load_images(capture.train)[:, 0, 0, 0] == [42, 41, 40]).all()


@pytest.mark.parametrize("write_model", [binary_model, text_model])
def test_colmap_points(tmp_path, write_model):
    write_model(tmp_path / "sparse/0")
    photos(tmp_path / "images")
    capture = read_capture(tmp_path)
    # By rising id.
    assert capture.points.positions.tolist() == [list(POINTS[i]) for i in (3, 7, 900)]
    assert capture.points.colours.tolist() == [[i % 256, 20, 30] for i in (3, 7, 900)]
    # Seen from x = 4 along -x, they lie 3, 4 and 100 deep.
    view = capture.train[0]
    assert (view.near, view.far) == pytest.approx((3.002, 99.808))
    assert view.seen.tolist() == [0, 1, 2]
    if write_model is text_model:  # an image without observations, whose second line is empty
        assert capture.train[2].near is None and not len(capture.train[2].seen)


def test_points_that_photos_show_elsewhere_are_not_what_they_show(tmp_path):
    binary_model(tmp_path / "sparse/0", errors=(0.5, 3.0, np.nan))  # of points 7, 3 and 900
    photos(tmp_path / "images")
    capture = read_capture(tmp_path)
    assert len(capture.points.positions) == 3 and capture.train[0].seen.tolist() == [1]


MODELS = {
    0: ("SIMPLE_PINHOLE", (80, 50, 40), False, (0,) * 5),
    1: ("PINHOLE", (80, 80, 50, 40), False, (0,) * 5),
    2: ("SIMPLE_RADIAL", (80, 50, 40, 0.1), False, (0.1, 0, 0, 0, 0)),
    3: ("RADIAL", (80, 50, 40, 0.1, 0.2), False, (0.1, 0.2, 0, 0, 0)),
    4: ("OPENCV", (80, 80, 50, 40, 0.1, 0.2, 0.3, 0.4), False, (0.1, 0.2, 0, 0.3, 0.4)),
    5: ("OPENCV_FISHEYE", (80, 80, 50, 40, 0.1, 0.2, 0.3, 0.4), True, (0.1, 0.2, 0.3, 0.4)),
    6: (
        "FULL_OPENCV",
        (80, 80, 50, 40, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8),
        False,
        (0.1, 0.2, 0.5, 0.3, 0.4, 0, 0.6, 0.7, 0.8),
    ),
    8: ("SIMPLE_RADIAL_FISHEYE", (80, 50, 40, 0.1), True, (0.1, 0, 0, 0)),
    9: ("RADIAL_FISHEYE", (80, 50, 40, 0.1, 0.2), True, (0.1, 0.2, 0, 0)),
    14: ("SIMPLE_FISHEYE", (80, 50, 40), True, (0,) * 4),
    15: ("FISHEYE", (80, 80, 50, 40), True, (0,) * 4),
}


@pytest.mark.parametrize("number", MODELS)
def test_colmap_models(tmp_path, number):
    name, params, fisheye, distortion = MODELS[number]
    binary_model(tmp_path / "bin/sparse/0", model=number, params=params)
    text_model(tmp_path / "txt/sparse/0", camera=f"5 {name} 100 80 {' '.join(map(str, params))}")
    for coding in ("bin", "txt"):
        view = colmap.read_model(tmp_path / coding / "sparse/0").images[0].view
        assert (view.fl_x, view.fl_y, view.cx, view.cy) == (80, 80, 50, 40)
        assert (view.fisheye, view.distortion) == (fisheye, distortion)


@pytest.mark.parametrize(
    "number, name", [(7, "FOV"), (10, "THIN_PRISM_FISHEYE"), (17, "EQUIRECTANGULAR"), (99, "99")]
)
def test_colmap_models_that_are_not_read(tmp_path, number, name):
    binary_model(tmp_path / "sparse/0", model=number)
    photos(tmp_path / "images")
    with pytest.raises(UnsupportedCamera, match=rf"cameras\.bin: camera 5.*{name}.*image_undistorter"):
        read_capture(tmp_path)
    if number < 99:
        text_model(tmp_path / "text/sparse/0", camera=f"5 {name} 100 80 80 50 40")
        with pytest.raises(UnsupportedCamera, match=rf"cameras\.txt: camera 5.*{name}"):
            colmap.read_model(tmp_path / "text/sparse/0")


def test_colmap_photos_of_another_size_and_ending(tmp_path):
    """Photos of 2000 x 1600 with copies of a half, a quarter and an eighth: the quarter is the largest that
    is not too large."""
    binary_model(tmp_path / "sparse/0", ("a.JPG",), params=(1600, 1600, 1000, 800), size=(2000, 1600))
    copies = {"images": (2000, 1600), "images_2": (1100, 880), "images_4": (500, 400), "images_8": (250, 200)}
    for folder, size in copies.items():
        photo(tmp_path / folder / "a.png", size)
    capture = read_capture(tmp_path)
    (view,) = capture.train
    assert (view.width, view.height, view.image_path) == (500, 400, tmp_path / "images_4/a.png")
    assert project(view, POINT) == pytest.approx((350, 100))
    assert "images_4" in capture.notes[0]
    (tmp_path / "images_4/a.png").unlink()
    assert read_capture(tmp_path).train[0].width == 250


def test_colmap_without_the_full_size_photos(tmp_path):
    """Copies alone, with names of their own, as LLFF's scenes come: which photo is which is not known, unless
    LLFF's own poses are there, which go by their order."""
    binary_model(tmp_path / "sparse/0", ("IMG_9.JPG", "IMG_10.JPG"))
    photos(tmp_path / "images_2", ("image000.png", "image001.png"), (50, 40))
    with pytest.raises(NoViews, match=r"photos such as IMG_9\.JPG.* 2 others, such as images_2/image000"):
        read_capture(tmp_path)
    np.save(tmp_path / "poses_bounds.npy", llff_rows(2))
    capture = read_capture(tmp_path)
    assert capture.kind == "llff" and "by the order of their names" in capture.notes[1]


def test_colmap_photos_that_are_missing(tmp_path):
    binary_model(tmp_path / "sparse/0")
    with pytest.raises(NoViews, match=r"3 photos such as 10\.png"):
        read_capture(tmp_path)
    photos(tmp_path / "images", NAMES[:2])
    capture = read_capture(tmp_path)
    assert ([view.name for view in capture.train], capture.missing) == (["a", "2"], ("10.png",))


def test_colmap_masks(tmp_path):
    binary_model(tmp_path / "sparse/0")
    photos(tmp_path / "images")
    photo(tmp_path / "masks/b/2.png.png", channels=3)
    photo(tmp_path / "masks/a.png", channels=3)
    masks = [view.mask_path for view in read_capture(tmp_path).train]
    assert masks == [None, tmp_path / "masks/a.png", tmp_path / "masks/b/2.png.png"]


def test_colmap_photo_of_another_shape(tmp_path):
    binary_model(tmp_path / "sparse/0")
    photos(tmp_path / "images", size=(80, 100))
    with pytest.raises(BadIntrinsics, match=r"images\.bin: image 21 \(10\.png\): .*100x80.*80x100"):
        read_capture(tmp_path)


def test_every_cut_of_a_colmap_file_is_refused(tmp_path):
    folder = tmp_path / "sparse/0"
    binary_model(folder)
    photos(tmp_path / "images")
    for name in ("cameras", "images", "points3D"):
        path = folder / f"{name}.bin"
        data = path.read_bytes()
        for kept in range(len(data)):
            path.write_bytes(data[:kept])
            if name == "points3D":  # which are not needed
                model = colmap.read_model(folder)
                assert model.points is None and "points3D.bin" in model.notes[0]
                continue
            with pytest.raises(FormatError, match=rf"{name}\.bin"):
                colmap.read_model(folder)
        path.write_bytes(data)


def test_flipped_bytes_of_a_colmap_model_read_or_are_refused(tmp_path):
    folder = tmp_path / "sparse/0"
    binary_model(folder)
    for name in ("cameras", "images", "points3D"):
        path = folder / f"{name}.bin"
        data = path.read_bytes()
        for i in range(len(data)):
            path.write_bytes(data[:i] + bytes([data[i] ^ 0xC1]) + data[i + 1 :])
            try:
                colmap.read_model(folder)
            except FormatError as error:
                assert str(tmp_path) in str(error)
        path.write_bytes(data)


def test_counts_are_held_against_the_file(tmp_path):
    binary_model(tmp_path)
    for name in ("cameras", "images", "points3D"):
        path = tmp_path / f"{name}.bin"
        data = path.read_bytes()
        path.write_bytes(struct.pack("<Q", 2**62) + data[8:])
        said = "4,611,686,018,427,387,904 records do not fit"
        if name == "points3D":
            assert said in colmap.read_model(tmp_path).notes[0]
        else:
            with pytest.raises(BadModel, match=said):
                colmap.read_model(tmp_path)
        path.write_bytes(data)


BAD_TEXT = {
    "words for numbers": ("cameras.txt", "5 PINHOLE 100 80 x 80 50 40", BadModel, "line 1: found 'x'"),
    "too few parameters": ("cameras.txt", "5 PINHOLE 100 80 80 80", BadModel, "expected 4: fx fy cx cy"),
    "no focal length": ("cameras.txt", "5 PINHOLE 100 80 0 80 50 40", BadIntrinsics, "focal length of 0"),
    "a huge picture": ("cameras.txt", "5 PINHOLE 100000 80 80 80 50 40", BadIntrinsics, "100000x80"),
    "infinity": ("cameras.txt", "5 PINHOLE 100 80 inf 80 50 40", BadModel, "found 'inf'"),
    "another camera": (
        "images.txt",
        "1 1 0 0 0 0 0 0 6 a.png",
        BadModel,
        r"image 1 \(a.png\): is of camera 6",
    ),
    "no rotation": ("images.txt", "1 0 0 0 0 0 0 0 5 a.png", BadPose, r"image 1 \(a.png\)"),
    "half a line": ("images.txt", "1 1 0 0 0 0 0 0", BadModel, "line 1"),
    "observations of words": ("images.txt", "1 1 0 0 0 0 0 0 5 a.png\n1 1 x", BadModel, "line 2"),
    "no images": ("images.txt", "# none", BadModel, "images file is empty"),
}


@pytest.mark.parametrize("file, text, error, said", BAD_TEXT.values(), ids=BAD_TEXT)
def test_bad_colmap_text(tmp_path, file, text, error, said):
    text_model(tmp_path / "sparse/0")
    photos(tmp_path / "images")
    (tmp_path / "sparse/0" / file).write_text(text + "\n")
    with pytest.raises(error, match=said):
        read_capture(tmp_path)


def test_names_with_blanks(tmp_path):
    text_model(tmp_path / "sparse/0", names=("my photo.png",))
    photos(tmp_path / "images", ("my photo.png",))
    assert read_capture(tmp_path).train[0].name == "my photo"


# --- LLFF ---------------------------------------------------------------------------------------------------


def llff_rows(count: int, size=(400, 320), focal=320.0) -> np.ndarray:
    """The camera of these tests: down is world -z, right world +y, back world +x."""
    matrix = np.array([[0, 0, 1, 4], [0, 1, 0, 1], [-1, 0, 0, 2]], float)
    row = np.column_stack([matrix, [size[1], size[0], focal]]).ravel()
    return np.tile([*row, 3.0, 30.0], (count, 1))


def llff(folder: Path, count: int = 3, rows: np.ndarray | None = None) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    np.save(folder / "poses_bounds.npy", llff_rows(count) if rows is None else rows)
    photos(folder / "images_4", [f"image{i:03d}.png" for i in range(count)])


def test_llff_pixel(tmp_path):
    llff(tmp_path)
    assert is_capture(tmp_path) and is_capture(tmp_path / "poses_bounds.npy")
    for named in (tmp_path, tmp_path / "poses_bounds.npy"):
        capture = read_capture(named)
        assert (capture.kind, len(capture.train)) == ("llff", 3)
        for view in capture.train:
            assert view.camera_to_world == pytest.approx(np.array(POSE))
            assert project(view, POINT) == pytest.approx(PIXEL)
            assert (view.near, view.far) == (3, 30)
        assert "images_4" in capture.notes[0]


def test_llff_takes_the_folder_that_suits(tmp_path):
    llff(tmp_path, rows=llff_rows(3, (2000, 1600), 1600.0))
    names = [f"image{i:03d}.png" for i in range(3)]
    photos(tmp_path / "images", names, (2000, 1600))
    photos(tmp_path / "images_2", names, (1000, 800))
    photos(tmp_path / "images_20", names[:2], (200, 160))
    view = read_capture(tmp_path).train[0]
    assert (view.width, project(view, POINT)) == (1000, pytest.approx((700, 200)))


def test_llff_poses_and_photos_that_do_not_match(tmp_path):
    llff(tmp_path)
    (tmp_path / "images_4/image001.png").unlink()
    with pytest.raises(BadModel, match=r"3 poses.*0 in images, 2 in images_4"):
        read_capture(tmp_path)


def changed(column: int, value: float) -> np.ndarray:
    rows = llff_rows(3)
    rows[1, column] = value
    return rows


BAD_TABLES = {
    "NaN": (changed(3, np.nan), BadPose, "row 1"),
    "no rotation": (changed(0, 2.0), BadPose, "row 1"),
    "mirrored": (llff_rows(3) * [-1, *[1] * 4, -1, *[1] * 4, -1, *[1] * 6], BadPose, "mirrored"),
    "no focal length": (changed(14, 0.0), BadIntrinsics, "row 1"),
    "no size": (changed(4, 0.0), BadIntrinsics, "row 1"),
    "bounds the wrong way round": (changed(15, 99.0), BadIntrinsics, "bounds of 99 and 30"),
    "columns missing": (llff_rows(3)[:, :15], BadModel, "3x15 numbers"),
    "no table": (np.zeros(17), BadModel, "17 numbers"),
    "words": (np.array([["a"] * 17]), BadModel, "expected rows of 17 floats"),
    "objects": (np.full((2, 17), None), BadModel, "expected rows of 17 floats"),
}


@pytest.mark.parametrize("rows, error, said", BAD_TABLES.values(), ids=BAD_TABLES)
def test_bad_poses_bounds(tmp_path, rows, error, said):
    llff(tmp_path, rows=rows)
    with pytest.raises(error, match=said) as caught:
        read_capture(tmp_path)
    assert "poses_bounds.npy" in str(caught.value)


def test_a_table_that_is_none_or_cut(tmp_path):
    llff(tmp_path)
    path = tmp_path / "poses_bounds.npy"
    data = path.read_bytes()
    for kept in range(0, len(data), 7):
        path.write_bytes(data[:kept])
        with pytest.raises(BadModel, match=r"poses_bounds\.npy"):
            read_capture(tmp_path)
    path.write_bytes(data.replace(b"(3, 17)", b"(9999999999, 17)".ljust(7)))
    with pytest.raises(BadModel):
        read_capture(tmp_path)


# --- Polycam ------------------------------------------------------------------------------------------------


def polycam(
    folder: Path, images: str = "corrected_images", cameras: str = "corrected_cameras", **keys
) -> None:
    """Rows of Polycam's matrix are the world's y, z and x."""
    rows = [POSE[1], POSE[2], POSE[0]]
    numbers = {f"t_{i}{j}": rows[i][j] for i in range(3) for j in range(4)}
    numbers |= {"fx": 320.0, "fy": 320.0, "cx": 200.0, "cy": 160.0, "width": 400, "height": 320}
    for name in ("100.png", "99.png"):
        photo(folder / "keyframes" / images / name)
        file = folder / "keyframes" / cameras / f"{Path(name).stem}.json"
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(json.dumps({**numbers, "blur_score": 1.0, **keys}))


def test_polycam_pixel(tmp_path):
    polycam(tmp_path)
    polycam(tmp_path, "images", "cameras", fx=1.0)
    for named in (tmp_path, tmp_path / "keyframes"):
        assert is_capture(named)
        capture = read_capture(named)
        assert (capture.kind, [view.name for view in capture.train]) == ("polycam", ["99", "100"])
        for view in capture.train:
            assert project(view, POINT) == pytest.approx(PIXEL)


def test_polycam_without_corrections(tmp_path):
    polycam(tmp_path, "images", "cameras")
    assert project(read_capture(tmp_path).train[0], POINT) == pytest.approx(PIXEL)
    (tmp_path / "keyframes/images/99.png").unlink()
    assert read_capture(tmp_path).missing == ("99",)


@pytest.mark.parametrize(
    "keys, error",
    [
        ({"t_00": None}, BadPose),
        ({"t_01": 7}, BadPose),
        ({"fx": "1"}, BadIntrinsics),
        ({"fx": 0}, BadIntrinsics),
        ({"cx": float("nan")}, BadIntrinsics),
        ({"width": 0}, BadIntrinsics),
    ],
)
def test_bad_polycam(tmp_path, keys, error):
    polycam(tmp_path, **keys)
    with pytest.raises(error, match=r"99\.json"):
        read_capture(tmp_path)


# --- nerfstudio ---------------------------------------------------------------------------------------------

BIG = {"fl_x": 1600, "fl_y": 1600, "cx": 1000, "cy": 800, "w": 2000, "h": 1600}


@pytest.mark.parametrize("file", ["images/a.jpg", "./images/a.jpg", "images/deep/a.jpg"])
def test_reduced_copies_with_another_ending(tmp_path, file):
    photo(tmp_path / file.replace("a.jpg", "a.png"), (2000, 1600))
    photo(tmp_path / file.replace("images", "images_4").replace("a.jpg", "a.png"), (500, 400))
    write(tmp_path, frames=[frame(file)], **BIG)
    capture = read_capture(tmp_path)
    assert project(capture.train[0], POINT) == pytest.approx((350, 100))
    assert "images_4" in capture.notes[0] and capture.missing == ()


def test_copies_alone(tmp_path):
    photo(tmp_path / "images_8/a.png", (250, 200))
    write(tmp_path, frames=[frame("images/a.jpg")], **BIG)
    assert project(read_capture(tmp_path).train[0], POINT) == pytest.approx((175, 50))


def test_masks(tmp_path):
    """Half of the photo is dark in its mask: that is ignored, whatever the mask's levels are."""
    for i, (low, high) in enumerate([(0, 255), (0, 1), (10, 200)]):
        photo(tmp_path / f"{i}.png")
        levels = np.full((80, 100), low, np.uint8)
        levels[:, 60:] = high
        Pillow.fromarray(levels).save(tmp_path / f"mask_{i}.png")
    frames = [frame(f"{i}.png", mask_path=f"./mask_{i}.png") for i in range(3)]
    photo(tmp_path / "3.png", (20, 16))
    write(tmp_path, frames=[*frames, frame("3.png")], fl_x=80, w=100, h=80)
    views = read_capture(tmp_path).train
    loaded = load_photos(views)
    assert loaded.first.tolist() == [0, 8000, 16000, 24000, 24320]
    assert loaded.pixels.shape == (24320, 4) and loaded.photo(3, views[3]).shape == (16, 20, 4)
    expected = np.tile(np.arange(100) < 60, (80, 1))
    for i in range(3):
        assert (loaded.ignored[loaded.first[i] : loaded.first[i + 1]].reshape(80, 100) == expected).all()
        assert (load_ignored(views[i]) == expected).all()
    assert not loaded.ignored[24000:].any() and load_ignored(views[3]) is None
    assert load_photos(views[3:]).ignored is None
    clear = load_photos(views, masks="alpha")
    assert clear.ignored is None and (clear.pixels[..., 3] == np.where(loaded.ignored, 0, 255)).all()
    with pytest.raises(MixedSizes):
        load_images(views)


def test_masks_of_reduced_photos(tmp_path):
    """A full-size mask is read at the small photo's pixel centres; one from masks_4 goes before it."""
    photo(tmp_path / "images_4/a.png", (5, 4))
    levels = np.zeros((16, 20), np.uint8)
    levels[2::4, 2::4] = 255
    (tmp_path / "masks").mkdir()
    Pillow.fromarray(levels).save(tmp_path / "masks/a.png")
    write(tmp_path, frames=[frame("images/a.png", mask_path="masks/a.png")], fl_x=80, w=20, h=16)
    (view,) = read_capture(tmp_path).train
    assert not load_ignored(view).any()
    (tmp_path / "masks_4").mkdir()
    Pillow.fromarray(np.zeros((4, 5), np.uint8)).save(tmp_path / "masks_4/a.png")
    (view,) = read_capture(tmp_path).train
    assert load_ignored(view).all()


def test_masks_that_do_not_fit(tmp_path):
    photo(tmp_path / "a.png")
    photo(tmp_path / "mask.png", (50, 50))
    write(tmp_path, frames=[frame("a.png", mask_path="mask.png")], fl_x=80)
    with pytest.raises(
        BadMask, match=r"frame 0 \(a\.png\): the mask .*mask\.png is 50x50, but a\.png is 100x80"
    ):
        read_capture(tmp_path)
    (tmp_path / "mask.png").unlink()
    with pytest.raises(MissingFile, match=r"frame 0 \(a\.png\): its mask .*mask\.png"):
        read_capture(tmp_path)


def cloud(path: Path, coding: str = "ascii", points=PLACES, colour: str = "uchar") -> None:
    fields = [("x", "float"), ("y", "double"), ("z", "float"), ("nx", "short")]
    fields += [(name, colour) for name in ("red", "green", "blue")]
    said = "".join(f"property {kind} {name}\n" for name, kind in fields)
    header = (
        f"ply\nformat {coding} 1.0\ncomment made by a test\nelement vertex {len(points)}\n{said}end_header\n"
    )
    hue = (0.5, 1.0, 0.0) if colour == "float" else (127, 255, 0)
    if coding == "ascii":
        body = "".join(f"{x} {y} {z} 9 {' '.join(map(str, hue))}\n" for x, y, z in points).encode()
    else:
        order = "<" if coding == "binary_little_endian" else ">"
        layout = order + "fdfh" + ("fff" if colour == "float" else "BBB")
        body = b"".join(struct.pack(layout, *p, 9, *hue) for p in points)
    path.write_bytes(header.encode() + body)


@pytest.mark.parametrize("colour", ["uchar", "float"])
@pytest.mark.parametrize("coding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_points_of_a_ply(tmp_path, coding, colour):
    cloud(tmp_path / "p.ply", coding, colour=colour)
    points = read_ply_points(tmp_path / "p.ply")
    assert points.positions.tolist() == [list(p) for p in POINTS.values()]
    assert points.colours.tolist() == [[127, 255, 0]] * 3


def test_points_beside_other_elements(tmp_path):
    """Faces may come first, vertices may hold lists, and colours may have 16 bits."""
    header = "ply\nformat ascii 1.0\nelement face 1\nproperty list uchar int vertex_indices\n"
    header += "element vertex 2\n" + "".join(f"property float {axis}\n" for axis in "xyz")
    header += "property list uchar float weights\n"
    header += "".join(f"property ushort {hue}\n" for hue in ("red", "green", "blue"))
    rows = "3 0 1 0\n1 2 3 2 0.5 0.5 65535 0 257\n4 5 6 0 0 65535 0\n"
    (tmp_path / "p.ply").write_text(header + "end_header\n" + rows)
    points = read_ply_points(tmp_path / "p.ply")
    assert points.positions.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert points.colours.tolist() == [[255, 0, 1], [0, 255, 0]]


BAD_CLOUDS = {
    "no ply": (b"solid", BadModel),
    "no end": (b"ply\nformat ascii 1.0\n", BadModel),
    "no z": (
        b"ply\nformat ascii 1.0\nelement vertex 0\nproperty float x\nproperty float y\nend_header\n",
        BadModel,
    ),
    "coding": (b"ply\nformat zip 1.0\nelement vertex 0\nend_header\n", BadModel),
    "faces first": (b"ply\nformat ascii 1.0\nelement face 2\nend_header\n", BadModel),
    "list": (b"ply\nformat ascii 1.0\nelement vertex 1\nproperty list uchar int x\nend_header\n", BadModel),
    "negative": (b"ply\nformat ascii 1.0\nelement vertex -1\nend_header\n", BadModel),
    "huge": (b"ply\nformat ascii 1.0\nelement vertex 999999999\nend_header\n", BadModel),
}


@pytest.mark.parametrize("data, error", BAD_CLOUDS.values(), ids=BAD_CLOUDS)
def test_bad_clouds(tmp_path, data, error):
    (tmp_path / "p.ply").write_bytes(data)
    with pytest.raises(error, match=r"p\.ply"):
        read_ply_points(tmp_path / "p.ply")


@pytest.mark.parametrize("coding", ["ascii", "binary_little_endian"])
def test_every_cut_of_a_cloud(tmp_path, coding):
    path = tmp_path / "p.ply"
    cloud(path, coding)
    data = path.read_bytes().rstrip(b"\n")
    for kept in range(len(data) - 1):
        path.write_bytes(data[:kept])
        try:
            points = read_ply_points(path)
        except BadModel:
            continue
        # A text may be cut inside its last number without anyone seeing it.
        assert coding == "ascii" and points.positions.shape == (3, 3)


MOVED = [[0.0, 0, 1, 5], [1, 0, 0, 6], [0, 1, 0, 7]]


@pytest.mark.parametrize("applied", [False, True])
def test_points_come_into_the_poses_frame(tmp_path, applied):
    """Some writers apply `applied_transform` to the points, some do not: what the cameras see decides."""
    photo(tmp_path / "a.png")
    seen = np.array([(0.0, 2.0, 3.0), (1.0, 1.0, 2.0), (-9.0, 1.0, 2.0)])
    original = seen if applied else (seen - np.array(MOVED)[:, 3]) @ np.array(MOVED)[:, :3]
    cloud(tmp_path / "p.ply", points=[tuple(p) for p in original.tolist()])
    write(tmp_path, fl_x=80, ply_file_path="p.ply", applied_transform=MOVED)
    capture = read_capture(tmp_path)
    assert capture.points.positions == pytest.approx(seen)
    assert (capture.train[0].near, capture.train[0].far) == pytest.approx((3, 13), abs=0.02)


def test_points_of_the_model_that_a_capture_came_from(tmp_path):
    photo(tmp_path / "a.png")
    scale, matrix = 2.0, np.array(MOVED)
    points = {i: tuple((np.array(p) / scale - matrix[:, 3]) @ matrix[:, :3]) for i, p in POINTS.items()}
    binary_model(tmp_path / "colmap/sparse/0", points=points)
    write(tmp_path, fl_x=80, applied_transform=MOVED, applied_scale=scale)
    cloud(tmp_path / "p.ply")
    for more in ({}, {"ply_file_path": "p.ply"}):
        write(tmp_path, fl_x=80, applied_transform=MOVED, applied_scale=scale, **more)
        capture = read_capture(tmp_path)
        assert capture.kind == "transforms" and capture.notes == ()
        assert capture.points.positions == pytest.approx(np.array([POINTS[i] for i in (3, 7, 900)]))
        assert capture.train[0].seen.tolist() == [0, 1, 2]


def test_a_model_beside_a_capture_that_is_not_its_own(tmp_path):
    """Its photo would show points that lie behind it; or it is cut off."""
    photo(tmp_path / "a.png")
    cloud(tmp_path / "p.ply")
    write(tmp_path, fl_x=80, ply_file_path="p.ply", applied_transform=np.eye(4)[:3].tolist())
    binary_model(tmp_path / "sparse/0", points={i: (9.0, 1.0, 2.0) for i in range(9)})
    capture = read_capture(tmp_path)
    assert len(capture.points.positions) == 3 and capture.train[0].seen is None and capture.notes == ()
    file = tmp_path / "sparse/0/points3D.bin"
    file.write_bytes(file.read_bytes()[:-9])
    capture = read_capture(tmp_path)
    assert len(capture.points.positions) == 3 and capture.train[0].seen is None
    assert "points3D.bin" in capture.notes[0] and "is read without that model" in capture.notes[0]


@pytest.mark.parametrize("listed", ["1", [0.5], [-1], [True], {}, [10**12], [3]])
def test_points_that_a_frame_cannot_show(tmp_path, listed):
    photo(tmp_path / "a.png")
    cloud(tmp_path / "p.ply")
    write(tmp_path, fl_x=80, frames=[frame("a.png", sparse_points=[2, 0, 2])], ply_file_path="p.ply")
    assert read_capture(tmp_path).train[0].seen.tolist() == [0, 2]
    write(tmp_path, fl_x=80, frames=[frame("a.png", sparse_points=listed)], ply_file_path="p.ply")
    with pytest.raises(BadSchema, match="sparse.point"):
        read_capture(tmp_path)


def test_points_that_are_not_there(tmp_path):
    photo(tmp_path / "a.png")
    write(tmp_path, fl_x=80, ply_file_path="p.ply")
    capture = read_capture(tmp_path)
    assert capture.points is None and "p.ply" in capture.notes[0]


@pytest.mark.parametrize("matrix, scale", [([[1, 2], [3, 4]], 1), (MOVED, 0), ("x", 1), ([[0.0] * 4] * 3, 1)])
def test_bad_applied_transform(tmp_path, matrix, scale):
    photo(tmp_path / "a.png")
    cloud(tmp_path / "p.ply")
    write(tmp_path, fl_x=80, ply_file_path="p.ply", applied_transform=matrix, applied_scale=scale)
    with pytest.raises(BadSchema, match="applied_transform"):
        read_capture(tmp_path)


@pytest.mark.parametrize(
    "photos_in, model",
    [
        ("dense/images", "dense/sparse"),
        ("scans/cup/input", "scans/cup/distorted/sparse/0"),
        ("images", "out/model/0"),
    ],
)
def test_the_only_capture_below_a_folder(tmp_path, photos_in, model):
    photos(tmp_path / photos_in)
    binary_model(tmp_path / model)
    capture = read_capture(tmp_path)
    assert is_capture(tmp_path) and len(capture.train) == len(NAMES)
    assert capture.train[0].image_path.parent == tmp_path / photos_in
    assert "has no poses itself" in capture.notes[0]


def test_an_export_of_polycam_in_a_folder(tmp_path):
    polycam(tmp_path / "my scan")
    assert read_capture(tmp_path).kind == "polycam"


# --- orientation --------------------------------------------------------------------------------------------


def turned_photo(path: Path, orientation: int) -> tuple[np.ndarray, np.ndarray]:
    """A picture of 100 x 80 stored pixels with an EXIF orientation: as stored, and as it stands upright."""
    stored = np.random.default_rng(0).integers(0, 256, (80, 100, 3), np.uint8)
    exif = Pillow.Exif()
    exif[0x0112] = orientation
    Pillow.fromarray(stored).save(path, exif=exif)
    return stored, np.asarray(ImageOps.exif_transpose(Pillow.open(path)))


@pytest.mark.parametrize("centre, shown", [((40, 50), "upright"), ((50, 40), "stored"), (None, "stored")])
def test_the_orientation_whose_centre_is_the_cameras(tmp_path, centre, shown):
    """Where the file states no size; where it states no centre either, a note says what is taken."""
    pictures = dict(zip(("stored", "upright"), turned_photo(tmp_path / "a.png", 6), strict=True))
    write(tmp_path, fl_x=80, **({} if centre is None else {"cx": centre[0], "cy": centre[1]}))
    capture = read_capture(tmp_path)
    assert (load_images(capture.train)[0, ..., :3] == pictures[shown]).all()
    assert ("read as stored" in " ".join(capture.notes)) == (centre is None)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_the_orientation_whose_size_is_the_cameras(tmp_path, orientation):
    stored, upright = turned_photo(tmp_path / "a.png", orientation)
    for size in ((100, 80), (80, 100)):
        write(tmp_path, fl_x=80, w=size[0], h=size[1])
        if size == (100, 80):
            expected = stored
        elif orientation >= 5:
            expected = upright
        else:
            with pytest.raises(BadIntrinsics, match=r"80x100, but a\.png is 100x80"):
                read_capture(tmp_path)
            continue
        (view,) = read_capture(tmp_path).train
        assert (view.width, view.height) == size
        assert (load_images([view])[0, ..., :3] == expected).all()


# --- the box ------------------------------------------------------------------------------------------------


def noisy(path: Path) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    Pillow.fromarray(np.random.default_rng(1).integers(0, 256, (8, 10, 3), np.uint8)).save(path)


def ring(count: int, radius: float, centre, inward: bool = True) -> list:
    """Poses on a circle about z that look at its centre, or away from it."""
    poses = []
    for angle in 2 * np.pi * np.arange(count) / count:
        away = np.array([np.cos(angle), np.sin(angle), 0])
        back = away if inward else -away
        pose = np.eye(4)
        pose[:3] = np.stack([np.cross([0, 0, 1], back), [0, 0, 1], back, centre + radius * away], 1)
        poses.append(pose.tolist())
    return poses


def test_a_box_for_what_is_all_around(tmp_path):
    noisy(tmp_path / "a.png")
    centre = np.array([3.0, -2, 1])
    frames = posed(tmp_path, ring(9, 4, centre))
    write(tmp_path, frames=frames, fl_x=80, aabb_scale=4)
    capture = read_capture(tmp_path)
    assert capture.frame.layout == "inward" and capture.frame.distance == pytest.approx(4)
    assert capture.frame.focus == pytest.approx(centre)
    assert capture.aabb == pytest.approx([*(centre - 20), *(centre + 20)])


def test_a_box_as_large_as_the_points_say(tmp_path):
    noisy(tmp_path / "a.png")
    frames = posed(tmp_path, ring(9, 4, np.zeros(3)))
    directions = np.random.default_rng(0).normal(size=(5000, 3))
    shell = 32 * directions / np.abs(directions).max(1)[:, None]
    for scale, reach in ((1, 1.25 * 32), (0.01, 12), (100, 60)):
        cloud(tmp_path / "p.ply", points=[tuple(p) for p in (scale * shell).tolist()])
        write(tmp_path, frames=frames, fl_x=80, ply_file_path="p.ply")
        assert read_capture(tmp_path).aabb == pytest.approx([-reach] * 3 + [reach] * 3, rel=1e-5)


def test_a_room_seen_from_its_middle(tmp_path):
    noisy(tmp_path / "a.png")
    poses = ring(9, 2, np.ones(3), inward=False)
    write(tmp_path, frames=posed(tmp_path, poses), fl_x=80)
    capture = read_capture(tmp_path)
    assert capture.frame.layout == "outward"
    assert capture.aabb == pytest.approx([-9] * 3 + [11] * 3)


def test_poses_without_depth(tmp_path):
    """They have a box and can be compared with, but nothing can be learnt from them."""
    noisy(tmp_path / "a.png")
    turning = ring(9, 0, np.full(3, 7.0), inward=False)
    for poses, error, said in (
        (turning, BadPose, "all 9 photos, 00 to 08, stand at one point"),
        (ring(9, 4, np.zeros(3))[:2], NoViews, "has 2 photos to learn from, but"),
    ):
        write(tmp_path, frames=posed(tmp_path, poses), fl_x=80)
        capture = read_capture(tmp_path)
        assert (capture.aabb[3:] > capture.aabb[:3]).all()
        with pytest.raises(error, match=said):
            check_parallax(capture)
    write(tmp_path, frames=posed(tmp_path, ring(9, 1e-3, np.ones(3))), fl_x=80)
    check_parallax(read_capture(tmp_path))
    with pytest.raises(NoViews, match="has 2 photos to learn from beside 7 that only measure"):
        held = read_capture(tmp_path)
        check_parallax(replace(held, train=held.train[:2], test=held.train[2:]))


def test_photos_that_all_look_one_way(tmp_path):
    """Cameras at z = 0 looking along -z: what they show of depths 3 to 30 lies in the box."""
    rows = llff_rows(5)
    turned = np.array([[0, 1, 0], [-1, 0, 0], [0, 0, 1]], float)
    for i, row in enumerate(rows):
        row[:15] = np.column_stack([turned, [i - 2.0, 0, 0], [320, 400, 320]]).ravel()
    llff(tmp_path, 5, rows)
    for i in range(5):
        noisy(tmp_path / f"images_4/image{i:03d}.png")
    capture = read_capture(tmp_path)
    assert capture.frame.layout == "forward-facing"
    assert capture.frame.distance == pytest.approx(np.sqrt(90))
    # At depth 30 a picture of 400 x 320 pixels at f = 320 shows +-18.75 by +-15, from x = -2 to 2.
    expected = np.array([-20.75, -15, -30, 20.75, 15, -3])
    assert capture.aabb == pytest.approx(expected + 0.02 * 41.5 * np.array([-1] * 3 + [1] * 3))


@pytest.mark.parametrize("border", [0, 2])
def test_a_box_around_what_masks_cut_out(tmp_path, border):
    """Cameras at 4 from a ball of radius 0.5, whose masks are squares that just hold it; or squares to the
    very border, which tell nothing of an object."""
    noisy(tmp_path / "a.png")
    reach = 80 * 0.5 / np.sqrt(16 - 0.25)
    levels = np.zeros((2 * round(reach + border),) * 2, np.uint8)
    levels[border : len(levels) - border, border : len(levels) - border] = 255
    Pillow.fromarray(levels).save(tmp_path / "mask.png")
    Pillow.fromarray(np.tile(np.arange(len(levels), dtype=np.uint8), (len(levels), 1))).save(
        tmp_path / "a.png"
    )
    centre = np.array([3.0, -2, 1])
    frames = posed(tmp_path, ring(9, 4, centre), mask_path="mask.png")
    write(tmp_path, frames=frames, fl_x=80)
    capture = read_capture(tmp_path)
    assert capture.aabb == pytest.approx([*(centre - 20), *(centre + 20)])
    if border == 0:
        assert capture.object_aabb is None
    else:
        # Rays through the corners of a square pass its centre at root 2 times the half side, nearly.
        reach = np.abs(capture.object_aabb - [*centre, *centre])
        assert reach.min() > 0.5 and reach.max() < 0.5 * np.sqrt(2) * 1.07


# --- real captures ------------------------------------------------------------------------------------------


def test_cup():
    capture = read_capture(real("cup"))
    assert (capture.kind, len(capture.train), capture.missing, capture.opaque) == ("colmap", 77, (), True)
    assert capture.points.positions.shape == (9262, 3) and capture.frame.layout == "inward"
    assert load_images(capture.train[:2]).shape == (2, 600, 800, 4)


def colour_error(capture, step: int) -> float:
    """Mean difference of the points' colours and the pixels they fall on, over some views."""
    errors = []
    for view in capture.train[::step]:
        picture = load_images([view])[0, ..., :3].astype(int)
        local = (capture.points.positions - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]
        before = local[:, 2] < 0
        x, y, depth = local[before, 0], local[before, 1], -local[before, 2]
        column, row = view.cx + view.fl_x * x / depth, view.cy - view.fl_y * y / depth
        seen = (column >= 0) & (column < view.width) & (row >= 0) & (row < view.height)
        at = picture[row[seen].astype(int), column[seen].astype(int)]
        errors.append(np.abs(at - capture.points.colours[before][seen]).mean())
    return float(np.mean(errors))


@pytest.mark.parametrize("name", ["cup", "bear"])
def test_points_fall_on_pixels_of_their_colour(name):
    """Far better than on the pixels of mirrored pictures, which have the same colours elsewhere."""
    capture = read_capture(real(name))
    right = colour_error(capture, 16)
    mirrored = capture.points.positions * [1, 1, -1]
    object.__setattr__(capture, "points", type(capture.points)(mirrored, capture.points.colours))
    assert right < 0.75 * colour_error(capture, 16)


def test_fern():
    capture = read_capture(real("fern"))
    assert (capture.kind, len(capture.train), capture.frame.layout) == ("llff", 20, "forward-facing")
    view = capture.train[0]
    assert (view.width, view.height, view.fl_x) == (504, 378, pytest.approx(3260.52633 / 8))
    assert view.near > 15 and view.far < 100


def test_tankard():
    capture = read_capture(real("tankard"))
    ignored = load_photos(capture.train[:5]).ignored.reshape(5, 400, 400)
    assert not ignored[:, 200, 200].any() and ignored[:, 0, 0].all()


def test_sceaux():
    assert is_capture(real("sceaux"))
    with pytest.raises(NoPoses, match="COLMAP"):
        read_capture(real("sceaux"))


@pytest.mark.parametrize("name", ["colmap", "sparse", "7"])
def test_a_capture_may_be_called_as_models_folders_are(tmp_path, name):
    """Its own photos are taken, not those of a capture beside it."""
    for capture in (name, "other"):
        binary_model(tmp_path / capture / "sparse/0", ("a.png", "b.png"), apart=1.0)
        photos(tmp_path / capture / "images", ("a.png", "b.png"))
    read = read_capture(tmp_path / name)
    assert [view.image_path.parent for view in read.train] == [tmp_path / name / "images"] * 2
    assert len(read_capture(tmp_path / name / "sparse/0").train) == 2
