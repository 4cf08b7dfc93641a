"""The views that fused scenes are judged by, and what they say of a student."""

from dataclasses import replace

import numpy as np
import pytest

from fusedrf_cli.bridge.evaluation_views import (
    EvaluationViewConfig,
    ViewTarget,
    between,
    evaluation_views,
    share_shown,
)
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.distillation.evaluation import Evaluator
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera, look_at
from tests.analytic.fields import Box, Tint
from tests.bridge.test_views import FOCUS, photo
from tests.formats.test_camera_set import camera_set_of
from tests.formats.test_captures import looking_at

WHOLE, MOST_OBJECTS = EvaluationViewConfig.whole, EvaluationViewConfig.most_objects
BIG = (800, 600)
BOX = np.array([-2.0, -2, -2, 2, 2, 2])
PLACE = replace(
    camera_set_of([photo(i, FOCUS + 3 * np.array([np.cos(i), np.sin(i), 0.3]), BIG) for i in range(6)]),
    surroundings=True,
)


@pytest.fixture(autouse=True)
def usual(in_force):
    """Other tests of this package look at less."""
    in_force(EvaluationViewConfig())


def subject(name: str, at, camera_set=None) -> ViewTarget:
    at = np.array(at, float)
    return ViewTarget(name, np.concatenate([at - 0.2, at + 0.2]), camera_set)


OBJECTS = [subject("cup", (1, 0, 0)), subject("bowl", (0, 1, 0), replace(PLACE, surroundings=False))]


def shown(camera, point) -> tuple[float, float]:
    """Column and row at which a pinhole shows a point (3,), in widths and heights."""
    x, y, back = (point - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    column, row = camera.cx - camera.fl_x * x / back, camera.cy + camera.fl_y * y / back
    return column / camera.width, row / camera.height


@pytest.mark.parametrize("camera_set", [None, PLACE])
def test_the_whole_and_every_object_are_looked_at(camera_set):
    found = evaluation_views(camera_set, BOX, OBJECTS, 4, (160, 160), 1)
    assert [look.of for look in found[:WHOLE]] == [None] * WHOLE
    assert {look.of for look in found[WHOLE:]} == {"cup", "bowl"}
    assert len({look.camera.name for look in found}) == len(found)
    assert {(look.camera.width, look.camera.height) for look in found} == {(160, 160)}
    many = evaluation_views(camera_set, BOX, [subject(f"o{i}", (i, 0, 0)) for i in range(20)], 4, (16, 16), 1)
    assert len(many) == WHOLE + MOST_OBJECTS == WHOLE + len({look.of for look in many if look.of})


def test_objects_are_looked_at_as_they_were_photographed():
    """In the photos' resolution and from where they were taken; framed where there are no photos."""
    for seed in range(8):
        found = {look.of: look.camera for look in evaluation_views(None, BOX, OBJECTS, 4, (160, 160), seed)}
        column, row = shown(found["bowl"], np.array([0.0, 1.0, 0.0]))
        assert -0.2 < column < 1.2 and -0.2 < row < 1.2
        assert found["bowl"].fl_x == pytest.approx(1.2 * BIG[0])
        assert np.linalg.norm(found["bowl"].camera_to_world[:3, 3] - FOCUS) < 3.2
        column, row = shown(found["cup"], np.array([1.0, 0.0, 0.0]))
        assert -0.2 < column < 1.2 and -0.2 < row < 1.2  # a part of it
        whole = framing_camera(OBJECTS[0].box, 0, 0.4, 400, 400)
        assert found["cup"].fl_x == pytest.approx(whole.fl_x)


def test_a_place_is_looked_at_from_between_its_cameras():
    """All of what a photo shows, and a part of it in full."""
    eyes = PLACE.poses[:, :3, 3]
    full, part = [], []
    for seed in range(6):
        for look in evaluation_views(PLACE, BOX, [], 4, (160, 160), seed):
            eye = look.camera.camera_to_world[:3, 3]
            assert np.linalg.norm(eyes - eye, axis=1).min() < 1.6 and abs(eye[2] - eyes[0, 2]) < 1e-6
            (full if look.camera.fl_x > 500 else part).append(look.camera.fl_x)
    assert len(full) == len(part) == 12
    assert np.allclose(full, 1.2 * BIG[0]) and np.allclose(part, 1.2 * 160)


def test_views_follow_their_seed():
    found = (evaluation_views(PLACE, BOX, OBJECTS, 6, (32, 32), seed) for seed in (1, 1, 2))
    poses = [[look.camera.camera_to_world for look in drawn] for drawn in found]
    assert np.array_equal(poses[0], poses[1]) and not np.array_equal(poses[0], poses[2])


def test_what_hides_an_object_counts():
    """A wall stands on one side of a ball, and mist around its foot: neither from behind the wall nor from
    inside of it or of the mist is the ball seen, though what little shows of the ball's box lies there."""
    ball = Placed("ball", Box(500.0, (0.2, 0.2, 0.2)), np.eye(4))
    wall, mist = np.eye(4), np.eye(4)
    wall[0, 3], mist[1, 3] = 1.0, -2.0
    fog = Placed("mist", Box(2.0, (0.5, 1.9, 0.5)), mist)
    scene = ComposedField([ball, Placed("wall", Box(500.0, (0.1, 3.0, 3.0)), wall), fog])
    subject_of = ViewTarget("ball", np.array([-0.2] * 3 + [0.2] * 3), None)

    def seen_from(x: float, y: float = 0.01) -> float:
        pose = look_at(np.array([x, y, 0.01]), np.zeros(3), np.array([0.0, 0.0, 1.0]))
        camera = Camera(pose, 100.0, 100.0, 20.0, 10.0, 40, 20)
        return share_shown(scene, {"ball": ComposedField([ball])}, camera, subject_of)

    assert seen_from(-0.7) == 1.0  # it fills the view
    assert seen_from(2.5) == seen_from(1.02) == seen_from(0.0, -1.5) == 0.0
    assert seen_from(-1.5) == pytest.approx(0.2 * 100 / 1.3 / 20, abs=2 / 12)  # its near side in columns


def test_views_of_an_object_are_drawn_anew_until_it_is_seen():
    """From one half of the directions alone; where none of the tries sees enough, from the best of them."""
    behind = subject("ball", (0, 0, 0))

    def from_one_half(camera, of) -> float:
        return float(camera.camera_to_world[0, 3] < 0)

    found = (evaluation_views(None, BOX, [behind], 8, (32, 32), seed, from_one_half) for seed in range(4))
    eyes = np.array([[look.camera.camera_to_world[:3, 3] for look in drawn] for drawn in found])
    assert (eyes[:, 3:, 0] < 0).all() and (eyes[:, :3, 0] > 0).any()

    trial = []

    def hardly(camera, of) -> float:
        trial.append(
            (0.9 * EvaluationViewConfig.shown / (2 + camera.camera_to_world[2, 3]), camera.camera_to_world)
        )
        return trial[-1][0]

    (*_, last) = evaluation_views(None, BOX, [behind], WHOLE + 1, (32, 32), 0, hardly)
    assert len(trial) == EvaluationViewConfig.tries
    assert np.array_equal(last.camera.camera_to_world, max(trial, key=lambda one: one[0])[1])


def test_a_camera_between_two_looks_where_they_look():
    views = [photo(i, FOCUS + 3 * np.array([np.cos(a), np.sin(a), 0.3]), BIG) for i, a in enumerate((0, 0.5))]
    rng = np.random.default_rng(0)
    for _ in range(20):
        pose = between(views, rng).camera_to_world
        assert np.allclose(pose[:3, :3].T @ pose[:3, :3], np.eye(3), atol=1e-9)
        towards = FOCUS - pose[:3, 3]
        assert -pose[:3, 2] @ towards / np.linalg.norm(towards) > 0.999
    assert np.allclose(between(views[:1], rng).camera_to_world, views[0].camera_to_world)


def test_a_verdict_counts_the_covered_pixels_apart():
    """A wall that covers a known part of the picture and is wrong by a known amount of each colour."""
    teacher, student = (
        ComposedField([Placed("wall", Box(500.0, (0.5, 0.01, 0.5), tint=Tint.of(g, g, g)), np.eye(4))])
        for g in (0.5, 0.6)
    )
    pose = np.array(looking_at(np.array([0.0, -4.0, 0.0]), np.zeros(3)))
    camera = replace(framing_camera(BOX, 0, 0, 64, 64), camera_to_world=pose)
    judge = Evaluator(teacher, [camera], teacher.origin)
    found = judge.evaluate(student)
    assert found.covered == pytest.approx(20, abs=0.3)
    assert found.psnr == pytest.approx(found.covered - 10 * np.log10(found.share), abs=0.2)
    assert 0.02 < found.share < 0.4 and found.views == pytest.approx([judge(student)])
    away = replace(
        camera, camera_to_world=np.array(looking_at(np.array([0.0, -4, 0]), np.array([0.0, -9, 0])))
    )
    of_nothing = Evaluator(teacher, [away], teacher.origin).evaluate(student)
    assert of_nothing.covered is None and of_nothing.share == 0
