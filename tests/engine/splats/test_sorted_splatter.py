"""The splatter of the tests against closed forms."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.engine.splats.sorted_splatter import Camera, rendered

SH_0, SH_1 = 0.28209479177387814, 0.4886025119029199
FOCAL, SIDE = 40.0, 33
CAMERA = Camera(np.eye(4), FOCAL, SIDE, SIDE)
"""At the origin, along -z; the middle of pixel 16 is the middle of the picture."""


def splats(centres, scales, opacities, colours, turn=None, harmonics=None) -> SimpleNamespace:
    turn = Rotation.identity() if turn is None else turn
    count = len(centres)
    first = (np.array(colours, float)[:, None] - 0.5) / SH_0
    return SimpleNamespace(
        centres=np.array(centres, float),
        scales=np.broadcast_to(np.array(scales, float), (count, 3)),
        rotations=np.tile(np.roll(turn.as_quat(), 1), (count, 1)),
        opacities=np.array(opacities, float),
        harmonics=first if harmonics is None else np.concatenate([first, harmonics], 1),
    )


def offsets() -> tuple[np.ndarray, np.ndarray]:
    """(H, W) x and y of pixels from the middle, y down."""
    y, x = np.mgrid[:SIDE, :SIDE] + 0.5 - SIDE / 2
    return x, y


def cut(alpha: np.ndarray) -> np.ndarray:
    return np.where(alpha < 1 / 255, 0, np.minimum(alpha, 0.99))


@pytest.mark.parametrize("low_pass", [0, 0.3])
def test_a_ball_on_the_axis(low_pass):
    """o exp(-r² / 2v), v = (f s / z)² and the low-pass."""
    picture, alpha = rendered(splats([[0, 0, -4]], 0.5, [0.8], [[1, 0.5, 0]]), CAMERA, low_pass)
    x, y = offsets()
    expected = cut(0.8 * np.exp(-(x**2 + y**2) / 2 / (25 + low_pass)))
    np.testing.assert_allclose(alpha, expected, atol=1e-12)
    np.testing.assert_allclose(picture, expected[..., None] * [1, 0.5, 0], atol=1e-12)


def test_a_turned_ellipsoid_on_the_axis():
    """Turned by 30 degrees about the axis, counterclockwise, which is clockwise where y is down."""
    turn = Rotation.from_rotvec([0, 0, np.pi / 6])
    _, alpha = rendered(splats([[0, 0, -4]], [0.6, 0.2, 9], [0.8], [[1, 1, 1]], turn), CAMERA, 0)
    x, y = offsets()
    long, short = x * np.cos(np.pi / 6) - y * np.sin(np.pi / 6), x * np.sin(np.pi / 6) + y * np.cos(np.pi / 6)
    expected = cut(0.8 * np.exp(-((long / 6) ** 2 + (short / 2) ** 2) / 2))
    np.testing.assert_allclose(alpha, expected, atol=1e-12)


def test_a_ball_beside_the_axis_is_stretched_away_from_the_middle():
    """J = f / z [1, -x / z]: the variance along x grows by 1 + (x / z)²."""
    _, alpha = rendered(splats([[0.5, 0, -4]], 0.2, [0.8], [[1, 1, 1]]), CAMERA, 0)
    x, y = offsets()
    expected = cut(0.8 * np.exp(-((x - 5) ** 2 / (1 + 1 / 64) + y**2) / 2 / 4))
    np.testing.assert_allclose(alpha, expected, atol=1e-12)


def test_the_nearer_one_is_in_front_whatever_their_order():
    two = splats([[0, 0, -6], [0, 0, -4]], 0.5, [1, 0.6], [[1, 0, 0], [0, 1, 0]])
    picture, alpha = rendered(two, CAMERA)
    assert picture[16, 16] == pytest.approx([0.4 * 0.99, 0.6, 0])
    assert alpha[16, 16] == pytest.approx(1 - 0.4 * 0.01)
    for name, rows in vars(two).items():
        setattr(two, name, rows[::-1])
    assert np.array_equal(rendered(two, CAMERA)[0], picture)


def test_splats_behind_and_too_near_are_not_seen():
    _, alpha = rendered(splats([[0, 0, 4], [0, 0, -0.1]], 0.5, [1, 1], [[1, 1, 1]] * 2), CAMERA)
    assert not alpha.any()


def test_colours_depend_on_the_direction_to_the_centre_and_are_not_negative():
    """The third coefficient of degree 1 is -√(3/4π) x."""
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([0, np.pi / 2, 0]).as_matrix(), [4, 0, 0]
    harmonics = np.zeros((1, 3, 3))
    harmonics[0, 2] = [0.2 / SH_1, -0.2 / SH_1, -2 / SH_1]
    seen = splats([[0, 0, 0]], 0.5, [0.8], [[0.5, 0.5, 0.5]], harmonics=harmonics)
    picture, _ = rendered(seen, Camera(pose, FOCAL, SIDE, SIDE))  # along -x
    assert picture[16, 16] == pytest.approx(0.8 * np.array([0.7, 0.3, 0]))
