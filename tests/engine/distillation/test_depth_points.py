"""Pixels that are known to show a point: which they are, and that they come in turn."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.depth_points import DepthPoints, KnownPoints
from fusedrf_cli.engine.distillation.ray_dataset import Pictures, RayDataset
from fusedrf_cli.engine.rendering.cameras import Camera, look_at

BENT = (0.1, -0.05, 0.0, 0.01, -0.01)
UP = np.array([0.0, 0.0, 1.0])


def cameras() -> list[Camera]:
    """A pinhole, a lens that bends and a fisheye, of different sizes, around the origin."""
    eyes = np.array([[4.0, 0, 1], [0, 4, 1], [-3, -3, 0]])
    lenses = [(40, 30, (0.0,) * 5, False), (24, 36, BENT, False), (32, 32, (0.05, 0, 0, 0), True)]
    return [
        Camera(
            look_at(eye, np.zeros(3), UP), 40, 40, width / 2, height / 2, width, height, bends, str(i), fish
        )
        for i, (eye, (width, height, bends, fish)) in enumerate(zip(eyes, lenses, strict=True))
    ]


def some(count: int = 60) -> KnownPoints:
    """Points around the origin, each shown by all three pictures; some lie outside of one."""
    points = np.random.default_rng(0).uniform(-1.2, 1.2, (count, 3))
    return KnownPoints(np.tile(points, (3, 1)), np.repeat(np.arange(3), count))


def made(ignored: np.ndarray | None = None) -> tuple[DepthPoints, RayDataset]:
    views, generator = cameras(), torch.Generator().manual_seed(0)
    pixels = np.zeros((sum(camera.width * camera.height for camera in views), 4), np.uint8)
    return DepthPoints(views, some(), ignored, generator), RayDataset(
        views, Pictures(pixels, ignored), generator
    )


def test_rays_of_the_pixels_pass_by_the_points():
    """Within half a diagonal of a pixel, through any lens."""
    depth_points, dataset = made()
    chosen, points = depth_points.draw(150)
    assert 100 < len(chosen) <= 150
    rays_o, rays_d, *_ = dataset.of(chosen)
    away = points - rays_o
    aside = np.linalg.norm(np.cross(away, rays_d), axis=1) / np.linalg.norm(away, axis=1)
    assert (np.einsum("ni,ni->n", away, rays_d) > 0).all()
    assert aside.max() < 0.75 / 40 and np.median(aside) < 0.5 / 40


def test_every_one_comes_once_before_any_again():
    depth_points, _ = made()
    count = len(depth_points.points)
    found = np.concatenate([depth_points.draw(7)[1] for _ in range(count)])[: 7 * count]
    for turn in np.split(found, 7):
        assert np.array_equal(np.unique(turn, axis=0), np.unique(depth_points.points, axis=0))


def test_what_a_mask_excludes_is_not_drawn():
    depth_points, _ = made()
    ignored = np.zeros(40 * 30 + 24 * 36 + 32 * 32, bool)
    ignored[depth_points.pixels[::2]] = True
    left, _ = made(ignored)
    assert 0 < len(left.pixels) < len(depth_points.pixels)
    assert not ignored[left.pixels].any()


def test_points_outside_of_a_picture_or_behind_it_are_left_out():
    views = cameras()
    known = KnownPoints(np.array([[0.0, 0, 0], [9, 0, 1], [0, 0, 40]]), np.zeros(3, np.int64))
    depth_points = DepthPoints(views, known, None, torch.Generator())
    assert depth_points.points.tolist() == [[0, 0, 0]]
    assert divmod(int(depth_points.pixels[0]), 40) == pytest.approx((15, 20), abs=1)
