"""The sparse field's CUDA loops against the CPU's, as test_cuda.py has it: always in numba's simulator."""

import numpy as np
import pytest

from fusedrf_cli.engine.kernels import sparse_cpu
from tests.analytic.rays import points_in, rays_at, unit
from tests.engine.kernels.simulated import (
    EXACT,
    HERE,
    beside_the_simulator,
    both,
    on_a_device,
    run_simulated,
)
from tests.engine.kinds.sparse_cases import random_sparse

if HERE:
    from fusedrf_cli.engine.kernels import sparse_cuda


@beside_the_simulator
def test_the_simulator_agrees():
    run_simulated(__file__)


@on_a_device
@pytest.mark.parametrize("degree", [0, 1])
@pytest.mark.parametrize("count", [0, 1, 24])
def test_query_and_its_gradient(degree, count):
    field = random_sparse(degree)
    points = points_in(field.aabb, count, margin=0.1)
    dirs = unit(np.random.default_rng(1).normal(size=(count, 3)))
    read = *field.kernel_shape, field.arrays, points, dirs
    for wanted, found in both((sparse_cpu, sparse_cuda), "query", (*read, True), ((count,), (count, 3))):
        np.testing.assert_allclose(found, wanted, **EXACT)
        assert count < 2 or wanted.any()
    d_sigma, d_rgb = np.linspace(-1, 1, count), np.linspace(1, -1, 3 * count).reshape(count, 3)
    for wanted, found in both(
        (sparse_cpu, sparse_cuda), "query_backward", (*read, d_sigma, d_rgb), ((1, field.size),)
    ):
        np.testing.assert_allclose(found, wanted, **EXACT)


@on_a_device
@pytest.mark.parametrize("degree", [0, 1])
def test_render(degree):
    field = random_sparse(degree)
    rays_o, rays_d = rays_at(field.aabb, 4)
    rays_d[0] = [0.0, 0.0, -1.0]  # along an axis
    inputs = *field.kernel_shape, field.arrays, field.grid, rays_o, rays_d, 0.0, 0.05, 1e-3
    for wanted, found in both((sparse_cpu, sparse_cuda), "render", inputs, ((4, 5),)):
        np.testing.assert_allclose(found, wanted, **EXACT)
        assert wanted[:, 3].max() > 0.1


@on_a_device
def test_train_rays(monkeypatch):
    """More rays than have scratch at a time."""
    field, n = random_sparse(1), 3
    rays_o, rays_d = rays_at(field.aabb, n)
    rng = np.random.default_rng(2)
    target, background = rng.random((n, 4)), rng.random((n, 3))
    inputs = (
        *field.kernel_shape, field.arrays, field.grid, rays_o, rays_d, 0.0, rng.random(n), 0.05, 1e-3, target,
        background, 0.3, 200,
    )  # fmt: skip
    monkeypatch.setattr(sparse_cuda, "RAYS_IN_FLIGHT", 2)
    for wanted, found in both((sparse_cpu, sparse_cuda), "train_rays", inputs, ((1, field.size), (1, 3))):
        np.testing.assert_allclose(found, wanted, **EXACT)
    assert wanted[0, 2] > n  # samples


@on_a_device
def test_expose():
    field = random_sparse(0, depth=1)
    low, high = (field.fine.places[field.fine.corners[:12, q]] for q in (0, 7))
    inputs = field.arrays, (low + high) / 2, (high - low).min(1), np.eye(3), 3.0, 0.01
    for wanted, found in both((sparse_cpu, sparse_cuda), "expose", inputs, ((12,), (12, 3))):
        np.testing.assert_allclose(found, wanted, **EXACT)
        assert wanted.any()


@on_a_device
@pytest.mark.parametrize("keep", [False, True])
def test_sums_of_rows(keep):
    field = random_sparse(1)
    lattice = field.fine
    *edges, target = lattice.gathering if keep else lattice.spreading
    some = target[:20]
    results = []
    for loops in (sparse_cpu, sparse_cuda):
        values = np.arange(float(field.size))
        loops.sums_of_rows(values, 0, 4, edges[0][:21], *edges[1:], some, keep)
        results.append(values)
    np.testing.assert_allclose(results[1], results[0], **EXACT)
    assert (results[0] != np.arange(float(field.size))).any()
