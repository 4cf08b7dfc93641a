"""The CUDA loops against the CPU's: on a GPU where there is one, and always in numba's simulator.

The simulator runs the bodies as plain Python, so the cases are few and small.
"""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.distillation.passes import Batch, FusedPass
from fusedrf_cli.engine.kernels import cpu
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera, tile_order
from fusedrf_cli.engine.rendering.volume import render_image
from tests.engine.conftest import BOX, SIXTY_FOUR, points_in, random_vm, rays_at, unit
from tests.engine.kernels.simulated import (
    EXACT,
    HERE,
    SIMULATED,
    beside_the_simulator,
    both,
    on_a_device,
    run_simulated,
)
from tests.engine.kernels.test_cpu import two_blocks

if HERE:
    from fusedrf_cli.engine.kernels import cuda


@beside_the_simulator
def test_the_simulator_agrees():
    run_simulated(__file__)


def fields():
    """One block under a grid, and two blocks that overlap."""
    turned = np.array([[0.0, -0.9, 0.0, 0.2], [0.7, 0.0, 0.0, -0.1], [0.0, 0.0, 1.1, 0.3], [0, 0, 0, 1]])
    return [random_vm(cells=3), two_blocks(turned)]


def both_of(name: str, field, inputs: tuple, outputs: tuple[tuple[int, ...], ...]):
    """`both` of a function that reads a VM field."""
    return both((cpu, cuda), name, (*field.kernel_shape, field.arrays, field.grid, *inputs), outputs)


@on_a_device
@pytest.mark.parametrize("case", [0, 1])
@pytest.mark.parametrize("count", [0, 1, 24])
def test_query_and_its_gradient(case, count):
    field = fields()[case]
    points = points_in(field.aabb, count, margin=0.1)
    dirs = unit(np.random.default_rng(1).normal(size=(count, 3)))
    for wanted, found in both_of("query", field, (points, dirs, True), ((count,), (count, 3))):
        np.testing.assert_allclose(found, wanted, **EXACT)
        assert count < 2 or wanted.any()
    d_sigma, d_rgb = np.linspace(-1, 1, count), np.linspace(1, -1, 3 * count).reshape(count, 3)
    size = field.params.numel()
    for wanted, found in both_of("query_backward", field, (points, dirs, d_sigma, d_rgb), ((1, size),)):
        np.testing.assert_allclose(found, wanted, **EXACT)


@on_a_device
@pytest.mark.parametrize("case", [0, 1])
def test_render(case):
    field = fields()[case]
    rays_o, rays_d = rays_at(field.aabb, 4)
    rays_d[0] = [0.0, 0.0, -1.0]  # along an axis
    inputs = rays_o, rays_d, 0.0, 0.2, 1e-3
    for wanted, found in both_of("render", field, inputs, ((4, 5),)):
        np.testing.assert_allclose(found, wanted, **EXACT)
        assert wanted[:, 3].max() > 0.1


@on_a_device
@pytest.mark.parametrize("case", [0, 1])
def test_train_rays(case, monkeypatch):
    """More rays than have scratch at a time, and more shaded samples than have a slot for their features."""
    field = [random_vm(), fields()[1]][case]
    n = 3
    rays_o, rays_d = rays_at(field.aabb, n)
    rng = np.random.default_rng(2)
    target, background = rng.random((n, 4)), rng.random((n, 3))
    inputs = rays_o, rays_d, 0.0, rng.random(n), 0.4, 1e-3, target, background, 0.3, 40
    monkeypatch.setattr(cuda, "RAYS_IN_FLIGHT", 2)
    for wanted, found in both_of("train_rays", field, inputs, ((1, field.params.numel()), (1, 3))):
        np.testing.assert_allclose(found, wanted, **EXACT)
    assert wanted[0, 2] > n  # samples


@on_a_device
def test_features_and_their_gradient():
    field = random_vm()
    points = points_in(BOX, 9, margin=0.1)
    ranks, width = field.kernel_shape[1], 3 * SIXTY_FOUR.colour_rank
    d_out = np.linspace(-1, 1, 9 * width)
    results = []
    for loops in (cpu, cuda):
        out, grads = np.zeros(9 * width), np.zeros((1, field.params.numel()))
        loops.features(ranks, field.arrays, 0, points, out)
        loops.features_backward(ranks, field.arrays, 0, points, d_out, grads)
        results.append((out, grads))
    for wanted, found in zip(*results, strict=True):
        np.testing.assert_allclose(found, wanted, **EXACT)


@on_a_device
def test_density_at_cells():
    field = random_vm()
    cells = np.argwhere(np.ones((2, 2, 2), bool))
    cell, probes = (BOX[3:] - BOX[:3]) / 2, np.array([[0.25] * 3, [0.75] * 3])
    results = [np.zeros(8), np.zeros(8)]
    for loops, out in zip((cpu, cuda), results, strict=True):
        grid = BOX[:3].copy(), cell, cells
        loops.density_at_cells(field.kernel_shape[0], field.arrays, 0, *grid, probes, out)
    np.testing.assert_allclose(results[1], results[0], **EXACT)


@on_a_device
def test_march():
    field = random_vm(cells=6)
    rays_o, rays_d = rays_at(BOX, 20)
    alive = np.arange(20) % 5 != 0
    results = []
    for loops in (cpu, cuda):
        start, ts, counts = np.zeros(20, np.int64), np.zeros((20, 4)), np.zeros(20, np.int64)
        for _ in range(2):
            loops.march(field.grid, rays_o, rays_d, 0.0, np.full(20, 0.5), 0.05, start, alive, ts, counts)
        results.append((start, ts, counts))
    for wanted, found in zip(*results, strict=True):
        np.testing.assert_allclose(found, wanted, **EXACT)
    assert results[0][2].any()


@on_a_device
def test_adam(rng):
    """Two steps on some of the entries, half of them untouched."""
    size, low, high = 96, 16, 80
    gradients = rng.normal(size=(2, size)) * (np.arange(size) // 16 % 2 == 0)
    results = []
    for loops in (cpu, cuda):
        arrays = [np.ones(size), np.zeros((1, size)), np.zeros(size), np.zeros(size)]
        for step, gradient in enumerate(gradients):
            arrays[1][0] = gradient
            rest = 0.1, low, high, 0.9, 0.99, 1e-8, 1 / (1 - 0.9 ** (step + 1)), 1 / (1 - 0.99 ** (step + 1))
            loops.adam(*arrays, *rest)
        results.append(arrays)
    for wanted, found in zip(*results, strict=True):
        np.testing.assert_allclose(found, wanted, **EXACT)


@on_a_device
def test_a_field_there_learns_and_renders_as_here(monkeypatch):
    """One step of training and one picture by the engine's own classes."""
    rays_o, rays_d = rays_at(BOX, 2)
    batch = Batch(rays_o, rays_d, np.full(2, 0.5), np.ones((2, 4)), np.zeros((2, 3)), 0.1, 0.0, 0.4, 1e-3)
    camera = framing_camera(BOX, 0.9, 0.45, 2, 2)
    found = []
    for device in ("cpu", "cuda"):
        if SIMULATED:
            monkeypatch.setattr(kernels, "loops", lambda _, device=device: cuda if device == "cuda" else cpu)
        field = random_vm(dtype=torch.float64).to("cpu" if SIMULATED else device)
        optimiser = Adam(field, 1)
        sums = FusedPass(field).gradient(field, batch, optimiser.grads)
        assert optimiser.sound()
        optimiser.step(0.01)
        shot = render_image(field, camera, step=0.4)
        found.append((sums, field.params.cpu().numpy(), shot.rgb, shot.opacity))
    for wanted, other in zip(*found, strict=True):
        np.testing.assert_allclose(other, wanted, rtol=1e-6, atol=1e-7)
        assert wanted.any()


@on_a_device
def test_pinhole_rays():
    pose = np.eye(4)
    pose[:3] = np.random.default_rng(3).normal(size=(3, 4))
    camera = Camera(pose, 20.0, 21.0, 3.5, 4.5, 9, 5)
    order = tile_order(9, 3)
    wanted = camera.rays(slice(2, 5), order)
    found = np.zeros((27, 3)), np.zeros((27, 3))
    cuda.pinhole_rays(pose, 20.0, 21.0, 3.5, 4.5, 9, 2, order, *found)
    for one, other in zip(wanted, found, strict=True):
        np.testing.assert_allclose(other, one, **EXACT)
