"""Rotations as unit quaternions (x, y, z, w) and as matrices that act on columns."""

import numpy as np


def matrices(quaternions: np.ndarray) -> np.ndarray:
    """(..., 3, 3) float64 of unit quaternions (..., 4)."""
    x, y, z, w = np.moveaxis(np.asarray(quaternions, np.float64), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), (0, 1), (-2, -1))


def quaternions(rotations: np.ndarray) -> np.ndarray:
    """(N, 4) unit quaternions, w not negative, of the rotations nearest to (N, 3, 3) matrices (Bar-Itzhack:
    the eigenvector of the largest eigenvalue)."""
    r = np.moveaxis(np.asarray(rotations, np.float64), 0, -1)
    rows = [
        [r[0, 0] - r[1, 1] - r[2, 2], r[1, 0] + r[0, 1], r[2, 0] + r[0, 2], r[2, 1] - r[1, 2]],
        [r[1, 0] + r[0, 1], r[1, 1] - r[0, 0] - r[2, 2], r[2, 1] + r[1, 2], r[0, 2] - r[2, 0]],
        [r[2, 0] + r[0, 2], r[2, 1] + r[1, 2], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
        [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
    ]
    found = np.linalg.eigh(np.moveaxis(np.array(rows), -1, 0))[1][:, :, -1]
    return np.where(found[:, 3:] < 0, -found, found)
