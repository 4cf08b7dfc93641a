"""Scalar bodies of the `sparse` field's kernels, written once for the CPU (`sparse_cpu.py`) and the GPU
(`sparse_cuda.py`).

Notation for the whole file.
    brick        4 x 4 x 4 voxels, a leaf of a tree whose roots are the *top cells* of the box; a brick of
                 level l is 2^-l top cells wide
    rows         (V, 4) floats from params[0] on: density feature and the degree-0 coefficients of the three
                 colour logits, one row per vertex of the brick's voxels
    bands        (W, width) floats from params[bands_at] on: the coefficients of degree 1 and more, channel by
                 channel, one row per vertex of a lattice of `coarse` voxels a side and brick
    widths       a tuple whose *length* is the width of a row of bands, 0 or a multiple of 8
    coefficients a tuple whose length is the number of SH coefficients per channel
σ = scale softplus(f) and rgb = sigmoid(Σ_k Y_k c_k), with f and c_k interpolated linearly between vertices:
before the activation, so that surfaces stay where they are.
"""

import math
from typing import NamedTuple

import numpy as np

from fusedrf_cli.engine.kernels.bodies import (
    COLOUR_FROM,
    FACE_TOLERANCE,
    accumulate,
    add_scaled,
    body,
    compared,
    exit_distance,
    hit_box,
    next_sample,
    scatter,
    sh_basis,
    sigmoid,
    softplus,
)

SIDE = 4  # voxels of a brick along an axis
ROW = 4  # numbers of a vertex: density feature, three colours
Y0 = 0.28209479177387814  # the spherical harmonic of degree 0


class SparseArrays(NamedTuple):
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
    band_rows: object  # (N, (coarse + 1)^3) int32
    coarse: int  # voxels of the bands' lattice along a brick's side
    finest: int  # the level of the finest brick


@body
def brick_at(sparse, x, y, z):
    """(brick, its level) that holds a point; (-1, level of the empty node around it) where there is none.

    Outside the box the answer is an empty node of level 0.
    """
    u = (x - sparse.lo[0]) / sparse.top[0]
    v = (y - sparse.lo[1]) / sparse.top[1]
    w = (z - sparse.lo[2]) / sparse.top[2]
    nx, ny, nz = sparse.offset.shape
    i, j, m = int(math.floor(u)), int(math.floor(v)), int(math.floor(w))
    if i < 0 or j < 0 or m < 0 or i >= nx or j >= ny or m >= nz:
        return -1, 0
    offset = sparse.offset[np.uint64(i), np.uint64(j), np.uint64(m)]
    if offset < 0:
        return -1, 0
    n = 1 << int(sparse.depth[np.uint64(i), np.uint64(j), np.uint64(m)])
    a, b, c = min(int((u - i) * n), n - 1), min(int((v - j) * n), n - 1), min(int((w - m) * n), n - 1)
    brick = int(sparse.table[np.uint64(offset + (a * n + b) * n + c)])
    if brick < 0:
        return -1, -1 - brick
    return brick, int(sparse.level[np.uint64(brick)])


@body
def in_brick(sparse, level, coordinate, axis, n):
    """Voxel of a brick's n along an axis that a coordinate lies in, and the fraction inside it."""
    u = (coordinate - sparse.lo[axis]) / sparse.top[axis] * (1 << level)
    f = (u - math.floor(u)) * n
    i = min(int(f), n - 1)
    return i, f - i


@body
def voxel_at(sparse, brick, level, x, y, z):
    """(first vertex of the voxel around a point, fractions u, v, w); the vertex is -1 where it is
    inactive."""
    i, u = in_brick(sparse, level, x, 0, SIDE)
    j, v = in_brick(sparse, level, y, 1, SIDE)
    m, w = in_brick(sparse, level, z, 2, SIDE)
    bit = np.uint64((i * SIDE + j) * SIDE + m)
    if (sparse.mask[np.uint64(brick)] >> bit) & np.uint64(1) == np.uint64(0):
        return -1, 0.0, 0.0, 0.0
    return (i * (SIDE + 1) + j) * (SIDE + 1) + m, u, v, w


@body
def corner_weight(q, u, v, w):
    """Weight of corner q = 4 a + 2 b + c of a voxel at fractions u, v, w."""
    return (u if q & 4 else 1.0 - u) * (v if q & 2 else 1.0 - v) * (w if q & 1 else 1.0 - w)


@body
def corner(first, q, n):
    """Vertex q = 4 a + 2 b + c of the voxel whose first vertex is given, in a brick of n voxels a side."""
    return np.uint64(first + ((q >> 2) * (n + 1) + ((q >> 1) & 1)) * (n + 1) + (q & 1))


@body
def feature_at(sparse, brick, first, u, v, w):
    """Density feature, interpolated."""
    params = sparse.params
    total = 0.0
    for q in range(8):
        row = sparse.rows[np.uint64(brick), corner(first, q, SIDE)]
        total += corner_weight(q, u, v, w) * params[np.uint64(ROW * row)]
    return total


@body
def logits_at(widths, coefficients, sparse, brick, level, first, u, v, w, x, y, z, sh, bands, out):
    """The three colour logits at a point, seen along the direction whose basis `sh` holds, into out (3,)."""
    params = sparse.params
    out[0], out[1], out[2] = 0, 0, 0
    for q in range(8):
        at = np.uint64(ROW * sparse.rows[np.uint64(brick), corner(first, q, SIDE)])
        weight = corner_weight(q, u, v, w) * Y0
        out[0] += weight * params[at + np.uint64(1)]
        out[1] += weight * params[at + np.uint64(2)]
        out[2] += weight * params[at + np.uint64(3)]
    if len(widths) > 0:
        real = params.dtype.type
        n = sparse.coarse
        i, u = in_brick(sparse, level, x, 0, n)
        j, v = in_brick(sparse, level, y, 1, n)
        m, w = in_brick(sparse, level, z, 2, n)
        first = (i * (n + 1) + j) * (n + 1) + m
        for r in range(np.uint64(len(widths))):
            bands[r] = 0
        for q in range(8):
            row = sparse.band_rows[np.uint64(brick), corner(first, q, n)]
            at = np.uint64(sparse.bands_at + len(widths) * row)
            add_scaled(widths, bands, np.uint64(0), real(corner_weight(q, u, v, w)), params, at)
        count = len(coefficients) - 1
        for c in range(3):
            for k in range(count):
                out[c] += sh[k + 1] * bands[c * count + k]


@body
def scatter_point(
    widths, coefficients, sparse, grads, brick, level, first, u, v, w, x, y, z, d_f, shaded, d_logits, sh,
    bands
):  # fmt: skip
    """Adjoint of `feature_at`, for d_f, and, where shaded, of `logits_at` for d_logits (3,)."""
    real = sparse.params.dtype.type
    for q in range(8):
        at = ROW * sparse.rows[np.uint64(brick), corner(first, q, SIDE)]
        weight = corner_weight(q, u, v, w)
        accumulate(grads, at, real(weight * d_f))
        if shaded:
            accumulate(grads, at + 1, real(weight * Y0 * d_logits[0]))
            accumulate(grads, at + 2, real(weight * Y0 * d_logits[1]))
            accumulate(grads, at + 3, real(weight * Y0 * d_logits[2]))
    if shaded and len(widths) > 0:
        n = sparse.coarse
        i, u = in_brick(sparse, level, x, 0, n)
        j, v = in_brick(sparse, level, y, 1, n)
        m, w = in_brick(sparse, level, z, 2, n)
        first = (i * (n + 1) + j) * (n + 1) + m
        count = len(coefficients) - 1
        for r in range(np.uint64(len(widths))):
            bands[r] = 0
        for c in range(3):
            for k in range(count):
                bands[c * count + k] = real(d_logits[c] * sh[k + 1])
        for q in range(8):
            row = sparse.band_rows[np.uint64(brick), corner(first, q, n)]
            at = np.uint64(sparse.bands_at + len(widths) * row)
            scatter(widths, grads, at, real(corner_weight(q, u, v, w)), bands, np.uint64(0))


@body
def query_sparse_point(
    widths, coefficients, sparse, points, dirs, with_colour, i, sh, bands, logits, sigma, rgb
):
    """σ (1/length) and rgb at point i; both 0 where no voxel is active."""
    x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
    sigma[i] = 0
    rgb[i, 0], rgb[i, 1], rgb[i, 2] = 0, 0, 0
    brick, level = brick_at(sparse, x, y, z)
    if brick >= 0:
        first, u, v, w = voxel_at(sparse, brick, level, x, y, z)
        if first >= 0:
            sigma[i] = sparse.scale * softplus(feature_at(sparse, brick, first, u, v, w))
            if with_colour:
                sh_basis(coefficients, float(dirs[i, 0]), float(dirs[i, 1]), float(dirs[i, 2]), sh, 0)
                logits_at(
                    widths, coefficients, sparse, brick, level, first, u, v, w, x, y, z, sh, bands, logits
                )
                for c in range(3):
                    rgb[i, c] = sigmoid(logits[c])


@body
def query_sparse_point_backward(
    widths, coefficients, sparse, points, dirs, d_sigma, d_rgb, i, sh, bands, logits, grad
):
    """Adjoint of `query_sparse_point`: adds to grad (P,) what d_sigma[i] and d_rgb[i] send back."""
    x, y, z = float(points[i, 0]), float(points[i, 1]), float(points[i, 2])
    brick, level = brick_at(sparse, x, y, z)
    if brick < 0:
        return
    first, u, v, w = voxel_at(sparse, brick, level, x, y, z)
    if first < 0:
        return
    shaded = d_rgb[i, 0] != 0 or d_rgb[i, 1] != 0 or d_rgb[i, 2] != 0
    if shaded:
        sh_basis(coefficients, float(dirs[i, 0]), float(dirs[i, 1]), float(dirs[i, 2]), sh, 0)
        logits_at(widths, coefficients, sparse, brick, level, first, u, v, w, x, y, z, sh, bands, logits)
        for c in range(3):
            rgb = sigmoid(logits[c])
            logits[c] = d_rgb[i, c] * rgb * (1 - rgb)
    f = feature_at(sparse, brick, first, u, v, w)
    d_f = d_sigma[i] * sparse.scale * sigmoid(f)
    scatter_point(
        widths, coefficients, sparse, grad, brick, level, first, u, v, w, x, y, z, d_f, shaded, logits, sh,
        bands
    )  # fmt: skip


@body
def node_exit(sparse, level, x, y, z, dx, dy, dz):
    """Distance from a point to where a ray leaves the node of a level around it."""
    n = 1.0 / (1 << level)
    a, b, c = n * sparse.top[0], n * sparse.top[1], n * sparse.top[2]
    i = math.floor((x - sparse.lo[0]) / a)
    j = math.floor((y - sparse.lo[1]) / b)
    m = math.floor((z - sparse.lo[2]) / c)
    return min(
        exit_distance(x, dx, sparse.lo[0], a, i, 1),
        min(exit_distance(y, dy, sparse.lo[1], b, j, 1), exit_distance(z, dz, sparse.lo[2], c, m, 1)),
    )


@body
def beyond_node(sparse, level, x, y, z, dx, dy, dz, t, t0, step, k):
    """First sample index beyond the node of a level around the point of sample k."""
    away = node_exit(sparse, level, x, y, z, dx, dy, dz)
    return max(k + 1, int(math.ceil((t + away - t0) / step - FACE_TOLERANCE)))


@body
def next_in_brick(sparse, level, x, y, z, dx, dy, dz, t, t0, step, k, steps):
    """First index after k that is a multiple of a brick's steps or lies beyond the brick."""
    if steps == 1:
        return k + 1
    beyond = beyond_node(sparse, level, x, y, z, dx, dy, dz, t, t0, step, k)
    return min((k | (steps - 1)) + 1, beyond)


@body
def render_sparse_ray(
    widths, coefficients, sparse, grid, rays_o, rays_d, near, step, early_stop, i, sh, bands, logits, out
):
    """Marches, shades and composites ray i in one pass: out[i] is premultiplied rgb, opacity, Σ w t.

    In a brick of level l one step in 2^(finest - l), counted from the ray's first, is a sample, and stands
    for as many: which they are does not depend on what was skipped before.
    """
    ox, oy, oz = rays_o[i, 0], rays_o[i, 1], rays_o[i, 2]
    dx, dy, dz = rays_d[i, 0], rays_d[i, 1], rays_d[i, 2]
    t0, t1 = hit_box(ox, oy, oz, dx, dy, dz, grid.lo, grid.hi)
    t0 = max(t0, near) + 0.5 * step
    red, green, blue, depth = 0.0, 0.0, 0.0, 0.0
    trans = 1.0
    waiting = 0.0  # weight of samples too light to be shaded; the next shaded one lends them its colour
    sh_basis(coefficients, dx, dy, dz, sh, 0)
    k = next_sample(grid, ox, oy, oz, dx, dy, dz, t0, t1, step, 0)
    while k >= 0 and trans > early_stop:
        t = t0 + k * step
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        brick, level = brick_at(sparse, x, y, z)
        steps = 1 << (sparse.finest - level)
        if brick < 0:
            k = beyond_node(sparse, level, x, y, z, dx, dy, dz, t, t0, step, k)
        elif k & (steps - 1) != 0:
            k = next_in_brick(sparse, level, x, y, z, dx, dy, dz, t, t0, step, k, steps)
        else:
            first, u, v, w = voxel_at(sparse, brick, level, x, y, z)
            if first >= 0:
                s = sparse.scale * softplus(feature_at(sparse, brick, first, u, v, w))
                weight = trans * (1.0 - math.exp(-s * steps * step))
                trans -= weight
                depth += weight * t
                waiting += weight
                if waiting > COLOUR_FROM:
                    logits_at(
                        widths, coefficients, sparse, brick, level, first, u, v, w, x, y, z, sh, bands, logits
                    )
                    red += waiting * sigmoid(logits[0])
                    green += waiting * sigmoid(logits[1])
                    blue += waiting * sigmoid(logits[2])
                    waiting = 0.0
            k = next_in_brick(sparse, level, x, y, z, dx, dy, dz, t, t0, step, k, steps)
        k = next_sample(grid, ox, oy, oz, dx, dy, dz, t0, t1, step, k)
    out[i, 0], out[i, 1], out[i, 2], out[i, 3], out[i, 4] = red, green, blue, 1.0 - trans, depth


@body
def expose_voxel(sparse, places, sides, directions, far, blocked, i, clearest, facing):
    """How much light reaches voxel i, a cube of sides[i] around places[i], from `far` away or from outside
    the box: the most along one of the directions (D, 3) into clearest[i], and the mean of their opposites, by
    that light, into facing[i]. What lets through less than `blocked` counts as opaque.
    """
    clearest[i] = 0
    facing[i, 0], facing[i, 1], facing[i, 2] = 0, 0, 0
    total = 0.0
    for q in range(directions.shape[0]):
        dx, dy, dz = directions[q, 0], directions[q, 1], directions[q, 2]
        trans = 1.0
        t = sides[i]
        while t < far and trans > blocked:
            x, y, z = places[i, 0] + t * dx, places[i, 1] + t * dy, places[i, 2] + t * dz
            brick, level = brick_at(sparse, x, y, z)
            if brick < 0:
                if not in_box(sparse, x, y, z):
                    break
                t += max(node_exit(sparse, level, x, y, z, dx, dy, dz), 0.0) + 1e-3 * sides[i]
            else:
                span = min(sparse.top[0], min(sparse.top[1], sparse.top[2])) / (SIDE << level)
                first, u, v, w = voxel_at(sparse, brick, level, x, y, z)
                if first >= 0:
                    s = sparse.scale * softplus(feature_at(sparse, brick, first, u, v, w))
                    trans *= math.exp(-s * span)
                t += span
        if trans > blocked:
            clearest[i] = max(clearest[i], trans)
            facing[i, 0] -= trans * dx
            facing[i, 1] -= trans * dy
            facing[i, 2] -= trans * dz
            total += trans
    if total > 0:
        facing[i, 0], facing[i, 1], facing[i, 2] = (
            facing[i, 0] / total,
            facing[i, 1] / total,
            facing[i, 2] / total,
        )


@body
def in_box(sparse, x, y, z):
    """Whether a point lies in the field's box."""
    nx, ny, nz = sparse.offset.shape
    u, v = (x - sparse.lo[0]) / sparse.top[0], (y - sparse.lo[1]) / sparse.top[1]
    w = (z - sparse.lo[2]) / sparse.top[2]
    return u >= 0 and v >= 0 and w >= 0 and u < nx and v < ny and w < nz


@body
def train_sparse_ray(
    widths, coefficients, sparse, grid, rays_o, rays_d, near, jitter, step, early_stop, target, background,
    opacity_weight, i, ts, pre, weights, carried, rgbs, spans, sh, bands, logits, grad, loss,
):  # fmt: skip
    """Ray i of `train_rays` in sparse_cpu.py: forward, compare, and backward along the ray into grad (P,).

    ts to spans hold what the backward sweep needs of every sample; a span of 0 ends up nowhere, a negative
    `carried` says that the sample was not shaded.
    """
    ox, oy, oz = rays_o[i, 0], rays_o[i, 1], rays_o[i, 2]
    dx, dy, dz = rays_d[i, 0], rays_d[i, 1], rays_d[i, 2]
    t0, t1 = hit_box(ox, oy, oz, dx, dy, dz, grid.lo, grid.hi)
    t0 = max(t0, near) + jitter[i] * step
    red, green, blue = 0.0, 0.0, 0.0
    trans = 1.0
    count = 0
    waiting = 0.0
    sh_basis(coefficients, dx, dy, dz, sh, 0)
    k = next_sample(grid, ox, oy, oz, dx, dy, dz, t0, t1, step, 0)
    while k >= 0 and trans > early_stop and count < ts.shape[0]:
        t = t0 + k * step
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        brick, level = brick_at(sparse, x, y, z)
        steps = 1 << (sparse.finest - level)
        if brick < 0:
            k = beyond_node(sparse, level, x, y, z, dx, dy, dz, t, t0, step, k)
        elif k & (steps - 1) != 0:
            k = next_in_brick(sparse, level, x, y, z, dx, dy, dz, t, t0, step, k, steps)
        else:
            first, u, v, w = voxel_at(sparse, brick, level, x, y, z)
            if first >= 0:
                f = feature_at(sparse, brick, first, u, v, w)
                weight = trans * (1.0 - math.exp(-sparse.scale * softplus(f) * steps * step))
                trans -= weight
                ts[count], pre[count], weights[count], spans[count] = t, f, weight, steps
                carried[count] = -1.0
                waiting += weight
                if waiting > COLOUR_FROM:
                    logits_at(
                        widths, coefficients, sparse, brick, level, first, u, v, w, x, y, z, sh, bands, logits
                    )
                    for c in range(3):
                        rgbs[count, c] = sigmoid(logits[c])
                    red += waiting * rgbs[count, 0]
                    green += waiting * rgbs[count, 1]
                    blue += waiting * rgbs[count, 2]
                    carried[count] = waiting
                    waiting = 0.0
                count += 1
            k = next_in_brick(sparse, level, x, y, z, dx, dy, dz, t, t0, step, k, steps)
        k = next_sample(grid, ox, oy, oz, dx, dy, dz, t0, t1, step, k)

    g_r, g_g, g_b, g_t = compared(
        red, green, blue, trans, target, background, opacity_weight, i, count, loss
    )
    behind = trans * g_t
    after = trans
    own = 0.0
    for q in range(count - 1, -1, -1):
        shaded = carried[q] >= 0
        if shaded:
            own = g_r * rgbs[q, 0] + g_g * rgbs[q, 1] + g_b * rgbs[q, 2]
            logits[0] = g_r * carried[q] * rgbs[q, 0] * (1 - rgbs[q, 0])
            logits[1] = g_g * carried[q] * rgbs[q, 1] * (1 - rgbs[q, 1])
            logits[2] = g_b * carried[q] * rgbs[q, 2] * (1 - rgbs[q, 2])
        d_f = spans[q] * step * (after * own - behind) * sparse.scale * sigmoid(pre[q])
        behind += weights[q] * own
        after += weights[q]
        t = ts[q]
        x, y, z = ox + t * dx, oy + t * dy, oz + t * dz
        brick, level = brick_at(sparse, x, y, z)
        first, u, v, w = voxel_at(sparse, brick, level, x, y, z)
        scatter_point(
            widths, coefficients, sparse, grad, brick, level, first, u, v, w, x, y, z, d_f, shaded, logits,
            sh, bands,
        )  # fmt: skip


@body
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
