"""Rigs: cameras come back from a scene.json as they were, follow similarities, and are refused if hostile."""

import copy
import json
from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats.camera_set import MAX_CAMERAS, CameraSet, capture_camera_set, is_name, read_camera_set
from formats.capture_frame import scene_frame
from formats.errors import BadSchema
from formats.rotations import matrices, quaternions
from formats.scene import MAX_SCENE_BYTES, SceneGraph, dump_scene, parse_scene
from formats.views import Capture, View

LENSES = {
    "pinhole": {},
    "brown": {"distortion": (-0.12, 0.05, -0.01, 0.003, -0.002)},
    "eighth power": {"distortion": (-0.2, 0.08, -0.02, 0.001, 0.002, 0.004)},
    "rational": {"distortion": (0.3, -0.1, 0.02, -0.001, 0.002, 0.0, 0.35, -0.05, 0.01)},
    "fisheye": {"distortion": (0.05, -0.02, 0.006, -0.001), "fisheye": True},
    "equidistant": {"distortion": (0.0,) * 4, "fisheye": True},
}
TURNED = np.array([[0, -2, 0, 5.0], [2, 0, 0, -1], [0, 0, 2, 3], [0, 0, 0, 1]])
"""A quarter turn about z, a scale of 2 and a shift."""


def inward(count: int, radius: float = 4.0, height: float = 1.5, focus=(0.0, 0.0, 0.0), **lens) -> list[View]:
    """Views on a circle around z that look at a focus."""
    return [inward_view(i / count, i, radius, height, np.array(focus), lens) for i in range(count)]


def inward_view(turn: float, number: int, radius: float, height: float, focus, lens: dict) -> View:
    angle = 2 * np.pi * turn
    back = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
    pose = np.eye(4)
    pose[:3, 3] = focus + back
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    pose[:3, :3] = np.stack([right, np.cross(back, right), back], 1)
    return View(f"photo_{number:03d}", pose, 900.5, 901.25, 511.5, 390.0, 1024, 768, **lens)


def camera_set_of(views: list[View], held_out: int = 0, surroundings: bool = True) -> CameraSet:
    parts = tuple(views[: len(views) - held_out]), tuple(views[len(views) - held_out :])
    box = np.array([-1.0, -1, -1, 1, 1, 1])
    capture = Capture(Path("capture"), "colmap", *parts, box, opaque=True)
    return capture_camera_set(capture, surroundings)


def back_again(camera_set: CameraSet) -> CameraSet:
    """A rig after its way through a scene.json."""
    scene = parse_scene(dump_scene(SceneGraph((), cameras=camera_set.content())), "here")
    return read_camera_set(scene.cameras)


def projected(view: View, points: np.ndarray) -> np.ndarray:
    """(N, 2) pixels of points before a pinhole."""
    x, y, z = ((points - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]).T
    return np.stack([view.cx - view.fl_x * x / z, view.cy + view.fl_y * y / z], 1)


def seen_points(view: View, distance: float) -> np.ndarray:
    corners = [view.corners(distance * share) for share in (0.1, 1, 10)]
    return np.concatenate(corners)


# --- there and back -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", LENSES.values(), ids=LENSES)
def test_cameras_come_back(lens):
    camera_set = camera_set_of(inward(7, **lens), held_out=2)
    found = back_again(camera_set)
    assert [len(found.train), len(found.test), found.surroundings] == [5, 2, True]
    np.testing.assert_allclose(found.focus, camera_set.focus, atol=1e-7)
    assert found.distance == camera_set.distance
    for one, other in zip(found.views, camera_set.views, strict=True):
        np.testing.assert_allclose(one.camera_to_world, other.camera_to_world, atol=5e-8)
        kept = ("name", "fl_x", "fl_y", "cx", "cy", "width", "height", "distortion", "fisheye")
        assert [getattr(one, key) for key in kept] == [getattr(other, key) for key in kept]


@pytest.mark.parametrize(("scale", "away"), [*product((1e-2, 1.0, 1e4), (0.0, 5e6)), (1e-9, 0), (1e9, 5e12)])
def test_rounding_moves_no_pixel(scale, away):
    """By a thousandth, in any unit, and far from the origin, as surveyed captures are."""
    views = inward(5, 4 * scale, 1.5 * scale, (away, -away, away / 10))
    camera_set = camera_set_of(views)
    for one, other in zip(back_again(camera_set).views, camera_set.views, strict=True):
        points = seen_points(other, camera_set.distance)
        np.testing.assert_allclose(projected(one, points), projected(other, points), rtol=0, atol=1e-3)


@pytest.mark.parametrize(("away", "far"), [(9e11, False), (2e12, True)])
def test_cameras_that_stand_far_away_require_a_reader_that_takes_them(away, far):
    data = dump_scene(SceneGraph((), cameras=camera_set_of(inward(3, 4e3, 1e3, (away, 0, 0))).content()))
    assert parse_scene(data, "here").far == far == (b'"requires": [' in data)


def test_lenses_are_stored_once():
    plain, bent = inward(4), inward(4, **LENSES["brown"])
    content = camera_set_of([plain[0], bent[1], plain[2], bent[3]]).content()
    assert [len(row) for row in content["lenses"]] == [6, 11] and content["lens"] == [0, 1, 0, 1]
    assert "lens" not in camera_set_of(plain).content()


def test_a_hundred_cameras_take_some_kilobytes():
    assert len(dump_scene(SceneGraph((), cameras=camera_set_of(inward(100)).content()))) < 12_000


def test_as_many_cameras_as_are_allowed_fit():
    views = [replace(view, name=f"{i:05d}") for i, view in enumerate(inward(10) * (MAX_CAMERAS // 10))]
    views = [replace(view, fl_x=900.0 + i / 7) for i, view in enumerate(views)]
    data = dump_scene(SceneGraph((), cameras=camera_set_of(views).content()))
    assert len(data) < MAX_SCENE_BYTES / 1.2
    assert len(read_camera_set(parse_scene(data, "here").cameras).views) == MAX_CAMERAS


def test_names_that_cannot_name_pictures_are_replaced():
    names = ["a/b", "a_b", "a\nb", "..", "é" * 200, "a_b_00002", "\udcff"]
    views = [replace(view, name=name) for view, name in zip(inward(7), names, strict=True)]
    found = [view.name for view in back_again(camera_set_of(views)).views]
    assert found[1] == "a_b_00001" and found[3] == ".." and len(set(found)) == 7
    assert all(is_name(name) for name in found)


def test_photos_that_are_held_out_may_have_names_of_others():
    views = inward(2)
    camera_set = camera_set_of([views[0], replace(views[1], name=views[0].name)], held_out=1)
    assert [view.name for view in back_again(camera_set).views] == [views[0].name] * 2


@given(st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1))
def test_quaternions_are_rotations(numbers):
    unit = np.array(numbers) / np.linalg.norm(numbers)
    turn = matrices(unit)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(matrices(quaternions(turn[None])[0]), turn, atol=1e-12)


def test_the_nearest_rotation_is_taken():
    """Poses may be off by a thousandth."""
    turn = matrices(np.array([0.5, 0.5, 0.5, 0.5]))
    noisy = turn + np.random.default_rng(0).normal(0, 1e-4, (3, 3))
    u, _, v = np.linalg.svd(noisy)
    np.testing.assert_allclose(matrices(quaternions(noisy[None])[0]), u @ v, atol=1e-7)


# --- what follows from the cameras --------------------------------------------------------------------------


def test_up_height_and_distance_of_a_ring():
    camera_set = camera_set_of(inward(12, radius=3.0, height=4.0, focus=(1.0, 2.0, 3.0)))
    np.testing.assert_allclose(camera_set.focus, [1, 2, 3], atol=1e-9)
    np.testing.assert_allclose(camera_set.up, [0, 0, 1], atol=1e-12)
    assert (camera_set.height(camera_set.up), camera_set.distance) == (pytest.approx(4.0), pytest.approx(5.0))


@pytest.mark.parametrize("s", [1, -1])
def test_up_of_photos_that_lie_on_their_side(s):
    """A ring of cameras that look down, each turned about its axis by a quarter, one way or the other."""
    turn = np.array([[0, -s, 0, 0], [s, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
    ring = inward(12, radius=3.0, height=4.0)
    sideways = [replace(view, camera_to_world=view.camera_to_world @ turn) for view in ring]
    np.testing.assert_allclose(camera_set_of(sideways).up, [0, 0, 1], atol=1e-6)


@pytest.mark.parametrize("elevation", [5, 45, 85])
def test_up_of_a_ring_from_the_side_and_from_above(elevation):
    height, radius = 3 * np.sin(np.radians(elevation)), 3 * np.cos(np.radians(elevation))
    np.testing.assert_allclose(
        camera_set_of(inward(12, radius=radius, height=height)).up, [0, 0, 1], atol=1e-9
    )


def test_ups_that_cancel_out():
    up, down = inward(2, height=0.0)
    flipped = down.camera_to_world @ np.diag([-1.0, -1.0, 1.0, 1.0])
    camera_set = camera_set_of([up, replace(down, camera_to_world=flipped)])
    assert camera_set.up.tolist() == [0, 0, 1]


def test_the_typical_camera_is_the_middle_one():
    """Of a row of cameras that all look one way, and not one that looks elsewhere from the same place."""
    views = []
    for i, x in enumerate([-3.0, -2.0, 0.1, 2.0, 9.0]):
        pose = np.eye(4)
        pose[0, 3] = x
        views.append(View(str(i), pose, 80, 80, 50, 40, 100, 80))
    around = np.diag([-1.0, 1.0, -1.0, 1.0])
    frame = scene_frame(np.array([view.camera_to_world for view in views]), 4.0)
    camera_set = CameraSet(
        (View("behind", around, 80, 80, 50, 40, 100, 80), *views), (), frame.focus, 4.0, True
    )
    assert camera_set.typical.name == "2"


@settings(max_examples=30, deadline=None)
@given(
    st.lists(st.floats(-1, 1), min_size=4, max_size=4).filter(lambda q: np.linalg.norm(q) > 0.1),
    st.floats(0.01, 100),
    st.lists(st.floats(-50, 50), min_size=3, max_size=3),
)
def test_placed_cameras_see_what_they_saw(turn, scale, shift):
    """A point and where it is placed land on the same pixel."""
    camera_set, place = camera_set_of(inward(3), held_out=1), np.eye(4)
    place[:3, :3] = scale * matrices(np.array(turn) / np.linalg.norm(turn))
    place[:3, 3] = shift
    moved = camera_set.placed(place)
    for one, other in zip(moved.views, camera_set.views, strict=True):
        points = seen_points(other, camera_set.distance)
        placed = points @ place[:3, :3].T + place[:3, 3]
        np.testing.assert_allclose(projected(one, placed), projected(other, points), rtol=0, atol=1e-6)
    assert moved.distance == pytest.approx(scale * camera_set.distance)
    np.testing.assert_allclose(moved.focus, place[:3, :3] @ camera_set.focus + place[:3, 3], atol=1e-9)
    np.testing.assert_allclose(moved.up, place[:3, :3] @ camera_set.up / scale, atol=1e-9)
    assert (len(moved.test), moved.test[0].name) == (1, camera_set.test[0].name)


def test_placed_twice_is_placed_by_the_product():
    camera_set, other = camera_set_of(inward(3)), np.linalg.inv(TURNED)
    np.testing.assert_allclose(camera_set.placed(TURNED).placed(other).poses, camera_set.poses, atol=1e-12)
    assert camera_set.placed(np.eye(4)) is camera_set


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([1.0, 1.0, 1.01, 1.0]),
        np.diag([-1.0, 1.0, 1.0, 1.0]),
        np.diag([-2.0, -2.0, -2.0, 1.0]),
        np.eye(4) + np.diag([0.1, 0, 0], k=1),
    ],
    ids=["stretched", "mirrored", "mirrored in a point", "sheared"],
)
def test_cameras_do_not_follow_what_no_camera_can_see(matrix):
    assert camera_set_of(inward(3)).placed(matrix) is None


# --- hostile ------------------------------------------------------------------------------------------------


def spoilt(change) -> dict:
    content = copy.deepcopy(camera_set_of([*inward(3), *inward(1, **LENSES["brown"])], 1, False).content())
    content["names"] = ["a", "b", "c", "a"]
    change(content)
    return content


def put(*keys, value):
    def change(content):
        for key in keys[:-1]:
            content = content[key]
        content[keys[-1]] = value

    return change


HOSTILE = {
    "no object": lambda: [1],
    "no poses": lambda: spoilt(lambda c: c.pop("poses")),
    "no camera": lambda: spoilt(lambda c: c.update(names=[], poses=[], lens=[], held_out=0)),
    "too many": lambda: spoilt(put("names", value=["a"] * (MAX_CAMERAS + 1))),
    "a pose too few": lambda: spoilt(lambda c: c["poses"].pop()),
    "a lens too few": lambda: spoilt(lambda c: c["lens"].pop()),
    "six numbers": lambda: spoilt(lambda c: c["poses"][1].pop()),
    "text": lambda: spoilt(put("poses", 0, 0, value="0")),
    "boolean": lambda: spoilt(put("poses", 0, 0, value=True)),
    "far": lambda: spoilt(put("poses", 0, 0, value=1e300)),
    "no rotation": lambda: spoilt(put("poses", 0, 3, value=2.0)),
    "endless rotation": lambda: spoilt(put("poses", 0, 3, value=1e300)),
    "zero rotation": lambda: spoilt(put("poses", 0, slice(3, 7), value=[0.0] * 4)),
    "lens 2": lambda: spoilt(put("lens", 0, value=2)),
    "lens -1": lambda: spoilt(put("lens", 0, value=-1)),
    "no lens said": lambda: spoilt(lambda c: c.pop("lens")),
    "lens of 7": lambda: spoilt(lambda c: c["lenses"][0].append(0.1)),
    "half a pixel": lambda: spoilt(put("lenses", 0, 0, value=100.5)),
    "no pixel": lambda: spoilt(put("lenses", 0, 1, value=0)),
    "a million pixels a side": lambda: spoilt(put("lenses", 0, 1, value=10**6)),
    "no focal length": lambda: spoilt(put("lenses", 0, 2, value=0)),
    "focal length next to nothing": lambda: spoilt(put("lenses", 0, 3, value=1e-300)),
    "endless distortion": lambda: spoilt(put("lenses", 1, 6, value=1e300)),
    "held out -1": lambda: spoilt(put("held_out", value=-1)),
    "held out 5": lambda: spoilt(put("held_out", value=5)),
    "distance 0": lambda: spoilt(put("distance", value=0)),
    "distance -1": lambda: spoilt(put("distance", value=-1.0)),
    "endless distance": lambda: spoilt(put("distance", value=1e300)),
    "focus far": lambda: spoilt(put("focus", 2, value=-1e300)),
    "focus flat": lambda: spoilt(put("focus", value=[0, 0])),
    "a path": lambda: spoilt(put("names", 0, value="../../etc/cron.d/a")),
    "a path of Windows": lambda: spoilt(put("names", 0, value="..\\a")),
    "no name": lambda: spoilt(put("names", 0, value="")),
    "a name that clears the screen": lambda: spoilt(put("names", 0, value="\x1b[2J")),
    "a long name": lambda: spoilt(put("names", 0, value="a" * 201)),
    "a name twice": lambda: spoilt(put("names", 1, value="a")),
    "surroundings 1": lambda: spoilt(put("surroundings", value=1)),
}


def test_what_is_spoilt_was_good():
    assert len(read_camera_set(spoilt(lambda content: None)).views) == 4


@pytest.mark.parametrize("make", HOSTILE.values(), ids=HOSTILE)
def test_hostile_cameras_are_refused(make):
    """P12, P14, P15: in one sentence that names the file, before anything is made of their numbers."""
    content = {"format": "rfpack", "version": "1.1", "nodes": [], "cameras": make()}
    with pytest.raises(BadSchema, match="^here: .*cameras") as caught:
        parse_scene(json.dumps(content).encode(), "here")
    assert str(caught.value).isprintable()
