"""Lists of poses with slips: what can be mended is, a few broken frames are left out, and both are said."""

import json
import re
import struct
import time
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from formats.cameras import JSON_TOKEN, read_cameras, read_document
from formats.captures import read_capture
from formats.colmap import read_model
from formats.colmap_points import binary_points
from formats.errors import (
    BadImage,
    BadIntrinsics,
    BadJson,
    BadModel,
    BadPose,
    BadSchema,
    LimitExceeded,
    NoViews,
)
from formats.names import distinct_names, is_name
from formats.photos import natural
from formats.points import MAX_POINTS, read_ply_points
from formats.transforms import read_splits, sparse_points
from tests.formats.test_captures import POINT, looking_at, photo, project
from tests.formats.test_readers import (
    NAMES,
    POINTS,
    binary_model,
    cloud,
    llff,
    llff_rows,
    photos,
    polycam,
    text_model,
)

EYES = [[4 * np.cos(a), 4 * np.sin(a), 1 + 0.3 * np.sin(3 * a)] for a in np.arange(12) * np.pi / 6]
POSES = [np.array(looking_at(eye, np.zeros(3))) for eye in EYES]


def capture(folder: Path, change=lambda i, pose: pose.tolist(), more=lambda i: {}, count: int = 12, **keys):
    """A capture whose pose i is what `change` makes of it."""
    frames = []
    for i, pose in enumerate(POSES[:count]):
        photo(folder / f"{i}.png", level=20 * i)
        frames.append({"file_path": f"{i}.png", "transform_matrix": change(i, pose.copy()), **more(i)})
    text = json.dumps(
        {"fl_x": 80, "fl_y": 80, "cx": 50, "cy": 40, "w": 100, "h": 80, **keys, "frames": frames}
    )
    (folder / "transforms.json").write_text(text)
    return folder


def said(read) -> str:
    return " ".join(read.notes)


# --- poses --------------------------------------------------------------------------------------------------

SLIPS = {
    "scaled": (lambda i, pose: (pose @ np.diag([1.7, 1.7, 1.7, 1])).tolist(), 1e-9, "12 photos.*scaled axes"),
    "stretched": (lambda i, pose: (pose @ np.diag([1, 2, 3, 1])).tolist(), 1e-9, "scaled axes"),
    "three decimals": (lambda i, pose: pose.round(3).tolist(), 1e-3, "are rounded, and the nearest"),
    "two decimals": (lambda i, pose: pose.round(2).tolist(), 1e-2, "12 photos.*are rounded"),
    "six decimals": (lambda i, pose: pose.round(6).tolist(), 1e-6, None),
    "texts": (lambda i, pose: [[str(x) for x in row] for row in pose], 1e-9, None),
    "in one row": (lambda i, pose: pose.ravel().tolist(), 1e-9, None),
}


@pytest.mark.parametrize("change, within, note", SLIPS.values(), ids=SLIPS)
def test_poses_that_are_mended(tmp_path, change, within, note):
    """The rotation nearest to each; where the camera stands is as the file says."""
    read = read_capture(capture(tmp_path, change))
    found = np.array([view.camera_to_world for view in read.train])
    order = [int(view.name) for view in read.train]
    np.testing.assert_allclose(found, np.array(POSES)[order], rtol=0, atol=within)
    turns = found[:, :3, :3]
    np.testing.assert_allclose(turns.transpose(0, 2, 1) @ turns, np.tile(np.eye(3), (12, 1, 1)), atol=3e-4)
    assert re.search(note, said(read)) if note else read.notes == ()


BROKEN = {
    "NaN": (lambda pose: pose * np.nan, "NaN"),
    "null": (lambda pose: None, "no camera pose"),
    "mirrored": (lambda pose: pose @ np.diag([-1, 1, 1, 1.0]), "mirrored"),
    "transposed": (np.transpose, "transposed"),
    "far away": (lambda pose: pose + np.pad([[1e14]], ((0, 3), (3, 0))), "1e\\+14 from the world's origin"),
    "one decimal": (lambda pose: pose.round(1), "no rotation"),
}


@pytest.mark.parametrize("change, why", BROKEN.values(), ids=BROKEN)
def test_a_few_broken_poses_are_left_out_and_named(tmp_path, change, why):
    def changed(broken):
        return lambda i, pose: np.array(change(pose) if i in broken else pose).tolist()

    read = read_capture(capture(tmp_path, changed({1})))
    assert len(read.train) == 11 and re.search(rf"frame 1 \(1\.png\): .*{why}.*left out", said(read))
    assert len(read_capture(capture(tmp_path, changed({1, 4}))).train) == 10
    with pytest.raises(BadPose, match=why):  # more than a few
        read_capture(capture(tmp_path, changed({1, 4, 7})))


def test_a_broken_photo_or_lens_leaves_its_frame_out(tmp_path):
    capture(tmp_path, more=lambda i: {"fl_x": "80"} if i == 2 else {})
    (tmp_path / "0.png").write_text("<html>")
    read = read_capture(tmp_path)
    assert len(read.train) == 10
    assert re.search(r"/0\.png: .* \(its frame is left out\)", said(read))
    assert "fl_x is the text '80'" in said(read)


def test_frames_that_are_listed_again(tmp_path):
    """With the pose of the first they are one; with another nobody knows which is right."""
    capture(tmp_path)
    file = tmp_path / "transforms.json"
    document = json.loads(file.read_text())
    again = document["frames"] + [
        document["frames"][0] | {"file_path": "./x/../0.png"},
        document["frames"][1],
    ]
    (tmp_path / "x").mkdir()
    file.write_text(json.dumps(document | {"frames": again}))
    read = read_capture(tmp_path)
    assert len(read.train) == 12 and "2 frames are listed again" in said(read)
    moved = document["frames"][0] | {"transform_matrix": POSES[3].tolist()}
    file.write_text(json.dumps(document | {"frames": [*document["frames"], moved]}))
    read = read_capture(tmp_path)
    assert "0" not in [view.name for view in read.train] and "0.png is listed 2 times" in said(read)
    file.write_text(
        json.dumps(document | {"frames": [f | {"file_path": "0.png"} for f in document["frames"]]})
    )
    with pytest.raises(BadPose, match="0.png is listed 12 times, with different poses"):
        read_capture(tmp_path)


def test_frames_that_are_none(tmp_path):
    capture(tmp_path)
    file = tmp_path / "transforms.json"
    document = json.loads(file.read_text())
    for frames in ([None], [{"transform_matrix": POSES[0].tolist()}], [{"file_path": 3}]):
        file.write_text(json.dumps(document | {"frames": document["frames"] + frames}))
        assert "1 frame has no file_path" in said(read_capture(tmp_path))
    file.write_text(json.dumps(document | {"frames": [None, 3]}))
    with pytest.raises(BadSchema, match="list of objects"):
        read_capture(tmp_path)
    file.write_text(json.dumps(document | {"frames": []}))
    with pytest.raises(NoViews, match='"frames" is empty'):
        read_capture(tmp_path)


# --- files of text ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("coding", ["utf-8-sig", "utf-16", "utf-16-be", "utf-32"])
def test_byte_order_marks(tmp_path, coding):
    file = capture(tmp_path) / "transforms.json"
    mark = "\ufeff" if coding == "utf-16-be" else ""
    file.write_bytes((mark + file.read_text()).encode(coding))
    assert len(read_capture(tmp_path).train) == 12


def test_slips_in_json_are_named_by_line(tmp_path):
    file = tmp_path / "transforms.json"
    for text, where in (
        ('{"a": 1,\n}', r"line 2 column 1.*remove a comma"),
        ('{"a": [1,\n2,]}', r"line 2 column 3.*remove a comma"),
        ('// one\n/* two\nthree */ {"a": "// no",\n}', r"line 4 column 1"),
        ('{"a": "\n', r"line 1 column 8"),
        ("", "the file is empty"),
    ):
        file.write_text(text)
        with pytest.raises(BadJson, match=where):
            read_document(file)
    file.write_bytes('{"ä": 1}'.encode("latin-1"))
    with pytest.raises(BadJson, match="save it as UTF-8"):
        read_document(file)


@pytest.mark.parametrize("text", ['"' + '\\"' * 200_000, "/*" * 200_000, '"a" /*' * 100_000, "//" * 200_000])
def test_comments_are_looked_for_in_one_pass(text):
    """Tokens lie one after the other and cover every quote and slash, so no byte is looked at again."""
    started, end = time.process_time(), 0
    for token in JSON_TOKEN.finditer(text):
        assert not set(text[end : token.start()]) & set('"/')
        end = token.end()
    assert end == len(text) and time.process_time() - started < 20  # quadratic: minutes


def test_too_many_values(tmp_path):
    (tmp_path / "a.json").write_text(json.dumps({"frames": list(range(12))}))
    with pytest.raises(LimitExceeded, match="more than 10 values"):
        read_document(tmp_path / "a.json", 10)


# --- numbers ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "keys", [{"fl_x": 1e-300}, {"fl_x": 1e300}, {"k1": 1e300}, {"cx": -1e20}, {"x_fov": 1e-9}]
)
def test_lenses_that_no_camera_has(tmp_path, keys):
    with pytest.raises(BadIntrinsics, match=r"frame 0 \(0\.png\)"):
        read_capture(capture(tmp_path, **keys))


@pytest.mark.parametrize("name", ["9" * 5000, "a\0b", "/", "", "\ud800", "x\n", "\u202e", "..", "ü" * 150])
def test_names_that_no_picture_can_have(tmp_path, name):
    """Cameras are named by them all the same, and differ."""
    names = distinct_names([name, name, f"{name[:40]}_00001", f"{name[:40]}_00002", name])
    assert len(set(names)) == 5 and all(map(is_name, names))
    frames = [{"file_path": name, "transform_matrix": POSES[i].tolist()} for i in range(3)]
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"fl_x": 80, "w": 100, "h": 80, "frames": frames}))
    named = [view.name for view in read_cameras(file)]
    assert len(set(named)) == 3 and all(map(is_name, named))


def test_natural_order_of_any_number_of_digits():
    names = ["a2", "a10", "a010", "a" + "9" * 6000, "a1" + "0" * 6000, "b", "a"]
    assert sorted(names, key=natural) == ["a", "a2", "a10", "a010", names[3], names[4], "b"]


# --- COLMAP -------------------------------------------------------------------------------------------------


def edited(folder: Path, change, name: str = "images") -> list:
    text_model(folder)
    file = folder / f"{name}.txt"
    file.write_bytes(
        change(file.read_text()).encode() if isinstance(change(""), str) else change(file.read_text())
    )
    return [image.name for image in read_model(folder).images]


def observed(text: str) -> list[str]:
    return [line for line in text.split("\n") if line and not line.startswith("1.5 2.5")]


TEXTS = {
    "without observations": lambda text: "\n".join(observed(text)),
    "without observations, CRLF": lambda text: "\r\n".join(observed(text)),
    "CRLF": lambda text: text.replace("\n", "\r\n"),
    "CR": lambda text: text.replace("\n", "\r"),
    "tabs": lambda text: text.replace(" ", "\t"),
    "a mark": lambda text: "\ufeff" + text,
    "UTF-16": lambda text: text.encode("utf-16"),
    "comments between": lambda text: text.replace("\n", "\n# more\n"),
    "lines without end": lambda text: text.rstrip("\n"),
}


@pytest.mark.parametrize("change", TEXTS.values(), ids=TEXTS)
def test_texts_of_a_model(tmp_path, change):
    assert edited(tmp_path, change) == list(NAMES)


def test_a_text_without_some_observations(tmp_path):
    """The lines of points belong to the images before them."""
    lines = [line for line in text_lines(tmp_path) if line]  # the first image has an empty line
    (tmp_path / "images.txt").write_text("\n".join(lines))
    counts = [len(image.view.seen) for image in read_model(tmp_path).images]
    assert counts == [0, 3, 3]


def text_lines(folder: Path) -> list[str]:
    text_model(folder)
    return (folder / "images.txt").read_text().split("\n")


def test_decimal_commas_are_named(tmp_path):
    with pytest.raises(
        BadModel, match=r"images\.txt: line 2: found '0,5', expected a number; write decimals"
    ):
        edited(tmp_path, lambda text: text.replace("0.5", "0,5"))


@pytest.mark.parametrize("camera", ["5 pinhole 100 80 80 80 50 40", "5 PINHOLE 100.0 80.0 80 80 50 40"])
def test_cameras_written_by_hand(tmp_path, camera):
    text_model(tmp_path, camera=camera)
    assert project(read_model(tmp_path).images[0].view, POINT) == pytest.approx((70, 20))


def test_names_keep_their_blanks(tmp_path):
    text_model(tmp_path, names=("my  photo 1.png", "2 3 4", "00 1"))
    assert [image.name for image in read_model(tmp_path).images] == ["my  photo 1.png", "2 3 4", "00 1"]


def test_a_broken_image_of_many_is_left_out(tmp_path):
    names = [f"{i}.png" for i in range(6)]
    text_model(tmp_path / "sparse/0", names=names)
    photos(tmp_path / "images", names)
    file = tmp_path / "sparse/0/images.txt"
    file.write_text(file.read_text().replace("\n4 0.5 0.5", "\n4 nan 0.5"))
    read = read_capture(tmp_path)
    assert [view.name for view in read.train] == ["0", "1", "2", "4", "5"]
    assert re.search(r"image 4 \(3\.png\): its pose is not a rotation.*left out", said(read))


def test_the_largest_model_is_read(tmp_path):
    names = [f"{i}.png" for i in range(12)]
    photos(tmp_path / "images", names)
    for place, part in (("0", names[:2]), ("1", names[2:9]), ("10", names[9:]), ("2", names[:1])):
        binary_model(tmp_path / "sparse" / place, part)
    read = read_capture(tmp_path)
    assert len(read.train) == 7
    assert "sparse/1, a model of 7 photos, is read, and not sparse/10 of 3, sparse/0 of 2" in said(read)
    assert len(read_capture(tmp_path / "sparse/10").train) == 3
    assert "and not" not in said(read_capture(tmp_path / "sparse/10"))
    assert len(read_capture(tmp_path / "sparse").train) == 7


# --- points -------------------------------------------------------------------------------------------------


def many_points(folder: Path, coding: str, count: int) -> dict:
    """A model whose point i lies at (i, 0, 0)."""
    places = {i: (float(i), 0.0, 0.0) for i in range(count)}
    if coding == "binary":
        binary_model(folder, points=places)
    else:
        text_model(folder)
        lines = [f"{i} {float(i)} 0 0 1 2 3 0.5 1 0\n" for i in places]
        (folder / "points3D.txt").write_text("".join(lines))
        file = folder / "images.txt"
        file.write_text(file.read_text().replace("2.5 900", "2.5 9"))
    return places


@pytest.mark.parametrize("coding", ["binary", "text"])
@pytest.mark.parametrize("count, step", [(10, 1), (11, 2), (20, 2), (95, 10)])
def test_points_beyond_a_limit_are_thinned(tmp_path, coding, count, step):
    many_points(tmp_path, coding, count)
    model = read_model(tmp_path, most_points=10)
    assert model.points.positions[:, 0].tolist() == list(range(0, count, step))
    assert (model.notes == ()) == (step == 1) and (step == 1 or f"one in {step} is read" in model.notes[0])
    seen = model.images[1].view.seen
    known = set(range(count)) if coding == "binary" else {3, 7, 9}
    assert seen.tolist() == [i // step for i in sorted(known) if i % step == 0]


@pytest.mark.parametrize("coding", ["ascii", "binary_little_endian", "binary_big_endian"])
def test_points_of_a_cloud_are_thinned(tmp_path, coding):
    cloud(tmp_path / "p.ply", coding, points=[(float(i), 0.0, 0.0) for i in range(25)])
    found = read_ply_points(tmp_path / "p.ply", 10)
    assert found.positions[:, 0].tolist() == [0, 3, 6, 9, 12, 15, 18, 21, 24] and found.thinned == 3
    capture(tmp_path, more=lambda i: {"sparse_points": [i, 6]}, ply_file_path="p.ply")
    file = tmp_path / "transforms.json"
    document, train, _ = read_splits(file, tmp_path, None)
    sparse = sparse_points(file, document, train.views, 10)
    assert "one in 3 is read, 9 in all" in said(sparse)
    assert [view.seen.tolist() for view in sparse.told(file, train.views)[:4]] == [[0, 2], [2], [2], [1, 2]]


def test_points_are_gathered_block_by_block(tmp_path):
    """A track of any length lies between them."""
    data = struct.pack("<Q", 7)
    for i in range(7):
        data += struct.pack("<Q3d3BdQ", 70 - i, i, 2 * i, 3 * i, i, i, i, 0.25 * i, i) + bytes(8 * i)
    found = binary_points(MAX_POINTS, tmp_path, data, block=3).points
    assert found.positions.tolist() == [[i, 2 * i, 3 * i] for i in reversed(range(7))]
    assert found.colours[:, 0].tolist() == [6, 5, 4, 3, 2, 1, 0]


@pytest.mark.parametrize("data", [b"", b"ply\n", b"\0" * 99], ids=["empty", "header", "zeros"])
def test_damaged_points_are_left_out(tmp_path, data):
    binary_model(tmp_path / "a/sparse/0", [f"{i}.png" for i in range(6)])
    photos(tmp_path / "a/images", [f"{i}.png" for i in range(6)])
    (tmp_path / "a/sparse/0/points3D.bin").write_bytes(data)
    capture(tmp_path / "b", ply_file_path="p.ply")
    (tmp_path / "b/p.ply").write_bytes(data)
    for folder, file in (("a", "points3D.bin"), ("b", "p.ply")):
        read = read_capture(tmp_path / folder)
        if not (folder == "a" and data == b"\0" * 99):  # no points at all, and more bytes
            assert read.points is None and file in said(read)


def test_points_at_another_computers_path(tmp_path):
    cloud(tmp_path / "p.ply")
    read = read_capture(capture(tmp_path, ply_file_path="C:\\scan\\p.ply"))
    assert len(read.points.positions) == len(POINTS)


# --- LLFF and Polycam ---------------------------------------------------------------------------------------


def test_one_row_of_many(tmp_path):
    rows = llff_rows(6)
    rows[2, 3] = np.nan
    llff(tmp_path, 6, rows)
    (tmp_path / "images_4/image004.png").write_bytes(b"")
    read = read_capture(tmp_path)
    assert [view.name for view in read.train] == [f"image00{i}" for i in (0, 1, 3, 5)]
    assert read.missing == ("image004.png",) and "row 2 (image002.png): holds NaN" in said(read)
    assert "the photos of images_4 by the order of their names, image000.png to image005.png" in said(read)


def test_polycam_without_sizes(tmp_path):
    """As its newest export: the photos tell."""
    polycam(tmp_path, width=None, height=None)
    (tmp_path / "keyframes/corrected_cameras/._99.json").write_bytes(b"\0\5\26\7")
    (tmp_path / "keyframes/corrected_images/._99.png").write_bytes(b"\0\5\26\7")
    for file in (tmp_path / "keyframes/corrected_images").glob("[0-9]*"):
        photo(file, (400, 320))
    read = read_capture(tmp_path)
    assert [view.name for view in read.train] == ["99", "100"] and read.notes == ()
    assert project(read.train[0], POINT) == pytest.approx((280, 80))


def test_polycam_without_corrected_photos(tmp_path):
    polycam(tmp_path, "images", "cameras")
    (tmp_path / "keyframes/corrected_cameras").mkdir()
    assert "corrected_cameras is not used" in said(read_capture(tmp_path))


# --- photos that were cut off -------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", ["png", "jpg"])
def test_a_photo_that_is_cut_off_is_left_out(tmp_path, ending):
    folder = capture(tmp_path)
    pixels = np.random.default_rng(0).integers(0, 256, (80, 100, 3), np.uint8)
    Image.fromarray(pixels).save(tmp_path / f"4.{ending}")
    if ending != "png":
        (tmp_path / "4.png").unlink()
    whole = (tmp_path / f"4.{ending}").read_bytes()
    (tmp_path / f"4.{ending}").write_bytes(whole[: len(whole) // 2])
    read = read_capture(folder)
    assert [view.name for view in read.train] == [str(i) for i in range(12) if i != 4]
    assert f"4.{ending}: the file is cut off; copy it again, or remove it (its frame is left out)" in said(
        read
    )
    for i in (7, 8):
        (tmp_path / f"{i}.png").write_bytes((tmp_path / f"{i}.png").read_bytes()[:-30])
    with pytest.raises(BadImage, match=rf"4\.{ending}: the file is cut off"):
        read_capture(folder)


def test_a_photo_with_more_behind_its_end_is_whole(tmp_path):
    """As a phone's film behind its photo."""
    folder = capture(tmp_path)
    (tmp_path / "3.png").write_bytes((tmp_path / "3.png").read_bytes() + bytes(9000))
    assert len(read_capture(folder).train) == 12


def test_damaged_points_are_told(tmp_path):
    at = np.arange(30.0).reshape(10, 3)
    at[4, 1], at[7, 0] = np.nan, np.inf
    lines = "".join(f"{x} {y} {z}\n" for x, y, z in at)
    head = "ply\nformat ascii 1.0\nelement vertex 10\n" + "".join(f"property float {a}\n" for a in "xyz")
    (tmp_path / "points.ply").write_text(f"{head}end_header\n{lines}")
    read = read_capture(capture(tmp_path, ply_file_path="points.ply"))
    assert len(read.points.positions) == 8
    assert "points.ply: 2 sparse points are NaN, infinite or beyond 1e30, and left out" in said(read)
