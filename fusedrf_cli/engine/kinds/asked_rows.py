"""The rows of a hash grid that points of marked cells ask: those of the vertices around them."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
import torch

from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class AskedRowsConfig:
    """How they are found."""

    rounded: float = 1e-3
    """Of the spacing of vertices: more than rounding makes of a point."""
    most_met: float = 8.0
    """Cells of a lattice for each of its rows: then nine in ten of the rows are asked."""
    vertices_at_once: int = 1 << 22
    """Of a lattice: some 100 MB."""


@dataclass(frozen=True)
class Lattice:
    """A level of a hash grid: vertices at whole multiples of a spacing."""

    box: np.ndarray
    """(6,) that the masks lie over, in the lattice's coordinates."""
    spacing: float
    rows: int
    row_of: Callable[[torch.Tensor], torch.Tensor]
    """Which row vertices (N, 3) int64 have, (N,)."""


def asked_rows(levels: Sequence[Lattice], masks: Sequence[np.ndarray]) -> np.ndarray:
    """(R,) bool, level after level: the rows that some point asks of the cells that all masks (X, Y, Z) mark;
    all of a level of which so many cells are met that most are."""
    smallest = min(mask.mean() for mask in masks)
    parts = []
    for level in levels:
        sides = level.box[3:] - level.box[:3]
        most = current(AskedRowsConfig).most_met * level.rows
        asked = np.full(level.rows, smallest * (sides / level.spacing).prod() > most)
        if not asked.all():
            for vertices in met_vertices(level.box, masks, level.spacing):
                asked[level.row_of(torch.from_numpy(vertices)).numpy()] = True
        parts.append(asked)
    return np.concatenate(parts)


def met_vertices(box: np.ndarray, masks: Sequence[np.ndarray], spacing: float) -> Iterator[np.ndarray]:
    """(N, 3) int64, a part after the other: the vertices of a lattice of that spacing around the points of a
    box (6,) that lie in marked cells (X, Y, Z) of all the masks over it."""
    config = current(AskedRowsConfig)
    first = np.floor(box[:3] / spacing - config.rounded).astype(np.int64)
    count = np.floor(box[3:] / spacing + config.rounded).astype(np.int64) + 1 - first
    layers = max(1, config.vertices_at_once // int(count[1:].prod()))
    for start in range(0, count[0], layers):
        low, sides = first + [start, 0, 0], np.array([min(layers, count[0] - start), *count[1:]])
        cells = np.ones(sides, bool)
        for mask in masks:
            cells &= overlapping(mask, box, low, sides, spacing)
        met = np.zeros(sides + 1, bool)
        for corner in product((0, 1), repeat=3):
            met[tuple(slice(c, c + n) for c, n in zip(corner, sides, strict=True))] |= cells
        yield np.argwhere(met) + low


def overlapping(
    mask: np.ndarray, box: np.ndarray, low: np.ndarray, sides: np.ndarray, spacing: float
) -> np.ndarray:
    """(sides) bool: which cells of a lattice of that spacing, from the one at `low` (3,) on, meet one of the
    marked cells (X, Y, Z) of a box (6,)."""
    for axis, cells in enumerate(mask.shape):
        ends = (low[axis] + np.arange(sides[axis] + 1)) * spacing - box[axis]
        at, off = ends / (box[axis + 3] - box[axis]) * cells, current(AskedRowsConfig).rounded * spacing
        off *= cells / (box[axis + 3] - box[axis])
        begin = np.floor(at[:-1] - off).clip(0, cells - 1).astype(np.int64)
        last = (np.ceil(at[1:] + off) - 1).clip(0, cells - 1).astype(np.int64)
        met = mask.take(begin, axis)
        for step in range(1, int((last - begin).max()) + 1):
            met |= mask.take(np.minimum(begin + step, last), axis)
        mask = met
    return mask
