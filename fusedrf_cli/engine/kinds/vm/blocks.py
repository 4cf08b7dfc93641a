"""Blocks: a composed scene of VM fields as one VM field, each tensor in its object's own axes.

Nothing is optimised here: tensors keep their numbers (or are resampled when the whole must be smaller), and
the ownership grid of the
field says per cell which block is asked. So a turned object costs no rank, copies of one object share a
tensor, and appending or
dropping a block leaves all others bit for bit as they were.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields import pages
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.vm.field import Block, VMField, VMShape, VMTensor
from fusedrf_cli.engine.kinds.vm.trimming import smaller_shape, truncated

MAX_BLOCKS = 255
LEARNT, RESTORED = "fused", "restored"
"""Names of blocks that stand for no object: what was distilled, and what fills what a cut uncovered."""
UNNAMED = ("", LEARNT, RESTORED)
FINER = 1 / 8  # of the finest voxel: with a stretched block a common voxel may lie under it
TOLERANCE = 1 + 1e-4  # to which a common voxel is found
COARSER = 1.5  # times its own voxel: how coarse a tensor can get before it is left without its detail


def blocks_of(
    placed: list[Placed],
    fits: Callable[[VMShape, list[VMTensor]], bool] | None = None,
    ranks: VMShape | None = None,
) -> VMField:
    """One VM field that answers as the max composition of placed VM fields does, in their common frame.

    With `fits` the tensors are resampled to the finest common voxel (in the common frame) at which it says
    so of their shape and what they are. With `ranks` they keep at most those, truncated by energy. Raises
    ValueError when a placed field is no VM field or there are more than MAX_BLOCKS blocks.
    """
    for p in placed:
        if p.field.kind != VMField.kind:
            raise ValueError(f"blocks are made of vm fields only, but '{p.name}' is of kind '{p.field.kind}'")
    fields = {id(p.field): p.field for p in placed}
    first, tensors, shapes, own, dtype = {}, [], [], {}, torch.float32
    for key, streamed in fields.items():
        field = opened(streamed)
        first[key], own[key] = len(tensors), field.blocks
        tensors += field.tensors
        shapes.append(field.shape)
        dtype = field.params.dtype
    whole = common_shape(shapes)
    shape = whole if ranks is None else smaller_shape(whole, ranks)
    blocks = [
        Block(
            first[id(p.field)] + b.tensor,
            p.object_to_world @ b.object_to_field,
            block_name(p, b, own),
            b.tint,
        )
        for p in placed
        for b in own[id(p.field)]
    ]
    if len(blocks) > MAX_BLOCKS:
        raise ValueError(f"a field holds at most {MAX_BLOCKS} blocks, this scene has {len(blocks)}")
    if fits is not None:
        tensors = fitting_tensors(tensors, blocks, lambda tried: fits(shape, tried))
    params = pages.zeros(sum(t.size(shape) for t in tensors), dtype)
    at = 0
    for key, streamed in fields.items():  # one after the other: not all of them need to be in memory
        field = reshaped(opened(streamed).to("cpu"), whole)
        for t in range(len(field.tensors)):
            numbers = truncated(tensor_field(field, t, tensors[first[key] + t]), shape).params
            params[at : at + len(numbers)] = numbers
            at += len(numbers)
    return VMField.assembled(shape, *shared(shape, tensors, blocks, params))


def shared(
    shape: VMShape, tensors: list[VMTensor], blocks: list[Block], params: torch.Tensor
) -> tuple[tuple[VMTensor, ...], tuple[Block, ...], torch.Tensor]:
    """Tensors, blocks and numbers, of tensors that are equal to the bit the first alone: one more of an
    object that is there already costs a placement."""
    ends = np.cumsum([tensor.size(shape) for tensor in tensors])
    parts = [params[end - t.size(shape) : end] for end, t in zip(ends, tensors, strict=True)]
    first, kept = [], []
    for i, tensor in enumerate(tensors):
        same = (j for j in kept if equal(tensor, tensors[j]) and torch.equal(parts[i], parts[j]))
        first.append(next(same, i))
        kept += [i] if first[i] == i else []
    if len(kept) == len(tensors):
        return tuple(tensors), tuple(blocks), params
    blocks = [replace(block, tensor=kept.index(first[block.tensor])) for block in blocks]
    return tuple(tensors[i] for i in kept), tuple(blocks), torch.cat([parts[i] for i in kept])


def equal(one: VMTensor, other: VMTensor) -> bool:
    """Whether two tensors lie alike: all but their numbers."""
    grids = one.occupancy, other.occupancy
    facts = [(t.resolution, t.scale, t.shift, t.space, t.hashed) for t in (one, other)]
    return (
        facts[0] == facts[1]
        and np.array_equal(one.aabb, other.aabb)
        and np.array_equal(grids[0].aabb, grids[1].aabb)
        and np.array_equal(grids[0].occupied, grids[1].occupied)
    )


def block_name(placed: Placed, block: Block, own: dict[int, tuple[Block, ...]]) -> str:
    """The node's name; of a node that holds several blocks, the node's and the block's. A node without a name
    (the field that is being edited) leaves its blocks theirs.
    """
    if not placed.name:
        return block.name
    several = len(own[id(placed.field)]) > 1
    return f"{placed.name}/{block.name}" if several else part_name(placed.name)


def part_name(name: str) -> str:
    """A block's name for a node's: its own, but for those that say that a block stands for no object."""
    return f"{name}/{name}" if name in UNNAMED else name


def node_name(part: str) -> str:
    """Inverse of `part_name`."""
    return next((name for name in UNNAMED if part == part_name(name)), part)


def without(field: VMField, names: set[str]) -> VMField | None:
    """The field without the blocks of those names and the tensors that only they used; None when nothing is
    left.
    """
    kept = [b for b in field.blocks if not any(b.name == n or b.name.startswith(f"{n}/") for n in names)]
    if not kept:
        return None
    used = sorted({b.tensor for b in kept})
    sizes = [field.tensors[t].size(field.shape) for t in used]
    params = torch.cat(
        [field.params[field.layout[t, 0] : field.layout[t, 0] + n] for t, n in zip(used, sizes, strict=True)]
    )
    blocks = tuple(replace(b, tensor=used.index(b.tensor)) for b in kept)
    return VMField.assembled(field.shape, tuple(field.tensors[t] for t in used), blocks, params)


def common_shape(shapes: list[VMShape]) -> VMShape:
    """The smallest shape that holds all of the given ones."""
    return VMShape(
        *(max(getattr(s, name) for s in shapes) for name in ("density_rank", "colour_rank", "sh_degree"))
    )


def reshaped(field: VMField, shape: VMShape) -> VMField:
    """The same field with more components and coefficients, the new ones zero."""
    if field.shape == shape:
        return field
    params = pages.zeros(sum(t.size(shape) for t in field.tensors), field.params.dtype)
    wide = VMField(shape, field.tensors, field.blocks, params, field.occupancy, field.owners)
    for t in range(len(field.tensors)):
        target = wide.sections(t)
        for name, old in field.sections(t).items():
            if name == "colour_basis":
                for mode in range(3):
                    source = old[..., mode * field.shape.colour_rank : (mode + 1) * field.shape.colour_rank]
                    at = mode * shape.colour_rank
                    target[name][:, : source.shape[1], at : at + source.shape[2]] = source
            else:
                target[name][..., : old.shape[-1]] = old
    return wide


def fitting_tensors(
    tensors: list[VMTensor], blocks: list[Block], fits: Callable[[list[VMTensor]], bool]
) -> list[VMTensor]:
    """The tensors at their own resolution, or at that of the finest common voxel (in the blocks' frame) at
    which they fit, where that is less. What is left of a tensor whose voxels are more than COARSER times its
    own is without its detail, which would be most of its numbers.
    """
    if fits(tensors):
        return tensors
    sizes = [np.linalg.svd(b.object_to_field[:3, :3], compute_uv=False) for b in blocks]
    stretch = [
        max(s[0] for b, s in zip(blocks, sizes, strict=True) if b.tensor == t) for t in range(len(tensors))
    ]

    def at_voxel(voxel: float) -> list[VMTensor]:
        found = []
        for tensor, scale in zip(tensors, stretch, strict=True):
            wanted = np.ceil((tensor.aabb[3:] - tensor.aabb[:3]) * scale / voxel).astype(int) + 1
            texels = tuple(int(n) for n in np.clip(wanted, 2, tensor.resolution))
            coarser = max(tensor.resolution) > COARSER * max(texels)
            found.append(replace(tensor, resolution=texels, hashed=None if coarser else tensor.hashed))
        return found

    fine = FINER * min(tensors[b.tensor].voxel_size.min() * s[-1] for b, s in zip(blocks, sizes, strict=True))
    coarse = max(float((t.aabb[3:] - t.aabb[:3]).max() * s) for t, s in zip(tensors, stretch, strict=True))
    while coarse > TOLERANCE * fine:
        middle = (fine * coarse) ** 0.5
        fine, coarse = (fine, middle) if fits(at_voxel(middle)) else (middle, coarse)
    return at_voxel(coarse)


def tensor_field(field: VMField, t: int, wanted: VMTensor | None = None) -> VMField:
    """One tensor of a field as a field of its own, in its object's frame, resampled and without its detail
    where the one that is wanted in its place is."""
    tensor: VMTensor = field.tensors[t]
    kept = tensor if wanted is None or wanted.hashed else replace(tensor, hashed=None)  # the last section
    start = int(field.layout[t, 0])
    params = field.params[start : start + kept.size(field.shape)].clone()
    alone = VMField(field.shape, (kept,), (Block(0, np.eye(4), ""),), params, tensor.occupancy)
    same = wanted is None or wanted.resolution == tensor.resolution
    return alone if same else alone.resampled(tensor.aabb, wanted.resolution)
