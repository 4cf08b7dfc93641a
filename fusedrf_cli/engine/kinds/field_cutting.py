"""An object out of a field on grids, and the field without it: both have the numbers that the field has, so
that together they show what it showed."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import torch

from fusedrf_cli.engine.fields.occupancy import PROBES, OccupancyConfig, OccupancyGrid, cell_counts
from fusedrf_cli.engine.kernels.reference import OCTANTS
from fusedrf_cli.engine.selection.cells import Selection
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded, unbounded


@dataclass(frozen=True)
class FieldCuttingConfig:
    """How finely an object is cut out."""

    finest: int = 320
    """Cells along an axis of the grid of a field from which an object is gone, at most, or as many as it
    had."""
    cut: int = 256
    """Cells along the longest side of an object's grid, at most."""
    together: int = 8
    """Texels along an axis of a plane that files code by one scale."""


OWN, OTHER = 1, 2
"""Of what is in a cell of a selection."""
CORNERS = OCTANTS - 0.5
Holds = Callable[[np.ndarray], np.ndarray]
"""Which points (N, 3) of a frame are kept, (N,) bool."""
KeepsCells = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Which cells, by their middles (N, 3) and their size (3,), are kept, (N,) bool."""


def refined(grid: OccupancyGrid, voxel: float) -> OccupancyGrid:
    """The same cells, each made of several that are no smaller than about a voxel."""
    config = current(FieldCuttingConfig)
    finer = grid.occupied
    for axis, (cell, count) in enumerate(zip(grid.cell, grid.occupied.shape, strict=True)):
        finer = np.repeat(finer, max(1, min(config.finest // count, int(np.ceil(cell / voxel)))), axis)
    return grid.marked(finer)


def without_object(grid: OccupancyGrid, voxel: float, selection: Selection) -> OccupancyGrid:
    """A grid of a field with such voxels without the cells that hold cells of the object and no other
    density, so that nothing of that is lost; the grid itself where there are none."""
    finer = refined(grid, voxel)
    index = np.argwhere(finer.occupied)
    occupied, cells = finer.occupied.copy(), SelectionCells(selection)
    for part in np.array_split(index, -(-len(index) // current(OccupancyConfig).points_at_once) or 1):
        occupied[tuple(part[emptied(finer, part, cells)].T)] = False
    return grid if (occupied == finer.occupied).all() else grid.marked(occupied)


class SelectionCells:
    """What the cells of a selection hold, by points of the coordinates of the lattice."""

    def __init__(self, selection: Selection):
        grid, self.selection = selection.lattice.grid, selection
        self.low, self.cell, self.box = grid.aabb[:3], grid.cell, selection.object.tight_aabb(1)
        # a cell more on each side, where there is nothing
        owners = np.where(selection.object.occupied, OWN, selection.other.occupied * OTHER)
        padded = np.pad(owners.astype(np.uint8), 1)
        self.flat, self.last = padded.ravel(), np.array(padded.shape) - 1

    def at(self, points: np.ndarray) -> np.ndarray:
        """(N,) uint8: OWN where points (N, 3) lie in the object, OTHER in other density, 0 in neither."""
        index = np.clip(np.floor((points - self.low) / self.cell) + 1, 0, self.last).astype(np.int64)
        rows, columns = self.last[1] + 1, self.last[2] + 1
        return self.flat[(index[:, 0] * rows + index[:, 1]) * columns + index[:, 2]]


def emptied(grid: OccupancyGrid, index: np.ndarray, cells: SelectionCells) -> np.ndarray:
    """(N,) bool: which cells (N, 3) of a grid hold cells of the object and no other density."""

    def to_lattice(points: np.ndarray) -> np.ndarray:
        return cells.selection.lattice_points(points, grid.space)

    middles = grid.aabb[:3] + (index + 0.5) * grid.cell
    at, diagonals = (
        to_lattice(middles),
        CORNERS[:1] if cells.selection.is_aligned(grid.space) else CORNERS[:4],
    )
    corners = (to_lattice(middles + corner * grid.cell) for corner in diagonals)
    # Cells of the selection may be narrower, or wider.
    reach = 2 * max(np.abs(corner - at).max(initial=0) for corner in corners)
    left = np.flatnonzero(((at > cells.box[:3] - reach) & (at < cells.box[3:] + reach)).all(1))
    owners = cells.at(at[left]) & OWN
    for probe in PROBES:
        owners |= cells.at(to_lattice(middles[left] + (probe - 0.5) * grid.cell))
        alone = owners & OTHER == 0
        left, owners = left[alone], owners[alone]
    empty = np.zeros(len(index), bool)
    empty[left] = owners == OWN
    return empty


def with_object(
    grid: OccupancyGrid, box: np.ndarray, narrowest: float, inside: KeepsCells
) -> OccupancyGrid | None:
    """Cells over a box (6,), no wider than `narrowest` where that takes at most `cut` of them, that are
    occupied in a grid and that `inside` keeps; None where there is none."""
    longest = int(np.clip(np.ceil((box[3:] - box[:3]).max() / narrowest), 1, current(FieldCuttingConfig).cut))
    cells = OccupancyGrid.full(box, longest, grid.space)
    middles = cells.centres()
    covered = grid.contains(middles)
    covered[covered] = inside(middles[covered], cells.cell)
    return cells.marked(covered.reshape(cell_counts(box, longest))) if covered.any() else None


def cut_out(field, box: np.ndarray, selection: Selection):
    """The object as a field over the texels around it of a field that has `resampled` over a box (6,); None
    where there is nothing of it."""
    looked_in = selection.box_in(field.occupancy)
    if (looked_in[3:] <= looked_in[:3]).any():
        return None

    def inside(points: np.ndarray, size: np.ndarray) -> np.ndarray:
        return selection.object.contains(selection.lattice_points(points, field.space))

    return part_within(field, box, selection.cell_in(), inside, looked_in)


def crop_of(field, box: np.ndarray, holds: Holds):
    """What of a field as in `cut_out` lies where `holds` says so of points of its frame: cells of a voxel
    that lie there wholly. None where there is nothing."""
    inside = partial(wholly, field, holds)
    return part_within(field, box, field.voxel_size, inside, field.occupancy.aabb)


def restricted(field, holds: Holds):
    """A field, with all its texels, without the cells that do not lie wholly where `holds` says so; they are
    parts of its own cells, so that nothing shows that was empty before. None where nothing is left."""
    grid = refined(field.occupancy, field.voxel_size)
    index, occupied = np.argwhere(grid.occupied), grid.occupied.copy()
    for part in np.array_split(index, -(-len(index) // current(OccupancyConfig).points_at_once) or 1):
        occupied[tuple(part.T)] = wholly(field, holds, grid.aabb[:3] + (part + 0.5) * grid.cell, grid.cell)
    return field.with_occupancy(grid.marked(occupied)) if occupied.any() else None


def wholly(field, holds: Holds, middles: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(N,) bool: which cells of a size (3,) around middles (N, 3) have all their corners where `holds` says
    so."""
    mask = np.ones(len(middles), bool)
    for corner in CORNERS:
        mask[mask] = holds(to_frame(middles[mask] + corner * size, field.space))
    return mask


def part_within(field, box: np.ndarray, narrowest: float, inside, looked_in: np.ndarray):
    """The part of a field, whose numbers lie over a box (6,), that `with_object` keeps, on the texels around
    it. There is none of it outside of the box `looked_in` (6,)."""
    rough = with_object(field.occupancy, looked_in, narrowest, inside)
    if rough is None:
        return None
    around, resolution = on_texels(rough.tight_aabb(1), box, field.resolution)
    cells = with_object(field.occupancy, around, narrowest, inside)
    if cells is None:
        return None
    if field.space is unbounded and np.abs(around).max() <= 1:  # in the core coordinates are the frame's
        cells = replace(cells, space=bounded)
    return (field.resampled(around, resolution) if field.over_texels else field).with_occupancy(cells)


def to_frame(points: np.ndarray, space) -> np.ndarray:
    """Points (N, 3) of a space's coordinates in the frame."""
    return space.inv_contract(torch.from_numpy(points)).numpy()


def on_texels(
    target: np.ndarray, box: np.ndarray, resolution: tuple[int, int, int]
) -> tuple[np.ndarray, tuple[int, int, int]]:
    """The smallest box (6,) around another whose faces lie on texels of a field over `box` (6,), the lower
    ones on those of `together`, and how many of them it has per axis: on it resampling takes over the very
    numbers, and what files code together stays so."""
    count = np.asarray(resolution) - 1
    spacing = (box[3:] - box[:3]) / count
    first = np.clip(np.floor((target[:3] - box[:3]) / spacing + 1e-6), 0, count - 1).astype(int)
    first -= first % current(FieldCuttingConfig).together
    last = np.clip(np.ceil((target[3:] - box[:3]) / spacing - 1e-6), first + 1, count).astype(int)
    faces = np.concatenate([box[:3] + first * spacing, box[:3] + last * spacing])
    return faces, tuple(int(n) for n in last - first + 1)


def cut_away(field, selection: Selection):
    """A field without an object: itself where it has nothing of it; None where nothing is left."""
    around = selection.box_in(field.occupancy)
    if (around[3:] <= around[:3]).any():
        return field
    left = without_object(field.occupancy, field.voxel_size, selection)
    if left is field.occupancy:
        return field
    part = field.with_occupancy(left) if left.occupied.any() else field
    return None if part is field else part
