"""Rays of a field of several blocks, each through the blocks that it meets.

Who owns a cell is asked for every sample, and grids of all cells are read for it. Most rays come to the
matter of one block alone, or end in a first one before they come to that of a second: there that block
answers alone, as a field of one tensor does.
"""

from collections.abc import Callable

import numpy as np
from numba import get_num_threads

from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.kernels import cpu
from fusedrf_cli.engine.kernels.loops import Rays
from fusedrf_cli.engine.kernels.plain import NOWHERE
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.volume import seen_from


def show_by_routes(
    field: VMField, together: Callable[[Rays, np.ndarray], None], rays: Rays, out: np.ndarray
) -> None:
    """Fill out (N, 5) as ComputedField.show does; `together` is that of all blocks.

    A ray is followed through its first block up to where it comes to cells with matter of a second one, and
    from there, if light is left, through all of them. A background is the first of every ray: it has detail
    finer than its step, so that a ray must be on one lattice of samples from end to end, and only rays that
    meet nothing else are its alone.
    """
    first, second = met_blocks(field, rays)
    bounds = np.isfinite(field.balls[:, 3])
    near, far = rays.reach.T
    out[:], begin = 0, near.copy()
    for b in np.flatnonzero(np.bincount(first + 1)[1:]).tolist():
        chosen = first == b
        if bounds[b]:
            begin[chosen] = np.maximum(near, second)[chosen]
        else:
            chosen &= (second == NOWHERE) & (field.crossings[b] == 0)
            begin[chosen] = NOWHERE
        chosen = np.flatnonzero(chosen)
        out[chosen] = shown_alone(field, b, picked(rays, chosen, near, np.minimum(far, second)))
    left = np.flatnonzero((begin < np.minimum(far, NOWHERE)) & (out[:, 3] < 1 - rays.early_stop))
    behind = np.zeros((len(left), out.shape[1]), out.dtype)
    together(picked(rays, left, begin, far), behind)
    out[left] += (1 - out[left, 3:4]) * behind


def picked(rays: Rays, chosen: np.ndarray, begin: np.ndarray, end: np.ndarray) -> Rays:
    """Some of the rays, from and to the distances (N,) that are said of all."""
    reach = np.stack([begin[chosen], end[chosen]], 1)
    return rays._replace(rays_o=rays.rays_o[chosen], rays_d=rays.rays_d[chosen], reach=reach)


def met_blocks(field: VMField, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """(N,) the first block that each of the rays comes to, or -1, and (N,) where it comes to a second one, or
    NOWHERE."""
    first, second = np.empty(len(rays.rays_o), np.int64), np.empty(len(rays.rays_o))
    apart, apart_at = field.apart
    at = apart_at[[block.tensor for block in field.blocks]]
    placed = field.to_unit, apart, at, field.balls
    cpu.first_two(rays.rays_o, rays.rays_d, *placed, get_num_threads(), first, second)
    return first, second


def shown_alone(field: VMField, b: int, rays: Rays) -> np.ndarray:
    """(N, 5) what rays show of block b, by samples in its object's frame that are as dense for it as theirs
    are for the field."""
    alone = field.alone[b]
    rays_o, rays_d, lengths = seen_from(field.blocks[b].object_to_field, rays.rays_o, rays.rays_d)
    step = sampling_step(alone) * rays.step / sampling_step(field)
    found = np.zeros((len(rays_o), 5), np.float32)
    reach = rays.reach * np.reshape(lengths, (-1, 1))
    alone.show(Rays(rays_o, rays_d, reach, float(step), rays.early_stop), found)
    found[:, 4] /= lengths
    return found
