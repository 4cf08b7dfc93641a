"""Edits of a vm field: blocks come and go, and of a distilled tensor the cells of a box are emptied and
filled by a tensor of their own. All other numbers stay as they are."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.kinds import splitting
from fusedrf_cli.engine.kinds.vm.blocks import (
    blocks_of,
    tensor_field,
)
from fusedrf_cli.engine.kinds.vm.field import Block, VMField
from fusedrf_cli.engine.selection.cells import Selection


def cut_out(field: VMField, selection: Selection) -> VMField | None:
    """What of each block is a selected object's, see splitting.py."""

    def part(own: VMField, block: Block) -> VMField | None:
        return splitting.cut_out(own, own.tensors[0].aabb, selection.seen_from(block.object_to_field))

    return apart(field, part)


def cut_away(field: VMField, selection: Selection) -> VMField | None:
    """What of each block is not a selected object's, see splitting.py."""
    return apart(
        field, lambda own, block: splitting.cut_away(own, selection.seen_from(block.object_to_field))
    )


def cropped(field: VMField, holds: splitting.Holds) -> VMField | None:
    """What of each block lies where `holds` says so of points of the field's frame, see splitting.py."""
    return in_blocks(field, holds, lambda own, held: splitting.cropped(own, own.tensors[0].aabb, held))


def restricted(field: VMField, holds: splitting.Holds) -> VMField | None:
    """Each block as splitting.py restricts it."""
    return in_blocks(field, holds, splitting.restricted)


def in_blocks(field: VMField, holds: splitting.Holds, part_of: Callable) -> VMField | None:
    """What `part_of` leaves of each block, given its tensor alone and `holds` in its object's frame."""

    def part(own: VMField, block: Block) -> VMField | None:
        def held(points: np.ndarray) -> np.ndarray:
            return holds(points @ block.object_to_field[:3, :3].T + block.object_to_field[:3, 3])

        return part_of(own, held)

    return apart(field, part)


def apart(field: VMField, part_of: Callable[[VMField, Block], VMField | None]) -> VMField | None:
    """A part of each block's tensor, placed as the block; None where none has any."""
    if len(field.blocks) == 1 and np.array_equal(field.blocks[0].object_to_field, np.eye(4)):
        return part_of(field, field.blocks[0])
    found = []
    for block in field.blocks:
        part = part_of(tensor_field(field, block.tensor), block)
        if part is not None:
            alone = replace(part.blocks[0], name=block.name)
            part = tinted(replaced(part, (alone,)), block.tint)
            found.append(Placed("", part, block.object_to_field))
    return joined(found)


def replaced(field: VMField, blocks: tuple[Block, ...]) -> VMField:
    """The field with other blocks that lie as its own do."""
    return VMField(field.shape, field.tensors, blocks, field.params, field.occupancy, field.owners)


def tinted(field: VMField, tint: tuple[float, float, float]) -> VMField:
    """The field with the colours of all its blocks multiplied by r, g, b."""
    return replaced(
        field, tuple(replace(b, tint=tuple(np.multiply(b.tint, tint).tolist())) for b in field.blocks)
    )


def joined(placed: list[Placed]) -> VMField | None:
    """Placed fields of one tensor each as one field; None of none."""
    if not placed:
        return None
    if len(placed) == 1 and np.array_equal(placed[0].object_to_world, np.eye(4)):
        return placed[0].field
    return blocks_of(placed)
