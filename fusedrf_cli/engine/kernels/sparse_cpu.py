"""CPU loops over the bodies of sparse_bodies.py, after the pattern of `cpu.py`: a part of the work per core,
which writes only what is its own."""

import numpy as np
from numba import prange

from fusedrf_cli.engine.kernels.cpu import (
    POINTS_PER_TASK,
    RAYS_PER_TASK,
    adam,
    loop,
    on_device,
    shared,
    task,
)
from fusedrf_cli.engine.kernels.sparse_bodies import (
    expose_voxel,
    query_sparse_point,
    query_sparse_point_backward,
    render_sparse_ray,
    sum_of_rows,
    train_sparse_ray,
)

__all__ = [
    "adam", "expose", "on_device", "query", "query_backward", "render", "shared", "sums_of_rows",
    "train_rays",
]  # fmt: skip


@task
def query_task(
    widths, coefficients, sparse, points, dirs, with_colour, low, high, sh, bands, logits, sigma, rgb
):
    """`query` for points low..high."""
    for i in range(low, high):
        query_sparse_point(
            widths, coefficients, sparse, points, dirs, with_colour, i, sh, bands, logits, sigma, rgb
        )


@loop
def query(widths, coefficients, sparse, points, dirs, with_colour, sigma, rgb):
    """σ (1/length) and rgb of a sparse field at points (N, 3) seen along dirs (N, 3); 0 where no voxel is
    active."""
    n = points.shape[0]
    for part in prange((n + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        kind = sparse.params.dtype
        sh, bands, logits = np.empty(16, kind), np.empty(len(widths), kind), np.empty(3)
        low, high = part * POINTS_PER_TASK, min(n, (part + 1) * POINTS_PER_TASK)
        query_task(
            widths, coefficients, sparse, points, dirs, with_colour, low, high, sh, bands, logits, sigma, rgb
        )


@task
def query_backward_task(
    widths, coefficients, sparse, points, dirs, d_sigma, d_rgb, low, high, sh, bands, logits, grad
):
    """`query_backward` for points low..high, into one row of gradients."""
    for i in range(low, high):
        query_sparse_point_backward(
            widths, coefficients, sparse, points, dirs, d_sigma, d_rgb, i, sh, bands, logits, grad
        )


@loop
def query_backward(widths, coefficients, sparse, points, dirs, d_sigma, d_rgb, grads):
    """Adjoint of `query`: adds to row p of grads (parts, P) what d_sigma (N,), d_rgb (N, 3) of part p's
    points send back."""
    n = points.shape[0]
    parts = grads.shape[0]
    for p in prange(parts):
        kind = sparse.params.dtype
        query_backward_task(
            widths, coefficients, sparse, points, dirs, d_sigma, d_rgb, p * n // parts, (p + 1) * n // parts,
            np.empty(16, kind), np.empty(len(widths), kind), np.empty(3), grads[p],
        )  # fmt: skip


@task
def render_task(
    widths, coefficients, sparse, grid, rays_o, rays_d, near, step, early_stop, low, high, sh, bands,
    logits, out,
):  # fmt: skip
    """`render` for rays low..high."""
    for i in range(low, high):
        render_sparse_ray(
            widths, coefficients, sparse, grid, rays_o, rays_d, near, step, early_stop, i, sh, bands,
            logits, out,
        )  # fmt: skip


@loop
def render(widths, coefficients, sparse, grid, rays_o, rays_d, near, step, early_stop, out):
    """March, shade and composite rays in one pass: out (N, 5) as of `cpu.render`."""
    n = rays_o.shape[0]
    for part in prange((n + RAYS_PER_TASK - 1) // RAYS_PER_TASK):
        kind = sparse.params.dtype
        sh, bands, logits = np.empty(16, kind), np.empty(len(widths), kind), np.empty(3)
        low, high = part * RAYS_PER_TASK, min(n, (part + 1) * RAYS_PER_TASK)
        render_task(
            widths, coefficients, sparse, grid, rays_o, rays_d, near, step, early_stop, low, high, sh, bands,
            logits, out,
        )  # fmt: skip


@task
def expose_task(sparse, places, sides, directions, far, blocked, low, high, clearest, facing):
    """`expose` for voxels low..high."""
    for i in range(low, high):
        expose_voxel(sparse, places, sides, directions, far, blocked, i, clearest, facing)


@loop
def expose(sparse, places, sides, directions, far, blocked, clearest, facing):
    """How much light reaches voxels of sides (K,) around places (K, 3): clearest (K,) and facing (K, 3) as of
    `expose_voxel`."""
    n = places.shape[0]
    for part in prange((n + POINTS_PER_TASK - 1) // POINTS_PER_TASK):
        low, high = part * POINTS_PER_TASK, min(n, (part + 1) * POINTS_PER_TASK)
        expose_task(sparse, places, sides, directions, far, blocked, low, high, clearest, facing)


@task
def train_task(
    widths, coefficients, sparse, grid, rays_o, rays_d, near, jitter, step, early_stop, target, background,
    opacity_weight, low, high, ts, pre, weights, carried, rgbs, spans, sh, bands, logits, grad, loss,
):  # fmt: skip
    """`train_rays` for rays low..high, into one row of gradients and losses."""
    for i in range(low, high):
        train_sparse_ray(
            widths, coefficients, sparse, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
            background, opacity_weight, i, ts, pre, weights, carried, rgbs, spans, sh, bands, logits, grad,
            loss,
        )  # fmt: skip


@loop
def train_rays(
    widths, coefficients, sparse, grid, rays_o, rays_d, near, jitter, step, early_stop, target, background,
    opacity_weight, max_samples, grads, loss,
):  # fmt: skip
    """One pass over rays: render, compare, and add the gradient of the loss to row p of grads (parts, P); the
    loss is that of `cpu.train_rays`."""
    n = rays_o.shape[0]
    parts = grads.shape[0]
    for p in prange(parts):
        kind = sparse.params.dtype
        train_task(
            widths, coefficients, sparse, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
            background, opacity_weight, p * n // parts, (p + 1) * n // parts, np.empty(max_samples),
            np.empty(max_samples), np.empty(max_samples), np.empty(max_samples), np.empty((max_samples, 3)),
            np.empty(max_samples, np.int64), np.empty(16, kind), np.empty(len(widths), kind), np.empty(3),
            grads[p], loss[p],
        )  # fmt: skip


@loop
def sums_of_rows(values, base, width, start, source, weight, target, keep):
    """For every i, row target[i] of `values` (flat; rows of a width from `base` on) becomes, or with `keep`
    gains, the weighted sum of the rows source[start[i]:start[i + 1]], none of which is a target."""
    for i in prange(target.shape[0]):
        sum_of_rows(values, base, width, start, source, weight, target, i, keep)
