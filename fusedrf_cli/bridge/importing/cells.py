"""Occupancy grids as the files of Instant-NGP and of what is built on it have them: cascades of 128³ cells,
or fewer, each twice as large as the one before, in Morton order."""

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid

FINEST = 512
"""Cells along an axis of the grid that cascades become, at most."""


def cells_of_bits(bits: np.ndarray, cascades: int, bound: float) -> OccupancyGrid:
    """The grid over ±bound of cascades' bits (N,), the x axis first in Morton order; cascade c covers
    ±2^c."""
    side = round((len(bits) / cascades) ** (1 / 3))
    if side < 1 or side & (side - 1) or side**3 * cascades != len(bits):
        raise FormatError(f"{len(bits):,} cells are no {cascades} cubes of a power of two")
    levels = unmortoned(bits.reshape(cascades, -1), side)
    return merged(levels, np.array([-bound] * 3 + [bound] * 3), bound)


def unmortoned(values: np.ndarray, side: int) -> np.ndarray:
    """(C, side, side, side) of rows (C, side³) in Morton order, whose lowest bit is x's."""
    coordinates = np.arange(side)
    spread = np.zeros(side, np.int64)
    for bit in range(side.bit_length() - 1):
        spread |= ((coordinates >> bit) & 1) << (3 * bit)
    index = spread[:, None, None] | spread[None, :, None] << 1 | spread[None, None, :] << 2
    return values[:, index]


def merged(levels: np.ndarray, box: np.ndarray, bound: float) -> OccupancyGrid:
    """One grid over a box of cascades (C, S, S, S) around its middle: of every cascade what lies outside of
    the one before. Where the finest cells would be too many, cells are occupied of which any part is."""
    side = levels.shape[1]
    finest = min(1.0, bound)
    count = min(round(side * bound / finest), FINEST)
    # middles of the grid's cells, and of the parts of each that is coarser than the finest cascade
    parts = max(1, round(side * bound / finest / count))
    occupied = np.zeros((count,) * 3, bool)
    at = (np.arange(count * parts) + 0.5) / (count * parts) * 2 * bound - bound
    far = np.maximum(np.abs(at) / finest, 1e-30)
    level_of = np.clip(np.ceil(np.log2(far)).astype(int), 0, len(levels) - 1)
    for level in range(len(levels)):
        half = finest * 2**level if level else finest
        half = min(half, bound)
        index = np.floor((at + half) / (2 * half) * side).astype(int)
        inside = level_of <= level
        chosen = np.flatnonzero(inside)
        if not len(chosen):
            continue
        part = levels[level][np.ix_(index[chosen], index[chosen], index[chosen])]
        if level:
            own = level_of[chosen] == level
            part &= own[:, None, None] | own[None, :, None] | own[None, None, :]
        x, y, z = np.nonzero(part)
        occupied[chosen[x] // parts, chosen[y] // parts, chosen[z] // parts] = True
    return OccupancyGrid(box, occupied)
