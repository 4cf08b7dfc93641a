"""The hole that an object leaves in what it stood on or hung at: a surface that goes on smoothly there.

Nobody saw what was behind the object, so the surface and its colours are the smoothest ones that fit what is
seen around it: both solve Laplace's equation over the hole (a membrane; Bertalmio et al. 2000 name it the
simplest inpainting), the surface as its distance from the plane that most of its surroundings lie in.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from scipy.ndimage import binary_dilation
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, cell_counts
from fusedrf_cli.engine.rendering.volume import render_rays
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class HoleConfig:
    """How a hole is looked for and filled."""

    columns: int = 96
    """Along the longer side of what is looked at: the object's box and what is beside it."""
    beside: float = 0.4
    """How far beside, in the box's longer side."""
    shows: float = 0.5
    """Opacity from which a column has a surface."""
    flat: float = 0.04
    """Of the box's longest side: how far from a plane surfaces may lie that it counts as theirs."""
    behind: float = 0.3
    """Of the box's depth: how far behind it surfaces are looked for."""
    ring: tuple[int, int] = (2, 10)
    """Columns from what the object covered: those between tell what it touched."""
    agreeing: float = 0.4
    """Share of these that must lie in one plane."""
    before: float = 0.8
    """Share of the covered columns in which the object must not lie behind that plane."""
    least_hole: float = 0.01
    """Share of the columns of the box: fewer are no hole."""
    draws: int = 300
    thick: float = 2.0
    """Columns that a filled surface is thick."""
    optical_depth: float = 12.0
    """Through it."""


@dataclass(frozen=True, eq=False)
class Patch:
    """A surface over a rectangle: a radiance field of the frame of the field that it mends."""

    frame: np.ndarray
    """(4, 4): columns run along its third axis; the first corner of the rectangle is its origin."""
    pitch: float
    """The distance of columns."""
    heights: np.ndarray
    """(A, B) of the surface along the third axis."""
    colours: np.ndarray
    """(A, B, 3)."""
    filled: np.ndarray
    """(A, B) bool: where there is any."""
    kind = "patch"

    @property
    def voxel_size(self) -> float:
        """The distance of columns."""
        return self.pitch

    @property
    def thickness(self) -> float:
        """Of the surface, along its columns."""
        return current(HoleConfig).thick * self.pitch

    @cached_property
    def aabb(self) -> np.ndarray:
        """(6,) in the field's frame."""
        at = np.argwhere(self.filled)
        sides = np.concatenate([at, at + 1]) * self.pitch
        z = np.tile(self.heights[self.filled], 2)
        local = np.concatenate([np.c_[sides, z], np.c_[sides, z - self.thickness]])
        points = local @ self.frame[:3, :3].T + self.frame[:3, 3]
        return np.concatenate([points.min(0) - self.pitch, points.max(0) + self.pitch])

    @cached_property
    def occupancy(self) -> OccupancyGrid:
        """Cells of two columns' width near the surface."""
        box = self.aabb
        longest = max(1, int(np.ceil((box[3:] - box[:3]).max() / (2 * self.pitch))))
        grid = OccupancyGrid.full(box, longest)
        u, v, depth, inside = self.local(grid.centres(), 1)
        reach = np.linalg.norm(grid.cell)
        at = self.heights[u, v]
        near = inside & (depth < at + reach) & (depth > at - self.thickness - reach)
        return grid.marked(near.reshape(cell_counts(box, longest)))

    def local(self, points: np.ndarray, grown: int = 0) -> tuple[np.ndarray, ...]:
        """Columns (N,), (N,) that points (N, 3) lie in, their heights (N,), and whether the surface, `grown`
        by so many columns, is there."""
        at = (points - self.frame[:3, 3]) @ self.frame[:3, :3]
        column = np.floor(at[:, :2] / self.pitch).astype(int)
        size = np.array(self.filled.shape)
        inside = ((column >= 0) & (column < size)).all(1)
        column = np.clip(column, 0, size - 1)
        there = binary_dilation(self.filled, iterations=grown) if grown else self.filled
        return column[:, 0], column[:, 1], at[:, 2], inside & there[column[:, 0], column[:, 1]]

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) and rgb (N, 3), the same along all directions."""
        u, v, height, inside = self.local(points.numpy())
        below = self.heights[u, v] - height
        solid = inside & (below >= 0) & (below <= self.thickness)
        sigma = np.where(solid, current(HoleConfig).optical_depth / self.thickness, 0.0)
        return torch.from_numpy(sigma).float(), torch.from_numpy(self.colours[u, v]).float()


@dataclass(frozen=True, eq=False)
class Columns:
    """What a field shows in columns that look at the back face of a box, in a frame of their own."""

    frame: np.ndarray
    pitch: float
    size: tuple[float, float, float]
    """Of the box along the frame's axes."""
    beside: float
    """From the frame's origin to the box, along the first two axes."""
    heights: np.ndarray
    """(A, B) of the first surface above the back face; nan where there is none."""
    colours: np.ndarray
    covered: np.ndarray
    """(A, B) bool: columns that the object was in."""
    tops: np.ndarray
    """(A, B) how high it was there, or half the box where that is not known."""

    @cached_property
    def of_box(self) -> np.ndarray:
        """(A, B) bool: columns through the box."""
        u, v = ((np.arange(n) + 0.5) * self.pitch - self.beside for n in self.heights.shape)
        return np.outer((u >= 0) & (u < self.size[0]), (v >= 0) & (v < self.size[1]))


def patches(
    rest: RadianceField, box: np.ndarray, up: np.ndarray, gone: RadianceField | None = None
) -> tuple[list[Patch], float]:
    """Surfaces that fill the holes that an object of a box (6,) leaves in `rest`: in what it stood on, by the
    unit vector `up` (3,), and what it leant or hung at; and the share of what it covered there that is a
    hole. All in the frame of `rest`. gone: the object; None: it covered what is in the box."""
    surfaces, holes, looked = [], 0, 0
    for direction in ways(up):
        view = columns(rest, box, direction, gone)
        patch, share = mended(view)
        if patch is not None:
            surfaces.append(patch)
            holes += share * view.covered.sum()
            looked += int(view.covered.sum())
    return surfaces, float(holes / looked) if looked else 0.0


def ways(up: np.ndarray) -> list[np.ndarray]:
    """Directions (3,) from surfaces that an object may touch: up, and four level ones."""
    side = np.cross(up, np.eye(3)[np.abs(up).argmin()])
    side /= np.linalg.norm(side)
    other = np.cross(up, side)
    return [up, side, -side, other, -other]


def columns(
    rest: RadianceField, box: np.ndarray, direction: np.ndarray, gone: RadianceField | None = None
) -> Columns:
    """Look along -way at the back of a box (6,) and at what is beside it."""
    config = current(HoleConfig)
    first = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    first /= np.linalg.norm(first)
    axes = np.stack([first, np.cross(direction, first), direction], 1)
    corners = np.stack(np.meshgrid(*box.reshape(2, 3).T, indexing="ij"), -1).reshape(-1, 3) @ axes
    low, size = corners.min(0), np.ptp(corners, 0)
    beside = config.beside * float(size[:2].max())
    pitch = float((size[:2].max() + 2 * beside) / config.columns)
    counts = np.ceil((size[:2] + 2 * beside) / pitch).astype(int)
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = axes, axes @ (low - [beside, beside, 0])
    deepest, top = -config.behind * size[2] - 2 * pitch, size[2] * 1.02
    u, v = np.meshgrid(*((np.arange(n) + 0.5) * pitch for n in counts), indexing="ij")
    starts = np.stack([u, v, np.full_like(u, top)], -1).reshape(-1, 3) @ axes.T + frame[:3, 3]
    down = np.broadcast_to(-direction, starts.shape).copy()
    shown = render_rays(rest, starts, down, far=float(top - deepest)).reshape(*counts, 5)
    opacity = shown[..., 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        heights = np.where(opacity > config.shows, top - shown[..., 4] / opacity, np.nan)
        colours = np.where(opacity[..., None] > config.shows, shown[..., :3] / opacity[..., None], 0)
    view = Columns(frame, pitch, tuple(size), beside, heights.astype(np.float64), colours, None, None)
    covered, tops = view.of_box, np.full(tuple(counts), size[2] / 2)
    if gone is not None:
        there = render_rays(gone, starts, down).reshape(*counts, 5)
        covered = covered & (there[..., 3] > config.shows)
        tops[covered] = top - there[covered, 4] / there[covered, 3]
    return replace(view, covered=covered, tops=tops)


def mended(view: Columns) -> tuple[Patch | None, float]:
    """The surface that fills the covered columns where none is seen near the plane of what is beside them,
    and their share; None where what is beside lies in no plane near the back of the box, or there is no
    hole."""
    config = current(HoleConfig)
    plane = plane_of(view)
    if plane is None:
        return None, 0.0
    u, v = np.indices(view.heights.shape)
    level = plane[0] * u + plane[1] * v + plane[2]
    level_columns = np.abs(np.nan_to_num(view.heights, nan=np.inf) - level) < config.flat * max(view.size)
    hole = view.covered & ~level_columns
    share = float(hole.sum() / max(1, view.covered.sum()))
    if share < config.least_hole:
        return None, 0.0
    # The rim of a hole is thin, and shows what is behind it.
    hole = binary_dilation(hole, iterations=2) & view.of_box
    level_columns &= ~hole
    values = np.concatenate([np.where(level_columns, view.heights - level, 0)[..., None], view.colours], -1)
    smooth = membrane(values, level_columns, hole)
    heights, colours = level + smooth[..., 0], np.clip(smooth[..., 1:], 0, 1)
    return Patch(view.frame, view.pitch, heights, colours, hole), share


def plane_of(view: Columns) -> np.ndarray | None:
    """(3,) a, b, c of the plane a u + b v + c, by columns, in which most surfaces lie that are seen close
    beside the object and do not hide it (RANSAC, Fischler and Bolles 1981); None where too few do."""
    config = current(HoleConfig)
    near, far = (binary_dilation(view.covered, iterations=n) for n in config.ring)
    ring = far & ~near
    cells = np.argwhere(ring & np.isfinite(view.heights))
    heights = view.heights[tuple(cells.T)]
    if len(cells) < 3:
        return None
    rows = np.c_[cells, np.ones(len(cells))]
    under = np.c_[np.argwhere(view.covered), np.ones(int(view.covered.sum()))]
    tops, flat = view.tops[view.covered], config.flat * max(view.size)
    g, best = np.random.default_rng(0), np.zeros(len(cells), bool)
    for _ in range(config.draws):
        three = g.choice(len(cells), 3, replace=False)
        try:
            plane = np.linalg.solve(rows[three], heights[three])
        except np.linalg.LinAlgError:
            continue
        near = np.abs(rows @ plane - heights) < flat
        if near.sum() > best.sum() and (under @ plane < tops + flat).mean() >= config.before:
            best = near
    if best.sum() < max(3, config.agreeing * ring.sum()):
        return None
    return np.linalg.lstsq(rows[best], heights[best], rcond=None)[0]


def membrane(values: np.ndarray, known: np.ndarray, missing: np.ndarray) -> np.ndarray:
    """(A, B, C) values where they are known, and where they are wanted the solution of Laplace's equation
    between: each cell the mean of those of its four neighbours that are known or wanted."""
    number = np.full(missing.shape, -1)
    number[missing] = np.arange(missing.sum())
    rows, columns, entries = [], [], []
    right = np.zeros((int(missing.sum()), values.shape[-1]))
    for axis, shift in ((0, 1), (0, -1), (1, 1), (1, -1)):
        beside = np.roll(number, shift, axis)
        shifted = np.roll(known, shift, axis)
        edge = [slice(None)] * 2
        edge[axis] = 0 if shift == 1 else -1
        beside[tuple(edge)], shifted[tuple(edge)] = -1, False
        to_known, to_wanted = missing & shifted, missing & (beside >= 0)
        right[number[to_known]] += np.roll(values, shift, axis)[to_known]
        for here in (number[to_known], number[to_wanted]):
            rows.append(here), columns.append(here), entries.append(np.ones(len(here)))
        rows.append(number[to_wanted]), columns.append(beside[to_wanted])
        entries.append(-np.ones(int(to_wanted.sum())))
    n = len(right)
    rows, columns = np.concatenate([*rows, np.arange(n)]), np.concatenate([*columns, np.arange(n)])
    # A piece without any known neighbour has no solution but the smallest.
    entries = np.concatenate([*entries, np.full(n, 1e-9)])
    matrix = coo_matrix((entries, (rows, columns)), shape=(n, n)).tocsc()
    filled = values.copy()
    if n:
        filled[missing] = np.stack([spsolve(matrix, part) for part in right.T], -1)
    return filled
