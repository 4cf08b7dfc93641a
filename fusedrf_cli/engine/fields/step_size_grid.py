"""How far apart samples may lie in the cells of a grid over several placed fields."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import torch

from fusedrf_cli.engine.fields.occupancy import MAX_STRIDE, OccupancyGrid, squeezed
from fusedrf_cli.engine.spaces import bounded


class StepSizeGrid:
    """How far apart samples may lie in each cell of a grid over several placed fields: as the finest of those
    that reach it needs, and no farther than it is to cells that need finer ones."""

    def __init__(self, grid: OccupancyGrid):
        """grid: its box, cells and space."""
        self.whole, self.spacing = grid, np.full(grid.occupied.shape, np.inf, np.float32)

    def kept(
        self,
        marks: Iterable[np.ndarray],
        placed: Iterable[tuple[OccupancyGrid, np.ndarray]],
        steps: Iterable[float],
    ) -> Iterator[np.ndarray]:
        """The marks as they come, noted: the cells (X, Y, Z) bool that each of several placed grids reaches,
        which is sampled at a step of its own; placed as in `placed_cells`."""
        for mark, (grid, matrix), step in zip(marks, placed, steps, strict=True):
            self.spacing[mark] = np.minimum(self.spacing[mark], self.needed(mark, grid, matrix, step))
            yield mark

    def needed(self, mark: np.ndarray, grid: OccupancyGrid, object_to_field: np.ndarray, step: float):
        """How far apart in the coordinates of this space samples may lie that a placed grid needs: a number,
        or one for each of the cells of `mark`.

        What is d long in the frame is, with n as in unbounded.py, d / n long across and d / n² along the way
        out, in each of the two spaces by its own n.
        """
        finest = step * squeezed(object_to_field)
        space, same = self.whole.space, np.array_equal(object_to_field, np.eye(4))
        alike = space is grid.space and (space is bounded or same)
        if grid.stride is None and alike:
            return finest
        back = np.linalg.inv(object_to_field)
        here = torch.from_numpy(self.whole.marked(mark).centres())
        frame = space.inv_contract(here).numpy()
        there = grid.space.contract(torch.from_numpy(frame @ back[:3, :3].T + back[:3, 3]))
        if alike:
            return finest * grid.strides_at(there.numpy())
        ratio = (space.rates(here) / grid.space.rates(there)).sqrt().numpy()
        if space is not bounded:  # to the far side of a cell
            ratio *= np.maximum(1 - self.whole.cell[0] / 2 / space.rates(here).sqrt().numpy(), 0.1)
        return finest * np.minimum(ratio, ratio**2) * grid.strides_at(there.numpy())

    def stepping_over_nothing(self) -> np.ndarray:
        """The spacing (X, Y, Z) with which no sample stands for what lies in cells that need finer ones: that
        of a cell k cells away, or the k cells up to the density in it, whichever is more. Cells are reached
        up to one around density, so density k cells away is k whole cells away. In other spaces than bounded
        ones lengths change from cell to cell: there it is a cell at most."""
        from scipy.ndimage import minimum_filter

        spacing, near, cell = self.spacing, self.spacing, self.whole.cell.min()
        if self.whole.space is not bounded:
            return np.minimum(spacing, cell)
        known = np.isfinite(spacing)
        most, least = spacing[known].max(), spacing[known].min()
        if most <= max(cell, least):
            return spacing
        for away in range(1, int(np.ceil(most / cell))):
            near = minimum_filter(near, 3)
            spacing = np.minimum(spacing, np.maximum(near, away * cell))
        return spacing

    def grid(self, occupied: np.ndarray) -> OccupancyGrid:
        """The grid with those cells (X, Y, Z) bool."""
        grid = self.whole.marked(occupied)
        known = np.isfinite(self.spacing)
        if not known.any():
            return grid
        spacing = self.stepping_over_nothing()
        most, least = float(spacing[known].max()), float(spacing[known].min())
        unit = self.unit(most, least)
        strides = np.where(known, spacing, unit) / unit + 1e-4  # up to a rounding
        stride = np.clip(strides, 1, MAX_STRIDE).astype(np.uint16)
        return replace(grid, stride=None if stride.max() == 1 else stride, unit=unit)

    def unit(self, most: float, least: float) -> float:
        """That of strides where samples lie from `least` to `most` apart. In a place it is a part of `most`,
        by which all that lies behind what stands in it is sampled: so its samples come where they come
        without that, and do not move with what else is there. In a box it is `least`, by which all of a scene
        is sampled before it is fused. Strides are whole numbers of it, of at least 8 where
        samples lie closest in an unbounded scene."""
        if self.whole.space is bounded or most <= (1 + 1e-3) * least:
            return max(least, most / MAX_STRIDE)
        return most / min(np.ceil(8 * most / least), MAX_STRIDE)
