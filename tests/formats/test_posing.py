"""Poses out of photos: what is compared, which way is up, what is said; and with pycolmap, the poses."""

import json
import os
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from PIL import Image as Pillow

from formats import posing
from formats.captures import read_capture
from formats.colmap_worker import ALIKE, NEIGHBOURS, matching_pairs
from formats.errors import BadImage, MissingExtra, MissingFile, NoPoses, NotACapture, NoViews, PosingFailed
from formats.images import read_focal, write_smaller
from formats.overview import overview
from formats.points import SparsePoints, read_ply_points, write_ply_points
from formats.posing import DISTANCE, PosedPhotos, estimate, photos_to_pose, upright, write_posed
from formats.views import View
from fusedrf_cli.progress import NullProgress
from tests.formats import corner
from tests.formats.test_captures import POSE, photo, real
from tests.formats.test_readers import ring

ROOT = Path(__file__).parents[2]
with_pycolmap = pytest.mark.skipif(
    find_spec("pycolmap") is None, reason="pycolmap is not installed (the extra fusedrf[capture])"
)


class ObjectCues(NullProgress):
    """Keeps the phases, and how far each came."""

    def __init__(self):
        super().__init__()
        self.phases: dict[str, list] = {}

    def phase(self, name, total=None):
        self.phases[name] = [total]

    def advance(self, done, **figures):
        list(self.phases.values())[-1].append(done)


# --- photos -------------------------------------------------------------------------------------------------


def test_photos_are_found_in_natural_order(tmp_path):
    for name in ("p10.png", "p9.png", "p1.JPG"):
        Pillow.new("RGB", (8, 8)).save(tmp_path / name)
    (tmp_path / "notes.txt").write_text("")
    assert [file.name for file in photos_to_pose(tmp_path)] == ["p1.JPG", "p9.png", "p10.png"]
    (tmp_path / "images").mkdir()
    shutil.move(tmp_path / "p9.png", tmp_path / "images")
    with pytest.raises(NoViews, match="holds 2 photos, but"):
        photos_to_pose(tmp_path)
    for name in ("p1.JPG", "p10.png"):
        shutil.move(tmp_path / name, tmp_path / "images")
    assert len(photos_to_pose(tmp_path)) == 3


def test_no_photos(tmp_path):
    with pytest.raises(NotACapture, match="the folder is empty"):
        photos_to_pose(tmp_path)
    (tmp_path / "IMG_1.HEIC").write_bytes(b"")
    with pytest.raises(BadImage, match=r"IMG_1\.HEIC"):
        photos_to_pose(tmp_path)
    with pytest.raises(MissingFile, match="no such folder"):
        photos_to_pose(tmp_path / "nowhere")


def exif(path: Path, **keys) -> Path:
    """A photo of 60 x 40 pixels; `keys` are of its EXIF."""
    tags = Pillow.Exif()
    if "orientation" in keys:
        tags[0x0112] = keys["orientation"]
    if "focal" in keys:
        tags.get_ifd(0x8769)[0xA405] = keys["focal"]
    Pillow.new("RGB", (60, 40)).save(path, exif=tags)
    return path


def test_focal_lengths_of_exif(tmp_path):
    assert read_focal(exif(tmp_path / "a.jpg", focal=26)) == pytest.approx(26 / 43.27)
    assert read_focal(exif(tmp_path / "b.jpg")) is None
    assert read_focal(exif(tmp_path / "c.jpg", focal=0)) is None


def test_photos_of_one_size_and_focal_length_are_of_one_camera(tmp_path):
    (tmp_path / "work").mkdir()
    photos = [exif(tmp_path / f"{i}.jpg", focal=focal) for i, focal in enumerate((26, 26, 52, 26))]
    photos.append(photo(tmp_path / "4.png", (80, 60)) or tmp_path / "4.png")
    headers = posing._prepare(tmp_path / "work", photos, 2, NullProgress())
    cameras = json.loads((tmp_path / "work/job.json").read_text())["cameras"]
    assert [camera["photos"] for camera in cameras] == [
        ["000000.png", "000001.png", "000003.png"],
        ["000002.png"],
        ["000004.png"],
    ]
    assert cameras[0]["focal"] == pytest.approx(26 / 43.27 * np.hypot(60, 40)) and cameras[2]["focal"] is None
    assert headers[4][:2] == (80, 60)


@pytest.mark.parametrize("mode, ending", [("RGB", "jpg"), ("RGBA", "png"), ("P", "png"), ("L", "webp")])
def test_photos_are_handed_on_smaller(tmp_path, mode, ending):
    Pillow.new(mode, (100, 50)).save(tmp_path / f"a.{ending}")
    assert write_smaller(tmp_path / f"a.{ending}", tmp_path / "b.png", 40) == (40, 20)
    with Pillow.open(tmp_path / "b.png") as written:
        assert (written.size, written.mode) == ((40, 20), "RGB")
    assert write_smaller(tmp_path / f"a.{ending}", tmp_path / "b.png", 400) == (100, 50)


def test_a_few_photos_that_are_cut_off_are_left_out(tmp_path):
    corner.write_photos(tmp_path, 6)
    data = (tmp_path / "p1.jpg").read_bytes()
    (tmp_path / "p1.jpg").write_bytes(data[: len(data) // 2])
    found, notes = posing.whole_photos(tmp_path, photos_to_pose(tmp_path))
    assert [photo.stem for photo in found] == ["p0", "p2", "p3", "p4", "p5"]
    assert len(notes) == 1 and "p1.jpg: the file is cut off; copy it again" in notes[0]
    assert overview(tmp_path)["photos"] == {"to_pose": 5}


def test_a_photo_that_is_cut_off_is_named_before_any_work(tmp_path, monkeypatch):
    monkeypatch.setattr(posing, "check_extra", lambda folder: None)
    corner.write_photos(tmp_path, 3)
    data = (tmp_path / "p1.jpg").read_bytes()
    (tmp_path / "p1.jpg").write_bytes(data[: len(data) // 2])
    with pytest.raises(BadImage, match=r"p1\.jpg: the picture cannot be decoded.*replace or remove it"):
        estimate(tmp_path, photos_to_pose(tmp_path), 1, NullProgress())


def test_without_the_extra(tmp_path, monkeypatch):
    monkeypatch.setattr(posing, "find_spec", lambda name: None)
    with pytest.raises(MissingExtra, match=r'pip install "fusedrf\[capture\]"'):
        estimate(tmp_path, [], 1, NullProgress())


# --- pairs --------------------------------------------------------------------------------------------------


def test_pairs_are_neighbours_and_those_that_look_alike():
    """60 pictures of a walk that goes round twice: i and i + 30 show the same."""
    random = np.random.default_rng(0)
    places = random.integers(0, 256, (30, 40, 128))
    noisy = [places[i % 30] + random.integers(-8, 9, (40, 128)) for i in range(60)]
    pairs = matching_pairs([np.clip(found, 0, 255).astype(np.uint8) for found in noisy])
    assert pairs == sorted(set(pairs)) and all(i < j for i, j in pairs)
    assert {(i, i + 1) for i in range(59)} | {(i, i + 30) for i in range(30)} <= set(pairs)
    assert len(pairs) <= 60 * (NEIGHBOURS + ALIKE)


def test_pairs_of_pictures_without_features():
    found = [np.zeros((0, 128), np.uint8), *np.random.default_rng(0).integers(0, 256, (4, 9, 128), np.uint8)]
    assert matching_pairs(found) == [(i, j) for i in range(5) for j in range(i + 1, 5)]
    assert {(i, i + 1) for i in range(29)} <= set(matching_pairs([np.zeros((0, 128), np.uint8)] * 30))


# --- the world's axes ---------------------------------------------------------------------------------------


def anyhow(poses: np.ndarray) -> tuple[list[View], SparsePoints, np.ndarray]:
    """Views and what they look at in a world turned, moved and scaled anyhow."""
    axis = np.array([0.3, -0.5, 0.81])
    a, b, c = axis / np.linalg.norm(axis)
    cross = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
    turn = np.eye(3) + np.sin(2) * cross + (1 - np.cos(2)) * cross @ cross
    poses = poses.copy()
    poses[:, :3, :3] = turn @ poses[:, :3, :3]
    poses[:, :3, 3] = 7 * poses[:, :3, 3] @ turn.T + [50, -20, 3]
    points = 7 * np.random.default_rng(0).normal(size=(99, 3)) * 0.3 @ turn.T + [50, -20, 3]
    views = [View(f"{i}", pose, 80, 80, 50, 40, 100, 80) for i, pose in enumerate(poses)]
    return views, SparsePoints(points, np.zeros((99, 3), np.uint8)), turn


def test_the_world_is_stood_upright():
    poses = np.array(ring(12, 5, np.zeros(3)))
    poses[:, :3, 3] += [0, 0, 1.5]  # from above the middle, and looking level
    views, points = upright(*anyhow(poses)[:2], [1] * 12)
    found = np.array([view.camera_to_world for view in views])
    assert found[:, :3, 1] == pytest.approx(np.tile([0, 0, 1], (12, 1)), abs=1e-9)
    assert found[0, :3, 2] == pytest.approx([0, -1, 0], abs=1e-9)
    assert np.linalg.norm(found[:, :3, 3], axis=1) == pytest.approx(np.full(12, DISTANCE))
    assert np.linalg.norm(points.positions, axis=1).max() < DISTANCE


def test_cameras_that_look_down_from_one_side_are_stood_upright():
    """Their mean up leans; but their x axes are level."""
    poses = corner.poses(7)
    views, _ = upright(*anyhow(poses)[:2], [1] * 7)
    turned = np.array([view.camera_to_world for view in views])
    assert np.degrees(np.arccos(turned[:, 2, 1])) == pytest.approx(
        np.degrees(np.arccos(poses[:, 2, 1])), abs=1e-6
    )


def turned_about(axis: int, angle: float) -> np.ndarray:
    """(4, 4) a turn about x (0) or z (2)."""
    found, (i, j) = np.eye(4), [(1, 2), (2, 0), (0, 1)][axis]
    found[i, i] = found[j, j] = np.cos(angle)
    found[i, j], found[j, i] = -np.sin(angle), np.sin(angle)
    return found


@pytest.mark.parametrize("orientation, quarter", [(1, 0), (6, 1), (3, 2), (8, 3)])
def test_photos_that_are_stored_sideways(orientation, quarter):
    """The stored picture of a camera that was turned has its up at a side."""
    poses = np.array(ring(9, 5, np.zeros(3)))
    roll = turned_about(2, -np.pi / 2 * quarter)
    views, _ = upright(*anyhow(poses @ roll)[:2], [orientation] * 9)
    upright_poses = np.array([view.camera_to_world for view in views]) @ np.linalg.inv(roll)
    assert upright_poses[:, :3, 1] == pytest.approx(np.tile([0, 0, 1], (9, 1)), abs=1e-9)


@pytest.mark.parametrize("quarter", [1, 3])
def test_photos_that_are_stored_sideways_and_do_not_say_so(quarter):
    """Their cameras look down by 30 degrees."""
    down, roll = turned_about(0, -np.pi / 6), turned_about(2, -np.pi / 2 * quarter)
    views, _ = upright(*anyhow(np.array(ring(9, 5, np.zeros(3))) @ down @ roll)[:2], [1] * 9)
    held = np.array([view.camera_to_world for view in views]) @ np.linalg.inv(down @ roll)
    assert held[:, :3, 1] == pytest.approx(np.tile([0, 0, 1], (9, 1)), abs=1e-9)


def test_a_camera_that_looks_straight_down():
    down = np.array([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 5], [0, 0, 0, 1]], float)
    poses = np.stack([down, *np.array(ring(9, 5, np.zeros(3)))])
    views, _ = upright(*anyhow(poses)[:2], [1] * 10)
    assert views[0].camera_to_world[:3, 1] == pytest.approx([0, 1, 0], abs=0.2)
    assert views[1].camera_to_world[2, 1] > 0.98


# --- writing ------------------------------------------------------------------------------------------------


def test_points_come_back(tmp_path):
    random = np.random.default_rng(0)
    points = SparsePoints(random.normal(size=(50, 3)), random.integers(0, 256, (50, 3), np.uint8))
    write_ply_points(tmp_path / "p.ply", points)
    back = read_ply_points(tmp_path / "p.ply")
    assert back.positions == pytest.approx(points.positions, rel=1e-6)
    assert (back.colours == points.colours).all()


def posed(folder: Path, count: int = 3) -> PosedPhotos:
    """Photos that "found" a place in a row, one of them of another size."""
    views = []
    for i in range(count):
        size = (100, 80) if i else (80, 100)
        photo(folder / f"{i}.png", size)
        pose = np.array(POSE, float)
        pose[1, 3] += i
        views.append(
            View(f"{i}", pose, 80 + i, 81, 50, 40, *size, (0.1, 0, 0, 0, 0), image_path=folder / f"{i}.png")
        )
    points = SparsePoints(np.random.default_rng(0).normal(size=(99, 3)), np.zeros((99, 3), np.uint8))
    return PosedPhotos(tuple(views), points, ("x.png",), (), (count,), 0.5)


@pytest.mark.parametrize("relative", [False, True])
def test_what_is_written_is_a_capture(tmp_path, relative):
    given = posed(tmp_path / "holiday/images")
    (tmp_path / "out").mkdir()
    write_posed(tmp_path / "out/capture", given, overwrite=False, relative=relative)
    if relative:  # so that both may be moved together
        shutil.move(tmp_path, str(tmp_path) + "-moved")
        tmp_path = Path(str(tmp_path) + "-moved")
    assert sorted(p.name for p in (tmp_path / "out/capture").iterdir()) == ["points.ply", "transforms.json"]
    capture = read_capture(tmp_path / "out/capture")
    assert [view.name for view in capture.train] == ["0", "1", "2"] and len(capture.points.positions) == 99
    for view, back in zip(given.views, capture.train, strict=True):
        assert (back.camera_to_world == view.camera_to_world).all()
        for key in ("fl_x", "fl_y", "cx", "cy", "width", "height", "distortion"):
            assert getattr(back, key) == getattr(view, key)


# --- the process --------------------------------------------------------------------------------------------


def in_its_place(monkeypatch, tmp_path, code: str) -> None:
    """Let the process run `code` instead of `formats.colmap_worker`."""
    place = tmp_path / "instead" / "formats"
    place.mkdir(parents=True)
    (place / "__init__.py").write_text("")
    (place / "colmap_worker.py").write_text(code)
    monkeypatch.setattr(posing, "__file__", str(place / "posing.py"))
    monkeypatch.setattr(posing, "check_extra", lambda folder: None)


@pytest.mark.parametrize(
    "models, said",
    [
        ([], r"none of its 4 photos \(1 of them, such as p2\.jpg, are blurred or plain\) found"),
        ([2], "2 of its 4 photos"),
    ],
)
def test_photos_that_give_no_model(tmp_path, monkeypatch, models, said):
    last = {"features": [900, 800, 3, 700], "models": models, "error": None}
    in_its_place(monkeypatch, tmp_path, f"import json\nprint(json.dumps({last!r}))")
    corner.write_photos(tmp_path / "photos", 4)
    with pytest.raises(NoPoses, match=said) as caught:
        estimate(tmp_path / "photos", photos_to_pose(tmp_path / "photos"), 1, NullProgress())
    assert "overlap too little" in str(caught.value) and "take more" in str(caught.value)


@pytest.mark.parametrize("code", ["raise SystemExit('out of paper')", "import os; os.abort()", "pass"])
def test_a_process_that_breaks_down(tmp_path, monkeypatch, code):
    in_its_place(monkeypatch, tmp_path, code)
    corner.write_photos(tmp_path / "photos", 3)
    with pytest.raises(PosingFailed, match="broke down") as caught:
        estimate(tmp_path / "photos", photos_to_pose(tmp_path / "photos"), 1, NullProgress())
    assert ("out of paper" in str(caught.value)) == ("paper" in code)


def test_an_interrupt_ends_the_process_and_leaves_nothing(tmp_path, monkeypatch):
    mark = tmp_path / "alive"
    in_its_place(
        monkeypatch,
        tmp_path,
        f"import os, time\nopen({str(mark)!r}, 'w').write(str(os.getpid()))\n"
        'print(\'{"phase": "features", "total": 3}\', flush=True)\ntime.sleep(60)',
    )
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    (tmp_path / "temporary").mkdir()
    corner.write_photos(tmp_path / "photos", 3)

    class Interrupting(NullProgress):
        def phase(self, name, total=None):
            if name == "features":
                raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        estimate(tmp_path / "photos", photos_to_pose(tmp_path / "photos"), 1, Interrupting())
    assert not any((tmp_path / "temporary").iterdir())
    with pytest.raises(ProcessLookupError):
        os.kill(int(mark.read_text()), 0)


# --- with pycolmap ------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def found(tmp_path_factory) -> tuple:
    """8 photos of the corner, one of a plain wall: what was found, what was told, and the true poses."""
    pytest.importorskip("pycolmap", reason="pycolmap is not installed (the extra fusedrf[capture])")
    folder, told = tmp_path_factory.mktemp("corner"), ObjectCues()
    true = corner.write_photos(folder, 8)
    Pillow.new("RGB", corner.SIZE, (90, 90, 90)).save(folder / "p99.png")
    return estimate(folder, photos_to_pose(folder), 1, told), told, true


@with_pycolmap
def test_the_corner_is_found(found):
    posed, told, true = found
    assert [view.name for view in posed.views] == [f"p{i}" for i in range(8)]
    assert (posed.unposed, posed.plain, posed.models) == (("p99.png",), ("p99.png",), (8,))
    poses = np.array([view.camera_to_world for view in posed.views])
    turned, moved, turn = corner.aligned(poses, true)
    assert turned.max() < 0.5 and moved.max() < 0.01
    assert turn[2, 2] > np.cos(np.radians(1))  # its z is the corner's
    assert posed.views[0].fl_x == pytest.approx(corner.FOCAL, rel=0.02) and posed.error < 1
    assert len(posed.points.positions) > 500
    assert list(told.phases) == ["reading", "features", "matching", "mapping"]
    assert [told.phases[name][0] for name in told.phases] == [9, 9, 36, 9]
    assert all(done == sorted(done) for done in (counts[1:] for counts in told.phases.values()))


@with_pycolmap
def test_the_same_photos_give_the_same_poses(found, tmp_path):
    corner.write_photos(tmp_path, 8)
    Pillow.new("RGB", corner.SIZE, (90, 90, 90)).save(tmp_path / "p99.png")
    again = estimate(tmp_path, photos_to_pose(tmp_path), 1, NullProgress())
    for one, other in zip(found[0].views, again.views, strict=True):
        assert (one.camera_to_world == other.camera_to_world).all()
    assert (found[0].points.positions == again.points.positions).all()


@with_pycolmap
def test_many_photos_are_posed_by_likely_pairs_and_their_lens_is_refined(tmp_path, monkeypatch):
    """Those limits hold in the process, so that is where they are lowered."""
    import formats

    place = Path(formats.__file__).parent
    shutil.copytree(place, tmp_path / "instead/formats")
    mapper = tmp_path / "instead/formats/colmap_worker.py"
    text = mapper.read_text()
    for found, lowered in (("EXHAUSTIVE = 60", "EXHAUSTIVE = 4"), ("REFINED = 30", "REFINED = 6")):
        assert found in text
        text = text.replace(found, lowered)
    mapper.write_text(text)
    monkeypatch.setattr(posing, "__file__", str(tmp_path / "instead/formats/posing.py"))
    corner.write_photos(tmp_path / "photos", 6)
    told = ObjectCues()
    posed = estimate(tmp_path / "photos", photos_to_pose(tmp_path / "photos"), 1, told)
    assert list(told.phases) == ["reading", "features", "comparing", "matching", "mapping", "refining"]
    (view, *_), true = posed.views, corner.poses(6)
    assert view.fl_x == pytest.approx(corner.FOCAL, rel=0.02) and view.fl_x != view.fl_y
    assert abs(view.cx - corner.SIZE[0] / 2) < 8 and any(view.distortion[3:])
    turned, moved, _ = corner.aligned(np.array([view.camera_to_world for view in posed.views]), true)
    assert len(turned) == 6 and turned.max() < 1.5 and moved.max() < 0.02


@with_pycolmap
def test_photos_of_nothing(tmp_path):
    for i in range(3):
        Pillow.new("RGB", (64, 48), (i, 90, 90)).save(tmp_path / f"{i}.png")
    with pytest.raises(
        NoPoses, match="none of its 3 photos .*3 of them, such as 0.png, are blurred or plain"
    ):
        estimate(tmp_path, photos_to_pose(tmp_path), 1, NullProgress())


@with_pycolmap
def test_the_process_ends_with_its_parent(tmp_path):
    """Its input is closed when this process ends, however it does."""
    job = {"threads": 1, "cameras": [{"photos": ["a.png"], "focal": None, "width": 9, "height": 9}]}
    (tmp_path / "job.json").write_text(json.dumps(job))
    Pillow.new("RGB", (4000, 3000)).save(tmp_path / "a.png")
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    words = [sys.executable, "-m", "formats.colmap_worker", str(tmp_path)]
    process = subprocess.Popen(words, cwd=ROOT, **pipes)
    with process:
        process.stdin.close()
        assert process.wait(60) == 1


@pytest.mark.slow
@with_pycolmap
def test_sceaux():
    """All of 11 photos of a castle."""
    photos = photos_to_pose(real("sceaux"))
    posed = estimate(real("sceaux"), photos, 2, NullProgress())
    assert len(posed.views) == 11 and posed.models == (11,)


@pytest.mark.slow
@with_pycolmap
def test_fox():
    """50 photos of a phone, against the poses that came with them."""
    given = {view.name: view for view in read_capture(real("fox")).train}
    folder = real("fox") / "images"
    posed = estimate(folder, photos_to_pose(folder), 2, NullProgress())
    assert len(posed.views) >= 48
    true = np.array([given[view.name].camera_to_world for view in posed.views])
    turned, moved, _ = corner.aligned(np.array([view.camera_to_world for view in posed.views]), true)
    assert np.median(turned) < 1 and np.median(moved) < 0.02 * 4
