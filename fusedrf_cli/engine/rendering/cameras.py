"""Pinhole cameras with Brown-Conrady distortion: pixels to rays.

Axes are OpenGL's: +x right, +y up, looking along -z. Pixel (i, j) is column i, row j from the top, its centre
at (i + 0.5, j + 0.5).
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from fusedrf_cli.engine.kernels import cpu

TILE = 16  # pixels along the side of a tile


@dataclass(frozen=True)
class Camera:
    """One view: where it is and how it projects."""

    camera_to_world: np.ndarray
    """(4, 4) float64."""
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, k3, p1, p2."""
    name: str = ""

    @property
    def intrinsics(self) -> tuple[float, ...]:
        """All that shapes the camera's own ray directions, as a key."""
        return (self.fl_x, self.fl_y, self.cx, self.cy, self.width, self.height, *self.distortion)

    def local_directions(self, rows: slice = slice(None)) -> np.ndarray:
        """(rows, width, 3) float64 directions in the camera's frame, z = -1."""
        columns = (np.arange(self.width) + 0.5 - self.cx) / self.fl_x
        lines = (np.arange(self.height)[rows] + 0.5 - self.cy) / self.fl_y
        x, y = np.meshgrid(columns, lines)
        if any(self.distortion):
            x, y = undistort(x, y, self.distortion)
        return np.stack([x, -y, -np.ones_like(x)], -1)

    def rays(
        self, rows: slice = slice(None), order: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """rays_o, rays_d, each (rows * width, 3) float64 in world space, rays_d of unit length, row by row,
        or those of the rows' pixels in another order (N,) int64."""
        top, bottom, _ = rows.indices(self.height)
        if order is None:
            order = np.arange((bottom - top) * self.width)
        rays_o, rays_d = np.empty((len(order), 3)), np.empty((len(order), 3))
        pose = np.ascontiguousarray(self.camera_to_world, np.float64)
        if any(self.distortion):
            rays_d[:] = self.local_directions(rows).reshape(-1, 3)[order] @ pose[:3, :3].T
            rays_d /= np.linalg.norm(rays_d, axis=1, keepdims=True)
            rays_o[:] = pose[:3, 3]
        else:
            inner = self.fl_x, self.fl_y, self.cx, self.cy
            cpu.pinhole_rays(pose, *map(float, inner), self.width, top, order, rays_o, rays_d)
        return rays_o, rays_d


@lru_cache(maxsize=4)
def tile_order(width: int, rows: int) -> np.ndarray:
    """(rows * width,) int64 pixels, counted row by row, tile after tile: rays of a tile pass the same
    texels."""
    high, wide = -(-rows // TILE), -(-width // TILE)
    padded = np.full((high * TILE, wide * TILE), -1)
    padded[:rows, :width] = np.arange(rows * width).reshape(rows, width)
    order = padded.reshape(high, TILE, wide, TILE).swapaxes(1, 2).ravel()
    return order[order >= 0]


def undistort(x: np.ndarray, y: np.ndarray, distortion: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Invert the Brown-Conrady model by fixed-point iteration: distorted to ideal normalised image
    coordinates (y down)."""
    k1, k2, k3, p1, p2 = distortion
    u, v = x, y
    for _ in range(12):
        r2 = u * u + v * v
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        du = 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
        dv = p1 * (r2 + 2 * v * v) + 2 * p2 * u * v
        u, v = (x - du) / radial, (y - dv) / radial
    return u, v


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(4, 4) camera_to_world of a camera at eye that looks at target, its +y as near to up as can be."""
    back = np.asarray(eye, np.float64) - target
    back = back / np.linalg.norm(back)
    right = np.cross(up, back)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross([0.0, 1.0, 0.0] if abs(back[1]) < 0.9 else [1.0, 0.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(back, right), back, eye
    return pose


FRAMING_FOV = 0.6911112  # radians, horizontal: the field of view of NeRF-Synthetic's cameras


def framing_camera(
    aabb: np.ndarray, azimuth: float, elevation: float, width: int, height: int, name: str = "view"
) -> Camera:
    """A camera outside a box (6,) that frames its bounding ball; azimuth from +x about +z, elevation above
    the xy plane, radians."""
    centre, radius = (aabb[:3] + aabb[3:]) / 2, float(np.linalg.norm(aabb[3:] - aabb[:3]) / 2)
    focal = 0.5 * width / np.tan(FRAMING_FOV / 2)
    narrow = np.arctan(0.5 * min(width, height) / focal)
    away = np.array(
        [np.cos(azimuth) * np.cos(elevation), np.sin(azimuth) * np.cos(elevation), np.sin(elevation)]
    )
    eye = centre + away * (0.92 * radius / np.sin(narrow))
    pose = look_at(eye, centre, np.array([0.0, 0.0, 1.0]))
    return Camera(pose, focal, focal, width / 2, height / 2, width, height, name=name)


def orbit(aabb: np.ndarray, count: int, width: int, height: int, elevation: float = 0.45) -> list[Camera]:
    """`count` cameras evenly around a box, all at one elevation."""
    return [
        framing_camera(aabb, 2 * np.pi * i / count + 0.9, elevation, width, height, name=f"orbit_{i:04d}")
        for i in range(count)
    ]


def scattered(
    aabb: np.ndarray,
    count: int,
    width: int,
    height: int,
    seed: int | tuple[int, ...],
    lowest: float = 0.05,
) -> list[Camera]:
    """`count` cameras at seeded random azimuths and elevations above `lowest` radians: the views nothing is
    trained on."""
    rng = np.random.default_rng(seed)
    spots = zip(rng.uniform(0, 2 * np.pi, count), rng.uniform(lowest, 1.3, count), strict=True)
    return [framing_camera(aabb, a, e, width, height, name=f"view_{i:04d}") for i, (a, e) in enumerate(spots)]
