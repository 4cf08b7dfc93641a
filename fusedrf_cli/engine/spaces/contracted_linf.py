"""Contraction of all of space by the largest coordinate (curved.py): x → (2 - 1/n) x/n with n = max |x_i|
outside the cube n <= 1 (nerfstudio's SceneContraction of order ∞), and with SHELL < 1 that of DVGO's
unbounded scenes. It differs from `unbounded` in that the other coordinates are not x_j / n. Before, each
coordinate may be multiplied by a STRETCH of its own (K-Planes' global_scale), which is not the placement's: σ
and directions stay those of the frame.

A ray is cut into the pieces of unbounded.py, but is curved outside the cube. There n and x change evenly
along a piece, and with B = SHELL and the constants κ_j = n d_j - n' x_j it moves in the coordinates by
    (B d_j + (1 + B - 2 B / n) κ_j) / n²
for a unit of t; the length of that times n² is largest at one of the two ends, and with this speed t_local
goes.
"""

import math

import torch

from fusedrf_cli.engine.kernels.primitives import along
from fusedrf_cli.engine.spaces import curved
from fusedrf_cli.engine.spaces.curved import (  # noqa: F401
    CONTRACTED_DENSITY,
    CURVED,
    SHELL,
    clearance,
    contracted_by,
    density_rates_by,
    next_change,
    next_sample,
    optical_length,
    placed_by,
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
    interval,
    leaving,
    length_at,
    picture_step,
    region_at,
    share_of,
    size_in,
    size_of,
    span,
)

STRETCH_X = STRETCH_Y = STRETCH_Z = 1.0
CONSTANTS = curved.CONSTANTS | {f"stretch_{axis}": (0.01, 100.0) for axis in "xyz"}


def stretched(v):
    """A point or a direction of the frame, stretched."""
    return STRETCH_X * v[0], STRETCH_Y * v[1], STRETCH_Z * v[2]


def point(p):
    """See bounded.py."""
    x = stretched(p)
    n = size_of(x)
    s = scale_of(n) if n > 1.0 else 1.0
    return x[0] * s, x[1] * s, x[2] * s


def frame_point(q):
    """Inverse of `point`; what lies beyond FAR comes back at FAR."""
    m = size_of(q)
    s = size_before(m) / m if m > 1.0 else 1.0
    return q[0] * s / STRETCH_X, q[1] * s / STRETCH_Y, q[2] * s / STRETCH_Z


def depth_per_coordinate(q):
    """See bounded.py: by the way out, and at most."""
    m = size_of(q)
    if CONTRACTED_DENSITY != 0.0:
        return 1.0
    least = min(STRETCH_X, min(STRETCH_Y, STRETCH_Z))
    return (size_before(m) ** 2 / SHELL if m > 1.0 else 1.0) / least


def first_piece_at(o, d, t):
    """See bounded.py; the region at t comes with it."""
    return t, region_at(stretched(o), stretched(d), t)


def speed_in(region, o, d, n):
    """How far, times n², a ray moves in the coordinates for a unit of t where it is in a slab at n; o and d
    are stretched."""
    size, growth, twist = size_in(region, o), size_in(region, d), 1.0 + SHELL - 2.0 * SHELL / n
    x = SHELL * d[0] + twist * (size * d[0] - growth * o[0])
    y = SHELL * d[1] + twist * (size * d[1] - growth * o[1])
    z = SHELL * d[2] + twist * (size * d[2] - growth * o[2])
    return math.sqrt(x * x + y * y + z * z)


def rate(q, d):
    """See bounded.py."""
    if CONTRACTED_DENSITY == 0.0:
        return 1.0
    p, d = stretched(frame_point(q)), stretched(d)
    n = size_of(p)
    if n <= 1.0:
        return math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])
    return speed_in(region_at(p, d, 0.0), p, d, n) / (n * n)


def next_piece(piece_begin, grid, o, d, far):
    """See bounded.py; `warp` is (t0, t1 - t0, n0, n1, 1 / length in t_local)."""
    t0, region = piece_begin
    t1, after = t0, NOWHERE
    x, v = stretched(o), stretched(d)
    if region != NOWHERE and t0 < far:
        t1, after = leaving(region, x, v, t0)
    following = t1, after
    t1 = min(t1, far)
    n0, n1, speed = 1.0, 1.0, math.sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2])
    if region > CORE:
        n0, n1 = max(size_in(region, along(x, v, t0)), 1.0), max(size_in(region, along(x, v, t1)), 1.0)
        speed = max(speed_in(region, x, v, n0), speed_in(region, x, v, n1))
    length = speed * (t1 - t0) / (n0 * n1)
    if region == NOWHERE or length <= 0.0 or not n0 < FAR:
        warp = t0, 0.0, 1.0, 1.0, 1.0
        return (o, (d, warp), 0.0, -1.0, warp), following
    warp = t0, t1 - t0, n0, n1, 1.0 / length
    return (o, (d, warp), 0.0, length, warp), following


def piece(number, grid, o, d, near, far):
    """See bounded.py."""
    piece_begin = first_piece_at(o, d, near)
    for _ in range(number):
        if piece_begin[1] != NOWHERE:
            piece_begin = leaving(piece_begin[1], stretched(o), stretched(d), piece_begin[0])
    return next_piece(piece_begin, grid, o, d, far)[0]


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
    points = torch.stack(stretched(points.unbind(1)), 1)
    return contracted_by(points, points.abs().amax(1, keepdim=True), SHELL)


def inv_contract(points: torch.Tensor) -> torch.Tensor:
    """`frame_point` of each of coordinates (N, 3), differentiable."""
    x, y, z = placed_by(points, points.abs().amax(1, keepdim=True), SHELL, FAR).unbind(1)
    return torch.stack([x / STRETCH_X, y / STRETCH_Y, z / STRETCH_Z], 1)


def rates(points: torch.Tensor) -> torch.Tensor:
    """See bounded.py."""
    m = points.abs().amax(1, keepdim=True)
    stretch = (placed_by(points, m, SHELL, FAR).norm(dim=1) / inv_contract(points).norm(dim=1)).nan_to_num(1)
    return rates_by(m[:, 0], SHELL, FAR) * stretch


def density_rates(points: torch.Tensor, dirs: torch.Tensor) -> torch.Tensor:
    """See bounded.py."""
    if not CONTRACTED_DENSITY:
        return points.new_ones(len(points))
    x = placed_by(points, points.abs().amax(1, keepdim=True), SHELL, FAR)
    dirs = torch.stack(stretched(dirs.unbind(1)), 1)
    n, axis = x.abs().max(1, keepdim=True)
    return density_rates_by(x, dirs, n, dirs.gather(1, axis) * x.gather(1, axis).sign(), SHELL)
