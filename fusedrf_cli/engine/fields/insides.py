"""What the cells of a field's grid are like inside: which of the 4 x 4 x 4 parts of a cell hold matter.

A cell is some voxels wide, and cells are grown by one around matter, so that most of what lies in occupied
ones is empty, or haze too thin to be seen. Parts are found by asking in them, those of surfaces are grown by
one, and they are kept as the bits of a number for each cell (`parts.bit_of`).
"""

import numpy as np

from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels import GridArrays
from fusedrf_cli.engine.kernels.parts import MIXED
from fusedrf_cli.engine.kernels.plain import grow_insides

SURFACE = 2e-2  # optical depth across a part from which there may be matter beside it
OPAQUE = 1.0  # from which all of an eighth of a cell counts as matter
FAINT = 1e-3 * 0.4 ** np.arange(6)  # from which a part holds matter: the first by which little is lost
LOST = 7e-4  # optical depth that is lost along lines of cells, root mean square
SIDE = 4  # parts of a cell along an axis
MOST_PLACES = 60_000_000  # that are asked at: a second or two
FULL = np.uint64(2**64 - 1)
WORTH_LOOKING = 1_500_000
"""Rays from which looking into the cells of what stands in a place is worth it: of three objects it takes
1.8 s, and of 426,000 rays saves 0.5 s; of small ones close by it saves more. Of four objects in a box it
takes 1.2 s, saves 0.4 s of 640,000 rays, and costs 3 dB to denser samples: nothing is looked into there."""


def insides_of(field) -> np.ndarray | None:
    """(X, Y, Z) uint64, the bits of the parts of each cell of a computed field's grid; None where they would
    take too long to be told, or thin fog is much of what there is."""
    grid: OccupancyGrid = field.occupancy
    part, cells = grid.cell.max() / SIDE, np.argwhere(grid.occupied)
    per = int(np.ceil(part / field.voxel_size))  # farther apart than a voxel matter would be missed
    if len(cells) * (SIDE * per) ** 3 > MOST_PLACES:
        return None
    bits, rest = field.look_into(cells, places(per), np.array([SURFACE, *FAINT]) / part, OPAQUE / part)
    for own, lost in zip(bits[1:], SIDE * part * rest[1:], strict=True):
        if lost_along_lines(grid, cells, lost) <= LOST:
            return grown(grid, cells, bits[0]) | in_cells(grid, cells, own)
    return None


def places(per: int) -> np.ndarray:
    """(64 per³, 3) places in a cell, `per` along each axis of each part, part by part in the order of their
    bits."""
    halves = np.arange(2)
    at = [halves[:, None, None] / 2, halves[:, None] / 4, (np.arange(per) + 0.5) / (SIDE * per)]
    axis = (at[0] + at[1] + at[2]).reshape(-1)  # far, near, within
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), -1)
    split = grid.reshape(*(2, 2, per) * 3, 3)
    return split.transpose(0, 3, 6, 1, 4, 7, 2, 5, 8, 9).reshape(-1, 3)


def lost_along_lines(grid: OccupancyGrid, cells: np.ndarray, depths: np.ndarray) -> float:
    """The root mean square, over the lines of cells along the axes that pass an occupied one, of what depths
    (N,) of cells (N, 3) add up to along it."""
    lost = in_cells(grid, cells, depths)
    sums = [lost.sum(axis)[grid.occupied.any(axis)] for axis in range(3)]
    return float(np.sqrt(np.square(np.concatenate(sums), dtype=np.float64).mean())) if len(cells) else 0.0


def in_cells(grid: OccupancyGrid, cells: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(X, Y, Z) of values (N,) of cells (N, 3), 0 in others."""
    found = np.zeros(grid.occupied.shape, values.dtype)
    found[tuple(cells.T)] = values
    return found


def grown(grid: OccupancyGrid, cells: np.ndarray, bits: np.ndarray) -> np.ndarray:
    """(X, Y, Z) uint64 of bits (N,) of cells (N, 3), grown by a part where cells are occupied: what a field
    says elsewhere was never learnt."""
    found = in_cells(grid, cells, bits)
    for axis in range(3):
        wider = np.empty_like(found)
        grow_insides(found, axis, wider)
        found = wider
    found[~grid.occupied] = 0
    return found


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
