"""CUDA loops over the scalar bodies: one thread per item of work; the functions and their arguments are those
of `cpu.py`.

The bodies are compiled from the same source, with atomic sums where threads may add to the same place. Arrays
may lie on the device or on the host: what is on the host is copied to the device and, where a function writes
it, back. NUMBA_ENABLE_CUDASIM=1 runs all of this without a GPU.
"""

from functools import lru_cache
from types import FunctionType, SimpleNamespace

import numba
import numpy as np
from numba import cuda
from numba.np.numpy_support import from_dtype

from fusedrf_cli.engine.kernels import bodies, items

SIMULATED = bool(numba.config.ENABLE_CUDASIM)
THREADS = 1 if SIMULATED else 128  # the simulator's threads are Python's, one after the other
RAYS_IN_FLIGHT = 1 << 14  # rays of a training pass that have scratch memory at the same time

device = cuda.jit(device=True, fastmath=True)


@device
def accumulate(out, i, value):
    """`bodies.accumulate`, atomic."""
    cuda.atomic.add(out, i, value)


@device
def scatter_8(out, o, weight, values, v):
    """`bodies.scatter_8`, atomic."""
    for r in range(8):
        cuda.atomic.add(out, o + np.uint64(r), weight * values[v + np.uint64(r)])


@device
def prefetch_planes(ranks, vm, array, first, b, x, y, z):
    """Nothing: while some threads wait for memory, others work."""


@lru_cache(maxsize=1)
def device_bodies() -> SimpleNamespace:
    """Every body of bodies.py and items.py as a device function that calls device functions."""
    names = {**vars(bodies), **vars(items)}
    for name, value in list(names.items()):
        if hasattr(value, "py_func"):
            names[name] = device(FunctionType(value.py_func.__code__, names, name))
    names |= {"accumulate": accumulate, "scatter_8": scatter_8, "prefetch_planes": prefetch_planes}
    return SimpleNamespace(**names)


@lru_cache
def point_kernels(rank: int, colour_rank: int, kind: np.dtype) -> SimpleNamespace:
    """Kernels over points and cells, for ranks and a float type: the sizes of a thread's own arrays."""
    body, real = device_bodies(), from_dtype(kind)
    width, wide, both = 3 * colour_rank, 9 * colour_rank, 2 * max(rank, colour_rank)
    query_point, query_point_backward = body.query_point, body.query_point_backward
    features_point, features_point_backward = body.features_point, body.features_point_backward
    cell_density = body.cell_density

    @cuda.jit(fastmath=True)
    def query(ranks, colour_ranks, coefficients, vm, grid, points, dirs, with_colour, sigma, rgb):
        i = cuda.grid(1)
        if i < points.shape[0]:
            features, basis = cuda.local.array(width, real), cuda.local.array(wide, real)
            sh = cuda.local.array(16, real)
            query_point(
                ranks, colour_ranks, coefficients, vm, grid, points, dirs, with_colour, i, features, basis,
                sh, sigma, rgb,
            )  # fmt: skip

    @cuda.jit(fastmath=True)
    def query_backward(ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb, grads):
        i = cuda.grid(1)
        if i < points.shape[0]:
            features, basis = cuda.local.array(width, real), cuda.local.array(wide, real)
            d_features, d_basis = cuda.local.array(width, real), cuda.local.array(wide, real)
            sh, d_f = cuda.local.array(16, real), cuda.local.array(1, real)
            scratch = cuda.local.array(both, real)
            query_point_backward(
                ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb, i, features,
                d_features, basis, d_basis, sh, d_f, scratch, grads[0],
            )  # fmt: skip

    @cuda.jit(fastmath=True)
    def features(colour_ranks, vm, block, points, out):
        i = cuda.grid(1)
        if i < points.shape[0]:
            features_point(colour_ranks, vm, block, points, i, out)

    @cuda.jit(fastmath=True)
    def features_backward(colour_ranks, vm, block, points, d_features, grads):
        i = cuda.grid(1)
        if i < points.shape[0]:
            scratch = cuda.local.array(both, real)
            features_point_backward(colour_ranks, vm, block, points, d_features, i, scratch, grads[0])

    @cuda.jit(fastmath=True)
    def density_at_cells(ranks, vm, b, lo, cell, cells, offsets, out):
        i = cuda.grid(1)
        if i < cells.shape[0]:
            cell_density(ranks, vm, b, lo, cell, cells, i, offsets, out)

    return SimpleNamespace(
        query=query, query_backward=query_backward, features=features, features_backward=features_backward,
        density_at_cells=density_at_cells,
    )  # fmt: skip


@lru_cache
def ray_kernels(rank: int, colour_rank: int, kind: np.dtype) -> SimpleNamespace:
    """Kernels over rays, for ranks and a float type."""
    body, real = device_bodies(), from_dtype(kind)
    width, wide, both = 3 * colour_rank, 9 * colour_rank, 2 * max(rank, colour_rank)
    render_ray, train_ray = body.render_ray, body.train_ray

    @cuda.jit(fastmath=True)
    def render(ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, step, early_stop, out):
        i = cuda.grid(1)
        if i < rays_o.shape[0]:
            features, basis = cuda.local.array(width, real), cuda.local.array(wide, real)
            sh = cuda.local.array(16, real)
            render_ray(
                ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, step, early_stop, i,
                features, basis, sh, out,
            )  # fmt: skip

    @cuda.jit(fastmath=True)
    def train_rays(
        ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
        background, opacity_weight, reals, wholes, grads, loss,
    ):  # fmt: skip
        thread = cuda.grid(1)
        features, basis = cuda.local.array(width, real), cuda.local.array(wide, real)
        d_features, d_basis = cuda.local.array(width, real), cuda.local.array(wide, real)
        sh, d_f = cuda.local.array(16, real), cuda.local.array(1, real)
        scratch = cuda.local.array(both, real)
        if thread < reals.shape[2]:
            for i in range(thread, rays_o.shape[0], reals.shape[2]):
                train_ray(
                    ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step,
                    early_stop, target, background, opacity_weight, i, reals[0, :, thread],
                    reals[1, :, thread], reals[2, :, thread], reals[3, :, thread],
                    reals[4:7, :, thread].T, wholes[0, :, thread], wholes[1, :, thread],
                    wholes[2, :, thread], features, d_features, basis, d_basis, sh, d_f, scratch, grads[0],
                    loss[0],
                )  # fmt: skip

    return SimpleNamespace(render=render, train_rays=train_rays)


@lru_cache(maxsize=1)
def plain_kernels() -> SimpleNamespace:
    """Kernels that know nothing of ranks."""
    body = device_bodies()
    adam_line, march_ray, pinhole_ray, line = body.adam_line, body.march_ray, body.pinhole_ray, items.LINE

    @cuda.jit(fastmath=True)
    def adam(params, grads, moment1, moment2, rate, low, high, beta1, beta2, eps, correction1, correction2):
        start = low + line * cuda.grid(1)
        if start < high:
            adam_line(
                params, grads, moment1, moment2, rate, np.uint64(start), beta1, beta2, eps, correction1,
                correction2,
            )  # fmt: skip

    @cuda.jit(fastmath=True)
    def march(grid, rays_o, rays_d, near, jitter, step, alive, start, ts, counts):
        i = cuda.grid(1)
        if i < rays_o.shape[0]:
            march_ray(grid, rays_o, rays_d, near, jitter, step, alive, i, start, ts, counts)

    @cuda.jit(fastmath=True)
    def pinhole_rays(pose, fl_x, fl_y, cx, cy, width, top, order, rays_o, rays_d):
        i = cuda.grid(1)
        if i < order.shape[0]:
            pinhole_ray(pose, fl_x, fl_y, cx, cy, width, top, order, i, rays_o, rays_d)

    return SimpleNamespace(adam=adam, march=march, pinhole_rays=pinhole_rays)


@lru_cache(maxsize=2)
def training_scratch(max_samples: int, rays: int, kind: np.dtype) -> tuple:
    """What the backward sweeps of so many rays need: (7, max_samples, rays) reals and (3, ..) whole numbers,
    a ray's own next to its neighbours', as threads read them."""
    shape = max_samples, rays
    return cuda.device_array((7, *shape), kind), cuda.device_array((3, *shape), np.int32)


def shared(tensor):
    """A torch tensor's numbers as the loops take them, not copied. The simulator's device is the host."""
    return tensor.detach().numpy() if SIMULATED else cuda.as_cuda_array(tensor.detach())


def on_device(value):
    """A host array's copy on the device, a tuple of arrays with all of them there; all else as it is."""
    if isinstance(value, np.ndarray):
        return value if SIMULATED else cuda.to_device(np.ascontiguousarray(value))
    return type(value)(*map(on_device, value)) if hasattr(value, "_fields") else value


def launch(kernel, items: int, inputs: tuple, outputs: tuple) -> None:
    """Run a kernel, one thread per item; its last arguments are the arrays it writes."""
    if items:
        placed = [on_device(array) for array in outputs]
        kernel[(items + THREADS - 1) // THREADS, THREADS](*map(on_device, inputs), *placed)
        fetch(outputs, placed)


def fetch(host: tuple, placed: list) -> None:
    """Copy what lies on the device back to those arrays that lie on the host."""
    for array, there in zip(host, placed, strict=True):
        if there is not array:
            there.copy_to_host(array)


# -- the functions of cpu.py -------------------------------------------------------------------------------


def query(ranks, colour_ranks, coefficients, vm, grid, points, dirs, with_colour, sigma, rgb):
    """See cpu.query."""
    kernel = point_kernels(len(ranks), len(colour_ranks), vm.params.dtype).query
    inputs = ranks, colour_ranks, coefficients, vm, grid, points, dirs, with_colour
    launch(kernel, len(points), inputs, (sigma, rgb))


def query_backward(ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb, grads):
    """See cpu.query_backward; all is added to row 0 of grads."""
    kernel = point_kernels(len(ranks), len(colour_ranks), vm.params.dtype).query_backward
    inputs = ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb
    launch(kernel, len(points), inputs, (grads,))


def features(colour_ranks, vm, block, points, out):
    """See cpu.features."""
    kernel = point_kernels(len(colour_ranks), len(colour_ranks), vm.params.dtype).features
    launch(kernel, len(points), (colour_ranks, vm, block, points), (out,))


def features_backward(colour_ranks, vm, block, points, d_features, grads):
    """See cpu.features_backward; all is added to row 0 of grads."""
    kernel = point_kernels(len(colour_ranks), len(colour_ranks), vm.params.dtype).features_backward
    launch(kernel, len(points), (colour_ranks, vm, block, points, d_features), (grads,))


def density_at_cells(ranks, vm, b, lo, cell, cells, offsets, out):
    """See cpu.density_at_cells."""
    kernel = point_kernels(len(ranks), len(ranks), vm.params.dtype).density_at_cells
    launch(kernel, len(cells), (ranks, vm, b, lo, cell, cells, offsets), (out,))


def render(ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, step, early_stop, out):
    """See cpu.render."""
    kernel = ray_kernels(len(ranks), len(colour_ranks), vm.params.dtype).render
    inputs = ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, step, early_stop
    launch(kernel, len(rays_o), inputs, (out,))


def train_rays(
    ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
    background, opacity_weight, max_samples, grads, loss,
):  # fmt: skip
    """See cpu.train_rays; all is added to row 0 of grads and loss."""
    kernel = ray_kernels(len(ranks), len(colour_ranks), vm.params.dtype).train_rays
    # as much for few rays as for many: their number changes from step to step, and memory is slow to be had
    scratch = training_scratch(max_samples, RAYS_IN_FLIGHT, vm.params.dtype)
    inputs = (
        ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
        background, opacity_weight, *scratch,
    )  # fmt: skip
    launch(kernel, min(len(rays_o), RAYS_IN_FLIGHT), inputs, (grads, loss))


def adam(params, grads, moment1, moment2, rate, low, high, beta1, beta2, eps, correction1, correction2):
    """See cpu.adam."""
    inputs = params, grads, moment1, moment2
    placed = [on_device(array) for array in inputs]
    rest = rate, low, high, beta1, beta2, eps, correction1, correction2
    lines = -(-(high - low) // items.LINE)
    if lines > 0:
        plain_kernels().adam[(lines + THREADS - 1) // THREADS, THREADS](*placed, *rest)
    fetch(inputs, placed)


def march(grid, rays_o, rays_d, near, jitter, step, start, alive, ts, counts):
    """See cpu.march."""
    inputs = grid, rays_o, rays_d, near, jitter, step, alive
    launch(plain_kernels().march, len(rays_o), inputs, (start, ts, counts))


def pinhole_rays(pose, fl_x, fl_y, cx, cy, width, top, order, rays_o, rays_d):
    """See cpu.pinhole_rays."""
    inputs = pose, fl_x, fl_y, cx, cy, width, top, order
    launch(plain_kernels().pinhole_rays, len(order), inputs, (rays_o, rays_d))
