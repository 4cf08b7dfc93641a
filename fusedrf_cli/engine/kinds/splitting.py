"""An object out of a field on grids, and the field without it: both have the numbers that the field has, so
that together they show what it showed."""

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import torch

from fusedrf_cli.engine.fields.occupancy import PROBES, OccupancyConfig, OccupancyGrid, cell_counts
from fusedrf_cli.engine.selection.cells import Selection
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded, unbounded

FINEST = 320
"""Cells along an axis of the grid of a field from which an object is gone, at most, or as many as it had."""
CUT = 256
"""Cells along the longest side of an object's grid, at most."""
TOGETHER = 8
"""Texels along an axis of a plane that files code by one scale."""
OWN, OTHER = 1, 2
"""Of what is in a cell of a selection."""
CORNERS = np.stack(np.meshgrid(*[[-0.5, 0.5]] * 3, indexing="ij"), -1).reshape(-1, 3)
Holds = Callable[[np.ndarray], np.ndarray]
"""Which points (N, 3) of a frame are kept, (N,) bool."""
KeepsCells = Callable[[np.ndarray, np.ndarray], np.ndarray]
"""Which cells, by their middles (N, 3) and their size (3,), are kept, (N,) bool."""
ToField = Callable[[np.ndarray], np.ndarray]
"""Points (N, 3) of the coordinates of a grid to those of the field that was selected in."""


def as_it_is(points: np.ndarray) -> np.ndarray:
    """The map of a grid that lies in the field's own coordinates."""
    return points


def refined(grid: OccupancyGrid, voxel: float) -> OccupancyGrid:
    """The same cells, each made of several that are no smaller than about a voxel."""
    finer = grid.occupied
    for axis, (cell, count) in enumerate(zip(grid.cell, grid.occupied.shape, strict=True)):
        finer = np.repeat(finer, max(1, min(FINEST // count, int(np.ceil(cell / voxel)))), axis)
    return grid.marked(finer)


def without_object(
    grid: OccupancyGrid, voxel: float, selection: Selection, to_field: ToField = as_it_is
) -> OccupancyGrid:
    """A grid of a field with such voxels without the cells that hold cells of the object and no other matter,
    so that nothing of that is lost; the grid itself where there are none."""
    finer = refined(grid, voxel)
    index = np.argwhere(finer.occupied)
    kept, matter = finer.occupied.copy(), Matter(selection)
    for part in np.array_split(index, -(-len(index) // current(OccupancyConfig).points_at_once) or 1):
        kept[tuple(part[emptied(finer, part, matter, to_field)].T)] = False
    return grid if (kept == finer.occupied).all() else grid.marked(kept)


class Matter:
    """What the cells of a selection hold, by points."""

    def __init__(self, selection: Selection):
        grid = selection.lattice.grid
        self.low, self.cell, self.box = grid.aabb[:3], grid.cell, selection.object.tight_aabb(1)
        # a cell more on each side, where there is nothing
        held = np.where(selection.object.occupied, OWN, selection.other.occupied * OTHER)
        whole = np.pad(held.astype(np.uint8), 1)
        self.flat, self.last = whole.ravel(), np.array(whole.shape) - 1

    def at(self, points: np.ndarray) -> np.ndarray:
        """(N,) uint8: OWN where points (N, 3) lie in the object, OTHER in other matter, 0 in neither."""
        index = np.clip(np.floor((points - self.low) / self.cell) + 1, 0, self.last).astype(np.int64)
        rows, columns = self.last[1] + 1, self.last[2] + 1
        return self.flat[(index[:, 0] * rows + index[:, 1]) * columns + index[:, 2]]


def emptied(grid: OccupancyGrid, index: np.ndarray, matter: Matter, to_field: ToField) -> np.ndarray:
    """(N,) bool: which cells (N, 3) of a grid hold cells of the object and no other matter."""
    middles = grid.aabb[:3] + (index + 0.5) * grid.cell
    at, corners = to_field(middles), to_field(middles + grid.cell / 2)
    reach = 2 * np.abs(corners - at).max(initial=0)  # cells of the selection may be narrower, or wider
    left = np.flatnonzero(((at > matter.box[:3] - reach) & (at < matter.box[3:] + reach)).all(1))
    held = matter.at(at[left]) & OWN
    for probe in PROBES:
        held |= matter.at(to_field(middles[left] + (probe - 0.5) * grid.cell))
        alone = held & OTHER == 0
        left, held = left[alone], held[alone]
    found = np.zeros(len(index), bool)
    found[left] = held == OWN
    return found


def with_object(
    grid: OccupancyGrid, box: np.ndarray, narrowest: float, inside: KeepsCells
) -> OccupancyGrid | None:
    """Cells over a box (6,), no wider than `narrowest` where that takes at most CUT of them, that are
    occupied in a grid and that `inside` keeps; None where there is none."""
    longest = int(np.clip(np.ceil((box[3:] - box[:3]).max() / narrowest), 1, CUT))
    cells = OccupancyGrid.full(box, longest, grid.space)
    middles = cells.centres()
    own = grid.contains(middles)
    own[own] = inside(middles[own], cells.cell)
    return cells.marked(own.reshape(cell_counts(box, longest))) if own.any() else None


def cut_out(field, box: np.ndarray, selection: Selection, to_field: ToField = as_it_is):
    """The object as a field over the texels around it of a field that has `resampled` over a box (6,); None
    where there is nothing of it."""
    narrowest = float(selection.lattice.grid.cell.min())
    looked_in = field.occupancy.aabb
    if to_field is as_it_is:
        looked_in = common_box(looked_in, selection.object.tight_aabb(1))
    return within(field, box, narrowest, lambda at, size: selection.object.contains(to_field(at)), looked_in)


def common_box(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(6,) what two boxes (6,) have in common."""
    return np.concatenate([np.maximum(one[:3], other[:3]), np.minimum(one[3:], other[3:])])


def cropped(field, box: np.ndarray, holds: Holds):
    """What of a field as in `cut_out` lies where `holds` says so of points of its frame: cells of a voxel
    that lie there wholly. None where there is nothing."""
    inside = partial(wholly, field, holds)
    return within(field, box, field.voxel_size, inside, field.occupancy.aabb)


def restricted(field, holds: Holds):
    """A field, with all its texels, without the cells that do not lie wholly where `holds` says so; they are
    parts of its own cells, so that nothing shows that was empty before. None where nothing is left."""
    grid = refined(field.occupancy, field.voxel_size)
    index, kept = np.argwhere(grid.occupied), grid.occupied.copy()
    for part in np.array_split(index, -(-len(index) // current(OccupancyConfig).points_at_once) or 1):
        kept[tuple(part.T)] = wholly(field, holds, grid.aabb[:3] + (part + 0.5) * grid.cell, grid.cell)
    return field.with_occupancy(grid.marked(kept)) if kept.any() else None


def wholly(field, holds: Holds, middles: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(N,) bool: which cells of a size (3,) around middles (N, 3) have all their corners where `holds` says
    so."""
    kept = np.ones(len(middles), bool)
    for corner in CORNERS:
        kept[kept] = holds(placed(middles[kept] + corner * size, field.space))
    return kept


def within(field, box: np.ndarray, narrowest: float, inside, looked_in: np.ndarray):
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
    return field.resampled(around, resolution).with_occupancy(cells)


def placed(points: np.ndarray, space) -> np.ndarray:
    """Points (N, 3) of a space's coordinates in the frame."""
    return space.placed(torch.from_numpy(points)).numpy()


def on_texels(
    wanted: np.ndarray, box: np.ndarray, resolution: tuple[int, int, int]
) -> tuple[np.ndarray, tuple[int, int, int]]:
    """The smallest box (6,) around another whose faces lie on texels of a field over `box` (6,), the lower
    ones on those of TOGETHER, and how many of them it has per axis: on it resampling takes over the very
    numbers, and what files code together stays so."""
    count = np.asarray(resolution) - 1
    spacing = (box[3:] - box[:3]) / count
    first = np.clip(np.floor((wanted[:3] - box[:3]) / spacing + 1e-6), 0, count - 1).astype(int)
    first -= first % TOGETHER
    last = np.clip(np.ceil((wanted[3:] - box[:3]) / spacing - 1e-6), first + 1, count).astype(int)
    faces = np.concatenate([box[:3] + first * spacing, box[:3] + last * spacing])
    return faces, tuple(int(n) for n in last - first + 1)


def cut_away(field, selection: Selection, to_field: ToField = as_it_is):
    """A field on one grid without an object; None where nothing is left."""
    left = without_object(field.occupancy, field.voxel_size, selection, to_field)
    return field.with_occupancy(left) if left.occupied.any() else None


def placed_in(field, object_to_field: np.ndarray, space) -> ToField:
    """The map from the coordinates of a grid in `space`, of an object placed in a field by a (4, 4), to those
    of the field."""
    if space is field.space and np.array_equal(object_to_field, np.eye(4)):
        return as_it_is

    def to_field(points: np.ndarray) -> np.ndarray:
        at = placed(points, space) @ object_to_field[:3, :3].T
        return field.space.contracted(torch.from_numpy(at + object_to_field[:3, 3])).numpy()

    return to_field
