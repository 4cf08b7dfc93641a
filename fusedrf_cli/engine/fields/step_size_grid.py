"""How far apart samples may lie in the cells of a grid over several fields placed in unbounded space."""

from collections.abc import Iterable, Iterator
from dataclasses import replace

import numpy as np
import torch

from fusedrf_cli.engine.fields.occupancy import MAX_STRIDE, OccupancyGrid, squeezed


class StepSizeGrid:
    """How far apart samples may lie in each cell of a grid over several fields placed in unbounded space: as
    the finest of those that reach it needs."""

    def __init__(self, grid: OccupancyGrid):
        """grid: its box and cells, in unbounded space."""
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
        finest, space = step * squeezed(object_to_field), self.whole.space
        alike = space is grid.space and np.array_equal(object_to_field, np.eye(4))
        if grid.stride is None and alike:
            return finest
        back = np.linalg.inv(object_to_field)
        here = torch.from_numpy(self.whole.marked(mark).centres())
        frame = space.inv_contract(here).numpy()
        there = grid.space.contract(torch.from_numpy(frame @ back[:3, :3].T + back[:3, 3]))
        if alike:
            return finest * grid.strides_at(there.numpy())
        inverse = space.rates(here).sqrt()  # 1 / n
        far = (inverse - self.whole.cell[0] / 2).clamp_min(0.1 * inverse)  # that on the far side of a cell
        frame_far = frame * (inverse / far).numpy()[:, None]
        there_far = grid.space.contract(torch.from_numpy(frame_far @ back[:3, :3].T + back[:3, 3]))
        ratio = torch.minimum(
            inverse / grid.space.rates(there).sqrt(), far / grid.space.rates(there_far).sqrt()
        ).numpy()
        return finest * np.minimum(ratio, ratio**2) * grid.strides_at(there.numpy())

    def grid(self, occupied: np.ndarray) -> OccupancyGrid:
        """The grid with those cells (X, Y, Z) bool. Lengths change from cell to cell, so that samples lie a
        cell apart at most."""
        grid = self.whole.marked(occupied)
        known = np.isfinite(self.spacing)
        if not known.any():
            return grid
        spacing = np.minimum(self.spacing, self.whole.cell.min())
        unit = self.unit(float(spacing[known].max()), float(spacing[known].min()))
        strides = np.where(known, spacing, unit) / unit + 1e-4  # up to a rounding
        stride = np.clip(strides, 1, MAX_STRIDE).astype(np.uint16)
        return replace(grid, stride=None if stride.max() == 1 else stride, unit=unit)

    def unit(self, most: float, least: float) -> float:
        """That of strides where samples lie from `least` to `most` apart: a part of `most`, by which all that
        lies behind what stands in a place is sampled. So its samples come where they come without that, and
        do not move with what else is there. Where samples lie closest a stride is 8 units at least."""
        if most <= (1 + 1e-3) * least:
            return least
        return most / min(np.ceil(8 * most / least), MAX_STRIDE)
