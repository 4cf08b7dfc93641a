"""The scalar functions of splats for the loops (kernels/loops.py): density and colour of Gaussians as seen
along a ray.

With u = W (x - μ) and v = W d, W = S⁻¹ Rᵀ the map that makes a splat a sphere of unit variance, a ray passes
it at the distance |u × v| / |v|, where splatting (Kerbl et al. 2023) gives it the opacity
α = o exp(-|u × v|² / 2 |v|²). Its optical depth -ln(1 - α) is spread along the ray as the Gaussian is, and
by a tent of half the width Δ: with s = u·v / |v|, w = Δ |v| and Ψ'' the density of the normal distribution,
x has (Ψ(s + w) - 2 Ψ(s) + Ψ(s - w)) / (w Δ) of it for a unit of length. So the samples of a ray, Δ apart,
have all of it together, wherever they lie and however thin the splat is, and nearer ones nearly so."""

import math
from typing import NamedTuple

import numpy as np

from fusedrf_cli.engine.kernels.primitives import sh_basis

KEPT_SPLATS = 64  # of a sample, whose densities wait for its colour
TABLE = 2048  # entries of Ψ over [-EDGE, EDGE]; linear between them it is right to 1e-6
EDGE = 4.0
ROW = 16  # numbers of a splat beside its colour: μ (3), W (9), o, the largest |u × v|² / |v|², and two more
MOST_OPAQUE = 0.99  # as splatting has it
KEPT_AT = 16  # of scratch, behind the harmonics: how many, the point, the direction, numbers and densities
REACH = 3.3  # standard deviations along the ray, within which all but a thousandth of the depth lies


class Arrays(NamedTuple):
    """What the functions read."""

    params: object  # (P,) float, the rows of ROW, then those of 3 COEFFICIENTS
    colours: object  # int64, where those begin
    first: object  # (cells + 1,) int64, where the splats of a cell begin in `members`
    members: object  # (M,) int32
    lo: object  # (3,) float64, the lower corner of the cells
    cell: object  # (3,) float64
    counts: object  # (3,) int64
    length: object  # float, Δ
    table: object  # (TABLE + 1,) float, Ψ(x) = x Φ(x) + φ(x)


def sizes(field) -> dict[str, int]:
    """The constants of the namespace."""
    return {"COEFFICIENTS": field.coefficients, "SCRATCH": 24 + 2 * KEPT_SPLATS, "KEPT": 0, "SHADING_COST": 8}


# -- compiled ------------------------------------------------------------------------------------------------


def ramp(field, x):
    """Ψ(x), which is 0 and then x but around 0."""
    real = field.params.dtype.type
    if abs(x) >= real(EDGE):
        return max(x, real(0))
    at = (x + real(EDGE)) * real(TABLE / (2 * EDGE))
    i = min(int(at), TABLE - 1)
    below = field.table[i]
    return below + (at - real(i)) * (field.table[i + 1] - below)


def cell_number(field, p):
    """The cell that a point lies in, or -1."""
    i = math.floor((p[0] - field.lo[0]) / field.cell[0])
    j = math.floor((p[1] - field.lo[1]) / field.cell[1])
    k = math.floor((p[2] - field.lo[2]) / field.cell[2])
    nx, ny, nz = field.counts[0], field.counts[1], field.counts[2]
    if 0 <= i < nx and 0 <= j < ny and 0 <= k < nz:
        return (int(i) * ny + int(j)) * nz + int(k)
    return -1


def density_of(field, splat, p, d):
    """σ of one splat."""
    row, params, real = np.uint64(splat) * np.uint64(ROW), field.params, field.params.dtype.type
    x, y, z = (
        real(p[0] - params[row]),
        real(p[1] - params[row + np.uint64(1)]),
        real(p[2] - params[row + np.uint64(2)]),
    )
    dx, dy, dz = real(d[0]), real(d[1]), real(d[2])
    w = row + np.uint64(3)
    u0 = params[w] * x + params[w + np.uint64(1)] * y + params[w + np.uint64(2)] * z
    v0 = params[w] * dx + params[w + np.uint64(1)] * dy + params[w + np.uint64(2)] * dz
    w += np.uint64(3)
    u1 = params[w] * x + params[w + np.uint64(1)] * y + params[w + np.uint64(2)] * z
    v1 = params[w] * dx + params[w + np.uint64(1)] * dy + params[w + np.uint64(2)] * dz
    w += np.uint64(3)
    u2 = params[w] * x + params[w + np.uint64(1)] * y + params[w + np.uint64(2)] * z
    v2 = params[w] * dx + params[w + np.uint64(1)] * dy + params[w + np.uint64(2)] * dz
    c0, c1, c2 = u1 * v2 - u2 * v1, u2 * v0 - u0 * v2, u0 * v1 - u1 * v0
    vv = v0 * v0 + v1 * v1 + v2 * v2
    apart = c0 * c0 + c1 * c1 + c2 * c2
    if apart > params[row + np.uint64(13)] * vv:
        return real(0)
    v = math.sqrt(vv)
    s, wide = (u0 * v0 + u1 * v1 + u2 * v2) / v, field.length * v
    if abs(s) - wide > real(REACH):
        return real(0)
    alpha = min(params[row + np.uint64(12)] * math.exp(real(-0.5) * apart / vv), real(MOST_OPAQUE))
    share = ramp(field, s + wide) - real(2) * ramp(field, s) + ramp(field, s - wide)
    return real(-math.log(real(1) - alpha) * share / (wide * field.length))


def is_kept(scratch, p, d):
    """Whether the densities that were kept are those of a point along a direction."""
    same = True
    for a in range(3):
        same &= scratch[KEPT_AT + 1 + a] == scratch.dtype.type(p[a])
        same &= scratch[KEPT_AT + 4 + a] == scratch.dtype.type(d[a])
    return same


def density(field, grid, index, p, d, scratch):
    """See loops.py."""
    number = cell_number(field, p)
    if number < 0:
        return 0.0, 0.0, 0, 0
    total, count = 0.0, 0
    for m in range(field.first[number], field.first[number + 1]):
        sigma = density_of(field, field.members[m], p, d)
        if sigma > 0:
            total += sigma
            if count < KEPT_SPLATS:
                scratch[KEPT_AT + 8 + 2 * count] = m - field.first[number]
                scratch[KEPT_AT + 9 + 2 * count] = sigma
            count += 1
    scratch[KEPT_AT] = count if count <= KEPT_SPLATS else -1
    for a in range(3):
        scratch[KEPT_AT + 1 + a], scratch[KEPT_AT + 4 + a] = p[a], d[a]
    return total, 0.0, 1, number


def pack_cell(cell):
    """See loops.py."""
    return cell


def ray_setup(field, d, scratch):
    """See loops.py: the harmonics of the direction."""
    sh_basis(COEFFICIENTS, d, scratch, 0)


def add_colour(field, splat, sigma, scratch):
    """σ times the colour of a splat."""
    row = np.uint64(field.colours) + np.uint64(splat) * np.uint64(3 * COEFFICIENTS)
    half = field.params.dtype.type(0.5)
    r, g, b = half, half, half
    for k in range(np.uint64(COEFFICIENTS)):
        r += scratch[k] * field.params[row + np.uint64(3) * k]
        g += scratch[k] * field.params[row + np.uint64(3) * k + np.uint64(1)]
        b += scratch[k] * field.params[row + np.uint64(3) * k + np.uint64(2)]
    return sigma * max(r, 0.0), sigma * max(g, 0.0), sigma * max(b, 0.0)


def colour(field, number, p, d, scratch, memory, at):
    """See loops.py: the mean of the colours by density, which may still be known."""
    red, green, blue, total = 0.0, 0.0, 0.0, 0.0
    first = field.first[number]
    if scratch[KEPT_AT] >= 0 and is_kept(scratch, p, d):
        for n in range(int(scratch[KEPT_AT])):
            sigma = scratch[KEPT_AT + 9 + 2 * n]
            splat = field.members[first + int(scratch[KEPT_AT + 8 + 2 * n])]
            r, g, b = add_colour(field, splat, sigma, scratch)
            red, green, blue, total = red + r, green + g, blue + b, total + sigma
    else:
        for m in range(first, field.first[number + 1]):
            sigma = density_of(field, field.members[m], p, d)
            if sigma > 0:
                r, g, b = add_colour(field, field.members[m], sigma, scratch)
                red, green, blue, total = red + r, green + g, blue + b, total + sigma
    return (red / total, green / total, blue / total) if total > 0.0 else (0.0, 0.0, 0.0)


def backward(field, cell, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad):
    """Splats are imported, and do not learn."""
