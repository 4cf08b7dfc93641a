"""The insides of cells (engine/fields/insides.py) of a field of several blocks: each tensor is looked into in
its own grid, as fine as itself, and what was found there is placed."""

from copy import copy

import numpy as np

from fusedrf_cli.engine.fields.insides import SIDE, insides_of, with_insides
from fusedrf_cli.engine.fields.occupancy import (
    MAX_STRIDE,
    OccupancyGrid,
    Pace,
    reached_cells,
    transformed_aabb,
)
from fusedrf_cli.engine.kernels.plain import mark_parts
from fusedrf_cli.engine.kinds.vm.field import Block, VMField
from fusedrf_cli.engine.spaces import bounded

LEVELS = 2  # halvings of a cell to its parts


def looked_into(field: VMField) -> VMField:
    """The field with tensors, and a grid, of which the insides of cells are known. Not looked into are those
    tensors that lie in unbounded space, or are bent by the space that they were placed into."""
    insides = [tensor_insides(field, t) for t in range(len(field.tensors))]
    if all(bits is None for bits in insides):
        return field
    starts = np.cumsum([0, *(0 if bits is None else bits.size for bits in insides)])[:-1]
    at = np.where([bits is None for bits in insides], -1, starts)
    held = np.concatenate([bits.ravel() for bits in insides if bits is not None])
    other, loops = copy(field), field.device_loops
    held, at = loops.on_device(held), loops.on_device(at.astype(np.int64))
    other.__dict__["arrays"] = field.arrays._replace(inside=held, inside_at=at)
    other.__dict__["grid"] = loops.on_device(placed_insides(field, insides))
    return other


def tensor_insides(field: VMField, t: int) -> np.ndarray | None:
    """Those of a tensor's own cells, where it is looked into."""
    if field.tensors[t].space is not bounded or not all(
        straight(field, b) for b, block in enumerate(field.blocks) if block.tensor == t
    ):
        return None
    return insides_of(alone(field, t))


def straight(field: VMField, b: int) -> bool:
    """Whether a block lies in the coordinates of the field's space as its placement says: in unbounded space
    the core does."""
    block = field.blocks[b]
    box = transformed_aabb(field.tensors[block.tensor].aabb, block.object_to_field)
    return field.space is bounded or abs(box).max() <= 1


def alone(field: VMField, t: int) -> VMField:
    """A tensor of a field in its own frame, with the field's numbers."""
    tensor, start = field.tensors[t], int(field.layout[t, 0])
    numbers = field.params[start : start + tensor.size(field.shape)]
    return VMField(field.shape, (tensor,), (Block(0, np.eye(4), ""),), numbers, tensor.occupancy)


def placed_insides(field: VMField, insides: list[np.ndarray | None]):
    """The field's grid, whose parts hold matter where that of a tensor reaches that was looked into; what was
    not lies in whole cells, at its own strides."""
    grid = field.occupancy
    found = np.zeros(grid.occupied.shape, np.uint64)
    whole = [block for block in field.blocks if insides[block.tensor] is None]
    for block in field.blocks:
        if insides[block.tensor] is not None:
            place(insides[block.tensor], field.tensors[block.tensor].aabb, block.object_to_field, grid, found)
    found[~grid.occupied] = 0
    return with_insides(grid, found, strides_of(field, whole) if whole else None)


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


def place(bits: np.ndarray, box: np.ndarray, object_to_field: np.ndarray, grid, found: np.ndarray) -> None:
    """Mark in `found` what the parts of a tensor's cells reach after placing; where they are finer than those
    of the grid, its eighths or cells."""
    cell, part = (box[3:] - box[:3]) / bits.shape, grid.cell / SIDE
    wide = abs(object_to_field[:3, :3] * cell) / part[:, None]  # of a cell along each of its axes, in parts
    widest = wide.sum(1).max()
    level = next((n for n in range(LEVELS) if widest / 2**n <= 1), LEVELS)
    steps, whole = steps_through(wide.max(0) / 2**level), steps_through(wide.max(0))
    linear = object_to_field[:3, :3] * cell / part[:, None]
    shift = (object_to_field[:3, :3] @ box[:3] + object_to_field[:3, 3] - grid.aabb[:3]) / part
    mark_parts(bits, level, np.concatenate([linear, shift[:, None]], 1), steps, whole, found)


def steps_through(sides: np.ndarray) -> np.ndarray:
    """(N, 3) places in a box of sides (3,), of which it is 1 along each axis, no farther apart than 1."""
    counts = np.maximum(np.ceil(sides), 1).astype(int) + 1
    return np.stack(np.meshgrid(*[np.linspace(0, 1, n) for n in counts], indexing="ij"), -1).reshape(-1, 3)
