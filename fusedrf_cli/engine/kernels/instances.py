"""What the loops do for scenes of several placed fields: templates beside those of loops.py, compiled for a
kind and a space (`specialise`).

An *instance* is a field placed in the scene's frame. Along a ray it has samples of its own, at its own step,
which begin where the ray does, wherever the ray is cut into *segments*: a segment takes those samples whose
first step has its middle in it. Distances t along rays are those of the scene's frame, whose unit is `length`
long in an instance's. A *slot* is the segment of one ray and one instance in it.

An instance shows what lies in all of its *crops*, boxes and balls, each of which is a row of 13 numbers: a
(3, 4) from the scene's frame to one in which it is the cube from -1 to 1 or the unit ball, row by row, and
whether it is the ball. They are convex, so that a ray is in all of them between two distances, and a slot's
samples are those of the segment between these: a crop moves none.

    show_ray    slots of an instance that is alone: marched, shaded and composited behind what the ray has
    trace_ray   slots of segments where instances meet: the samples of one of them, without their colours
    shade_ray   the colours of those samples by the weights that they were given
    densest_at, colour_at
                the same for points
    next_change where along a ray an instance's occupied cells begin, or end (needs no kind, only a space)
"""

import math
from typing import NamedTuple

import numpy as np

from fusedrf_cli.engine.kernels.primitives import (
    FACE_TOLERANCE,
    FARTHEST,
    along,
    cell_of,
    exit_distance,
    next_sample,
)

MAX_TRACED = 24  # samples of a slot: what does not fit is left to the ray's next segment
ANYWHERE = -1.0  # for a gap: where occupied cells begin
DENSER = 1 + 1e-6  # times as dense at least, to be denser: else the first instance shows, not a rounding


class Instances(NamedTuple):
    """Placed fields by the cells that they occupy (B instances)."""

    world_to_instance: object  # (B, 3, 4) from the scene's frame
    lo: object  # (B, 3) lower corner of its grid, in the coordinates of its space
    hi: object  # (B, 3)
    cell: object  # (B, 3) size of a cell
    counts: object  # (B, 3) int64 cells per axis
    first_cell: object  # (B,) int64, where its cells begin in `skip`
    skip: object  # flat uint8, see GridArrays
    step: object  # (B,) at which it is sampled, in its own coordinates
    spheres: object  # (B, 4) centre and radius around its occupied cells, in the scene's frame; or infinite
    space: object  # (B,) int64, the number of its space among those without end that instances lie in; or -1
    shown: object  # (B, 4) what its density is multiplied by, and its colours: red, green and blue
    first_crop: object  # (B + 1,) int64, where its crops begin in `crops`, and end where the next one's begin
    crops: object  # (C, 13), see above


class Box(NamedTuple):
    """As much of a grid as `next_piece` reads."""

    lo: object
    hi: object


class Slots(NamedTuple):
    """Those slots, chosen (M,) of S, on N rays that belong to instances of one field."""

    rays_o: object  # (N, 3) float64, in the scene's frame
    rays_d: object  # (N, 3) float64, unit length
    reach: object  # (N, 2) float64, from which distance to which rays are followed: samples begin there
    chosen: object  # (M,) int64
    ray: object  # (S,) int64
    instance: object  # (S,) int64
    begin: object  # (N,) float64, where the ray's segment begins
    end: object  # (N,) float64, where it ends
    world_to_instance: object  # (B, 3, 4)
    shown: object  # (B, 4), see Instances
    first_crop: object  # (B + 1,), see Instances
    crops: object  # (C, 13), see Instances
    step: object  # float, in the coordinates of the instance
    early_stop: object  # float, the transmittance at which a ray ends
    rendered: object  # (N, 5) what lies before the segment, as `show_ray` leaves it


class Traces(NamedTuple):
    """The samples of S slots, at most MAX_TRACED each, in order; distances are the scene's."""

    count: object  # (S,) int64
    complete: object  # (S,) up to where they are all of them, FARTHEST where none was left out
    low: object  # (S, MAX_TRACED) from where a sample stands
    high: object  # (S, MAX_TRACED) to where
    middle: object  # (S, MAX_TRACED) where it was taken
    depth: object  # (S, MAX_TRACED) its optical depth
    weight: object  # (S, MAX_TRACED) the share of the light that it takes, see `merge_samples`
    cell: object  # (S, MAX_TRACED) int64, what `pack_cell` makes of its cell
    cursor: object  # (S,) int64, used while samples are merged
    rgb: object  # (S, 3) the sum of their colours by weight


class PointQuery(NamedTuple):
    """Points chosen (M,) of N for one instance."""

    points: object  # (N, 3) float64, in the scene's frame
    dirs: object  # (N, 3) float64, unit length
    chosen: object  # (M,) int64
    instance: object  # int
    world_to_instance: object  # (B, 3, 4)
    shown: object  # (B, 4), see Instances
    first_crop: object  # (B + 1,), see Instances
    crops: object  # (C, 13), see Instances
    adds: object  # bool: densities add up, and colours by their shares
    with_colour: object  # bool


class PointAnswers(NamedTuple):
    """What `densest_at` and `colour_at` fill."""

    sigma: object  # (N,) float64 per length of the scene's frame
    densest: object  # (N,) int64, the densest instance, or -1
    cell: object  # (N,) int64, what `pack_cell` makes of its cell
    rgb: object  # (N, 3) float64


# -- rays ----------------------------------------------------------------------------------------------------


def ray_in_instance(world_to_instance, b, rays_o, rays_d, r):
    """Row r of origins and directions in the frame of instance b: (origin, direction, its length), not of
    unit length: distances along it are those of the scene."""
    m = world_to_instance[b]
    x, y, z = rays_o[r, 0], rays_o[r, 1], rays_o[r, 2]
    o = (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3],
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3],
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3],
    )
    x, y, z = rays_d[r, 0], rays_d[r, 1], rays_d[r, 2]
    d = (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
    )
    return o, d, math.sqrt(d[0] * d[0] + d[1] * d[1] + d[2] * d[2])


def in_crop(crops, c, x, y, z):
    """A point of the scene's frame in that in which crop c is the cube from -1 to 1, or the unit ball; or,
    without where that frame lies, a direction."""
    return (
        crops[c, 0] * x + crops[c, 1] * y + crops[c, 2] * z,
        crops[c, 4] * x + crops[c, 5] * y + crops[c, 6] * z,
        crops[c, 8] * x + crops[c, 9] * y + crops[c, 10] * z,
    )


def cropped_between(first_crop, crops, b, rays_o, rays_d, r, begin, end):
    """From and to which distance, between two, ray r is in all crops of instance b; both are the first where
    it is nowhere."""
    low, high = begin, end
    for c in range(first_crop[b], first_crop[b + 1]):
        x, y, z = in_crop(crops, c, rays_o[r, 0], rays_o[r, 1], rays_o[r, 2])
        x, y, z = x + crops[c, 3], y + crops[c, 7], z + crops[c, 11]
        v = in_crop(crops, c, rays_d[r, 0], rays_d[r, 1], rays_d[r, 2])
        if crops[c, 12] != 0.0:
            speed = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
            middle = -(x * v[0] + y * v[1] + z * v[2]) / speed
            x, y, z = along((x, y, z), v, middle)  # past the centre: exact however far away that is
            square = (1.0 - (x * x + y * y + z * z)) / speed
            half = math.sqrt(max(square, 0.0))
            low, high = max(low, middle - half), min(high, middle + half)
            if square < 0.0:
                high = low
        else:
            for axis in range(3):
                p = x if axis == 0 else (y if axis == 1 else z)
                speed = v[0] if axis == 0 else (v[1] if axis == 1 else v[2])
                if speed == 0.0:
                    high = high if abs(p) <= 1.0 else low
                else:
                    one, other = (-1.0 - p) / speed, (1.0 - p) / speed
                    low, high = max(low, min(one, other)), min(high, max(one, other))
    return (low, high) if low < high else (begin, begin)


def is_cropped_away(query, j):
    """Whether point j lies outside of a crop of the instance."""
    for c in range(query.first_crop[query.instance], query.first_crop[query.instance + 1]):
        crops = query.crops
        x, y, z = in_crop(crops, c, query.points[j, 0], query.points[j, 1], query.points[j, 2])
        x, y, z = x + crops[c, 3], y + crops[c, 7], z + crops[c, 11]
        if crops[c, 12] != 0.0:
            if x * x + y * y + z * z > 1.0:
                return True
        elif max(abs(x), max(abs(y), abs(z))) > 1.0:
            return True
    return False


def slot_ray(slots, s):
    """The ray of a slot: its number, origin and unit direction in the instance's frame, how long a unit of
    the scene's is along it, and from and to which distance of the scene the instance is followed."""
    r, b = slots.ray[s], slots.instance[s]
    o, d, length = ray_in_instance(slots.world_to_instance, b, slots.rays_o, slots.rays_d, r)
    ends = cropped_between(
        slots.first_crop, slots.crops, b, slots.rays_o, slots.rays_d, r, slots.begin[r], slots.end[r]
    )
    return r, o, (d[0] / length, d[1] / length, d[2] / length), length, ends


def samples_between(slots, ends, length, warp, t_begin, t_end):
    """Which samples of a piece from t_begin to t_end lie between the ends of a slot: (where sample 0 is, the
    number of the first, where they end). Both ends go by the numbers of samples, so that of two segments that
    touch every sample is in one, and none of them stands for less than it does in the whole ray."""
    step, end = slots.step, length_at(warp, ends[1] * length)
    t_begin = t_begin + 0.5 * step
    first = math.ceil((min(length_at(warp, ends[0] * length), t_end) - t_begin) / step)
    if end < t_end:
        t_end = t_begin + (math.ceil((end - t_begin) / step) - 0.5) * step
    return t_begin, max(0, int(first)), t_end


def show_ray(field, grid, slots, i, scratch, memory, out):
    """Marches, shades and composites slot chosen[i] in one pass behind what out[r] has of its ray:
    premultiplied rgb, opacity, Σ w t.

    A sample sits in the middle of the steps it stands for. `pending` is the weight of samples too light to be
    shaded: the next one that is lends them its colour, at the end of the segment the last one.
    """
    s = slots.chosen[i]
    r, o, d, length, ends = slot_ray(slots, s)
    step, far, shown = slots.step, slots.reach[r, 1] * length, slots.shown[slots.instance[s]]
    thick = shown[0]
    red, green, blue, depth = 0.0, 0.0, 0.0, 0.0
    c_r, c_g, c_b = 0.0, 0.0, 0.0
    trans, pending, enough = 1.0 - out[r, 3], 0.0, COLOUR_FROM
    ready, piece_begin = False, first_piece_at(o, d, slots.reach[r, 0] * length)
    for _ in range(PIECES):
        if trans <= slots.early_stop:
            break
        (origin, direction, t_begin, t_end, warp), piece_begin = next_piece(piece_begin, grid, o, d, far)
        if t_end <= t_begin:
            continue
        t_begin, index, t_end = samples_between(slots, ends, length, warp, t_begin, t_end)
        index, n_steps = next_sample(grid, origin, direction, t_begin, t_end, step, index)
        while index >= 0 and trans > slots.early_stop:
            t_local = t_begin + 0.5 * midpoint(index, n_steps) * step
            p, line = position_at(origin, direction, t_local), (origin, direction, warp)
            look_along(field, grid, line, t_begin, t_end, step, index, n_steps, scratch)
            sigma, _, strides, cell = density(field, grid, index, p, d, scratch)
            if strides > 0:
                tau = thick * sigma * optical_length(warp, p, d, t_local, n_steps, strides, step)
                weight = trans * (1.0 - math.exp(-tau))
                if slots.early_stop > 0.0 and trans - weight <= REST_FROM:
                    weight = trans
                trans -= weight
                depth += weight * distance(warp, t_local)
                pending += weight
                if pending > enough:
                    if not ready:
                        ray_setup(field, d, scratch)
                        ready = True
                    c_r, c_g, c_b = colour(field, cell, p, d, scratch, memory, 0)
                    red += pending * c_r
                    green += pending * c_g
                    blue += pending * c_b
                    pending, enough = 0.0, SHARED_COLOUR_FROM
            index = next_index(
                field, grid, cell, n_steps, strides, index, p, direction, t_local, t_begin, step
            )
            index, n_steps = next_sample(grid, origin, direction, t_begin, t_end, step, index)
    out[r, 0] += shown[1] * (red + pending * c_r)
    out[r, 1] += shown[2] * (green + pending * c_g)
    out[r, 2] += shown[3] * (blue + pending * c_b)
    out[r, 3] = 1.0 - trans
    out[r, 4] += depth / length


def trace_ray(field, grid, slots, i, scratch, memory, out):
    """The samples of slot chosen[i] that are not empty, up to where they alone would leave no light."""
    s = slots.chosen[i]
    r, o, d, length, ends = slot_ray(slots, s)
    step, far, thick = slots.step, slots.reach[r, 1] * length, slots.shown[slots.instance[s], 0]
    trans, count, complete = 1.0 - slots.rendered[r, 3], 0, FARTHEST
    piece_begin = first_piece_at(o, d, slots.reach[r, 0] * length)
    for _ in range(PIECES):
        if trans <= slots.early_stop or count == MAX_TRACED:
            break
        (origin, direction, t_begin, t_end, warp), piece_begin = next_piece(piece_begin, grid, o, d, far)
        if t_end <= t_begin:
            continue
        t_begin, index, t_end = samples_between(slots, ends, length, warp, t_begin, t_end)
        index, n_steps = next_sample(grid, origin, direction, t_begin, t_end, step, index)
        while index >= 0 and trans > slots.early_stop and count < MAX_TRACED:
            t_local = t_begin + 0.5 * midpoint(index, n_steps) * step
            p, line = position_at(origin, direction, t_local), (origin, direction, warp)
            look_along(field, grid, line, t_begin, t_end, step, index, n_steps, scratch)
            sigma, _, strides, cell = density(field, grid, index, p, d, scratch)
            if strides > 0 and sigma > 0.0:
                depth = thick * sigma * optical_length(warp, p, d, t_local, n_steps, strides, step)
                low, high = interval(
                    warp, t_local + 0.5 * (strides - 1) * n_steps * step, strides * n_steps * step
                )
                out.low[s, count], out.high[s, count] = low / length, high / length
                out.middle[s, count] = distance(warp, t_local) / length
                out.depth[s, count], out.weight[s, count], out.cell[s, count] = depth, 0.0, pack_cell(cell)
                trans *= math.exp(-depth)
                count += 1
            index = next_index(
                field, grid, cell, n_steps, strides, index, p, direction, t_local, t_begin, step
            )
            index, n_steps = next_sample(grid, origin, direction, t_begin, t_end, step, index)
        if count == MAX_TRACED:
            left_out = t_begin + (index - 0.5) * step if index >= 0 else t_end
            complete = distance(warp, left_out) / length
    out.count[s], out.complete[s] = count, complete


def shade_ray(field, grid, slots, i, scratch, memory, out):
    """The colours of the samples of slot chosen[i] that show, by their weights; light ones as in
    `show_ray`."""
    s = slots.chosen[i]
    _, o, d, length, _ = slot_ray(slots, s)
    shown = slots.shown[slots.instance[s]]
    red, green, blue = 0.0, 0.0, 0.0
    c_r, c_g, c_b = 0.0, 0.0, 0.0
    pending, enough, ready = 0.0, COLOUR_FROM, False
    for q in range(out.count[s]):
        pending += out.weight[s, q]
        if pending > enough:
            p = point(along(o, d, out.middle[s, q] * length))
            cell = unpack_cell(field, out.cell[s, q], p)
            if not ready:
                ray_setup(field, d, scratch)
                ready = True
            c_r, c_g, c_b = colour(field, cell, p, d, scratch, memory, 0)
            red += pending * c_r
            green += pending * c_g
            blue += pending * c_b
            pending, enough = 0.0, SHARED_COLOUR_FROM
    out.rgb[s, 0] = shown[1] * (red + pending * c_r)
    out.rgb[s, 1] = shown[2] * (green + pending * c_g)
    out.rgb[s, 2] = shown[3] * (blue + pending * c_b)


# -- points --------------------------------------------------------------------------------------------------


def chosen_point(query, i):
    """Point chosen[i] in the instance's space."""
    where, b = query.world_to_instance, query.instance
    return point(ray_in_instance(where, b, query.points, query.dirs, query.chosen[i])[0])


def point_in_instance(field, grid, query, i):
    """Point chosen[i] in the instance's space, the unit direction there, and what densities there are times
    in the scene's frame; asks for the numbers that a later point will read."""
    matrix, b, n = query.world_to_instance, query.instance, i + POINTS_AHEAD
    if n < query.chosen.shape[0]:
        p = chosen_point(query, n)
        if is_inside(field, grid, p):
            prefetch_density(field, field.params, 0, p)
            if query.with_colour:
                prefetch_colour(field, field.params, 0, p)
    o, d, length = ray_in_instance(matrix, b, query.points, query.dirs, query.chosen[i])
    p, d = point(o), (d[0] / length, d[1] / length, d[2] / length)
    return p, d, rate(p, d) * length * query.shown[b, 0]


def densest_at(field, grid, query, i, scratch, memory, out):
    """Enter an instance's density at point chosen[i] where it is the densest so far, or add it."""
    j = query.chosen[i]
    p, d, times = point_in_instance(field, grid, query, i)
    if is_inside(field, grid, p) and not is_cropped_away(query, j):
        look_in_instance(field, grid, query, i, scratch)
        sigma, _, strides, cell = density(field, grid, 0, p, d, scratch)
        sigma *= times
        if strides > 0 and query.adds:
            out.sigma[j] += sigma
        elif strides > 0 and sigma > DENSER * out.sigma[j]:
            out.sigma[j], out.densest[j], out.cell[j] = sigma, query.instance, pack_cell(cell)


def colour_at(field, grid, query, i, scratch, memory, out):
    """An instance's colour at point chosen[i], where it is the densest, or its share by density where they
    add up."""
    j, share, shown = query.chosen[i], 1.0, query.shown[query.instance]
    p, d, times = point_in_instance(field, grid, query, i)
    if query.adds:
        if not is_inside(field, grid, p) or is_cropped_away(query, j):
            return
        look_in_instance(field, grid, query, i, scratch)
        sigma, _, strides, cell = density(field, grid, 0, p, d, scratch)
        if strides == 0 or sigma <= 0.0:
            return
        share = sigma * times / out.sigma[j]
    else:
        look_in_instance(field, grid, query, i, scratch)
        cell = unpack_cell(field, out.cell[j], p)
    ray_setup(field, d, scratch)
    c_r, c_g, c_b = colour(field, cell, p, d, scratch, memory, 0)
    out.rgb[j, 0] += share * shown[1] * c_r
    out.rgb[j, 1] += share * shown[2] * c_g
    out.rgb[j, 2] += share * shown[3] * c_b


# -- occupancy along a ray -----------------------------------------------------------------------------------


def next_change(instances, b, o, d, t, end, gap):
    """Along a ray o + t d of the frame of instance b, d of any length, from t to `end`: where an occupied
    cell begins, or FARTHEST where none does; for a gap of 0 or more where, from t on, nothing occupied
    follows for longer than that."""
    box = Box(instances.lo[b], instances.hi[b])
    lo, cell, first = instances.lo[b], instances.cell[b], instances.first_cell[b]
    nx, ny, nz = instances.counts[b, 0], instances.counts[b, 1], instances.counts[b, 2]
    piece_begin, last = first_piece_at(o, d, t), t
    for _ in range(PIECES):
        (origin, direction, t_begin, t_end, warp), piece_begin = next_piece(piece_begin, box, o, d, end)
        # From where the ray enters, so that steps are seen however far away that is.
        start, t_local, most = along(origin, direction, t_begin), 0.0, t_end - t_begin
        least = FACE_TOLERANCE * cell[0] / max(abs(direction[0]), max(abs(direction[1]), abs(direction[2])))
        while t_local < most:
            x, y, z = along(start, direction, t_local)
            i, j = cell_of(x, lo[0], cell[0], nx), cell_of(y, lo[1], cell[1], ny)
            k = cell_of(z, lo[2], cell[2], nz)
            empty = int(instances.skip[np.uint64(first + (i * ny + j) * nz + k)])
            if empty == 0 and gap < 0.0:
                return distance(warp, t_begin + t_local)
            if empty != 0 and gap >= 0.0 and distance(warp, t_begin + t_local) > last + gap:
                return last
            cube = max(empty, 1)
            away = min(
                exit_distance(x, direction[0], lo[0], cell[0], i, cube),
                min(
                    exit_distance(y, direction[1], lo[1], cell[1], j, cube),
                    exit_distance(z, direction[2], lo[2], cell[2], k, cube),
                ),
            )
            t_local += max(away, 0.0) + least
            if empty == 0:
                last = distance(warp, t_begin + min(t_local, most))
    return FARTHEST if gap < 0.0 else last
