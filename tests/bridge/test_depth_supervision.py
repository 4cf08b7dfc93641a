"""Which sparse points tell how far away things are."""

from pathlib import Path

import numpy as np
import pytest

from formats.points import SparsePoints
from formats.views import Capture, View
from fusedrf_cli.bridge.depth_supervision import certain, known_points
from fusedrf_cli.bridge.scene_bounds import SceneBounds
from fusedrf_cli.engine.kernels.learning import DEPTH_TOLERANCE
from tests.formats.test_captures import looking_at

FOCAL = 500.0


def views(eyes: np.ndarray, seen=None) -> tuple[View, ...]:
    return tuple(
        View(f"{i}", np.array(looking_at(eye, np.zeros(3))), FOCAL, FOCAL, 200, 150, 400, 300, seen=seen)
        for i, eye in enumerate(eyes)
    )


def off(eyes: np.ndarray, point: np.ndarray, rng) -> float:
    """By how much of its mean distance from the eyes, on average, a point is misplaced along a line of sight
    where it is put nearest to all lines of sight (least squares), each off by half a pixel."""
    errors = []
    for _ in range(400):
        lines = point - eyes
        away = np.linalg.norm(lines, axis=1, keepdims=True)
        lines = lines / away + rng.normal(size=lines.shape) * 0.5 / FOCAL
        lines /= np.linalg.norm(lines, axis=1, keepdims=True)
        across = np.eye(3) - lines[:, :, None] * lines[:, None]
        found = np.linalg.solve(across.sum(0), np.einsum("nij,nj->i", across, eyes))
        errors.append(np.linalg.norm(found - point) / away.mean())
    return float(np.sqrt(np.mean(np.square(errors))))


@pytest.mark.parametrize("count", [3, 6])
def test_a_point_is_certain_where_lines_of_sight_that_are_a_little_off_meet_near_it(count):
    rng = np.random.default_rng(0)
    for apart in (0.02, 0.05, 0.3, 0.6):
        eyes = np.stack(
            [np.linspace(-apart, apart, count), np.full(count, -4.0), rng.normal(size=count) * apart], 1
        )
        everyone = np.arange(count)
        sure = certain(np.zeros((1, 3)), views(eyes), np.zeros(count, int), everyone)[0]
        error = off(eyes, np.zeros(3), rng)
        assert sure or error > 0.7 * DEPTH_TOLERANCE
        assert not sure or error < 1.5 * DEPTH_TOLERANCE


def test_two_photos_are_not_enough():
    eyes = np.array([[3.0, 0, 1], [0, 3, 1], [-3, 0, 1]])
    point, picture = np.array([0, 0, 1, 1, 1]), np.array([0, 1, 0, 1, 2])
    assert certain(np.zeros((3, 3)), views(eyes), point, picture).tolist() == [False, True, False]


def test_points_come_in_the_frame_of_the_field_with_the_photos_that_show_them():
    eyes = np.array([[3.0, 0, 1], [0, 3, 1], [-3, 0, 1]])
    points = SparsePoints(np.array([[5.0, 5, 5], [0.2, 0.4, 0.6]]), np.zeros((2, 3), np.uint8))
    box, origin = np.array([-1.0, -1, -1, 1, 1, 1]), np.diag([2.0, 2, 2, 1])
    origin[:3, 3] = 0.1, 0.2, 0.3

    def capture(seen) -> Capture:
        return Capture(Path(), "colmap", views(eyes, seen), (), box, True, points=points)

    known = known_points(capture(np.array([1])), SceneBounds(box, origin, True))
    assert known.points == pytest.approx(np.tile([0.05, 0.1, 0.15], (3, 1)))
    assert known.picture.tolist() == [0, 1, 2]
    assert known_points(capture(None), SceneBounds(box, origin, True)) is None
    assert known_points(capture(np.array([1])), SceneBounds(box, origin)) is None
