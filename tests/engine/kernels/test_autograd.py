"""Density and features as torch functions: against a slow loop, gradients against finite differences."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.kernels import autograd
from fusedrf_cli.engine.kinds.vm.field import MODES

from ..conftest import DIRECTIONS_26, points_in, random_vm

TURNED = np.array([[0.0, -1.5, 0, 0.1], [1.2, 0, 0.3, 0], [0, 0.2, 0.8, -0.2], [0, 0, 0, 1]])


def places(field, count=40, margin=0.1):
    """Points (count, 3) in and around a field's box, and directions for them."""
    points = points_in(field.aabb, count, seed=3, margin=margin)
    return torch.from_numpy(points), torch.from_numpy(np.resize(DIRECTIONS_26, (count, 3)))


def slow_products(field, point: np.ndarray) -> np.ndarray:
    """(3 rank,) products at a point of the object's frame, texel by texel."""
    box, sections = field.tensors[0].aabb, field.sections(0)
    unit = (point - box[:3]) / (box[3:] - box[:3])
    if (unit < 0).any() or (unit > 1).any():
        return np.zeros(3 * field.shape.colour_rank)
    at = unit * (np.array(field.tensors[0].resolution) - 1)
    low = np.minimum(at.astype(int), np.array(field.tensors[0].resolution) - 2)
    part = at - low
    found = []
    for m, (a, b, c) in enumerate(MODES):
        plane, line = (sections[f"colour_{what}_{m}"].numpy() for what in ("plane", "line"))
        p = sum(
            (part[a] if i else 1 - part[a]) * (part[b] if j else 1 - part[b]) * plane[low[a] + i, low[b] + j]
            for i in (0, 1)
            for j in (0, 1)
        )
        found.append(p * ((1 - part[c]) * line[low[c]] + part[c] * line[low[c] + 1]))
    return np.concatenate(found)


def directional(function, params, d_out, seed, step=1e-6):
    """(finite difference, gradient's share) of <function(params), d_out> along a random direction."""
    along = torch.randn(params.shape, generator=torch.Generator().manual_seed(seed), dtype=params.dtype)
    difference = (function(params + step * along) - function(params - step * along)) / (2 * step)
    leaf = params.clone().requires_grad_()
    (function(leaf) * d_out).sum().backward()
    return float((difference * d_out).sum()), float((leaf.grad * along).sum())


def test_features_equal_a_slow_loop():
    field = random_vm()
    points, _ = places(field)
    products = autograd.features(field, field.params, points)
    assert products.shape == (40, 48)
    expected = np.stack([slow_products(field, p) for p in points.numpy()])
    assert (expected == 0).all(1).any() and (expected != 0).any(1).any()
    np.testing.assert_allclose(products.numpy(), expected, atol=1e-12)


def test_features_of_a_placed_block_are_those_of_the_object():
    field, placed = random_vm(), random_vm(matrix=TURNED)
    points, _ = places(field)
    moved = points @ torch.from_numpy(TURNED[:3, :3].T) + torch.from_numpy(TURNED[:3, 3])
    expected = autograd.features(field, field.params, points)
    found = autograd.features(placed, placed.params, moved)
    inside = (expected != 0).any(1)
    np.testing.assert_allclose(found[inside], expected[inside], atol=1e-10)


def test_density_is_the_field_s():
    field = random_vm(cells=4)
    points, dirs = places(field)
    sigma = autograd.density(field, field.params, points, dirs)
    assert torch.equal(sigma, field.query(points, dirs)[0])
    assert (sigma == 0).any() and (sigma > 0).any()


@pytest.mark.parametrize("seed", range(4))
def test_gradients_against_finite_differences(seed):
    field = random_vm(cells=4, seed=seed)
    points, dirs = places(field)
    generator = torch.Generator().manual_seed(seed)
    d_sigma = torch.randn(len(points), generator=generator, dtype=torch.float64)
    d_products = torch.randn(len(points), 48, generator=generator, dtype=torch.float64)
    expected, found = directional(
        lambda p: autograd.density(field, p, points, dirs), field.params, d_sigma, seed
    )
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-7) and expected != 0
    expected, found = directional(
        lambda p: autograd.features(field, p, points), field.params, d_products, seed
    )
    assert found == pytest.approx(expected, rel=1e-6, abs=1e-7) and expected != 0


def test_given_rows_take_the_gradient_instead():
    field = random_vm()
    points, dirs = places(field)
    whole, kept = (field.params.clone().requires_grad_() for _ in range(2))
    rows = np.zeros((3, field.params.numel()))
    for leaf, grads in ((whole, None), (kept, rows)):
        total = autograd.density(field, leaf, points, dirs, grads).sum()
        (total + autograd.features(field, leaf, points, grads).square().sum()).backward()
    assert kept.grad is None
    np.testing.assert_allclose(rows.sum(0), whole.grad.numpy(), atol=1e-11)
    assert (np.abs(rows).sum(1) > 0).all()


def test_no_points():
    field = random_vm()
    none = torch.zeros((0, 3), dtype=torch.float64)
    leaf = field.params.clone().requires_grad_()
    products = autograd.features(field, leaf, none)
    (products.sum() + autograd.density(field, leaf, none, none).sum()).backward()
    assert products.shape == (0, 48) and not leaf.grad.any()
