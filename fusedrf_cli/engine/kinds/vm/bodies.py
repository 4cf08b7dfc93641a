"""The `vm` kind's scalar functions: what kernels/loops.py asks of a kind, for one or more placed tensors.

Notation for the whole file.
    u, v, w      a point in the unit cube of one tensor
    params       flat float vector holding all tensors of a field; `layout[t]` are the offsets of tensor t's
                 sections in it: 0-2 density planes, 3-5 density lines, 6-8 colour planes, 9-11 colour lines,
                 12 colour basis
    modes        mode 0 = plane xy, line z; mode 1 = plane xz, line y; mode 2 = plane yz, line x (TensoRF, eq.
                 5)
    place        the block that a point belongs to; it is also the frame
DENSITY_RANK, COLOUR_RANK and COEFFICIENTS are the field's sizes. A ray's `scratch` holds, one after the
other, the directional basis (BASIS), its gradient (D_BASIS), the gradient of a sample's colour features
(D_FEATURES), the spherical harmonics (SH), and room for one mode (TILE) and one number (ONE).
"""

from typing import NamedTuple

import numpy as np
from numba import literally

from fusedrf_cli.engine.kernels.parts import (
    add_scaled,
    bilinear,
    cell_of,
    linear,
    scatter,
    sh_basis,
    sigmoid,
    softplus,
    store_8,
    texel,
)  # fmt: skip
from fusedrf_cli.engine.kernels.prefetch import prefetch_plane

NO_BLOCK = 255  # in the ownership grids: nobody is asked here
EDGE = 1e-9  # share of a box by which rounding may put a point on its face outside


class Arrays(NamedTuple):
    """Everything a kernel reads of a VM field, as arrays (T tensors, B blocks)."""

    params: object  # (P,) float, all sections of all tensors
    layout: object  # (T, 13) int64, offsets into params
    resolution: object  # (T, 3) int64, texels per axis
    to_unit: object  # (B, 3, 4) float, field frame -> unit cube of the block's tensor
    to_object: object  # (B, 3, 3) float, field directions -> object directions, unnormalised
    tensor: object  # (B,) int64, the tensor of a block
    activation: object  # (T, 2) float, scale (1/length of the object frame) and shift of the softplus
    first: object  # (X, Y, Z) uint8, owning block of a cell; shape (0, 0, 0) when there is one block
    second: object  # (X, Y, Z) uint8, the other block that has matter in the cell, or NO_BLOCK
    occupied: object  # flat uint8, the tensors' own occupancy, asked only where there are several blocks
    occupied_at: object  # (T, 4) int64, offset into occupied and cells per axis
    crossing: object  # (B,) uint8, how points come to the block's tensor (VMField.crossings)
    part: object  # (B, 6) float64, lower corner and 1 / sides of a tensor's box in its own unbounded space


def sizes(field) -> dict[str, int]:
    """The constants that the functions of this file are compiled with."""
    rank, colour_rank = field.shape.density_rank, field.shape.colour_rank
    held = {
        "BASIS": 9 * colour_rank, "D_BASIS": 9 * colour_rank, "D_FEATURES": 3 * colour_rank, "SH": 16,
        "TILE": 2 * max(rank, colour_rank), "ONE": 1,
    }  # fmt: skip
    starts = np.cumsum([0, *held.values()]).tolist()
    return {
        "DENSITY_RANK": rank, "COLOUR_RANK": colour_rank, "COEFFICIENTS": field.shape.coefficients,
        **dict(zip(held, starts, strict=False)), "SCRATCH": starts[-1], "KEPT": 3 * colour_rank,
        "CROSSING": int(any(field.crossings)),
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


def block_density(field, b, p, stretch):
    """(σ in the field frame, pre-activation) of block b at a field point; (0, 0) outside its tensor."""
    u, v, w, inside = unit_point(field, b, p)
    if not inside:
        return 0.0, 0.0
    t = field.tensor[b]
    if field.first.shape[0] != 0 and not matter_at(field, t, u, v, w):
        return 0.0, 0.0
    f = density_feature(field, t, u, v, w)
    slope = crossed(field, b, p, stretch) * field.activation[t, 0]
    return float(slope * softplus(f + field.activation[t, 1])), float(f)


def crossed(field, b, p, stretch):
    """What makes block b's density one per length of the coordinates at p: the stretch of its placement, and
    for a block that does not lie in the field's own space the length that those coordinates stand for."""
    if CROSSING != 0 and field.crossing[b] != 0:
        own = 1.0 if field.crossing[b] == 1 else rate(point(affine(field.to_unit, b, frame_point(p))))
        return stretch * own / rate(p)
    return stretch


def matter_at(field, t, u, v, w):
    """Whether a unit point lies in an occupied cell of tensor t; what a tensor says elsewhere was never
    learnt."""
    nx, ny, nz = field.occupied_at[t, 1], field.occupied_at[t, 2], field.occupied_at[t, 3]
    i, j, m = min(int(u * nx), nx - 1), min(int(v * ny), ny - 1), min(int(w * nz), nz - 1)
    return field.occupied[np.uint64(field.occupied_at[t, 0] + (i * ny + j) * nz + m)] != 0


def density(field, grid, k, p, d, scratch):
    """(σ, pre-activation, 1, block) of the densest block at a point; ties go to the lower block (DESIGN)."""
    if field.first.shape[0] == 0:
        stretch = object_direction(field, 0, d)[3]
        sigma, f = block_density(field, 0, p, stretch)
        return sigma, f, 1, 0
    nx, ny, nz = field.first.shape
    i = cell_of(p[0], grid.lo[0], grid.cell[0], nx)
    j = cell_of(p[1], grid.lo[1], grid.cell[1], ny)
    m = cell_of(p[2], grid.lo[2], grid.cell[2], nz)
    b = int(field.first[i, j, m])
    if b == NO_BLOCK:
        return 0.0, 0.0, 1, 0
    sigma, f = block_density(field, b, p, object_direction(field, b, d)[3])
    other = int(field.second[i, j, m])
    if other != NO_BLOCK:
        sigma2, f2 = block_density(field, other, p, object_direction(field, other, d)[3])
        if sigma2 > sigma:
            return sigma2, f2, 1, other
    return sigma, f, 1, b


def unstretched(field, grid, frame, p, scratch):
    """σ of a block at a field point, in units of its object's frame."""
    return block_density(field, frame, p, 1.0)[0]


def frame_of(place):
    """The block."""
    return place


def keep(place):
    """The block."""
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
    """rgb_c = sigmoid(<basis_c, features>); the features are kept."""
    u, v, w, _ = unit_point(field, place, p)
    colour_features(field, field.tensor[place], u, v, w, memory, at)
    return (
        float(sigmoid(dot_row(scratch, 0, memory, at))),
        float(sigmoid(dot_row(scratch, 1, memory, at))),
        float(sigmoid(dot_row(scratch, 2, memory, at))),
    )


def backward(field, place, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad):
    """Adjoint of `density` and, where shaded, of `colour`; the basis gathers its gradient until `end`."""
    if shaded:
        u, v, w, _ = unit_point(field, place, p)
        d_logits(rgb, d_rgb, scratch, memory, at)
        scatter_colour(field, grad, field.tensor[place], u, v, w, scratch)
    density_backward(field, place, p, d, pre, d_sigma, scratch, grad)


def density_backward(field, place, p, d, pre, d_sigma, scratch, grad):
    """Adjoint of `density`."""
    u, v, w, _ = unit_point(field, place, p)
    t = field.tensor[place]
    slope = crossed(field, place, p, object_direction(field, place, d)[3]) * field.activation[t, 0]
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
    """The density planes. A random point misses the cache a dozen times; asked for early, the misses
    overlap."""
    ahead_planes(DENSITY_RANK, 0, field, array, held, p)


def ahead_colour(field, array, held, p):
    """The colour planes."""
    ahead_planes(COLOUR_RANK, 6, field, array, held, p)


def ahead_planes(rank, first, field, array, block, p):
    """Ask for what of the three planes from section `first` on a query of a block at a field point reads."""
    u, v, w, _ = unit_point(field, block, p)
    t = field.tensor[block]
    nx, ny, nz = field.resolution[t, 0], field.resolution[t, 1], field.resolution[t, 2]
    off = field.layout[t]
    prefetch_plane(rank, array, off[first], nx, ny, u, v)
    prefetch_plane(rank, array, off[first + 1], nx, nz, u, w)
    prefetch_plane(rank, array, off[first + 2], ny, nz, v, w)
