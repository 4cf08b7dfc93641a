"""Scalar bodies of every kernel, written once: called from the CPU loops in `cpu.py` and from GPU kernels
alike.

Notation for the whole file.
    x, y, z      a point in the frame of the field; u, v, w the same point in the unit cube of one VM tensor
    ranks        a tuple whose *length* is the rank: the length is part of the type, so the compiler unrolls
                 the loops over it
    params       flat float vector holding all tensors of a field; `layout[t]` are the offsets of tensor t's
                 sections in it: 0-2 density planes, 3-5 density lines, 6-8 colour planes, 9-11 colour lines,
                 12 colour basis
    modes        mode 0 = plane xy, line z; mode 1 = plane xz, line y; mode 2 = plane yz, line x (TensoRF, eq.
                 5)
Offsets are unsigned: a signed index costs a wrap-around test per load, a factor of five in all.
"""

import math
from typing import NamedTuple

import numpy as np
from numba import njit

body = njit(fastmath=True, error_model="numpy", cache=True, forceinline=True, _nrt=False)

NO_BLOCK = 255  # in the ownership grids: nobody is asked here
COLOUR_FROM = 1e-4  # weight below which a sample's colour is not evaluated
EDGE = 1e-9  # share of a box by which rounding may put a point on its face outside
FACE_TOLERANCE = 1e-6  # steps: a sample on the face of an occupied cell must not be jumped over by rounding


class VMArrays(NamedTuple):
    """Everything a kernel reads of a VM field, as arrays (T tensors, B blocks)."""

    params: object  # (P,) float, all sections of all tensors
    layout: object  # (T, 13) int64, offsets into params
    resolution: object  # (T, 3) int64, texels per axis
    to_unit: object  # (B, 3, 4) float, field frame -> unit cube of the block's tensor
    to_object: object  # (B, 3, 3) float, field directions -> object directions, unnormalised
    tensor: object  # (B,) int64, the tensor of a block
    density: object  # (T, 2) float, scale (1/length of the object frame) and shift of the softplus
    first: object  # (X, Y, Z) uint8, owning block of a cell; shape (0, 0, 0) when there is one block
    second: object  # (X, Y, Z) uint8, the other block that has matter in the cell, or NO_BLOCK
    stride: object  # (B,) int64, steps of the finest block that one sample of this block may stand for
    occupied: object  # flat uint8, the tensors' own occupancy, asked only where there are several blocks
    occupied_at: object  # (T, 4) int64, offset into occupied and cells per axis


class GridArrays(NamedTuple):
    """The occupancy grid: `skip` is 0 in an occupied cell, else the Chebyshev distance in cells to the next
    one."""

    skip: object  # (X, Y, Z) uint8
    lo: object  # (3,) float, lower corner
    hi: object  # (3,) float, upper corner
    cell: object  # (3,) float, size of a cell


@body
def hit_box(ox, oy, oz, dx, dy, dz, lo, hi):
    """Interval [t0, t1] in which a ray is inside a box; t1 < t0 when it misses. A zero component is tested
    apart (0 * inf)."""
    t0 = 0.0
    t1 = 1e30
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


@body
def cell_of(p, lo, cell, n):
    """Index of the cell that holds coordinate p, clamped to the grid."""
    return min(max(int((p - lo) / cell), 0), n - 1)


@body
def exit_distance(p, d, lo, cell, i, s):
    """Distance along the ray to the face of the empty cube of half width s around cell i, on one axis."""
    if d > 0.0:
        return (lo + (i + s) * cell - p) / d
    if d < 0.0:
        return (lo + (i - s + 1) * cell - p) / d
    return 1e30


@body
def next_sample(grid, ox, oy, oz, dx, dy, dz, t0, t1, step, k):
    """First k' >= k whose sample t0 + k' step lies in an occupied cell, or -1 when the ray leaves the box
    before one.

    Samples stay on the ray's own lattice whatever is skipped, so that an image with and without skipping is
    the same.
    """
    skip, lo, cell = grid.skip, grid.lo, grid.cell
    nx, ny, nz = skip.shape
    while True:
        t = t0 + k * step
        if t >= t1:
            return -1
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        i = cell_of(x, lo[0], cell[0], nx)
        j = cell_of(y, lo[1], cell[1], ny)
        m = cell_of(z, lo[2], cell[2], nz)
        s = int(skip[np.uint64(i), np.uint64(j), np.uint64(m)])
        if s == 0:
            return k
        away = min(
            exit_distance(x, dx, lo[0], cell[0], i, s),
            min(exit_distance(y, dy, lo[1], cell[1], j, s), exit_distance(z, dz, lo[2], cell[2], m, s)),
        )
        k = max(k + 1, int(math.ceil((t + away - t0) / step - FACE_TOLERANCE)))


@body
def sh_basis(degree_1_squared, x, y, z, out, base):
    """Real spherical harmonics of a unit direction into out[base:], orders l then m = -l..l, orthonormal on
    the sphere.

    Signs follow the habit of Plenoxels and 3D Gaussian splatting (Condon-Shortley phase kept).
    """
    n = len(degree_1_squared)
    out[base] = 0.28209479177387814
    if n > 1:
        out[base + 1] = -0.4886025119029199 * y
        out[base + 2] = 0.4886025119029199 * z
        out[base + 3] = -0.4886025119029199 * x
    if n > 4:
        out[base + 4] = 1.0925484305920792 * x * y
        out[base + 5] = -1.0925484305920792 * y * z
        out[base + 6] = 0.31539156525252005 * (2.0 * z * z - x * x - y * y)
        out[base + 7] = -1.0925484305920792 * x * z
        out[base + 8] = 0.5462742152960396 * (x * x - y * y)
    if n > 9:
        out[base + 9] = -0.5900435899266435 * y * (3.0 * x * x - y * y)
        out[base + 10] = 2.890611442640554 * x * y * z
        out[base + 11] = -0.4570457994644658 * y * (4.0 * z * z - x * x - y * y)
        out[base + 12] = 0.3731763325901154 * z * (2.0 * z * z - 3.0 * x * x - 3.0 * y * y)
        out[base + 13] = -0.4570457994644658 * x * (4.0 * z * z - x * x - y * y)
        out[base + 14] = 1.445305721320277 * z * (x * x - y * y)
        out[base + 15] = -0.5900435899266435 * x * (x * x - 3.0 * y * y)


@body
def texel(params, u, n):
    """Lower texel and fraction of unit coordinate u on an axis of n >= 2 texels, corners aligned."""
    real = params.dtype.type
    f = u * real(n - 1)
    i = min(int(f), n - 2)
    return i, f - real(i)


@body
def mode_dot(ranks, params, plane, line, na, nb, nc, a, b, c):
    """sum_r P_r(a, b) L_r(c): bilinear plane times linear line, summed over ranks."""
    rank = len(ranks)
    ia, ta = texel(params, a, na)
    ib, tb = texel(params, b, nb)
    ic, tc = texel(params, c, nc)
    w11 = ta * tb
    w10 = ta - w11
    w01 = tb - w11
    w00 = params.dtype.type(1) - ta - w01
    o00 = np.uint64(plane + (ia * nb + ib) * rank)
    o01 = o00 + np.uint64(rank)
    o10 = o00 + np.uint64(nb * rank)
    o11 = o10 + np.uint64(rank)
    l0 = np.uint64(line + ic * rank)
    l1 = l0 + np.uint64(rank)
    total = params.dtype.type(0)
    for r in range(np.uint64(rank)):
        p = w00 * params[o00 + r] + w01 * params[o01 + r] + w10 * params[o10 + r] + w11 * params[o11 + r]
        total += p * (params[l0 + r] + tc * (params[l1 + r] - params[l0 + r]))
    return total


@body
def mode_products(ranks, params, plane, line, na, nb, nc, a, b, c, out, base):
    """P_r(a, b) L_r(c) for every rank, into out[base:]."""
    rank = len(ranks)
    ia, ta = texel(params, a, na)
    ib, tb = texel(params, b, nb)
    ic, tc = texel(params, c, nc)
    w11 = ta * tb
    w10 = ta - w11
    w01 = tb - w11
    w00 = params.dtype.type(1) - ta - w01
    o00 = np.uint64(plane + (ia * nb + ib) * rank)
    o01 = o00 + np.uint64(rank)
    o10 = o00 + np.uint64(nb * rank)
    o11 = o10 + np.uint64(rank)
    l0 = np.uint64(line + ic * rank)
    l1 = l0 + np.uint64(rank)
    start = np.uint64(base)
    for r in range(np.uint64(rank)):
        p = w00 * params[o00 + r] + w01 * params[o01 + r] + w10 * params[o10 + r] + w11 * params[o11 + r]
        out[start + r] = p * (params[l0 + r] + tc * (params[l1 + r] - params[l0 + r]))


@body
def accumulate(out, i, value):
    """out[i] += value, where others may be adding too."""
    out[i] += value


@body
def compared(red, green, blue, trans, target, background, opacity_weight, i, count, loss):
    """Gradients of the loss of `train_rays` (cpu.py) in ray i's colour and in the transmittance behind it;
    its colour error, opacity error and samples are added to `loss`.
    """
    e_r = red + trans * background[i, 0] - target[i, 0]
    e_g = green + trans * background[i, 1] - target[i, 1]
    e_b = blue + trans * background[i, 2] - target[i, 2]
    e_a = (1.0 - trans) - target[i, 3]
    accumulate(loss, 0, (e_r * e_r + e_g * e_g + e_b * e_b) / 3.0)
    accumulate(loss, 1, e_a * e_a)
    accumulate(loss, 2, count)
    n = target.shape[0]
    scale = 2.0 / (3.0 * n)
    g_r, g_g, g_b = scale * e_r, scale * e_g, scale * e_b
    behind = g_r * background[i, 0] + g_g * background[i, 1] + g_b * background[i, 2]
    return g_r, g_g, g_b, behind - 2.0 / n * opacity_weight * e_a


@body
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


@body
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


@body
def add_scaled(ranks, out, o, weight, values, v):
    """out[o : o + rank] += weight * values[v : v + rank]; the rank is a multiple of 8."""
    for tile in range(np.uint64(len(ranks) // 8)):
        at = tile * np.uint64(8)
        add_scaled_8(out, o + at, weight, values, v + at)


@body
def scatter_8(out, o, weight, values, v):
    """`add_scaled_8` to a place where others may be adding too; on the CPU each core has a row of its own."""
    add_scaled_8(out, o, weight, values, v)


@body
def scatter(ranks, out, o, weight, values, v):
    """`add_scaled` to a place where others may be adding too."""
    for tile in range(np.uint64(len(ranks) // 8)):
        at = tile * np.uint64(8)
        scatter_8(out, o + at, weight, values, v + at)


@body
def bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r):
    """One component of a plane at four corners' offsets and weights."""
    return w00 * params[o00 + r] + w01 * params[o01 + r] + w10 * params[o10 + r] + w11 * params[o11 + r]


@body
def linear(params, l0, l1, t, r):
    """One component of a line between two texels."""
    return params[l0 + r] + t * (params[l1 + r] - params[l0 + r])


@body
def mode_scatter(ranks, params, grads, plane, line, na, nb, nc, a, b, c, d_out, base, stride, scratch):
    """Adjoint of `mode_products`: adds into grads what d_out[base + r * stride] sends to plane and line."""
    rank = len(ranks)
    ia, ta = texel(params, a, na)
    ib, tb = texel(params, b, nb)
    ic, tc = texel(params, c, nc)
    w11 = ta * tb
    w10 = ta - w11
    w01 = tb - w11
    w00 = params.dtype.type(1) - ta - w01
    o00 = np.uint64(plane + (ia * nb + ib) * rank)
    o01 = o00 + np.uint64(rank)
    o10 = o00 + np.uint64(nb * rank)
    o11 = o10 + np.uint64(rank)
    l0 = np.uint64(line + ic * rank)
    l1 = l0 + np.uint64(rank)
    start = np.uint64(base)
    jump = np.uint64(stride)
    half = np.uint64(rank)
    for tile in range(np.uint64(rank // 8)):
        r = tile * np.uint64(8)
        d0, d1 = d_out[start + r * jump], d_out[start + (r + np.uint64(1)) * jump]
        d2, d3 = d_out[start + (r + np.uint64(2)) * jump], d_out[start + (r + np.uint64(3)) * jump]
        d4, d5 = d_out[start + (r + np.uint64(4)) * jump], d_out[start + (r + np.uint64(5)) * jump]
        d6, d7 = d_out[start + (r + np.uint64(6)) * jump], d_out[start + (r + np.uint64(7)) * jump]
        e0 = d0 * linear(params, l0, l1, tc, r)
        e1 = d1 * linear(params, l0, l1, tc, r + np.uint64(1))
        e2 = d2 * linear(params, l0, l1, tc, r + np.uint64(2))
        e3 = d3 * linear(params, l0, l1, tc, r + np.uint64(3))
        e4 = d4 * linear(params, l0, l1, tc, r + np.uint64(4))
        e5 = d5 * linear(params, l0, l1, tc, r + np.uint64(5))
        e6 = d6 * linear(params, l0, l1, tc, r + np.uint64(6))
        e7 = d7 * linear(params, l0, l1, tc, r + np.uint64(7))
        store_8(scratch, r, e0, e1, e2, e3, e4, e5, e6, e7)
        e0 = d0 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r)
        e1 = d1 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(1))
        e2 = d2 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(2))
        e3 = d3 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(3))
        e4 = d4 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(4))
        e5 = d5 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(5))
        e6 = d6 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(6))
        e7 = d7 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(7))
        store_8(scratch, half + r, e0, e1, e2, e3, e4, e5, e6, e7)
    zero = np.uint64(0)
    scatter(ranks, grads, o00, w00, scratch, zero)
    scatter(ranks, grads, o01, w01, scratch, zero)
    scatter(ranks, grads, o10, w10, scratch, zero)
    scatter(ranks, grads, o11, w11, scratch, zero)
    scatter(ranks, grads, l0, params.dtype.type(1) - tc, scratch, half)
    scatter(ranks, grads, l1, tc, scratch, half)


@body
def unit_point(vm, b, x, y, z):
    """The unit-cube coordinates of a field point in block b, and whether it lies inside."""
    to_unit = vm.to_unit
    real = vm.params.dtype.type
    u = to_unit[b, 0, 0] * x + to_unit[b, 0, 1] * y + to_unit[b, 0, 2] * z + to_unit[b, 0, 3]
    v = to_unit[b, 1, 0] * x + to_unit[b, 1, 1] * y + to_unit[b, 1, 2] * z + to_unit[b, 1, 3]
    w = to_unit[b, 2, 0] * x + to_unit[b, 2, 1] * y + to_unit[b, 2, 2] * z + to_unit[b, 2, 3]
    lo, hi = -EDGE, 1 + EDGE
    inside = u >= lo and v >= lo and w >= lo and u <= hi and v <= hi and w <= hi
    return real(u), real(v), real(w), inside


@body
def density_feature(ranks, vm, t, u, v, w):
    """Pre-activation density of tensor t at a unit point (TensoRF, eq. 6)."""
    nx, ny, nz = vm.resolution[t, 0], vm.resolution[t, 1], vm.resolution[t, 2]
    off = vm.layout[t]
    return (
        mode_dot(ranks, vm.params, off[0], off[3], nx, ny, nz, u, v, w)
        + mode_dot(ranks, vm.params, off[1], off[4], nx, nz, ny, u, w, v)
        + mode_dot(ranks, vm.params, off[2], off[5], ny, nz, nx, v, w, u)
    )


@body
def scatter_density(ranks, vm, grads, t, u, v, w, d_feature, base, scratch):
    """Adjoint of `density_feature`; d_feature[base] is the incoming gradient."""
    nx, ny, nz = vm.resolution[t, 0], vm.resolution[t, 1], vm.resolution[t, 2]
    off = vm.layout[t]
    p = vm.params
    mode_scatter(ranks, p, grads, off[0], off[3], nx, ny, nz, u, v, w, d_feature, base, 0, scratch)
    mode_scatter(ranks, p, grads, off[1], off[4], nx, nz, ny, u, w, v, d_feature, base, 0, scratch)
    mode_scatter(ranks, p, grads, off[2], off[5], ny, nz, nx, v, w, u, d_feature, base, 0, scratch)


@body
def colour_features(ranks, vm, t, u, v, w, out, base):
    """The 3 * rank colour products of tensor t at a unit point, into out[base:]."""
    rank = len(ranks)
    nx, ny, nz = vm.resolution[t, 0], vm.resolution[t, 1], vm.resolution[t, 2]
    off = vm.layout[t]
    mode_products(ranks, vm.params, off[6], off[9], nx, ny, nz, u, v, w, out, base)
    mode_products(ranks, vm.params, off[7], off[10], nx, nz, ny, u, w, v, out, base + rank)
    mode_products(ranks, vm.params, off[8], off[11], ny, nz, nx, v, w, u, out, base + 2 * rank)


@body
def scatter_colour(ranks, vm, grads, t, u, v, w, d_features, base, scratch):
    """Adjoint of `colour_features`."""
    rank = len(ranks)
    nx, ny, nz = vm.resolution[t, 0], vm.resolution[t, 1], vm.resolution[t, 2]
    off = vm.layout[t]
    p = vm.params
    mode_scatter(ranks, p, grads, off[6], off[9], nx, ny, nz, u, v, w, d_features, base, 1, scratch)
    mode_scatter(ranks, p, grads, off[7], off[10], nx, nz, ny, u, w, v, d_features, base + rank, 1, scratch)
    mode_scatter(
        ranks, p, grads, off[8], off[11], ny, nz, nx, v, w, u, d_features, base + 2 * rank, 1, scratch
    )


@body
def softplus(f):
    """log(1 + e^f) without overflow."""
    if f > 15.0:
        return f
    return math.log1p(math.exp(f))


@body
def sigmoid(f):
    """1 / (1 + e^-f)."""
    return 1 / (1 + math.exp(-f))


@body
def object_direction(vm, b, dx, dy, dz):
    """The unit direction in block b's object frame and |A d|, which keeps the optical depth (σ_field =
    σ_object |A d|)."""
    m = vm.to_object
    x = m[b, 0, 0] * dx + m[b, 0, 1] * dy + m[b, 0, 2] * dz
    y = m[b, 1, 0] * dx + m[b, 1, 1] * dy + m[b, 1, 2] * dz
    z = m[b, 2, 0] * dx + m[b, 2, 1] * dy + m[b, 2, 2] * dz
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length, length


@body
def block_density(ranks, vm, b, x, y, z, stretch):
    """(σ in the field frame, pre-activation) of block b at a field point; (0, 0) outside its tensor."""
    u, v, w, inside = unit_point(vm, b, x, y, z)
    if not inside:
        return 0.0, 0.0
    t = vm.tensor[b]
    if vm.first.shape[0] != 0 and not matter_at(vm, t, u, v, w):
        return 0.0, 0.0
    f = density_feature(ranks, vm, t, u, v, w)
    return float(stretch * vm.density[t, 0] * softplus(f + vm.density[t, 1])), float(f)


@body
def matter_at(vm, t, u, v, w):
    """Whether a unit point lies in an occupied cell of tensor t; what a tensor says elsewhere was never
    learnt."""
    nx, ny, nz = vm.occupied_at[t, 1], vm.occupied_at[t, 2], vm.occupied_at[t, 3]
    i, j, m = min(int(u * nx), nx - 1), min(int(v * ny), ny - 1), min(int(w * nz), nz - 1)
    return vm.occupied[np.uint64(vm.occupied_at[t, 0] + (i * ny + j) * nz + m)] != 0


@body
def winning_block(ranks, vm, grid, x, y, z, dx, dy, dz):
    """(block, σ, pre-activation, steps) of the densest block at a point; ties go to the lower block (DESIGN).

    `steps` says for how many steps of the ray the answer stands: where only coarse blocks have matter, a
    sample per step of the finest block would see nothing new.
    """
    if vm.first.shape[0] == 0:
        stretch = object_direction(vm, 0, dx, dy, dz)[3]
        sigma, f = block_density(ranks, vm, 0, x, y, z, stretch)
        return 0, sigma, f, 1
    nx, ny, nz = vm.first.shape
    i = cell_of(x, grid.lo[0], grid.cell[0], nx)
    j = cell_of(y, grid.lo[1], grid.cell[1], ny)
    m = cell_of(z, grid.lo[2], grid.cell[2], nz)
    b = int(vm.first[i, j, m])
    if b == NO_BLOCK:
        return 0, 0.0, 0.0, 1
    steps = vm.stride[b]
    sigma, f = block_density(ranks, vm, b, x, y, z, object_direction(vm, b, dx, dy, dz)[3])
    other = int(vm.second[i, j, m])
    if other != NO_BLOCK:
        steps = min(steps, vm.stride[other])
        sigma2, f2 = block_density(ranks, vm, other, x, y, z, object_direction(vm, other, dx, dy, dz)[3])
        if sigma2 > sigma:
            return other, sigma2, f2, steps
    return b, sigma, f, steps


@body
def directional_basis(colour_ranks, coefficients, vm, b, dx, dy, dz, basis, sh):
    """Fold SH into the colour basis once per ray: basis[c, :] = sum_k Y_k(d_object) B[c, k, :] (SH is
    linear)."""
    width = 3 * len(colour_ranks)
    count = len(coefficients)
    x, y, z, _ = object_direction(vm, b, dx, dy, dz)
    sh_basis(coefficients, x, y, z, sh, 0)
    start = np.uint64(vm.layout[vm.tensor[b], 12])
    zero = basis.dtype.type(0)
    for c in range(3):
        row = np.uint64(c * width)
        for r in range(np.uint64(width)):
            basis[row + r] = zero
        for k in range(count):
            source = start + np.uint64((c * count + k) * width)
            for mode in range(np.uint64(3)):
                at = mode * np.uint64(len(colour_ranks))
                add_scaled(colour_ranks, basis, row + at, sh[k], vm.params, source + at)


@body
def scatter_basis(colour_ranks, coefficients, vm, grads, b, sh, d_basis):
    """Adjoint of `directional_basis`; sh are the values it left."""
    width = 3 * len(colour_ranks)
    count = len(coefficients)
    start = np.uint64(vm.layout[vm.tensor[b], 12])
    for c in range(3):
        row = np.uint64(c * width)
        for k in range(count):
            target = start + np.uint64((c * count + k) * width)
            for mode in range(np.uint64(3)):
                at = mode * np.uint64(len(colour_ranks))
                scatter(colour_ranks, grads, target + at, sh[k], d_basis, row + at)


@body
def dot_row(colour_ranks, basis, row, features, base):
    """Inner product of one row of a directional basis with colour features."""
    width = 3 * len(colour_ranks)
    a = np.uint64(row * width)
    f = np.uint64(base)
    total = basis.dtype.type(0)
    for r in range(np.uint64(width)):
        total += basis[a + r] * features[f + r]
    return total
