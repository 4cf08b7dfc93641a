"""Normalised device coordinates of forward-facing scenes (NeRF, Mildenhall et al. 2020, appendix C).

In the frame the camera that all others are near to stands at the origin and looks along -z, and the near
plane is one unit away. With D = -z,
    (x, y, z) → (SCALE_X x / D, SCALE_Y y / D, 1 - 2 / D),
SCALE_X and SCALE_Y being focal lengths over half the width and half the height of its picture. The map is
projective: rays are straight, one piece. σ is per length of the coordinates, as NeRF's and TensoRF's is.
"""

import math

import numpy as np
import torch

from fusedrf_cli.engine.kernels.primitives import along, hit_box
from fusedrf_cli.engine.spaces.bounded import most_samples, picture_step  # noqa: F401
from fusedrf_cli.engine.spaces.unbounded import (  # noqa: F401
    FAR,
    LEARN_FROM,
    REST_FROM,
    SHARED_COLOUR_FROM,
    distance,
    interval,
    length_at,
    share_of,
    span,
)

PIECES = 1
WHOLE = np.array([-1.0] * 3 + [1.0] * 3)
SCALE_X = SCALE_Y = 1.0
CONSTANTS = {"scale_x": (1e-3, 1e3), "scale_y": (1e-3, 1e3)}
position_at = along


def point(p):
    """Where a point of the field's frame lies in the space's coordinates; what is nearer than 1 / FAR to the
    camera's plane, or behind it, as if it were there."""
    per = 1.0 / max(-p[2], 1.0 / FAR)
    return SCALE_X * p[0] * per, SCALE_Y * p[1] * per, 1.0 - 2.0 * per


def frame_point(q):
    """Inverse of `point`; what lies beyond FAR comes back at FAR."""
    away = 2.0 / max(1.0 - q[2], 2.0 / FAR)
    return q[0] * away / SCALE_X, q[1] * away / SCALE_Y, -away


def rate(q, d):
    """How long a unit of length of the frame along d is in the coordinates at `q`."""
    per = 0.5 * max(1.0 - q[2], 2.0 / FAR)  # 1 / D
    x, y, z = SCALE_X * d[0] + q[0] * d[2], SCALE_Y * d[1] + q[1] * d[2], -2.0 * per * d[2]
    return per * math.sqrt(x * x + y * y + z * z)


def depth_per_coordinate(q):
    """See bounded.py."""
    return 1.0


def optical_length(warp, p, d, t_local, n_steps, strides, step):
    """See loops.py: exactly, as lines are straight."""
    low, high = share_of(warp, t_local + 0.5 * (strides - 1) * n_steps * step, strides * n_steps * step)
    return (high - low) / warp[4]


def first_piece_at(o, d, t):
    """See bounded.py."""
    return t


def next_piece(piece_begin, grid, o, d, far):
    """See bounded.py; `warp` as in unbounded.py, with n = D."""
    low, high = max(piece_begin, 0.0), min(far, FAR * FAR)
    if d[2] != 0.0:
        near, end = (-1.0 / FAR - o[2]) / d[2], (-FAR - o[2]) / d[2]
        low, high = max(low, min(near, end)), min(high, max(near, end))
    n0, n1 = -(o[2] + low * d[2]), -(o[2] + high * d[2])
    if high <= low or min(n0, n1) < 0.5 / FAR or max(n0, n1) > 2.0 * FAR:
        return (o, d, 1.0, 0.0, (low, 0.0, 1.0, 1.0, 1.0)), far
    q0, q1 = point(along(o, d, low)), point(along(o, d, high))
    x, y, z = q1[0] - q0[0], q1[1] - q0[1], q1[2] - q0[2]
    length = math.sqrt(x * x + y * y + z * z)
    if length <= 0.0:
        return (o, d, 1.0, 0.0, (low, 0.0, 1.0, 1.0, 1.0)), far
    direction = x / length, y / length, z / length
    t_begin, t_end = hit_box(q0, direction, grid.lo, grid.hi)
    return (q0, direction, t_begin, min(t_end, length), (low, high - low, n0, n1, 1.0 / length)), far


def piece(number, grid, o, d, near, far):
    """See bounded.py."""
    return next_piece(first_piece_at(o, d, near), grid, o, d, far)[0]


def contract(points: torch.Tensor) -> torch.Tensor:
    """`point` of each of points (N, 3), differentiable."""
    per = 1 / (-points[:, 2:]).clamp_min(1 / FAR)
    return torch.cat([SCALE_X * points[:, :1] * per, SCALE_Y * points[:, 1:2] * per, 1 - 2 * per], 1)


def inv_contract(points: torch.Tensor) -> torch.Tensor:
    """`frame_point` of each of coordinates (N, 3), differentiable."""
    away = 2 / (1 - points[:, 2:]).clamp_min(2 / FAR)
    return torch.cat([points[:, :1] * away / SCALE_X, points[:, 1:2] * away / SCALE_Y, -away], 1)


def rates(points: torch.Tensor) -> torch.Tensor:
    """See bounded.py."""
    return (1 - points[:, 2]).clamp_min(2 / FAR) ** 2 / 2


def density_rates(points: torch.Tensor, dirs: torch.Tensor) -> torch.Tensor:
    """See bounded.py."""
    per = (1 - points[:, 2:]).clamp_min(2 / FAR) / 2
    across = torch.cat([SCALE_X * dirs[:, :1], SCALE_Y * dirs[:, 1:2]], 1) + points[:, :2] * dirs[:, 2:]
    return (per * torch.cat([across, -2 * per * dirs[:, 2:]], 1)).norm(dim=1)
