"""Teachers of a region of a field: one that exists only inside it, and one that shows something else
there."""

from functools import cached_property

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import (
    DEFAULT_CELLS,
    SCENE_CELLS,
    OccupancyGrid,
    cell_counts,
    mapped,
    reached_cells,
)


class ClippedField:
    """A field that is empty outside a box of its own frame."""

    kind = "clipped"

    def __init__(self, field: RadianceField, aabb: np.ndarray):
        """aabb (6,) in the field's frame."""
        self.field, self.box = field, np.asarray(aabb, np.float64)

    @cached_property
    def occupancy(self) -> OccupancyGrid:
        """The field's own cells that lie in the box, on a grid of the box itself."""
        counts = np.maximum(np.ceil((self.box[3:] - self.box[:3]) / self.field.occupancy.cell).astype(int), 1)
        grid = OccupancyGrid(self.box, np.ones(counts, bool))
        own = self.field.occupancy
        found = own.dilated().contains(mapped(grid.centres(), own.space))
        return OccupancyGrid(self.box, found.reshape(counts))

    @property
    def aabb(self) -> np.ndarray:
        """(6,) the box."""
        return self.box

    @property
    def voxel_size(self) -> float:
        """The field's own."""
        return self.field.voxel_size

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) and rgb (N, 3); σ is 0 outside the box."""
        sigma, rgb = self.field.query(points, dirs, with_colour)
        box = torch.from_numpy(self.box)
        return sigma * ((points >= box[:3]) & (points <= box[3:])).all(1), rgb


class MaxOf:
    """Placed fields as one that answers as the densest of them; of none, that there is nothing."""

    kind = "densest"

    def __init__(self, placed: list[Placed], occupancy: OccupancyGrid | None = None):
        """occupancy: of a field in the frame of all, whose space is that of this one too."""
        self.placed, self.occupancy = placed, occupancy

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) and rgb (N, 3) at points (N, 3) along unit dirs (N, 3)."""
        sigma, rgb = torch.zeros(len(points)), torch.zeros(len(points), 3)
        for one in self.placed:
            x, d, stretch = one.to_object(points, dirs)
            found, colour = one.field.query(x, d, with_colour)
            found = (found.double() * stretch).float()
            won = found > sigma
            sigma[won], rgb[won] = found[won], colour[won].float()
        return sigma, rgb


class PatchedField:
    """A field that inside a region of its frame answers as others do."""

    kind = "patched"

    def __init__(self, field: RadianceField, aabb: np.ndarray, region: np.ndarray, inside: MaxOf):
        """aabb (6,) is the box of it all in the coordinates of the field's space, region (6,) a box of its
        frame where `inside` answers."""
        self.field, self.aabb, self.region, self.inside = field, aabb, region, inside

    @property
    def voxel_size(self) -> float:
        """The finest of all."""
        return min([self.field.voxel_size, *(p.voxel_size for p in self.inside.placed)])

    @cached_property
    def occupancy(self) -> OccupancyGrid:
        """Cells that the field reaches outside of the region, or the others inside of it."""
        own = self.field.occupancy
        longest = int(
            np.clip(np.ceil((self.aabb[3:] - self.aabb[:3]).max() / own.cell.min()), 1, SCENE_CELLS)
        )
        longest = max(longest, min(DEFAULT_CELLS, SCENE_CELLS))
        counts = cell_counts(self.aabb, longest)
        grid = OccupancyGrid(self.aabb, np.ones(counts, bool), own.space)
        places = grid.centres()
        centres = own.space.placed(torch.from_numpy(places)).numpy()
        reach = grid.cell / 2 / own.space.rates(torch.from_numpy(places)).numpy()[:, None]
        within = ((centres > self.region[:3] + reach) & (centres < self.region[3:] - reach)).all(1)
        found = own.dilated().contains(places) & ~within
        beside = ((centres > self.region[:3] - reach) & (centres < self.region[3:] + reach)).all(1)
        for one in self.inside.placed:
            reached = reached_cells(one.field.occupancy, one.object_to_world, self.aabb, longest, own.space)
            found |= reached.ravel() & beside
        return OccupancyGrid(self.aabb, found.reshape(counts), own.space)

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) and rgb (N, 3) at points (N, 3) along unit dirs (N, 3)."""
        sigma, rgb = self.field.query(points, dirs, with_colour)
        region = torch.from_numpy(self.region)
        within = ((points >= region[:3]) & (points <= region[3:])).all(1)
        if within.any():
            sigma[within], rgb[within] = self.inside.query(points[within], dirs[within], with_colour)
        return sigma, rgb
