"""Rays to learn along: they hit what they are to hit, or are those of the views."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.rendering.cameras import Camera, look_at, projected
from fusedrf_cli.engine.spaces import unbounded
from tests.engine.conftest import BOX, Gaussian, chord_of_box

SMALL = np.array([0.5, 0.4, 0.6, 0.55, 0.45, 0.65])
OTHER = np.array([-0.8, -0.9, -0.5, -0.7, -0.8, -0.4])
VIEW = Camera(
    look_at(np.array([3.0, -4, 2]), np.zeros(3), np.array([0.0, 0, 1])), 50.0, 60.0, 30.0, 22.0, 64, 48
)
VIEWS = (
    VIEW,
    replace(VIEW, camera_to_world=look_at(np.array([-9.0, 0, 1]), np.ones(3), np.array([0.0, 0, 1]))),
)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def hits(box, rays_o, rays_d) -> np.ndarray:
    grown = box + 1e-9 * np.array([-1, -1, -1, 1, 1, 1])
    return chord_of_box(grown[:3], grown[3:], rays_o, rays_d) > 0


@pytest.mark.parametrize("count", [1, 7, 3000])
def test_every_ray_hits_the_box_and_starts_outside(count):
    rays_o, rays_d = RaySampler([BOX]).draw(count, seeded())
    assert rays_o.shape == rays_d.shape == (count, 3)
    assert hits(BOX, rays_o, rays_d).all()
    np.testing.assert_allclose(np.linalg.norm(rays_d, axis=1), 1)
    centre, radius = (BOX[:3] + BOX[3:]) / 2, np.linalg.norm(BOX[3:] - BOX[:3]) / 2
    assert (np.linalg.norm(rays_o - centre, axis=1) >= 1.19 * radius).all()


def test_small_objects_get_their_share():
    """A box of a millionth of the volume gets a quarter of all rays, as the other one does."""
    rays_o, rays_d = RaySampler([BOX, SMALL, OTHER]).draw(4000, seeded())
    for box in (SMALL, OTHER):
        assert 1000 <= hits(box, rays_o, rays_d).sum() < 1400
    assert (hits(BOX, rays_o, rays_d) | hits(SMALL, rays_o, rays_d) | hits(OTHER, rays_o, rays_d)).all()


def test_rays_follow_the_seed():
    first, again, other = (RaySampler([BOX]).draw(50, seeded(s))[0] for s in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_half_the_rays_are_those_of_the_views():
    """From their places, through all of their pictures, evenly; the others aim at the objects."""
    rays_o, rays_d = RaySampler([BOX, SMALL], VIEWS).draw(8000, seeded())
    np.testing.assert_allclose(np.linalg.norm(rays_d, axis=1), 1)
    seen = 0
    for view in VIEWS:
        own = (rays_o == view.camera_to_world[:3, 3]).all(1)
        pixels, _, inside = projected(view, rays_o[own] + 5 * rays_d[own])
        assert inside.all() and 1800 < own.sum() < 2200
        share = pixels / (view.width, view.height)
        np.testing.assert_allclose(share.mean(0), 0.5, atol=0.03)
        np.testing.assert_allclose(share.std(0), 12**-0.5, atol=0.02)
        seen += own.sum()
    assert seen == 4000 and hits(SMALL, rays_o, rays_d).sum() >= 4000


def test_where_nothing_stands_in_a_place_all_rays_are_those_of_the_views():
    rays_o = RaySampler([BOX], VIEWS).draw(500, seeded())[0]
    assert all(
        (rays == VIEWS[0].camera_to_world[:3, 3]).all() or (rays == VIEWS[1].camera_to_world[:3, 3]).all()
        for rays in rays_o
    )


def test_views_count_in_a_place_alone():
    """And no ray aims at the box of what fills all of space, which has none."""
    thing = Placed("thing", Gaussian(density=8.0).occupy(12), np.eye(4))
    place = Gaussian(density=8.0)
    place.occupancy = OccupancyGrid.full(unbounded.WHOLE, 8, unbounded)
    assert RaySampler.of(ComposedField([thing]), VIEWS).views == ()
    scene = ComposedField([thing, Placed("place", place, np.eye(4))])
    sampler = RaySampler.of(scene, VIEWS)
    assert sampler.views == VIEWS and len(sampler.boxes) == 2
    np.testing.assert_array_equal(sampler.boxes[1], thing.aabb)
    assert len(RaySampler.of(scene).boxes) == 3
