"""The insides of cells (engine/fields/insides.py) of a field of several blocks: matter lies where an occupied
cell of a tensor's own grid, which is as fine as the tensor, reaches after placing. Nothing is lost by it."""

from copy import copy

import numpy as np

from fusedrf_cli.engine.fields.insides import SIDE, with_insides
from fusedrf_cli.engine.fields.occupancy import (
    MAX_STRIDE,
    OccupancyGrid,
    Pace,
    reached_cells,
    transformed_aabb,
)
from fusedrf_cli.engine.kernels.plain import mark_parts
from fusedrf_cli.engine.kinds.vm.field import Block, VMField, VMTensor
from fusedrf_cli.engine.spaces import bounded

ROUNDING = 1e-6  # parts


def with_known_insides(field: VMField) -> VMField:
    """The field under a grid that knows the insides of cells. Blocks that lie in unbounded space, or are bent
    by the space that they were placed into, fill the cells that they reach, at their own strides."""
    straight = [is_straight(field, b) for b in range(len(field.blocks))]
    whole = [block for block, own in zip(field.blocks, straight, strict=True) if not own]
    if not any(straight):
        return field
    grid, other = field.occupancy, copy(field)
    found = np.zeros(grid.occupied.shape, np.uint64)
    for block in (block for block, own in zip(field.blocks, straight, strict=True) if own):
        mark(field.tensors[block.tensor], block.object_to_field, grid, found)
    found[~grid.occupied] = 0
    known = with_insides(grid, found, strides_of(field, whole) if whole else None)
    other.__dict__["grid"] = field.device_loops.on_device(known)
    return other


def is_straight(field: VMField, b: int) -> bool:
    """Whether a block lies in the coordinates of the field's space as its placement says: in unbounded space
    the core does."""
    block = field.blocks[b]
    tensor = field.tensors[block.tensor]
    box = transformed_aabb(tensor.aabb, block.object_to_field)
    return tensor.space is bounded and (field.space is bounded or abs(box).max() <= 1)


def strides_of(field: VMField, blocks: list[Block]) -> np.ndarray:
    """(X, Y, Z) uint16 of the field's grid: the strides that some blocks need, of a cell at most, 0 where
    they are not."""
    grid = field.occupancy
    longest = max(grid.occupied.shape)
    placed = [(field.tensors[block.tensor].occupancy, block.object_to_field) for block in blocks]
    marks = (reached_cells(*one, grid.aabb, longest, grid.space) for one in placed)
    pace = Pace(OccupancyGrid(grid.aabb, grid.occupied, grid.space))
    for _ in pace.kept(marks, placed, [field.tensors[block.tensor].step for block in blocks]):
        pass
    reached = np.isfinite(pace.spacing) & grid.occupied
    if grid.stride is None:
        return reached.astype(np.uint16)
    strides = np.where(reached, np.minimum(pace.spacing, grid.cell.min()), 0) / grid.unit + 1e-4
    return np.where(reached, np.clip(strides, 1, MAX_STRIDE), 0).astype(np.uint16)


def mark(tensor: VMTensor, object_to_field: np.ndarray, grid: OccupancyGrid, found: np.ndarray) -> None:
    """Set in `found` (X, Y, Z) uint64 the parts of the grid's cells that the boxes around the occupied cells
    of a tensor's own grid reach after placing."""
    occupied, part = tensor.occupancy.occupied, grid.cell / SIDE
    cell = (tensor.aabb[3:] - tensor.aabb[:3]) / occupied.shape
    linear = object_to_field[:3, :3] * cell / part[:, None]
    shift = (object_to_field[:3, :3] @ tensor.aabb[:3] + object_to_field[:3, 3] - grid.aabb[:3]) / part
    reach = abs(linear).sum(1) / 2 + ROUNDING
    mark_parts(occupied, np.concatenate([linear, shift[:, None]], 1), reach, found)
