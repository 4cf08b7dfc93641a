"""Which way is up, from how cameras were held.

Poses are (N, 4, 4) float64, camera-to-world, OpenGL axes. People hold the long or the short side of a camera
level, also where they look down, so the level axes of all cameras are square to one direction: the
eigenvector of the smallest eigenvalue of the mean of x xᵀ over their sideways axes x. The mean of their
upward axes is not it: of cameras that look down from one side it leans away from that side.
"""

import numpy as np

from formats.capture_frame import sphere

APART = 0.1
"""Axes lie in a plane if the mean square of their distances from it is less than this share of the mean
square of their spread across their main direction in it."""
SPREAD = 0.005
"""Least of that spread, as cameras have it that turn by 15 degrees in all."""
SIDEWAYS, SIDEWAYS_SPREAD = 0.25, 0.03
"""Cameras were held sideways if their y axes lie so much nearer to a plane than their x axes, and spread so
much in it: where all look one way, the hand's roll alone spreads y axes, in a plane that is not level."""
SIGNED = 0.1
"""Least length, along a direction, of the mean of axes that tells which of its two ends is up."""

TOGETHER, EACH = 0.02, 0.15
"""Where some photos were held upright and others sideways, the mean square of level axes along up is at most
that, and each kind is this share of them at least."""
SEVERAL = 8
"""Cameras that tell it at least: for fewer there is such a direction by chance."""
GRID = 1000
"""Directions that are tried for it, about, and cameras that they are tried on."""

UNKNOWN = (
    "which way is up does not follow from these cameras, which all face one way or were held any way: the "
    "mean of their upward axes is taken; --up says otherwise when rendering"
)
EITHER = (
    "the photos lie on their side and look neither up nor down, so up may be the opposite of what is taken; "
    "--up says otherwise when rendering"
)


def upward(poses: np.ndarray) -> np.ndarray:
    """(3,) unit vector: which way is up where the cameras stand, as `vertical` tells."""
    return vertical(*np.moveaxis(poses[:, :3, :3], 2, 0))[0]


def upward_doubt(poses: np.ndarray) -> str | None:
    """A sentence where `upward` is a guess, None where it follows from the cameras."""
    return vertical(*np.moveaxis(poses[:, :3, :3], 2, 0))[1]


def vertical(rights: np.ndarray, ups: np.ndarray, backs: np.ndarray) -> tuple[np.ndarray, str | None]:
    """(3,) unit vector up, and a sentence where it is a guess, of the cameras' axes in the world, (N, 3).

    Photos that lie on their side, stored as a camera that was turned by a quarter left them, have level y
    axes; up is then on the side from which the cameras look down. Where some lie on their side and others do
    not, up is square to one of both axes of each. Without any plane of level axes it is the
    mean of the ups, square to the cameras' common sideways axis where there is one; +z where they cancel.
    """
    if (both := _held_both_ways(rights, ups)) is not None:
        return both, None
    across, x_axes = np.linalg.eigh(rights.T @ rights / len(rights))
    along, y_axes = np.linalg.eigh(ups.T @ ups / len(ups))
    if along[0] < SIDEWAYS * across[0] and along[0] < APART * along[1] > APART * SIDEWAYS_SPREAD:
        lean = float(y_axes[:, 0] @ backs.mean(0))
        return y_axes[:, 0] * (-1.0 if lean < 0 else 1.0), None if abs(lean) > SIGNED else EITHER
    mean = ups.mean(0)
    if across[0] < APART * across[1] > APART * SPREAD:
        up = x_axes[:, 0]
        sign = float(up @ mean)
        if abs(sign) <= SIGNED:  # all look straight down, or straight up, which is rare
            sign = float(up @ backs.mean(0))
        return up * (-1.0 if sign < 0 else 1.0), None
    if across[1] <= SPREAD:  # all look one way: only a tilt to the side is known
        mean = mean - (mean @ x_axes[:, 2]) * x_axes[:, 2]
    length = float(np.linalg.norm(mean))
    return mean / length if length > 1e-6 else np.array([0.0, 0.0, 1.0]), UNKNOWN


def _held_both_ways(rights: np.ndarray, ups: np.ndarray) -> np.ndarray | None:
    """(3,) up where some photos were held upright and others on their side: the direction to which one of the
    two axes of each camera, (N, 3) each, is square. None where there is none, or not both kinds of photos."""
    if len(rights) < SEVERAL:
        return None
    grid = sphere(2 * GRID)[:GRID].T  # the upper half
    few = slice(None, None, -(-len(rights) // GRID))
    up = grid[:, np.minimum((rights[few] @ grid) ** 2, (ups[few] @ grid) ** 2).mean(0).argmin()]
    for _ in range(5):
        upright = (rights @ up) ** 2 < (ups @ up) ** 2
        axes = np.where(upright[:, None], rights, ups)
        spread, directions = np.linalg.eigh(axes.T @ axes / len(axes))
        up = directions[:, 0]
    both = EACH <= upright.mean() <= 1 - EACH
    if not both or spread[0] > TOGETHER or spread[1] < SIDEWAYS_SPREAD:
        return None
    sign = float((ups[upright] @ up).mean())
    return up * np.sign(sign) if abs(sign) > SIGNED else None
