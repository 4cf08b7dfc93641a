"""CPU loops over the scalar bodies: each part of the work runs on one core and writes only what is its own.

Rays are (N, 3) float64 in the field's frame, directions of unit length. A loop over `parts` is the parallel
one: part p owns the p-th slice of the rays and row p of every scratch and gradient array, so nothing races
and a sum over rows has one order.
"""

import numpy as np
from numba import njit, prange

from fusedrf_cli.engine.kernels.items import (
    adam_line,
    cell_density,
    features_point,
    features_point_backward,
    march_ray,
    pinhole_ray,
    query_point,
    query_point_backward,
    render_ray,
    train_ray,
)
from fusedrf_cli.engine.kernels.prefetch import COLOUR, DENSITY, LINE, prefetch_planes

loop = njit(parallel=True, fastmath=True, error_model="numpy", cache=True)
# A task is the serial work of one core. Without the reference counting of array arguments (_nrt) it is up to
# eight times faster, so tasks allocate nothing: the loops around them hand in the scratch.
task = njit(fastmath=True, error_model="numpy", cache=True, _nrt=False)

POINTS_PER_TASK = 2048
RAYS_PER_TASK = 256
ENTRIES_PER_TASK = 1 << 16
POINTS_AHEAD = 4  # a point's texels are asked for so many points before it


def shared(tensor):
    """A torch tensor's numbers as the loops take them, not copied."""
    return tensor.detach().numpy()


def on_device(arrays):
    """Arrays, or a tuple of them, where the loops read them fastest: here as they are."""
    return arrays


@task
def query_task(
    ranks, colour_ranks, coefficients, vm, grid, points, dirs, with_colour, low, high, features, basis, sh,
    sigma, rgb,
):  # fmt: skip
    """`query` for points low..high."""
    for i in range(low, high):
        n = i + POINTS_AHEAD
        if n < high:
            x, y, z = float(points[n, 0]), float(points[n, 1]), float(points[n, 2])
            prefetch_planes(ranks, vm, vm.params, DENSITY, 0, x, y, z)
            if with_colour:
                prefetch_planes(colour_ranks, vm, vm.params, COLOUR, 0, x, y, z)
        query_point(
            ranks, colour_ranks, coefficients, vm, grid, points, dirs, with_colour, i, features, basis, sh,
            sigma, rgb,
        )  # fmt: skip


@loop
def query(ranks, colour_ranks, coefficients, vm, grid, points, dirs, with_colour, sigma, rgb):
    """σ (1/length) and rgb of a VM field at points (N, 3) seen along dirs (N, 3); both 0 where the grid is
    empty."""
    n = points.shape[0]
    width = 3 * len(colour_ranks)
    for part in prange((n + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        kind = vm.params.dtype
        features, basis, sh = np.empty(width, kind), np.empty(3 * width, kind), np.empty(16, kind)
        low, high = part * POINTS_PER_TASK, min(n, (part + 1) * POINTS_PER_TASK)
        query_task(
            ranks,
            colour_ranks,
            coefficients,
            vm,
            grid,
            points,
            dirs,
            with_colour,
            low,
            high,
            features,
            basis,
            sh,
            sigma,
            rgb,
        )


@task
def query_backward_task(
    ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb, low, high, features,
    d_features, basis, d_basis, sh, d_f, scratch, grad,
):  # fmt: skip
    """`query_backward` for points low..high, into one row of gradients."""
    for i in range(low, high):
        n = i + POINTS_AHEAD
        if n < high:
            x, y, z = float(points[n, 0]), float(points[n, 1]), float(points[n, 2])
            prefetch_planes(ranks, vm, vm.params, DENSITY, 0, x, y, z)
            prefetch_planes(ranks, vm, grad, DENSITY, 0, x, y, z)
            if d_rgb[n, 0] != 0 or d_rgb[n, 1] != 0 or d_rgb[n, 2] != 0:
                prefetch_planes(colour_ranks, vm, vm.params, COLOUR, 0, x, y, z)
                prefetch_planes(colour_ranks, vm, grad, COLOUR, 0, x, y, z)
        query_point_backward(
            ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb, i, features,
            d_features, basis, d_basis, sh, d_f, scratch, grad,
        )  # fmt: skip


@loop
def query_backward(ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb, grads):
    """Adjoint of `query`: adds to row p of grads (parts, P) what d_sigma (N,), d_rgb (N, 3) of part p's
    points send back."""
    n = points.shape[0]
    parts = grads.shape[0]
    width = 3 * len(colour_ranks)
    for p in prange(parts):
        kind = vm.params.dtype
        query_backward_task(
            ranks, colour_ranks, coefficients, vm, grid, points, dirs, d_sigma, d_rgb, p * n // parts,
            (p + 1) * n // parts, np.empty(width, kind), np.empty(width, kind), np.empty(3 * width, kind),
            np.empty(3 * width, kind), np.empty(16, kind), np.empty(1, kind),
            np.empty(2 * max(len(ranks), len(colour_ranks)), kind), grads[p],
        )  # fmt: skip


@task
def render_task(
    ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, step, early_stop, low, high,
    features, basis, sh, out,
):  # fmt: skip
    """`render` for rays low..high."""
    for i in range(low, high):
        render_ray(
            ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, step, early_stop, i, features,
            basis, sh, out,
        )  # fmt: skip


@loop
def render(ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, step, early_stop, out):
    """March, shade and composite rays in one pass: out (N, 5) is premultiplied rgb, opacity, and Σ w t (over
    opacity: mean depth).

    Stops at a remaining transmittance of `early_stop`; samples sit at the middle of each step.
    """
    n = rays_o.shape[0]
    width = 3 * len(colour_ranks)
    for part in prange((n + RAYS_PER_TASK - 1) // RAYS_PER_TASK):
        kind = vm.params.dtype
        features, basis, sh = np.empty(width, kind), np.empty(3 * width, kind), np.empty(16, kind)
        low, high = part * RAYS_PER_TASK, min(n, (part + 1) * RAYS_PER_TASK)
        render_task(
            ranks,
            colour_ranks,
            coefficients,
            vm,
            grid,
            rays_o,
            rays_d,
            near,
            step,
            early_stop,
            low,
            high,
            features,
            basis,
            sh,
            out,
        )


@task
def train_task(
    ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
    background, opacity_weight, low, high, ts, pre, weights, carried, rgbs, blocks, slots, spans, features,
    d_features, basis, d_basis, sh, d_f, scratch, grad, loss,
):  # fmt: skip
    """`train_rays` for rays low..high, into one row of gradients and losses."""
    for i in range(low, high):
        train_ray(
            ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step, early_stop,
            target, background, opacity_weight, i, ts, pre, weights, carried, rgbs, blocks, slots, spans,
            features, d_features, basis, d_basis, sh, d_f, scratch, grad, loss,
        )  # fmt: skip


@loop
def train_rays(
    ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
    background, opacity_weight, max_samples, grads, loss,
):  # fmt: skip
    """One pass over rays: render, compare, and add the gradient of the loss to row p of grads (parts, P).

    The loss of a ray is mean_c (C_c + (1 - A) background_c - target_c)^2 + opacity_weight (A - target_3)^2,
    with A the opacity; target is (N, 4): rgb over the ray's background (N, 3), and the captured alpha. loss
    (parts, 3) gains the sums of the colour term, of the opacity term and of the samples taken. jitter (N,) in
    [0, 1) shifts the samples by a share of a step.
    """
    n = rays_o.shape[0]
    parts = grads.shape[0]
    width = 3 * len(colour_ranks)
    for p in prange(parts):
        kind = vm.params.dtype
        ts, pre, weights = np.empty(max_samples), np.empty(max_samples), np.empty(max_samples)
        whole = np.empty((3, max_samples), np.int64)
        train_task(
            ranks, colour_ranks, coefficients, vm, grid, rays_o, rays_d, near, jitter, step, early_stop,
            target, background, opacity_weight, p * n // parts, (p + 1) * n // parts, ts, pre, weights,
            np.empty(max_samples), np.empty((max_samples, 3)), whole[0], whole[1], whole[2],
            np.empty(max_samples * width, kind), np.empty(width, kind), np.empty(3 * width, kind),
            np.empty(3 * width, kind), np.empty(16, kind),
            np.empty(1, kind), np.empty(2 * max(len(ranks), len(colour_ranks)), kind), grads[p], loss[p],
        )  # fmt: skip


@task
def adam_task(params, grads, moment1, moment2, rate, low, high, beta1, beta2, eps, correction1, correction2):
    """`adam` for entries low..high."""
    for line in range(low, high, LINE):
        adam_line(
            params, grads, moment1, moment2, rate, np.uint64(line), beta1, beta2, eps, correction1,
            correction2,
        )  # fmt: skip


@loop
def adam(params, grads, moment1, moment2, rate, low, high, beta1, beta2, eps, correction1, correction2):
    """Adam (Kingma and Ba 2015, alg. 1) on params[low:high], whole cache lines, summing and clearing the rows
    of grads (parts, P).

    An entry whose gradient is exactly 0 was touched by no sample: it and its moments keep their values (lazy
    Adam).
    """
    parts = (high - low + ENTRIES_PER_TASK - 1) // ENTRIES_PER_TASK
    for part in prange(parts):
        start = low + part * ENTRIES_PER_TASK
        end = min(high, start + ENTRIES_PER_TASK)
        adam_task(
            params, grads, moment1, moment2, rate, start, end, beta1, beta2, eps, correction1, correction2
        )


@task
def density_at_cells_task(ranks, vm, b, lo, cell, cells, low, high, offsets, out):
    """`density_at_cells` for cells low..high."""
    for i in range(low, high):
        cell_density(ranks, vm, b, lo, cell, cells, i, offsets, out)


@loop
def density_at_cells(ranks, vm, b, lo, cell, cells, offsets, out):
    """Largest σ of block b, as if unstretched, over `offsets` (K, 3) in each of `cells` (N, 3) int64 of a
    grid: out (N,)."""
    n = cells.shape[0]
    for part in prange((n + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        low, high = part * POINTS_PER_TASK, min(n, (part + 1) * POINTS_PER_TASK)
        density_at_cells_task(ranks, vm, b, lo, cell, cells, low, high, offsets, out)


@task
def pinhole_task(pose, fl_x, fl_y, cx, cy, width, top, order, low, high, rays_o, rays_d):
    """`pinhole_rays` for rays low..high."""
    for i in range(low, high):
        pinhole_ray(pose, fl_x, fl_y, cx, cy, width, top, order, i, rays_o, rays_d)


@loop
def pinhole_rays(pose, fl_x, fl_y, cx, cy, width, top, order, rays_o, rays_d):
    """Rays (N, 3) of an undistorted camera at pose (4, 4), camera to world, OpenGL axes: ray i is that of
    pixel order[i] (N,), counted row by row of `width` pixels from row `top` on."""
    n = order.shape[0]
    for part in prange((n + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        low, high = part * POINTS_PER_TASK, min(n, (part + 1) * POINTS_PER_TASK)
        pinhole_task(pose, fl_x, fl_y, cx, cy, width, top, order, low, high, rays_o, rays_d)


@loop
def march(grid, rays_o, rays_d, near, jitter, step, start, alive, ts, counts):
    """The next samples of every living ray: ts (N, K) distances, counts (N,); start (N,) int64 is where to go
    on, -1 at the end."""
    for i in prange(rays_o.shape[0]):
        march_ray(grid, rays_o, rays_d, near, jitter, step, alive, i, start, ts, counts)


@task
def features_task(colour_ranks, vm, block, points, low, high, out):
    """`features` for points low..high."""
    for i in range(low, high):
        features_point(colour_ranks, vm, block, points, i, out)


@loop
def features(colour_ranks, vm, block, points, out):
    """Colour products of one block at points (N, 3): out (N * 3 rank,), 0 outside the block's box."""
    n = points.shape[0]
    for part in prange((n + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        low, high = part * POINTS_PER_TASK, min(n, (part + 1) * POINTS_PER_TASK)
        features_task(colour_ranks, vm, block, points, low, high, out)


@task
def features_backward_task(colour_ranks, vm, block, points, d_features, low, high, scratch, grad):
    """`features_backward` for points low..high, into one row of gradients."""
    for i in range(low, high):
        features_point_backward(colour_ranks, vm, block, points, d_features, i, scratch, grad)


@loop
def features_backward(colour_ranks, vm, block, points, d_features, grads):
    """Adjoint of `features`: adds to row p of grads (parts, P) what d_features (N * 3 rank,) of part p's
    points send back."""
    n = points.shape[0]
    parts = grads.shape[0]
    for p in prange(parts):
        scratch = np.empty(2 * len(colour_ranks), vm.params.dtype)
        low, high = p * n // parts, (p + 1) * n // parts
        features_backward_task(colour_ranks, vm, block, points, d_features, low, high, scratch, grads[p])
