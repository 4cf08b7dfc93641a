"""A region of a field: emptying it, and a teacher that exists only inside it."""

from dataclasses import replace
from functools import cached_property

import numpy as np
import torch

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.vm.field import VMField, VMTensor

RESTORED = "restored"  # name of the blocks that fill what a cut uncovered


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
        found = self.field.occupancy.dilated().contains(grid.centres())
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


def region_of(field: VMField, aabb: np.ndarray) -> np.ndarray:
    """(6,) the box grown to whole cells of the field's distilled tensor (block 0), so that cutting it out
    leaves no seam.
    """
    tensor = field.tensors[field.blocks[0].tensor]
    at = field.blocks[0].object_to_field[:3, 3]
    cell, lo = tensor.occupancy.cell, tensor.aabb[:3] + at
    low = np.floor((aabb[:3] - lo) / cell - 1e-9)
    high = np.ceil((aabb[3:] - lo) / cell + 1e-9)
    shape = np.asarray(tensor.occupancy.occupied.shape)
    return np.concatenate([lo + np.clip(low, 0, shape) * cell, lo + np.clip(high, 0, shape) * cell])


def cleared(field: VMField, region: np.ndarray) -> VMField:
    """The field with the cells of a region (of `region_of`) empty in its distilled tensor, and in the tensors
    that earlier cuts filled in; no number changes.
    """
    blocks = [field.blocks[0], *(b for b in field.blocks[1:] if b.name == RESTORED)]
    emptied = {
        b.tensor: emptied_tensor(field.tensors[b.tensor], b.object_to_field[:3, 3], region) for b in blocks
    }
    tensors = tuple(emptied.get(t, tensor) for t, tensor in enumerate(field.tensors))
    return VMField.assembled(field.shape, tensors, field.blocks, field.params)


def emptied_tensor(tensor: VMTensor, at: np.ndarray, region: np.ndarray) -> VMTensor:
    """A tensor placed by a mere shift `at` (3,), without the cells whose centres lie in the region."""
    grid = tensor.occupancy
    cells = np.argwhere(grid.occupied)
    centres = grid.aabb[:3] + at + (cells + 0.5) * grid.cell
    inside = ((centres > region[:3]) & (centres < region[3:])).all(1)
    occupied = grid.occupied.copy()
    occupied[tuple(cells[inside].T)] = False
    return replace(tensor, occupied=occupied)
