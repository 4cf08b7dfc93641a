"""Placed and composed fields as functions of torch: against the composition as it stands, and gradients in
float64 against finite differences."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.differentiable import bounds, device_of, float_type, numbers, query
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig
from fusedrf_cli.engine.fields.streamed import StreamedField
from tests.analytic.rays import SHEAR, affine, turn

from ..conftest import THIRTY_TWO, Gaussian, points_in, random_vm, unit

CHECK = {"fast_mode": True, "eps": 1e-7, "atol": 1e-6, "rtol": 1e-6}


@pytest.fixture(autouse=True)
def coarse_occupancy(in_force):
    """A grid that is made in no time."""
    in_force(OccupancyConfig(scene_cells=24))


def three(rule: str, dtype=torch.float64) -> ComposedField:
    """Overlapping fields: turned, sheared, and a mirrored copy of the first."""
    shape = {} if dtype == torch.float64 else {"shape": THIRTY_TWO}
    one, two = (random_vm(seed=seed, cells=4, dtype=dtype, **shape) for seed in (1, 2))
    spots = {"a": affine(turn(20)), "b": affine(SHEAR), "c": affine((-0.8, 1, 1.1), (0.5, 0.2, 0))}
    return ComposedField([Placed(n, two if n == "b" else one, m) for n, m in spots.items()], rule)


def asked(composed, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    points = torch.from_numpy(points_in(composed.aabb, count))
    return points, torch.from_numpy(unit(np.random.default_rng(3).normal(size=(count, 3))))


@pytest.mark.parametrize("rule", ["max", "add"])
def test_answers_are_the_composition_s(rule):
    """To the bit in float32, whether gradients are wanted or not."""
    composed = three(rule, torch.float32)
    points, dirs = asked(composed, 3000)
    wanted = composed.query(points, dirs)
    assert 0.05 < (wanted[0] > 0).float().mean() < 0.95
    for leaf in (points, points.clone().requires_grad_()):
        sigma, rgb = query(composed, leaf, dirs)
        assert torch.equal(sigma.detach(), wanted[0]) and sigma.requires_grad == leaf.requires_grad
        torch.testing.assert_close(rgb.detach(), wanted[1], rtol=0, atol=1e-6)
    sigma, rgb = query(composed, points, dirs, with_colour=False)
    assert torch.equal(sigma, wanted[0]) and not rgb.any()


@pytest.mark.parametrize("rule", ["max", "add"])
def test_gradients_are_finite_differences(rule):
    composed = three(rule)
    points, dirs = asked(composed, 60)
    poses = [torch.from_numpy(p.object_to_world) for p in composed.placed]
    own = numbers(composed)
    assert len(own) == 2  # a and c are one field
    held = {id(field): i for i, field in enumerate(dict.fromkeys(p.field for p in composed.placed))}

    def answers(points, dirs, a, c, *params):
        placed = [
            Placed(p.name, p.field.with_params(params[held[id(p.field)]]), p.object_to_world)
            for p in composed.placed
        ]
        again = ComposedField(placed, rule).posed({})
        shift = torch.from_numpy(again.origin)  # of a composition that is centred already
        shifted = [pose - torch.nn.functional.pad(shift[:, None], (3, 0, 0, 1)) for pose in (a, c)]
        return query(again, points - shift, dirs, dict(zip("ac", shifted, strict=True)))

    leaves = [x.clone().requires_grad_() for x in (points, dirs, poses[0], poses[2], *own)]
    assert torch.autograd.gradcheck(answers, leaves, **CHECK)


def test_a_placed_field_alone():
    placed = Placed("a", random_vm(cells=4), affine(turn(40) @ np.diag([1, -2, 0.7])))
    points = torch.from_numpy(points_in(placed.aabb, 40))
    dirs = torch.from_numpy(unit(np.random.default_rng(3).normal(size=(40, 3))))
    x, d, stretch = placed.to_object(points, dirs)
    wanted = placed.field.query(x, d)
    sigma, rgb = query(placed, points, dirs)
    torch.testing.assert_close(sigma, wanted[0] * stretch)
    torch.testing.assert_close(rgb, wanted[1])
    pose = torch.from_numpy(placed.object_to_world).clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda m: query(placed, points, dirs, {"a": m}), pose, **CHECK)


def test_the_colour_of_the_denser_has_the_gradient():
    """Where a field is hidden by a denser one its numbers have none."""
    thin, dense = random_vm(seed=1, scale=1e-9), random_vm(seed=2)
    composed = ComposedField([Placed("thin", thin, np.eye(4)), Placed("dense", dense, np.eye(4))])
    for field in (thin, dense):
        field.params.requires_grad_()
    points, dirs = asked(composed, 300)
    inside = (dense.query(points + torch.from_numpy(composed.origin), dirs)[0] > 1e-3)[:, None]
    (query(composed, points, dirs)[1] * inside).sum().backward()
    assert dense.params.grad.any() and not thin.params.grad.any()


def test_the_box_moves_with_the_placements():
    composed = three("max")
    pose = torch.from_numpy(composed.placed[1].object_to_world).clone().requires_grad_()
    np.testing.assert_allclose(bounds(composed, None), composed.aabb)
    np.testing.assert_allclose(bounds(composed, {"b": pose}).detach(), composed.aabb, atol=1e-12)
    assert torch.autograd.gradcheck(lambda m: bounds(composed, {"b": m}), pose, **CHECK)
    far = pose.detach().clone()
    far[0, 3] += 5
    np.testing.assert_allclose(
        bounds(composed, {"b": far}), composed.posed({"b": far.numpy()}).aabb, atol=1e-12
    )


def test_fields_without_numbers_and_fields_read_when_asked():
    fog = Placed("fog", Gaussian(), np.eye(4))
    streamed = Placed("vm", StreamedField(lambda: random_vm(cells=4)), affine(0.5))
    composed = ComposedField([fog, streamed], "add")
    assert len(numbers(composed)) == 1 and float_type(composed) == torch.float64
    assert device_of(ComposedField([fog])) == torch.device("cpu")
    points, dirs = asked(composed, 500)
    torch.testing.assert_close(query(composed, points, dirs)[0].float(), composed.query(points, dirs)[0])


def test_a_composition_of_compositions():
    inner = three("max")
    outer = ComposedField([Placed("inner", inner, affine(turn(10))), Placed("d", random_vm(), affine(0.5))])
    points, dirs = asked(outer, 500)
    torch.testing.assert_close(query(outer, points, dirs)[0].float(), outer.query(points, dirs)[0])
