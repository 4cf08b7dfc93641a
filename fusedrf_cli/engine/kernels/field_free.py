"""Loops that know no kind of field, for the CPU: Adam, rays of a camera, cells to mark, sums of rows.

Each part of the work runs on one core and writes only what is its own, so that a sum has one order.
"""

import math

import numpy as np
from numba import njit, prange

from fusedrf_cli.engine.kernels.lens import lens_ray, unbend
from fusedrf_cli.engine.kernels.prefetch import prefetch
from fusedrf_cli.engine.kernels.primitives import LINE, adam_line, sum_of_rows, touched
from fusedrf_cli.engine.kernels.threads import ONE_THREAD

FLAGS = dict(fastmath=True, error_model="numpy", cache=True)
# Other threads go on while a loop runs: one of them ends the process where it is told to (signals.py).
loop = njit(**FLAGS, parallel=not ONE_THREAD, nogil=True)
# A task is the serial work of one core. Without the reference counting of array arguments (_nrt) it is up to
# eight times faster, so tasks allocate nothing: the loops around them hand in the scratch.
serial = njit(**FLAGS, _nrt=False)

ITEMS_PER_TASK = 2048
LINES_PER_TASK = (1 << 16) // LINE


@serial
def touched_of_all(grads, low, high, starts):
    """How many of the cache lines of entries low..high some sample touched, and their starts."""
    count = 0
    for line in range(low, high, LINE):
        starts[count] = line
        count += touched(grads, np.uint64(line))
    return count


@serial
def touched_of_some(grads, lines, low, high, starts):
    """`touched_of_all` of the cache lines that begin at lines[low:high]."""
    count = 0
    for i in range(low, high):
        starts[count] = lines[i]
        count += touched(grads, np.uint64(lines[i]))
    return count


@serial
def adam_task(
    params, grads, moment1, moment2, rate, starts, count, beta1, beta2, eps, correction1, correction2
):
    """`adam` for the cache lines that begin at starts[:count]. What only they need is asked for early: which
    they are follows no pattern, so that each would be waited for."""
    for i in range(count):
        ahead = starts[min(i + 8, count - 1)]
        prefetch(params, ahead)
        if moment1.shape[0] != 0:
            prefetch(moment1, ahead)
        prefetch(moment2, ahead)
        adam_line(
            params, grads, moment1, moment2, rate, np.uint64(starts[i]), beta1, beta2, eps, correction1,
            correction2,
        )  # fmt: skip


@loop
def adam(params, grads, moment1, moment2, rate, low, high, beta1, beta2, eps, correction1, correction2):
    """Adam (Kingma and Ba 2015, alg. 1) on params[low:high], whole cache lines, summing and clearing the rows
    of grads (parts, P).

    An entry whose gradient is exactly 0 was touched by no sample: it and its moments keep their values (lazy
    Adam). moment1 (0,) stands for β1 = 0.
    """
    per_task = LINES_PER_TASK * LINE
    for part in prange((high - low + per_task - 1) // per_task):
        start = low + part * per_task
        starts = np.empty(LINES_PER_TASK, np.int64)
        count = touched_of_all(grads, start, min(high, start + per_task), starts)
        adam_task(
            params, grads, moment1, moment2, rate, starts, count, beta1, beta2, eps, correction1, correction2
        )


@loop
def adam_lines(params, grads, moment1, moment2, rate, lines, beta1, beta2, eps, correction1, correction2):
    """`adam` on the cache lines that begin at lines (L,) alone: of a large field most are never touched, and
    looking at them would cost more than the rest of a step."""
    for part in prange((len(lines) + LINES_PER_TASK - 1) // LINES_PER_TASK):
        low, high = part * LINES_PER_TASK, min(len(lines), (part + 1) * LINES_PER_TASK)
        starts = np.empty(LINES_PER_TASK, np.int64)
        count = touched_of_some(grads, lines, low, high, starts)
        adam_task(
            params, grads, moment1, moment2, rate, starts, count, beta1, beta2, eps, correction1, correction2
        )


@serial
def lens_task(pose, fl_x, fl_y, cx, cy, distortion, bent, width, top, order, low, high, rays_o, rays_d):
    """`lens_rays` for rays low..high."""
    for i in range(low, high):
        lens_ray(pose, fl_x, fl_y, cx, cy, distortion, bent, width, top, order, i, rays_o, rays_d)


@loop
def lens_rays(pose, fl_x, fl_y, cx, cy, distortion, bent, width, top, order, rays_o, rays_d):
    """Rays (N, 3) of a camera at pose (4, 4), camera to world, OpenGL axes: ray i is that of pixel order[i]
    (N,), counted row by row of `width` pixels from row `top` on. The lens is a pinhole or, where it is
    `bent`, has a `distortion`, a tuple of nine (`lens.bend`)."""
    n = order.shape[0]
    for part in prange((n + ITEMS_PER_TASK - 1) // ITEMS_PER_TASK):
        low, high = part * ITEMS_PER_TASK, min(n, (part + 1) * ITEMS_PER_TASK)
        lens_task(pose, fl_x, fl_y, cx, cy, distortion, bent, width, top, order, low, high, rays_o, rays_d)


@serial
def unbend_task(distorted, distortion, low, high, ideal):
    """`unbent` for points low..high."""
    for i in range(low, high):
        ideal[i, 0], ideal[i, 1] = unbend(distorted[i, 0], distorted[i, 1], distortion)


@loop
def unbent(distorted, distortion, ideal):
    """For every of distorted (N, 2) normalised image coordinates the ideal ones (`lens.unbend`), by a
    lens of `distortion`, a tuple of nine."""
    n = distorted.shape[0]
    for part in prange((n + ITEMS_PER_TASK - 1) // ITEMS_PER_TASK):
        low, high = part * ITEMS_PER_TASK, min(n, (part + 1) * ITEMS_PER_TASK)
        unbend_task(distorted, distortion, low, high, ideal)


@serial
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
