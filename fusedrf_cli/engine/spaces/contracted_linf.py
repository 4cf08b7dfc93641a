"""Contraction of all of space by the largest coordinate (curved.py): x → (2 - 1/n) x/n with n = max |x_i|
outside the cube n <= 1 (nerfstudio's SceneContraction of order ∞), and with SHELL < 1 that of DVGO's
unbounded scenes. It differs from `unbounded` in that the other coordinates are not x_j / n.

A ray is cut into the pieces of unbounded.py, but is curved outside the cube. There n and x change evenly
along a piece, and with B = SHELL and the constants κ_j = n d_j - n' x_j it moves in the coordinates by
    (B d_j + (1 + B - 2 B / n) κ_j) / n²
for a unit of t; the length of that times n² is largest at one of the two ends, and with this speed t_local
goes.
"""

import math

import torch

from fusedrf_cli.engine.kernels.primitives import along
from fusedrf_cli.engine.spaces.curved import (  # noqa: F401
    CONSTANTS,
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
    CORE,
    FAR,
    LEARN_FROM,
    LOOK_AT_BOX,
    NOWHERE,
    PIECES,
    REST_FROM,
    SHARED_COLOUR_FROM,
    WHOLE,
    distance,
    first_piece_at,
    interval,
    leaving,
    length_at,
    picture_step,
    piece,
    region_at,
    share_of,
    size_in,
    size_of,
    span,
)


def speed_in(region, o, d, n):
    """How far, times n², a ray moves in the coordinates for a unit of t where it is in a slab at n."""
    size, growth, twist = size_in(region, o), size_in(region, d), 1.0 + SHELL - 2.0 * SHELL / n
    x = SHELL * d[0] + twist * (size * d[0] - growth * o[0])
    y = SHELL * d[1] + twist * (size * d[1] - growth * o[1])
    z = SHELL * d[2] + twist * (size * d[2] - growth * o[2])
    return math.sqrt(x * x + y * y + z * z)


def rate(q, d):
    """See bounded.py."""
    if CONTRACTED_DENSITY == 0.0:
        return 1.0
    p = frame_point(q)
    n = size_of(p)
    return 1.0 if n <= 1.0 else speed_in(region_at(p, d, 0.0), p, d, n) / (n * n)


def next_piece(piece_begin, grid, o, d, far):
    """See bounded.py; `warp` is (t0, t1 - t0, n0, n1, 1 / length in t_local)."""
    t0, region = piece_begin
    t1, after = t0, NOWHERE
    if region != NOWHERE and t0 < far:
        t1, after = leaving(region, o, d, t0)
    following = t1, after
    t1 = min(t1, far)
    n0, n1, speed = 1.0, 1.0, math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    if region > CORE:
        n0, n1 = max(size_in(region, along(o, d, t0)), 1.0), max(size_in(region, along(o, d, t1)), 1.0)
        speed = max(speed_in(region, o, d, n0), speed_in(region, o, d, n1))
    length = speed * (t1 - t0) / (n0 * n1)
    if region == NOWHERE or length <= 0.0 or not n0 < FAR:
        warp = t0, 0.0, 1.0, 1.0, 1.0
        return (o, (d, warp), 0.0, -1.0, warp), following
    warp = t0, t1 - t0, n0, n1, 1.0 / length
    return (o, (d, warp), 0.0, length, warp), following


def slope(warp, t_local):
    """The derivative of `distance`."""
    _, length, n0, n1, per = warp
    n = t_local * per * n0 + (1.0 - t_local * per) * n1
    return length * per * n0 * n1 / (n * n)


def ends_of(warp, t_local, length):
    """From and to which t_local of a piece a length of t_local around `t_local` stands, see `share_of`."""
    low, high = share_of(warp, t_local, length)
    return low / warp[4], high / warp[4]


def most_samples(aabb, step: float) -> int:
    """See bounded.py: in a slab |κ_j| (t1 - t0) / (n0 n1) is at most 2 for two j, and 0 for the third;
    t1 - t0 at most √3 (n0 + n1)."""
    slab = SHELL * 2 * math.sqrt(3) + (1 + SHELL) * 2 * math.sqrt(2)
    return int((2 * math.sqrt(3) + slab * (PIECES - 1)) / step) + 2 * PIECES


def contract(points: torch.Tensor) -> torch.Tensor:
    """`point` of each of points (N, 3), differentiable."""
    return contracted_by(points, points.abs().amax(1, keepdim=True), SHELL)


def inv_contract(points: torch.Tensor) -> torch.Tensor:
    """`frame_point` of each of coordinates (N, 3), differentiable."""
    return placed_by(points, points.abs().amax(1, keepdim=True), SHELL, FAR)


def rates(points: torch.Tensor) -> torch.Tensor:
    """See bounded.py."""
    return rates_by(points.abs().amax(1), SHELL, FAR)


def density_rates(points: torch.Tensor, dirs: torch.Tensor) -> torch.Tensor:
    """See bounded.py."""
    if not CONTRACTED_DENSITY:
        return points.new_ones(len(points))
    x = inv_contract(points)
    n, axis = x.abs().max(1, keepdim=True)
    return density_rates_by(x, dirs, n, dirs.gather(1, axis) * x.gather(1, axis).sign(), SHELL)
