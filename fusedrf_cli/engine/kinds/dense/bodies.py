"""Scalar bodies of the `dense` kind: a grid of vertices with density and spherical-harmonic colour (as
Plenoxels; DVGO, Sun et al., CVPR 2022, eq. 5 to 7: interpolation comes before the activation).

    σ = scale softplus(f + shift), rgb_c = sigmoid(Σ_k SH_k(d) v[c, k]), f and v trilinear between vertices
COEFFICIENTS are the spherical harmonics per channel, WIDTH the floats of a vertex's row of colour.
"""

from typing import NamedTuple

import numpy as np

from fusedrf_cli.engine.kernels.parts import accumulate, add_scaled, scatter, sh_basis, sigmoid, softplus
from fusedrf_cli.engine.kernels.prefetch import prefetch

EDGE = 1e-9  # share of a box by which rounding may put a point on its face outside


class Arrays(NamedTuple):
    """What the kernels read of a dense field of N = nx ny nz vertices."""

    params: object  # (P,) float: density (N,), then rows of colour (N, WIDTH)
    rows_at: int  # where the rows begin in params
    resolution: object  # (3,) int64, vertices per axis, corners on the faces of the box
    lo: object  # (3,) float64, lower corner of the box
    side: object  # (3,) float64, its sides
    density: object  # (2,) float, scale (1/length) and shift of the softplus


def sizes(field):
    """Constants of the namespace; scratch holds a row of colour, that of its gradient, and SH."""
    width = field.shape.width
    return {
        "COEFFICIENTS": field.shape.coefficients, "WIDTH": width, "ROW": 0, "D_ROW": width, "SH": 2 * width,
        "SCRATCH": 2 * width + 16, "KEPT": 0,
    }  # fmt: skip


def vertex_on(field, p, axis):
    """Lower vertex and share of the upper one on an axis, and whether the point lies inside the box."""
    n = field.resolution[axis]
    u = (p[axis] - field.lo[axis]) / field.side[axis]
    f = min(max(u, 0.0), 1.0) * (n - 1)
    i = min(int(f), n - 2)
    return i, f - i, -EDGE <= u <= 1 + EDGE


def place_of(field, p):
    """((lower vertex, shares of the upper ones on three axes), whether the point lies inside the box)."""
    i, u, in_x = vertex_on(field, p, 0)
    j, v, in_y = vertex_on(field, p, 1)
    m, w, in_z = vertex_on(field, p, 2)
    first = (i * field.resolution[1] + j) * field.resolution[2] + m
    return (first, u, v, w), in_x and in_y and in_z


def corner(field, place, q):
    """Vertex q = 4 a + 2 b + c of the voxel around a place, and its weight."""
    first, u, v, w = place
    ny, nz = field.resolution[1], field.resolution[2]
    weight = (u if q & 4 else 1.0 - u) * (v if q & 2 else 1.0 - v) * (w if q & 1 else 1.0 - w)
    return np.uint64(first + ((q >> 2) * ny + ((q >> 1) & 1)) * nz + (q & 1)), weight


def density(field, grid, k, p, d, scratch):
    """See loops.py; the place is the voxel's first vertex and the shares inside it."""
    place, inside = place_of(field, p)
    if not inside:
        return 0.0, 0.0, 0, place
    f = 0.0
    for q in range(8):
        vertex, weight = corner(field, place, q)
        f += weight * field.params[vertex]
    return float(field.density[0] * softplus(f + field.density[1])), f, 1, place


def again(field, held, p):
    """See loops.py."""
    return place_of(field, p)[0]


def begin(field, frame, d, scratch):
    """Spherical harmonics of the direction."""
    sh_basis(COEFFICIENTS, d, scratch, SH)


def row_of(field, vertex):
    """Where a vertex's row of colour begins."""
    return np.uint64(field.rows_at) + vertex * np.uint64(WIDTH)


def logit(scratch, c):
    """Σ_k SH_k v[c, k] of the row in scratch."""
    total = 0.0
    for k in range(COEFFICIENTS):
        total += scratch[SH + k] * scratch[ROW + c * COEFFICIENTS + k]
    return total


def colour(field, place, p, d, scratch, memory, at):
    """See loops.py; keeps nothing: SH and their sum do without what was between."""
    real = field.params.dtype.type
    for r in range(WIDTH):
        scratch[ROW + r] = 0
    for q in range(8):
        vertex, weight = corner(field, place, q)
        add_scaled(WIDTH, scratch, np.uint64(ROW), real(weight), field.params, row_of(field, vertex))
    return (
        float(sigmoid(logit(scratch, 0))),
        float(sigmoid(logit(scratch, 1))),
        float(sigmoid(logit(scratch, 2))),
    )


def backward(field, place, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad):
    """See loops.py."""
    real = field.params.dtype.type
    if shaded:
        for c in range(3):
            d_logit = d_rgb[c] * rgb[c] * (1 - rgb[c])
            for k in range(COEFFICIENTS):
                scratch[D_ROW + c * COEFFICIENTS + k] = real(d_logit * scratch[SH + k])
        for q in range(8):
            vertex, weight = corner(field, place, q)
            scatter(WIDTH, grad, row_of(field, vertex), real(weight), scratch, np.uint64(D_ROW))
    density_backward(field, place, pre, d_sigma, grad)


def density_backward(field, place, pre, d_sigma, grad):
    """Adjoint of `density`."""
    d_f = d_sigma * field.density[0] * sigmoid(pre + field.density[1])
    if d_f != 0:
        for q in range(8):
            vertex, weight = corner(field, place, q)
            accumulate(grad, vertex, field.params.dtype.type(weight * d_f))


def ahead_density(field, array, held, p):
    """Ask for the four pairs of vertices around a point."""
    place, _ = place_of(field, p)
    for q in range(0, 8, 2):
        prefetch(array, corner(field, place, q)[0])


def ahead_colour(field, array, held, p):
    """Ask for the rows of the eight vertices around a point."""
    place, _ = place_of(field, p)
    for q in range(8):
        prefetch(array, row_of(field, corner(field, place, q)[0]))
