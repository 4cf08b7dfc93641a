"""Cells of a field's grid that are occupied."""

from dataclasses import dataclass

import numpy as np

from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import PROBES, OccupancyConfig, OccupancyGrid, cell_counts
from fusedrf_cli.engine.rendering.volume import render_rays
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class OccupancyUpdateConfig:
    """From when a cell counts as empty."""

    empty_below: float = 0.01
    """Optical depth across a cell under which it counts as empty."""
    rays_that_judge: int = 1 << 13
    """That tell whether anything is seen of low density."""
    first_prune_depth: float = 16 * empty_below
    """How thick low density is, across a cell, that is left out first where it is known what rays should
    show: low density of a student is mostly what it failed to learn."""
    last_prune_depth: float = empty_below / 64
    """The low density that is tried last, where rays show all that is thicker."""
    same: float = 1e-6
    """Mean square by which pictures differ that show the same: 60 dB."""


def occupancy_of(
    field: StoredField, box: np.ndarray | None = None, cells: int | None = None
) -> OccupancyGrid:
    """Cells of the box (6,) of a field on one grid, by default that of its present occupancy, in which the
    optical depth across the cell passes `empty_below` somewhere, grown by one cell. cells: along the longest
    axis at most, by default those of `OccupancyConfig`.

    Cells whose centre the present grid calls empty stay so: they were grown by one when they were found.
    """
    space = field.occupancy.space
    box = field.aabb if box is None else box
    counts = cell_counts(box, min(cells or current(OccupancyConfig).cells, max(field.resolution)))
    cell = (box[3:] - box[:3]) / counts
    index = np.stack(np.meshgrid(*[np.arange(n) for n in counts], indexing="ij"), -1).reshape(-1, 3)
    index = index[field.occupancy.contains(box[:3] + (index + 0.5) * cell)]
    sigma = field.peaks(box[:3], cell, index, PROBES)
    occupied = np.zeros(counts, bool)
    occupied[tuple(index[sigma * cell.min() > current(OccupancyUpdateConfig).empty_below].T)] = True
    return OccupancyGrid(box, occupied, space).dilated()


def depths_across(field: StoredField, probes: np.ndarray) -> np.ndarray:
    """(X, Y, Z) optical depth across each cell of the field's occupancy at the densest of probes (K, 3) in
    [0, 1] of it; 0 in empty ones."""
    grid = field.occupancy
    cells = np.argwhere(grid.occupied)
    depth = np.zeros(grid.occupied.shape, np.float32)
    depth[tuple(cells.T)] = field.peaks(grid.aabb[:3], grid.cell, cells, probes) * grid.cell.min()
    return depth


def prune_low_density(
    field: StoredField,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    near: float = 0.0,
    truth: np.ndarray | None = None,
) -> OccupancyGrid:
    """The field's occupancy but for cells in which the optical depth across the cell passes `empty_below`
    nowhere; where rays (N, 3) from `near` on show it by more than `same`, but for those of low density a
    quarter as thick, and so on, and at last with all of them. Where it is known what rays should show,
    premultiplied rgb and opacity `truth` (N, 4), it begins with `first_prune_depth`, and rays must not be
    further from that by more.

    Cells found while a field learns are grown by one, for density to grow into; that room would be sampled in
    every picture.
    """
    config = current(OccupancyUpdateConfig)
    # about as close together as the texels of a fine field
    probes = np.stack(np.meshgrid(*[(np.arange(4) + 0.5) / 4] * 3, indexing="ij"), -1).reshape(-1, 3)
    grid, depth = field.occupancy, depths_across(field, probes)
    full = render_rays(field, rays_o, rays_d, near=near)[:, :4]
    expected, most = (full, config.empty_below) if truth is None else (truth, config.first_prune_depth)
    allowed = np.square(full - expected).mean() + config.same
    while most >= config.last_prune_depth:
        fewer = grid.marked(grid.occupied & (depth > most))
        if fewer.occupied.any():
            pruned = render_rays(field.with_occupancy(fewer), rays_o, rays_d, near=near)[:, :4]
            if np.square(pruned - expected).mean() <= allowed:
                return fewer
        most /= 4
    return grid
