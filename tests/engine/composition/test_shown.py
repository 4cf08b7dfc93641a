"""Placed fields whose densities and colours are multiplied by an opacity and a tint."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import Composite
from fusedrf_cli.engine.composition.differentiable import query
from fusedrf_cli.engine.rendering.volume import render_rays
from tests.analytic.rays import affine, points_in, rays_at, turn, unit
from tests.engine.composition.test_composite import blob, surroundings

OPACITY, TINT = 0.4, (0.9, 0.5, 0.0)
AT = affine(turn(30) @ np.diag([1.0, 1.2, -0.8]), (0.3, 0.1, 0.0))
FIELDS = {"vm": lambda: blob("vm"), "sparse": lambda: blob("sparse"), "all of space": surroundings}


@pytest.fixture(params=FIELDS)
def field(request):
    return FIELDS[request.param]()


def asked(box: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
    """Points of a box, and directions."""
    dirs = unit(np.random.default_rng(1).normal(size=(2000, 3)))
    return torch.from_numpy(points_in(box, 2000)), torch.from_numpy(dirs)


@pytest.mark.parametrize("rule", ["max", "add"])
@pytest.mark.parametrize("made", [ComposedField, Composite])
def test_densities_and_colours_are_multiplied_and_no_more(field, made, rule):
    plain, shown = (made([Placed("a", field, AT, *how)], rule) for how in ((), (OPACITY, TINT)))
    points, dirs = asked(Placed("a", field, AT).moved(plain.origin).aabb)
    (sigma, rgb), (less, other) = plain.query(points, dirs), shown.query(points, dirs)
    assert sigma.max() > 1e-2 and rgb.max() > 0.3
    torch.testing.assert_close(less, OPACITY * sigma, rtol=1e-6, atol=0)
    torch.testing.assert_close(other, rgb * torch.tensor(TINT), rtol=1e-5, atol=1e-7)
    less, other = query(shown, points, dirs)
    torch.testing.assert_close(less, OPACITY * sigma, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(other, rgb * torch.tensor(TINT), rtol=1e-3, atol=1e-4)


def test_optical_depths_of_rays_are_multiplied(field):
    """All samples stay where they are: what light is left is that to the power of the opacity."""
    plain, thin, tinted = (Composite([Placed("a", field, AT, *how)]) for how in ((), (OPACITY,), (1.0, TINT)))
    rays = rays_at(Placed("a", field, AT).moved(plain.origin).aabb, 200)
    before, after, coloured = (render_rays(f, *rays, early_stop=0.0) for f in (plain, thin, tinted))
    assert before[:, 3].max() > 0.05
    left = 1 - before[:, 3].astype(float)
    told = left > 1e-3  # less light is lost in the roundings of what is not 1
    np.testing.assert_allclose(1 - after[told, 3], left[told] ** OPACITY, atol=1e-4)
    assert (after[~told, 3] > 0.9).all()
    np.testing.assert_allclose(coloured[:, :3], before[:, :3] * TINT, rtol=1e-5, atol=1e-7)
    np.testing.assert_array_equal(coloured[:, 3:], before[:, 3:])


def test_instances_of_one_field_have_tints_of_their_own():
    """Side by side, each is shown as alone; and there is one field in memory."""
    one, places = blob("vm"), (np.eye(4), affine(1.0, (4.0, 0, 0)))
    nodes = [
        Placed("n", one, at, 1.0, tint) for at, tint in zip(places, (TINT, (0.0, 1.0, 1.0)), strict=True)
    ]
    scene = Composite(nodes, origin=np.zeros(3))
    assert len({id(field) for field in scene.fields}) == 1 and set(scene.field_of) == {0}
    for node in nodes:
        rays = rays_at(node.aabb, 100)
        apart = np.abs(rays[1][:, 0]) < 0.6  # so that the other one is not met
        rays_o, rays_d = (x[apart] for x in rays)
        alone = Composite([node], origin=np.zeros(3))
        np.testing.assert_array_equal(render_rays(scene, rays_o, rays_d), render_rays(alone, rays_o, rays_d))


def test_groups_hand_theirs_on():
    inner = ComposedField([Placed("a", blob("vm"), AT, 0.5, (0.5, 1.0, 1.0))], "add")
    inner.placed.append(Placed("b", blob("sparse"), affine(1.0, (0.2, 0, 0))))
    outer = [Placed("g", inner, affine(2.0, (0, 1, 0)), 0.5, (0.5, 1.0, 0.5)), Placed("c", blob("vm"), AT)]
    scene, naive = Composite(outer), ComposedField(outer)
    assert [(p.opacity, p.tint) for p in scene.parts][:2] == [(0.25, (0.25, 1, 0.5)), (0.5, (0.5, 1, 0.5))]
    points, dirs = asked(naive.aabb)
    torch.testing.assert_close(
        scene.query(points, dirs)[0], naive.query(points, dirs)[0], rtol=1e-5, atol=1e-6
    )
    torch.testing.assert_close(
        scene.query(points, dirs)[1], naive.query(points, dirs)[1], rtol=1e-3, atol=1e-4
    )
