"""Rays of scenes of several instances (instances.py), cut into segments by which of these have occupied cells
there, and how the samples of several are merged. Loops for the CPU.
"""

import math
from functools import cache
from types import ModuleType
from typing import NamedTuple

import numpy as np
from numba import get_num_threads, prange

from fusedrf_cli.engine.kernels.bundles import fewer_near, instances_near, ray_reaches
from fusedrf_cli.engine.kernels.field_free import loop, serial
from fusedrf_cli.engine.kernels.instances import ANYWHERE, DENSER
from fusedrf_cli.engine.kernels.primitives import FARTHEST, device
from fusedrf_cli.engine.kernels.specialise import compile_into, loops_for, rebound
from fusedrf_cli.engine.spaces import bounded, unbounded

GAP = 4.0  # steps: occupied cells that are no farther apart belong together
DONE, SHARED = -1, -2  # of a ray's segment: there is none; several instances meet in it


class Segments(NamedTuple):
    """The segments that N rays come to next: perhaps one of the only unbounded instance alone, and behind it
    one of an instance or of several."""

    alone_from: object  # (N,) where the first one begins, which is where the ray's last segment ended
    alone_to: object  # (N,) where it ends; the same where there is none
    instance: object  # (N,) int64 of the second one, or SHARED, or DONE
    begin: object  # (N,) where it begins
    end: object  # (N,) where it ends
    n_meeting: object  # (N,) int64, how many instances meet in it, if it is SHARED
    meeting: object  # (N, W) int64, they in order, where that is room enough


class Groups(NamedTuple):
    """By which rules S slots are composed: where they do not add up, the densest counts. Slots of a ray that
    belong to one group lie side by side."""

    group: object  # (S,) int64 of each slot
    adds: object  # (G,) bool, whether samples of a group add up
    all_add: object  # bool, whether groups do


next_in_box, next_in_space = (loops_for(None, (), s).names["next_change"] for s in (bounded, unbounded))
ray_in_instance, cropped_between = (
    loops_for(None, (), bounded).names[name] for name in ("ray_in_instance", "cropped_between")
)


# -- the next segment of a ray -------------------------------------------------------------------------------


@device
def next_on_ray(rays, instances, b, r, begin, end, gaps):
    """`next_change` of instance b in its crops on ray r, for a gap of so many of its steps, and how long a
    step is."""
    o, d, length = ray_in_instance(instances.world_to_instance, b, rays.rays_o, rays.rays_d, r)
    step = instances.step[b] / length
    begin, end = cropped_between(
        instances.first_crop, instances.crops, b, rays.rays_o, rays.rays_d, r, begin, end
    )
    if instances.space[b] >= 0:
        return next_in_space(instances, b, o, d, begin, end, gaps * step), step
    return next_in_box(instances, b, o, d, begin, end, gaps * step), step


@device
def occupied_from(rays, instances, b, r, begin, end):
    """Where from `begin` on instance b has occupied cells on ray r, or FARTHEST where it has none before the
    end; and how long one of its steps is there."""
    if instances.spheres[b, 3] < FARTHEST and not ray_reaches(rays, r, instances.spheres[b], begin, end):
        return FARTHEST, 0.0
    return next_on_ray(rays, instances, b, r, begin, end, ANYWHERE)


@device
def first_two(rays, instances, r, near, begins, low, high, begin, two):
    """Those two of instances near[low:high], and of `two`, whose occupied cells come first on ray r from
    `begin` on: (where the first begins, where the second does, the first, the second, a step of the first).
    Of those that begin at one place, as all do in which the ray is already, the ones of the lowest numbers
    come first, whatever order they are in."""
    for c in range(low, high):
        end = two[1] + 1e-12 * abs(two[1])  # farther by a rounding, for what begins where another does
        if begins[c] > end:
            break
        b = near[c]
        at, step = occupied_from(rays, instances, b, r, begin, end)
        if at < two[0] or (at == two[0] and b < two[2]):
            two = at, two[0], b, two[2], step
        elif at < two[1] or (at == two[1] and b < two[3]):
            two = two[0], at, two[2], b, two[4]
    return two


@device
def end_of_meeting(rays, instances, r, two, far):
    """Where the first of two instances whose cells begin close to each other on ray r ends."""
    first, second, b, other, step = two
    one, _ = next_on_ray(rays, instances, b, r, first, far, GAP)
    end, _ = next_on_ray(rays, instances, other, r, second, far, GAP)
    return min(max(min(one, end), second + GAP * step), far)


@device
def note_meeting(rays, instances, r, near, begins, count, begin, end, segments):
    """Enter those of instances near[:count] that have occupied cells on ray r between two distances, in
    order."""
    n_meeting, room = 0, segments.meeting.shape[1]
    for c in range(count):
        if begins[c] > end:
            break
        at, _ = occupied_from(rays, instances, near[c], r, begin, end)
        if at < end:
            k = min(n_meeting, room - 1)
            while k > 0 and segments.meeting[r, k - 1] > near[c]:
                segments.meeting[r, k] = segments.meeting[r, k - 1]
                k -= 1
            segments.meeting[r, k] = near[c]
            n_meeting += 1
    segments.n_meeting[r] = n_meeting


@device
def segment_of(rays, instances, r, near, begins, n_unbounded, count, segments):
    """Enter the next segment of ray r, which may meet instances near[:count], n_unbounded of them without
    end."""
    begin, far = segments.end[r], rays.reach[r, 1]
    two = far, far, DONE, DONE, 0.0
    two = first_two(rays, instances, r, near, begins, n_unbounded, count, begin, two)
    segments.alone_from[r], segments.alone_to[r] = begin, begin
    if n_unbounded == 1 and (two[2] == DONE or two[0] - begin > GAP * two[4]):
        begin = two[0]
        segments.alone_to[r] = begin
    if begin < far:
        two = first_two(rays, instances, r, near, begins, 0, n_unbounded, begin, two)
    segments.begin[r] = max(begin, two[0] - two[4])  # what was walked over need not be walked over again
    segments.instance[r] = two[2]
    if two[2] != DONE:
        if two[3] == DONE or two[1] - two[0] > GAP * two[4]:
            segments.end[r] = two[1]
        else:
            segments.instance[r], segments.end[r] = SHARED, end_of_meeting(rays, instances, r, two, far)
            note_meeting(rays, instances, r, near, begins, count, begin, segments.end[r], segments)


@serial
def segment_task(rays, instances, chosen, low, high, near, begins, few, few_begin, segments):
    """`next_segments` of rays chosen[low:high]; near, begins, few and few_begin (B,) are room."""
    n_unbounded, count = instances_near(rays, instances, chosen, low, high, near, begins)
    few_rays = 16  # which lie close together in pictures
    for start in range(low, high, few_rays):
        stop = min(high, start + few_rays)
        left = fewer_near(rays, instances, chosen, start, stop, near, begins, count, few, few_begin)
        for i in range(start, stop):
            segment_of(rays, instances, chosen[i], few, few_begin, n_unbounded, left, segments)


def next_segments(rays, instances, spaces, chosen, segments):
    """The next segments of rays chosen (M,), from where their last ended. spaces are those that instances
    without end lie in, as Instances.space counts them."""
    segments_loop_in(spaces)(rays, instances, chosen, get_num_threads(), segments)


@loop
def segments_loop(rays, instances, chosen, threads, segments):
    """`next_segments` by so many threads."""
    n = chosen.shape[0]
    tile = 256  # rays, which lie close together in pictures
    tasks = (n + tile - 1) // tile
    each_has = (tasks + threads - 1) // threads
    for turn in prange(each_has * threads):
        part = turn % each_has * threads + turn // each_has
        low, high = part * tile, min(n, (part + 1) * tile)
        if low < high:
            count = instances.step.shape[0]
            near, few = np.empty(count, np.int64), np.empty(count, np.int64)
            begins, few_begin = np.empty(count), np.empty(count)
            segment_task(rays, instances, chosen, low, high, near, begins, few, few_begin, segments)


# -- other spaces than bounded and unbounded ones ------------------------------------------------------------


def next_in_either(instances, b, o, d, t, end, gap):
    """`next_change` of an instance in one space, or in one of others."""
    if instances.space[b] == NUMBER:
        return next_in_this(instances, b, o, d, t, end, gap)
    return next_in_others(instances, b, o, d, t, end, gap)


def next_in_any(changes, tag, compiled):
    """`next_change` of instances in several spaces, by that of each, as `compiled` makes functions."""
    change = changes[-1]
    for number in range(len(changes) - 2, -1, -1):
        names = {"next_in_this": changes[number], "next_in_others": change, "NUMBER": number}
        change = compiled(rebound(next_in_either, names, f"{tag}_{number}"))
    return change


@cache
def segments_loop_in(spaces: tuple[ModuleType, ...]):
    """`segments_loop` for instances in some spaces. What most scenes have is compiled without the others."""
    if spaces in ((), (unbounded,)):
        return segments_loop
    loops = [loops_for(None, (), space) for space in spaces]
    tag = "_".join(each.tag for each in loops)
    names = globals() | {
        "next_in_space": next_in_any([one.names["next_change"] for one in loops], tag, serial)
    }
    parts = next_on_ray, occupied_from, first_two, end_of_meeting, note_meeting, segment_of
    parts = {part.py_func.__name__: part.py_func for part in (*parts, segment_task, segments_loop)}
    compile_into(names, parts, {"segment_task": serial, "segments_loop": loop})
    return names["segments_loop"]


# -- slots and rays ------------------------------------------------------------------------------------------


@serial
def sort_slots(chosen, instance, field_of, ends, order):
    """Slots chosen (M,) into order (M,) by the fields of instance (S,): SHARED ones up to ends[0], then those
    of field f up to ends[1 + f], where instance b has field field_of[b]. DONE ones are left out."""
    ends[:] = 0
    for i in range(chosen.shape[0]):
        b = instance[chosen[i]]
        if b != DONE:
            ends[0 if b == SHARED else 1 + field_of[b]] += 1
    total = 0
    for f in range(ends.shape[0]):
        total, ends[f] = total + ends[f], total
    for i in range(chosen.shape[0]):
        b = instance[chosen[i]]
        if b != DONE:
            f = 0 if b == SHARED else 1 + field_of[b]
            order[ends[f]] = chosen[i]
            ends[f] += 1


@device
def goes_on(r, rays, segments, rendered, early_stop):
    """Whether ray r goes on behind its segment. One whose segment has no length does not: it would never come
    any farther."""
    moved = segments.instance[r] != DONE and segments.end[r] > segments.alone_from[r]
    return moved and segments.end[r] < rays.reach[r, 1] and rendered[r, 3] < 1.0 - early_stop


def rays_left(chosen, rays, segments, rendered, early_stop):
    """Those of rays chosen (M,) that go on behind their segments."""
    left = np.empty_like(chosen)
    return left[: rays_left_task(chosen, rays, segments, rendered, early_stop, left)]


@serial
def rays_left_task(chosen, rays, segments, rendered, early_stop, left):
    """`rays_left` into left (M,): how many."""
    count = 0
    for i in range(chosen.shape[0]):
        if goes_on(chosen[i], rays, segments, rendered, early_stop):
            left[count] = chosen[i]
            count += 1
    return count


# -- samples of several instances ----------------------------------------------------------------------------


@device
def sample_at(traces, s, t, end):
    """The sample of slot s that stands at t, or comes next: (whether there is one that was taken before the
    end, whether it stands at t, its density)."""
    q = traces.cursor[s]
    while q < traces.count[s] and traces.high[s, q] <= t:
        q += 1
    traces.cursor[s] = q
    if q == traces.count[s] or traces.middle[s, q] >= end:
        return False, False, 0.0
    return True, traces.low[s, q] <= t, traces.depth[s, q] / (traces.high[s, q] - traces.low[s, q])


@device
def group_at(traces, group, adds, s, behind, t, end):
    """The group of slots that begins with slot s: (the first slot of the next one, the group's density at t,
    its densest slot there or -1, where one of its samples begins or ends next)."""
    g, total, densest, winner, following = group[s], 0.0, 0.0, -1, FARTHEST
    while s < behind and group[s] == g:
        comes, stands, sigma = sample_at(traces, s, t, end)
        if comes:
            q = traces.cursor[s]
            following = min(following, traces.high[s, q] if stands else traces.low[s, q])
        if stands:
            total += sigma
            if sigma > DENSER * densest:
                densest, winner = sigma, s
        s += 1
    return s, total if adds[g] else densest, winner, following


@device
def share_out(traces, group, adds, s, behind, t, end, weight):
    """Give a weight to what stands at t of the group that begins with slot s: to its densest sample, or,
    where it adds them up, to all by their densities; returns the first slot of the next group."""
    following, density, winner, _ = group_at(traces, group, adds, s, behind, t, end)
    if winner >= 0 and not adds[group[s]]:
        traces.weight[winner, traces.cursor[winner]] += weight
    elif winner >= 0:
        for other in range(s, following):
            _, stands, sigma = sample_at(traces, other, t, end)
            if stands:
                traces.weight[other, traces.cursor[other]] += weight * sigma / density
    return following


@device
def merge_ray(traces, group, adds, all_add, s0, s1, r, early_stop, segment_end, out):
    """`merge_samples` of slots s0 to s1 of ray r."""
    trans, depth, t, end = 1.0 - out[r, 3], 0.0, -FARTHEST, FARTHEST
    for s in range(s0, s1):
        end, traces.cursor[s] = min(end, traces.complete[s]), 0
    segment_end[r] = min(segment_end[r], end)
    while trans > early_stop:
        following, densest, total, first, s = FARTHEST, 0.0, 0.0, -1, s0
        while s < s1:
            this = s
            s, sigma, _, change = group_at(traces, group, adds, s, s1, t, end)
            following, total = min(following, change), total + sigma
            if sigma > DENSER * densest:
                densest, first = sigma, this
        if following >= FARTHEST:
            break
        if first >= 0:
            weight = trans * (1.0 - math.exp(-(total if all_add else densest) * (following - t)))
            trans -= weight
            depth += weight * 0.5 * (t + following)
            if all_add:
                s = s0
                while s < s1:
                    sigma = group_at(traces, group, adds, s, s1, t, end)[1]
                    s = share_out(traces, group, adds, s, s1, t, end, weight * sigma / total)
            else:
                share_out(traces, group, adds, first, s1, t, end, weight)
        t = following
    out[r, 3] = 1.0 - trans
    out[r, 4] += depth


@serial
def merge_task(shared, start, low, high, early_stop, groups, traces, segment_end, out):
    """`merge_samples` for rays shared[low:high]."""
    for m in range(low, high):
        s0, s1, r = start[m], start[m + 1], shared[m]
        merge_ray(traces, groups.group, groups.adds, groups.all_add, s0, s1, r, early_stop, segment_end, out)


@loop
def merge_samples(shared, start, early_stop, groups, traces, segment_end, out):
    """Composite the samples of rays shared (M,), slots start[m] to start[m + 1] of the m-th, as piecewise
    constant densities behind what out (N, 5) has. Leaves in traces.weight what each takes of the light, and
    in segment_end (N,) how far that went."""
    m, per_task = shared.shape[0], 1024
    for part in prange((m + per_task - 1) // per_task):
        low, high = part * per_task, min(m, (part + 1) * per_task)
        merge_task(shared, start, low, high, early_stop, groups, traces, segment_end, out)


@loop
def add_colours(shared, start, traces, out):
    """Add the colours of the slots to those of their rays, see `merge_samples`."""
    for m in prange(shared.shape[0]):
        for s in range(start[m], start[m + 1]):
            for c in range(3):
                out[shared[m], c] += traces.rgb[s, c]


@serial
def points_in_sphere(points, sphere, inside):
    """The numbers of points (N, 3) in a sphere into inside (N,): how many."""
    count = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0] - sphere[0], points[i, 1] - sphere[1], points[i, 2] - sphere[2]
        inside[count] = i
        count += 1 if x * x + y * y + z * z <= sphere[3] * sphere[3] else 0
    return count
