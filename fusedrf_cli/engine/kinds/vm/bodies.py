"""The `vm` kind's scalar functions: what kernels/loops.py asks of a kind, for one or more placed tensors.

Notation for the whole file.
    u, v, w      a point in the unit cube of one tensor
    params       flat float vector holding all tensors of a field; `layout[t]` are the offsets of tensor t's
                 sections in it: 0-2 density planes, 3-5 density lines, 6-8 colour planes, 9-11 colour lines,
                 12 colour basis
    modes        mode 0 = plane xy, line z; mode 1 = plane xz, line y; mode 2 = plane yz, line x (TensoRF, eq.
                 5)
    rows         of a tensor's hashed detail (engine/fields/hashed.py), section 13, level after level: added
                 to the density and to the logits of the colour where planes and lines say that there may be
                 matter
    place        the block that a point belongs to, which is also the frame, and NEAR more where its tensor's
                 detail was asked
DENSITY_RANK, COLOUR_RANK and COEFFICIENTS are the field's sizes. A ray's `scratch` holds, one after the
other, the directional basis (BASIS), its gradient (D_BASIS), the gradient of a sample's colour features
(D_FEATURES), the spherical harmonics (SH), and room for one mode (TILE), one number (ONE), a sample of the
background (HELD, see `started`) and what the hashed detail said last (DETAIL_AT, see `detail`).
"""

import math
from typing import NamedTuple

import numpy as np
from numba import literally

from fusedrf_cli.engine.fields.hashed import EMPTY_FROM, RUN, WIDTH
from fusedrf_cli.engine.kernels.parts import (
    FACE_TOLERANCE,
    accumulate,
    add_scaled,
    along,
    bilinear,
    cell_of,
    exit_distance,
    linear,
    scatter,
    sh_basis,
    sigmoid,
    softplus,
    store_8,
    texel,
)  # fmt: skip
from fusedrf_cli.engine.kernels.prefetch import prefetch, prefetch_plane

NO_BLOCK = 255  # in the ownership grids: nobody is asked here
EDGE = 1e-9  # share of a box by which rounding may put a point on its face outside
NEAR = 256  # in a place, beside the block


class Arrays(NamedTuple):
    """Everything a kernel reads of a VM field, as arrays (T tensors, B blocks)."""

    params: object  # (P,) float, all sections of all tensors
    layout: object  # (T, 14) int64, offsets into params
    resolution: object  # (T, 3) int64, texels per axis
    to_unit: object  # (B, 3, 4) float, field frame -> unit cube of the block's tensor
    to_object: object  # (B, 3, 3) float, field directions -> object directions, unnormalised
    tensor: object  # (B,) int64, the tensor of a block
    activation: object  # (T, 2) float, scale (1/length of the object frame) and shift of the softplus
    owners: object  # (X, Y, Z) uint16, owning block of a cell + 256 times the other block that has matter in
    # it, or NO_BLOCK; shape (0, 0, 0) when there is one block
    apart: object  # flat uint8, how many cells those of a tensor's box are from matter, with several blocks
    apart_at: object  # (T, 4) int64, offset into apart and cells per axis
    cell: object  # (B, 2) float64, a cell of the block's tensor: in the field's coordinates, in its own steps
    crossing: object  # (B,) uint8, how points come to the block's tensor (VMField.crossings)
    part: object  # (B, 6) float64, lower corner and 1 / sides of a tensor's box in its own unbounded space
    rows: object  # (T, 2) int64, rows of a level of a tensor's hashed detail, and how many levels it has
    lattice: object  # (T, levels, 2, 3) float, sides and lower corner of a tensor's box in a level's spacings


def sizes(field) -> dict[str, int]:
    """The constants that the functions of this file are compiled with."""
    rank, colour_rank = field.shape.density_rank, field.shape.colour_rank
    held = {
        "BASIS": 9 * colour_rank, "D_BASIS": 9 * colour_rank, "D_FEATURES": 3 * colour_rank, "SH": 16,
        "TILE": 2 * max(rank, colour_rank), "ONE": 1, "HELD": 7, "DETAIL_AT": 7,
    }  # fmt: skip
    starts = np.cumsum([0, *held.values()]).tolist()
    return {
        "DENSITY_RANK": rank, "COLOUR_RANK": colour_rank, "COEFFICIENTS": field.shape.coefficients,
        **dict(zip(held, starts, strict=False)), "SCRATCH": starts[-1], "KEPT": 3 * colour_rank,
        "CROSSING": int(any(field.crossings)), "DETAIL": int(any(t.hashed for t in field.tensors)),
    }  # fmt: skip


# -- one mode of a tensor ------------------------------------------------------------------------------------


def mode_dot(params, plane, line, na, nb, nc, a, b, c):
    """sum_r P_r(a, b) L_r(c): bilinear plane times linear line, summed over ranks."""
    rank = DENSITY_RANK
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


def mode_products(params, plane, line, na, nb, nc, a, b, c, out, base):
    """P_r(a, b) L_r(c) for every rank, into out[base:]."""
    rank = COLOUR_RANK
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


def mode_scatter(rank, params, grads, plane, line, na, nb, nc, a, b, c, base, stride, scratch):
    """Adjoint of `mode_products`: adds into grads what scratch[base + r * stride] sends to plane and line."""
    literally(rank)
    literally(stride)
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
    tile_at = np.uint64(TILE)
    half = np.uint64(TILE + rank)
    for tile in range(np.uint64(rank // 8)):
        r = tile * np.uint64(8)
        d0, d1 = scratch[start + r * jump], scratch[start + (r + np.uint64(1)) * jump]
        d2, d3 = scratch[start + (r + np.uint64(2)) * jump], scratch[start + (r + np.uint64(3)) * jump]
        d4, d5 = scratch[start + (r + np.uint64(4)) * jump], scratch[start + (r + np.uint64(5)) * jump]
        d6, d7 = scratch[start + (r + np.uint64(6)) * jump], scratch[start + (r + np.uint64(7)) * jump]
        e0 = d0 * linear(params, l0, l1, tc, r)
        e1 = d1 * linear(params, l0, l1, tc, r + np.uint64(1))
        e2 = d2 * linear(params, l0, l1, tc, r + np.uint64(2))
        e3 = d3 * linear(params, l0, l1, tc, r + np.uint64(3))
        e4 = d4 * linear(params, l0, l1, tc, r + np.uint64(4))
        e5 = d5 * linear(params, l0, l1, tc, r + np.uint64(5))
        e6 = d6 * linear(params, l0, l1, tc, r + np.uint64(6))
        e7 = d7 * linear(params, l0, l1, tc, r + np.uint64(7))
        store_8(scratch, tile_at + r, e0, e1, e2, e3, e4, e5, e6, e7)
        e0 = d0 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r)
        e1 = d1 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(1))
        e2 = d2 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(2))
        e3 = d3 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(3))
        e4 = d4 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(4))
        e5 = d5 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(5))
        e6 = d6 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(6))
        e7 = d7 * bilinear(params, o00, o01, o10, o11, w00, w01, w10, w11, r + np.uint64(7))
        store_8(scratch, half + r, e0, e1, e2, e3, e4, e5, e6, e7)
    scatter(rank, grads, o00, w00, scratch, tile_at)
    scatter(rank, grads, o01, w01, scratch, tile_at)
    scatter(rank, grads, o10, w10, scratch, tile_at)
    scatter(rank, grads, o11, w11, scratch, tile_at)
    scatter(rank, grads, l0, params.dtype.type(1) - tc, scratch, half)
    scatter(rank, grads, l1, tc, scratch, half)


# -- a tensor -----------------------------------------------------------------------------------------------


def affine(matrices, b, p):
    """A point by the b-th of matrices (B, 3, 4)."""
    x, y, z = p
    return (
        matrices[b, 0, 0] * x + matrices[b, 0, 1] * y + matrices[b, 0, 2] * z + matrices[b, 0, 3],
        matrices[b, 1, 0] * x + matrices[b, 1, 1] * y + matrices[b, 1, 2] * z + matrices[b, 1, 3],
        matrices[b, 2, 0] * x + matrices[b, 2, 1] * y + matrices[b, 2, 2] * z + matrices[b, 2, 3],
    )


def part_unit(field, b, p):
    """Coordinates of the unbounded space of block b in the unit cube of its tensor's box."""
    box = field.part[b]
    return (p[0] - box[0]) * box[3], (p[1] - box[1]) * box[4], (p[2] - box[2]) * box[5]


def unit_point(field, b, p):
    """The unit-cube coordinates of a field point in block b, and whether it lies inside."""
    real = field.params.dtype.type
    if CROSSING != 0 and field.crossing[b] != 0:
        u, v, w = affine(field.to_unit, b, frame_point(p))
        if field.crossing[b] == 2:
            u, v, w = part_unit(field, b, point((u, v, w)))
    else:
        u, v, w = affine(field.to_unit, b, p)
    lo, hi = -EDGE, 1 + EDGE
    inside = u >= lo and v >= lo and w >= lo and u <= hi and v <= hi and w <= hi
    return real(u), real(v), real(w), inside


def density_feature(field, t, u, v, w):
    """Pre-activation density of tensor t at a unit point (TensoRF, eq. 6)."""
    nx, ny, nz = field.resolution[t, 0], field.resolution[t, 1], field.resolution[t, 2]
    off = field.layout[t]
    return (
        mode_dot(field.params, off[0], off[3], nx, ny, nz, u, v, w)
        + mode_dot(field.params, off[1], off[4], nx, nz, ny, u, w, v)
        + mode_dot(field.params, off[2], off[5], ny, nz, nx, v, w, u)
    )


def scatter_density(field, grads, t, u, v, w, scratch):
    """Adjoint of `density_feature`; scratch[ONE] is the incoming gradient."""
    nx, ny, nz = field.resolution[t, 0], field.resolution[t, 1], field.resolution[t, 2]
    off = field.layout[t]
    p = field.params
    mode_scatter(DENSITY_RANK, p, grads, off[0], off[3], nx, ny, nz, u, v, w, ONE, 0, scratch)
    mode_scatter(DENSITY_RANK, p, grads, off[1], off[4], nx, nz, ny, u, w, v, ONE, 0, scratch)
    mode_scatter(DENSITY_RANK, p, grads, off[2], off[5], ny, nz, nx, v, w, u, ONE, 0, scratch)


def colour_features(field, t, u, v, w, out, base):
    """The 3 * rank colour products of tensor t at a unit point, into out[base:]."""
    rank = COLOUR_RANK
    nx, ny, nz = field.resolution[t, 0], field.resolution[t, 1], field.resolution[t, 2]
    off = field.layout[t]
    mode_products(field.params, off[6], off[9], nx, ny, nz, u, v, w, out, base)
    mode_products(field.params, off[7], off[10], nx, nz, ny, u, w, v, out, base + rank)
    mode_products(field.params, off[8], off[11], ny, nz, nx, v, w, u, out, base + 2 * rank)


def scatter_colour(field, grads, t, u, v, w, scratch):
    """Adjoint of `colour_features`; scratch[D_FEATURES:] is the incoming gradient."""
    rank = COLOUR_RANK
    nx, ny, nz = field.resolution[t, 0], field.resolution[t, 1], field.resolution[t, 2]
    off = field.layout[t]
    p = field.params
    mode_scatter(rank, p, grads, off[6], off[9], nx, ny, nz, u, v, w, D_FEATURES, 1, scratch)
    mode_scatter(rank, p, grads, off[7], off[10], nx, nz, ny, u, w, v, D_FEATURES + rank, 1, scratch)
    mode_scatter(rank, p, grads, off[8], off[11], ny, nz, nx, v, w, u, D_FEATURES + 2 * rank, 1, scratch)


# -- a tensor's hashed detail --------------------------------------------------------------------------------


def run_at(field, t, level, i, j, run):
    """Offset in params of the rows of the `run`-th RUN vertices along z at (i, j): they share a hash and lie
    side by side."""
    h = (i * 2654435761) ^ (j * 805459861) ^ (run * 3674653429)  # wraps around at 64 bits
    return (field.layout[t, 13] + level * field.rows[t, 0] * WIDTH) + (
        (h ^ (h >> 15)) & (field.rows[t, 0] // RUN - 1)
    ) * (RUN * WIDTH)


def edge(field, t, level, i, j, k):
    """Offsets in params of the rows of vertices (i, j, k) and (i, j, k + 1)."""
    last = k % RUN == RUN - 1
    low = run_at(field, t, level, i, j, k // RUN)
    high = run_at(field, t, level, i, j, k // RUN + 1) if last else low + (k % RUN + 1) * WIDTH
    return np.uint64(low + k % RUN * WIDTH), np.uint64(high)


def vertex_below(field, t, level, u, v, w):
    """The vertex (i, j, k) of a level below a unit point on all axes, and how far (a, b, c) in [0, 1) of a
    spacing the point is from it."""
    sides, low = field.lattice[t, level, 0], field.lattice[t, level, 1]
    x, y, z = u * sides[0] + low[0], v * sides[1] + low[1], w * sides[2] + low[2]
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    real = field.params.dtype.type
    return (int(i), int(j), int(k)), (real(x - i), real(y - j), real(z - k))


def edges_around(field, t, level, n, below, share):
    """The rows at both ends of the n-th of the four edges along z around a point, and their parts in what is
    interpolated there; below and share as `vertex_below` returns them."""
    one = field.params.dtype.type(1)
    part = share[0] if n >> 1 == 1 else one - share[0]
    part *= share[1] if n & 1 == 1 else one - share[1]
    low, high = edge(field, t, level, below[0] + (n >> 1), below[1] + (n & 1), below[2])
    return low, high, part * (one - share[2]), part * share[2]


def detail(field, t, u, v, w, scratch):
    """What the rows of tensor t add to the density at a unit point, before activation: trilinear between
    vertices, summed over the levels. Leaves in scratch[DETAIL_AT:] where that was, the tensor from 1 on and
    the point, and what they add to the logits of red, green and blue."""
    p = field.params
    zero = p.dtype.type(0)
    total, red, green, blue = zero, zero, zero, zero
    for level in range(field.rows[t, 1]):
        below, share = vertex_below(field, t, level, u, v, w)
        for n in range(4):
            low, high, near, far = edges_around(field, t, level, n, below, share)
            total += near * p[low] + far * p[high]
            red += near * p[low + np.uint64(1)] + far * p[high + np.uint64(1)]
            green += near * p[low + np.uint64(2)] + far * p[high + np.uint64(2)]
            blue += near * p[low + np.uint64(3)] + far * p[high + np.uint64(3)]
    at = np.uint64(DETAIL_AT)
    scratch[at], scratch[at + np.uint64(1)] = t + 1, u
    scratch[at + np.uint64(2)], scratch[at + np.uint64(3)] = v, w
    scratch[at + np.uint64(4)], scratch[at + np.uint64(5)], scratch[at + np.uint64(6)] = red, green, blue
    return total


def detail_colour(field, t, u, v, w, scratch):
    """What the rows of tensor t add to the logits of red, green and blue at a unit point, most often the one
    whose density was asked last."""
    at = np.uint64(DETAIL_AT)
    known = scratch[at] == t + 1 and scratch[at + np.uint64(1)] == u
    if not (known and scratch[at + np.uint64(2)] == v and scratch[at + np.uint64(3)] == w):
        detail(field, t, u, v, w, scratch)
    return scratch[at + np.uint64(4)], scratch[at + np.uint64(5)], scratch[at + np.uint64(6)]


def scatter_detail(field, grad, t, u, v, w, d_feature, rgb, d_rgb):
    """Adjoint of `detail` in its density and, where d_rgb is not 0, in its colour behind the sigmoid."""
    real = field.params.dtype.type
    d_red = real(d_rgb[0] * rgb[0] * (1 - rgb[0]))
    d_green = real(d_rgb[1] * rgb[1] * (1 - rgb[1]))
    d_blue = real(d_rgb[2] * rgb[2] * (1 - rgb[2]))
    for level in range(field.rows[t, 1]):
        below, share = vertex_below(field, t, level, u, v, w)
        for n in range(4):
            low, high, near, far = edges_around(field, t, level, n, below, share)
            add_row(grad, low, near * d_feature, near * d_red, near * d_green, near * d_blue)
            add_row(grad, high, far * d_feature, far * d_red, far * d_green, far * d_blue)


def add_row(grad, row, density, red, green, blue):
    """Adds to the WIDTH numbers of a row, to which others may be adding too."""
    accumulate(grad, row, density)
    accumulate(grad, row + np.uint64(1), red)
    accumulate(grad, row + np.uint64(2), green)
    accumulate(grad, row + np.uint64(3), blue)


# -- blocks -------------------------------------------------------------------------------------------------


def object_direction(field, b, d):
    """The unit direction in block b's object frame and |A d|, which keeps the optical depth (σ_field =
    σ_object |A d|)."""
    dx, dy, dz = d
    m = field.to_object
    x = m[b, 0, 0] * dx + m[b, 0, 1] * dy + m[b, 0, 2] * dz
    y = m[b, 1, 0] * dx + m[b, 1, 1] * dy + m[b, 1, 2] * dz
    z = m[b, 2, 0] * dx + m[b, 2, 1] * dy + m[b, 2, 2] * dz
    length = math.sqrt(x * x + y * y + z * z)
    return x / length, y / length, z / length, length


def block_density(field, b, p, d, stretched, scratch):
    """(σ in the field frame, pre-activation, place) of block b at a field point; (0, 0, b) outside its
    tensor. Not `stretched`: as if its placement did not stretch it along d."""
    u, v, w, inside = unit_point(field, b, p)
    if not inside:
        return 0.0, 0.0, b
    t = field.tensor[b]
    if field.owners.shape[0] != 0 and cells_apart(field, t, u, v, w) != 0:
        return 0.0, 0.0, b  # what a tensor says there was never learnt
    f, place = density_feature(field, t, u, v, w), b
    if DETAIL != 0 and field.rows[t, 1] != 0 and f + field.activation[t, 1] > EMPTY_FROM:
        f += detail(field, t, u, v, w, scratch)
        place = b + NEAR
    stretch = object_direction(field, b, d)[3] if stretched else 1.0
    slope = crossed(field, b, p, stretch) * field.activation[t, 0]
    return float(slope * softplus(f + field.activation[t, 1])), float(f), place


def crossed(field, b, p, stretch):
    """What makes block b's density one per length of the coordinates at p: the stretch of its placement, and
    for a block that does not lie in the field's own space the length that those coordinates stand for."""
    if CROSSING != 0 and field.crossing[b] != 0:
        d = 0.0, 0.0, 1.0  # of which this space's rate knows nothing
        own = 1.0 if field.crossing[b] == 1 else rate(point(affine(field.to_unit, b, frame_point(p))), d)
        return stretch * own / rate(p, d)
    return stretch


def cells_apart(field, t, u, v, w):
    """How many cells of tensor t's box that of a unit point is from the nearest with matter."""
    nx, ny, nz = field.apart_at[t, 1], field.apart_at[t, 2], field.apart_at[t, 3]
    i, j, m = min(int(u * nx), nx - 1), min(int(v * ny), ny - 1), min(int(w * nz), nz - 1)
    return int(field.apart[np.uint64(field.apart_at[t, 0] + (i * ny + j) * nz + m)])


def density(field, grid, k, p, d, scratch):
    """(σ, pre-activation, 1, place) of the densest block at a point; ties go to the lower block (DESIGN).
    With several blocks 0 instead of 1 where none has matter."""
    if field.owners.shape[0] == 0:
        sigma, f, place = block_density(field, 0, p, d, True, scratch)
        return sigma, f, 1, place
    i, j, m = ownership_cell(field, grid, p)
    b, other = owners_of(field, i, j, m)
    if b == NO_BLOCK:
        return 0.0, 0.0, 0, 0
    if other == NO_BLOCK:
        sigma, f, place = block_density(field, b, p, d, True, scratch)
    else:
        sigma, f, place = held_density(field, b, k, p, d, scratch)
        sigma2, f2, place2 = held_density(field, other, k, p, d, scratch)
        if sigma2 > sigma:
            return sigma2, f2, 1, place2
    return sigma, f, (1 if sigma > 0.0 else 0), place


def started(field, step, scratch):
    """In scratch[HELD:] the turn, from 1 on, of the sample that is held, -1 while there is none; what
    `block_density` said there; how many steps the background's own samples are apart, the step, and for how
    many steps the sample at hand stands. All 0 where nothing is ever held."""
    if CROSSING != 0:
        for b in range(field.tensor.shape[0]):
            if field.crossing[b] == 0:
                scratch[HELD] = -1
                scratch[HELD + 4] = max(1, int(field.cell[b, 0] / field.cell[b, 1] / step + 0.5))
                scratch[HELD + 5] = step


def standing(field, many, scratch):
    """See `started`."""
    if CROSSING != 0:
        scratch[HELD + 6] = many


def held_density(field, b, k, p, d, scratch):
    """`block_density` at step k of a picture's ray. The background, the block whose tensor lies in the
    coordinates of the field, is asked no more often than where it is alone, whatever stands before it: it
    holds the answer of its own sample, in the core, where coordinates go along with d."""
    at_hand = CROSSING != 0 and scratch[HELD] != 0 and field.crossing[b] == 0
    if not at_hand or max(abs(p[0]), max(abs(p[1]), abs(p[2]))) > 1.0:
        return block_density(field, b, p, d, True, scratch)
    apart = int(scratch[HELD + 4])
    turn = k // apart + 1
    if int(scratch[HELD]) != turn:
        steps = (turn - 0.5) * apart - (k + 0.5 * scratch[HELD + 6])  # from the middle of this sample
        middle = along(p, d, steps * scratch[HELD + 5])
        sigma, f, place = block_density(field, b, middle, d, True, scratch)
        scratch[HELD], scratch[HELD + 1], scratch[HELD + 2], scratch[HELD + 3] = turn, sigma, f, place
    return float(scratch[HELD + 1]), float(scratch[HELD + 2]), int(scratch[HELD + 3])


def owners_of(field, i, j, m):
    """The two blocks that are asked in a cell, or NO_BLOCK."""
    owners = int(field.owners[np.uint64(i), np.uint64(j), np.uint64(m)])
    return owners % 256, owners // 256


def ownership_cell(field, grid, p):
    """Indices of the cell of a point."""
    nx, ny, nz = field.owners.shape
    i = cell_of(p[0], grid.lo[0], grid.cell[0], nx)
    j = cell_of(p[1], grid.lo[1], grid.cell[1], ny)
    return i, j, cell_of(p[2], grid.lo[2], grid.cell[2], nz)


def advance(field, grid, place, many, steps, k, p, way, u, u0, step):
    """Where there is nothing, the first sample in this cell of the ownership grid that may have matter: which
    samples there are does not change by it."""
    if steps > 0 or field.owners.shape[0] == 0:
        return k + max(many * steps, 1)
    i, j, m = ownership_cell(field, grid, p)
    stride = 1
    if grid.stride.shape[0] != 0:
        stride = max(1, int(int(grid.stride[i, j, m]) * grid.unit / step + FACE_TOLERANCE))
    away = min(
        exit_distance(p[0], way[0], grid.lo[0], grid.cell[0], i, 1),
        min(
            exit_distance(p[1], way[1], grid.lo[1], grid.cell[1], j, 1),
            exit_distance(p[2], way[2], grid.lo[2], grid.cell[2], m, 1),
        ),
    )
    b, other = owners_of(field, i, j, m)
    if b != NO_BLOCK:
        away = min(away, nothing_for(field, b, p, stride * step))
    if other != NO_BLOCK:
        away = min(away, nothing_for(field, other, p, stride * step))
    beyond = int((u + away - u0) / step) // stride * stride
    return max(k + many, beyond)


def nothing_for(field, b, p, stride):
    """How far from a point of the field block b has no matter in any direction, at least; stride: between
    samples there, which is no more than the block needs."""
    u, v, w, _ = unit_point(field, b, p)
    u, v, w = min(max(u, 0), 1), min(max(v, 0), 1), min(max(w, 0), 1)  # matter in the box is no nearer to p
    whole = max(cells_apart(field, field.tensor[b], u, v, w) - 1, 0)
    cell = field.cell[b, 1] * stride
    if CROSSING == 0 or field.crossing[b] == 0:
        cell = field.cell[b, 0]
    return whole * cell


def unstretched(field, grid, frame, p, scratch):
    """σ of a block at a field point, in units of its object's frame."""
    return block_density(field, frame, p, (0.0, 0.0, 1.0), False, scratch)[0]


def frame_of(place):
    """The block."""
    return place % NEAR


def keep(place):
    """The place itself."""
    return place


def begin(field, b, d, scratch):
    """Fold SH into the colour basis once per ray: basis[c, :] = sum_k Y_k(d_object) B[c, k, :] (SH is
    linear)."""
    width, count = 3 * COLOUR_RANK, COEFFICIENTS
    x, y, z, _ = object_direction(field, b, d)
    sh_basis(count, (x, y, z), scratch, SH)
    start = np.uint64(field.layout[field.tensor[b], 12])
    for c in range(np.uint64(3)):
        source, row = start + c * np.uint64(count * width), np.uint64(BASIS) + c * np.uint64(width)
        for tile in range(np.uint64(width // 8)):
            at = tile * np.uint64(8)
            mixed_8(
                count, scratch, row + at, scratch, np.uint64(SH), field.params, source + at, np.uint64(width)
            )


def end(field, b, d, scratch, grad):
    """Adjoint of `begin`, by the spherical harmonics that it left; clears the gradient."""
    width, count = 3 * COLOUR_RANK, COEFFICIENTS
    start = np.uint64(field.layout[field.tensor[b], 12])
    for c in range(3):
        row = np.uint64(D_BASIS + c * width)
        for k in range(count):
            target = start + np.uint64((c * count + k) * width)
            for mode in range(np.uint64(3)):
                at = mode * np.uint64(COLOUR_RANK)
                scatter(COLOUR_RANK, grad, target + at, scratch[SH + k], scratch, row + at)
    for r in range(np.uint64(3 * width)):
        scratch[np.uint64(D_BASIS) + r] = 0


def dot_row(scratch, row, features, base):
    """Inner product of one row of the directional basis with colour features."""
    width = 3 * COLOUR_RANK
    a = np.uint64(BASIS + row * width)
    f = np.uint64(base)
    total = scratch.dtype.type(0)
    for r in range(np.uint64(width)):
        total += scratch[a + r] * features[f + r]
    return total


def colour(field, place, p, d, scratch, memory, at):
    """rgb_c = sigmoid(<basis_c, features> + detail_c); the features are kept."""
    u, v, w, _ = unit_point(field, frame_of(place), p)
    t = field.tensor[frame_of(place)]
    colour_features(field, t, u, v, w, memory, at)
    r, g = dot_row(scratch, 0, memory, at), dot_row(scratch, 1, memory, at)
    b = dot_row(scratch, 2, memory, at)
    if DETAIL != 0 and place >= NEAR:
        red, green, blue = detail_colour(field, t, u, v, w, scratch)
        r, g, b = r + red, g + green, b + blue
    return float(sigmoid(r)), float(sigmoid(g)), float(sigmoid(b))


def backward(field, place, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad):
    """Adjoint of `density` and, where shaded, of `colour`; the basis gathers its gradient until `end`."""
    if shaded:
        u, v, w, _ = unit_point(field, frame_of(place), p)
        d_logits(rgb, d_rgb, scratch, memory, at)
        scatter_colour(field, grad, field.tensor[frame_of(place)], u, v, w, scratch)
    density_backward(field, place, p, d, pre, d_sigma, scratch, grad)
    if DETAIL != 0 and place >= NEAR:
        u, v, w, _ = unit_point(field, frame_of(place), p)
        scatter_detail(field, grad, field.tensor[frame_of(place)], u, v, w, scratch[ONE], rgb, d_rgb)


def density_backward(field, place, p, d, pre, d_sigma, scratch, grad):
    """Adjoint of `density` but for the detail; leaves in scratch[ONE] what is sent to the feature."""
    b = frame_of(place)
    u, v, w, _ = unit_point(field, b, p)
    t = field.tensor[b]
    slope = crossed(field, b, p, object_direction(field, b, d)[3]) * field.activation[t, 0]
    scratch[ONE] = d_sigma * slope * sigmoid(pre + field.activation[t, 1])
    if scratch[ONE] != 0:
        scatter_density(field, grad, t, u, v, w, scratch)


def d_logits(rgb, d_rgb, scratch, memory, at):
    """What d_rgb sends to the features, into scratch[D_FEATURES:], and to the basis, added to
    scratch[D_BASIS:]."""
    rank = COLOUR_RANK
    for r in range(np.uint64(3 * rank)):
        scratch[np.uint64(D_FEATURES) + r] = 0
    for c in range(3):
        shown = rgb[0] if c == 0 else (rgb[1] if c == 1 else rgb[2])
        wanted = d_rgb[0] if c == 0 else (d_rgb[1] if c == 1 else d_rgb[2])
        d_logit = scratch.dtype.type(wanted * shown * (1 - shown))
        for mode in range(3):
            at_mode = np.uint64(mode * rank)
            row = np.uint64(3 * c * rank) + at_mode
            features, basis = np.uint64(at) + at_mode, np.uint64(BASIS) + row
            add_scaled(rank, scratch, np.uint64(D_FEATURES) + at_mode, d_logit, scratch, basis)
            add_scaled(rank, scratch, np.uint64(D_BASIS) + row, d_logit, memory, features)


# -- asking for memory early --------------------------------------------------------------------------------


def ahead_density(field, array, held, p):
    """The density planes, and the rows of the detail if that was asked last. A random point misses the cache
    a dozen times; asked for early, the misses overlap."""
    ahead_planes(DENSITY_RANK, 0, field, array, held, p)
    if DETAIL != 0 and held >= NEAR:
        ahead_detail(field, array, held, p)


def ahead_colour(field, array, held, p):
    """The colour planes."""
    ahead_planes(COLOUR_RANK, 6, field, array, held, p)


def ahead_detail(field, array, held, p):
    """Ask for the rows at the ends of the four edges along z of the lattice's cells around a field point."""
    u, v, w, _ = unit_point(field, frame_of(held), p)
    t = field.tensor[frame_of(held)]
    for level in range(field.rows[t, 1]):
        (i, j, k), _ = vertex_below(field, t, level, u, v, w)
        for di in range(2):
            for dj in range(2):
                low, high = edge(field, t, level, i + di, j + dj, k)
                prefetch(array, low)
                prefetch(array, high)


def ahead_planes(rank, first, field, array, block, p):
    """Ask for what of the three planes from section `first` on a query of a block at a field point reads."""
    u, v, w, _ = unit_point(field, frame_of(block), p)
    t = field.tensor[frame_of(block)]
    nx, ny, nz = field.resolution[t, 0], field.resolution[t, 1], field.resolution[t, 2]
    off = field.layout[t]
    prefetch_plane(rank, array, off[first], nx, ny, u, v)
    prefetch_plane(rank, array, off[first + 1], nx, nz, u, w)
    prefetch_plane(rank, array, off[first + 2], ny, nz, v, w)
