"""Kinds against their plain torch references: what is answered, and the gradients of the references
themselves against finite differences."""

import numpy as np
import pytest
import torch

from ..conftest import points_in, unit
from .cases import KINDS  # noqa: F401  (a fixture)


@pytest.fixture(params=KINDS)
def field(request):
    return KINDS[request.param]()


def asked(field, count: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    """Points in and around a field's box, and unit directions."""
    dirs = unit(np.random.default_rng(seed).normal(size=(count, 3)))
    return torch.from_numpy(points_in(field.aabb, count, seed, margin=0.05)), torch.from_numpy(dirs)


def test_the_kernels_answer_as_the_reference(field):
    points, dirs = asked(field, 2000)
    found, wanted = field.query(points, dirs), field.reference(field.params, points, dirs)
    assert 0.05 < (wanted[0] > 0).double().mean() < 0.95
    torch.testing.assert_close(found[0], wanted[0], rtol=1e-6, atol=1e-9)
    torch.testing.assert_close(found[1], wanted[1], rtol=0, atol=1e-9)


def sent_back(field, answers):
    """What random gradients of answers at 300 points send to the numbers that others do not follow from: by
    the kernels, and by autograd through answers(params, points, dirs)."""
    points, dirs = asked(field, 300)
    generator = torch.Generator().manual_seed(1)
    d_sigma = torch.randn(300, generator=generator, dtype=torch.float64)
    d_rgb = torch.randn(300, 3, generator=generator, dtype=torch.float64)
    rows = np.zeros((2, field.params.numel()))
    field.query_backward(points, dirs, d_sigma, d_rgb, rows)
    params = field.params.clone().requires_grad_()
    torch.autograd.backward(answers(params, points, dirs), (d_sigma, d_rgb))
    free = params.grad != 0
    assert free.sum() > 100
    return rows.sum(0)[free], params.grad[free]


def test_the_kernels_send_back_what_the_reference_does(field):
    np.testing.assert_allclose(*sent_back(field, field.reference), rtol=1e-5, atol=1e-9)


def test_references_are_differentiable_in_all_they_are_asked(field):
    points, dirs = asked(field, 40)
    leaves = (field.params.clone(), points, dirs)
    leaves = tuple(leaf.requires_grad_() for leaf in leaves)
    assert torch.autograd.gradcheck(field.reference, leaves, fast_mode=True, eps=1e-7, atol=1e-6, rtol=1e-5)


def test_float32_stays_float32(field):
    points, dirs = asked(field, 50)
    sigma, rgb = field.reference(field.params.float(), points.float(), dirs.float())
    assert sigma.dtype == rgb.dtype == torch.float32
    wanted = field.reference(field.params, points.float(), dirs.float())
    torch.testing.assert_close(sigma.double(), wanted[0], rtol=1e-4, atol=1e-4)


def test_no_points_no_answers(field):
    none = torch.zeros((0, 3), dtype=torch.float64)
    sigma, rgb = field.reference(field.params.clone().requires_grad_(), none, none)
    assert sigma.shape == (0,) and rgb.shape == (0, 3)
