"""Fields as functions of torch, each kind: gradients against finite differences in float64, devices without
compiled loops, and what cannot be differentiated."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.fields.computed import ComputedField
from fusedrf_cli.engine.fields.differentiable import query
from fusedrf_cli.engine.fields.streamed import StreamedField

from ..conftest import Gaussian, points_in, random_vm, unit
from ..kinds.cases import KINDS  # noqa: F401  (a fixture)


@pytest.fixture(params=KINDS)
def field(request):
    return KINDS[request.param]()


def places(field, count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Points in and around a field's box, and unit directions."""
    dirs = unit(np.random.default_rng(seed).normal(size=(count, 3)))
    return torch.from_numpy(points_in(field.aabb, count, seed, margin=0.05)), torch.from_numpy(dirs)


def test_gradients_are_finite_differences(field):
    """In numbers, points and directions, together."""
    points, dirs = places(field, 40)
    leaves = [x.clone().requires_grad_() for x in (field.params, points, dirs)]

    def answers(params, points, dirs):
        return query(field, points, dirs, params)

    assert torch.autograd.gradcheck(answers, leaves, fast_mode=True, eps=1e-7, atol=1e-6, rtol=1e-5)
    for i in range(3):  # and each alone: what is not asked is not made
        alone = [x.detach().requires_grad_(i == j) for j, x in enumerate(leaves)]
        assert torch.autograd.gradcheck(answers, alone, fast_mode=True, eps=1e-7, atol=1e-6, rtol=1e-5)


def test_answers_are_the_field_s_own(field):
    points, dirs = places(field, 500)
    wanted = field.query(points, dirs)
    assert (wanted[0] > 0).any() and (wanted[0] == 0).any()
    for params in (None, field.params.clone(), field.params.clone().requires_grad_()):
        sigma, rgb = query(field, points, dirs, params)
        assert torch.equal(sigma, wanted[0]) and torch.equal(rgb, wanted[1])
        assert sigma.requires_grad == rgb.requires_grad == (params is not None and params.requires_grad)
    sigma, rgb = query(field, points.float().double(), dirs, with_colour=False)
    assert not rgb.any() and torch.equal(sigma, field.query(points.float().double(), dirs)[0])


def test_a_field_s_own_numbers_learn_by_an_optimiser_of_torch(field):
    """They may require a gradient; dependent ones follow, and have none."""
    points, dirs = places(field, 400)
    wanted = query(field, points, dirs)[0]
    optimiser = torch.optim.Adam([field.params.requires_grad_()], 0.02)
    with torch.no_grad():
        field.params += 0.3 * torch.randn_like(field.params)
    losses = []
    for _ in range(25):
        optimiser.zero_grad()
        loss = (query(field, points, dirs)[0] - wanted).square().mean()
        loss.backward()
        losses.append(loss.item())
        optimiser.step()
    assert losses[-1] < 0.2 * losses[0]
    for low, high in field.dependent():
        assert not field.params.grad[low:high].any()
    before = field.params.detach().clone()
    field.settle()
    found = field.params.detach()
    free = torch.ones_like(found, dtype=torch.bool)
    for low, high in field.dependent():
        free[low:high] = False
    assert torch.equal(found[free], before[free])


def test_where_there_are_no_compiled_loops_the_reference_answers(field, monkeypatch):
    points, dirs = places(field, 200)
    leaf = field.params.clone().requires_grad_()
    wanted = query(field, points, dirs, leaf)
    (wanted[0].sum() + wanted[1].square().sum()).backward()
    monkeypatch.setattr(kernels, "device_loops", lambda device: None)
    monkeypatch.setattr(ComputedField, "loops", None)
    slow = field.params.clone().requires_grad_()
    found = query(field, points, dirs, slow)
    (found[0].sum() + found[1].square().sum()).backward()
    for one, other in zip((*found, slow.grad), (*wanted, leaf.grad), strict=True):
        torch.testing.assert_close(one, other, rtol=1e-6, atol=1e-6)


def test_no_gradient_is_made_where_none_is_wanted(field, monkeypatch):
    points, dirs = places(field, 20)
    monkeypatch.setattr(type(field), "reference", None)
    with torch.no_grad():
        sigma, _ = query(field, points, dirs, field.params.clone().requires_grad_())
    assert not sigma.requires_grad


def test_numbers_changed_between_forward_and_backward_are_noticed():
    field = random_vm()
    points, dirs = places(field, 20)
    params = field.params.clone().requires_grad_()
    loss = query(field, points, dirs, params)[0].sum()
    with torch.no_grad():
        params += 1
    with pytest.raises(RuntimeError, match="modified by an inplace operation"):
        loss.backward()


def test_a_field_without_a_reference_answers_but_has_no_gradient():
    field = Gaussian()
    points, dirs = places(field, 30)
    assert torch.equal(query(field, points, dirs)[0], field.query(points, dirs)[0])
    with pytest.raises(ValueError, match="'analytic' have no reference"):
        query(field, points.requires_grad_(), dirs)


def test_a_streamed_field_is_opened():
    field = random_vm()
    points, dirs = places(field, 30)
    found = query(StreamedField(lambda: field), points.requires_grad_(), dirs)[0]
    assert found.requires_grad and torch.equal(found.detach(), field.query(points.detach(), dirs)[0])


def test_what_was_left_out_has_no_gradient(field):
    points, dirs = places(field, 50)
    leaf = field.params.clone().requires_grad_()
    sigma, rgb = query(field, points, dirs, leaf, with_colour=False)
    assert sigma.requires_grad and not rgb.requires_grad


def test_points_where_nothing_is(field):
    points, dirs = places(field, 10)
    points = (points + 1e3).requires_grad_()
    sigma, rgb = query(field, points, dirs.requires_grad_())
    (sigma.sum() + rgb.sum()).backward()
    assert not sigma.any() and not points.grad.any() and not dirs.grad.any()


def test_no_points(field):
    none = torch.zeros((0, 3), dtype=torch.float64, requires_grad=True)
    leaf = field.params.clone().requires_grad_()
    sigma, rgb = query(field, none, none.detach(), leaf)
    (sigma.sum() + rgb.sum()).backward()
    assert sigma.shape == (0,) and rgb.shape == (0, 3) and not leaf.grad.any()
