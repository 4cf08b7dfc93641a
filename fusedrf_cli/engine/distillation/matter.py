"""Cells of a field's grid that hold matter."""

import numpy as np

from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import PROBES, OccupancyConfig, OccupancyGrid, cell_counts
from fusedrf_cli.engine.rendering.volume import render_rays

EMPTY_BELOW = 0.01  # optical depth across a cell under which it counts as empty
# Where in a cell haze is looked for: about as close together as the texels of a fine field.
CLOSE_PROBES = np.stack(np.meshgrid(*[(np.arange(4) + 0.5) / 4] * 3, indexing="ij"), -1).reshape(-1, 3)
RAYS_THAT_JUDGE = 1 << 13  # whether anything is seen of haze
# How thick haze is, across a cell, that is left out first where it is known what rays should show: haze of a
# student is mostly what it failed to learn.
THICK_HAZE = 16 * EMPTY_BELOW
THIN_HAZE = EMPTY_BELOW / 64  # that is tried last, where rays show all that is thicker
SAME = 1e-6  # mean square by which pictures differ that show the same: 60 dB


def occupancy_of(
    field: StoredField, box: np.ndarray | None = None, cells: int = OccupancyConfig.cells
) -> OccupancyGrid:
    """Cells of the box (6,) of a field on one grid, by default that of its present occupancy, in which the
    optical depth across the cell passes EMPTY_BELOW somewhere, grown by one cell.

    Cells whose centre the present grid calls empty stay so: they were grown by one when they were found.
    """
    space = field.occupancy.space
    box = field.aabb if box is None else box
    counts = cell_counts(box, min(cells, max(field.resolution)))
    cell = (box[3:] - box[:3]) / counts
    index = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), -1).reshape(-1, 3)
    index = index[field.occupancy.contains(box[:3] + (index + 0.5) * cell)]
    sigma = field.peaks(box[:3], cell, index, PROBES)
    occupied = np.zeros(counts, bool)
    occupied[tuple(index[sigma * cell.min() > EMPTY_BELOW].T)] = True
    return OccupancyGrid(box, occupied, space).dilated()


def depths_across(field: StoredField, probes: np.ndarray) -> np.ndarray:
    """(X, Y, Z) optical depth across each cell of the field's occupancy at the densest of probes (K, 3) in
    [0, 1] of it; 0 in empty ones."""
    grid = field.occupancy
    cells = np.argwhere(grid.occupied)
    depth = np.zeros(grid.occupied.shape, np.float32)
    depth[tuple(cells.T)] = field.peaks(grid.aabb[:3], grid.cell, cells, probes) * grid.cell.min()
    return depth


def without_haze(
    field: StoredField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    near: float = 0.0,
    truth: np.ndarray | None = None,
) -> OccupancyGrid:
    """The field's occupancy but for cells in which the optical depth across the cell passes EMPTY_BELOW
    nowhere; where rays (N, 3) from `near` on show it by more than SAME, but for those of haze a quarter as
    thick, and so on, and at last with all of them. Where it is known what rays should show, premultiplied rgb
    and opacity `truth` (N, 4), it begins with THICK_HAZE, and rays must not be further from that by more.

    Cells found while a field learns are grown by one, for matter to grow into; that room would be sampled in
    every picture.
    """
    grid, depth = field.occupancy, depths_across(field, CLOSE_PROBES)
    whole = render_rays(field, rays_o, rays_d, near=near)[:, :4]
    expected, most = (whole, EMPTY_BELOW) if truth is None else (truth, THICK_HAZE)
    allowed = np.square(whole - expected).mean() + SAME
    while most >= THIN_HAZE:
        fewer = grid.marked(grid.occupied & (depth > most))
        if fewer.occupied.any():
            found = render_rays(field.with_occupancy(fewer), rays_o, rays_d, near=near)[:, :4]
            if np.square(found - expected).mean() <= allowed:
                return fewer
        most /= 4
    return grid
