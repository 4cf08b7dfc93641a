"""Scalar parts that kinds of field, spaces and loops are put together from, compiled once for all of them; a
GPU compiles the same source.

Points and directions are tuples (x, y, z) of float64. Offsets are unsigned: a signed index costs a
wrap-around test per load, a factor of five in all. What several rays may add to at the same time goes through
`accumulate`, `scatter_8` and `scatter`, which a GPU replaces by atomic ones.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import literally, njit

device = njit(fastmath=True, error_model="numpy", cache=True, forceinline=True, _nrt=False)

LINE = 16  # floats in a cache line
CLIPPED = 0.97  # a photo's colour from which on more light would not have shown
FARTHEST = 1e30  # farther than any ray goes
FACE_TOLERANCE = 1e-6  # steps: a sample on the face of an occupied cell must not be jumped over by rounding


class GridArrays(NamedTuple):
    """The occupancy grid: `skip` is 0 in an occupied cell, else the Chebyshev distance in cells to the next
    one. Samples in a cell may be `stride` times `unit` apart; without strides they are a step apart."""

    skip: object  # (X, Y, Z) uint8
    lo: object  # (3,) float, lower corner
    hi: object  # (3,) float, upper corner
    cell: object  # (3,) float, size of a cell
    stride: object = np.zeros((0, 0, 0), np.uint16)  # (X, Y, Z) uint16, at least 1 in occupied cells
    unit: object = 0.0  # float


@device
def along(origin, direction, u):
    """The point at length u of a straight line."""
    return origin[0] + u * direction[0], origin[1] + u * direction[1], origin[2] + u * direction[2]


@device
def hit_box(origin, direction, lo, hi):
    """Interval [t0, t1] in which a ray is inside a box; t1 < t0 when it misses. A zero component is tested
    apart (0 * inf)."""
    ox, oy, oz = origin
    dx, dy, dz = direction
    t0 = 0.0
    t1 = FARTHEST
    for axis in range(3):
        o = ox if axis == 0 else (oy if axis == 1 else oz)
        d = dx if axis == 0 else (dy if axis == 1 else dz)
        if d == 0.0:
            if o < lo[axis] or o >= hi[axis]:
                return 1.0, 0.0
        else:
            a = (lo[axis] - o) / d
            b = (hi[axis] - o) / d
            t0 = max(t0, min(a, b))
            t1 = min(t1, max(a, b))
    return t0, t1


@device
def cell_of(p, lo, cell, n):
    """Index of the cell that holds coordinate p, clamped to the grid."""
    return min(max(int((p - lo) / cell), 0), n - 1)


@device
def exit_distance(p, d, lo, cell, i, s):
    """Distance along the ray to the face of the empty cube of half width s around cell i, on one axis."""
    if d > 0.0:
        return (lo + (i + s) * cell - p) / d
    if d < 0.0:
        return (lo + (i - s + 1) * cell - p) / d
    return FARTHEST


@device
def next_sample(grid, origin, direction, t_begin, t_end, step, index):
    """(the first number n >= index at which t_begin + n step of a straight line lies in an occupied cell, for
    how many steps from there on one sample may stand), or (-1, 1) when there is no such n before t_end.

    Samples stay on the ray's own lattice whatever is skipped, so that an image with and without skipping is
    the same: what stands for several steps ends at a whole multiple of them, or before.
    """
    dx, dy, dz = direction
    skip, lo, cell = grid.skip, grid.lo, grid.cell
    nx, ny, nz = skip.shape
    while True:
        t_local = t_begin + index * step
        if t_local >= t_end:
            return -1, 1
        x, y, z = along(origin, direction, t_local)
        i = cell_of(x, lo[0], cell[0], nx)
        j = cell_of(y, lo[1], cell[1], ny)
        m = cell_of(z, lo[2], cell[2], nz)
        s = int(skip[np.uint64(i), np.uint64(j), np.uint64(m)])
        if s != 0:
            away = min(
                exit_distance(x, dx, lo[0], cell[0], i, s),
                min(exit_distance(y, dy, lo[1], cell[1], j, s), exit_distance(z, dz, lo[2], cell[2], m, s)),
            )
            index = max(index + 1, int(math.ceil((t_local + away - t_begin) / step - FACE_TOLERANCE)))
            continue
        if grid.stride.shape[0] == 0:
            return index, 1
        n_steps = int(grid.stride[np.uint64(i), np.uint64(j), np.uint64(m)])
        if grid.unit != step:
            n_steps = max(1, int(n_steps * grid.unit / step + FACE_TOLERANCE))
        most = max(1, int(math.ceil((t_end - t_local) / step + 0.5)) - 1)
        # the same samples wherever a ray comes to cells of a stride; index % n_steps takes twice as long
        return index, min(n_steps - (index - n_steps * int(index / n_steps)), most)


@device
def occupied(grid, p):
    """Whether a point lies in the grid's box, in a cell that is not empty."""
    nx, ny, nz = grid.skip.shape
    i = int(math.floor((p[0] - grid.lo[0]) / grid.cell[0]))
    j = int(math.floor((p[1] - grid.lo[1]) / grid.cell[1]))
    m = int(math.floor((p[2] - grid.lo[2]) / grid.cell[2]))
    return 0 <= i < nx and 0 <= j < ny and 0 <= m < nz and grid.skip[i, j, m] == 0


@device
def sh_basis(count, d, out, base):
    """The first `count` (1, 4, 9 or 16) real spherical harmonics of a unit direction into out[base:], orders
    l then m = -l..l, orthonormal on the sphere.

    Signs follow the habit of Plenoxels and 3D Gaussian splatting (Condon-Shortley phase kept).
    """
    x, y, z = d
    out[base] = 0.28209479177387814
    if count > 1:
        out[base + 1] = -0.4886025119029199 * y
        out[base + 2] = 0.4886025119029199 * z
        out[base + 3] = -0.4886025119029199 * x
    if count > 4:
        out[base + 4] = 1.0925484305920792 * x * y
        out[base + 5] = -1.0925484305920792 * y * z
        out[base + 6] = 0.31539156525252005 * (2.0 * z * z - x * x - y * y)
        out[base + 7] = -1.0925484305920792 * x * z
        out[base + 8] = 0.5462742152960396 * (x * x - y * y)
    if count > 9:
        out[base + 9] = -0.5900435899266435 * y * (3.0 * x * x - y * y)
        out[base + 10] = 2.890611442640554 * x * y * z
        out[base + 11] = -0.4570457994644658 * y * (4.0 * z * z - x * x - y * y)
        out[base + 12] = 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)
        out[base + 13] = -0.4570457994644658 * x * (4.0 * z * z - x * x - y * y)
        out[base + 14] = 1.445305721320277 * z * (x * x - y * y)
        out[base + 15] = -0.5900435899266435 * x * (x * x - 3.0 * y * y)


@device
def texel(params, u, n):
    """Lower texel and fraction of unit coordinate u on an axis of n >= 2 texels, corners aligned."""
    real = params.dtype.type
    f = u * real(n - 1)
    i = min(int(f), n - 2)
    return i, f - real(i)


@device
def accumulate(out, i, value):
    """out[i] += value, where others may be adding too."""
    out[i] += value


@device
def raise_to(out, i, value):
    """out[i] = max(out[i], value), where others may be raising it too."""
    out[i] = max(out[i], value)


@device
def within_range(colour, target):
    """A colour as a photo shows it, whose range ends: what is beyond CLIPPED, or below 0, shows as the target
    does there."""
    if (target >= CLIPPED and colour > target) or (target <= 0.0 and colour < target):
        colour = target
    return colour


@device
def loss_and_grad(batch, i, colour, trans, work, loss):
    """Gradients of the loss of a batch of rays (ComputedField.train_rays) in ray i's colour and in the
    transmittance behind it; its colour error, unless its depth is known, opacity error and work are added to
    `loss`.
    """
    target, background, exposure = batch.target, batch.background, batch.exposure
    red, green, blue = colour
    red += trans * background[i, 0]
    green += trans * background[i, 1]
    blue += trans * background[i, 2]
    exposed = exposure.shape[0] > 0
    if exposed:
        red = within_range(exposure[i, 0, 0] * red + exposure[i, 1, 0], target[i, 0])
        green = within_range(exposure[i, 0, 1] * green + exposure[i, 1, 1], target[i, 1])
        blue = within_range(exposure[i, 0, 2] * blue + exposure[i, 1, 2], target[i, 2])
    e_r, e_g, e_b = red - target[i, 0], green - target[i, 1], blue - target[i, 2]
    e_a = (1.0 - trans) - target[i, 3]
    if i >= batch.depths.shape[0]:
        accumulate(loss, 0, (e_r * e_r + e_g * e_g + e_b * e_b) / 3.0)
    accumulate(loss, 1, e_a * e_a)
    accumulate(loss, 2, work)
    n = target.shape[0]
    scale = 2.0 / (3.0 * n)
    g_r, g_g, g_b = scale * e_r, scale * e_g, scale * e_b
    if exposed:
        g_r *= exposure[i, 2, 0] * exposure[i, 0, 0]
        g_g *= exposure[i, 2, 1] * exposure[i, 0, 1]
        g_b *= exposure[i, 2, 2] * exposure[i, 0, 2]
    behind = g_r * background[i, 0] + g_g * background[i, 1] + g_b * background[i, 2]
    return (g_r, g_g, g_b), behind - 2.0 / n * batch.opacity_weight * e_a


@device
def add_scaled_8(out, o, weight, values, v):
    """out[o : o + 8] += weight * values[v : v + 8].

    All loads stand before all stores: only then may the compiler, which must fear that the arrays overlap,
    use vectors.
    """
    e0 = out[o] + weight * values[v]
    e1 = out[o + np.uint64(1)] + weight * values[v + np.uint64(1)]
    e2 = out[o + np.uint64(2)] + weight * values[v + np.uint64(2)]
    e3 = out[o + np.uint64(3)] + weight * values[v + np.uint64(3)]
    e4 = out[o + np.uint64(4)] + weight * values[v + np.uint64(4)]
    e5 = out[o + np.uint64(5)] + weight * values[v + np.uint64(5)]
    e6 = out[o + np.uint64(6)] + weight * values[v + np.uint64(6)]
    e7 = out[o + np.uint64(7)] + weight * values[v + np.uint64(7)]
    store_8(out, o, e0, e1, e2, e3, e4, e5, e6, e7)


@device
def store_8(out, o, e0, e1, e2, e3, e4, e5, e6, e7):
    """out[o : o + 8] = e0 .. e7."""
    out[o] = e0
    out[o + np.uint64(1)] = e1
    out[o + np.uint64(2)] = e2
    out[o + np.uint64(3)] = e3
    out[o + np.uint64(4)] = e4
    out[o + np.uint64(5)] = e5
    out[o + np.uint64(6)] = e6
    out[o + np.uint64(7)] = e7


@device
def add_scaled(count, out, o, weight, values, v):
    """out[o : o + count] += weight * values[v : v + count]; the count is a multiple of 8, and a constant."""
    literally(count)  # known when this is compiled, and not only where it is inlined: the loop is unrolled
    for tile in range(np.uint64(count // 8)):
        at = tile * np.uint64(8)
        add_scaled_8(out, o + at, weight, values, v + at)


@device
def mixed_8(count, out, o, weights, w, values, v, stride):
    """out[o : o + 8] = Σ_k weights[w + k] values[v + k stride : v + k stride + 8] over k < count."""
    zero = out.dtype.type(0)
    e0, e1, e2, e3, e4, e5, e6, e7 = zero, zero, zero, zero, zero, zero, zero, zero
    for k in range(np.uint64(count)):
        weight, at = weights[w + k], v + k * stride
        e0 += weight * values[at]
        e1 += weight * values[at + np.uint64(1)]
        e2 += weight * values[at + np.uint64(2)]
        e3 += weight * values[at + np.uint64(3)]
        e4 += weight * values[at + np.uint64(4)]
        e5 += weight * values[at + np.uint64(5)]
        e6 += weight * values[at + np.uint64(6)]
        e7 += weight * values[at + np.uint64(7)]
    store_8(out, o, e0, e1, e2, e3, e4, e5, e6, e7)


@device
def scatter_8(out, o, weight, values, v):
    """`add_scaled_8` to a place where others may be adding too; on the CPU each core has a row of its own."""
    add_scaled_8(out, o, weight, values, v)


@device
def scatter_4(out, o, weight, values, v):
    """`scatter_8` of four numbers."""
    e0 = out[o] + weight * values[v]
    e1 = out[o + np.uint64(1)] + weight * values[v + np.uint64(1)]
    e2 = out[o + np.uint64(2)] + weight * values[v + np.uint64(2)]
    e3 = out[o + np.uint64(3)] + weight * values[v + np.uint64(3)]
    out[o] = e0
    out[o + np.uint64(1)] = e1
    out[o + np.uint64(2)] = e2
    out[o + np.uint64(3)] = e3


@device
def scatter(count, out, o, weight, values, v):
    """`add_scaled` to a place where others may be adding too."""
    literally(count)
    for tile in range(np.uint64(count // 8)):
        at = tile * np.uint64(8)
        scatter_8(out, o + at, weight, values, v + at)


@device
def dot(count, a, i, b, j):
    """Σ_r a[i + r] b[j + r] of `count` numbers."""
    total = a.dtype.type(0)
    for r in range(np.uint64(count)):
        total += a[i + r] * b[j + r]
    return total


@device
def dense(inputs, outputs, params, weights, values, v, out, o):
    """out[o : o + outputs] = b + Wᵀ x of a dense layer with x = values[v : v + inputs]: W (inputs, outputs)
    and behind it b lie in params from `weights` on. The outputs are a multiple of 8."""
    for r in range(np.uint64(outputs)):
        out[o + r] = params[weights + np.uint64(inputs * outputs) + r]
    for i in range(np.uint64(inputs)):
        if values[v + i] != 0:
            add_scaled(outputs, out, o, values[v + i], params, weights + i * np.uint64(outputs))


@device
def dense_backward(inputs, outputs, params, weights, values, v, rectified, d_out, o, d_in, n, grad):
    """Adjoint of `dense` for d_out[o : o + outputs]: sets d_in[n : n + inputs] and adds to grad. Where x is
    `rectified` its zeros send nothing back."""
    one = params.dtype.type(1)
    scatter(outputs, grad, weights + np.uint64(inputs * outputs), one, d_out, o)
    for i in range(np.uint64(inputs)):
        row = weights + i * np.uint64(outputs)
        if values[v + i] != 0:
            scatter(outputs, grad, row, values[v + i], d_out, o)
        if rectified and values[v + i] == 0:
            d_in[n + i] = 0
        else:
            d_in[n + i] = dot(outputs, params, row, d_out, o)


@device
def rectify(count, values, v):
    """values[v : v + count] where they are above 0, else 0."""
    for r in range(np.uint64(count)):
        values[v + r] = max(values[v + r], values.dtype.type(0))


@device
def bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r):
    """One component of a plane at four corners' offsets and weights."""
    return w00 * params[o00 + r] + w01 * params[o01 + r] + w10 * params[o10 + r] + w11 * params[o11 + r]


@device
def linear(params, l0, l1, t, r):
    """One component of a line between two texels."""
    return params[l0 + r] + t * (params[l1 + r] - params[l0 + r])


@device
def softplus(f):
    """log(1 + e^f) without overflow."""
    if f > 15.0:
        return f
    return math.log1p(math.exp(f))


@device
def sigmoid(f):
    """1 / (1 + e^-f)."""
    return 1 / (1 + math.exp(-f))


@device
def touched(grads, start):
    """Whether any part of grads (parts, P) has sent something to the cache line that starts at an entry."""
    total = grads.dtype.type(0)
    for p in range(grads.shape[0]):
        for i in range(np.uint64(LINE)):
            total += abs(grads[p, start + i])
    return total != 0


@device
def adam_line(params, grads, moment1, moment2, rate, start, beta1, beta2, eps, correction1, correction2):
    """`adam` of field_free.py for the cache line that starts at entry `start`."""
    real = params.dtype.type
    one, zero = real(1), real(0)
    for p in range(1, grads.shape[0]):
        add_scaled(LINE, grads[0], start, one, grads[p], start)
        for i in range(np.uint64(LINE)):
            grads[p, start + i] = zero
    has_momentum = moment1.shape[0] != 0
    for i in range(np.uint64(LINE)):
        g, v = grads[0, start + i], moment2[start + i]
        m = moment1[start + i] if has_momentum else zero
        m_new = beta1 * m + (one - beta1) * g
        v_new = beta2 * v + (one - beta2) * g * g
        if has_momentum:
            moment1[start + i] = m_new if g != zero else m
        moment2[start + i] = v_new if g != zero else v
        change = rate * (m_new * correction1) / (math.sqrt(v_new * correction2) + eps)
        params[start + i] -= change if g != zero else zero
        grads[0, start + i] = zero


@device
def sum_of_rows(values, base, width, start, source, weight, target, i, keep):
    """Row target[i] of `values` (rows of a width, from `base` on) becomes, or with `keep` gains, the weighted
    sum of the rows source[start[i]:start[i + 1]].
    """
    real = values.dtype.type
    to = base + width * target[i]
    for c in range(width):
        total = values[to + c] if keep else real(0)
        for e in range(start[i], start[i + 1]):
            total += real(weight[e]) * values[base + width * source[e] + c]
        values[to + c] = total
