"""What spaces share in which rays are curved: contractions x → (1 + B - B/n) x/n of all of space, with n the
size of a point x by some norm, where that is over 1 (Mip-NeRF 360, Barron et al. 2022, eq. 10, has B = 1 and
the Euclidean norm). With B = SHELL coordinates are up to 1 + SHELL in size.

A piece of a ray o + t d is (o, (d, warp), 0, length, warp): t_local is a warp of the distance t, such that no
length of t_local is shorter than it is in the coordinates. So a sample may go on in t_local by as much as the
nearest occupied cell is away along any axis, and none is missed (`next_sample`).
"""

import math

import numpy as np
import torch

from fusedrf_cli.engine.kernels.primitives import FACE_TOLERANCE, along, cell_of

CURVED = True
SHELL = 1.0
CONTRACTED_DENSITY = 0.0  # 1: σ is per length of the coordinates along the ray (DVGO); 0: of the frame
CONSTANTS = {"shell": (1e-3, 1.0), "contracted_density": (0.0, 1.0)}


def position_at(origin, direction, t_local):
    """See bounded.py."""
    return point(along(origin, direction[0], distance(direction[1], t_local)))


def scale_of(n):
    """What a point of size n over 1 is multiplied by to be contracted."""
    return (1.0 + SHELL - SHELL / n) / n


def size_before(m):
    """Inverse: the size of the point of the frame whose coordinates are m over 1 in size, FAR at most."""
    return SHELL / max(1.0 + SHELL - m, SHELL / FAR)


def point(p):
    """Where a point of the field's frame lies in the space's coordinates."""
    n = size_of(p)
    s = scale_of(n) if n > 1.0 else 1.0
    return p[0] * s, p[1] * s, p[2] * s


def frame_point(q):
    """Inverse of `point`; what lies beyond FAR comes back at FAR."""
    m = size_of(q)
    s = size_before(m) / m if m > 1.0 else 1.0
    return q[0] * s, q[1] * s, q[2] * s


def depth_per_coordinate(q):
    """See bounded.py: by the way out."""
    m = size_of(q)
    return 1.0 if CONTRACTED_DENSITY != 0.0 or m <= 1.0 else size_before(m) ** 2 / SHELL


def optical_length(warp, p, d, t_local, n_steps, strides, step):
    """See kernels/loops.py. Where σ is per length of the coordinates, their length at the sample counts: far
    out an interval of t is of no use, since there t goes up manifold in one step."""
    length = strides * n_steps * step
    middle = t_local + 0.5 * (length - n_steps * step)
    if CONTRACTED_DENSITY == 0.0:
        return span(warp, middle, length)
    low, high = ends_of(warp, middle, length)
    return rate(p, d) * slope(warp, t_local) * (high - low)


def clearance(p, lo, hi, cell, index, empty):
    """How far a point of the coordinates may move along any axis before it comes to an occupied cell: it is
    outside a grid's box, or in the cell `index` that is `empty` cells away from one (GridArrays); -1 where it
    is in an occupied cell."""
    outside, away = 0.0, 1e30
    for axis in range(3):
        x = p[0] if axis == 0 else (p[1] if axis == 1 else p[2])
        i = index[0] if axis == 0 else (index[1] if axis == 1 else index[2])
        outside = max(outside, max(lo[axis] - x, x - hi[axis]))
        lower, upper = lo[axis] + (i - empty + 1) * cell[axis], lo[axis] + (i + empty) * cell[axis]
        away = min(away, min(x - lower, upper - x))
    if outside > 0.0:
        return outside
    return -1.0 if empty == 0 else max(away, 0.0)


def next_sample(grid, origin, direction, t_begin, t_end, step, index):
    """See kernels/primitives.py; samples are a step apart everywhere."""
    nx, ny, nz = grid.skip.shape
    while True:
        t_local = t_begin + index * step
        if t_local >= t_end:
            return -1, 1
        p = position_at(origin, direction, t_local)
        i = cell_of(p[0], grid.lo[0], grid.cell[0], nx)
        j = cell_of(p[1], grid.lo[1], grid.cell[1], ny)
        m = cell_of(p[2], grid.lo[2], grid.cell[2], nz)
        empty = int(grid.skip[np.uint64(i), np.uint64(j), np.uint64(m)])
        away = clearance(p, grid.lo, grid.hi, grid.cell, (i, j, m), empty)
        if away < 0.0:
            return index, 1
        index = max(index + 1, int(math.ceil((t_local + away - t_begin) / step - FACE_TOLERANCE)))


def next_change(instances, b, o, d, t, end, gap):
    """See kernels/instances.py. Half a step around occupied cells counts as occupied, so that no step is
    shorter."""
    lo, hi, cell, first = instances.lo[b], instances.hi[b], instances.cell[b], instances.first_cell[b]
    nx, ny, nz = instances.counts[b, 0], instances.counts[b, 1], instances.counts[b, 2]
    piece_begin, last, least = first_piece_at(o, d, t), t, 0.5 * instances.step[b]
    for _ in range(PIECES):
        (origin, direction, t_local, t_end, warp), piece_begin = next_piece(
            piece_begin, Box(lo, hi), o, d, end
        )
        while t_local < t_end:
            p = position_at(origin, direction, t_local)
            i, j = cell_of(p[0], lo[0], cell[0], nx), cell_of(p[1], lo[1], cell[1], ny)
            k = cell_of(p[2], lo[2], cell[2], nz)
            empty = int(instances.skip[np.uint64(first + (i * ny + j) * nz + k)])
            away = clearance(p, lo, hi, cell, (i, j, k), empty)
            if away < least and gap < 0.0:
                return distance(warp, t_local)
            if away >= least and gap >= 0.0 and distance(warp, t_local) > last + gap:
                return last
            t_local += max(away, least)
            if away < least:
                last = distance(warp, min(t_local, t_end))
    return FARTHEST if gap < 0.0 else last


# -- in torch ------------------------------------------------------------------------------------------------


def contracted_by(points: torch.Tensor, n: torch.Tensor, shell: float) -> torch.Tensor:
    """The coordinates (N, 3) of points (N, 3) of sizes n (N, 1)."""
    outside = n.clamp_min(1)
    return torch.where(n > 1, points * (1 + shell - shell / outside) / outside, points)


def placed_by(points: torch.Tensor, m: torch.Tensor, shell: float, far: float) -> torch.Tensor:
    """Inverse, of coordinates (N, 3) of sizes m (N, 1); what lies beyond `far` comes back there."""
    n = shell / (1 + shell - m.clamp_min(1)).clamp_min(shell / far)
    return torch.where(m > 1, points * n / m.clamp_min(1), points)


def rates_by(m: torch.Tensor, shell: float, far: float) -> torch.Tensor:
    """The `rates` (N,) of coordinates of sizes m (N,)."""
    return torch.where(m > 1, (1 + shell - m).clamp_min(shell / far) ** 2 / shell, 1)


def density_rates_by(
    points: torch.Tensor, dirs: torch.Tensor, n: torch.Tensor, growth: torch.Tensor, shell: float
) -> torch.Tensor:
    """(N,) how long unit dirs (N, 3) are in the coordinates at points (N, 3) of the frame, of sizes n (N, 1)
    that grow so much along them (N, 1)."""
    n = n.clamp_min(1)
    across = (1 + shell - shell / n) / n
    moved = across * dirs + (2 * shell / n**3 - (1 + shell) / n**2) * growth * points
    return torch.where(n > 1, moved, dirs).norm(dim=1)
