"""Distortion of a lens, and the ray of a pixel, as scalar functions for loops that know no kind of field."""

import math

from numba import njit

from fusedrf_cli.engine.kernels.primitives import device

strict = njit(error_model="numpy", cache=True, forceinline=True, _nrt=False)  # where NaN must stay NaN

NEWTON_STEPS = 50
NEWTON_NEAR = 1e-13  # focal lengths, or radians


@strict
def bend(u, v, distortion):
    """OpenCV's distortion of a lens: ideal normalised image coordinates (y down) to distorted ones (x, y),
    and the derivatives (x by u; x by v, which is that of y by u; y by v).

    distortion (9,) is k1, k2, k3, p1, p2, k4, d1, d2, d3. With r² = u² + v² the radial factor is
    (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) / (1 + d1 r² + d2 r⁴ + d3 r⁶); p1 and p2 are tangential. d1 to d3 are
    what OpenCV calls k4 to k6; k4 is here Metashape's.
    """
    k1, k2, k3, p1, p2, k4, d1, d2, d3 = distortion
    r2 = u * u + v * v
    over = 1 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)))
    under = 1 + r2 * (d1 + r2 * (d2 + r2 * d3))
    d_over = k1 + r2 * (2 * k2 + r2 * (3 * k3 + r2 * 4 * k4))
    d_under = d1 + r2 * (2 * d2 + r2 * 3 * d3)
    radial = over / under
    slope = 2 * (d_over - radial * d_under) / under  # twice the derivative of the factor by r²
    x = u * radial + 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    y = v * radial + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
    x_u = radial + u * u * slope + 2 * p1 * v + 6 * p2 * u
    x_v = u * v * slope + 2 * p1 * u + 2 * p2 * v
    y_v = radial + v * v * slope + 6 * p1 * v + 2 * p2 * u
    return (x, y), (x_u, x_v, y_v)


@strict
def unbend(x, y, distortion):
    """Inverse of `bend` by Newton steps, halved where one would lead away; where no ray reaches, the nearest
    that was found."""
    u, v, share = x, y, 1.0
    bent, slopes = bend(u, v, distortion)
    far = math.hypot(bent[0] - x, bent[1] - y)
    for _ in range(NEWTON_STEPS):
        if far < NEWTON_NEAR:
            break
        a, b, d = slopes
        dx, dy = x - bent[0], y - bent[1]
        # Never singular: a step along a fold of the lens is long, is seen to lead away, and is halved.
        area = a * d - b * b
        area = 1e-12 if abs(area) < 1e-12 else area
        next_u, next_v = u + share * (d * dx - b * dy) / area, v + share * (a * dy - b * dx) / area
        next_bent, next_slopes = bend(next_u, next_v, distortion)
        next_far = math.hypot(next_bent[0] - x, next_bent[1] - y)
        if next_far < far:
            u, v, bent, slopes, far = next_u, next_v, next_bent, next_slopes, next_far
            share = min(2.0 * share, 1.0)
        else:
            share = 0.5 * share
    return u, v


@device
def lens_ray(pose, fl_x, fl_y, cx, cy, distortion, bent, width, top, order, i, rays_o, rays_d):
    """The ray of pixel order[i]; see `lens_rays` in field_free.py."""
    row, column = order[i] // width, order[i] % width
    x, y = (column + 0.5 - cx) / fl_x, (top + row + 0.5 - cy) / fl_y
    if bent:
        x, y = unbend(x, y, distortion)
    y = -y
    dx = pose[0, 0] * x + pose[0, 1] * y - pose[0, 2]
    dy = pose[1, 0] * x + pose[1, 1] * y - pose[1, 2]
    dz = pose[2, 0] * x + pose[2, 1] * y - pose[2, 2]
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    rays_d[i, 0], rays_d[i, 1], rays_d[i, 2] = dx / length, dy / length, dz / length
    rays_o[i, 0], rays_o[i, 1], rays_o[i, 2] = pose[0, 3], pose[1, 3], pose[2, 3]
