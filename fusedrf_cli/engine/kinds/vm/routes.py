"""Rays of a field of several blocks, each through the blocks that it meets.

Who owns a cell is asked for every sample, and grids of all cells are read for it. Most rays come to the
matter of one block alone, or end in a first one before they come to that of a second: there that block
answers alone, as a field of one tensor does.
"""

from collections.abc import Callable, Iterator

import numpy as np
from numba import get_num_threads

from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.kernels.loops import Rays
from fusedrf_cli.engine.kernels.routing import NOWHERE, first_two, put_behind, taken
from fusedrf_cli.engine.kinds.vm.field import VMField

Shown = Callable[[Rays, np.ndarray], None]
"""Fills out (N, 5) with what rays show, as ComputedField.show does."""


def show_by_routes(field: VMField, together: Shown, rays: Rays, out: np.ndarray) -> None:
    """Fill out (N, 5) as ComputedField.show does; `together` is that of all blocks.

    A ray is followed through its first block up to where it comes to cells with matter of a second one, and
    from there, if light is left, through all of them. A background is the first of every ray: it has detail
    finer than its step, so that a ray must be on one lattice of samples from end to end, and only rays that
    meet nothing else are its alone.
    """
    first, second = met_blocks(field, rays)
    near, far = np.ascontiguousarray(rays.reach.T)
    out[:], before = 0, np.minimum(far, second)
    alone = goes_alone(field, first, second)
    for b, chosen in by_number(np.where(alone, first, -1)):
        matrix, own = field.blocks[b].object_to_field, field.alone[b]
        # samples in the object's frame that are as dense for it as those of all blocks are for the field
        step = sampling_step(own) * rays.step / sampling_step(field)
        show_behind(own.show, rays._replace(step=step), chosen, near, before, matrix, out)
    begin = np.where(alone, np.maximum(near, second), near)
    left = np.flatnonzero((begin < np.minimum(far, NOWHERE)) & (out[:, 3] < 1 - rays.early_stop))
    show_behind(together, rays, left, begin, far, np.eye(4), out)


def goes_alone(field: VMField, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """(N,) bool, whether a ray whose `met_blocks` these are is the first block's alone until it comes to the
    second; so is one that meets none, of which nothing is left."""
    bounded = np.isfinite(field.balls[:, 3])
    direct = np.equal(field.crossings, 0)
    return np.append(bounded, True)[first] | (np.append(direct, True)[first] & (second == NOWHERE))


def by_number(numbers: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Every one of numbers (N,) int16 that is at least 0, with the places (M,) where it is, in order."""
    order = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers + 1))
    for number, (low, high) in enumerate(zip(ends[:-1], ends[1:], strict=True)):
        if low < high:
            yield number, order[low:high]


def met_blocks(field: VMField, rays: Rays) -> tuple[np.ndarray, np.ndarray]:
    """(N,) the first block that each of the rays comes to, or -1, and (N,) where it comes to a second one, or
    NOWHERE."""
    first, second = np.empty(len(rays.rays_o), np.int16), np.empty(len(rays.rays_o))
    apart, apart_at = field.apart
    at = apart_at[[block.tensor for block in field.blocks]]
    placed = field.to_unit, apart, at, field.balls
    first_two(rays.rays_o, rays.rays_d, *placed, get_num_threads(), first, second)
    return first, second


def show_behind(
    show: Shown,
    rays: Rays,
    chosen: np.ndarray,
    begin: np.ndarray,
    end: np.ndarray,
    matrix: np.ndarray,
    out: np.ndarray,
) -> None:
    """Composite behind what out (N, 5) has what rays chosen (M,) show, from and to distances begin and end
    (N,), in a frame that lies at matrix (4, 4) of theirs; the step is that frame's."""
    count, turn = len(chosen), matrix[:3, :3]
    own_o, own_d, reach = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 2))
    lengths, found = np.empty(count), np.zeros((count, 5), out.dtype)
    placing = np.linalg.inv(turn), matrix[:3, 3].copy(), not np.array_equal(turn, np.eye(3))
    taken(rays.rays_o, rays.rays_d, begin, end, chosen, placing, own_o, own_d, reach, lengths)
    show(rays._replace(rays_o=own_o, rays_d=own_d, reach=reach), found)
    put_behind(found, lengths, chosen, out)
