"""Loops that know no kind of field, for the CPU: Adam, rays of a camera, sums of rows, samples of a ray.

Each part of the work runs on one core and writes only what is its own, so that a sum has one order.
"""

import math

import numpy as np
from numba import njit, prange

from fusedrf_cli.engine.kernels.parts import LINE, adam_line, pinhole_ray, sum_of_rows

FLAGS = dict(fastmath=True, error_model="numpy", cache=True)
loop = njit(**FLAGS, parallel=True)
# A task is the serial work of one core. Without the reference counting of array arguments (_nrt) it is up to
# eight times faster, so tasks allocate nothing: the loops around them hand in the scratch.
task = njit(**FLAGS, _nrt=False)

RAYS_PER_TASK = 2048
ENTRIES_PER_TASK = 1 << 16
LINES_PER_TASK = ENTRIES_PER_TASK // LINE


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
def adam_lines_task(
    params, grads, moment1, moment2, rate, lines, part, beta1, beta2, eps, correction1, correction2
):
    """`adam_lines` for the part-th of them."""
    low, high = part * LINES_PER_TASK, min(len(lines), (part + 1) * LINES_PER_TASK)
    for i in range(low, high):
        adam_line(
            params, grads, moment1, moment2, rate, np.uint64(lines[i]), beta1, beta2, eps, correction1,
            correction2,
        )  # fmt: skip


@loop
def adam_lines(params, grads, moment1, moment2, rate, lines, beta1, beta2, eps, correction1, correction2):
    """`adam` on the cache lines that begin at lines (L,) alone: of a large field most are never touched, and
    looking at them would cost more than the rest of a step."""
    for part in prange((len(lines) + LINES_PER_TASK - 1) // LINES_PER_TASK):
        adam_lines_task(
            params, grads, moment1, moment2, rate, lines, part, beta1, beta2, eps, correction1, correction2
        )


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
    for part in prange((n + RAYS_PER_TASK - 1) // RAYS_PER_TASK):
        low, high = part * RAYS_PER_TASK, min(n, (part + 1) * RAYS_PER_TASK)
        pinhole_task(pose, fl_x, fl_y, cx, cy, width, top, order, low, high, rays_o, rays_d)


@task
def mark_cells(corners, offsets, marked):
    """Set the cells of marked (X, Y, Z) bool in which corners (N, 3) plus offsets (K, 3) lie, both counted in
    cells; for those outside the cell on a face that is next to them."""
    nx, ny, nz = marked.shape
    for n in range(corners.shape[0]):
        for k in range(offsets.shape[0]):
            i = int(math.floor(corners[n, 0] + offsets[k, 0]))
            j = int(math.floor(corners[n, 1] + offsets[k, 1]))
            m = int(math.floor(corners[n, 2] + offsets[k, 2]))
            marked[min(max(i, 0), nx - 1), min(max(j, 0), ny - 1), min(max(m, 0), nz - 1)] = True


@loop
def sums_of_rows(values, base, width, start, source, weight, target, keep):
    """For every i, row target[i] of `values` (flat; rows of a width, from `base` on) becomes, or with `keep`
    gains, the weighted sum of the rows source[start[i]:start[i + 1]], none of which is a target."""
    for i in prange(target.shape[0]):
        sum_of_rows(values, base, width, start, source, weight, target, i, keep)
