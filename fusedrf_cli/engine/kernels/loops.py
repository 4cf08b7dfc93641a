"""The loops of every kind of field, written once: march, query, weigh; learning.py has those that learn, and
instances.py those that render.

These functions are templates: `specialise` gives them, the device functions of a kind and those of a space
one namespace, compiled for the sizes of a field. So names that are not defined here, such as `density`,
`piece` or SCRATCH, are the kind's, the space's and the field's.

What a kind's module of device functions has, with p the point in the space's coordinates, d the unit
direction of the ray in the field's frame, `field` its Arrays, and `scratch` SCRATCH numbers of the field's
type, 0 at first where gradients are gathered:
    sizes(field)                       for Python: constants of the namespace by name; SCRATCH and KEPT, the
                                       numbers kept per shaded sample for the way back, are among them
    density(field, grid, index, p, d, scratch)
                                       (σ, pre, strides, cell): σ in the unit of the space (`rate`); `pre`
                                       what `backward` needs of it; for how many steps of the ray the
                                       sample of that index stands, 0 where there is nothing to sample;
                                       `cell`, an int or a tuple, what the other functions need to know of
                                       where p lies
    colour(field, cell, p, d, scratch, memory, at)
                                       (r, g, b) in [0, 1] as floats; leaves KEPT numbers in memory[at:]
    backward(field, cell, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, memory, at, grad)
                                       adds to grad what d_sigma, and where shaded d_rgb (3), send back; rgb
                                       and memory[at:] are as `colour` left them
And what it may have, with the defaults below:
    ray_setup, ray_backward            once per ray before the first `colour`, and after the last
                                       `backward`: fold the direction into a basis; scatter its gradient, and
                                       leave 0 what has gathered it
    pack_cell, unpack_cell, next_index, is_inside, prefetch_density, prefetch_colour
    LEARN_FROM, SHADING_COST among its sizes
"""

import math
from typing import NamedTuple

import numpy as np
from numba import prange

from fusedrf_cli.engine.kernels.primitives import accumulate, cell_of, next_sample, occupied, raise_to

COLOUR_FROM = 1e-4  # weight below which a sample's colour is not evaluated
LEARN_FROM = COLOUR_FROM  # the same in training
SHARED_COLOUR_FROM = 2e-3  # the same in pictures, behind a ray's first colour
REST_FROM = 0.0  # transmittance from which, in pictures that may stop early, all that is left shows a sample
SHADING_COST = 0  # of a shaded sample, beyond that of one sample: training counts work in samples
POINTS_AHEAD = 4  # a point's numbers are asked for so many points before it
POINTS_PER_TASK = 2048
RAYS_PER_TASK = 256


class PointBatch(NamedTuple):
    """What `query_point` answers."""

    points: object  # (N, 3) float64
    dirs: object  # (N, 3) float64, unit length
    with_colour: object  # bool


class PointValues(NamedTuple):
    """What `query_point` fills."""

    sigma: object  # (N,)
    rgb: object  # (N, 3)


class WeightRays(NamedTuple):
    """What `weigh_ray` follows."""

    rays_o: object  # (N, 3) float64
    rays_d: object  # (N, 3) float64, unit length
    jitter: object  # (N,) float64 in [0, 1)
    near: object  # float
    step: object  # float
    early_stop: object  # float


class VoteRays(NamedTuple):
    """What `vote_ray` follows, and the cells it votes for."""

    rays_o: object  # (N, 3) float64
    rays_d: object  # (N, 3) float64, unit length
    jitter: object  # (N,) float64 in [0, 1)
    inside: object  # (N,) uint8, 1 for a vote in favour
    step: object  # float
    early_stop: object  # float
    lo: object  # (3,) lower corner of cell (0, 0, 0), in the space's coordinates
    cell: object  # (3,) size of a cell
    counts: object  # (3,) int64 cells per axis


class Cells(NamedTuple):
    """What `peak_of_cell` looks into."""

    lo: object  # (3,) lower corner of cell (0, 0, 0)
    cell: object  # (3,) size of a cell
    cells: object  # (N, 3) int64
    offsets: object  # (K, 3) in [0, 1], where in a cell


# -- what a kind may leave out -------------------------------------------------------------------------------


def ray_setup(field, d, scratch):
    """Prepare `scratch` for colours seen along d."""


def ray_backward(field, d, scratch, grad):
    """Send back what `backward` has gathered in `scratch` since `ray_setup`, and clear it."""


def pack_cell(cell):
    """An int from which `unpack_cell` makes the cell again."""
    return 0


def unpack_cell(field, packed, p):
    """The cell of a point p, from what `pack_cell` made of it; whatever rounding does to p, this and
    `backward` must read no number out of bounds."""
    return packed


def next_index(field, grid, cell, n_steps, strides, index, p, direction, t_local, t_begin, step):
    """The number of the sample after `index`, which lies at p, t_local on a line along `direction`, and
    stands for `n_steps` times `strides` steps, which is 0 where there is nothing. Sample n lies at t_begin +
    n step."""
    return index + max(n_steps * strides, 1)


def is_inside(field, grid, p):
    """Whether a query of p is answered at all."""
    return occupied(grid, p)


def prefetch_density(field, array, packed, p):
    """Ask for what `density` will read at p in an array laid out as the field's numbers, in the cell that
    `packed` (0 where it is not known) belongs to."""


def prefetch_colour(field, array, packed, p):
    """As `prefetch_density`, what `colour` will read."""


# -- one item of work ----------------------------------------------------------------------------------------


def triple(values, i):
    """Row i of an array (N, 3) as three floats."""
    return float(values[i, 0]), float(values[i, 1]), float(values[i, 2])


def midpoint(index, n_steps):
    """Twice the number, on a ray's lattice, of the middle of `n_steps` steps from step `index` on."""
    return 2 * index + n_steps - 1


def optical_length(warp, p, d, t_local, n_steps, strides, step):
    """How much of a ray along d, by the unit that σ at p is of, a sample at t_local stands for: `n_steps`
    steps around it, and as many again behind it for each of `strides` beyond the first."""
    return rate(p, d) * span(warp, t_local + 0.5 * (strides - 1) * n_steps * step, strides * n_steps * step)


def alpha_at(field, grid, line, index, n_steps, t_local, step, d, scratch):
    """What a ray meets at t_local of a piece, line (origin, direction, warp), in `n_steps` steps from step
    `index` on: the point; the share of the light that is lost there; and what `density` says besides σ."""
    origin, direction, warp = line
    p = position_at(origin, direction, t_local)
    sigma, pre, strides, cell = density(field, grid, index, p, d, scratch)
    opacity = 0.0
    if strides > 0:
        opacity = 1.0 - math.exp(-sigma * optical_length(warp, p, d, t_local, n_steps, strides, step))
    return p, opacity, pre, strides, cell


def query_point(field, grid, query, i, scratch, memory, out):
    """σ (1/length) and rgb at point i; both 0 where the field is not known."""
    p, d = point(triple(query.points, i)), triple(query.dirs, i)
    n = i + POINTS_AHEAD
    if n < query.points.shape[0]:
        q = point(triple(query.points, n))
        prefetch_density(field, field.params, 0, q)
        if query.with_colour:
            prefetch_colour(field, field.params, 0, q)
    out.sigma[i] = 0
    out.rgb[i, 0], out.rgb[i, 1], out.rgb[i, 2] = 0, 0, 0
    if is_inside(field, grid, p):
        look_among(field, grid, query.points, i, scratch)
        sigma, _, strides, cell = density(field, grid, 0, p, d, scratch)
        if strides > 0:
            out.sigma[i] = rate(p, d) * sigma
            if query.with_colour and sigma > 0:
                ray_setup(field, d, scratch)
                rgb = colour(field, cell, p, d, scratch, memory, 0)
                out.rgb[i, 0], out.rgb[i, 1], out.rgb[i, 2] = rgb


def weigh_ray(field, grid, rays, i, samples, scratch, most, loss):
    """Raises most[c] to the weight of each sample of ray i that lies in cell c of the grid, counted z first,
    where it is more. Samples lie `rays.jitter[i]` of a step into each step."""
    o, d, step = triple(rays.rays_o, i), triple(rays.rays_d, i), rays.step
    nx, ny, nz = grid.skip.shape
    trans = 1.0
    for number in range(PIECES):
        origin, direction, t_begin, t_end, warp = piece(number, grid, o, d, rays.near, FARTHEST)
        t_begin = t_begin + rays.jitter[i] * step
        index, n_steps = next_sample(grid, origin, direction, t_begin, t_end, step, 0)
        while index >= 0 and trans > rays.early_stop:
            t_local = t_begin + 0.5 * midpoint(index, n_steps) * step
            line = origin, direction, warp
            look_along(field, grid, line, t_begin, t_end, step, index, n_steps, scratch)
            p, opacity, _, strides, cell = alpha_at(
                field, grid, line, index, n_steps, t_local, step, d, scratch
            )
            if strides > 0:
                weight = trans * opacity
                trans -= weight
                x = cell_of(p[0], grid.lo[0], grid.cell[0], nx)
                y = cell_of(p[1], grid.lo[1], grid.cell[1], ny)
                z = cell_of(p[2], grid.lo[2], grid.cell[2], nz)
                c = (x * ny + y) * nz + z
                raise_to(most, c, weight)
            index = next_index(
                field, grid, cell, n_steps, strides, index, p, direction, t_local, t_begin, step
            )
            index, n_steps = next_sample(grid, origin, direction, t_begin, t_end, step, index)


def vote_ray(field, grid, rays, i, samples, scratch, votes, loss):
    """Adds to votes[2 c], or, where `rays.inside[i]`, to votes[2 c + 1] the weight of each sample of ray i in
    cell c of a box of cells, counted z first. Samples lie `rays.jitter[i]` of a step into each step."""
    o, d, step = triple(rays.rays_o, i), triple(rays.rays_d, i), rays.step
    nx, ny, nz = rays.counts[0], rays.counts[1], rays.counts[2]
    trans = 1.0
    for number in range(PIECES):
        origin, direction, t_begin, t_end, warp = piece(number, grid, o, d, 0.0, FARTHEST)
        t_begin = t_begin + rays.jitter[i] * step
        index, n_steps = next_sample(grid, origin, direction, t_begin, t_end, step, 0)
        while index >= 0 and trans > rays.early_stop:
            t_local = t_begin + 0.5 * midpoint(index, n_steps) * step
            line = origin, direction, warp
            look_along(field, grid, line, t_begin, t_end, step, index, n_steps, scratch)
            p, opacity, _, strides, cell = alpha_at(
                field, grid, line, index, n_steps, t_local, step, d, scratch
            )
            if strides > 0:
                weight = trans * opacity
                trans -= weight
                x = math.floor((p[0] - rays.lo[0]) / rays.cell[0])
                y = math.floor((p[1] - rays.lo[1]) / rays.cell[1])
                z = math.floor((p[2] - rays.lo[2]) / rays.cell[2])
                if 0 <= x < nx and 0 <= y < ny and 0 <= z < nz:
                    accumulate(votes, 2 * ((x * ny + y) * nz + z) + rays.inside[i], weight)
            index = next_index(
                field, grid, cell, n_steps, strides, index, p, direction, t_local, t_begin, step
            )
            index, n_steps = next_sample(grid, origin, direction, t_begin, t_end, step, index)


def point_of_cell(cells, i, q):
    """Where in cell i offset q is."""
    return (
        cells.lo[0] + (cells.cells[i, 0] + cells.offsets[q, 0]) * cells.cell[0],
        cells.lo[1] + (cells.cells[i, 1] + cells.offsets[q, 1]) * cells.cell[1],
        cells.lo[2] + (cells.cells[i, 2] + cells.offsets[q, 2]) * cells.cell[2],
    )


def peak_of_cell(field, grid, cells, i, scratch, memory, out):
    """Largest σ, per length of the coordinates, over `offsets` in cell i."""
    best = 0.0
    for q in range(cells.offsets.shape[0]):
        p = point_of_cell(cells, i, q)
        look_into_cell(field, grid, cells, i, q, scratch)
        sigma = density(field, grid, 0, p, (0.0, 0.0, 1.0), scratch)[0]
        best = max(best, depth_per_coordinate(p) * sigma)
    out[i] = best


# -- the CPU's loops over items ------------------------------------------------------------------------------
# `item` is one of the functions above, or one of a kind's own with the same arguments.


def each_task(field, grid, query, low, high, scratch, memory, out):
    """`each` for items low..high: the serial work of one core."""
    for i in range(low, high):
        item(field, grid, query, i, scratch, memory, out)


def each(field, grid, query, count, per_task, threads, out):
    """An item of work for each i < count, each filling what is its own in `out`.

    A thread gets a run of what is iterated over, so tasks are dealt out to so many threads in turn: half
    of a picture is often sky, and the thread that had it would wait for the others.
    """
    parts = (count + per_task - 1) // per_task
    each_has = (parts + threads - 1) // threads
    for turn in prange(each_has * threads):
        part = turn % each_has * threads + turn // each_has
        real = field.params.dtype
        scratch, memory = np.zeros(SCRATCH + LANE_ROOM, real), np.empty(max(KEPT, 1), real)
        low, high = part * per_task, min(count, (part + 1) * per_task)
        each_task(field, grid, query, low, high, scratch, memory, out)


def sweep_task(field, grid, batch, low, high, samples, scratch, grad, loss):
    """`sweep` for items low..high, into one row of gradients and losses."""
    for i in range(low, high):
        item(field, grid, batch, i, samples, scratch, grad, loss)


def sweep(field, grid, batch, count, most, grads, loss):
    """An item of work, of at most so many samples, for each i < count, each adding to a gradient: part p
    of them to row p of grads (parts, P) and of loss (parts, 3)."""
    n_rows = grads.shape[0]
    for p in prange(n_rows):
        real = field.params.dtype
        integers, reals = np.empty((6, most), np.int64), np.empty((5, most))
        samples = RaySamples(
            integers[0], integers[1], integers[2], integers[3], integers[4], integers[5], reals[0], reals[1],
            reals[2], reals[3], reals[4], np.empty((most, 3)), np.empty(max(most * KEPT, 1), real),
        )  # fmt: skip
        low, high = p * count // n_rows, (p + 1) * count // n_rows
        sweep_task(
            field, grid, batch, low, high, samples, np.zeros(SCRATCH + LANE_ROOM, real), grads[p], loss[p]
        )


# -- marching, which needs no field --------------------------------------------------------------------------


def march_ray(grid, rays_o, rays_d, reach, jitter, step, i, start, ts, spans, counts):
    """The next samples of ray i within reach[i], from start[i] (piece and number of the sample) on: distances
    ts[i], what lengths of the ray they stand for, spans[i], as many as counts[i]."""
    o, d = triple(rays_o, i), triple(rays_d, i)
    for number in range(start[i] % PIECES, PIECES):
        origin, direction, t_begin, t_end, warp = piece(number, grid, o, d, reach[i, 0], reach[i, 1])
        t_begin = t_begin + jitter[i] * step
        first = start[i] // PIECES if number == start[i] % PIECES else 0
        index, n_steps = next_sample(grid, origin, direction, t_begin, t_end, step, first)
        while index >= 0 and counts[i] < ts.shape[1]:
            t_local = t_begin + 0.5 * midpoint(index, n_steps) * step
            ts[i, counts[i]], spans[i, counts[i]] = (
                distance(warp, t_local),
                span(warp, t_local, n_steps * step),
            )
            counts[i] += 1
            index, n_steps = next_sample(grid, origin, direction, t_begin, t_end, step, index + n_steps)
        if index >= 0:
            start[i] = index * PIECES + number
            return
    start[i] = -1


def march(grid, rays_o, rays_d, reach, jitter, step, start, alive, ts, spans, counts):
    """The next samples of every living ray, from and to the distances reach (N, 2): ts (N, K) distances,
    spans (N, K) the lengths that they stand for, counts (N,); start (N,) int64, 0 at first, is where to go
    on, -1 at the end."""
    for i in prange(rays_o.shape[0]):
        counts[i] = 0
        if alive[i] and start[i] >= 0:
            march_ray(grid, rays_o, rays_d, reach, jitter, step, i, start, ts, spans, counts)
