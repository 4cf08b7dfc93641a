"""The space of a field that fills everything: a core, which coordinates leave as it is, and around it all the
rest, drawn together.

With n = max |x_i| of a point of the field's frame, the core is n <= 1. Outside, the coordinate a with the
largest magnitude becomes ±(2 - 1/n) and the two others x_j / n (MERF, Reiser et al. 2023, eq. 3), so that
coordinates lie in [-2, 2]. In the core and in each of the six slabs around it straight lines stay straight
and planes flat, so that a ray is a few straight pieces (see bounded.py for what a space has).

A slab's part of a ray from (t0, n0) to (t1, n1) is a line of length L in coordinates; at t_local along it,
with s = t_local / L,
    t(t_local) = t0 + (t1 - t0) s n0 / (s n0 + (1 - s) n1),
and with r = (t - t0) / (t1 - t0)
    s(t) = r n1 / ((1 - r) n0 + r n1).
"""

import math

import numpy as np
import torch

from fusedrf_cli.engine.kernels.primitives import FARTHEST, along, hit_box

PIECES = 6  # a straight line meets at most five of the seven regions, and a sixth by rounding at an edge
STEP_PER_VOXEL = 0.9  # at most: a step of half a voxel shows the same (decision 001) in 1.5 times the time
FAR = 1e3  # n at which rays end
CORE, NOWHERE = 0, -1  # regions; 1 + 2 axis is the slab on the negative side of an axis, 2 + 2 axis the other
REACH = 2.0  # coordinates lie between -REACH and REACH
# See loops.py: a ray through a place has some hundred samples that weigh next to nothing.
LEARN_FROM, SHARED_COLOUR_FROM, REST_FROM = 3e-3, 1e-2, 1e-2
WHOLE = np.array([-REACH] * 3 + [REACH] * 3)
REGIONS = np.array(
    [[-1.0] * 3 + [1.0] * 3]
    + [
        [side if a == axis else -1 for a in range(3)] + [side + 1 if a == axis else 1 for a in range(3)]
        for axis in range(3)
        for side in (-2.0, 1.0)
    ]
)  # boxes (7, 6) of the coordinates, of each of which a ray has one piece
LOOK_AT_BOX = np.array([-0.6] * 3 + [0.6] * 3)  # of the core: what views of all of space look at
position_at = along


def size_of(p):
    """n of a point: the largest magnitude of a coordinate."""
    return max(abs(p[0]), max(abs(p[1]), abs(p[2])))


def point(p):
    """Where a point of the field's frame lies in the space's coordinates."""
    n = size_of(p)
    if n <= 1.0:
        return p
    x, y, z = p[0] / n, p[1] / n, p[2] / n
    end = 2.0 - 1.0 / n
    if abs(p[0]) == n:
        return x * end, y, z
    if abs(p[1]) == n:
        return x, y * end, z
    return x, y, z * end


def frame_point(q):
    """Inverse of `point`; what lies beyond FAR comes back at FAR."""
    m = size_of(q)
    if m <= 1.0:
        return q
    n = 1.0 / max(2.0 - m, 1.0 / FAR)
    x, y, z = q[0] * n, q[1] * n, q[2] * n
    if abs(q[0]) == m:
        return x / m, y, z
    if abs(q[1]) == m:
        return x, y / m, z
    return x, y, z / m


def rate(q, d):
    """How many units of the coordinates a unit of length of the frame is at `q`, radially: 1 / n²."""
    m = size_of(q)
    return 1.0 if m <= 1.0 else max(2.0 - m, 1.0 / FAR) ** 2


def depth_per_coordinate(q):
    """See bounded.py: what the numbers say of σ is per unit of the coordinates."""
    return 1.0


def region_at(o, d, t):
    """The region of the point at t of a ray, on a border either."""
    x, y, z = along(o, d, t)
    n = size_of((x, y, z))
    if n <= 1.0:
        return CORE
    if abs(x) == n:
        return 2 if x > 0.0 else 1
    if abs(y) == n:
        return 4 if y > 0.0 else 3
    return 6 if z > 0.0 else 5


def size_in(region, p):
    """n of a point (or, of a direction, its change) by the coordinate that a slab goes by."""
    c = p[0] if region < 3 else (p[1] if region < 5 else p[2])
    return -c if region % 2 == 1 else c


def leaving(region, o, d, t):
    """Where a ray that is in a region at t leaves it, and the region that it enters there."""
    end, after = FARTHEST, NOWHERE
    if region == CORE:
        for side in range(1, 7):
            speed = size_in(side, d)
            if speed > 0.0:
                at = (1.0 - size_in(side, o)) / speed
                if at < end:
                    end, after = at, side
        return max(end, t), after
    size, speed = size_in(region, o), size_in(region, d)
    if speed < 0.0:
        end, after = (1.0 - size) / speed, CORE
    if speed > 0.0:
        end = (FAR - size) / speed
    for side in range(1, 7):
        if (side - 1) // 2 != (region - 1) // 2:
            closing = speed - size_in(side, d)
            if closing < 0.0:
                at = (size_in(side, o) - size) / closing
                if at < end:
                    end, after = at, side
    return max(end, t), after


def first_piece_at(o, d, t):
    """See bounded.py; the region at t comes with it, or NOWHERE behind the last piece."""
    return t, region_at(o, d, t)


def next_piece(piece_begin, grid, o, d, far):
    """See bounded.py; `warp` is (t0, t1 - t0, n0, n1, 1 / L)."""
    t0, region = piece_begin
    t1, after = t0, NOWHERE
    if region != NOWHERE and t0 < far:
        t1, after = leaving(region, o, d, t0)
    else:
        region = NOWHERE
    following = t1, after
    t1 = min(t1, far)
    p0, p1 = along(o, d, t0), along(o, d, t1)
    n0, n1 = 1.0, 1.0
    if region > CORE:
        n0, n1 = max(size_in(region, p0), 1.0), max(size_in(region, p1), 1.0)
    q0, q1 = in_region(region, p0, n0), in_region(region, p1, n1)
    x, y, z = q1[0] - q0[0], q1[1] - q0[1], q1[2] - q0[2]
    length = math.sqrt(x * x + y * y + z * z)
    if region == NOWHERE or length <= 0.0 or not n0 < FAR:
        return (q0, d, 1.0, 0.0, (t0, 0.0, 1.0, 1.0, 1.0)), following
    direction = x / length, y / length, z / length
    t_begin, t_end = hit_box(q0, direction, grid.lo, grid.hi)
    return (q0, direction, t_begin, min(t_end, length), (t0, t1 - t0, n0, n1, 1.0 / length)), following


def piece(number, grid, o, d, near, far):
    """See bounded.py."""
    piece_begin = first_piece_at(o, d, near)
    for _ in range(number):
        if piece_begin[1] != NOWHERE:
            piece_begin = leaving(piece_begin[1], o, d, piece_begin[0])
    return next_piece(piece_begin, grid, o, d, far)[0]


def in_region(region, p, n):
    """The coordinates of a point whose region and n are known."""
    if region <= CORE:
        return p
    end = (2.0 - 1.0 / n) if region % 2 == 0 else (1.0 / n - 2.0)
    if region < 3:
        return end, p[1] / n, p[2] / n
    if region < 5:
        return p[0] / n, end, p[2] / n
    return p[0] / n, p[1] / n, end


def distance(warp, t_local):
    """The distance t along the ray, in the field's frame."""
    t0, length, n0, n1, per = warp
    s = t_local * per
    return t0 + length * s * n0 / (s * n0 + (1.0 - s) * n1)


def length_at(warp, t):
    """See bounded.py."""
    t0, length, n0, n1, per = warp
    r = min(max((t - t0) / length, 0.0), 1.0)
    return r * n1 / ((1.0 - r) * n0 + r * n1) / per


def share_of(warp, t_local, length):
    """From and to which share of a piece a length of t_local around `t_local` stands; where there is less
    than another such length before or behind it in the piece, that is its own too."""
    per = warp[4]
    s0, s1 = (t_local - 0.5 * length) * per, (t_local + 0.5 * length) * per
    s0 = 0.0 if (t_local - length) * per < 0.0 else s0
    s1 = 1.0 if (t_local + length) * per >= 1.0 else s1
    return s0, s1


def interval(warp, t_local, length):
    """See bounded.py."""
    s0, s1 = share_of(warp, t_local, length)
    return distance(warp, s0 / warp[4]), distance(warp, s1 / warp[4])


def span(warp, t_local, length):
    """How much of t a length of t_local around `t_local` stands for, see `share_of`. Exact, since far out t
    goes up manifold in one step."""
    _, whole, n0, n1, _ = warp
    s0, s1 = share_of(warp, t_local, length)
    return whole * n0 * n1 * (s1 - s0) / ((s0 * n0 + (1.0 - s0) * n1) * (s1 * n0 + (1.0 - s1) * n1))


def picture_step(voxel: float) -> float:
    """At which pictures sample a field with voxels of a size, so that a whole number of steps is as long as a
    slab is thick: a ray straight out then ends with a whole step. Where the last sample lies decides what it
    stands for, and where all rays ended with a short one, far floaters would show too little."""
    return 1 / math.ceil(1 / (STEP_PER_VOXEL * voxel))


def most_samples(aabb: np.ndarray, step: float) -> int:
    """How many samples a ray through a field of a box (6,) can have: a piece is at most 2 √3 long, in the
    core, or 3, in a slab."""
    return int((2 * math.sqrt(3) + 3.0 * (PIECES - 1)) / step) + 2 * PIECES


def contract(points: torch.Tensor) -> torch.Tensor:
    """`point` of each of points (N, 3), differentiable."""
    n, axis = points.abs().max(1, keepdim=True)
    outside = (points / n.clamp_min(1)).scatter(
        1, axis, points.gather(1, axis).sign() * (2 - 1 / n.clamp_min(1))
    )
    return torch.where(n > 1, outside, points)


def rates(points: torch.Tensor) -> torch.Tensor:
    """`rate` at each of coordinates (N, 3): (N,)."""
    most = points.abs().amax(1)
    return torch.where(most > 1, (2 - most).clamp_min(1 / FAR) ** 2, 1)


def density_rates(points: torch.Tensor, dirs: torch.Tensor) -> torch.Tensor:
    """(N,) `rate` at each of coordinates (N, 3)."""
    return rates(points)


def inv_contract(points: torch.Tensor) -> torch.Tensor:
    """`frame_point` of each of coordinates (N, 3), differentiable."""
    most, axis = points.abs().max(1, keepdim=True)
    n = 1 / (2 - most.clamp_min(1)).clamp_min(1 / FAR)
    outside = (points * n).scatter(1, axis, points.gather(1, axis).sign() * n)
    return torch.where(most > 1, outside, points)
