"""Which cells of a field are an object's."""

from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from types import ModuleType

import numpy as np
import torch
from scipy.ndimage import label, uniform_filter

from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, cell_counts, mapped, transformed_aabb
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded


@dataclass(frozen=True)
class CellConfig:
    """How an object's cells are told from others."""

    coarse: int = 128
    """Cells along the longest side of a field, of a first look at all of it."""
    fine: int = 192
    """Of a second look at the object's box."""
    dense: float = 0.02
    """Optical depth along a cell from which it is occupied that shows."""
    aside: float = 0.05
    """A piece with less than so much of the largest one's weight is not the object's."""
    island: float = 0.05
    """Of the object's cells: a piece of other density with fewer, inside of its box and touching nothing
    outside, cannot stand without it."""
    mixed: int = 2
    """Cells from other density up to which a cell may hold some of it."""
    window: int = 4
    """Cells up to which colours are compared."""
    foreign: float = 2.0
    """How many times farther from the object's colours nearby than from those of other density a cell's
    colour is that is not its."""
    contrast: float = 0.15
    """How far these colours must lie apart, of 1 in each channel."""
    asked_at_once: int = 1 << 20


@dataclass(frozen=True, eq=False)
class CellGrid:
    """Cells of a box in the coordinates of a field's space, those of them that the field has density in."""

    field: object
    grid: OccupancyGrid
    """Occupied where the field's own grid is, at the cell's middle."""

    @classmethod
    def over(cls, field, box: np.ndarray, longest: int) -> "CellGrid":
        """At most `longest` cells along the longest side of a box (6,), and no finer than a voxel of the
        field."""
        space, voxel = field.occupancy.space, field.voxel_size
        longest = max(1, min(longest, int(np.ceil((box[3:] - box[:3]).max() / voxel))))
        full = OccupancyGrid.full(box, longest, space)
        occupied = field.occupancy.contains(full.centres()).reshape(cell_counts(box, longest))
        return cls(field, full.marked(occupied))

    def kept(self, cells: np.ndarray) -> "CellGrid":
        """With those of its cells alone, (M,) bool, in order of `index`."""
        return CellGrid(self.field, self.grid.marked(self.spread(cells)))

    @cached_property
    def index(self) -> np.ndarray:
        """(M, 3) of the occupied cells."""
        return np.argwhere(self.grid.occupied)

    @cached_property
    def points(self) -> np.ndarray:
        """(M, 3) middles of the occupied cells in the field's frame."""
        return self.grid.space.inv_contract(torch.from_numpy(self.grid.centres())).numpy()

    @cached_property
    def widths(self) -> np.ndarray:
        """(M,) how wide they are about, in the field's frame."""
        rates = self.grid.space.rates(torch.from_numpy(self.grid.centres())).numpy()
        return self.grid.cell.max() / np.sqrt(rates)

    @cached_property
    def bounds(self) -> np.ndarray:
        """(2, 3) corners of the box around the occupied cells in the field's frame."""
        wide = self.widths.max(initial=0)
        low, high = self.points.min(0, initial=np.inf), self.points.max(0, initial=-np.inf)
        return np.stack([low - wide, high + wide])

    @cached_property
    def dense(self) -> np.ndarray:
        """(M,) bool: those with density that shows."""
        config = current(CellConfig)
        at = torch.from_numpy(self.points)
        ahead = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
        depths = [
            self.field.query(part, ahead.expand(len(part), 3), False)[0].numpy()
            for part in at.split(config.asked_at_once)
        ]
        return np.concatenate([*depths, np.zeros(0)]) * self.widths > config.dense

    def colours(self) -> np.ndarray:
        """(M, 3) colours in the middles of the cells, mean of what is seen along the axes."""
        at, total = torch.from_numpy(self.points), 0.0
        directions = torch.cat([torch.eye(3), -torch.eye(3)]).double()
        for direction in directions:
            total = total + self.field.query(at, direction.expand(len(at), 3))[1].numpy()
        return total / len(directions)

    def beside(self, allowed: np.ndarray) -> np.ndarray:
        """(K,) bool, of allowed cells (M,) with K of them: those next to density in cells that are not."""
        other = self.grid.marked(self.spread(~allowed & self.dense)).dilated().occupied
        return other[self.grid.occupied][allowed]

    def around(self, cells: np.ndarray, reach: int) -> np.ndarray:
        """(M,) bool: which cells lie within so many cells of some of them, (M,) bool."""
        grown = self.grid.marked(self.spread(cells)).dilated(reach).occupied
        return grown[self.grid.occupied]

    def means(self, values: np.ndarray, cells: np.ndarray) -> np.ndarray:
        """(M, D) the mean of values (M, D) of some cells, (M,) bool, up to `window` cells away; nan where
        there are none."""
        side, mask = 2 * current(CellConfig).window + 1, cells.astype(np.float32)
        columns = [mask, *(values * mask[:, None]).T.astype(np.float32)]
        low, high = self.index.min(0), self.index.max(0) + 1
        box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
        count, *sums = (
            uniform_filter(self.spread(column)[box], side, mode="constant")[tuple((self.index - low).T)]
            for column in columns
        )
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(count > 0.5 / side**3, np.stack(sums) / count, np.nan).T

    def spread(self, values: np.ndarray) -> np.ndarray:
        """(X, Y, Z) of what is known of the occupied cells, (M,); 0 elsewhere."""
        grid = np.zeros(self.grid.occupied.shape, values.dtype)
        grid[self.grid.occupied] = values
        return grid

    def pieces(self, chosen: np.ndarray, weights: np.ndarray) -> np.ndarray:
        """(M,) bool: of chosen cells those of the piece of dense ones with the most weight, and of others
        that are not much lighter, with the chosen cells around them."""
        labels, count = label(self.spread(chosen & self.dense), np.ones((3, 3, 3)))
        if not count:
            return chosen
        sums = np.bincount(labels[self.grid.occupied], weights, count + 1)
        sums[0] = 0
        large = self.grid.marked((sums >= current(CellConfig).aside * sums.max())[labels] & (labels > 0))
        return chosen & large.dilated(2).occupied[self.grid.occupied]


@dataclass(frozen=True, eq=False)
class Selection:
    """An object in a field: what is cut out."""

    lattice: CellGrid
    chosen: np.ndarray
    """(M,) bool: its cells."""
    sure: float = 1.0
    """How far those who chose agree, from 0 to 1."""
    object_to_lattice: np.ndarray = field(default_factory=partial(np.eye, 4))
    """(4, 4) from the frame of the field that is cut to that of the field that was selected in."""

    def seen_from(self, object_to_frame: np.ndarray) -> "Selection":
        """The same object for a field that lies in this one's frame by a (4, 4)."""
        other = replace(self, object_to_lattice=self.object_to_lattice @ object_to_frame)
        other.__dict__.update(object=self.object, other=self.other)  # of many nodes made once
        return other

    def lattice_points(self, points: np.ndarray, space: ModuleType) -> np.ndarray:
        """(N, 3) points of the coordinates of a space, of the field that is cut, in those of the lattice."""
        if self.is_aligned(space):
            return points
        at = space.inv_contract(torch.from_numpy(points)).numpy() @ self.object_to_lattice[:3, :3].T
        return mapped(at + self.object_to_lattice[:3, 3], self.lattice.grid.space)

    def is_aligned(self, space: ModuleType) -> bool:
        """Whether the coordinates of a space, of the field that is cut, are those of the lattice."""
        return space is self.lattice.grid.space and np.array_equal(self.object_to_lattice, np.eye(4))

    def box_in(self, grid: OccupancyGrid) -> np.ndarray:
        """(6,) the box of a grid of the field that is cut, or so much of it as is known to hold the object;
        its upper corner lies below the lower one where it holds nothing of it."""
        box, core = self.object.tight_aabb(1), self.lattice.grid.space is bounded
        if not self.is_aligned(grid.space):
            if grid.space is not bounded or not (
                core or np.abs(box).max() <= 1
            ):  # as the frame's in the core
                return grid.aabb
            box = transformed_aabb(box, np.linalg.inv(self.object_to_lattice))
        return np.concatenate([np.maximum(box[:3], grid.aabb[:3]), np.minimum(box[3:], grid.aabb[3:])])

    def cell_in(self) -> float:
        """The narrowest side of its cells in the frame of the field that is cut."""
        stretch = np.linalg.svd(self.object_to_lattice[:3, :3], compute_uv=False)[0]
        return float(self.lattice.grid.cell.min() / stretch)

    @cached_property
    def object(self) -> OccupancyGrid:
        """Its cells."""
        return self.lattice.grid.marked(self.lattice.spread(self.chosen))

    @cached_property
    def other(self) -> OccupancyGrid:
        """Cells with density that shows and is not its."""
        return self.lattice.grid.marked(self.lattice.spread(~self.chosen & self.lattice.dense))

    def with_islands(self) -> "Selection":
        """The object with small pieces of other density that hang in its box."""
        labels, count = label(self.other.occupied, np.ones((3, 3, 3)))
        sizes = np.bincount(labels.ravel(), minlength=count + 1)
        lost = sizes < current(CellConfig).island * (self.chosen & self.lattice.dense).sum()
        lost[0] = False
        for side in (labels[[0, -1]], labels[:, [0, -1]], labels[:, :, [0, -1]]):
            lost[side.ravel()] = False
        return self.joined(lost[labels][self.lattice.grid.occupied])

    def without_foreign(self) -> "Selection":
        """The object without cells beside other density that have its colour and not the object's: of what
        the object touches, a little comes along."""
        config = current(CellConfig)
        around = self.lattice.around
        object_cells, other = self.chosen & self.lattice.dense, ~self.chosen & self.lattice.dense
        near_own, near_other = around(object_cells, config.mixed), around(other, config.mixed)
        band = (object_cells & around(other, config.window)) | (other & around(object_cells, config.window))
        if not band.any():
            return self
        inner = self.lattice.kept(band)
        colours = inner.colours()
        means = [inner.means(colours, sure[band]) for sure in (object_cells & ~near_other, other & ~near_own)]
        away = [((colours - mean) ** 2).sum(1) for mean in means]
        differ = ((means[0] - means[1]) ** 2).sum(1) > 3 * config.contrast**2
        foreign = np.zeros(len(object_cells), bool)
        foreign[band] = differ & (away[0] > config.foreign**2 * away[1])
        return self.without(foreign & object_cells & near_other)

    def without(self, cells: np.ndarray) -> "Selection":
        """The object without some cells, (M,) bool, and without small pieces that then lie apart."""
        left = self.chosen & ~cells
        return replace(self, chosen=self.lattice.pieces(left, np.ones(len(left))))

    def joined(self, cells: np.ndarray) -> "Selection":
        """The object with some cells, (M,) bool."""
        return replace(self, chosen=self.chosen | cells)

    @property
    def shows(self) -> bool:
        """Whether any of its cells has density that shows."""
        return bool((self.chosen & self.lattice.dense).any())
