"""Contraction of all of space by the Euclidean norm (curved.py): x → (2 - 1/|x|) x/|x| outside the unit ball
(Mip-NeRF 360, Barron et al. 2022, eq. 10), and with SHELL < 1 that of DVGO's unbounded scenes.

A ray is told by its distance b from the origin and by τ, its length from the point there: |x|² = b² + τ².
Outside the ball it moves in the coordinates, with B = SHELL, by
    √(B² τ² + b² ((1 + B) |x| - B)²) / |x|³ <= c / (b² + τ²),  c = √(B² + (1 + B)² b²)
for a unit of τ, and the integral of that bound is t_local: from τ0 on, with q = tan(t_local b / c) / b,
    τ(t_local) = (τ0 + b² q) / (1 - τ0 q).

With the density OUTWARD all of the space but the ball is a stack of spheres, as behind a scene of Plenoxels:
σ is per unit of 1/|x| (by SHELL), on a ray's way out alone, times the length of a unit of the frame that way.
"""

import math

import torch

from fusedrf_cli.engine.kernels.primitives import FARTHEST, along
from fusedrf_cli.engine.spaces import curved
from fusedrf_cli.engine.spaces.curved import (  # noqa: F401
    CONTRACTED_DENSITY,
    CURVED,
    SHELL,
    clearance,
    contracted_by,
    density_rates_by,
    depth_per_coordinate,
    frame_point,
    next_change,
    next_sample,
    optical_length,
    placed_by,
    point,
    position_at,
    rates_by,
    scale_of,
    size_before,
)
from fusedrf_cli.engine.spaces.unbounded import (  # noqa: F401
    FAR,
    LEARN_FROM,
    LOOK_AT_BOX,
    REST_FROM,
    SHARED_COLOUR_FROM,
    WHOLE,
    picture_step,
)

PIECES = 3  # up to the ball, or to where the ray is nearest to the origin; in the ball; behind it
OUTWARD = 2.0  # of CONTRACTED_DENSITY: σ is per growth of |coordinates| along a ray, where they grow (svox2)
UNIT_X = UNIT_Y = UNIT_Z = 1.0  # of the frame's axes, by the length that σ is per where it is OUTWARD
CONSTANTS = curved.CONSTANTS | {"contracted_density": (0.0, OUTWARD)}
CONSTANTS |= {f"unit_{axis}": (0.01, 100.0) for axis in "xyz"}
INWARDS, INSIDE, OUTWARDS, BEYOND = 0, 1, 2, 3  # regions of a ray, in order


def size_of(p):
    """The Euclidean norm."""
    return math.sqrt(p[0] * p[0] + p[1] * p[1] + p[2] * p[2])


def rate(q, d):
    """See bounded.py."""
    m = size_of(q)
    if m <= 1.0:
        return 0.0 if CONTRACTED_DENSITY == OUTWARD else 1.0
    if CONTRACTED_DENSITY == 0.0:
        return 1.0
    n, out = size_before(m), (q[0] * d[0] + q[1] * d[1] + q[2] * d[2]) / m
    if CONTRACTED_DENSITY == OUTWARD:
        length = size_of((UNIT_X * d[0], UNIT_Y * d[1], UNIT_Z * d[2]))
        return SHELL * max(out, 0.0) / (n * n) * length
    across = scale_of(n) * n * n
    return math.sqrt(SHELL * SHELL * out * out + max(1.0 - out * out, 0.0) * across * across) / (n * n)


def nearest(o, d):
    """Of a ray, d of any length: the t at which it is nearest to the origin, how near (b), the length of d,
    and where in τ the unit ball and the ball of radius FAR end, 0 where it does not come there."""
    speed = size_of(d)
    middle = -(o[0] * d[0] + o[1] * d[1] + o[2] * d[2]) / (speed * speed)
    b = max(size_of(along(o, d, middle)), 1e-9)  # which is divided by
    return middle, b, speed, math.sqrt(max(1.0 - b * b, 0.0)), math.sqrt(max(FAR * FAR - b * b, 0.0))


def first_piece_at(o, d, t):
    """See bounded.py; the region at t comes with it."""
    middle, _, speed, edge, _ = nearest(o, d)
    tau = (t - middle) * speed
    return t, INWARDS if tau < -edge else (INSIDE if tau < edge else OUTWARDS)


def next_piece(piece_begin, grid, o, d, far):
    """See bounded.py; `warp` is (t and τ where it begins; b; b / c, or 0 inside; length in t_local; 1 /
    |d|)."""
    t0, region = piece_begin
    middle, b, speed, edge, last = nearest(o, d)
    low = -last if region == INWARDS else (-edge if region == INSIDE else edge)
    high = -edge if region == INWARDS else (edge if region == INSIDE else last)
    following = max(middle + high / speed, t0), min(region + 1, BEYOND)
    low, high = max((t0 - middle) * speed, low), min((min(far, FARTHEST) - middle) * speed, high)
    per, length = 0.0, high - low
    if region != INSIDE:
        per = b / math.sqrt(SHELL * SHELL + (1.0 + SHELL) * (1.0 + SHELL) * b * b)
        length = math.atan2(b * (high - low), b * b + low * high) / per
    if region == BEYOND or high <= low:
        length = -1.0
    warp = middle, low, b, per, length, 1.0 / speed
    return (o, (d, warp), 0.0, length, warp), following


def piece(number, grid, o, d, near, far):
    """See bounded.py."""
    piece_begin = first_piece_at(o, d, near)
    for _ in range(number):
        piece_begin = next_piece(piece_begin, grid, o, d, far)[1]
    return next_piece(piece_begin, grid, o, d, far)[0]


def distance(warp, t_local):
    """The distance t along the ray, in the field's frame."""
    middle, low, b, per, _, slow = warp
    if per == 0.0:
        return middle + (low + t_local) * slow
    q = math.tan(t_local * per) / b
    return middle + (low + b * b * q) / (1.0 - low * q) * slow


def length_at(warp, t):
    """See bounded.py."""
    middle, low, b, per, length, slow = warp
    tau = max((t - middle) / slow, low)
    if per == 0.0:
        return min(tau - low, length)
    return min(math.atan2(b * (tau - low), b * b + low * tau) / per, length)


def slope(warp, t_local):
    """The derivative of `distance`."""
    middle, _, b, per, _, slow = warp
    tau = (distance(warp, t_local) - middle) / slow
    return slow if per == 0.0 else (b * b + tau * tau) * slow * per / b


def ends_of(warp, t_local, length):
    """From and to which t_local of a piece a length of t_local around `t_local` stands; where there is less
    than another such length before or behind it in the piece, that is its own too."""
    low, high = t_local - 0.5 * length, t_local + 0.5 * length
    return 0.0 if t_local < length else low, warp[4] if t_local + length >= warp[4] else high


def interval(warp, t_local, length):
    """See bounded.py."""
    low, high = ends_of(warp, t_local, length)
    return distance(warp, low), distance(warp, high)


def span(warp, t_local, length):
    """See bounded.py."""
    low, high = interval(warp, t_local, length)
    return high - low


def most_samples(aabb, step: float) -> int:
    """See bounded.py: outside the ball pieces are longest where b = 1."""
    return int((2 + math.pi * math.hypot(SHELL, 1 + SHELL)) / step) + 2 * PIECES


def contract(points: torch.Tensor) -> torch.Tensor:
    """`point` of each of points (N, 3), differentiable."""
    return contracted_by(points, points.norm(dim=1, keepdim=True), SHELL)


def inv_contract(points: torch.Tensor) -> torch.Tensor:
    """`frame_point` of each of coordinates (N, 3), differentiable."""
    return placed_by(points, points.norm(dim=1, keepdim=True), SHELL, FAR)


def rates(points: torch.Tensor) -> torch.Tensor:
    """See bounded.py."""
    return rates_by(points.norm(dim=1), SHELL, FAR)


def density_rates(points: torch.Tensor, dirs: torch.Tensor) -> torch.Tensor:
    """See bounded.py."""
    if not CONTRACTED_DENSITY:
        return points.new_ones(len(points))
    x = inv_contract(points)
    n = x.norm(dim=1, keepdim=True)
    growth = (x * dirs).sum(1, keepdim=True) / n.clamp_min(1)
    if CONTRACTED_DENSITY == OUTWARD:
        u, v, w = dirs.unbind(1)
        length = torch.stack([UNIT_X * u, UNIT_Y * v, UNIT_Z * w]).norm(dim=0)
        return length * torch.where(n > 1, SHELL * growth.clamp_min(0) / n.clamp_min(1) ** 2, 0).squeeze(1)
    return density_rates_by(x, dirs, n, growth, SHELL)
