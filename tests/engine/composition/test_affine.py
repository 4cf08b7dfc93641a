"""Placing a field by any invertible affine: optical depths against closed forms, and colours that turn
along.
"""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import CONDITION_LIMIT, Placed, rigid_motion
from fusedrf_cli.engine.composition.composed import ComposedField
from tests.analytic.fields import BOX, AnalyticField, Gaussian
from tests.analytic.rays import DIRECTIONS_26, SHEAR, affine, rays_at, turn, unit

PLACEMENTS = {
    "as it is": np.eye(4),
    "tiny": affine(1e-3),
    "half": affine(0.5),
    "huge": affine(1e3, (5.0, 6.0, 7.0)),
    "stretch": affine((1, 1, 5)),
    "squeeze": affine((0.2, 3, 1)),
    "shear": affine(SHEAR),
    "mirror": affine((-1, 1, 1)),
    "rotation": affine(turn(37)),
    "all of it": affine(turn(70) @ np.array(SHEAR) @ np.diag([-0.5, 2, 1.2])),
    "far": affine(turn(20), (1e6, -1e6, 1e6)),
}


class Probe(AnalyticField):
    """Red seen against +x, blue seen against -x: a degree-1 colour in the object's frame."""

    def sigma(self, points):
        return np.ones(len(points))

    def colour(self, points, dirs):
        return np.stack([0.5 - 0.5 * dirs[:, 0], np.zeros(len(dirs)), 0.5 + 0.5 * dirs[:, 0]], 1)


@pytest.mark.parametrize("name", PLACEMENTS)
def test_every_ray_keeps_its_optical_depth(name):
    """The integral of the world's σ along a world ray is the object's closed form along the object's ray."""
    matrix, field = PLACEMENTS[name], Gaussian()
    object_o, object_d = rays_at(BOX, 40, seed=3)
    world_o = object_o @ matrix[:3, :3].T + matrix[:3, 3]
    v = object_d @ matrix[:3, :3].T
    length = np.linalg.norm(v, axis=1)
    composed = ComposedField([Placed("one", field, matrix)])
    samples = 4000
    t = (np.arange(samples) + 0.5) / samples * 6.0 * length[:, None]  # 6 units of the object's frame
    dirs = v / length[:, None]
    points = (world_o - composed.origin)[:, None] + t[..., None] * dirs[:, None]
    directions = np.broadcast_to(dirs[:, None], points.shape).reshape(-1, 3).copy()
    sigma, _ = composed.query(torch.from_numpy(points.reshape(-1, 3)), torch.from_numpy(directions), False)
    found = sigma.double().numpy().reshape(len(v), samples).sum(1) * 6.0 * length / samples
    wanted = field.depth(object_o, object_d)
    assert wanted.max() > 0.5
    np.testing.assert_allclose(found, wanted, rtol=1e-5, atol=1e-6)


def test_uniform_scale_divides_density():
    for k in (0.25, 1.0, 8.0):
        placed = Placed("one", Gaussian(), affine(k))
        _, _, stretch = placed.to_object(torch.zeros(26, 3), torch.from_numpy(DIRECTIONS_26))
        np.testing.assert_allclose(stretch.numpy(), 1 / k, rtol=1e-12)
        assert placed.voxel_size == pytest.approx(0.02 * k)


def test_points_and_directions_come_back():
    matrix = PLACEMENTS["all of it"]
    points, dirs = (
        np.random.default_rng(1).normal(size=(50, 3)),
        unit(np.random.default_rng(2).normal(size=(50, 3))),
    )
    world = points @ matrix[:3, :3].T + matrix[:3, 3]
    v = dirs @ matrix[:3, :3].T
    x, d, stretch = Placed("one", Gaussian(), matrix).to_object(
        torch.from_numpy(world), torch.from_numpy(unit(v))
    )
    np.testing.assert_allclose(x, points, atol=1e-12)
    np.testing.assert_allclose(d, dirs, atol=1e-12)
    np.testing.assert_allclose(stretch, 1 / np.linalg.norm(v, axis=1), rtol=1e-12)


@pytest.mark.parametrize("linear", [turn(90, (0, 0, 1)), turn(37), np.diag([-1.0, 1, 1])])
def test_view_dependent_colour_turns_with_the_object(linear):
    """From 26 sides, the side that was red is red where the object's own front now looks."""
    composed = ComposedField([Placed("one", Probe(), affine(linear))])
    dirs = torch.from_numpy(DIRECTIONS_26)
    at = torch.from_numpy(np.tile(np.array([0.3, -0.2, 0.1]) - composed.origin, (26, 1)))
    _, rgb = composed.query(at, dirs)
    front = linear[:, 0]  # the object's +x in the world
    np.testing.assert_allclose(rgb[:, 0], 0.5 - 0.5 * DIRECTIONS_26 @ front, atol=1e-6)
    np.testing.assert_allclose(rgb[:, 2], 0.5 + 0.5 * DIRECTIONS_26 @ front, atol=1e-6)


def test_a_flat_placement_is_refused_by_its_condition():
    Placed("thin", Gaussian(), affine((1, 1, 2 / CONDITION_LIMIT)))
    for scale in ((1, 1, 0.5 / CONDITION_LIMIT), (1, 0, 1)):
        with pytest.raises(ValueError, match="'flat' is singular"):
            Placed("flat", Gaussian(), affine(scale))
    assert Placed("small", Gaussian(), affine(1e-5)).condition == pytest.approx(1)


def test_moved_shifts_only_the_frame():
    placed = Placed("one", Gaussian(), PLACEMENTS["all of it"])
    moved = placed.moved(np.array([1.0, 2, 3]))
    np.testing.assert_allclose(moved.aabb, placed.aabb - [1, 2, 3, 1, 2, 3])
    assert np.array_equal(moved.object_to_world[:3, :3], placed.object_to_world[:3, :3])
    assert placed.object_to_world[0, 3] == 0.3  # the original stays


def test_a_twist_turns_and_shifts():
    """By Rodrigues' formula; a turn and its opposite are none; differentiable at 0 too."""
    axis, shift = np.array([1.0, 2.0, -0.5]), [0.3, -0.2, 0.1]
    twist = np.concatenate([np.radians(40) * axis / np.linalg.norm(axis), np.zeros(3)])
    np.testing.assert_allclose(rigid_motion(torch.from_numpy(twist)), affine(turn(40), (0, 0, 0)), atol=1e-14)
    moved = torch.tensor([0.0, 0, 0, *shift], dtype=torch.float64, requires_grad=True)
    np.testing.assert_allclose(rigid_motion(moved).detach(), affine(1, shift), atol=1e-15)
    both = torch.tensor([0.4, -1.0, 0.2, *shift], dtype=torch.float64, requires_grad=True)
    np.testing.assert_allclose((rigid_motion(both) @ rigid_motion(-both)).detach(), np.eye(4), atol=1e-14)
    assert rigid_motion(both)[3].tolist() == [0, 0, 0, 1]
    for at in (moved, both, torch.zeros(6, dtype=torch.float64, requires_grad=True)):
        assert torch.autograd.gradcheck(rigid_motion, at)
