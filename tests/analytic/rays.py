"""Points, rays and placements to try fields with."""

import numpy as np


def unit(vectors) -> np.ndarray:
    """Vectors (N, 3) made of unit length."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def points_in(aabb, count: int, seed: int = 0, margin: float = 0.0) -> np.ndarray:
    """(count, 3) random points of a box, or of one `margin` of its size larger on each side."""
    rng = np.random.default_rng(seed)
    extent = aabb[3:] - aabb[:3]
    return aabb[:3] - margin * extent + rng.random((count, 3)) * (1 + 2 * margin) * extent


def rays_at(aabb, count: int, seed: int = 0, away: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """(count, 3) origins on a sphere around a box and unit directions to random points in it."""
    rng = np.random.default_rng(seed)
    origins = (aabb[:3] + aabb[3:]) / 2 + away * unit(rng.normal(size=(count, 3)))
    return origins, unit(points_in(aabb, count, seed + 1) - origins)


DIRECTIONS_26 = unit(
    np.array(
        [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)],
        float,
    )
)


def affine(linear, translation=(0.3, -0.2, 0.1)) -> np.ndarray:
    """(4, 4) of a linear part: a number, three of them, or (3, 3)."""
    matrix = np.eye(4)
    linear = np.asarray(linear, float)
    matrix[:3, :3] = linear if linear.ndim == 2 else np.diag(np.broadcast_to(linear, 3))
    matrix[:3, 3] = translation
    return matrix


def turn(degrees: float, axis=(1.0, 2.0, -0.5)) -> np.ndarray:
    """(3, 3) rotation by Rodrigues' formula."""
    x, y, z = np.asarray(axis) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = np.radians(degrees)
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


SHEAR = [[1, 0.8, 0], [0, 1, 0], [0.3, 0, 1]]


def moved_rays(matrix: np.ndarray, rays_o: np.ndarray, rays_d: np.ndarray) -> tuple[np.ndarray, ...]:
    """Rays (N, 3) of one frame in another, (4, 4) from the first to the second: origins, unit directions, and
    how much longer (N,) a stretch of each ray is there."""
    d = rays_d @ matrix[:3, :3].T
    longer = np.linalg.norm(d, axis=1)
    return rays_o @ matrix[:3, :3].T + matrix[:3, 3], d / longer[:, None], longer
