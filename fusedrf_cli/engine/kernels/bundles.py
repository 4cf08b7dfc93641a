"""Bundles of rays, and which instances of a scene (instances.py) their rays may meet."""

import math
from typing import NamedTuple

from fusedrf_cli.engine.kernels.primitives import FARTHEST, along, device

ROUNDING = 1e-6  # of angles, in radians, and of distances, by which rays may come nearer than is reckoned


class RayBatch(NamedTuple):
    """N rays in the scene's frame."""

    rays_o: object  # (N, 3) float64
    rays_d: object  # (N, 3) float64, unit length
    reach: object  # (N, 2) float64, from which distance to which they are followed


@device
def bundle_of(rays, chosen, low, high):
    """A cone that holds the directions of rays chosen[low:high], and a ball that holds their origins: centre,
    radius, axis, and sine and cosine of half its angle."""
    rays_o, rays_d, r = rays.rays_o, rays.rays_d, chosen[low]
    x, y, z = rays_o[r, 0], rays_o[r, 1], rays_o[r, 2]
    dx, dy, dz, wide = 0.0, 0.0, 0.0, 0.0
    for i in range(low, high):
        r = chosen[i]
        dx, dy, dz = dx + rays_d[r, 0], dy + rays_d[r, 1], dz + rays_d[r, 2]
        ox, oy, oz = rays_o[r, 0] - x, rays_o[r, 1] - y, rays_o[r, 2] - z
        wide = max(wide, ox * ox + oy * oy + oz * oz)
    length, least = math.sqrt(dx * dx + dy * dy + dz * dz), 1.0
    if length <= 0.0:
        return (x, y, z), math.sqrt(wide), (1.0, 0.0, 0.0), (0.0, -1.0)
    dx, dy, dz = dx / length, dy / length, dz / length
    for i in range(low, high):
        r = chosen[i]
        least = min(least, rays_d[r, 0] * dx + rays_d[r, 1] * dy + rays_d[r, 2] * dz)
    least = max(least, -1.0)
    return (x, y, z), math.sqrt(wide), (dx, dy, dz), (math.sqrt(max(1.0 - least * least, 0.0)), least)


@device
def bundle_reaches(bundle, sphere):
    """From which distance on a ray of a bundle, see `bundle_of`, may be in a sphere (centre and radius), or
    FARTHEST where none comes there: a sphere is reached whose centre is no farther from the cone than its
    radius."""
    centre, wide, axis, (sine, cosine) = bundle
    x, y, z = sphere[0] - centre[0], sphere[1] - centre[1], sphere[2] - centre[2]
    square, radius = x * x + y * y + z * z, sphere[3] + wide
    far, along_axis = math.sqrt(square), x * axis[0] + y * axis[1] + z * axis[2]
    aside = math.sqrt(max(square - along_axis * along_axis, 0.0))
    if cosine > 0.0 and aside * cosine - along_axis * sine > radius + ROUNDING * far:
        return FARTHEST
    return far * (1 - ROUNDING) - radius


@device
def ray_reaches(rays, r, sphere, begin, end):
    """Whether ray r comes into a sphere (centre and radius) between two distances."""
    x, y, z = sphere[0] - rays.rays_o[r, 0], sphere[1] - rays.rays_o[r, 1], sphere[2] - rays.rays_o[r, 2]
    d = rays.rays_d[r, 0], rays.rays_d[r, 1], rays.rays_d[r, 2]
    middle = x * d[0] + y * d[1] + z * d[2]
    x, y, z = along((x, y, z), d, -middle)  # past the centre: exact however far away that is
    passes = x * x + y * y + z * z <= sphere[3] * sphere[3]
    return passes and middle + sphere[3] >= begin and middle - sphere[3] < end


@device
def instances_near(rays, instances, chosen, low, high, near, begins):
    """The instances that rays chosen[low:high] may meet into near (B,), unbounded ones first, the others by
    where they may begin, which goes into begins (B,): how many are unbounded, and how many there are."""
    bundle, count = bundle_of(rays, chosen, low, high), 0
    for b in range(instances.step.shape[0]):
        if instances.spheres[b, 3] >= FARTHEST:
            near[count], begins[count] = b, -FARTHEST
            count += 1
    n_unbounded = count
    for b in range(instances.step.shape[0]):
        if instances.spheres[b, 3] < FARTHEST:
            at = bundle_reaches(bundle, instances.spheres[b])
            if at < FARTHEST:
                near[count], begins[count] = b, at
                count += 1
    sort_by(begins, near, n_unbounded, count)
    return n_unbounded, count


@device
def fewer_near(rays, instances, chosen, low, high, near, begins, count, few, few_begin):
    """Those of instances near[:count] that rays chosen[low:high], some of those that they are near to, may
    meet, in the same order, into few (B,) and few_begin (B,): how many."""
    bundle, left = bundle_of(rays, chosen, low, high), 0
    for c in range(count):
        unbounded = begins[c] <= -FARTHEST
        if unbounded or bundle_reaches(bundle, instances.spheres[near[c]]) < FARTHEST:
            few[left], few_begin[left] = near[c], begins[c]
            left += 1
    return left


@device
def sort_by(keys, values, low, high):
    """Order keys[low:high], and values with them, by Shell's method with Ciura's gaps."""
    for gap in (701, 301, 132, 57, 23, 10, 4, 1):
        for i in range(low + gap, high):
            key, value, j = keys[i], values[i], i
            while j - gap >= low and keys[j - gap] > key:
                keys[j], values[j] = keys[j - gap], values[j - gap]
                j -= gap
            keys[j], values[j] = key, value
