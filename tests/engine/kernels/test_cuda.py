"""The loops on a GPU against the CPU's, for fields of every kind: on a GPU where there is one, and always in
numba's simulator.

The simulator runs the functions as plain Python, so the cases are few and small.
"""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composite import Composite
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.fields.computed import Batch, ComputedField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels import cpu
from fusedrf_cli.engine.rendering.cameras import framing_camera
from fusedrf_cli.engine.rendering.volume import reach_of, render_image
from fusedrf_cli.engine.spaces import contracted_l2
from tests.engine.conftest import BOX, points_in, random_vm, rays_at, unit
from tests.engine.kernels.simulated import (
    EXACT,
    HERE,
    SIMULATED,
    beside_the_simulator,
    on_a_device,
    run_simulated,
)
from tests.engine.kinds.cases import BOXED, random_boxed, random_detail
from tests.engine.kinds.sparse_cases import random_sparse

if HERE:
    from fusedrf_cli.engine.kernels import cuda

TURNED = np.array([[0.0, -0.9, 0.0, 0.2], [0.7, 0.0, 0.0, -0.1], [0.0, 0.0, 1.1, 0.3], [0, 0, 0, 1]])


@beside_the_simulator
@pytest.mark.slow
def test_the_simulator_agrees():
    run_simulated(__file__)


@pytest.fixture(autouse=True)
def used_memory(monkeypatch):
    """A thread's own memory holds what another left there; the simulator would clear it."""
    if SIMULATED:
        from numba.cuda.simulator.kernelapi import FakeCUDALocal

        clear = FakeCUDALocal.array

        def used(self, shape, dtype):
            found = clear(self, shape, dtype)
            found[...] = np.nan
            return found

        monkeypatch.setattr(FakeCUDALocal, "array", used)


def vm(dtype: torch.dtype) -> ComputedField:
    """One tensor under an occupancy grid."""
    return random_vm(dtype=dtype, cells=3)


def curved(dtype: torch.dtype) -> ComputedField:
    """A field in a space in which rays are curved."""
    field = random_boxed("dense", dtype)
    return field.with_occupancy(replace(field.occupancy, space=contracted_l2))


FIELDS = {
    "vm": vm,
    "dense, curved": curved,
    "vm, detail": lambda dtype: random_detail(dtype=dtype),
    "sparse": lambda dtype: random_sparse(dtype=dtype),
    "sparse without bands": lambda dtype: random_sparse(0, dtype=dtype),
    **{name: partial(random_boxed, name) for name in BOXED},
}
SINGLE = ["vm", "vm, detail", "sparse", *BOXED]
CASES = [(name, torch.float64) for name in FIELDS] + [(name, torch.float32) for name in SINGLE]
every_field = pytest.mark.parametrize(
    "name, dtype", CASES, ids=[f"{name}, {str(dtype).removeprefix('torch.')}" for name, dtype in CASES]
)


def twice(field: ComputedField, work):
    """Pairs of what work(field) returns here, with float64 numbers, and there, with those of the field. So
    float32 is held to better digits than its own, and nothing is compiled here to compare it with."""
    wanted = work(field.with_params(field.params.double()))
    with pytest.MonkeyPatch.context() as patch:
        if SIMULATED:
            patch.setattr(kernels, "device_loops", lambda _: cuda)
            found = work(field.with_params(field.params.clone()))
        else:
            found = work(field.to("cuda"))
    return zip(wanted, found, strict=True)


def check(found, wanted, dtype=torch.float64) -> None:
    """Equal but for the order of sums; what float32 numbers give is off by a share of the largest."""
    close = EXACT if dtype == torch.float64 else dict(rtol=1e-3, atol=2e-5 * np.abs(wanted).max(initial=0))
    np.testing.assert_allclose(found, wanted, **close)


@on_a_device
@every_field
@pytest.mark.parametrize("count", [0, 1, 24])
def test_query_and_its_gradient(name, dtype, count):
    field = FIELDS[name](dtype)
    points = torch.from_numpy(points_in(field.aabb, count, margin=0.1))
    dirs = torch.from_numpy(unit(np.random.default_rng(1).normal(size=(count, 3))))
    for wanted, found in twice(field, lambda f: f.query(points, dirs)):
        check(found, wanted.numpy(), dtype)
        assert count < 2 or wanted.any()
    d_sigma, d_rgb = torch.linspace(-1, 1, count), torch.linspace(1, -1, 3 * count).view(count, 3)

    def gradient(field):
        grads = np.zeros((1, field.params.numel()), field.real)
        field.query_backward(points, dirs, d_sigma, d_rgb, grads)
        return (grads,)

    for wanted, found in twice(field, gradient):
        check(found, wanted, dtype)
        assert count < 2 or wanted.any()


@on_a_device
@every_field
def test_render(name, dtype):
    field = FIELDS[name](dtype)
    rays_o, rays_d = rays_at(field.aabb, 4)
    rays_d[0] = [0.0, 0.0, -1.0]  # along an axis

    def picture(field):
        out = np.zeros((4, 5))
        field.render_rays(rays_o, rays_d, reach_of(len(out), 0.0, np.inf), 0.1, 1e-3, out)
        return (out,)

    for wanted, found in twice(field, picture):
        check(found, wanted, dtype)
        assert wanted[:, 3].max() > 0.1


@on_a_device
@pytest.mark.parametrize("rule", ["max", "add"])
def test_a_composite_of_two_kinds(rule):
    """Its segments are found here, and marched, traced, shaded and asked there."""
    other, rays = random_sparse(0), rays_at(BOX, 4)
    points = torch.from_numpy(points_in(BOX, 20))
    dirs = torch.from_numpy(unit(np.random.default_rng(1).normal(size=(20, 3))))

    def picture(field):
        second = other if SIMULATED else other.to(field.params.device)
        scene = Composite([Placed("a", field, np.eye(4)), Placed("b", second, TURNED)], rule)
        out, reach = np.zeros((4, 5)), reach_of(4, 0.0, np.inf)
        scene.render_rays(rays[0] - scene.origin, rays[1], reach, 2 * scene.sampling_step, 1e-3, out)
        return out, *(found.numpy() for found in scene.query(points, dirs))

    for wanted, found in twice(vm(torch.float64), picture):
        check(found, wanted, torch.float32)
        assert wanted.max() > 0.1


def trained(rays_o, rays_d, step, **more):
    """Work for `twice`: gradient, losses and samples of rays with random targets, of the first of which the
    depth is known."""
    n, rng = len(rays_o), np.random.default_rng(2)
    jitter, target, background = rng.random(n), rng.random((n, 4)), rng.random((n, 3))
    losses = {"opacity_weight": 0.3, "distortion": 0.1, "depth_weight": 0.5, "depths": rng.random(1) + 1}
    sampling = {"near": 0.0, "step": step, "early_stop": 1e-3}
    batch = Batch(rays_o, rays_d, jitter, target, background, **sampling, **losses, **more)

    def gradient(field):
        grads, loss = np.zeros((1, field.params.numel()), field.real), np.zeros((1, 3))
        field.train_rays(batch, grads, loss)
        return grads, loss

    return gradient


@on_a_device
@every_field
def test_train_rays(name, dtype, in_force):
    """More rays than have memory at a time, and more shaded samples than have a slot for what they keep."""
    field = FIELDS[name](dtype)
    in_force(cuda.CudaConfig(rays_in_flight=2))
    for wanted, found in twice(field, trained(*rays_at(field.aabb, 3), 0.1)):
        check(found, wanted, dtype)
    assert wanted[0, 2] > 3  # samples


@on_a_device
def test_train_rays_of_photos_of_their_own_exposure():
    exposure = np.random.default_rng(6).uniform(0.2, 1.5, (3, 3, 3))
    field = vm(torch.float64)
    for wanted, found in twice(field, trained(*rays_at(field.aabb, 3), 0.1, exposure=exposure)):
        check(found, wanted, torch.float64)


@on_a_device
@pytest.mark.parametrize("away", [0.0, 3e5])
def test_bricks_are_trained_from_far_away(away):
    """The way back finds every sample where the way there had it, however far the ray has come: a distance
    kept in float32 would put it beside its voxel, in one that is not active, or into no brick at all."""
    field = random_sparse(0, dtype=torch.float32, scale=0.3)
    rays_o, rays_d = rays_at(field.aabb, 8)
    for wanted, found in twice(field, trained(rays_o - away * rays_d, rays_d, 0.05)):
        check(found, wanted, torch.float32)


@on_a_device
def test_peaks():
    cells, probes = np.argwhere(np.ones((2, 2, 2), bool)), np.array([[0.25] * 3, [0.75] * 3])
    asked = BOX[:3], (BOX[3:] - BOX[:3]) / 2, cells, probes
    for wanted, found in twice(vm(torch.float64), lambda f: (f.peaks(*asked),)):
        check(found, wanted)


@on_a_device
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_weights_and_votes_of_cells(dtype):
    """Many rays meet in a cell at the same time, and none of them is lost."""
    field = vm(dtype)
    count = 4 if SIMULATED else 4000
    rays_o, rays_d = rays_at(field.aabb, count)
    jitter, inside = np.random.default_rng(3).random(count), np.arange(count) % 3 == 0
    cells = OccupancyGrid.full(field.aabb, 4)

    def found(field):
        weights = field.weights_in_cells(rays_o, rays_d, jitter, 0.0, 0.1)
        return weights, field.votes(rays_o, rays_d, jitter, inside, 0.1, cells)

    for wanted, other in twice(field, found):
        check(other, wanted, torch.float32)
        assert wanted.max() > 0.05


@on_a_device
def test_exposed():
    field = random_sparse(0, depth=1)
    low, high = (field.fine.positions[field.fine.corners[:12, q]] for q in (0, 7))
    for wanted, found in twice(field, lambda f: f.exposed(low, high, np.eye(3), 3.0, 0.01)):
        check(found, wanted)
        assert wanted.any()


@on_a_device
@pytest.mark.parametrize("keep", [False, True])
def test_sums_of_rows(keep):
    field = random_sparse()
    lattice = field.fine
    *edges, target = lattice.gathering if keep else lattice.spreading
    some = target[:20]
    results = []
    for loops in (cpu, cuda):
        values = np.arange(float(field.size))
        loops.sums_of_rows(values, 0, 4, edges[0][:21], *edges[1:], some, keep)
        results.append(values)
    check(results[1], results[0])
    assert (results[0] != np.arange(float(field.size))).any()


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
        check(found, wanted)


@on_a_device
@pytest.mark.parametrize(("name", "beta1"), [("vm", 0.0), ("sparse", 0.9)])
def test_a_field_there_learns_and_renders_as_here(name, beta1):
    """One step of training and one picture by the engine's own classes."""
    field = FIELDS[name](torch.float64)
    rays_o, rays_d = rays_at(field.aabb, 2)
    batch = Batch(rays_o, rays_d, np.full(2, 0.5), np.ones((2, 4)), np.zeros((2, 3)), 0.1, 0.0, 0.2, 1e-3)
    camera = framing_camera(field.aabb, 0.9, 0.45, 2, 2)

    def learn(field):
        field = field.with_params(field.params.clone())
        optimiser, loss = Adam(field, 1, beta1), np.zeros((1, 3))
        field.train_rays(batch, optimiser.grads, loss)
        assert optimiser.sound()
        optimiser.step(0.01)
        shot = render_image(field, camera, step=0.2)
        return loss, field.params.cpu().numpy(), shot.rgb, shot.opacity

    for wanted, other in twice(field, learn):
        np.testing.assert_allclose(other, wanted, rtol=1e-6, atol=1e-7)
        assert wanted.any()
