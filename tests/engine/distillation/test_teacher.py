"""What is asked of a teacher: pixels as the renderer has them, and points."""

from functools import partial
from operator import le

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.distillation.teacher import TeacherConfig, query_teacher, render_teacher
from fusedrf_cli.engine.rendering.volume import RenderConfig, render_rays
from tests.engine.conftest import BOX, Gaussian, Slab

EVERYTHING = TeacherConfig(empty_share=1.0)


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_pixels_are_those_of_the_renderer(in_force):
    """In one part and in several; a smooth field hides the jitter."""
    field = Gaussian(density=8.0).occupy(12)
    rays_o, rays_d = RaySampler([BOX]).draw(400, seeded())
    wanted = render_rays(field, rays_o, rays_d, step=0.01, early_stop=1e-3)[:, :4]
    for at_once in (1 << 16, 150):
        in_force(RenderConfig(rays_at_once=at_once))
        dataset = query_teacher(field, rays_o, rays_d, 0.01, seeded(3))
        assert wanted[:, 3].max() > 0.8
        np.testing.assert_allclose(dataset.pixels.numpy(), wanted, atol=3e-3)
        np.testing.assert_array_equal(dataset.rays_o, rays_o)


@pytest.mark.parametrize("at_once", [1 << 14, 30])
def test_points_are_samples_with_the_teachers_answers(at_once, in_force):
    in_force(RenderConfig(rays_at_once=at_once), EVERYTHING)
    field = Gaussian(density=8.0)
    rays_o, rays_d = RaySampler([BOX]).draw(100, seeded())
    points = query_teacher(field, rays_o, rays_d, 0.05, seeded(3)).points
    sigma, rgb = field.query(points.where, points.dirs)
    assert len(points) > 1000 and (sigma < 1e-3).any() and (sigma > 1).any()
    torch.testing.assert_close(sigma, points.sigma, rtol=1e-4, atol=1e-6)  # places are kept in float32
    shown = sigma * 0.05 > 1e-5
    torch.testing.assert_close(rgb[shown], points.rgb[shown], rtol=1e-4, atol=1e-5)


def test_all_matter_is_kept_and_a_share_of_the_emptiness(in_force):
    field, rays = Gaussian(density=8.0), RaySampler([BOX]).draw(2000, seeded())
    kept = query_teacher(field, *rays, 0.05, seeded(3)).points
    in_force(EVERYTHING)
    whole = query_teacher(field, *rays, 0.05, seeded(3)).points
    matter = [(points.sigma * 0.05 > TeacherConfig.occupied_depth).sum() for points in (whole, kept)]
    assert matter[0] == matter[1] > 1000
    assert abs((len(kept) - matter[1]) / (len(whole) - matter[0]) - TeacherConfig.empty_share) < 0.02


def test_transmittance_of_points_is_the_rays(in_force):
    """In a medium of σ = 4, behind a length x of it, exp(-4 x) to within the step."""
    in_force(EVERYTHING)
    rays_o, rays_d = np.array([[-3.0, 0, 0]] * 200), np.array([[1.0, 0, 0]] * 200)
    points = query_teacher(Slab(density=4.0), rays_o, rays_d, 0.02, seeded()).points
    deep = (points.where[:, 0] + 0.3).clamp(0, 0.7)
    wanted = torch.exp(-4 * deep)
    assert ((points.transmittance / wanted).log().abs() < 4 * 0.021).all()


def test_points_come_in_random_order_and_round_again():
    points = query_teacher(
        Gaussian(density=8.0), *RaySampler([BOX]).draw(100, seeded()), 0.05, seeded(3)
    ).points
    jumps = (points.where[1:] - points.where[:-1]).norm(dim=1)
    assert jumps.mean() > 0.3  # along a ray they would be 0.05 apart
    n, size = len(points), len(points) // 3 + 5
    drawn = torch.cat([points.batch(i, size).sigma for i in range(3)])
    assert torch.equal(drawn, torch.cat([points.sigma, points.sigma[: 3 * size - n]]))
    assert len(points.batch(7, 10 * n)) == n


def test_no_points_behind_what_is_opaque():
    """Behind the wall at x in [-0.3, 0.4] of optical depth 35 nothing is kept of a ray along +x."""
    rays_o, rays_d = np.array([[-3.0, 0, 0]] * 20), np.array([[1.0, 0, 0]] * 20)
    dataset = query_teacher(Slab(density=50.0), rays_o, rays_d, 0.02, seeded())
    x = dataset.points.where[:, 0]
    assert -0.3 < x.max() < -0.1 and x.min() < -0.9
    assert (dataset.pixels[:, 3] > 0.999).all()


def test_rays_past_everything_give_no_points():
    rays_o, rays_d = np.array([[-3.0, 0, 5]]), np.array([[1.0, 0, 0]])
    dataset = query_teacher(Slab(), rays_o, rays_d, 0.02, seeded())
    assert len(dataset.points) == 0 and not dataset.pixels.any()


def test_the_first_rays_are_asked_where_these_are_enough(in_force):
    """In whole parts, at least one; each as if all had been asked."""
    in_force(RenderConfig(rays_at_once=40), TeacherConfig(rendered_at_once=40))
    field, rays = Gaussian(density=8.0), RaySampler([BOX]).draw(150, seeded())
    whole, shown = query_teacher(field, *rays, 0.05, seeded(3)), render_teacher(field, *rays)
    assert len(whole.rays_o) == len(shown.pixels) == 150
    for wanted, asked in ((0, 40), (40, 40), (41, 80), (500, 150)):
        some = query_teacher(field, *rays, 0.05, seeded(3), partial(le, wanted))
        assert torch.equal(some.pixels, whole.pixels[:asked])
        np.testing.assert_array_equal(some.rays_d, rays[1][:asked])
        seen = render_teacher(field, *rays, partial(le, wanted))
        assert torch.equal(seen.pixels, shown.pixels[:asked]) and len(seen.points) == 0
        np.testing.assert_array_equal(seen.rays_o, rays[0][:asked])
    both = whole.and_rendered(seen)
    assert both.points is whole.points and torch.equal(both.pixels, torch.cat([whole.pixels, seen.pixels]))
    np.testing.assert_array_equal(both.rays_d, np.concatenate([rays[1]] * 2))
