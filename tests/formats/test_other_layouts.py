"""NSVF, ScanNet, 7-Scenes and OpenSfM: one point on one pixel, and a sentence for what cannot be read."""

import json
from pathlib import Path

import numpy as np
import pytest

from formats.captures import is_capture, read_capture
from formats.errors import BadIntrinsics, BadModel, BadPose, MissingFile, UnsupportedCamera
from formats.overview import overview
from tests.formats.test_captures import PIXEL, POINT, POSE, photo, project
from tests.formats.test_readers import TO_CAMERA, TRANSLATION

TO_WORLD = np.array(POSE) * [1, -1, -1, 1]
"""x right, y down, z forward."""
MATRIX = "80 0 50 0\n0 80 40 0\n0 0 1 0\n0 0 0 1\n"
LENSES = {
    "4x4": MATRIX,
    "3x3": "80 0 50\n0 80 40\n0 0 1\n",
    "NSVF's own": "80. 50. 40. 0.\n0. 0. 0.\n0.\n1.\n80 100\n",
    "NSVF's own, without a size": "80. 50. 40. 0.\n0. 0. 0.\n0.\n1.\n",
}


def text(matrix=TO_WORLD) -> str:
    return "\n".join("\t".join(f"{x:.8e}" for x in row) for row in np.asarray(matrix)) + "\n"


def nsvf(folder: Path, names=("0_0000", "0_0001", "1_0000", "2_0000"), lens=MATRIX, box="-1 -2 0 1 2 3 0.1"):
    for i, name in enumerate(names):
        photo(folder / f"rgb/{name}.png", level=40 + i)
        (folder / "pose").mkdir(exist_ok=True, parents=True)
        (folder / f"pose/{name}.txt").write_text(text())
    (folder / "intrinsics.txt").write_text(lens)
    (folder / "bbox.txt").write_text(box)
    return folder


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_nsvf_pixel(tmp_path, lens):
    assert is_capture(nsvf(tmp_path, lens=lens))
    capture = read_capture(tmp_path)
    assert [view.name for view in capture.train] == ["0_0000", "0_0001"]
    assert [view.name for view in capture.test] == ["2_0000"]
    assert "1 photos to validate with, such as 1_0000, are not used" in " ".join(capture.notes)
    for view in capture.train + capture.test:
        assert project(view, POINT) == pytest.approx(PIXEL)


def test_nsvf_without_test_photos(tmp_path):
    capture = read_capture(nsvf(tmp_path, ("0_a", "0_0", "1_0")))
    assert len(capture.train) == 3  # names that say nothing
    (tmp_path / "pose/0_a.txt").unlink()
    assert [view.name for view in read_capture(tmp_path).test] == ["1_0"]


def test_scannet_pixel(tmp_path):
    for i in range(3):
        photo(tmp_path / f"color/{i}.png", level=40 + i)
        (tmp_path / "pose").mkdir(exist_ok=True)
        (tmp_path / f"pose/{i}.txt").write_text(text())
    (tmp_path / "intrinsic").mkdir()
    with pytest.raises(MissingFile, match="has poses but no focal length"):
        read_capture(tmp_path)
    (tmp_path / "intrinsic/intrinsic_color.txt").write_text(MATRIX)
    assert [project(view, POINT) for view in read_capture(tmp_path).train] == [pytest.approx(PIXEL)] * 3


def test_7_scenes_pixel(tmp_path):
    """Its focal length of 585 is for photos of 640 pixels; lost frames are left out."""
    lost = np.full((4, 4), np.inf)
    for i in range(10):
        photo(tmp_path / f"frame-{i:06d}.color.png", (64, 48), level=40 + i)
        photo(tmp_path / f"frame-{i:06d}.depth.png", (64, 48), level=3)
        (tmp_path / f"frame-{i:06d}.pose.txt").write_text(text(lost if i == 3 else TO_WORLD))
    assert is_capture(tmp_path)
    capture = read_capture(tmp_path)
    assert len(capture.train) == 9
    assert project(capture.train[0], POINT) == pytest.approx((32 + 58.5 / 4, 24 - 58.5 / 4))
    notes = " ".join(capture.notes)
    assert "frame-000003.pose.txt: the camera's pose was lost" in notes
    assert "that of 7-Scenes is taken, 585 pixels of a photo 640 wide" in notes
    (tmp_path / "camera-intrinsics.txt").write_text("40 0 32\n0 40 24\n0 0 1")
    assert read_capture(tmp_path).train[0].fl_x == 40


@pytest.mark.parametrize(
    "file, content, error, said",
    [
        ("pose/0_0000.txt", "1 2 3", BadPose, "3 numbers, expected 4x4"),
        ("pose/0_0000.txt", "a b c", BadModel, "expected numbers"),
        ("pose/0_0000.txt", text(np.diag([1, 1, -1, 1])), BadPose, "mirrored"),
        ("intrinsics.txt", "", BadIntrinsics, "0 numbers"),
        ("intrinsics.txt", "nan 1 2", BadIntrinsics, "no focal lengths"),
        ("bbox.txt", "1 1 1 0 0 0", BadModel, "six sides"),
    ],
)
def test_bad_texts(tmp_path, file, content, error, said):
    nsvf(tmp_path)
    (tmp_path / file).write_text(content)
    with pytest.raises(error, match=said):
        read_capture(tmp_path)


# --- OpenSfM ------------------------------------------------------------------------------------------------

CAMERA = {"projection_type": "brown", "width": 100, "height": 80, "focal_x": 0.8, "focal_y": 0.8}
CAMERA |= {"c_x": 0.0, "c_y": 0.0, "k1": 0.0, "k2": 0.0, "p1": 0.0, "p2": 0.0, "k3": 0.0}
TURN = np.array([1, 1, -1]) * 2 * np.pi / 3 / np.sqrt(3)
"""Axis times angle of TO_CAMERA, a third of a turn about a diagonal."""


def shots(names, **camera) -> dict:
    shot = {"rotation": TURN.tolist(), "translation": TRANSLATION.tolist(), "camera": "phone"}
    points = {"1": {"coordinates": POINT.tolist(), "color": [9.0, 8.0, 300.0]}, "2": {"coordinates": None}}
    return {"cameras": {"phone": CAMERA | camera}, "shots": dict.fromkeys(names, shot), "points": points}


def opensfm(folder: Path, parts, names=("a.png", "b.png", "c.png"), where="") -> Path:
    for i, name in enumerate(names):
        photo(folder / "images" / name, level=40 + i)
    (folder / where).mkdir(exist_ok=True, parents=True)
    (folder / where / "reconstruction.json").write_text(json.dumps(parts))
    return folder


def test_the_turn_of_these_tests():
    x, y, z = TURN / np.linalg.norm(TURN)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.linalg.norm(TURN)
    assert np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross == pytest.approx(TO_CAMERA)


@pytest.mark.parametrize("where", ["", "opensfm"])
def test_opensfm_pixel(tmp_path, where):
    opensfm(tmp_path, [shots("x"), shots(("a.png", "b.png", "c.png"))], where=where)
    assert is_capture(tmp_path) and is_capture(tmp_path / where / "reconstruction.json")
    for named in (tmp_path, tmp_path / where / "reconstruction.json"):
        capture = read_capture(named)
        assert [view.name for view in capture.train] == ["a", "b", "c"]
        assert [project(view, POINT) for view in capture.train] == [pytest.approx(PIXEL)] * 3
        assert capture.points.positions.tolist() == [POINT.tolist()]
        assert capture.points.colours.tolist() == [[9, 8, 255]]
        assert "the reconstruction of 3 photos is read, and not those of 1" in " ".join(capture.notes)


def test_opensfm_lenses(tmp_path):
    opensfm(tmp_path, [shots(("a.png",), k1=0.1, k2=0.2, p1=0.3, p2=0.4, k3=0.5, c_x=0.1, c_y=-0.05)])
    (view,) = read_capture(tmp_path).train
    assert view.distortion == (0.1, 0.2, 0.5, 0.3, 0.4)
    assert (view.cx, view.cy) == pytest.approx((60, 35))
    opensfm(tmp_path, [shots(("a.png",), projection_type="fisheye", focal=0.5, focal_x=0, focal_y=0, k1=0.1)])
    (view,) = read_capture(tmp_path).train
    assert view.fisheye and view.distortion == (0.1, 0, 0, 0) and view.fl_x == view.fl_y == 50
    opensfm(tmp_path, [shots(("a.png",), projection_type="spherical")])
    with pytest.raises(UnsupportedCamera, match="spherical"):
        read_capture(tmp_path)


BROKEN = {
    "no shots": [{"cameras": {}, "shots": {}}],
    "a camera that is not there": [shots(("a.png",)) | {"cameras": {}}],
    "cameras that are no object": [shots(("a.png",)) | {"cameras": 3}],
    "a focal length in letters": [shots(("a.png",), focal_x="wide")],
}


@pytest.mark.parametrize("parts", BROKEN.values(), ids=BROKEN)
def test_bad_opensfm(tmp_path, parts):
    with pytest.raises((BadModel, BadIntrinsics), match=r"reconstruction\.json"):
        read_capture(opensfm(tmp_path, parts))


def test_overview(tmp_path):
    assert overview(nsvf(tmp_path / "nsvf"))["kind"] == "pose files"
    assert overview(opensfm(tmp_path / "sfm", [shots(("a.png",))]))["points"] == 1
