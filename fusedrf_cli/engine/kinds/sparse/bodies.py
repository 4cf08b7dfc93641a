"""The `sparse` kind's scalar functions: what kernels/loops.py asks of a kind.

Notation for the whole file.
    brick        4 x 4 x 4 voxels, a leaf of a tree whose roots are the *top cells* of the box; a brick of
                 level l is 2^-l top cells wide
    rows         (V, 4) floats from params[0] on: density feature and the degree-0 coefficients of the three
                 colour logits, one row per vertex of the brick's voxels
    bands        (W, WIDTH) floats from params[bands_at] on: the coefficients of degree 1 and more, channel by
                 channel, one row per vertex of a lattice of COARSE voxels a side and brick
    place        (brick or -1, its level or that of the empty node, first vertex of the voxel or -1, and the
                 fractions u, v, w in that voxel)
WIDTH, 0 or a multiple of 8, and COEFFICIENTS, the SH coefficients per channel, are the field's sizes. A ray's
`scratch` holds the spherical harmonics (SH) and one row of bands (BANDS).
σ = scale softplus(f) and rgb = sigmoid(Σ_k Y_k c_k), with f and c_k interpolated linearly between vertices:
before the activation, so that surfaces stay where they are.

In a brick of level l one step in 2^(finest - l), counted from the ray's first, is a sample, and stands for as
many: which they are does not depend on what was skipped before.
"""

import math
from typing import NamedTuple

import numpy as np

from fusedrf_cli.engine.kernels.parts import (
    FACE_TOLERANCE,
    accumulate,
    add_scaled,
    along,
    exit_distance,
    scatter,
    sh_basis,
    sigmoid,
    softplus,
)  # fmt: skip

SIDE = 4  # voxels of a brick along an axis
COARSE = 2  # voxels of the bands' lattice along a brick's side
ROW = 4  # numbers of a vertex: density feature, three colours
Y0 = 0.28209479177387814  # the spherical harmonic of degree 0


class Arrays(NamedTuple):
    """Everything a kernel reads of a sparse field, as arrays (N bricks)."""

    params: object  # (P,) float, rows and bands
    bands_at: int  # where the bands begin in params
    scale: float  # σ = scale softplus(f), 1/length
    lo: object  # (3,) float, lower corner of the box
    top: object  # (3,) float, sides of a top cell
    offset: object  # (X, Y, Z) int64, where a top cell's table begins, or -1
    depth: object  # (X, Y, Z) uint8, the level of its finest brick: the table has 2^depth entries a side
    table: object  # (E,) int32, the brick that holds an entry's cube, or -1 - level of the empty node
    level: object  # (N,) uint8
    mask: object  # (N,) uint64, bit (i * 4 + j) * 4 + k of an active voxel
    rows: object  # (N, 125) int32, the rows of a brick's vertices
    band_rows: object  # (N, (COARSE + 1)^3) int32
    finest: int  # the level of the finest brick


class Light(NamedTuple):
    """What `expose_voxel` looks from and along."""

    places: object  # (K, 3) middles of cubes
    sides: object  # (K,)
    directions: object  # (D, 3)
    far: object  # float
    blocked: object  # float


class Exposure(NamedTuple):
    """What `expose_voxel` fills."""

    clearest: object  # (K,)
    facing: object  # (K, 3)


def sizes(field) -> dict[str, int]:
    """The constants that the functions of this file are compiled with."""
    width = field.shape.band_width
    return {
        "WIDTH": width, "COEFFICIENTS": field.shape.coefficients, "SH": 0, "BANDS": 16, "SCRATCH": 16 + width,
        "KEPT": 0,
    }  # fmt: skip


# -- where a point lies --------------------------------------------------------------------------------------


def brick_at(field, p):
    """(brick, its level) that holds a point; (-1, level of the empty node around it) where there is none.

    Outside the box the answer is an empty node of level 0.
    """
    u = (p[0] - field.lo[0]) / field.top[0]
    v = (p[1] - field.lo[1]) / field.top[1]
    w = (p[2] - field.lo[2]) / field.top[2]
    nx, ny, nz = field.offset.shape
    i, j, m = int(math.floor(u)), int(math.floor(v)), int(math.floor(w))
    if i < 0 or j < 0 or m < 0 or i >= nx or j >= ny or m >= nz:
        return -1, 0
    offset = field.offset[np.uint64(i), np.uint64(j), np.uint64(m)]
    if offset < 0:
        return -1, 0
    n = 1 << int(field.depth[np.uint64(i), np.uint64(j), np.uint64(m)])
    a, b, c = min(int((u - i) * n), n - 1), min(int((v - j) * n), n - 1), min(int((w - m) * n), n - 1)
    brick = int(field.table[np.uint64(offset + (a * n + b) * n + c)])
    if brick < 0:
        return -1, -1 - brick
    return brick, int(field.level[np.uint64(brick)])


def in_brick(field, level, coordinate, axis, n):
    """Voxel of a brick's n along an axis that a coordinate lies in, and the fraction inside it."""
    u = (coordinate - field.lo[axis]) / field.top[axis] * (1 << level)
    f = (u - math.floor(u)) * n
    i = min(int(f), n - 1)
    return i, f - i


def voxel_at(field, brick, level, p):
    """(first vertex of the voxel around a point, fractions u, v, w); the vertex is -1 where it is
    inactive."""
    i, u = in_brick(field, level, p[0], 0, SIDE)
    j, v = in_brick(field, level, p[1], 1, SIDE)
    m, w = in_brick(field, level, p[2], 2, SIDE)
    bit = np.uint64((i * SIDE + j) * SIDE + m)
    if (field.mask[np.uint64(brick)] >> bit) & np.uint64(1) == np.uint64(0):
        return -1, 0.0, 0.0, 0.0
    return (i * (SIDE + 1) + j) * (SIDE + 1) + m, u, v, w


def wide_voxel_at(field, level, p):
    """`voxel_at` in the bands' lattice, whether it is active or not."""
    i, u = in_brick(field, level, p[0], 0, COARSE)
    j, v = in_brick(field, level, p[1], 1, COARSE)
    m, w = in_brick(field, level, p[2], 2, COARSE)
    return (i * (COARSE + 1) + j) * (COARSE + 1) + m, u, v, w


def corner_weight(q, u, v, w):
    """Weight of corner q = 4 a + 2 b + c of a voxel at fractions u, v, w."""
    return (u if q & 4 else 1.0 - u) * (v if q & 2 else 1.0 - v) * (w if q & 1 else 1.0 - w)


def corner(first, q, n):
    """Vertex q = 4 a + 2 b + c of the voxel whose first vertex is given, in a brick of n voxels a side."""
    return np.uint64(first + ((q >> 2) * (n + 1) + ((q >> 1) & 1)) * (n + 1) + (q & 1))


def known(field, grid, p):
    """Always: voxels are found without the grid."""
    return True


def keep(place):
    """The brick."""
    return place[0]


def again(field, held, p):
    """The place in a known brick; rounding may put p beside it, or into a voxel that is not active."""
    level = int(field.level[np.uint64(held)])
    first, u, v, w = voxel_at(field, held, level, p)
    return held, level, first, u, v, w


# -- along a ray ---------------------------------------------------------------------------------------------


def node_exit(field, level, p, way):
    """Distance from a point to where a ray leaves the node of a level around it."""
    n = 1.0 / (1 << level)
    a, b, c = n * field.top[0], n * field.top[1], n * field.top[2]
    i = math.floor((p[0] - field.lo[0]) / a)
    j = math.floor((p[1] - field.lo[1]) / b)
    m = math.floor((p[2] - field.lo[2]) / c)
    return min(
        exit_distance(p[0], way[0], field.lo[0], a, i, 1),
        min(
            exit_distance(p[1], way[1], field.lo[1], b, j, 1),
            exit_distance(p[2], way[2], field.lo[2], c, m, 1),
        ),
    )


def advance(field, grid, place, many, steps, k, p, way, u, u0, step):
    """In a brick the next number that is a multiple of its steps, or the first beyond it; else the first
    beyond the empty node."""
    brick, level = place[0], place[1]
    stride = 1 << (field.finest - level)
    if brick >= 0 and stride == 1:
        return k + 1
    away = node_exit(field, level, p, way)
    beyond = max(k + 1, int(math.ceil((u + away - u0) / step - FACE_TOLERANCE)))
    return min((k | (stride - 1)) + 1, beyond) if brick >= 0 else beyond


# -- density and colour --------------------------------------------------------------------------------------


def feature_at(field, brick, first, u, v, w):
    """Density feature, interpolated."""
    params = field.params
    total = 0.0
    for q in range(8):
        row = field.rows[np.uint64(brick), corner(first, q, SIDE)]
        total += corner_weight(q, u, v, w) * params[np.uint64(ROW * row)]
    return total


def density(field, grid, k, p, d, scratch):
    """σ where the voxel is active, for sample numbers that are multiples of the brick's steps."""
    brick, level = brick_at(field, p)
    steps = 1 << (field.finest - level)
    if brick < 0 or k & (steps - 1) != 0:
        return 0.0, 0.0, 0, (brick, level, -1, 0.0, 0.0, 0.0)
    first, u, v, w = voxel_at(field, brick, level, p)
    place = brick, level, first, u, v, w
    if first < 0:
        return 0.0, 0.0, 0, place
    feature = feature_at(field, brick, first, u, v, w)
    return field.scale * softplus(feature), feature, steps, place


def begin(field, frame, d, scratch):
    """Spherical harmonics of the direction."""
    sh_basis(COEFFICIENTS, d, scratch, SH)


def colour(field, place, p, d, scratch, memory, at):
    """rgb at a place; nothing is kept."""
    brick, level, first, u, v, w = place
    params = field.params
    red, green, blue = 0.0, 0.0, 0.0
    for q in range(8):
        row = np.uint64(ROW * field.rows[np.uint64(brick), corner(first, q, SIDE)])
        weight = corner_weight(q, u, v, w) * Y0
        red += weight * params[row + np.uint64(1)]
        green += weight * params[row + np.uint64(2)]
        blue += weight * params[row + np.uint64(3)]
    if WIDTH > 0:
        bands_at(field, brick, level, p, scratch)
        count = COEFFICIENTS - 1
        for k in range(count):
            red += scratch[SH + 1 + k] * scratch[BANDS + k]
            green += scratch[SH + 1 + k] * scratch[BANDS + count + k]
            blue += scratch[SH + 1 + k] * scratch[BANDS + 2 * count + k]
    return sigmoid(red), sigmoid(green), sigmoid(blue)


def bands_at(field, brick, level, p, scratch):
    """The row of bands at a point, interpolated, into scratch[BANDS:]."""
    params = field.params
    start = np.uint64(BANDS)
    first, u, v, w = wide_voxel_at(field, level, p)
    for r in range(np.uint64(WIDTH)):
        scratch[start + r] = 0
    for q in range(8):
        row = field.band_rows[np.uint64(brick), corner(first, q, COARSE)]
        weight = params.dtype.type(corner_weight(q, u, v, w))
        add_scaled(WIDTH, scratch, start, weight, params, np.uint64(field.bands_at + WIDTH * row))


def backward(field, place, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad):
    """Adjoint of `density` and, where shaded, of `colour`."""
    brick, level, first, u, v, w = place
    if first < 0:
        return
    real = field.params.dtype.type
    d_feature = d_sigma * field.scale * sigmoid(pre)
    d_r = d_rgb[0] * rgb[0] * (1 - rgb[0])
    d_g = d_rgb[1] * rgb[1] * (1 - rgb[1])
    d_b = d_rgb[2] * rgb[2] * (1 - rgb[2])
    for q in range(8):
        row = ROW * field.rows[np.uint64(brick), corner(first, q, SIDE)]
        weight = corner_weight(q, u, v, w)
        accumulate(grad, row, real(weight * d_feature))
        if shaded:
            accumulate(grad, row + 1, real(weight * Y0 * d_r))
            accumulate(grad, row + 2, real(weight * Y0 * d_g))
            accumulate(grad, row + 3, real(weight * Y0 * d_b))
    if WIDTH > 0 and shaded:
        scatter_bands(field, brick, level, p, (d_r, d_g, d_b), scratch, grad)


def scatter_bands(field, brick, level, p, d_logits, scratch, grad):
    """Adjoint of what `colour` makes of the bands."""
    real = field.params.dtype.type
    start, count = np.uint64(BANDS), COEFFICIENTS - 1
    for r in range(np.uint64(WIDTH)):
        scratch[start + r] = 0
    for k in range(count):
        scratch[BANDS + k] = real(d_logits[0] * scratch[SH + 1 + k])
        scratch[BANDS + count + k] = real(d_logits[1] * scratch[SH + 1 + k])
        scratch[BANDS + 2 * count + k] = real(d_logits[2] * scratch[SH + 1 + k])
    first, u, v, w = wide_voxel_at(field, level, p)
    for q in range(8):
        row = field.band_rows[np.uint64(brick), corner(first, q, COARSE)]
        weight = real(corner_weight(q, u, v, w))
        scatter(WIDTH, grad, np.uint64(field.bands_at + WIDTH * row), weight, scratch, start)


# -- what light reaches --------------------------------------------------------------------------------------


def expose_voxel(field, grid, light, i, scratch, memory, out):
    """How much light reaches voxel i, a cube of sides[i] around places[i], from `far` away or from outside
    the box: the most along one of the directions into clearest[i], and the mean of their opposites, by that
    light, into facing[i]. What lets through less than `blocked` counts as opaque.
    """
    clearest, facing, blocked = out.clearest, out.facing, light.blocked
    clearest[i] = 0
    facing[i, 0], facing[i, 1], facing[i, 2] = 0, 0, 0
    total = 0.0
    for q in range(light.directions.shape[0]):
        trans, way = light_along(field, light, i, q)
        if trans > blocked:
            clearest[i] = max(clearest[i], trans)
            facing[i, 0] -= trans * way[0]
            facing[i, 1] -= trans * way[1]
            facing[i, 2] -= trans * way[2]
            total += trans
    if total > 0:
        facing[i, 0] /= total
        facing[i, 1] /= total
        facing[i, 2] /= total


def light_along(field, light, i, q):
    """(share of the light that comes to voxel i from along direction q, that direction)."""
    way = light.directions[q, 0], light.directions[q, 1], light.directions[q, 2]
    side = light.sides[i]
    trans = 1.0
    t = side
    while t < light.far and trans > light.blocked:
        p = along((light.places[i, 0], light.places[i, 1], light.places[i, 2]), way, t)
        brick, level = brick_at(field, p)
        if brick < 0:
            if not in_box(field, p):
                break
            t += max(node_exit(field, level, p, way), 0.0) + 1e-3 * side
        else:
            span_of_voxel = min(field.top[0], min(field.top[1], field.top[2])) / (SIDE << level)
            first, u, v, w = voxel_at(field, brick, level, p)
            if first >= 0:
                sigma = field.scale * softplus(feature_at(field, brick, first, u, v, w))
                trans *= math.exp(-sigma * span_of_voxel)
            t += span_of_voxel
    return trans, way


def in_box(field, p):
    """Whether a point lies in the field's box."""
    nx, ny, nz = field.offset.shape
    u, v = (p[0] - field.lo[0]) / field.top[0], (p[1] - field.lo[1]) / field.top[1]
    w = (p[2] - field.lo[2]) / field.top[2]
    return u >= 0 and v >= 0 and w >= 0 and u < nx and v < ny and w < nz
