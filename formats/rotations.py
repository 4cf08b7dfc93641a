"""Rotations as unit quaternions (x, y, z, w) and as matrices that act on columns.

scipy does the same; loading it would take longer than all else that quick commands do, so that what is read
is done here.
"""

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
    """(N, 4) unit quaternions, w not negative, of the rotations nearest to (N, 3, 3) matrices."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_matrix(rotations).as_quat(canonical=True)
