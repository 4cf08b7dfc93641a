"""Loops that know no kind of field, for the CPU: Adam, rays of a camera, sums of rows, samples of a ray.

Each part of the work runs on one core and writes only what is its own, so that a sum has one order.
"""

import math

import numpy as np
from numba import njit, prange

from fusedrf_cli.engine.kernels.parts import LINE, adam_line, bit_of, body, pinhole_ray, sum_of_rows

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


# Of the bits of a cell's parts (`parts.bit_of`) those in the lower half of an eighth, and of the cell.
LOWER = tuple(
    np.uint64(sum(1 << q for q in range(64) if not q & (low | high)))
    for low, high in ((4, 0), (2, 0), (1, 0), (32, 0), (16, 0), (8, 0))
)


@task
def grow_insides_task(bits, axis, x, grown):
    """`grow_insides` for the cells (x, ...)."""
    nx, ny, nz = bits.shape
    one, zero = np.uint64(4 >> axis), np.uint64(0)  # how much later the bit of the next part is, in an eighth
    eight = np.uint64(32 >> axis)
    low, near = LOWER[axis], LOWER[3 + axis]
    for y in range(ny):
        for z in range(nz):
            own = bits[x, y, z]
            i, j, m = x + (axis == 0), y + (axis == 1), z + (axis == 2)
            after = bits[i, j, m] if i < nx and j < ny and m < nz else zero
            i, j, m = x - (axis == 0), y - (axis == 1), z - (axis == 2)
            before = bits[i, j, m] if i >= 0 and j >= 0 and m >= 0 else zero
            up = ((own & low) << one) | ((own & ~low & near) << (eight - one))
            up |= (before & ~low & ~near) >> (eight + one)
            down = ((own & ~low) >> one) | ((own & low & ~near) >> (eight - one))
            down |= (after & low & near) << (eight + one)
            grown[x, y, z] = own | up | down


@loop
def grow_insides(bits, axis, grown):
    """Of bits (X, Y, Z) uint64, the parts of cells, those that are set, and those beside them along an axis,
    into `grown`."""
    for x in prange(bits.shape[0]):
        grow_insides_task(bits, axis, x, grown)


@task
def mark_parts(bits, level, to_parts, steps, whole, marked):
    """Sets in marked (X, Y, Z) the bits of the parts in which matter of a grid (bits (A, B, C)) lies: of its
    parts, of the eighths of cells that have any for level 1, of the cells for level 0. to_parts (3, 4) takes
    its coordinates, in cells, to those of the marked grid, in parts; steps (K, 3) are the places in each that
    are looked at, `whole` (M, 3) those in a cell that is full of matter."""
    m = 1 << level
    for x in range(bits.shape[0]):
        for y in range(bits.shape[1]):
            for z in range(bits.shape[2]):
                full = bits[x, y, z] == ~np.uint64(0)
                for k in range(whole.shape[0] if full else 0):
                    mark_part(to_parts, x + whole[k, 0], y + whole[k, 1], z + whole[k, 2], marked)
                for q in range(0 if full or bits[x, y, z] == np.uint64(0) else m * m * m):
                    a, b, c = q // (m * m), q // m % m, q % m
                    if holds_any(bits[x, y, z], level, a, b, c):
                        for k in range(steps.shape[0]):
                            u, v = x + (a + steps[k, 0]) / m, y + (b + steps[k, 1]) / m
                            mark_part(to_parts, u, v, z + (c + steps[k, 2]) / m, marked)


@body
def holds_any(bits, level, a, b, c):
    """Whether part, eighth or cell (a, b, c) of a cell, by the level, holds matter."""
    if level == 2:
        return bits >> bit_of(a, b, c) & np.uint64(1) != np.uint64(0)
    if level == 1:
        return bits >> bit_of(2 * a, 2 * b, 2 * c) & np.uint64(255) != np.uint64(0)
    return True


@body
def mark_part(to_parts, u, v, w, marked):
    """Sets the bit of the part in which a point lies."""
    nx, ny, nz = marked.shape
    i, j = part_at(to_parts, 0, u, v, w, nx), part_at(to_parts, 1, u, v, w, ny)
    n = part_at(to_parts, 2, u, v, w, nz)
    marked[i // 4, j // 4, n // 4] |= np.uint64(1) << bit_of(i % 4, j % 4, n % 4)


@body
def part_at(to_parts, axis, u, v, w, cells):
    """Which of the parts of so many cells along an axis a point lies in, the nearest where it lies beside."""
    at = to_parts[axis, 0] * u + to_parts[axis, 1] * v + to_parts[axis, 2] * w + to_parts[axis, 3]
    return min(max(int(math.floor(at)), 0), 4 * cells - 1)
