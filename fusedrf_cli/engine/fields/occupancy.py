"""The occupancy grid of a field: which cells of its box hold matter, and how far away the next such cell
is."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType

import numpy as np
import torch

from fusedrf_cli.engine.kernels import GridArrays
from fusedrf_cli.engine.spaces import bounded, unbounded

DEFAULT_CELLS = 128
SCENE_CELLS = 160  # along the longest axis of a scene, and of what it is fused to: both are framed alike
THINNEST = 12  # texels across a flat box
POINTS_AT_ONCE = 1 << 18  # of a placed grid: some 20 MB
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

    @classmethod
    def full(cls, aabb: np.ndarray, cells: int = 1, space: ModuleType = bounded) -> "OccupancyGrid":
        """A grid that skips nothing."""
        return cls(np.asarray(aabb, np.float64), np.ones(cell_counts(aabb, cells), bool), space)

    def marked(self, occupied: np.ndarray) -> "OccupancyGrid":
        """A grid over the same box with other cells (X, Y, Z) bool, perhaps more or fewer."""
        return replace(self, occupied=occupied)

    @property
    def cell(self) -> np.ndarray:
        """(3,) size of a cell, in units of the frame."""
        return (self.aabb[3:] - self.aabb[:3]) / self.occupied.shape

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
        return GridArrays(self.skip, self.aabb[:3].copy(), self.aabb[3:].copy(), self.cell)

    def tight_aabb(self, margin_cells: float = 1.0) -> np.ndarray:
        """(6,) box around the occupied cells plus a margin, inside the grid's own box; that box itself where
        all is empty."""
        if not self.occupied.any():
            return self.aabb
        index = np.argwhere(self.occupied)
        lo = self.aabb[:3] + (index.min(0) - margin_cells) * self.cell
        hi = self.aabb[:3] + (index.max(0) + 1 + margin_cells) * self.cell
        return np.concatenate([np.maximum(lo, self.aabb[:3]), np.minimum(hi, self.aabb[3:])])

    @property
    def subject(self) -> np.ndarray:
        """(6,) box of the field's frame that views of it look at: that around the occupied cells, or, in
        unbounded space, the middle of the core."""
        return unbounded.SUBJECT if self.space is unbounded else self.tight_aabb(0)

    def dilated(self, cells: int = 1) -> "OccupancyGrid":
        """The grid with every occupied region grown by a number of cells."""
        from scipy.ndimage import binary_dilation

        return self.marked(binary_dilation(self.occupied, np.ones((3, 3, 3), bool), iterations=cells))

    def contains(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: which points (N, 3) of the space's coordinates lie in an occupied cell."""
        index = np.floor((points - self.aabb[:3]) / self.cell).astype(np.int64)
        inside = ((index >= 0) & (index < self.occupied.shape)).all(1)
        found = np.zeros(len(points), bool)
        i, j, k = index[inside].T
        found[inside] = self.occupied[i, j, k]
        return found

    def centres(self) -> np.ndarray:
        """(M, 3) centres of the occupied cells."""
        return self.aabb[:3] + (np.argwhere(self.occupied) + 0.5) * self.cell


def harmless_depth(depth: np.ndarray, most: float, shown: float) -> float:
    """The largest optical depth, at most `most`, up to which cells may be left out of a grid of optical
    depths (X, Y, Z) without any axis-parallel line of cells losing more than `shown` in all: thin fog is no
    emptiness.
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


def texels(aabb: np.ndarray, longest: int) -> tuple[int, int, int]:
    """Texels per axis of near-cubic voxels, `longest` on the longest axis; a flat box still gets THINNEST
    across."""
    return tuple(max(min(THINNEST, longest), n) for n in cell_counts(aabb, longest))


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
    for grid, matrix in placed:
        if grid.space is unbounded:
            yield shared_cells(grid, matrix, longest)
        else:
            yield marked_cells(grid, matrix, unbounded.WHOLE, longest, unbounded)


def shared_cells(grid: OccupancyGrid, object_to_field: np.ndarray, longest: int) -> np.ndarray:
    """(X, Y, Z) bool: cells of a grid over unbounded space whose middle lies in or beside an occupied cell of
    another such grid, placed by a (4, 4)."""
    own, back = grid.dilated(), np.linalg.inv(object_to_field)
    wanted = OccupancyGrid.full(unbounded.WHOLE, longest, unbounded)
    found = []
    for part in np.array_split(wanted.centres(), -(-wanted.occupied.size // POINTS_AT_ONCE)):
        at = unbounded.placed(torch.from_numpy(part)).numpy() @ back[:3, :3].T + back[:3, 3]
        found.append(own.contains(mapped(at, unbounded)))
    return np.concatenate(found).reshape(wanted.occupied.shape)


def mapped(points: np.ndarray, space: ModuleType) -> np.ndarray:
    """Points (N, 3) of a frame in the coordinates of a space."""
    return space.contracted(torch.from_numpy(points)).numpy()


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
    steps = np.stack(np.meshgrid(*[np.linspace(0, 1, n) for n in points], indexing="ij"), -1).reshape(-1, 3)
    corners = grid.aabb[:3] + np.argwhere(grid.occupied) * grid.cell
    found = np.zeros(counts, bool)
    # Many cells and few steps, or, in a coarse grid, the other way round: loop over the fewer.
    fewer, more = sorted((corners, steps * grid.cell), key=len)
    for part in np.array_split(more, -(-len(more) // POINTS_AT_ONCE)) if len(more) else ():
        for offset in fewer:
            at = mapped((part + offset) @ object_to_field[:3, :3].T + object_to_field[:3, 3], space)
            index = np.clip(np.floor((at - aabb[:3]) / cell).astype(np.int64), 0, counts - 1)
            found[tuple(index.T)] = True
    return OccupancyGrid(aabb, found).dilated().occupied


def transformed_aabb(aabb: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    """(6,) box around a box's eight corners after a (4, 4) affine."""
    moved = box_corners(aabb) @ matrix[:3, :3].T + matrix[:3, 3]
    return np.concatenate([moved.min(0), moved.max(0)])


def placed_box(box: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(6,) world box around a box (6,) of a frame that lies at `origin`: a position (3,), or a placement (4,
    4)."""
    return box + np.tile(origin, 2) if origin.shape == (3,) else transformed_aabb(box, origin)


def seen_box(box: np.ndarray, origin: np.ndarray) -> np.ndarray:
    """(6,) box of a frame that lies at `origin` around a world box (6,)."""
    return box - np.tile(origin, 2) if origin.shape == (3,) else transformed_aabb(box, np.linalg.inv(origin))


def box_corners(aabb: np.ndarray) -> np.ndarray:
    """(8, 3) corners of a box (6,)."""
    sides = zip(aabb[:3], aabb[3:], strict=True)
    return np.stack(np.meshgrid(*sides, indexing="ij"), -1).reshape(-1, 3)
