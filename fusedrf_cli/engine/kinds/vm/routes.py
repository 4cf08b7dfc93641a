"""Rays of a field of several blocks, each through the blocks that it meets.

Who owns a cell is asked for every sample, and grids of all cells are read for it. Most rays come to the
matter of one block alone, or end in a first one before they come to that of a second: there that block
answers alone, as a field of one tensor does.
"""

from collections.abc import Callable

import numpy as np
from numba import get_num_threads

from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.fields.computed import exact
from fusedrf_cli.engine.kernels import cpu
from fusedrf_cli.engine.kernels.plain import NOWHERE
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.volume import seen_from
from fusedrf_cli.engine.spaces import bounded


def render_by_routes(
    field: VMField,
    together: Callable[..., None],
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    reach: np.ndarray,
    step: float,
    early_stop: float,
    out: np.ndarray,
) -> None:
    """Fill out (N, 5) as ComputedField.render_rays does; `together` is that of all blocks.

    A ray is followed through its first block up to where it comes to cells with matter of a second one, and
    from there, if light is left, through all of them. A background is the first of every ray: it has detail
    finer than its step, so that a ray must be on one lattice of samples from end to end, and only rays that
    meet nothing else are its alone.
    """
    first, second = met_blocks(field, rays_o, rays_d)
    out[:], begin = 0, reach[:, 0].copy()
    for b in np.flatnonzero(np.bincount(first + 1)[1:]).tolist():
        chosen = first == b
        if is_bounded(field)[b]:
            begin[chosen] = np.maximum(begin[chosen], second[chosen])
        else:
            chosen &= (second == NOWHERE) & (field.crossings[b] == 0)
            begin[chosen] = NOWHERE
        chosen = np.flatnonzero(chosen)
        ends = np.stack([reach[chosen, 0], np.minimum(reach[chosen, 1], second[chosen])], 1)
        out[chosen] = rendered_alone(field, b, rays_o[chosen], rays_d[chosen], ends, step, early_stop)
    left = np.flatnonzero((begin < np.minimum(reach[:, 1], NOWHERE)) & (out[:, 3] < 1 - early_stop))
    ends = np.stack([begin[left], reach[left, 1]], 1)
    behind = np.zeros((len(left), out.shape[1]), out.dtype)
    together(rays_o[left], rays_d[left], ends, step, early_stop, behind)
    out[left] += (1 - out[left, 3:4]) * behind


def met_blocks(field: VMField, rays_o: np.ndarray, rays_d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N,) the first block that each of rays (N, 3) comes to, or -1, and (N,) where it comes to a second one,
    or NOWHERE."""
    first, second = np.empty(len(rays_o), np.int64), np.empty(len(rays_o))
    apart, apart_at = field.apart
    at = apart_at[[block.tensor for block in field.blocks]]
    whole = exact(rays_o), exact(rays_d), field.to_unit, apart, at, is_bounded(field)
    cpu.first_two(*whole, get_num_threads(), first, second)
    return first, second


def is_bounded(field: VMField) -> np.ndarray:
    """(B,) bool, which blocks do not fill all of space."""
    return np.array([field.tensors[block.tensor].space is bounded for block in field.blocks])


def rendered_alone(
    field: VMField,
    b: int,
    rays_o: np.ndarray,
    rays_d: np.ndarray,
    reach: np.ndarray,
    step: float,
    early_stop: float,
) -> np.ndarray:
    """(N, 5) what rays show of block b, by samples in its object's frame that are as dense for it as those of
    `step` are for the field."""
    alone = field.alone[b]
    rays_o, rays_d, lengths = seen_from(field.blocks[b].object_to_field, rays_o, rays_d)
    own = sampling_step(alone) * step / sampling_step(field)
    found = np.zeros((len(rays_o), 5), np.float32)
    alone.render_rays(rays_o, rays_d, (reach.T * lengths).T, own, early_stop, found)
    found[:, 4] /= lengths
    return found
