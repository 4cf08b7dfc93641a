"""The visual hull of an object that masks or alpha cut out: where in a box it can be."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.ndimage import distance_transform_edt, label, maximum

from formats.photos import decoders
from formats.silhouettes import shown_pixels
from formats.views import View
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.rendering.cameras import projected
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class VisualHullConfig:
    """How a visual hull is carved."""

    coarse: int = 32
    """Cells along the longest axis, of a first look, ..."""
    fine: int = 112
    """... and of a second one into what that leaves."""
    views: int = 100
    """At most so many masks, evenly spaced in the list, are looked at."""
    pixels: int = 300
    """Rows or columns of a mask, about: no fewer are looked at along its longer side."""
    amiss: float = 0.1
    """Share of the masks that may exclude a cell where the object is: some are not exact, or plain wrong."""
    rarely: float = 0.5
    """Of the median number of views that show a cell of the object: a piece of which fewer show every cell
    lies beside the object, and only photos tell of it in which it is in line with the object."""


def visual_hull(views: Sequence[View], box: np.ndarray, finest: int | None = None) -> OccupancyGrid:
    """The smallest box, with cells in it, around those of a box (6,), in world units, that most of the views'
    masks (`amiss`) leave room for an object in; a view says nothing of cells outside its picture, and cells
    that no view shows are left out.

    The alpha of a photo is such a mask. `finest` cells lie along the longest axis (None: `fine`). All cells
    are kept where the masks agree on none. Raises BadMask, BadImage, MissingFile.
    """
    config = current(VisualHullConfig)
    chosen = np.unique(np.linspace(0, len(views) - 1, min(len(views), config.views)).astype(int))
    with decoders(views) as threads:
        masks = threads.map(partial(Mask.of, config.pixels), [views[i] for i in chosen])
        masked = [mask for mask in masks if mask]
    around = tight_grid(carved(OccupancyGrid.full(box, config.coarse), masked))
    grid = OccupancyGrid.full(around.aabb, finest or config.fine)
    inside = grid.marked(around.contains(grid.centres()).reshape(grid.occupied.shape))
    return tight_grid(carved(inside, masked))


@dataclass(frozen=True, eq=False)
class Mask:
    """What the mask of a view keeps, and the alpha of its photo."""

    view: View
    stride: int
    """Only every so many rows and columns are looked at."""
    beside: np.ndarray
    """Of those, the distance in pixels to the next one that is kept, float32."""

    @classmethod
    def of(cls, most: int, view: View) -> "Mask | None":
        """A view's mask, of about so many rows or columns; None where that keeps nothing, which says nothing
        of the object."""
        stride = max(1, max(view.width, view.height) // most)
        ignored = ~shown_pixels(view)[::stride, ::stride]
        if ignored.all():
            return None
        return cls(view, stride, (stride * distance_transform_edt(ignored)).astype(np.float32))

    def distances(self, pixels: np.ndarray) -> np.ndarray:
        """(N,) how far pixels (N, 2), column and row, are from the next one that is kept, at least about."""
        column, row = (pixels // self.stride).astype(int).T
        return self.beside[row, column] - (self.stride - 1)


def carved(grid: OccupancyGrid, masked: Sequence[Mask]) -> OccupancyGrid:
    """The occupied cells of a grid that most masks leave, as `visual_hull` says, in pieces that enough views
    show."""
    config = current(VisualHullConfig)
    points, reach = grid.centres(), float(np.linalg.norm(grid.cell)) / 2
    shown, excluded = np.zeros((2, len(points)), int)
    for mask in masked:
        left = np.flatnonzero(excluded <= config.amiss * len(masked))
        pixels, away, inside = projected(mask.view, points[left])
        seen, in_pixels = left[inside], reach * max(mask.view.fl_x, mask.view.fl_y) / away[inside]
        shown[seen] += 1
        excluded[seen] += mask.distances(pixels[inside]) > in_pixels
    left = (shown > 0) & (excluded <= config.amiss * shown)
    if not left.any():
        return grid
    is_carved, times = np.zeros(grid.occupied.shape, bool), np.zeros(grid.occupied.shape, int)
    is_carved[grid.occupied], times[grid.occupied] = left, shown
    pieces, count = label(is_carved, np.ones((3, 3, 3)))
    most = maximum(times, pieces, np.arange(count + 1))  # piece 0 is what is not held
    return grid.marked(is_carved & (most >= config.rarely * np.median(shown[left]))[pieces])


def tight_grid(grid: OccupancyGrid) -> OccupancyGrid:
    """The same cells in the smallest box that holds the occupied ones and a cell around them, where the grid
    has it."""
    return grid.within(grid.tight_aabb(1))
