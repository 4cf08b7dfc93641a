"""Inexact poses: what is found of them from a known field, and what is learnt while they are found."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.fit import FitRun
from fusedrf_cli.engine.distillation.poses import (
    PoseConfig,
    Poses,
    angles_between,
    changed,
    changed_each,
    poses_of,
    refined,
    turns,
)
from fusedrf_cli.engine.distillation.ray_dataset import RayDataset
from fusedrf_cli.engine.rendering.cameras import orbit
from tests.engine.conftest import BOX
from tests.engine.distillation.test_exposure import BALL, LONG
from tests.engine.distillation.test_exposure import pictures as pictures_of_ball


def placed(cameras, shift: Poses):
    """The cameras at poses."""
    matrices = [camera.camera_to_world.copy() for camera in cameras]
    for matrix, rotation, position in zip(matrices, *shift, strict=True):
        matrix[:3, :3], matrix[:3, 3] = rotation, position
    return [replace(c, camera_to_world=m) for c, m in zip(cameras, matrices, strict=True)]


def shaken(cameras, pixels: float, seed: int = 0):
    """Cameras that are off by about so many pixels, in turn and place, with nothing in common."""
    g = np.random.default_rng(seed)
    angle = pixels / cameras[0].fl_x
    off = g.normal(0, angle / np.sqrt(3), (len(cameras), 6)) * [1, 1, 1, 3, 3, 3]
    return placed(cameras, changed(poses_of(cameras), off))


def spot(camera, pose: Poses, i: int) -> np.ndarray:
    """Where the middle of the ball and points around it are in a picture, in pixels."""
    points = BALL.centre + 0.5 * np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
    seen = (points - pose.position[i]) @ pose.rotation[i]
    return camera.fl_x * seen[:, :2] / -seen[:, 2:]


def test_turns_are_exponentials():
    g = np.random.default_rng(0)
    angles = np.concatenate([g.normal(size=(5, 3)), np.zeros((1, 3)), 1e-9 * np.ones((1, 3))])
    for found, (x, y, z) in zip(turns(angles), angles, strict=True):
        across = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
        np.testing.assert_allclose(found, torch.matrix_exp(across).numpy(), atol=1e-12)
    start = Poses(turns(g.normal(size=(7, 3))), g.normal(size=(7, 3)))
    turned = changed_each(start, np.concatenate([angles, np.zeros((7, 3))], 1))
    np.testing.assert_allclose(angles_between(start, turned), np.linalg.norm(angles, axis=1), atol=2e-8)


def test_what_all_poses_have_in_common_is_left_out():
    """All cameras turned about their middle, moved, drawn apart: nothing of it is left, in first order."""
    g = np.random.default_rng(1)
    start = Poses(turns(g.normal(size=(9, 3))), g.normal(size=(9, 3)))
    small = 1e-5 * g.normal(size=7)
    around = start.position - start.position.mean(0)
    alike = np.cross(small[:3], around) + small[3:6] + small[6] * around
    own = 1e-5 * g.normal(size=(9, 6))
    for extra in (0, own):
        one = changed(start, np.concatenate([np.tile(small[:3], (9, 1)), alike], 1) + extra)
        other = changed(start, np.zeros((9, 6)) + extra)
        np.testing.assert_allclose(one.position, other.position, atol=1e-8)
        np.testing.assert_allclose(one.rotation, other.rotation, atol=1e-8)


@pytest.mark.parametrize("pixels", [pytest.param(0.7, marks=pytest.mark.slow), 3.0])
def test_poses_are_found_again_from_what_a_field_shows(pixels):
    """Photos of the field itself: after a few rounds its points are where they were in every picture."""
    cameras = orbit(BOX, 5, 48, 48)
    truth, images = poses_of(cameras), pictures_of_ball(cameras)
    images[..., 3] = 255 * (images[..., 3] > 250)
    dataset = RayDataset(shaken(cameras, pixels), images, torch.Generator())

    def off() -> float:
        found = [spot(cameras[i], dataset.poses, i) - spot(cameras[i], truth, i) for i in range(5)]
        return float(np.sqrt(np.mean(np.square(found))))

    before, generator = off(), torch.Generator().manual_seed(2)
    for probe in (4.0, 4.0, 3.0, 2.0, 2.0, 1.0, 1.0, 0.5, 0.5, 0.5):
        *rays, colours = dataset.sample(800, generator)
        dataset.set_poses(
            changed_each(dataset.poses, refined(BALL, rays, colours, 0.0, probe * dataset.pixel))
        )
    assert before > 0.3 * pixels and off() < 0.25 * before and off() < 0.25


def test_poses_of_which_little_is_seen_stay():
    cameras = orbit(BOX, 3, 24, 24)
    images = pictures_of_ball(cameras)
    dataset = RayDataset(shaken(cameras, 3.0), images, torch.Generator())
    *rays, colours = dataset.sample(1500, torch.Generator())
    colours[1, PoseConfig.few - 1 :] = torch.nan
    away = rays[0].copy()
    away.reshape(3, 1500, 3)[2] += 100  # from there the field does not show
    change = refined(BALL, (away, rays[1]), colours, 0.0, dataset.pixel)
    assert change[0].any() and not change[1:].any()
    assert np.isfinite(change).all()


@pytest.mark.slow
def test_what_is_learnt_from_inexact_poses_is_sharper():
    """Poses end nearer to the true ones, but for what all have in common, and the photos, which the ball
    fills, are shown better."""
    cameras = [replace(c, fl_x=2 * c.fl_x, fl_y=2 * c.fl_y) for c in orbit(BOX, 10, 48, 48)]
    images = pictures_of_ball(cameras)
    given = shaken(cameras, 4.0)
    reached, off = [], []
    for refine in (False, True):
        run = FitRun.start(given, images, BOX, replace(LONG, poses=refine))
        run.finish()
        reached.append(run.psnr)
        found = [
            spot(cameras[i], run.pool.poses, i) - spot(cameras[i], poses_of(cameras), i) for i in range(10)
        ]
        off.append(np.sqrt(np.mean(np.square(np.array(found) - np.mean(found, 0)))))
    assert reached[1] > reached[0] + 1 and off[1] < 0.7 * off[0]
