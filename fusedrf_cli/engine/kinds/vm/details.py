"""What a field of several blocks holds of the objects that they stand for."""

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.detail import Detail, extent
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.vm.blocks import tensor_field
from fusedrf_cli.engine.kinds.vm.field import NO_BLOCK, VMField

MATTER = 1e-2  # optical depth of a cell from which it counts


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
