"""What the loops do to learn: templates beside those of loops.py, compiled for a kind and a space
(`specialise`).

    query_point_backward    the adjoint of `query_point`
    train_ray               a ray forward, its loss, and its gradient back to the field's numbers
"""

import math
from typing import NamedTuple

from fusedrf_cli.engine.kernels.primitives import loss_and_grad, next_sample

DEPTH_TOLERANCE = 0.01  # share of a known depth that density may lie from it


class QueryGradients(NamedTuple):
    """What `query_point_backward` takes back to the field's numbers."""

    points: object  # (N, 3) float64
    dirs: object  # (N, 3) float64, unit length
    d_sigma: object  # (N,)
    d_rgb: object  # (N, 3)


class RaySamples(NamedTuple):
    """What the way back of one ray needs of its samples. `memory` holds the KEPT numbers of as many shaded
    samples as fit; its last slot serves all beyond, whose colours are then evaluated twice."""

    # int, twice the number of the sample in its piece: where `n_steps` is even it is between two
    index: object
    piece: object  # int
    packed: object  # int, what `unpack_cell` makes the cell of
    n_steps: object  # int
    strides: object  # int
    slot: object  # int, where in memory, or -1: not shaded
    pre: object
    weight: object
    colour_weight: object  # weight that its colour stands for
    along: object  # how far along the ray, from 0 at its origin to 1 at infinity, where that is needed
    times: object  # how many times what it sends back counts; 0: it is not followed back
    rgb: object  # (K, 3)
    memory: object


def share_along(t):
    """From 0 at a ray's origin to 1 at infinity, 1/2 at one unit."""
    return t / (1.0 + t)


def depth_error(along, depth):
    """How far what lies at `along` of a ray (share_along) is from a depth that is known: 0 within
    DEPTH_TOLERANCE of it, 1 from twice that on."""
    away = abs(along / max((1.0 - along) * depth, 1e-12) - 1.0)
    return min(1.0, max(0.0, away / DEPTH_TOLERANCE - 1.0))


def query_point_backward(field, grid, gradients, i, samples, scratch, grad, loss):
    """Adjoint of `query_point`: adds to grad (P,) what d_sigma[i] and d_rgb[i] send back."""
    p, d, d_rgb = point(triple(gradients.points, i)), triple(gradients.dirs, i), triple(gradients.d_rgb, i)
    n = i + POINTS_AHEAD
    if n < gradients.points.shape[0]:
        q = point(triple(gradients.points, n))
        prefetch_density(field, field.params, 0, q)
        prefetch_density(field, grad, 0, q)
        if gradients.d_rgb[n, 0] != 0 or gradients.d_rgb[n, 1] != 0 or gradients.d_rgb[n, 2] != 0:
            prefetch_colour(field, field.params, 0, q)
            prefetch_colour(field, grad, 0, q)
    if is_inside(field, grid, p):
        look_among(field, grid, gradients.points, i, scratch)
        sigma, pre, strides, cell = density(field, grid, 0, p, d, scratch)
        if strides > 0 and sigma > 0:
            shaded = d_rgb[0] != 0 or d_rgb[1] != 0 or d_rgb[2] != 0
            rgb = 0.0, 0.0, 0.0
            if shaded:
                ray_setup(field, d, scratch)
                rgb = colour(field, cell, p, d, scratch, samples.memory, 0)
            d_sigma = rate(p, d) * float(gradients.d_sigma[i])
            backward(field, cell, p, d, pre, d_sigma, shaded, rgb, d_rgb, scratch, samples.memory, 0, grad)
            if shaded:
                ray_backward(field, d, scratch, grad)


def random_of(jitter):
    """A number in [0, 1) that has nothing to do with where a ray's samples lie: the jitter's last digits."""
    last = jitter * 1048576.0
    return last - math.floor(last)


def stochastic_backprop(batch, weight, chance):
    """How many times the gradient of a ray's next sample counts, 0 where it is not followed back; and the
    chance for the sample behind it. weight: its own, and what waits before it for a colour.

    A sample of less than batch.light is followed by a chance in proportion to that and counts for those that
    are not, so that the mean is the gradient of all. `chance` is summed along the ray, and one sample is
    taken wherever it passes a whole number: systematic sampling, which varies less than a draw for each.
    """
    if batch.light <= 0.0:
        return 1.0, chance
    share = min(1.0, weight / batch.light)
    chance += share
    if chance < 1.0:
        return 0.0, chance
    return 1.0 / share, chance - 1.0


def prefetch_sample(field, packed, origin, direction, t_begin, step, index, n_steps):
    """Ask for what the sample of `n_steps` steps from step `index` of a piece on, if there is one, will
    read; `packed` is of the one before it. Planes and rows lie all over memory: asked for one sample early,
    their misses overlap with the work on the one before."""
    if index >= 0:
        p = position_at(origin, direction, t_begin + 0.5 * midpoint(index, n_steps) * step)
        prefetch_density(field, field.params, packed, p)
        prefetch_colour(field, field.params, packed, p)


def train_ray(field, grid, batch, i, samples, scratch, grad, loss):
    """Ray i of a batch: forward as in `show_ray` of instances.py, compare, and back along the ray into grad
    (P,)."""
    o, d, step = triple(batch.rays_o, i), triple(batch.rays_d, i), batch.step
    red, green, blue = 0.0, 0.0, 0.0
    trans, pending = 1.0, 0.0
    count, shaded, chance = 0, 0, random_of(batch.jitter[i])
    last, piece_begin = samples.memory.shape[0] - KEPT, first_piece_at(o, d, batch.near)
    packed = 0
    for number in range(PIECES):
        if trans <= batch.early_stop:
            break
        (origin, direction, t_begin, t_end, warp), piece_begin = next_piece(piece_begin, grid, o, d, FARTHEST)
        t_begin = t_begin + batch.jitter[i] * step
        index, n_steps = next_sample(grid, origin, direction, t_begin, t_end, step, 0)
        prefetch_sample(field, packed, origin, direction, t_begin, step, index, n_steps)
        while index >= 0 and trans > batch.early_stop and count < samples.index.shape[0]:
            t_local = t_begin + 0.5 * midpoint(index, n_steps) * step
            following, wide = next_sample(grid, origin, direction, t_begin, t_end, step, index + n_steps)
            prefetch_sample(field, packed, origin, direction, t_begin, step, following, wide)
            line = origin, direction, warp
            look_along(field, grid, line, t_begin, t_end, step, index, n_steps, scratch)
            p, opacity, pre, strides, cell = alpha_at(
                field, grid, line, index, n_steps, t_local, step, d, scratch
            )
            if strides > 0:
                packed = pack_cell(cell)
                weight = trans * opacity
                trans -= weight
                times, chance = stochastic_backprop(batch, weight + pending, chance)
                if times > 0.0:
                    prefetch_density(field, grad, packed, p)
                samples.times[count] = times
                samples.index[count], samples.n_steps[count], samples.strides[count] = (
                    midpoint(index, n_steps),
                    n_steps,
                    strides,
                )
                samples.piece[count], samples.packed[count] = number, packed
                samples.slot[count], samples.pre[count], samples.weight[count] = -1, pre, weight
                if batch.distortion > 0.0 or i < batch.depths.shape[0]:
                    samples.along[count] = share_along(distance(warp, t_local))
                pending += weight
                if pending > LEARN_FROM:
                    if shaded == 0:
                        ray_setup(field, d, scratch)
                    at = min(shaded * KEPT, last)
                    if times > 0.0:
                        prefetch_colour(field, grad, packed, p)
                    r, g, b = colour(field, cell, p, d, scratch, samples.memory, at)
                    red += pending * r
                    green += pending * g
                    blue += pending * b
                    samples.rgb[count, 0], samples.rgb[count, 1], samples.rgb[count, 2] = r, g, b
                    samples.slot[count], samples.colour_weight[count] = at, pending
                    pending = 0.0
                    shaded += 1
                count += 1
            to = next_index(field, grid, cell, n_steps, strides, index, p, direction, t_local, t_begin, step)
            if to != index + n_steps:
                following, wide = next_sample(grid, origin, direction, t_begin, t_end, step, to)
            index, n_steps = following, wide
    work = count + SHADING_COST * shaded
    d_colour, d_trans = loss_and_grad(batch, i, (red, green, blue), trans, work, loss)
    if count > 0:
        counts = count, shaded
        train_ray_backward(field, grid, batch, i, samples, counts, trans, d_colour, d_trans, scratch, grad)


def train_ray_backward(field, grid, batch, i, samples, counts, trans, d_colour, d_trans, scratch, grad):
    """The way back of `train_ray` over the samples counts: (how many, how many of them shaded).

    d_colour is the gradient of the loss in the ray's colour, d_trans that in the transmittance behind it;
    `behind` gathers the share of all that lies behind a sample.
    """
    count, shaded = counts
    o, d, step = triple(batch.rays_o, i), triple(batch.rays_d, i), batch.step
    last = samples.memory.shape[0] - KEPT
    overwritten = shaded * KEPT > samples.memory.shape[0]
    depth, far = 0.0, 0.0
    if i < batch.depths.shape[0]:
        depth, far = batch.depths[i], batch.depth_weight / batch.target.shape[0]
    behind = trans * (d_trans + far)
    after = trans
    shown = 0.0
    before, beyond = (0.0, 0.0), (0.0, 0.0)
    if batch.distortion > 0.0:
        for q in range(count):
            before = before[0] + samples.weight[q], before[1] + samples.weight[q] * samples.along[q]
    number = samples.piece[count - 1]
    origin, direction, t_begin, _, warp = piece(number, grid, o, d, batch.near, FARTHEST)
    for q in range(count - 1, -1, -1):
        if PIECES > 1 and samples.piece[q] != number:
            number = samples.piece[q]
            origin, direction, t_begin, _, warp = piece(number, grid, o, d, batch.near, FARTHEST)
        t_local = t_begin + batch.jitter[i] * step + 0.5 * samples.index[q] * step
        p = position_at(origin, direction, t_local)
        cell, at, weight = unpack_cell(field, samples.packed[q], p), samples.slot[q], samples.weight[q]
        rgb, d_rgb = (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
        if at >= 0:
            rgb = samples.rgb[q, 0], samples.rgb[q, 1], samples.rgb[q, 2]
            shown = d_colour[0] * rgb[0] + d_colour[1] * rgb[1] + d_colour[2] * rgb[2]
            if overwritten and at == last:
                colour(field, cell, p, d, scratch, samples.memory, last)
            colour_weight = samples.colour_weight[q]
            d_rgb = d_colour[0] * colour_weight, d_colour[1] * colour_weight, d_colour[2] * colour_weight
        length = optical_length(warp, p, d, t_local, samples.n_steps[q], samples.strides[q], step)
        spread = far * depth_error(samples.along[q], depth) if far > 0.0 else 0.0
        if batch.distortion > 0.0:
            here = samples.along[q]
            before = before[0] - weight, before[1] - weight * here
            apart = here * (before[0] - beyond[0]) - (before[1] - beyond[1])
            apart += weight * length / rate(p, d) * (1.0 - here) * (1.0 - here) / 3.0
            spread += 2.0 * batch.distortion / batch.target.shape[0] * apart
            beyond = beyond[0] + weight, beyond[1] + weight * here
        d_sigma = length * (after * (shown + spread) - behind)
        behind += weight * (shown + spread)
        after += weight
        times = samples.times[q]
        if weight > 0.0 and times > 0.0:
            d_sigma, d_rgb = times * d_sigma, (times * d_rgb[0], times * d_rgb[1], times * d_rgb[2])
            backward(
                field,
                cell,
                p,
                d,
                samples.pre[q],
                d_sigma,
                at >= 0,
                rgb,
                d_rgb,
                scratch,
                samples.memory,
                at,
                grad,
            )
    if shaded > 0:
        ray_backward(field, d, scratch, grad)
