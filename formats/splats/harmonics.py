"""Real spherical harmonics of degree 0 to 3 as 3D Gaussian splatting uses them, and how they are turned.

The basis is that of Kerbl et al. 2023 (and of KHR_gaussian_splatting, appendix A): orthonormal, with the
Condon-Shortley phase, ordered by degree l and then by m = -l .. l.
"""

import numpy as np

DEGREES = {1: 0, 4: 1, 9: 2, 16: 3}
"""By the number of coefficients."""


def basis(directions: np.ndarray) -> np.ndarray:
    """(N, 16) float64 values of the harmonics along (N, 3) unit directions."""
    x, y, z = np.asarray(directions, np.float64).T
    xx, yy, zz = x * x, y * y, z * z
    columns = [
        0.28209479177387814 + 0 * x,
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return np.stack(columns, 1)


def rotation_matrix(turn: np.ndarray, count: int) -> np.ndarray:
    """(count, count) float64 M such that coefficients M c, seen along `turn` d, show what c showed along d.
    `turn` is (3, 3) orthogonal, a mirror too.

    Each degree is a space that turns keep, so that its block is found exactly from values along a few
    directions.
    """
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(64, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    before, after = basis(directions), basis(directions @ np.asarray(turn, np.float64).T)
    matrix = np.zeros((count, count))
    for degree in range(DEGREES[count] + 1):
        block = slice(degree**2, (degree + 1) ** 2)
        matrix[block, block] = np.linalg.lstsq(after[:, block], before[:, block], rcond=None)[0]
    return matrix


def turned(harmonics: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """(N, K, 3) float32 coefficients of splats that were turned (or mirrored) by an orthogonal matrix."""
    matrix = rotation_matrix(turn, harmonics.shape[1]).astype(np.float32)
    return np.matmul(matrix, harmonics)
