"""The occupancy grid of a field: which cells of its box are occupied, and how far away the next such cell
is."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType

import numpy as np
import torch

from fusedrf_cli.engine.fields.cell_bits import few_cells, most_bits, saves
from fusedrf_cli.engine.kernels import GridArrays
from fusedrf_cli.engine.kernels.field_free import mark_cells
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded, unbounded


@dataclass(frozen=True)
class OccupancyConfig:
    """How fine grids of cells are."""

    cells: int = 128
    """Along the longest axis of a field's own grid, at most."""
    scene_cells: int = 160
    """Along the longest axis of a scene, and of what it is fused to: both are framed alike."""
    points_at_once: int = 1 << 18
    """Of a placed grid: some 20 MB."""


MAX_STRIDE = 255
MOST_POINTS = 1 << 25  # of a placed grid, by which cells are found: of one that is huge there are far more
# where in a cell its density is probed
PROBES = np.stack(np.meshgrid(*[[0.25, 0.75]] * 3, indexing="ij"), -1).reshape(-1, 3)


@dataclass(frozen=True)
class OccupancyGrid:
    """Cells of an axis-aligned box, occupied or empty."""

    aabb: np.ndarray
    """(6,) float64 [xmin ymin zmin xmax ymax zmax], in the coordinates of the space, which are those of the
    frame of the field that owns the grid where that is bounded."""
    occupied: np.ndarray
    """(X, Y, Z) bool."""
    space: ModuleType = bounded
    """That its cells, and the numbers of the field that owns it, lie in (engine/spaces)."""
    stride: np.ndarray | None = None
    """(X, Y, Z) uint16: samples in a cell may lie so many times `unit` apart; None: a step everywhere."""
    unit: float = 0.0
    """Of the strides, or without them the distance of samples; 0: it follows from the field's voxel."""
    looked_at: np.ndarray | None = None
    """(6,) box of the frame that views look at; None: it follows from the cells."""

    @classmethod
    def full(cls, aabb: np.ndarray, cells: int = 1, space: ModuleType = bounded) -> "OccupancyGrid":
        """A grid that skips nothing."""
        return cls(np.asarray(aabb, np.float64), np.ones(cell_counts(aabb, cells), bool), space)

    def marked(self, occupied: np.ndarray) -> "OccupancyGrid":
        """A grid over the same box with other cells (X, Y, Z) bool, perhaps more or fewer, sampled evenly."""
        return OccupancyGrid(self.aabb, occupied, self.space)

    @property
    def cell(self) -> np.ndarray:
        """(3,) size of a cell, in units of the frame."""
        return (self.aabb[3:] - self.aabb[:3]) / self.occupied.shape

    def stored_bits(self, numbers: int) -> int:
        """At most so many bits for its cells, or for some of them, in a file beside so many numbers."""
        cells = self.occupied.size
        bricks = cells > few_cells(numbers) and saves(self._most_bits, cells)
        return self._most_bits if bricks else cells

    @cached_property
    def _most_bits(self) -> int:
        return most_bits(self.occupied)

    @cached_property
    def skip(self) -> np.ndarray:
        """(X, Y, Z) uint8: 0 in an occupied cell, else the Chebyshev distance in cells to the nearest
        occupied one (at most 255)."""
        if not self.occupied.any():
            return np.full(self.occupied.shape, 255, np.uint8)
        if self.occupied.all():
            return np.zeros(self.occupied.shape, np.uint8)
        from scipy.ndimage import distance_transform_cdt

        return np.minimum(distance_transform_cdt(~self.occupied, "chessboard"), 255).astype(np.uint8)

    @cached_property
    def arrays(self) -> GridArrays:
        """The arrays kernels read."""
        arrays = GridArrays(self.skip, self.aabb[:3].copy(), self.aabb[3:].copy(), self.cell)
        if self.stride is None:
            return arrays
        return arrays._replace(stride=self.stride, unit=self.unit)

    @cached_property
    def passage(self) -> float:
        """The longest way of a ray through occupied cells, at most, in lengths that samples may lie apart, as
        many times a step, or `unit` where there are strides: each of its pieces, in a region of its own where
        the space tells them, passes the layers of cells along the axis that it follows most, each in at most
        √3 times its thickness."""
        if not self.occupied.any():
            return 0.0
        pieces = [
            self.longest_in(box) for box in getattr(self.space, "REGIONS", [self.aabb] * self.space.PIECES)
        ]
        return float(np.sqrt(3) * sum(sorted(pieces)[-self.space.PIECES :]))

    def longest_in(self, box: np.ndarray) -> float:
        """Of the axes, the longest sum of thicknesses of layers of cells in a box (6,) by how far samples in
        them may lie apart."""
        first = np.floor((box[:3] - self.aabb[:3]) / self.cell + 1e-9).astype(int)
        end = np.ceil((box[3:] - self.aabb[:3]) / self.cell - 1e-9).astype(int)
        cells = tuple(slice(max(a, 0), max(b, 0)) for a, b in zip(first, end, strict=True))
        occupied, lengths = self.occupied[cells], []
        for axis in range(3):
            others = tuple({0, 1, 2} - {axis})
            often = occupied.any(others)
            if self.stride is not None:
                closest = self.stride[cells].min(others, where=occupied, initial=MAX_STRIDE)
                often = often / np.maximum(closest, 1)
            lengths.append(often.sum() * self.cell[axis])
        return max(lengths)

    def most_samples(self, step: float) -> int:
        """How many samples a ray can have in occupied cells, at most; step: where there are no strides."""
        apart = step if self.stride is None else self.unit
        passed = self.passage / apart + self.space.PIECES
        return int(min(passed, self.space.most_samples(self.aabb, apart)))

    def tight_aabb(self, margin_cells: float = 1.0) -> np.ndarray:
        """(6,) box around the occupied cells plus a margin, inside the grid's own box; that box itself where
        all is empty."""
        if not self.occupied.any():
            return self.aabb
        layers = [np.flatnonzero(self.occupied.any(tuple({0, 1, 2} - {axis}))) for axis in range(3)]
        lo = self.aabb[:3] + (np.array([layer[0] for layer in layers]) - margin_cells) * self.cell
        hi = self.aabb[:3] + (np.array([layer[-1] for layer in layers]) + 1 + margin_cells) * self.cell
        return np.concatenate([np.maximum(lo, self.aabb[:3]), np.minimum(hi, self.aabb[3:])])

    @property
    def look_at_box(self) -> np.ndarray:
        """(6,) box of the field's frame that views of it look at: that around the occupied cells, or, in
        spaces without end, the middle of the core; of a grid that does not reach there, since all cameras
        stand in the core and look one way, the middle half of the cells no farther than 5 from it."""
        if self.looked_at is not None:
            return self.looked_at
        if self.space is bounded:
            return self.tight_aabb(0)
        if hasattr(self.space, "LOOK_AT_BOX") and (self.aabb[:3] < 0).all() and (self.aabb[3:] > 0).all():
            return self.space.LOOK_AT_BOX
        points = self.space.inv_contract(torch.from_numpy(self.centres())).numpy()
        near = np.abs(points).max(1) < 5
        chosen = points[near] if near.any() else points
        return np.concatenate(np.quantile(chosen, [0.25, 0.75], axis=0))

    def within(self, aabb: np.ndarray) -> "OccupancyGrid":
        """The cells of a box (6,) whose faces are, but for rounding, those of cells."""
        first, end = np.rint((aabb.reshape(2, 3) - self.aabb[:3]) / self.cell).astype(int)
        cells = tuple(slice(a, b) for a, b in zip(first, end, strict=True))
        return replace(self, aabb=np.asarray(aabb, np.float64), occupied=self.occupied[cells])

    def limited(self, limits: "OccupancyGrid") -> "OccupancyGrid":
        """The occupied cells that those of another grid of this space reach into; all where none does."""
        reached, middles = np.zeros_like(self.occupied), limits.centres()
        # Spots in a cell of the limits, its corners about, no farther apart than own cells are wide.
        counts = 1 + np.ceil(limits.cell / self.cell).astype(int)
        axes = [0.4999 * np.linspace(-c, c, n) for c, n in zip(limits.cell, counts, strict=True)]
        for spot in np.stack(np.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3):
            index = np.floor((middles + spot - self.aabb[:3]) / self.cell).astype(int)
            inside = ((index >= 0) & (index < self.occupied.shape)).all(1)
            reached[tuple(index[inside].T)] = True
        reached &= self.occupied
        return self.marked(reached) if reached.any() else self

    def dilated(self, cells: int = 1) -> "OccupancyGrid":
        """The grid with every occupied region grown by a number of cells, along one axis after the other."""
        grown = self.occupied.copy()
        for axis in np.repeat(range(3), cells):
            along = np.moveaxis(grown, axis, 0)
            before = along.copy()
            along[1:] |= before[:-1]
            along[:-1] |= before[1:]
        return self.marked(grown)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: which points (N, 3) of the space's coordinates lie in an occupied cell."""
        index = np.floor((points - self.aabb[:3]) / self.cell).astype(np.int64)
        inside = ((index >= 0) & (index < self.occupied.shape)).all(1)
        contained = np.zeros(len(points), bool)
        i, j, k = index[inside].T
        contained[inside] = self.occupied[i, j, k]
        return contained

    def strides_at(self, points: np.ndarray) -> np.ndarray:
        """(N,) how many times `unit` samples may lie apart at points (N, 3) of the space's coordinates, the
        least near them."""
        if self.stride is None:
            return np.ones(len(points))
        from scipy.ndimage import minimum_filter

        least = minimum_filter(np.where(self.occupied, self.stride, MAX_STRIDE), 3)
        index = np.floor((points - self.aabb[:3]) / self.cell).astype(np.int64)
        return least[tuple(np.clip(index, 0, np.array(least.shape) - 1).T)]

    def centres(self) -> np.ndarray:
        """(M, 3) centres of the occupied cells."""
        return self.aabb[:3] + (np.argwhere(self.occupied) + 0.5) * self.cell


def harmless_depth(depth: np.ndarray, most: float, shown: float) -> float:
    """The largest optical depth, at most `most`, up to which cells may be left out of a grid of optical
    depths (X, Y, Z) without any axis-parallel line of cells losing more than `shown` in all: thin floaters
    are no emptiness.
    """
    for threshold in most * 0.25 ** np.arange(12):
        lost = np.where(depth <= threshold, depth, 0)
        if max(lost.sum(axis).max() for axis in range(3)) <= shown:
            return float(threshold)
    return 0.0


def cell_counts(aabb: np.ndarray, longest: int) -> tuple[int, int, int]:
    """Cells per axis of near-cubic cells, `longest` of them on the longest axis."""
    extent = np.asarray(aabb, np.float64)[3:] - np.asarray(aabb, np.float64)[:3]
    return tuple(int(n) for n in np.maximum(np.ceil(extent / extent.max() * longest - 1e-9), 1))


def texels(aabb: np.ndarray, longest: int, thinnest: int = 12) -> tuple[int, int, int]:
    """Texels per axis of near-cubic voxels, `longest` on the longest axis; a flat box still gets `thinnest`
    across."""
    return tuple(max(min(thinnest, longest), n) for n in cell_counts(aabb, longest))


def placed_cells(
    boxes: np.ndarray, placed: Iterable[tuple[OccupancyGrid, np.ndarray]], longest: int
) -> tuple[np.ndarray, Iterator[np.ndarray]]:
    """The box (6,) of one grid over several placed ones, and which of its cells each of them may reach
    (conservative by up to a cell), one after the other.

    placed are (grid, (4, 4) object_to_field), taken one at a time, and boxes (N, 6) the boxes around their
    occupied cells after placing; the new grid has near-cubic cells, `longest` on its longest axis.
    """
    lo, hi = boxes[:, :3].min(0), boxes[:, 3:].max(0)
    margin = (hi - lo).max() / longest
    aabb = np.concatenate([lo - margin, hi + margin])
    return aabb, (marked_cells(grid, matrix, aabb, longest) for grid, matrix in placed)


def unbounded_cells(placed: Iterable[tuple[OccupancyGrid, np.ndarray]], longest: int) -> Iterator[np.ndarray]:
    """Which cells of a grid over unbounded space, `longest` along each axis, each of several placed grids may
    reach; placed as in `placed_cells`, into the frame of that space."""
    for grid, object_to_field in placed:
        if grid.space is bounded:
            yield marked_cells(grid, object_to_field, unbounded.WHOLE, longest, unbounded)
        else:
            yield shared_cells(grid, object_to_field, longest)


def shared_cells(grid: OccupancyGrid, object_to_field: np.ndarray, longest: int) -> np.ndarray:
    """(X, Y, Z) bool: cells of a grid over unbounded space that occupied cells of a grid in a space without
    end, placed by a (4, 4), reach: those that share a volume with one where it lies as it is, else those
    whose middle lies in or beside one."""
    if grid.space is unbounded and np.array_equal(object_to_field, np.eye(4)):
        return overlapped(grid, longest)
    grown, back = grid.dilated(), np.linalg.inv(object_to_field)
    full = OccupancyGrid.full(unbounded.WHOLE, longest, unbounded)
    marked = []
    for part in np.array_split(
        full.centres(), -(-full.occupied.size // current(OccupancyConfig).points_at_once)
    ):
        at = unbounded.inv_contract(torch.from_numpy(part)).numpy() @ back[:3, :3].T + back[:3, 3]
        marked.append(grown.contains(mapped(at, grid.space)))
    return np.concatenate(marked).reshape(full.occupied.shape)


def overlapped(grid: OccupancyGrid, longest: int, aabb: np.ndarray = unbounded.WHOLE) -> np.ndarray:
    """(X, Y, Z) bool: cells of a box (6,) in a grid's coordinates, `longest` along its longest axis, that
    share a volume with an occupied cell of the grid; by default of all of unbounded space."""
    occupied, counts = grid.occupied, np.asarray(grid.occupied.shape)
    shape, sides = cell_counts(aabb, longest), aabb[3:] - aabb[:3]
    for axis, count in enumerate(counts):
        low, side = grid.aabb[axis], grid.aabb[axis + 3] - grid.aabb[axis]
        edges = aabb[axis] + sides[axis] / shape[axis] * np.arange(shape[axis] + 1)
        at = (edges - low) / side * count
        at = np.where(abs(at - np.rint(at)) < 1e-9, np.rint(at), at)  # faces but for rounding
        first, last = np.floor(at[:-1]).astype(int), np.ceil(at[1:]).astype(int)
        runs = zip(np.clip(first, 0, count), np.clip(last, 0, count), strict=True)
        occupied = np.stack([occupied.take(range(a, b), axis).any(axis) for a, b in runs], axis)
    return occupied


def mapped(points: np.ndarray, space: ModuleType) -> np.ndarray:
    """Points (N, 3) of a frame in the coordinates of a space."""
    return space.contract(torch.from_numpy(points)).numpy()


def marked_cells(
    grid: OccupancyGrid,
    object_to_field: np.ndarray,
    aabb: np.ndarray,
    longest: int,
    space: ModuleType = bounded,
) -> np.ndarray:
    """(X, Y, Z) bool: cells of a field's box, in the coordinates of its space, that a placed grid's occupied
    cells reach, grown by one."""
    counts = np.array(cell_counts(aabb, longest))
    cell = (aabb[3:] - aabb[:3]) / counts
    points = (
        np.maximum(
            np.ceil(np.linalg.norm(object_to_field[:3, :3], axis=0) * grid.cell / cell.min()), 1
        ).astype(int)
        + 1
    )
    n_points = np.prod(points, dtype=float) * (1 if space is bounded else grid.occupied.sum())
    if n_points > MOST_POINTS:  # cells far larger than the box's
        return reached_cells(grid, object_to_field, aabb, counts, space)
    steps = np.stack(np.meshgrid(*[np.linspace(0, 1, n) for n in points], indexing="ij"), -1).reshape(-1, 3)
    corners = grid.aabb[:3] + np.argwhere(grid.occupied) * grid.cell
    marked = np.zeros(counts, bool)
    if space is bounded:
        linear = object_to_field[:3, :3].T / cell
        begin = corners @ linear + (object_to_field[:3, 3] - aabb[:3]) / cell
        mark_cells(begin, steps * grid.cell @ linear, marked)
        return OccupancyGrid(aabb, marked).dilated().occupied
    # Many cells and few steps, or, in a coarse grid, the other way round: loop over the fewer.
    fewer, more = sorted((corners, steps * grid.cell), key=len)
    for part in (
        np.array_split(more, -(-len(more) // current(OccupancyConfig).points_at_once)) if len(more) else ()
    ):
        for offset in fewer:
            at = mapped((part + offset) @ object_to_field[:3, :3].T + object_to_field[:3, 3], space)
            index = np.clip(np.floor((at - aabb[:3]) / cell).astype(np.int64), 0, counts - 1)
            marked[tuple(index.T)] = True
    return OccupancyGrid(aabb, marked).dilated().occupied


def reached_cells(
    grid: OccupancyGrid, object_to_field: np.ndarray, aabb: np.ndarray, counts: np.ndarray, space: ModuleType
) -> np.ndarray:
    """The same, of cells (X, Y, Z) of a space in which a straight line stays one within a cell: those whose
    corners, placed in the grid, have a box around them that an occupied cell shares a volume with."""
    back = np.linalg.inv(object_to_field)
    sums = np.pad(grid.occupied.astype(np.int64).cumsum(0).cumsum(1).cumsum(2), ((1, 0),) * 3)
    last = np.array(grid.occupied.shape)
    axes = [np.linspace(low, high, n + 1) for low, high, n in zip(aabb[:3], aabb[3:], counts, strict=True)]
    reached = np.zeros(counts, bool)
    for i in range(counts[0]):
        corners = np.stack(np.meshgrid(axes[0][i : i + 2], *axes[1:], indexing="ij"), -1)
        points = space.inv_contract(torch.from_numpy(corners.reshape(-1, 3))).numpy()
        at = (points @ back[:3, :3].T + back[:3, 3] - grid.aabb[:3]) / grid.cell
        at = at.reshape(corners.shape)
        eight = np.stack([at[a, b : counts[1] + b, c : counts[2] + c] for a, b, c in np.ndindex(2, 2, 2)])
        low = np.clip(np.floor(eight.min(0)), 0, last).astype(np.int64)
        high = np.clip(np.ceil(eight.max(0)), 0, last).astype(np.int64)
        held = np.zeros(low.shape[:2], np.int64)
        for ends in np.ndindex(2, 2, 2):
            index = tuple(np.where(end, high[..., k], low[..., k]) for k, end in enumerate(ends))
            held += (-1) ** (3 - sum(ends)) * sums[index]
        reached[i] = (held > 0) & (low < high).all(-1)
    return reached


def squeezed(matrix: np.ndarray) -> float:
    """How long the shortest image of a unit of length is under a (4, 4) affine."""
    return float(np.linalg.svd(matrix[:3, :3], compute_uv=False)[-1])


def transformed_aabb(aabb: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """(6,) box around a box's eight corners after a (4, 4) affine."""
    moved = box_corners(aabb) @ matrix[:3, :3].T + matrix[:3, 3]
    return np.concatenate([moved.min(0), moved.max(0)])


def placement(origin: np.ndarray) -> np.ndarray:
    """(4, 4) of a frame that lies at `origin`: a position (3,), or that placement itself."""
    if origin.shape == (4, 4):
        return origin
    matrix = np.eye(4)
    matrix[:3, 3] = origin
    return matrix


def frame_around(box: np.ndarray) -> np.ndarray:
    """Where a frame for what lies in a box (6,) of the world has its origin, the middle: a position (3,), or,
    where the box is of no ordinary size, a placement (4, 4). Its unit is then a power of two, by which
    scaling is exact."""
    middle, side = (box[:3] + box[3:]) / 2, float((box[3:] - box[:3]).max())
    # Longest sides between which densities, per unit of length, fit the floats that they are stored as.
    if side == 0 or 2.0**-10 <= side <= 2.0**12:
        return middle
    frame = placement(middle)
    frame[:3, :3] *= 2.0 ** np.floor(np.log2(side))
    return frame


def seen_placement(object_to_world: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(4, 4) of an object seen from a frame that lies at `origin`: a position (3,), or a placement (4, 4)."""
    frame, matrix = placement(origin), object_to_world.copy()
    if np.array_equal(frame, matrix):
        return np.eye(4)
    matrix[:3, 3] -= frame[:3, 3]  # first, so that it is exact however far away both are
    if origin.shape == (4, 4):
        matrix[:3] = np.linalg.inv(frame[:3, :3]) @ matrix[:3]
    return matrix


def placed_box(box: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(6,) world box around a box (6,) of a frame that lies at `origin`: a position (3,), or a placement (4,
    4)."""
    return box + np.tile(origin, 2) if origin.shape == (3,) else transformed_aabb(box, origin)


def seen_box(box: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(6,) box of a frame that lies at `origin` around a world box (6,)."""
    if origin.shape == (3,):
        return box - np.tile(origin, 2)
    turned = origin.copy()
    turned[:3, 3] = 0
    return transformed_aabb(box - np.tile(origin[:3, 3], 2), np.linalg.inv(turned))


def box_corners(aabb: np.ndarray) -> np.ndarray:
    """(8, 3) corners of a box (6,)."""
    sides = zip(aabb[:3], aabb[3:], strict=True)
    return np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)


def enclosing(boxes: list[np.ndarray]) -> np.ndarray:
    """(6,) the box around boxes."""
    return np.concatenate([np.min([b[:3] for b in boxes], 0), np.max([b[3:] for b in boxes], 0)])
