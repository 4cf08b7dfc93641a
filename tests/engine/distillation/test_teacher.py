"""What is asked of a teacher: rays that hit, and pixels as the renderer has them."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.teacher import EMPTY_SHARE, MATTER, ask, random_rays
from fusedrf_cli.engine.rendering.volume import render_rays
from tests.engine.conftest import BOX, Gaussian, Slab, chord_of_box

SMALL = np.array([0.5, 0.4, 0.6, 0.55, 0.45, 0.65])
OTHER = np.array([-0.8, -0.9, -0.5, -0.7, -0.8, -0.4])


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def hits(box, rays_o, rays_d) -> np.ndarray:
    grown = box + 1e-9 * np.array([-1, -1, -1, 1, 1, 1])
    return chord_of_box(grown[:3], grown[3:], rays_o, rays_d) > 0


@pytest.mark.parametrize("count", [1, 7, 3000])
def test_every_ray_hits_the_box_and_starts_outside(count):
    rays_o, rays_d = random_rays([BOX], count, seeded())
    assert rays_o.shape == rays_d.shape == (count, 3)
    assert hits(BOX, rays_o, rays_d).all()
    np.testing.assert_allclose(np.linalg.norm(rays_d, axis=1), 1)
    centre, radius = (BOX[:3] + BOX[3:]) / 2, np.linalg.norm(BOX[3:] - BOX[:3]) / 2
    assert (np.linalg.norm(rays_o - centre, axis=1) >= 1.19 * radius).all()


def test_small_objects_get_their_share():
    """A box of a millionth of the volume gets a quarter of all rays, as the other one does."""
    rays_o, rays_d = random_rays([BOX, SMALL, OTHER], 4000, seeded())
    for box in (SMALL, OTHER):
        assert 1000 <= hits(box, rays_o, rays_d).sum() < 1400
    assert (hits(BOX, rays_o, rays_d) | hits(SMALL, rays_o, rays_d) | hits(OTHER, rays_o, rays_d)).all()


def test_rays_follow_the_seed():
    first, again, other = (random_rays([BOX], 50, seeded(s))[0] for s in (1, 1, 2))
    assert np.array_equal(first, again) and not np.array_equal(first, other)


def test_pixels_are_those_of_the_renderer():
    """In one part and in several; a smooth field hides the jitter."""
    field = Gaussian(density=8.0).occupy(12)
    rays_o, rays_d = random_rays([BOX], 400, seeded())
    wanted = render_rays(field, rays_o, rays_d, step=0.01, early_stop=1e-3)[:, :4]
    for at_once in (1 << 16, 150):
        pool = ask(field, rays_o, rays_d, 0.01, seeded(3), at_once=at_once)
        assert wanted[:, 3].max() > 0.8
        np.testing.assert_allclose(pool.pixels.numpy(), wanted, atol=3e-3)
        np.testing.assert_array_equal(pool.rays_o, rays_o)


@pytest.mark.parametrize("at_once", [1 << 14, 30])
def test_points_are_samples_with_the_teachers_answers(at_once):
    field = Gaussian(density=8.0)
    rays_o, rays_d = random_rays([BOX], 100, seeded())
    points = ask(field, rays_o, rays_d, 0.05, seeded(3), everything, at_once).points
    sigma, rgb = field.query(points.where, points.dirs)
    assert len(points) > 1000 and (sigma < 1e-3).any() and (sigma > 1).any()
    torch.testing.assert_close(sigma, points.sigma, rtol=1e-4, atol=1e-6)  # places are kept in float32
    shown = sigma * 0.05 > 1e-5
    torch.testing.assert_close(rgb[shown], points.rgb[shown], rtol=1e-4, atol=1e-5)


def everything(depth, transmittance):
    return torch.ones_like(depth)


def test_all_matter_is_kept_and_a_share_of_the_emptiness():
    field, rays = Gaussian(density=8.0), random_rays([BOX], 2000, seeded())
    whole = ask(field, *rays, 0.05, seeded(3), everything).points
    kept = ask(field, *rays, 0.05, seeded(3)).points
    matter = [(points.sigma * 0.05 > MATTER).sum() for points in (whole, kept)]
    assert matter[0] == matter[1] > 1000
    assert abs((len(kept) - matter[1]) / (len(whole) - matter[0]) - EMPTY_SHARE) < 0.02


def test_transmittance_of_points_is_the_rays():
    """In a medium of σ = 4, behind a length x of it, exp(-4 x) to within the step."""
    rays_o, rays_d = np.array([[-3.0, 0, 0]] * 200), np.array([[1.0, 0, 0]] * 200)
    points = ask(Slab(density=4.0), rays_o, rays_d, 0.02, seeded(), everything).points
    deep = (points.where[:, 0] + 0.3).clamp(0, 0.7)
    wanted = torch.exp(-4 * deep)
    assert ((points.transmittance / wanted).log().abs() < 4 * 0.021).all()


def test_points_come_in_random_order_and_round_again():
    points = ask(Gaussian(density=8.0), *random_rays([BOX], 100, seeded()), 0.05, seeded(3)).points
    jumps = (points.where[1:] - points.where[:-1]).norm(dim=1)
    assert jumps.mean() > 0.3  # along a ray they would be 0.05 apart
    n, size = len(points), len(points) // 3 + 5
    drawn = torch.cat([points.batch(i, size).sigma for i in range(3)])
    assert torch.equal(drawn, torch.cat([points.sigma, points.sigma[: 3 * size - n]]))
    assert len(points.batch(7, 10 * n)) == n


def test_no_points_behind_what_is_opaque():
    """Behind the wall at x in [-0.3, 0.4] of optical depth 35 nothing is kept of a ray along +x."""
    rays_o, rays_d = np.array([[-3.0, 0, 0]] * 20), np.array([[1.0, 0, 0]] * 20)
    pool = ask(Slab(density=50.0), rays_o, rays_d, 0.02, seeded())
    x = pool.points.where[:, 0]
    assert -0.3 < x.max() < -0.1 and x.min() < -0.9
    assert (pool.pixels[:, 3] > 0.999).all()


def test_rays_past_everything_give_no_points():
    rays_o, rays_d = np.array([[-3.0, 0, 5]]), np.array([[1.0, 0, 0]])
    pool = ask(Slab(), rays_o, rays_d, 0.02, seeded())
    assert len(pool.points) == 0 and not pool.pixels.any()
