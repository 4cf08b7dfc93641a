"""How finely a fused field holds what was placed in it, object by object: Nyquist's question, and what
anisotropy costs."""

from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.blocks import tensor_field
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.vm.field import NO_BLOCK, VMField

ENOUGH_VOXELS = 8  # across an object, under which there is no shape left
LOST_NOTED = 0.01  # share of an object's cells
MATTER = 1e-2  # optical depth of a cell from which it counts


@dataclass(frozen=True)
class Detail:
    """One placed object in a fused field; lengths are in the field's units."""

    name: str
    stretch: float
    """Condition number of the placement's linear part."""
    opacity_off: float
    """By how much the opacity may be off where the object is translucent."""
    own_voxel: float
    """The finest that the source tells apart."""
    held_voxel: float
    """The finest that the fused field tells apart there."""
    voxels_across: float
    """Of the fused field, along the object's longest side."""
    lost: float = 0.0
    """Share of its cells of matter that the fused field does not show."""


def tensor_details(placed: list[Placed], voxel: float) -> list[Detail]:
    """What one tensor of isotropic density with that voxel holds of placed objects."""
    return [
        Detail(p.name, p.condition, opacity_off(p.condition), p.voxel_size, voxel, extent(p) / voxel)
        for p in placed
    ]


def block_details(placed: list[Placed], field: VMField) -> list[Detail]:
    """What a field of `blocks_of` these placed fields holds; blocks keep the stretch of density."""
    voxels, lost, found, at = field.voxel_sizes(), lost_shares(field), [], 0
    for p in placed:
        own = slice(at, at + len(opened(p.field).blocks))
        at = own.stop
        held = min(voxels[own])
        found.append(
            Detail(p.name, p.condition, 0.0, p.voxel_size, held, extent(p) / held, float(lost[own].max()))
        )
    return found


def extent(placed: Placed) -> float:
    """The longest side of a placed object's box."""
    return float((placed.aabb[3:] - placed.aabb[:3]).max())


def opacity_off(condition: float) -> float:
    """The most by which an isotropic density misses the opacity of one stretched by a condition number κ:
    κ^(-1/(κ-1)) - κ^(-κ/(κ-1)), the largest gap between exp(-τ) and exp(-κτ).

    What is distilled lies somewhere between the densities along the longest and the shortest axis, wherever
    the rays it saw have drawn it; the geometric mean would halve the exponent, if it were known to be met.
    """
    k = condition
    return float(k ** (-1 / (k - 1)) - k ** (-k / (k - 1))) if k > 1 + 1e-9 else 0.0


def lost_shares(field: VMField) -> np.ndarray:
    """(B,) share of each block's cells of matter in whose middle the field answers less than the block does:
    a cell of the ownership grid asks two blocks, and others that meet there go unseen."""
    shares = np.zeros(len(field.blocks))
    if field.owners is None:
        return shares
    for b, block in enumerate(field.blocks):
        single = tensor_field(field, block.tensor)
        grid = single.occupancy
        x = grid.centres()
        at = x @ block.object_to_field[:3, :3].T + block.object_to_field[:3, 3]
        unasked = ~asked(field, at, b)
        if not unasked.any():
            continue
        direction = np.array([1.0, 0.0, 0.0])
        v = np.linalg.solve(block.object_to_field[:3, :3], direction)
        along = torch.from_numpy(np.tile(v / np.linalg.norm(v), (len(x), 1)))
        own = single.query(torch.from_numpy(x), along, False)[0].numpy() * np.linalg.norm(v)
        matter = own * np.linalg.norm(block.object_to_field[:3, :3] @ grid.cell) > MATTER
        doubted = torch.from_numpy(at[unasked & matter])
        shown = field.query(doubted, torch.from_numpy(np.tile(direction, (len(doubted), 1))), False)[0]
        shares[b] = np.count_nonzero(shown.numpy() < own[unasked & matter]) / max(matter.sum(), 1)
    return shares


def asked(field: VMField, points: np.ndarray, block: int) -> np.ndarray:
    """(N,) bool: whether a block is one of those asked at points (N, 3) of the field's frame."""
    grid = field.occupancy
    index = np.floor((points - grid.aabb[:3]) / grid.cell).astype(np.int64)
    i, j, k = np.clip(index, 0, np.asarray(grid.occupied.shape) - 1).T
    first, second = (owners[i, j, k] for owners in field.owners)
    return (first == block) | ((second == block) & (second != NO_BLOCK))
