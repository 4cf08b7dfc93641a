"""CUDA loops over the bodies of sparse_bodies.py, after the pattern of `cuda.py`: one thread per item of
work; the functions and their arguments are those of `sparse_cpu.py`."""

from functools import lru_cache
from types import FunctionType, SimpleNamespace

import numpy as np
from numba import cuda
from numba.np.numpy_support import from_dtype

from fusedrf_cli.engine.kernels import sparse_bodies
from fusedrf_cli.engine.kernels.cuda import (
    RAYS_IN_FLIGHT,
    accumulate,
    adam,
    device,
    device_bodies,
    launch,
    on_device,
    scatter_8,
    shared,
    training_scratch,
)

__all__ = [
    "adam",
    "expose",
    "on_device",
    "query",
    "query_backward",
    "render",
    "shared",
    "sums_of_rows",
    "train_rays",
]


@lru_cache(maxsize=1)
def sparse_device_bodies() -> SimpleNamespace:
    """Every body of sparse_bodies.py as a device function that calls device functions."""
    names = {**vars(sparse_bodies), **vars(device_bodies())}
    for name, value in vars(sparse_bodies).items():
        if hasattr(value, "py_func") and value.py_func.__module__ == sparse_bodies.__name__:
            names[name] = device(FunctionType(value.py_func.__code__, names, name))
    return SimpleNamespace(**(names | {"accumulate": accumulate, "scatter_8": scatter_8}))


@lru_cache
def kernels(width: int, kind: np.dtype) -> SimpleNamespace:
    """Kernels for a width of bands and a float type: the sizes of a thread's own arrays."""
    body, real, room = sparse_device_bodies(), from_dtype(kind), max(width, 1)
    query_point, query_point_backward = body.query_sparse_point, body.query_sparse_point_backward
    render_ray, train_ray = body.render_sparse_ray, body.train_sparse_ray

    @cuda.jit(fastmath=True)
    def query(widths, coefficients, sparse, points, dirs, with_colour, sigma, rgb):
        i = cuda.grid(1)
        if i < points.shape[0]:
            sh, bands, logits = (
                cuda.local.array(16, real),
                cuda.local.array(room, real),
                cuda.local.array(3, real),
            )
            query_point(
                widths, coefficients, sparse, points, dirs, with_colour, i, sh, bands, logits, sigma, rgb
            )

    @cuda.jit(fastmath=True)
    def query_backward(widths, coefficients, sparse, points, dirs, d_sigma, d_rgb, grads):
        i = cuda.grid(1)
        if i < points.shape[0]:
            sh, bands, logits = (
                cuda.local.array(16, real),
                cuda.local.array(room, real),
                cuda.local.array(3, real),
            )
            query_point_backward(
                widths, coefficients, sparse, points, dirs, d_sigma, d_rgb, i, sh, bands, logits, grads[0]
            )

    @cuda.jit(fastmath=True)
    def render(widths, coefficients, sparse, grid, rays_o, rays_d, near, step, early_stop, out):
        i = cuda.grid(1)
        if i < rays_o.shape[0]:
            sh, bands, logits = (
                cuda.local.array(16, real),
                cuda.local.array(room, real),
                cuda.local.array(3, real),
            )
            render_ray(
                widths, coefficients, sparse, grid, rays_o, rays_d, near, step, early_stop, i, sh, bands,
                logits, out,
            )  # fmt: skip

    @cuda.jit(fastmath=True)
    def train_rays(
        widths, coefficients, sparse, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
        background, opacity_weight, reals, wholes, grads, loss,
    ):  # fmt: skip
        thread = cuda.grid(1)
        sh, bands, logits = (
            cuda.local.array(16, real),
            cuda.local.array(room, real),
            cuda.local.array(3, real),
        )
        if thread < reals.shape[2]:
            for i in range(thread, rays_o.shape[0], reals.shape[2]):
                train_ray(
                    widths, coefficients, sparse, grid, rays_o, rays_d, near, jitter, step, early_stop,
                    target,
                    background, opacity_weight, i, reals[0, :, thread], reals[1, :, thread], reals[2, :,
                    thread],
                    reals[3, :, thread], reals[4:7, :, thread].T, wholes[0, :, thread], sh, bands, logits,
                    grads[0], loss[0],
                )  # fmt: skip

    return SimpleNamespace(query=query, query_backward=query_backward, render=render, train_rays=train_rays)


@lru_cache(maxsize=1)
def plain_kernels() -> SimpleNamespace:
    """Kernels that know nothing of colours."""
    body = sparse_device_bodies()
    expose_voxel, sum_of_rows = body.expose_voxel, body.sum_of_rows

    @cuda.jit(fastmath=True)
    def expose(sparse, places, sides, directions, far, blocked, clearest, facing):
        i = cuda.grid(1)
        if i < places.shape[0]:
            expose_voxel(sparse, places, sides, directions, far, blocked, i, clearest, facing)

    @cuda.jit(fastmath=True)
    def sums_of_rows(base, width, start, source, weight, target, keep, values):
        i = cuda.grid(1)
        if i < target.shape[0]:
            sum_of_rows(values, base, width, start, source, weight, target, i, keep)

    return SimpleNamespace(expose=expose, sums_of_rows=sums_of_rows)


# -- the functions of sparse_cpu.py ------------------------------------------------------------------------


def query(widths, coefficients, sparse, points, dirs, with_colour, sigma, rgb):
    """See sparse_cpu.query."""
    inputs = widths, coefficients, sparse, points, dirs, with_colour
    launch(kernels(len(widths), sparse.params.dtype).query, len(points), inputs, (sigma, rgb))


def query_backward(widths, coefficients, sparse, points, dirs, d_sigma, d_rgb, grads):
    """See sparse_cpu.query_backward; all is added to row 0 of grads."""
    inputs = widths, coefficients, sparse, points, dirs, d_sigma, d_rgb
    launch(kernels(len(widths), sparse.params.dtype).query_backward, len(points), inputs, (grads,))


def render(widths, coefficients, sparse, grid, rays_o, rays_d, near, step, early_stop, out):
    """See sparse_cpu.render."""
    inputs = widths, coefficients, sparse, grid, rays_o, rays_d, near, step, early_stop
    launch(kernels(len(widths), sparse.params.dtype).render, len(rays_o), inputs, (out,))


def train_rays(
    widths, coefficients, sparse, grid, rays_o, rays_d, near, jitter, step, early_stop, target, background,
    opacity_weight, max_samples, grads, loss,
):  # fmt: skip
    """See sparse_cpu.train_rays; all is added to row 0 of grads and loss."""
    scratch = training_scratch(max_samples, RAYS_IN_FLIGHT, sparse.params.dtype)
    inputs = (
        widths, coefficients, sparse, grid, rays_o, rays_d, near, jitter, step, early_stop, target,
        background, opacity_weight, *scratch,
    )  # fmt: skip
    kernel = kernels(len(widths), sparse.params.dtype).train_rays
    launch(kernel, min(len(rays_o), RAYS_IN_FLIGHT), inputs, (grads, loss))


def expose(sparse, places, sides, directions, far, blocked, clearest, facing):
    """See sparse_cpu.expose."""
    inputs = sparse, places, sides, directions, far, blocked
    launch(plain_kernels().expose, len(places), inputs, (clearest, facing))


def sums_of_rows(values, base, width, start, source, weight, target, keep):
    """See sparse_cpu.sums_of_rows."""
    inputs = base, width, start, source, weight, target, keep
    launch(plain_kernels().sums_of_rows, len(target), inputs, (values,))
