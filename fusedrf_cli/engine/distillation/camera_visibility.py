"""Which cells of unbounded space can hold what a capture's photos show: what no photo shows, and what lies
before all that a photo shows, can only be learnt as floaters."""

from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, cell_counts
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import unbounded


@dataclass(frozen=True)
class CameraVisibilityConfig:
    """How cells that no picture shows are found."""

    cells: int = 64
    beyond: float = 0.06
    """Of a picture's side: how far outside a cell's centre may be seen that reaches into it."""
    half_diagonal: float = 0.87
    """Of a cube, in its sides."""


def shown_cells(cameras: list[Camera], near: float, clear: list[float]) -> OccupancyGrid:
    """A grid over all of unbounded space whose cells at least one camera sees, farther away than `near`, and
    of which none lies wholly within `near` of a camera, nor with its middle in a camera's picture and wholly
    nearer to it than its `clear` distance.

    Cameras and distances are in the field's frame. Lenses count as pinholes, and cells that are seen are
    grown by one; a camera that sees more than half of all directions counts as seeing everything.
    """
    config = current(CameraVisibilityConfig)
    counts = cell_counts(unbounded.WHOLE, config.cells)
    grid = OccupancyGrid.full(unbounded.WHOLE, config.cells, unbounded)
    centres = grid.centres()
    real = (np.abs(centres) < 1).sum(1) >= 2  # beyond the core's edges coordinates stand for no place
    points = unbounded.inv_contract(torch.from_numpy(centres)).numpy()
    reach = config.half_diagonal * grid.cell.max() / unbounded.rates(torch.from_numpy(centres)).numpy()
    seen, empty = np.zeros(len(points), bool), np.zeros(len(points), bool)
    for camera, distance in zip(cameras, clear, strict=True):
        rest = np.flatnonzero(real & ~seen)
        seen[rest[seen_by(camera, points[rest], near)]] = True
        empty |= is_before_cameras(camera, points, reach, near, distance)
    return grid.marked(grid.marked(seen.reshape(counts)).dilated().occupied & ~empty.reshape(counts))


def is_before_cameras(
    camera: Camera, points: np.ndarray, reach: np.ndarray, near: float, clear: float
) -> np.ndarray:
    """(N,) bool: which balls around points (N, 3) of radii `reach` (N,) lie within `near` of a camera, where
    it could not have been held otherwise, or, with their middle in its picture, within `clear` of it."""
    offsets = points - camera.camera_to_world[:3, 3]
    farthest = np.linalg.norm(offsets, axis=1) + reach
    is_before = farthest < near
    if camera.fisheye:
        return is_before
    rest = np.flatnonzero(~is_before & (farthest < clear))
    x, y, z = (offsets[rest] @ camera.camera_to_world[:3, :3]).T
    column, row = offset_from_picture(camera, x, y, np.maximum(-z, 1e-9))
    is_before[rest] = (column < 0.5) & (row < 0.5) & (z < 0)
    return is_before


def offset_from_picture(camera: Camera, x, y, depth) -> tuple[np.ndarray, np.ndarray]:
    """How far from a picture's middle points of its camera's frame are shown, in widths and in heights."""
    column = (camera.cx + camera.fl_x * x / depth) / camera.width
    row = (camera.cy - camera.fl_y * y / depth) / camera.height
    return abs(column - 0.5), abs(row - 0.5)


def seen_by(camera: Camera, points: np.ndarray, near: float) -> np.ndarray:
    """(N,) bool: which points (N, 3) a camera sees beyond `near`, within `beyond` of its picture."""
    config = current(CameraVisibilityConfig)
    local = (points - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    away = np.linalg.norm(local, axis=1)
    if camera.fisheye:
        return away > near
    depth = np.maximum(-local[:, 2], 1e-9)
    column, row = offset_from_picture(camera, local[:, 0], local[:, 1], depth)
    inside = (column < 0.5 + config.beyond) & (row < 0.5 + config.beyond)
    return inside & (local[:, 2] < 0) & (away > near)
