"""Occupancy grids as the files of Instant-NGP and of what is built on it have them: cascades of 128³ cells,
or fewer, each twice as large as the one before, in Morton order; at a point the finest counts that reaches
it."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.bridge.importing.parts import ImportedNode
from fusedrf_cli.engine.fields.box import MAX_TEXELS
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, transformed_aabb
from fusedrf_cli.engine.kinds.assembled.field import PartsField
from fusedrf_cli.engine.spaces.bounded import STEP_PER_VOXEL

SAMPLED = 3**0.5 / 1024
"""How far apart rays are sampled in the first cascade, of its side, and in others of twice that, and so on;
there it is so at least, and more where the camera is far."""

TOGETHER = 2
"""Cascades that become one grid: of cells of the finest, eight times as many as a cascade has."""
IDENTITY = np.eye(3)
MOST_CELLS = 1 << 22
"""That a grid is cut into by a box."""
MOST_PARTS = 4
"""Parts along an axis of a cell of a last cascade that is not twice as large as the one before."""


def cells_of_bits(bits: np.ndarray, bound: float) -> list[OccupancyGrid]:
    """Grids around 0 of the bits (N,) of all cascades out to ±bound; see grids_of."""
    cascades = cascades_of(bound)
    side = round((len(bits) / cascades) ** (1 / 3))
    if side < 2 or side & (side - 1) or side**3 * cascades != len(bits):
        raise FormatError(
            f"{len(bits):,} cells are no {cascades} cubes of a power of two, as a bound of {bound:g} asks for"
        )
    return grids_of(unmortoned(bits.reshape(cascades, -1), side), np.zeros(3), bound)


def cascades_of(bound: float) -> int:
    """How many cascades there are out to ±bound, the first out to ±1."""
    return 1 + max(0, int(np.ceil(np.log2(bound))))


def unmortoned(values: np.ndarray, side: int) -> np.ndarray:
    """(C, side, side, side) of rows (C, side³) in Morton order, whose lowest bit is x's."""
    coordinates = np.arange(side)
    spread = np.zeros(side, np.int64)
    for bit in range(side.bit_length() - 1):
        spread |= ((coordinates >> bit) & 1) << (3 * bit)
    index = spread[:, None, None] | spread[None, :, None] << 1 | spread[None, None, :] << 2
    return values[:, index]


def grids_of(
    levels: Sequence[np.ndarray], middle: np.ndarray, bound: float, unit: float = 1.0
) -> list[OccupancyGrid]:
    """Grids around a middle (3,) that are occupied where cascades (S, S, S) are, each where none before it
    reaches: cascade c out to ±2^c units, the last out to ±bound. No cell is in two grids.

    One grid of the finest cells all over would have (S bound)³.
    """
    whole = len(levels) if bound <= 1 or np.log2(bound) == int(np.log2(bound)) else len(levels) - 1
    groups = [range(n, min(n + TOGETHER, whole)) for n in range(0, whole, TOGETHER)]
    grids = []
    for group in groups + [range(n, n + 1) for n in range(whole, len(levels))]:
        half = min(2.0 ** group[-1], bound)
        parts = 1 if group[-1] < whole else parts_of(levels[-1].shape[0], group[-1], bound)
        occupied = nested([levels[n] for n in group], parts)
        if group[0]:
            emptied(occupied, 2.0 ** (group[0] - 1) / half)
        box = np.concatenate([middle - half * unit, middle + half * unit])
        apart = SAMPLED * 2.0 ** group[0] * 2 * unit * min(1.0, bound)
        grids.append(OccupancyGrid(box, occupied, unit=apart))
    return grids


def nested(levels: Sequence[np.ndarray], parts: int) -> np.ndarray:
    """One grid of cascades that follow each other, of the finest one's cells, or of parts of them."""
    made = levels[0].repeat(parts, 0).repeat(parts, 1).repeat(parts, 2)
    for level in levels[1:]:
        quarter, often = len(made) // 2, 2 * len(made) // len(level)
        wider = level.repeat(often, 0).repeat(often, 1).repeat(often, 2)
        inner = slice(quarter, quarter + len(made))
        wider[inner, inner, inner] = made
        made = wider
    return made


def parts_of(side: int, cascade: int, bound: float) -> int:
    """Into how many parts cells of a last cascade are cut, so that the one before ends between them."""
    for parts in range(1, MOST_PARTS + 1):
        if (2 ** (cascade - 1) / bound * side * parts / 2) % 1 == 0:
            return parts
    return 1


def emptied(occupied: np.ndarray, share: float) -> None:
    """Empty the cells that lie within the inner part of a grid (S, S, S), of this share of its side."""
    first = int(np.ceil(len(occupied) * (1 - share) / 2 - 1e-9))
    inner = slice(first, len(occupied) - first)
    occupied[inner, inner, inner] = False


def cropped(
    grids: Sequence[OccupancyGrid], box: np.ndarray, to_local: np.ndarray = IDENTITY
) -> list[OccupancyGrid]:
    """The grids without the cells outside of a box (6,) of a frame that a matrix (3, 3) takes points to. The
    box's faces are met as well as MOST_CELLS cells do; those of a grid that is occupied all over exactly,
    where the frame is not turned."""
    made = []
    for grid in grids:
        low, high = transformed_aabb(grid.aabb, framed(to_local)).reshape(2, 3)
        if (box[:3] <= low).all() and (box[3:] >= high).all() or not grid.occupied.any():
            made.append(grid)
            continue
        if grid.occupied.all() and np.array_equal(to_local, IDENTITY):
            inner = np.concatenate([np.maximum(low, box[:3]), np.minimum(high, box[3:])])
            if (inner[:3] < inner[3:]).all():
                made.append(replace(OccupancyGrid.full(inner), unit=grid.unit))
            continue
        tight = grid.within(grid.tight_aabb(0))
        parts = max(1, int((MOST_CELLS / tight.occupied.size) ** (1 / 3) + 1e-9))
        finer = replace(tight, occupied=tight.occupied.repeat(parts, 0).repeat(parts, 1).repeat(parts, 2))
        x, y, z = (
            low + (np.arange(n) + 0.5) * cell
            for low, n, cell in zip(finer.aabb[:3], finer.occupied.shape, finer.cell, strict=True)
        )
        for axis, row in enumerate(to_local):
            at = row[0] * x[:, None, None] + row[1] * y[:, None] + row[2] * z
            finer.occupied[(at < box[axis]) | (at >= box[axis + 3])] = False
        made.append(finer.within(finer.tight_aabb(0)) if finer.occupied.any() else finer)
    return made


def framed(linear: np.ndarray) -> np.ndarray:
    """(4, 4) of a matrix (3, 3)."""
    matrix = np.eye(4)
    matrix[:3, :3] = linear
    return matrix


def nodes_of(
    field: PartsField, grids: Sequence[OccupancyGrid], placement: np.ndarray, of_texels: bool = False
) -> list[ImportedNode]:
    """A field in the cells of grids, once for each that has any; all have the same numbers. Unless these lie
    on texels, a grid that says how far apart rays are sampled in it is sampled so."""
    held, nodes = [grid for grid in grids if grid.occupied.any()], []
    if not held:
        raise FormatError("none of the cells that it shows is occupied, so that there is nothing to see")
    for n, grid in enumerate(held):
        resolution = field.resolution
        if grid.unit and not of_texels:
            texels = np.ceil(STEP_PER_VOXEL * (field.box[3:] - field.box[:3]) / grid.unit - 1e-6) + 1
            resolution = tuple(int(count) for count in texels.clip(2, MAX_TEXELS))
        shown = PartsField(
            field.shape, field.box, resolution, field.scale, field.shift, field.params,
            occupancy=grid.marked(grid.occupied),
        )  # fmt: skip
        nodes.append(ImportedNode(shown, placement, "" if len(held) == 1 else f"-{n + 1}"))
    return nodes
