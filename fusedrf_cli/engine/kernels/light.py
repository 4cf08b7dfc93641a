"""How much light reaches the places of a field: an item of work for the loops of loops.py, of every kind."""

import math
from typing import NamedTuple

from fusedrf_cli.engine.kernels.primitives import along, hit_box


class Light(NamedTuple):
    """What `expose_cube` looks from and along, in the coordinates of the field's space."""

    places: object  # (K, 3) middles of cubes
    sides: object  # (K,)
    directions: object  # (D, 3)
    far: object  # float
    blocked: object  # float
    step: object  # float, of samples


class Exposure(NamedTuple):
    """What `expose_cube` fills."""

    clearest: object  # (K,)
    facing: object  # (K, 3)


def expose_cube(field, grid, light, i, scratch, memory, out):
    """How much light reaches cube i, of sides[i] around places[i], from `far` away or from outside the box:
    the most along one of the directions into clearest[i], and the mean of their opposites, by that light,
    into facing[i]. What lets through less than `blocked` counts as opaque, and the cube itself as clear."""
    clearest, facing, side = out.clearest, out.facing, light.sides[i]
    clearest[i] = 0
    facing[i, 0], facing[i, 1], facing[i, 2] = 0, 0, 0
    origin, total = triple(light.places, i), 0.0
    for q in range(light.directions.shape[0]):
        direction = triple(light.directions, q)
        far = min(light.far, hit_box(origin, direction, grid.lo, grid.hi)[1])
        trans, k, u = 1.0, 0, side
        while u < far and trans > light.blocked:
            p = along(origin, direction, u)
            sigma, _, steps, place = density(field, grid, k, p, direction, scratch)
            trans *= math.exp(-sigma * steps * light.step)
            k = next_index(field, grid, place, 1, steps, k, p, direction, u, side, light.step)
            u = side + k * light.step
        if trans > light.blocked:
            clearest[i] = max(clearest[i], trans)
            facing[i, 0] -= trans * direction[0]
            facing[i, 1] -= trans * direction[1]
            facing[i, 2] -= trans * direction[2]
            total += trans
    if total > 0:
        facing[i, 0] /= total
        facing[i, 1] /= total
        facing[i, 2] /= total
