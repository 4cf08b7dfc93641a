"""Edits of a vm field: blocks come and go, and of a distilled tensor the cells of a box are emptied and
filled by a tensor of their own. All other numbers stay as they are."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.region import ClippedField
from fusedrf_cli.engine.fields.occupancy import placement, seen_box, transformed_aabb
from fusedrf_cli.engine.kinds import splitting
from fusedrf_cli.engine.kinds.editing import Becoming, Edited, Part, Teach, enclosing, goes_by
from fusedrf_cli.engine.kinds.student import Way
from fusedrf_cli.engine.kinds.vm.blocks import (
    MAX_BLOCKS,
    RESTORED,
    UNNAMED,
    blocks_of,
    node_name,
    part_name,
    tensor_field,
)
from fusedrf_cli.engine.kinds.vm.field import Block, VMField, VMTensor
from fusedrf_cli.engine.selection.cells import Selection

NUMBERS = 2_000_000  # of a tensor that a region or an object is learnt into
ROUNDED = 1e-9  # cells: what ends at the face of a cell may show in the next one too


def parts(field: VMField) -> list[Part]:
    """The blocks that stand for an object."""
    return [
        Part(b.name, transformed_aabb(field.tensors[b.tensor].occupancy.tight_aabb(0), b.object_to_field))
        for b in field.blocks
        if b.name not in UNNAMED
    ]


def arranged(field: VMField, becoming: Becoming) -> VMField:
    """The field with the blocks that stand for an object named and placed as `becoming` says."""

    def after(block: Block) -> list[Block]:
        if block.name in UNNAMED:
            return [block]
        found = becoming(node_name(block.name), block.object_to_field)
        return [replace(block, name=part_name(name), object_to_field=at) for name, at in found]

    blocks = [one for block in field.blocks for one in after(block)]
    if len(blocks) > MAX_BLOCKS:
        raise ValueError(f"a field holds at most {MAX_BLOCKS} blocks, and this would be {len(blocks)}")
    for block in blocks:
        Placed(block.name, None, block.object_to_field)  # raises where it is singular
    return VMField.assembled(field.shape, field.tensors, tuple(blocks), field.params)


def cut_out(field: VMField, selection: Selection) -> VMField | None:
    """What of each block is a selected object's, see splitting.py."""
    return apart(
        field,
        lambda own, block: splitting.cut_out(
            own, own.tensors[0].aabb, selection, to_field(field, own, block)
        ),
    )


def cut_away(field: VMField, selection: Selection) -> VMField | None:
    """What of each block is not a selected object's, see splitting.py."""
    return apart(field, lambda own, block: splitting.cut_away(own, selection, to_field(field, own, block)))


def cropped(field: VMField, holds: splitting.Holds) -> VMField | None:
    """What of each block lies where `holds` says so of points of the field's frame, see splitting.py."""

    def part(own: VMField, block: Block) -> VMField | None:
        def held(points: np.ndarray) -> np.ndarray:
            return holds(points @ block.object_to_field[:3, :3].T + block.object_to_field[:3, 3])

        return splitting.cropped(own, own.tensors[0].aabb, held)

    return apart(field, part)


def to_field(field: VMField, own: VMField, block: Block) -> splitting.ToField:
    """The map from the coordinates of a block's tensor, alone in `own`, to those of the field."""
    return splitting.placed_in(field, block.object_to_field, own.space)


def apart(field: VMField, part_of: Callable[[VMField, Block], VMField | None]) -> VMField | None:
    """A part of each block's tensor, placed as the block; None where none has any."""
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


def added(kind, field: VMField, objects: list[Placed], teach: Teach) -> Edited:
    """The field with the blocks of placed objects, of which those of another kind become a tensor in their
    own frame first. Raises ValueError where there would be too many."""
    objects = [as_vm(kind, p, teach) for p in objects]
    result = blocks_of([Placed("", field, np.eye(4)), *objects])
    return Edited(result, enclosing([p.aabb for p in objects]), "blocks appended")


def as_vm(kind, placed: Placed, teach: Teach) -> Placed:
    """A placed vm field with the same content: itself, or what distilling another kind gives, in the object's
    own frame."""
    if type(placed.field) is VMField:
        return placed
    teacher = ComposedField([Placed(placed.name, placed.field, np.eye(4))])
    student = kind.empty(teacher, Way(), NUMBERS, torch.Generator().manual_seed(teach.seed), placed.name)
    student, _ = teach(teacher, student, [teacher.occupancy.subject], True)
    return Placed(placed.name, student, placed.object_to_world @ placement(teacher.origin))


def refilled(kind, field: VMField, box: np.ndarray, rest: list[Placed] | None, teach: Teach) -> Edited | None:
    """The field whose distilled tensor is empty in the cells of a box (6,), and a tensor of its own that
    holds what the rest shows there, but for what the field holds apart; None where nothing is left."""
    region = region_of(field, box)
    emptied = cleared(field, box)
    apart = [part.name for part in parts(field)]
    rest = [p for p in rest or [] if p.reaches(region) and not any(goes_by(n, {p.name}) for n in apart)]
    teacher = ComposedField(rest) if rest else None
    local = ClippedField(teacher, seen_box(region, teacher.origin)) if rest else None
    if local is None or not local.occupancy.occupied.any():
        left = emptied.occupancy.occupied.any()
        return Edited(emptied, region, "the cells of its box emptied") if left else None
    student = kind.empty(local, Way(), NUMBERS, torch.Generator().manual_seed(teach.seed), RESTORED)
    student, figures = teach(local, student, [local.occupancy.subject], True)
    back = placement(teacher.origin)
    whole = blocks_of([Placed("", emptied, np.eye(4)), Placed("", student, back)])
    how = "the cells of its box emptied, and what the other sources show there learnt into a block"
    return Edited(whole, region, how, figures=figures)


def own_cells(field: VMField, box: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(3,), (3,) the first cell, and that behind the last, of the field's distilled tensor (block 0) around a
    box (6,)."""
    grid = field.tensors[field.blocks[0].tensor].occupancy
    reached = transformed_aabb(box, np.linalg.inv(field.blocks[0].object_to_field))
    low = np.floor((reached[:3] - grid.aabb[:3]) / grid.cell - ROUNDED)
    high = np.ceil((reached[3:] - grid.aabb[:3]) / grid.cell + ROUNDED)
    low, high = (np.clip(ends, 0, grid.occupied.shape).astype(int) for ends in (low, high))
    return low, high


def region_of(field: VMField, box: np.ndarray) -> np.ndarray:
    """(6,) the box grown to whole cells of the field's distilled tensor, so that cutting it out leaves no
    seam; around them where the tensor is turned: there what lies between is held twice.
    """
    grid, ends = field.tensors[field.blocks[0].tensor].occupancy, own_cells(field, box)
    grown = np.concatenate([grid.aabb[:3] + end * grid.cell for end in ends])
    return transformed_aabb(grown, field.blocks[0].object_to_field)


def cleared(field: VMField, box: np.ndarray) -> VMField:
    """The field with the cells around a box empty in its distilled tensor, and those of `region_of` it in the
    tensors that earlier cuts filled in; no number changes.
    """
    region, (low, high), first = region_of(field, box), own_cells(field, box), field.blocks[0].tensor
    emptied = {
        b.tensor: emptied_tensor(field.tensors[b.tensor], b.object_to_field[:3, 3], region)
        for b in field.blocks[1:]
        if b.name == RESTORED
    }
    occupied = field.tensors[first].occupancy.occupied.copy()
    occupied[tuple(slice(a, b) for a, b in zip(low, high, strict=True))] = False
    emptied[first] = replace(field.tensors[first], occupied=occupied)
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
