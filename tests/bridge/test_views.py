"""Where pictures are taken from: as a capture's photos were, or framed; before and after fuses and edits."""

import json
import random
import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from formats.bundle import read_bundle
from formats.camera_set import CameraSet, read_camera_set
from formats.captures import read_capture, write_capture
from formats.errors import FormatError
from formats.images import read_image, write_png
from formats.meshes import mesh_capture
from formats.scene import SceneGraph, dump_scene, make_node, parse_scene, read_scene, write_scene
from formats.views import View
from fusedrf_cli.bridge.capture_cameras import cameras_of_capture
from fusedrf_cli.bridge.field_bundle import write_field
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.rendering import renderable
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.bridge.scene_bounds import SceneBounds
from fusedrf_cli.bridge.training import TrainPresets
from fusedrf_cli.bridge.views import choose_views, pinhole, sized, standing
from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.rendering.cameras import Camera, azimuth_of, framing_camera, orbit
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.python import open_scene
from fusedrf_cli.requests import RenderRequest
from tests.bridge.conftest import FIELDS, part
from tests.formats.test_camera_set import LENSES, TURNED, camera_set_of
from tests.formats.test_captures import looking_at
from tests.formats.test_meshes import two_coloured_cube
from tests.promises.mutations import spoilt_json
from tests.promises.packs import GOLDEN

SMALL = ("--seed", "0", "--no-finetune")
FOCUS = np.array([0.05, -0.1, 0.02])
EYES = (
    *((1.6, 0.2, 0.5), (0.2, 1.5, 0.7), (-1.7, 0.1, 0.4)),
    *((0.1, -1.4, 0.9), (1.2, 1.1, 0.3), (1.5, -0.9, 0.6)),
)
STRETCHED = np.diag([1.0, 1.0, 1.5, 1.0])


def photo(number: int, eye, size=(24, 16), **more) -> View:
    width, height = size
    pose = np.array(looking_at(np.array(eye), FOCUS))
    return View(
        f"IMG_{number}", pose, 1.2 * width, 1.25 * width, 0.48 * width, 0.52 * height, width, height, **more
    )


CAMERA_SET = camera_set_of([photo(i, eye) for i, eye in enumerate(EYES)], held_out=2)
OBJECT = replace(CAMERA_SET, surroundings=False)


def keep(folder, name: str, camera_set: CameraSet | None, field: str = "red", **more) -> None:
    """A bundle of one of the solids, as if it was learnt from a capture with those cameras."""
    cameras = camera_set and camera_set.content()
    write_field(
        str(folder / name), FIELDS[field], name.split(".")[0], precision="float32", overwrite=True,
        about=SceneGraph((), cameras=cameras), **more,
    )  # fmt: skip


@pytest.fixture(autouse=True)
def room(folder):
    """room.rfpack, learnt from six photos of all that is around, two of them held out."""
    keep(folder, "room.rfpack", CAMERA_SET)


def views_of(folder, scene: str, **asked) -> list[Camera]:
    """The cameras that `render` takes."""
    unset = ("cameras", "path", "views", "orbit", "look_at", "view_from", "up", "size", "memory")
    words = dict.fromkeys(unset)
    words |= {"zoom": 1.0, "background": None, "depth": False, "fps": 24.0, "allow_outside": False}
    words |= {"reference": True}
    words |= {"near": 0.0, "far": np.inf}
    words |= {"scene": str(folder / scene), "output": "out", "overwrite": False}
    request = RenderRequest(device="cpu", threads=None, **words | asked)
    loaded = load_scene(request.scene)
    return choose_views(request, loaded, *renderable(loaded))


def cameras_in(folder, bundle: str) -> dict | None:
    return read_bundle(folder / bundle).scene.cameras


def eye_of(camera: Camera) -> np.ndarray:
    return camera.camera_to_world[:3, 3]


def target_of(camera: Camera, distance: float) -> np.ndarray:
    """The point at a distance along the optical axis."""
    return eye_of(camera) - distance * camera.camera_to_world[:3, 2]


def same(one: Camera, other: Camera) -> bool:
    return one.intrinsics == other.intrinsics and np.array_equal(one.camera_to_world, other.camera_to_world)


def place(folder, file: str, matrix, background: bool = False, *others: str) -> None:
    """A scene of the room, placed by a matrix, and other bundles as they are."""
    nodes = [make_node("room", source="room.rfpack", matrix=matrix, background=background)]
    nodes += [make_node(name, source=f"{name}.rfpack") for name in others]
    write_scene(folder / file, SceneGraph(tuple(nodes)), overwrite=True)


# --- a capture ----------------------------------------------------------------------------------------------


def test_a_capture_is_shown_as_one_of_its_photos(report, folder):
    said = report("render", "room.rfpack", "-o", "a.png")
    assert said["size"] == [24, 16]
    write_capture(folder / "eye", [CAMERA_SET.typical], np.zeros((1, 16, 24, 3), np.uint8))
    eye = ("--cameras", "eye/transforms_train.json")
    report("render", "room.rfpack", "-o", "b.png", *eye)
    one, other = (read_image(folder / f).astype(int) for f in ("a.png", "b.png"))
    assert np.abs(one - other).max() <= 1 and (one != 255).any()
    report("render", "room.rfpack", "-o", "c.png", "--size", "40x40")
    report("render", "room.rfpack", "-o", "d.png", *eye, "--size", "40x40")
    assert np.abs(read_image(folder / "c.png") - read_image(folder / "d.png").astype(int)).max() <= 1


def test_an_orbit_keeps_the_distance_and_the_height_of_the_photos(folder):
    cameras, up = views_of(folder, "room.rfpack", orbit=8), CAMERA_SET.up
    away = np.array([eye_of(camera) for camera in cameras]) - CAMERA_SET.focus
    np.testing.assert_allclose(np.linalg.norm(away, axis=1), CAMERA_SET.distance, atol=1e-6)
    np.testing.assert_allclose(away @ up, CAMERA_SET.height(up), atol=1e-6)
    for camera in cameras:
        np.testing.assert_allclose(target_of(camera, CAMERA_SET.distance), CAMERA_SET.focus, atol=1e-6)
        assert camera.camera_to_world[:3, 0] @ up == pytest.approx(0, abs=1e-7)  # level
        assert camera.camera_to_world[:3, 1] @ up > 0
        assert (camera.width, camera.height, camera.cx, camera.cy) == (24, 16, 12, 8)
    flat = away - np.outer(away @ up, up)
    np.testing.assert_allclose(flat.sum(0), 0, atol=1e-6)  # all around
    first, typical = flat[0], CAMERA_SET.typical.camera_to_world[:3, 3] - CAMERA_SET.focus
    assert np.linalg.norm(np.cross(first, typical - (typical @ up) * up)) < 1e-6  # it begins at that photo


@pytest.mark.parametrize("turn", [0.0, 2.0, 3.1])
def test_an_orbit_of_photos_from_one_side_swings_between_them(folder, turn):
    """To and fro between the outermost cameras, from the photo's side on, wherever azimuth 0 lies; all the
    way around where that is asked for by --from."""
    spread = (-0.5, -0.2, 0.0, 0.3, 0.9)
    eyes = [FOCUS + 2 * np.array([np.cos(turn + a), np.sin(turn + a), 0.4]) for a in spread]
    keep(folder, "side.rfpack", camera_set_of([photo(i, eye) for i, eye in enumerate(eyes)], held_out=1))
    camera_set = read_camera_set(read_bundle(folder / "side.rfpack").scene.cameras)
    cameras = views_of(folder, "side.rfpack", orbit=40)
    seen = azimuths(cameras, camera_set)
    allowed = azimuths([camera_of(view) for view in camera_set.views], camera_set)
    about = seen[0]
    seen, allowed = ((a - about + np.pi) % (2 * np.pi) - np.pi for a in (seen, allowed))
    assert allowed.min() - 1e-6 < seen.min() and seen.max() < allowed.max() + 1e-6
    assert np.ptp(seen) > 0.98 * np.ptp(allowed) and abs(np.diff(np.append(seen, seen[0]))).max() < 0.2
    asked = views_of(folder, "side.rfpack", orbit=40, view_from=(10.0, 20.0))
    assert np.ptp(azimuths(asked, camera_set)) > 5.8


def azimuths(cameras: list[Camera], camera_set: CameraSet) -> np.ndarray:
    return np.array([azimuth_of(eye_of(camera) - camera_set.focus, camera_set.up) for camera in cameras])


def test_every_view_of_the_capture_is_rendered_under_its_name(report, folder):
    said = report("render", "room.rfpack", "-o", "all", "--views", "capture")
    assert said["files"] == [f"all/IMG_{i}.png" for i in range(6)]
    assert read_image(folder / "all/IMG_3.png").shape[:2] == (16, 24)
    said = report("render", "room.rfpack", "-o", "some", "--views", "heldout", "--size", "12x8")
    assert said["files"] == ["some/IMG_4.png", "some/IMG_5.png"] and said["size"] == [12, 8]
    assert report("render", "room.rfpack", "-o", "film.gif", "--views", "capture")["views"] == 6


def test_photos_of_the_same_name_get_pictures_of_their_own(report, folder):
    """Blender's captures name the photos of each split from r_0."""
    views = [photo(0, EYES[0]), replace(photo(0, EYES[1]), name="IMG_0")]
    keep(folder, "twins.rfpack", camera_set_of(views, held_out=1))
    said = report("render", "twins.rfpack", "-o", "all", "--views", "capture")
    assert said["files"] == ["all/IMG_0.png", "all/IMG_0_heldout.png"]
    assert report("render", "twins.rfpack", "-o", "b", "--views", "heldout")["files"] == ["b/IMG_0.png"]


def test_a_film_has_one_size(run, report, folder):
    keep(folder, "mixed.rfpack", camera_set_of([photo(0, EYES[0]), photo(1, EYES[1], (16, 24))]))
    result = run("render", "mixed.rfpack", "-o", "a.gif", "--views", "capture")
    assert result.exit_code == 2 and "give --size" in result.stderr
    report("render", "mixed.rfpack", "-o", "a.gif", "--views", "capture", "--size", "20x20")
    assert len(report("render", "mixed.rfpack", "-o", "all", "--views", "capture")["files"]) == 2


def test_what_keeps_no_cameras_says_so(run, folder):
    def refused(scene: str, which: str) -> str:
        result = run("render", scene, "-o", "no", "--views", which)
        assert result.exit_code == 3 and not (folder / "no").exists()
        return result.stderr

    assert "keeps no cameras" in refused("red.rfpack", "capture")
    keep(folder, "all.rfpack", camera_set_of(list(CAMERA_SET.views)))
    assert "none of its 6 cameras was held out" in refused("all.rfpack", "heldout")
    place(folder, "two.json", np.eye(4), False, "all")
    assert "'room', 'all' each keep cameras" in refused("two.json", "capture")
    place(folder, "flat.json", STRETCHED)
    assert "stretches, shears or mirrors" in refused("flat.json", "capture")


# --- placed, fused, edited ----------------------------------------------------------------------------------


def test_a_placed_capture_shows_the_same_pixels(report, folder):
    """Turned, twice as large and elsewhere: its cameras go along."""
    place(folder, "turned.json", TURNED)
    report("render", "room.rfpack", "-o", "a", "--views", "capture")
    report("render", "turned.json", "-o", "b", "--views", "capture")
    shots = {name: [read_image(folder / f"{name}/IMG_{i}.png") / 255 for i in range(6)] for name in "ab"}
    for i in range(6):
        assert psnr(shots["a"][i], shots["b"][i]) > 30 > 22 > psnr(shots["a"][i], shots["b"][i - 1])
    one, other = (views_of(folder, scene, orbit=5)[3] for scene in ("room.rfpack", "turned.json"))
    assert np.linalg.norm(eye_of(other) - TURNED[:3, 3]) == pytest.approx(2 * np.linalg.norm(eye_of(one)))


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_the_rays_of_placed_cameras_are_the_placed_rays(lens):
    """Of any lens: what lies along a ray before lies along it after."""
    camera_set = camera_set_of([photo(i, eye, **lens) for i, eye in enumerate(EYES)])
    for one, other in zip(camera_set.views, camera_set.placed(TURNED).views, strict=True):
        (eyes, away), (moved_eyes, moved_away) = (camera_of(view).rays() for view in (one, other))
        np.testing.assert_allclose(moved_eyes, eyes @ TURNED[:3, :3].T + TURNED[:3, 3], atol=1e-12)
        np.testing.assert_allclose(moved_away, away @ TURNED[:3, :3].T / 2, atol=1e-12)


def test_cameras_are_those_of_the_background_or_of_the_only_source_that_has_any(folder):
    keep(folder, "chair.rfpack", OBJECT, "blue")
    keep(folder, "other.rfpack", camera_set_of(list(CAMERA_SET.views)[:3]), "blue")

    def count(*sources: str, background: bool) -> int:
        place(folder, "s.json", np.eye(4), background, *sources)
        try:
            return len(views_of(folder, "s.json", views="capture"))
        except Exception as error:
            assert "keep cameras" in str(error)
            return 0

    assert count("floor", background=False) == 6  # the only one
    assert count("floor", "chair", background=False) == 6  # the only one with surroundings
    assert count("floor", "other", background=False) == 0
    assert count("floor", "other", background=True) == 6


def test_fused_converted_and_edited_bundles_keep_the_cameras(report, folder):
    place(folder, "s.json", TURNED, True, "blue")
    report("fuse", "s.json", "-o", "f.rfpack", *SMALL)
    report("add", "f.rfpack", "blue.rfpack", "--name", "more", "-t", "9,0,0", "-o", "g.rfpack")
    report("delete", "g.rfpack", "blue", "-o", "h.rfpack", *SMALL)
    report("fuse", "h.rfpack", "-o", "i.rfpack", *SMALL)
    kept = cameras_in(folder, "f.rfpack")
    np.testing.assert_allclose(read_camera_set(kept).poses, CAMERA_SET.placed(TURNED).poses, atol=1e-6)
    assert [cameras_in(folder, f"{name}.rfpack") for name in "ghi"] == [kept] * 3
    assert read_bundle(folder / "f.rfpack").scene.framing is None  # its cameras say what pictures show
    one, *others = (views_of(folder, f"{name}.rfpack")[0] for name in "fghi")
    assert one.name == CAMERA_SET.typical.name and all(same(one, other) for other in others)


def test_a_stretched_capture_leaves_its_cameras_and_says_so(report, folder):
    place(folder, "s.json", STRETCHED, True, "blue")
    said = report("fuse", "s.json", "-o", "f.rfpack", *SMALL)
    assert any("its cameras are left out" in warning for warning in said["warnings"])
    assert cameras_in(folder, "f.rfpack") is None


def test_compose_leaves_cameras_where_they_are_and_they_are_found(report, folder):
    report("compose", "room.rfpack", "--background-node", "-s", "2", "blue.rfpack", "-o", "s.json")
    assert read_scene(folder / "s.json").cameras is None
    (view,) = views_of(folder, "s.json")
    np.testing.assert_allclose(eye_of(view), 2 * CAMERA_SET.typical.camera_to_world[:3, 3], atol=1e-7)


def test_a_scene_saved_from_python_keeps_its_cameras(folder):
    place(folder, "s.json", np.eye(4), True, "blue")
    for name, source in (("a", "room.rfpack"), ("b", "s.json"), ("c", "a.rfpack")):
        open_scene(folder / source).save(folder / f"{name}.rfpack")
        assert cameras_in(folder, f"{name}.rfpack") == CAMERA_SET.content()


def test_an_edit_does_not_move_the_view(report, folder):
    """Objects far away come and go; the scene, what is fused of it and what is edited look alike."""
    report("fuse", "pair.json", "-o", "f.rfpack", *SMALL)
    report("add", "f.rfpack", "blue.rfpack", "--name", "far", "-t", "20,0,5", "-o", "g.rfpack")
    report("delete", "g.rfpack", "red", "-o", "h.rfpack", *SMALL)
    report("convert", "f.rfpack", "--kind", "vm", "-o", "i.rfpack", "--max-size", "400kB")
    for asked in ({}, {"orbit": 3}, {"zoom": 2.0, "view_from": (10.0, 20.0)}):
        wanted = views_of(folder, "pair.json", **asked)
        for name in "fghi":
            found = views_of(folder, f"{name}.rfpack", **asked)
            assert all(same(one, other) for one, other in zip(found, wanted, strict=True)), name


def test_an_edit_of_a_trained_field_does_not_move_the_view_either(run, report, folder):
    before = views_of(folder, "red.rfpack")[0]
    added = run("add", "red.rfpack", "blue.rfpack", "--name", "far", "-t", "20,0,5", "-o", "g.rfpack")
    assert same(views_of(folder, "g.rfpack")[0], before)
    assert "far lies outside of what pictures show" in " ".join(added.stderr.split())
    look = re.search(r"--look-at (\S+?)`", added.stderr)[1]
    (shown,) = views_of(folder, "g.rfpack", look_at=tuple(map(float, look.split(","))))
    box = FIELDS["blue"].occupancy.tight_aabb(0)
    aimed = (box[:3] + box[3:]) / 2 + [20, 0, 5] - eye_of(shown)
    assert aimed / np.linalg.norm(aimed) @ -shown.camera_to_world[:3, 2] > 0.999
    near = run("add", "red.rfpack", "blue.rfpack", "--name", "near", "-o", "h.rfpack")
    assert "outside" not in near.stderr


def test_hostile_cameras_are_refused_or_make_views_of_finite_numbers():
    """P18, of what stands in `cameras`: rounded and placed again, circled, and at other sizes."""
    good, taken = json.dumps(read_bundle(GOLDEN / "ring.rfpack").scene.cameras).encode(), 0
    for seed in range(600):
        spoilt = spoilt_json(good, random.Random(seed))
        data = b'{"format": "rfpack", "version": "1.1", "nodes": [], "cameras": %s}' % spoilt
        try:
            scene = parse_scene(data, "here")
        except FormatError as error:
            assert str(error).isprintable()
            continue
        camera_set, taken = read_camera_set(scene.cameras), taken + 1
        for kept in filter(None, (camera_set, camera_set.placed(TURNED))):
            dump_scene(SceneGraph((), cameras=kept.content()))
        lens = pinhole(camera_of(sized(camera_set.typical, (8, 6))))
        photos = (camera_of(sized(view, (8, 6))) for view in camera_set.views)
        for camera in [*standing(camera_set, camera_set.up).orbit(lens, 3), *photos]:
            assert all(np.isfinite(numbers).all() for numbers in camera.rays()), seed
    assert 20 < taken < 200


# --- what stands free ---------------------------------------------------------------------------------------


def test_an_object_is_framed_as_before_whatever_photos_it_was_learnt_from(folder):
    keep(folder, "object.rfpack", OBJECT)
    box = FIELDS["red"].occupancy.tight_aabb(0)
    for scene in ("red.rfpack", "object.rfpack"):
        assert same(views_of(folder, scene)[0], framing_camera(box, 0.9, 0.45, 800, 800))
        cameras = zip(views_of(folder, scene, orbit=3, size=(20, 10)), orbit(box, 3, 20, 10), strict=True)
        assert all(same(one, other) for one, other in cameras)
    assert len(views_of(folder, "object.rfpack", views="capture")) == 6


def rolled(camera_set: CameraSet, degrees: float) -> CameraSet:
    """The same rig in a world that was turned about +x, objects and all."""
    turn = np.radians(degrees)
    matrix = np.eye(4)
    matrix[1:3, 1:3] = [[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]]
    return camera_set.placed(matrix)


@pytest.mark.parametrize("degrees, follows", [(0, False), (30, False), (90, True), (180, True)])
def test_an_object_stands_upright_in_a_world_whose_z_is_not_up(folder, degrees, follows):
    """As its photos were held, where that is more than 45 degrees from +z; --up goes before."""
    camera_set = rolled(OBJECT, degrees)
    keep(folder, "object.rfpack", camera_set)
    up = camera_set.up if follows else np.array([0.0, 0, 1])
    for camera in views_of(folder, "object.rfpack", orbit=4):
        assert camera.camera_to_world[:3, 1] @ up > 0.8  # from 26 degrees above
        assert camera.camera_to_world[:3, 0] @ up == pytest.approx(0, abs=1e-6)
    (camera,) = views_of(folder, "object.rfpack", up=(0.0, 3.0, 0.0))
    assert camera.camera_to_world[:3, 1] @ [0, 1, 0] > 0.8 and camera.camera_to_world[1, 0] == 0


def test_which_way_is_up_may_be_said(folder):
    """A place is circled about that direction, at the height of its photos along it; without an orbit it is
    no longer shown as a photo shows it."""
    up = np.array([0.6, 0.0, 0.8])
    cameras = views_of(folder, "room.rfpack", orbit=6, up=tuple(5 * up))
    away = np.array([eye_of(camera) for camera in cameras]) - CAMERA_SET.focus
    np.testing.assert_allclose(away @ up, CAMERA_SET.height(up), atol=1e-6)
    assert all(abs(camera.camera_to_world[:3, 0] @ up) < 1e-7 for camera in cameras)
    assert same(views_of(folder, "room.rfpack", up=tuple(5 * up))[0], replace(cameras[0], name="view"))


@pytest.mark.parametrize("scene", ["red.rfpack", "room.rfpack"])
def test_where_to_look_from_and_how_far(folder, scene):
    up = CAMERA_SET.up if scene == "room.rfpack" else np.array([0.0, 0, 1])
    target = np.array([0.3, -0.2, 0.1])
    (plain,) = views_of(folder, scene, look_at=tuple(target), size=(40, 30))
    distance = np.linalg.norm(eye_of(plain) - target)
    np.testing.assert_allclose(target_of(plain, distance), target, atol=1e-9)
    (near,) = views_of(folder, scene, look_at=tuple(target), size=(40, 30), zoom=2.0)
    np.testing.assert_allclose(eye_of(near) - target, (eye_of(plain) - target) / 2, atol=1e-9)
    east = np.array([1.0, 0, 0]) - up[0] * up
    for azimuth, elevation in ((0.0, 0.0), (90.0, 0.0), (-30.0, 45.0), (200.0, 90.0), (0.0, -90.0)):
        (camera,) = views_of(folder, scene, view_from=(azimuth, elevation), look_at=tuple(target))
        away = (eye_of(camera) - target) / np.linalg.norm(eye_of(camera) - target)
        assert np.degrees(np.arcsin(np.clip(away @ up, -1, 1))) == pytest.approx(elevation, abs=1e-4)
        if abs(elevation) < 90:
            flat = away - (away @ up) * up
            turn = np.degrees(np.arctan2(np.cross(east, flat) @ up, east @ flat))
            assert np.cos(np.radians(turn - azimuth)) == pytest.approx(1)
    first, *_ = views_of(folder, scene, orbit=4, view_from=(30.0, 10.0), zoom=0.5)
    (alone,) = views_of(folder, scene, view_from=(30.0, 10.0), zoom=0.5)
    assert same(first, alone)


@pytest.mark.parametrize("words", [("--zoom", "1e300"), ("--zoom", "1e-300"), ("--look-at", "1e300,0,0")])
@pytest.mark.parametrize("scene", ["red.rfpack", "room.rfpack"])
def test_a_view_that_numbers_cannot_hold_is_refused(run, folder, scene, words):
    result = run("render", scene, "-o", "a.png", *words)
    assert result.exit_code == 2 and "--zoom" in result.stderr and not (folder / "a.png").exists()


def test_a_picture_from_a_side(report, folder):
    """From +x and twice as near the red box fills the picture; from far away it does not."""
    words = ("--view-from", "0,0", "--size", "16x16", "--look-at", "0,0,0")
    report("render", "red.rfpack", "-o", "near.png", *words, "--zoom", "3")
    report("render", "red.rfpack", "-o", "far.png", *words, "--zoom", "0.3")
    near, far = ((read_image(folder / f"{name}.png")[..., 1] < 128).sum() for name in ("near", "far"))
    assert near == 256 and 0 < far < 64


# --- training and telling -----------------------------------------------------------------------------------


@pytest.fixture
def short(in_force):
    in_force(TrainPresets(draft=TrainConfig(longest=64, steps=5, samples=512)))


def speckled_capture(folder, count: int = 6) -> list[View]:
    """A folder `wall` of photos without alpha that show something up to their edges."""
    views = [photo(i, eye) for i, eye in enumerate(EYES[:count])]
    (folder / "wall").mkdir()
    keys = {"fl_x": views[0].fl_x, "fl_y": views[0].fl_y, "cx": views[0].cx, "cy": views[0].cy}
    frames = []
    for i, view in enumerate(views):
        pixels = np.random.default_rng(i).integers(0, 256, (16, 24, 3), np.uint8)
        write_png(folder / f"wall/{view.name}.png", pixels)
        frames.append(
            {"file_path": f"{view.name}.png", "transform_matrix": view.camera_to_world.tolist(), **keys}
        )
    (folder / "wall/transforms.json").write_text(json.dumps({"frames": frames}))
    return views


def test_training_on_photos_keeps_their_cameras(report, run, folder, short):
    views = speckled_capture(folder)
    report("train", "wall", "-o", "out.rfpack", "--quality", "draft", "--holdout", "3")
    camera_set = read_camera_set(cameras_in(folder, "out.rfpack"))
    assert camera_set.surroundings and [view.name for view in camera_set.test] == ["IMG_0", "IMG_3"]
    kept = {view.name: view for view in camera_set.views}
    for view in views:
        np.testing.assert_allclose(kept[view.name].camera_to_world, view.camera_to_world, atol=1e-6)
        assert camera_of(kept[view.name]).intrinsics == camera_of(view).intrinsics
    (shown,) = views_of(folder, "out.rfpack")
    assert shown.name in kept and (shown.width, shown.height) == (24, 16)
    said = report("info", "out.rfpack")["cameras"]
    assert said == {"count": 6, "held_out": 2, "photo_size": [24, 16], "sizes": 1, "surroundings": True}
    lines = run("info", "out.rfpack").stdout.splitlines()
    assert "cameras: count 6, held out 2, photo size 24x16" in lines


def test_training_on_an_object_keeps_its_cameras_and_how_it_is_framed(report, folder, short):
    report("train", "photos", "-o", "out.rfpack", "--quality", "draft")
    camera_set = read_camera_set(cameras_in(folder, "out.rfpack"))
    assert not camera_set.surroundings and (len(camera_set.train), len(camera_set.test)) == (8, 2)
    box = renderable(load_scene(str(folder / "out.rfpack")))[0].occupancy.tight_aabb(0)
    assert same(views_of(folder, "out.rfpack")[0], framing_camera(box, 0.9, 0.45, 800, 800))


def test_cameras_count_in_the_size_that_is_allowed(folder, short):
    """A field that just fits is made smaller where cameras come on top."""
    training, capture = part("training"), read_capture(folder / "photos")
    box = SceneBounds(np.array([-1.0] * 3 + [1] * 3))
    words = dict.fromkeys(("ranks", "sh_degree", "time_budget", "target_psnr", "max_size"))
    asked = SimpleNamespace(
        quality="draft", precision="float16", seed=0, masks="ignore", refine_poses=False, **words
    )
    kind = registry.kind("vm")
    whole = training.fit_settings(asked, kind, capture, box, "cpu")
    asked.max_size = training.bytes_of(kind.untrained(box.box, whole.longest, whole.storage), "float16")
    found = [training.fit_settings(asked, kind, capture, box, "cpu", more).longest for more in (0, 1, 10_000)]
    assert found[0] == whole.longest > found[1] >= found[2]


class Listener:
    """Takes what a command warns of."""

    def __init__(self):
        self.said = []

    def warn(self, sentence: str) -> None:
        self.said.append(sentence)


@pytest.mark.parametrize("cut_out", [False, True])
def test_photos_that_masks_cut_an_object_out_of_show_no_surroundings(folder, cut_out):
    speckled_capture(folder)
    capture = read_capture(folder / "wall")
    assert cameras_of_capture(capture, cut_out, Listener())["surroundings"] is not cut_out


def test_a_mesh_has_no_cameras_and_too_many_are_not_kept(tmp_path):
    two_coloured_cube().export(tmp_path / "cube.ply")
    capture, listener = mesh_capture(tmp_path / "cube.ply", n_train=2, size=16), Listener()
    assert cameras_of_capture(capture, False, listener) is None and listener.said == []
    many = replace(capture, kind="colmap", train=tuple(photo(i, EYES[0]) for i in range(10_001)))
    assert cameras_of_capture(many, False, listener) is None
    assert len(listener.said) == 1 and "does not keep its cameras" in listener.said[0]
