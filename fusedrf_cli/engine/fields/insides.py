"""What the cells of a field's grid are like inside: which of the 4 x 4 x 4 parts of a cell hold matter, as
the bits of a number for each cell (`parts.bit_of`).

The grid of a scene has cells as wide as a small object, or wider, and is grown by one of them around matter:
most of what lies in its occupied cells is empty.
"""

import numpy as np

from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels import GridArrays
from fusedrf_cli.engine.kernels.parts import MIXED

SIDE = 4  # parts of a cell along an axis
WORTH_TELLING = 100_000
"""Rays of pictures from which it is worth telling the insides of cells, in some tenths of a second."""


def with_insides(grid: OccupancyGrid, insides: np.ndarray, coarse: np.ndarray | None = None) -> GridArrays:
    """A grid's arrays that know the insides (X, Y, Z) of its cells. Parts without matter are skipped, or,
    where `coarse` (X, Y, Z) says so, sampled with another stride, of a cell at most: there lies what was not
    looked into. Beside matter such samples end where parts do, so that none stands for it."""
    matter, coarse = insides != 0, np.zeros(grid.occupied.shape, np.uint16) if coarse is None else coarse
    known = grid.arrays._replace(skip=grid.marked(matter | (coarse != 0)).skip, inner=insides, coarse=coarse)
    if grid.stride is None:
        return known
    stride = np.where(matter, grid.stride, coarse)
    stride[grid.marked(matter).dilated().occupied] += np.uint16(MIXED)
    return known._replace(stride=stride)
