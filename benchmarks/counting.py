"""Frames of `vm` fields with parts left out, to tell what the parts take: loops like `show_ray` of
kernels/instances.py, for benchmarks/filled.py.

A module like a kind's bodies.py, with the kind's own functions and these items of work beside them.
"""

from typing import NamedTuple

from fusedrf_cli.engine.kernels.loops import between, met, triple
from fusedrf_cli.engine.kernels.parts import along, next_sample
from fusedrf_cli.engine.kinds.vm.bodies import Arrays, sizes

__all__ = ["Arrays", "sizes"]


class Counts(NamedTuple):
    """What `count_ray` fills."""

    samples: object  # (N,) int64, at which a density is asked for
    dense: object  # (N,) int64, of which some are not 0
    colours: object  # (N,) int64


class Walked(NamedTuple):
    """What `walk_ray` follows: loops.Rays, where they end, and what is asked on the way."""

    rays_o: object
    rays_d: object
    reach: object
    step: object
    early_stop: object
    samples: object  # (N,) int64, after how many samples each ends
    asked: object  # bool: whether for densities


def count_ray(field, grid, rays, i, scratch, memory, out):
    """The samples that `show_ray` takes of ray i, and those that it jumps over where there is nothing."""
    o, d, step = triple(rays.rays_o, i), triple(rays.rays_d, i), rays.step
    trans, waiting, enough = 1.0, 0.0, COLOUR_FROM
    out.samples[i], out.dense[i], out.colours[i] = 0, 0, 0
    for number in range(PIECES):
        origin, way, u0, u1, course = piece(number, grid, o, d, rays.reach[i, 0], rays.reach[i, 1])
        u0 = u0 + 0.5 * step
        k, many = next_sample(grid, origin, way, u0, u1, step, 0)
        while k >= 0 and trans > rays.early_stop:
            u = u0 + 0.5 * between(k, many) * step
            _, opacity, _, _, _ = met(field, grid, (origin, way, course), k, many, u, step, d, scratch)
            weight = trans * opacity
            if trans - weight <= REST_FROM:
                weight = trans
            trans -= weight
            waiting += weight
            out.samples[i] += 1
            out.dense[i] += 1 if opacity > 0.0 else 0
            if waiting > enough:
                out.colours[i] += 1
                waiting, enough = 0.0, LENT_FROM
            k, many = next_sample(grid, origin, way, u0, u1, step, k + many)


def walk_ray(field, grid, rays, i, scratch, memory, out):
    """Marches to as many samples of ray i as it is said to have, and asks for their densities or for nothing;
    out[i] is made of what was found, so that no part of it is left out when this is compiled."""
    o, d, step = triple(rays.rays_o, i), triple(rays.rays_d, i), rays.step
    left, trans, places = rays.samples[i], 1.0, 0.0
    for number in range(PIECES):
        origin, way, u0, u1, course = piece(number, grid, o, d, rays.reach[i, 0], rays.reach[i, 1])
        u0 = u0 + 0.5 * step
        k, many = next_sample(grid, origin, way, u0, u1, step, 0)
        while k >= 0 and left > 0:
            u = u0 + 0.5 * between(k, many) * step
            if rays.asked:
                _, opacity, _, _, _ = met(field, grid, (origin, way, course), k, many, u, step, d, scratch)
                trans -= trans * opacity
            else:
                x, y, z = along(origin, way, u)
                places += x + y + z
            left -= 1
            k, many = next_sample(grid, origin, way, u0, u1, step, k + many)
    out[i] = trans + places
