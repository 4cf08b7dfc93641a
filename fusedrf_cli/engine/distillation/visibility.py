"""Which cells of unbounded space a capture's photos show: what no photo shows can only be learnt as fog."""

import numpy as np
import torch

from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, cell_counts
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.spaces import unbounded

CELLS = 64
BEYOND = 0.06  # of a picture's side: how far outside a cell's centre may be seen that reaches into it


def shown_cells(cameras: list[Camera], near: float) -> OccupancyGrid:
    """A grid over all of unbounded space whose cells at least one camera sees, farther away than `near`.

    Cameras are in the field's frame. Lenses count as pinholes, and cells are grown by one; a camera that
    sees more than half of all directions counts as seeing everything.
    """
    counts = cell_counts(unbounded.WHOLE, CELLS)
    grid = OccupancyGrid.full(unbounded.WHOLE, CELLS, unbounded)
    centres = grid.centres()
    real = (np.abs(centres) < 1).sum(1) >= 2  # beyond the core's edges coordinates stand for no place
    points = unbounded.placed(torch.from_numpy(centres)).numpy()
    seen = np.zeros(len(points), bool)
    for camera in cameras:
        rest = np.flatnonzero(real & ~seen)
        seen[rest[seen_by(camera, points[rest], near)]] = True
    return grid.marked(seen.reshape(counts)).dilated()


def seen_by(camera: Camera, points: np.ndarray, near: float) -> np.ndarray:
    """(N,) bool: which points (N, 3) a camera sees beyond `near`, within BEYOND of its picture."""
    local = (points - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
    away = np.linalg.norm(local, axis=1)
    if camera.fisheye:
        return away > near
    depth = np.maximum(-local[:, 2], 1e-9)
    column = (camera.cx + camera.fl_x * local[:, 0] / depth) / camera.width
    row = (camera.cy - camera.fl_y * local[:, 1] / depth) / camera.height
    inside = (abs(column - 0.5) < 0.5 + BEYOND) & (abs(row - 0.5) < 0.5 + BEYOND)
    return inside & (local[:, 2] < 0) & (away > near)
