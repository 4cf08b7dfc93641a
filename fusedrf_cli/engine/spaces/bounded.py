"""The space of a field in a finite box: coordinates are those of the field's frame.

What every space has, as scalar functions that the loops of kernels/loops.py are compiled with. A ray is cut
into PIECES, on each of which samples lie evenly in t_local. Where pieces are straight lines in the space's
coordinates, t_local is length along them. Where they are not (curved.py), a length of t_local is at most as
long in the coordinates, origin and direction of a piece are whatever its `position_at` reads, t_local begins
at 0, and the space has a `next_sample` and a `next_change` of its own in place of those of the loops. A kind
with a `next_index` of its own follows straight lines, and cannot lie in such a space.
"""

import numpy as np
import torch

from fusedrf_cli.engine.kernels.primitives import along, hit_box

PIECES = 1  # of a ray, at most
STEP_PER_VOXEL = 0.5  # of a field's finest voxel, at which pictures sample it


position_at = along
"""(origin, direction, t_local): the coordinates at t_local of a piece."""


def point(p):
    """Where a point of the field's frame lies in the space's coordinates."""
    return p


def frame_point(q):
    """Inverse of `point`."""
    return q


def rate(q, d):
    """What σ at `q`, as a field's numbers say it, is to be multiplied by to be per unit of length of the
    frame, along a unit direction of it."""
    return 1.0


def depth_per_coordinate(q):
    """The optical depth of a unit of length of the coordinates at `q`, about, where the numbers say a σ of
    1."""
    return 1.0


def first_piece_at(o, d, t):
    """Where the first piece of the ray o + t d begins that is followed from t on."""
    return t


def next_piece(piece_begin, grid, o, d, far):
    """(origin, direction, t_begin, t_end, warp) of the piece of a ray, in t < far, that begins there, and
    where the next one begins: positions are position_at(origin, direction, t_local) for t_local in [t_begin,
    t_end), empty where t_end <= t_begin. `warp` is what `distance` and `span` need."""
    t0, t1 = hit_box(o, d, grid.lo, grid.hi)
    return (o, d, max(t0, piece_begin), min(t1, far), 0.0), far


def piece(number, grid, o, d, near, far):
    """The piece of that number of a ray that is followed from `near` to `far`, see `next_piece`."""
    return next_piece(first_piece_at(o, d, near), grid, o, d, far)[0]


def distance(warp, t_local):
    """The distance t along the ray, in the field's frame."""
    return t_local


def length_at(warp, t):
    """Inverse of `distance`, within the piece."""
    return t


def interval(warp, t_local, length):
    """From and to which distance a length of t_local around `t_local` stands: `span` is the difference."""
    return t_local - 0.5 * length, t_local + 0.5 * length


def span(warp, t_local, length):
    """How much of t a length of t_local around `t_local` stands for: densities are per t."""
    return length


def picture_step(voxel: float) -> float:
    """At which pictures sample a field with voxels of a size."""
    return STEP_PER_VOXEL * voxel


def most_samples(aabb: np.ndarray, step: float) -> int:
    """How many samples a ray through a field of a box (6,) can have."""
    return int(float(np.linalg.norm(aabb[3:] - aabb[:3])) / step) + 2


def contract(points: torch.Tensor) -> torch.Tensor:
    """`point` of each of points (N, 3), differentiable."""
    return points


def inv_contract(points: torch.Tensor) -> torch.Tensor:
    """`frame_point` of each of coordinates (N, 3), differentiable."""
    return points


def rates(points: torch.Tensor) -> torch.Tensor:
    """(N,) how many units of the coordinates a unit of length of the frame is, along the way out, at each of
    coordinates (N, 3)."""
    return points.new_ones(len(points))


def density_rates(points: torch.Tensor, dirs: torch.Tensor) -> torch.Tensor:
    """(N,) `rate` at each of coordinates (N, 3) along unit dirs (N, 3), differentiable."""
    return points.new_ones(len(points))
