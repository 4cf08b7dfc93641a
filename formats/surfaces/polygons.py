"""Polygons as triangles."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from formats.surfaces.lines import within
from formats.surfaces.surface import check_budget, check_indices

MAX_CORNERS = 1000
MAX_LOOKS = 300_000
"""Corners that are looked at for ears, which takes seconds; polygons beyond, and larger ones, stay fans."""


def triangulated(
    path: Path | str, counts: np.ndarray, corners: np.ndarray, positions: np.ndarray, n_bytes: int
) -> tuple[np.ndarray, np.ndarray]:
    """(F, 3) places in `corners`, and (F,) which polygon each triangle is of.

    `counts` (P,) corners of each polygon in turn, `corners` (sum of them,) vertices, `positions` (V, 3).
    Convex polygons become fans; of those that are not, ears are cut. Fewer than three corners give nothing.
    Raises BadMesh, and LimitExceeded for more triangles than a file of so many bytes may have.
    """
    n = np.maximum(counts - 2, 0)
    check_budget(path, int(n.sum()), n_bytes)
    check_indices(path, corners, len(positions))
    starts = np.cumsum(counts) - counts
    polygon = np.repeat(np.arange(len(counts)), n)
    step = within(n)
    first = starts[polygon]
    fans = np.stack([first, first + step + 1, first + step + 2], 1)
    if (counts <= 3).all():
        return fans, polygon
    looks = iter(range(MAX_LOOKS))
    for index in _concave(counts, starts, corners, positions, fans, polygon):
        corner_indices = np.arange(starts[index], starts[index] + counts[index])
        if counts[index] > MAX_CORNERS:
            continue
        first = int(np.searchsorted(polygon, index))
        fans[first : first + len(corner_indices) - 2] = corner_indices[
            _ears(positions[corners[corner_indices]], looks)
        ]
    return fans, polygon


def _concave(counts, starts, corners, positions, fans, polygon) -> np.ndarray:
    """Polygons whose fan turns over somewhere."""
    a, b, c = (positions[corners[fans[:, corner]]] for corner in range(3))
    with np.errstate(over="ignore", invalid="ignore"):
        normals = np.cross(b - a, c - a)
        plane_normals = np.zeros((len(counts), 3))
        np.add.at(plane_normals, polygon, normals)
        turned = (normals * plane_normals[polygon]).sum(1) < 0
    concave = np.unique(polygon[turned])
    return concave[np.isfinite(plane_normals[concave]).all(1)]


def _ears(points: np.ndarray, looks: Iterator[int]) -> np.ndarray:
    """(n - 2, 3) corners of a simple polygon (n, 3), seen along its area normal, while there are `looks`."""
    centred = points - points.mean(0)
    normal = np.cross(centred, np.roll(centred, -1, 0)).sum(0)
    drop = int(np.abs(normal).argmax())
    flat = centred[:, [(drop + 1) % 3, (drop + 2) % 3]] * [np.sign(normal[drop]) or 1, 1]
    left, ears = list(range(len(points))), []
    while len(left) > 3:
        ear = next((k for k, _ in zip(range(len(left)), looks, strict=False) if _is_ear(flat, left, k)), 0)
        ears.append([left[ear - 1], left[ear], left[(ear + 1) % len(left)]])
        del left[ear]
    return np.array([*ears, left])


def _is_ear(flat: np.ndarray, left: list[int], k: int) -> bool:
    before, at, after = left[k - 1], left[k], left[(k + 1) % len(left)]
    a, b, c = flat[before], flat[at], flat[after]
    if _turn(a, b, c) <= 0:
        return False
    others = flat[[i for i in left if i not in (before, at, after)]]
    inside = (_turn(a, b, others.T) >= 0) & (_turn(b, c, others.T) >= 0) & (_turn(c, a, others.T) >= 0)
    return not inside.any()


def _turn(a, b, c):
    """Twice the area of the triangle, positive where it turns left; c may be (2, n)."""
    return (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
