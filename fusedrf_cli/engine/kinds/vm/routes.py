"""Rays of a field of several blocks, each through the blocks that it meets.

Who owns a cell is asked for every sample, and grids of all cells are read for it. Most rays come to the
matter of one block alone, or end in a first one before they come to that of a second: there that block
answers alone, as a field of one tensor does.
"""

from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numba import get_num_threads

from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.kernels.loops import Rays
from fusedrf_cli.engine.kernels.routing import NOWHERE, first_two, handed_on, put_behind, taken
from fusedrf_cli.engine.kinds.vm.field import VMField

Shown = Callable[[Rays, np.ndarray], None]
"""Fills out (N, 5) with what rays show, as ComputedField.show does."""


def show_by_routes(field: VMField, together: Shown, rays: Rays, out: np.ndarray) -> None:
    """Fill out (N, 5) as ComputedField.show does; `together` is that of all blocks.

    A ray is followed through its first block up to where it comes to cells with matter of a second one; if
    light is left, through that one as far as there is matter of no other; and from there through all of them.
    """
    first, second = met_blocks(field, rays)
    near, far = np.ascontiguousarray(rays.reach.T)
    steps = own_steps(field, rays.step)
    until = alone_until(field, rays, first, second, steps)
    end = np.minimum(far, until)
    numbers = np.where(until > near, first, np.int16(-1))
    if numbers.size and numbers.min() == numbers.max() and lies_in(field, numbers[0]):
        own = rays._replace(reach=np.stack([near, end], 1), step=steps[numbers[0]])
        field.alone[numbers[0]].show(own, out)  # as most of a picture's rays in a place: without copies
    else:
        out[:] = 0
        show_alone(field, rays, by_number(numbers), near, end, steps, out)
    show_second(field, rays, lit(rays, until, far, out), until, far, steps, out)
    show_behind(together, rays, [(np.eye(4), lit(rays, until, far, out))], until, far, out)


def lit(rays: Rays, until: np.ndarray, far: np.ndarray, out: np.ndarray) -> np.ndarray:
    """(M,) those rays that go on from `until` (N,), by what they have shown so far."""
    return np.flatnonzero((until < np.minimum(far, NOWHERE)) & (out[:, 3] < 1 - rays.early_stop))


def show_second(
    field: VMField,
    rays: Rays,
    left: np.ndarray,
    until: np.ndarray,
    far: np.ndarray,
    steps: list[float],
    out: np.ndarray,
) -> None:
    """Follow the rays left (M,) from until (N,) on through the bounded block whose matter comes next, up to
    where that of another one does, and move `until` there. A ray that comes to matter of a place next stays
    where it is: the place is asked together with all others there."""
    endless = np.isinf(field.balls[:, 3])
    if not len(left) or np.asarray(field.crossings)[endless].any():
        return
    beyond = rays.rays_o[left] + until[left, None] * rays.rays_d[left]
    found, further = met_blocks(field, rays._replace(rays_o=beyond, rays_d=rays.rays_d[left]), False)
    alone = ~np.append(endless, False)[found]  # the last stands for -1, where nothing comes any more
    begin, until[left] = until.copy(), until[left] + np.where(alone, further, 0)
    end = np.minimum(far, until)
    met = ((b, left[chosen]) for b, chosen in by_number(np.where(alone, found, np.int16(-1))))
    show_alone(field, rays, met, begin, end, steps, out)


def show_alone(
    field: VMField,
    rays: Rays,
    met: Iterable[tuple[int, np.ndarray]],
    begin: np.ndarray,
    end: np.ndarray,
    steps: list[float],
    out: np.ndarray,
) -> None:
    """Composite behind what out (N, 5) has what blocks show alone from and to distances begin and end (N,):
    of each block by its number rays (M,). Copies of one object are asked at once, since work in small pieces
    leaves cores idle."""
    placed: dict[int, list[tuple[np.ndarray, np.ndarray]]] = {}
    for b, chosen in met:
        placed.setdefault(twin(field, b), []).append((field.blocks[b].object_to_field, chosen))
    for b, parts in placed.items():
        show_behind(field.alone[b].show, rays._replace(step=steps[b]), parts, begin, end, out)


def twin(field: VMField, b: int) -> int:
    """The first block that shows in its object's frame what block b shows in its own."""
    tensor, tint = field.blocks[b].tensor, field.blocks[b].tint
    return next(i for i, o in enumerate(field.blocks) if o.tensor == tensor and np.array_equal(o.tint, tint))


def lies_in(field: VMField, b: int) -> bool:
    """Whether the frame of block b, -1 for none, is the field's own."""
    return b >= 0 and np.array_equal(field.blocks[b].object_to_field, np.eye(4))


def own_steps(field: VMField, step: float) -> list[float]:
    """For each block the step in its object's frame that is as dense for it as a step is for the field."""
    return [sampling_step(own) * step / sampling_step(field) for own in field.alone]


def alone_until(
    field: VMField, rays: Rays, first: np.ndarray, second: np.ndarray, steps: list[float]
) -> np.ndarray:
    """(N,) how far along each ray, whose `met_blocks` these are, only the first block needs to be asked;
    its beginning where that is not so from there on, NOWHERE where it meets no second one.

    A background is the first of every ray, and has detail finer than its step: the ray is handed on between
    two of its samples, in the core, where they are evenly apart, or where the core ends.
    """
    own_step = np.where(np.isinf(field.balls[:, 3]), steps, 0.0)
    own_step[(own_step > 0) & (np.asarray(field.crossings) != 0)] = -1
    until = np.empty(len(first))
    handed_on(rays.rays_o, rays.rays_d, np.ascontiguousarray(rays.reach), first, second, own_step, until)
    return until


def by_number(numbers: np.ndarray) -> Iterator[tuple[int, np.ndarray]]:
    """Every one of numbers (N,) int16 that is at least 0, with the places (M,) where it is, in order."""
    order = np.argsort(numbers, kind="stable")
    ends = np.cumsum(np.bincount(numbers + 1))
    for number, (low, high) in enumerate(zip(ends[:-1], ends[1:], strict=True)):
        if low < high:
            yield number, order[low:high]


def met_blocks(field: VMField, rays: Rays, everywhere: bool = True) -> tuple[np.ndarray, np.ndarray]:
    """(N,) the first block that each of the rays comes to, or -1, and (N,) where it comes to a second one, or
    NOWHERE; a place is met everywhere, or only where it has matter."""
    first, second = np.empty(len(rays.rays_o), np.int16), np.empty(len(rays.rays_o))
    apart, apart_at = field.apart
    at = apart_at[[block.tensor for block in field.blocks]]
    placed = field.to_unit, apart, at, field.balls
    first_two(rays.rays_o, rays.rays_d, *placed, everywhere, get_num_threads(), first, second)
    return first, second


def show_behind(
    show: Shown,
    rays: Rays,
    parts: list[tuple[np.ndarray, np.ndarray]],
    begin: np.ndarray,
    end: np.ndarray,
    out: np.ndarray,
) -> None:
    """Composite behind what out (N, 5) has what some rays show from and to distances begin and end (N,): in
    each part rays chosen (M,) in a frame that lies at a matrix (4, 4) of theirs; the step is that frame's."""
    ends = np.cumsum([0, *(len(chosen) for _, chosen in parts)])
    count = ends[-1]
    own_o, own_d, reach = np.empty((count, 3)), np.empty((count, 3)), np.empty((count, 2))
    lengths, found = np.empty(count), np.zeros((count, 5), out.dtype)
    for (matrix, chosen), low, high in zip(parts, ends[:-1], ends[1:], strict=True):
        turn, own = matrix[:3, :3], (own_o[low:high], own_d[low:high], reach[low:high], lengths[low:high])
        placing = np.linalg.inv(turn), matrix[:3, 3].copy(), not np.array_equal(turn, np.eye(3))
        taken(rays.rays_o, rays.rays_d, begin, end, chosen, placing, *own)
    show(rays._replace(rays_o=own_o, rays_d=own_d, reach=reach), found)
    put_behind(found, lengths, np.concatenate([chosen for _, chosen in parts]), out)
