"""Loops that tell which of several placed grids rays come to, for the CPU, and that hand rays to a grid and
what they show back."""

import math

import numpy as np
from numba import prange

from fusedrf_cli.engine.kernels.parts import FACE_TOLERANCE, along, body, cell_of, exit_distance, hit_box
from fusedrf_cli.engine.kernels.plain import RAYS_PER_TASK, loop, task

NOWHERE = 1e30  # further than any ray goes
RAYS_OF_TILE = 256  # which lie close together in pictures (`tile_order` of rendering/cameras.py)
ROUNDING = 1e-6  # of angles, in radians, and of distances, by which rays may come nearer than is reckoned


@body
def matter_at(o, d, end, matrix, apart, first, nx, ny, nz):
    """Where along a ray o + t d, from t = 0 to the end, the first cell with matter of a grid begins, or
    NOWHERE: from an empty cell it goes as far as there is no other. matrix (3, 4) takes points to where the
    grid's box is the unit cube; apart[first:] is how many cells each of its cells is from the nearest with
    matter."""
    x, y, z = o
    dx, dy, dz = d
    m = matrix
    origin = (
        nx * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z + m[0, 3]),
        ny * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z + m[1, 3]),
        nz * (m[2, 0] * x + m[2, 1] * y + m[2, 2] * z + m[2, 3]),
    )
    way = (
        nx * (m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz),
        ny * (m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz),
        nz * (m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz),
    )
    t, leaves = hit_box(origin, way, (0.0, 0.0, 0.0), (float(nx), float(ny), float(nz)))
    # From where the ray enters, so that steps are seen however far away that is.
    start, u, length = along(origin, way, t), 0.0, min(end, leaves) - t
    least = FACE_TOLERANCE / max(abs(way[0]), max(abs(way[1]), abs(way[2])))
    while u < length:
        x, y, z = along(start, way, u)
        i, j, k = cell_of(x, 0.0, 1.0, nx), cell_of(y, 0.0, 1.0, ny), cell_of(z, 0.0, 1.0, nz)
        s = int(apart[np.uint64(first + (i * ny + j) * nz + k)])
        if s == 0:
            return t + u
        away = min(
            exit_distance(x, way[0], 0.0, 1.0, i, s),
            min(exit_distance(y, way[1], 0.0, 1.0, j, s), exit_distance(z, way[2], 0.0, 1.0, k, s)),
        )
        u += max(away, 0.0) + least
    return NOWHERE


@body
def matter_from_core(o, d, matrix, apart, first, nx, ny, nz):
    """`matter_at` of a grid over all of space, of whose cells only those in the core are told apart: beyond,
    its matter is everywhere."""
    t, end = hit_box(o, d, (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    if t > 0.0 or end <= 0.0:
        return 0.0
    return min(end, matter_at(o, d, end, matrix, apart, first, nx, ny, nz))


@body
def comes_near(o, d, ball, end):
    """Whether a ray o + t d comes into a ball (centre and radius) with 0 <= t < end."""
    x, y, z = ball[0] - o[0], ball[1] - o[1], ball[2] - o[2]
    t = x * d[0] + y * d[1] + z * d[2]
    x, y, z = along((x, y, z), d, -t)  # past the centre: exact however far away that is
    return x * x + y * y + z * z <= ball[3] * ball[3] and t + ball[3] >= 0 and t - ball[3] < end


@body
def bundle_of(rays_o, rays_d, low, high):
    """A cone that holds the unit directions of rays low..high, and a ball that holds their origins: centre,
    radius, axis and half angle."""
    x, y, z = rays_o[low, 0], rays_o[low, 1], rays_o[low, 2]
    dx, dy, dz, wide = 0.0, 0.0, 0.0, 0.0
    for i in range(low, high):
        dx, dy, dz = dx + rays_d[i, 0], dy + rays_d[i, 1], dz + rays_d[i, 2]
        ox, oy, oz = rays_o[i, 0] - x, rays_o[i, 1] - y, rays_o[i, 2] - z
        wide = max(wide, ox * ox + oy * oy + oz * oz)
    length, least = math.sqrt(dx * dx + dy * dy + dz * dz), 1.0
    if length <= 0.0:
        return (x, y, z), math.sqrt(wide), (1.0, 0.0, 0.0), math.pi
    dx, dy, dz = dx / length, dy / length, dz / length
    for i in range(low, high):
        least = min(least, rays_d[i, 0] * dx + rays_d[i, 1] * dy + rays_d[i, 2] * dz)
    return (x, y, z), math.sqrt(wide), (dx, dy, dz), math.acos(max(least, -1.0))


@body
def may_come_near(bundle, ball):
    """Whether a ray of a bundle, see `bundle_of`, may come into a ball (centre and radius)."""
    centre, wide, axis, angle = bundle
    x, y, z = ball[0] - centre[0], ball[1] - centre[1], ball[2] - centre[2]
    far, radius = math.sqrt(x * x + y * y + z * z), ball[3] + wide
    if far * (1 - ROUNDING) <= radius:
        return True
    off = math.acos(min(max((x * axis[0] + y * axis[1] + z * axis[2]) / far, -1.0), 1.0))
    return off - math.asin(radius / far) <= angle + ROUNDING


@body
def balls_before(rays_o, rays_d, balls, low, high):
    """The bits of the balls, of which there are at most 64, that one of rays low..high may come into: most of
    a picture's tiles come to few."""
    bundle, bits = bundle_of(rays_o, rays_d, low, high), np.uint64(0)
    for b in range(balls.shape[0]):
        if balls[b, 3] >= NOWHERE or may_come_near(bundle, balls[b]):
            bits |= np.uint64(1) << np.uint64(b)
    return bits


@task
def first_two_task(rays_o, rays_d, to_unit, apart, apart_at, balls, everywhere, low, high, first, second):
    """`first_two` for rays low..high."""
    for begin in range(low, high, RAYS_OF_TILE):
        end = min(high, begin + RAYS_OF_TILE)
        bits = balls_before(rays_o, rays_d, balls, begin, end)
        for i in range(begin, end):
            o, d = (rays_o[i, 0], rays_o[i, 1], rays_o[i, 2]), (rays_d[i, 0], rays_d[i, 1], rays_d[i, 2])
            nearest, next_nearest, which, left, b = NOWHERE, NOWHERE, -1, bits, -1
            while left != np.uint64(0):
                b += 1
                asked = left & np.uint64(1)
                left >>= np.uint64(1)
                if asked == np.uint64(0):
                    continue
                endless, nx, ny, nz = balls[b, 3] >= NOWHERE, apart_at[b, 1], apart_at[b, 2], apart_at[b, 3]
                if endless and everywhere:
                    at = -1.0
                elif endless:
                    at = matter_from_core(o, d, to_unit[b], apart, apart_at[b, 0], nx, ny, nz)
                elif comes_near(o, d, balls[b], next_nearest):
                    at = matter_at(o, d, NOWHERE, to_unit[b], apart, apart_at[b, 0], nx, ny, nz)
                else:
                    continue
                if at < nearest:
                    which, nearest, next_nearest = b, at, nearest
                elif at < next_nearest:
                    next_nearest = at
            first[i], second[i] = which, next_nearest


@loop
def first_two(rays_o, rays_d, to_unit, apart, apart_at, balls, everywhere, threads, first, second):
    """For every ray (N, 3) the first of at most 64 placed grids in which it comes to a cell with matter, or
    -1, into first (N,) int16, and how far along it such cells of a second one begin, or NOWHERE, into second
    (N,).

    to_unit (B, 3, 4) takes points to where the box of a grid is the unit cube; apart is how many cells each
    cell is from the nearest with matter, flat, of all grids, and apart_at (B, 4) where in it that of a grid
    begins, and its cells per axis; balls (B, 4) is where a ball around its matter has its centre, and its
    radius: of a grid without end it is infinite, and its matter is `everywhere`, or in the core where its
    cells have some. Tasks are dealt to so many threads as in `each` of loops.py.
    """
    n = rays_o.shape[0]
    tasks = (n + RAYS_PER_TASK - 1) // RAYS_PER_TASK
    each_has = (tasks + threads - 1) // threads
    for turn in prange(each_has * threads):
        part = turn % each_has * threads + turn // each_has
        low, high = part * RAYS_PER_TASK, min(n, (part + 1) * RAYS_PER_TASK)
        first_two_task(
            rays_o, rays_d, to_unit, apart, apart_at, balls, everywhere, low, high, first, second
        )


@task
def handed_on_task(rays_o, rays_d, reach, first, second, own_step, low, high, until):
    """`handed_on` for rays low..high."""
    for i in range(low, high):
        near, at, b = reach[i, 0], second[i], first[i]
        step = own_step[b] if b >= 0 else 0.0
        if step < 0.0:
            until[i] = near
        elif at >= NOWHERE:
            until[i] = NOWHERE
        elif step == 0.0:
            until[i] = max(near, at)
        else:
            o, d = (rays_o[i, 0], rays_o[i, 1], rays_o[i, 2]), (rays_d[i, 0], rays_d[i, 1], rays_d[i, 2])
            enters, leaves = hit_box(o, d, (-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
            begin, end = max(near, enters), max(near, at)
            if begin >= leaves or end < begin:
                until[i] = near
            elif end < leaves:
                until[i] = begin + math.floor((end - begin) / step) * step
            else:
                until[i] = leaves


@loop
def handed_on(rays_o, rays_d, reach, first, second, own_step, until):
    """For every ray (N, 3), which comes to grids as `first_two` says, how far along it only the first one
    needs to be asked, into until (N,): its beginning, reach[:, 0], where that is nowhere so, NOWHERE where it
    is so to its end.

    own_step (B,) is 0 for a grid that ends. One without end hands a ray on between two of its samples: in the
    core, where they are own_step apart, or where the core ends and samples begin anew, or at its beginning;
    where own_step is negative, it hands all of a ray on.
    """
    n = rays_o.shape[0]
    for part in prange((n + RAYS_PER_TASK - 1) // RAYS_PER_TASK):
        low, high = part * RAYS_PER_TASK, min(n, (part + 1) * RAYS_PER_TASK)
        handed_on_task(rays_o, rays_d, reach, first, second, own_step, low, high, until)


@task
def taken_task(rays_o, rays_d, begin, end, chosen, placing, low, high, own_o, own_d, reach, lengths):
    """`taken` for rays chosen[low:high]."""
    inverse, origin, turned = placing
    m = inverse
    for i in range(low, high):
        r = chosen[i]
        x, y, z = rays_o[r, 0] - origin[0], rays_o[r, 1] - origin[1], rays_o[r, 2] - origin[2]
        dx, dy, dz, length = rays_d[r, 0], rays_d[r, 1], rays_d[r, 2], 1.0
        if turned:
            x, y, z = (
                m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
                m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
                m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
            )
            dx, dy, dz = (
                m[0, 0] * dx + m[0, 1] * dy + m[0, 2] * dz,
                m[1, 0] * dx + m[1, 1] * dy + m[1, 2] * dz,
                m[2, 0] * dx + m[2, 1] * dy + m[2, 2] * dz,
            )
            length = math.sqrt(dx * dx + dy * dy + dz * dz)
        own_o[i, 0], own_o[i, 1], own_o[i, 2] = x, y, z
        own_d[i, 0], own_d[i, 1], own_d[i, 2] = dx / length, dy / length, dz / length
        reach[i, 0], reach[i, 1], lengths[i] = begin[r] * length, end[r] * length, length


@loop
def taken(rays_o, rays_d, begin, end, chosen, placing, own_o, own_d, reach, lengths):
    """Those rays (N, 3) whose numbers are chosen (M,), from and to the distances begin and end (N,), in a
    frame of its own: origins own_o and unit directions own_d (M, 3), reach (M, 2), and lengths (M,), how much
    of its length a unit of theirs is.

    placing is (inverse (3, 3), origin (3,), turned): a point p is at inverse (p - origin) there; where it is
    not `turned`, the inverse is that of no turn.
    """
    m = chosen.shape[0]
    for part in prange((m + RAYS_PER_TASK - 1) // RAYS_PER_TASK):
        low, high = part * RAYS_PER_TASK, min(m, (part + 1) * RAYS_PER_TASK)
        taken_task(rays_o, rays_d, begin, end, chosen, placing, low, high, own_o, own_d, reach, lengths)


@task
def put_behind_task(found, lengths, chosen, low, high, out):
    """`put_behind` for rays chosen[low:high]."""
    for i in range(low, high):
        r = chosen[i]
        left = 1 - out[r, 3]
        for c in range(4):
            out[r, c] += left * found[i, c]
        out[r, 4] += left * np.float32(found[i, 4] / lengths[i])


@loop
def put_behind(found, lengths, chosen, out):
    """Composites what rays chosen (M,) show farther on, found (M, 5) as `show_ray` of instances.py leaves it,
    behind what out (N, 5) has of them; their distances are in units of which `lengths` (M,) make one."""
    m = chosen.shape[0]
    for part in prange((m + RAYS_PER_TASK - 1) // RAYS_PER_TASK):
        low, high = part * RAYS_PER_TASK, min(m, (part + 1) * RAYS_PER_TASK)
        put_behind_task(found, lengths, chosen, low, high, out)
