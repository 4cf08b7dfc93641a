"""Scalar bodies of the `cp` kind: sums of products of three lines (CP decomposition; TensoRF, eq. 3 and 4).

With u the point in the unit cube of the field's box:
    f(u) = Σ_r X_r(u_x) Y_r(u_y) Z_r(u_z), lines linear between texels;  σ = scale softplus(f + shift)
    rgb_c = sigmoid(Σ_r F_r(u) Σ_k SH_k(d) B[c, k, r]), F_r the colour's own products
RANK and COLOUR are the components of density and colour, COEFFICIENTS the spherical harmonics per channel.
"""

from typing import NamedTuple

import numpy as np

from fusedrf_cli.engine.kernels.parts import (
    add_scaled,
    dot,
    linear,
    scatter,
    sh_basis,
    sigmoid,
    softplus,
    store_8,
    texel,
)

EDGE = 1e-9  # share of a box by which rounding may put a point on its face outside


class Arrays(NamedTuple):
    """What the kernels read of a cp field."""

    params: object  # (P,) float: lines x, y, z of density, lines x, y, z of colour, colour basis
    sections: object  # (7,) int64, where these begin in params
    resolution: object  # (3,) int64, texels per axis, corners on the faces of the box
    lo: object  # (3,) float64, lower corner of the box
    side: object  # (3,) float64, its sides
    density: object  # (2,) float, scale (1/length) and shift of the softplus


def sizes(field):
    """Constants of the namespace; scratch holds the folded basis, its gradient, SH, the gradient of a
    feature vector, and those of three lines."""
    shape = field.shape
    rank, colour, widest = shape.density_rank, shape.colour_rank, max(shape.density_rank, shape.colour_rank)
    start = 6 * colour + 16
    return {
        "RANK": rank, "COLOUR": colour, "COEFFICIENTS": shape.coefficients, "BASIS": 0, "D_BASIS": 3 * colour,
        "SH": 6 * colour, "D_FEATURES": start, "D_LINES": start + widest, "SCRATCH": start + 4 * widest,
        "KEPT": colour,
    }  # fmt: skip


def place_of(field, p):
    """The point in the unit cube of the box, and whether it lies inside."""
    real = field.params.dtype.type
    u, v = (p[0] - field.lo[0]) / field.side[0], (p[1] - field.lo[1]) / field.side[1]
    w = (p[2] - field.lo[2]) / field.side[2]
    inside = min(u, min(v, w)) >= -EDGE and max(u, max(v, w)) <= 1 + EDGE
    return (real(u), real(v), real(w)), inside


def texels_of(count, field, section, axis, place):
    """Where the lower and the upper texel around a place begin on the line of an axis, `count` numbers each,
    and the share of the upper."""
    i, share = texel(field.params, place[axis], field.resolution[axis])
    lower = np.uint64(field.sections[section + axis] + i * count)
    return lower, lower + np.uint64(count), share


def lines_of(count, field, section, place):
    """`texels_of` on each of the three axes, for the section that begins with the line of x."""
    x, y = texels_of(count, field, section, 0, place), texels_of(count, field, section, 1, place)
    return x, y, texels_of(count, field, section, 2, place)


def factors(params, lines, first, i):
    """X_r, Y_r and Z_r between the texels of three lines, r the i-th component from the first on."""
    (x, y, z), r = lines, first + np.uint64(i)
    on_x, on_y = linear(params, x[0], x[1], x[2], r), linear(params, y[0], y[1], y[2], r)
    return on_x, on_y, linear(params, z[0], z[1], z[2], r)


def product(params, lines, first, i):
    """X_r Y_r Z_r; see `factors`."""
    x, y, z = factors(params, lines, first, i)
    return x * y * z


def density(field, grid, k, p, d, scratch):
    """See loops.py; the place is the point in the unit cube."""
    place, inside = place_of(field, p)
    if not inside:
        return 0.0, 0.0, 0, place
    lines, f = lines_of(RANK, field, 0, place), field.params.dtype.type(0)
    for r in range(np.uint64(RANK)):
        f += product(field.params, lines, r, 0)
    return float(field.density[0] * softplus(f + field.density[1])), float(f), 1, place


def again(field, held, p):
    """See loops.py."""
    return place_of(field, p)[0]


def begin(field, frame, d, scratch):
    """Fold SH into the colour basis: scratch[BASIS + c COLOUR + r] = Σ_k SH_k(d) B[c, k, r]."""
    sh_basis(COEFFICIENTS, d, scratch, SH)
    start = np.uint64(field.sections[6])
    for c in range(3):
        row = np.uint64(BASIS + c * COLOUR)
        for r in range(np.uint64(COLOUR)):
            scratch[row + r] = 0
        for k in range(COEFFICIENTS):
            source = start + np.uint64((c * COEFFICIENTS + k) * COLOUR)
            add_scaled(COLOUR, scratch, row, scratch[SH + k], field.params, source)


def end(field, frame, d, scratch, grad):
    """Adjoint of `begin`: scatters what lies in D_BASIS and clears it."""
    start = np.uint64(field.sections[6])
    for c in range(3):
        row = np.uint64(D_BASIS + c * COLOUR)
        for k in range(COEFFICIENTS):
            target = start + np.uint64((c * COEFFICIENTS + k) * COLOUR)
            scatter(COLOUR, grad, target, scratch[SH + k], scratch, row)
        for r in range(np.uint64(COLOUR)):
            scratch[row + r] = 0


def colour(field, place, p, d, scratch, memory, at):
    """See loops.py; keeps the colour's products."""
    lines, params, features = lines_of(COLOUR, field, 3, place), field.params, np.uint64(at)
    for tile in range(np.uint64(COLOUR // 8)):
        r = tile * np.uint64(8)
        e0, e1, e2 = product(params, lines, r, 0), product(params, lines, r, 1), product(params, lines, r, 2)
        e3, e4, e5 = product(params, lines, r, 3), product(params, lines, r, 4), product(params, lines, r, 5)
        e6, e7 = product(params, lines, r, 6), product(params, lines, r, 7)
        store_8(memory, features + r, e0, e1, e2, e3, e4, e5, e6, e7)
    red = dot(COLOUR, scratch, np.uint64(BASIS), memory, features)
    green = dot(COLOUR, scratch, np.uint64(BASIS + COLOUR), memory, features)
    blue = dot(COLOUR, scratch, np.uint64(BASIS + 2 * COLOUR), memory, features)
    return float(sigmoid(red)), float(sigmoid(green)), float(sigmoid(blue))


def sent_on(params, lines, scratch, first, i):
    """What the gradient of a product, scratch[D_FEATURES + r], sends to its factors; see `factors`."""
    x, y, z = factors(params, lines, first, i)
    sent = scratch[np.uint64(D_FEATURES) + first + np.uint64(i)]
    return sent * y * z, sent * x * z, sent * x * y


def scatter_products(count, field, section, place, scratch, grad):
    """Adjoint of the products of a section: scratch[D_FEATURES:] is their gradient."""
    params, lines = field.params, lines_of(count, field, section, place)
    for tile in range(np.uint64(count // 8)):
        r = tile * np.uint64(8)
        g0, g1 = sent_on(params, lines, scratch, r, 0), sent_on(params, lines, scratch, r, 1)
        g2, g3 = sent_on(params, lines, scratch, r, 2), sent_on(params, lines, scratch, r, 3)
        g4, g5 = sent_on(params, lines, scratch, r, 4), sent_on(params, lines, scratch, r, 5)
        g6, g7 = sent_on(params, lines, scratch, r, 6), sent_on(params, lines, scratch, r, 7)
        for a in range(3):
            line = np.uint64(D_LINES + a * count) + r
            store_8(scratch, line, g0[a], g1[a], g2[a], g3[a], g4[a], g5[a], g6[a], g7[a])
    for a in range(3):
        lower, upper, share = lines[a]
        line = np.uint64(D_LINES + a * count)
        scatter(count, grad, lower, params.dtype.type(1) - share, scratch, line)
        scatter(count, grad, upper, share, scratch, line)


def backward(field, place, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad):
    """See loops.py."""
    real = field.params.dtype.type
    if shaded:
        for r in range(np.uint64(COLOUR)):
            scratch[np.uint64(D_FEATURES) + r] = 0
        for c in range(3):
            d_logit, row = real(d_rgb[c] * rgb[c] * (1 - rgb[c])), np.uint64(c * COLOUR)
            add_scaled(COLOUR, scratch, np.uint64(D_FEATURES), d_logit, scratch, np.uint64(BASIS) + row)
            add_scaled(COLOUR, scratch, np.uint64(D_BASIS) + row, d_logit, memory, np.uint64(at))
        scatter_products(COLOUR, field, 3, place, scratch, grad)
    d_f = real(d_sigma * field.density[0] * sigmoid(pre + field.density[1]))
    if d_f != 0:
        for r in range(np.uint64(RANK)):
            scratch[np.uint64(D_FEATURES) + r] = d_f
        scatter_products(RANK, field, 0, place, scratch, grad)
