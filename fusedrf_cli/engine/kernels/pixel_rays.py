"""Loops that draw numbers in random order, and gather rays and colours of pixels, for the CPU."""

import math

import numpy as np
from numba import prange

from fusedrf_cli.engine.kernels.field_free import ITEMS_PER_TASK, loop, serial
from fusedrf_cli.engine.kernels.loops import RAYS_PER_TASK
from fusedrf_cli.engine.kernels.prefetch import prefetch
from fusedrf_cli.engine.kernels.primitives import device

ROUNDS = 6  # of mixing
AHEAD = 8  # so many rays before it is used a pixel is asked for, which lies anywhere


@device
def mixed(x):
    """64 bits of which each depends on every bit of x (the finaliser of MurmurHash3)."""
    x = (x ^ (x >> np.uint64(33))) * np.uint64(0xFF51AFD7ED558CCD)
    x = (x ^ (x >> np.uint64(33))) * np.uint64(0xC4CEB9FE1A85EC53)
    return x ^ (x >> np.uint64(33))


@device
def position_in_order(x, low_bits, high_bits, keys):
    """Which of 2^(low_bits + high_bits) numbers comes at place x of the order that keys (ROUNDS,) tell: a
    Feistel network, in which each half of the bits in turn is changed by the other, so that no two places get
    the same number."""
    low, high = x & ((np.uint64(1) << low_bits) - np.uint64(1)), x >> low_bits
    for i in range(ROUNDS):
        key = np.uint64(keys[i])
        if i % 2 == 0:
            high ^= mixed(low ^ key) >> (np.uint64(64) - high_bits)
        else:
            low ^= mixed(high ^ key) >> (np.uint64(64) - low_bits)
    return (high << low_bits) | low


@serial
def shuffled_task(at, count, low_bits, high_bits, keys, low, high, out):
    """`shuffled` for out[low:high]."""
    for i in range(low, high):
        x = position_in_order(np.uint64(at + i), low_bits, high_bits, keys)
        while x >= np.uint64(count):
            x = position_in_order(x, low_bits, high_bits, keys)
        out[i] = x


@loop
def shuffled(at, count, keys, out):
    """The numbers at places at, at + 1, ... of the order of 0 to count - 1 that keys (ROUNDS,) int64 tell,
    into out (N,) int64.

    An order of more numbers, a power of two, is gone along from each place until a number below `count` comes
    (cycle walking: Black and Rogaway 2002, "Ciphers with Arbitrary Finite Domains", section 3).
    """
    bits = 8  # at least: by fewer, some orders of a few numbers came far more often
    while (1 << bits) < count:
        bits += 1
    low_bits, high_bits = np.uint64(bits // 2), np.uint64(bits - bits // 2)
    n = out.shape[0]
    for part in prange((n + ITEMS_PER_TASK - 1) // ITEMS_PER_TASK):
        low, high = part * ITEMS_PER_TASK, min(n, (part + 1) * ITEMS_PER_TASK)
        shuffled_task(at, count, low_bits, high_bits, keys, low, high, out)


@device
def holder(first, pixel):
    """The picture that a pixel is in: the last whose first[...] is not past it."""
    low, high = 0, first.shape[0] - 1
    while high - low > 1:
        middle = (low + high) // 2
        if first[middle] <= pixel:
            low = middle
        else:
            high = middle
    return low


@serial
def rays_of_pixels_task(chosen, first, direction_at, directions, poses, colours, low, high, out):
    """`rays_of_pixels` for pixels chosen[low:high]."""
    rotation, position = poses
    rays_o, rays_d, pixels, view = out
    for i in range(low, min(high, low + AHEAD)):
        view[i] = holder(first, chosen[i])
    for i in range(low, high):
        if i + AHEAD < high:
            later = chosen[i + AHEAD]
            v = holder(first, later)
            view[i + AHEAD] = v
            prefetch(colours, 4 * later)
            prefetch(directions, 3 * (direction_at[v] + later - first[v]))
        p, v = chosen[i], view[i]
        at = 3 * (direction_at[v] + p - first[v])
        x, y, z = np.float64(directions[at]), np.float64(directions[at + 1]), np.float64(directions[at + 2])
        r = rotation
        dx = r[v, 0, 0] * x + r[v, 0, 1] * y + r[v, 0, 2] * z
        dy = r[v, 1, 0] * x + r[v, 1, 1] * y + r[v, 1, 2] * z
        dz = r[v, 2, 0] * x + r[v, 2, 1] * y + r[v, 2, 2] * z
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        rays_d[i, 0], rays_d[i, 1], rays_d[i, 2] = dx / length, dy / length, dz / length
        for c in range(3):
            rays_o[i, c] = position[v, c]
            pixels[i, c] = np.float32(colours[4 * p + c]) / np.float32(255)
        pixels[i, 3] = np.float32(colours[4 * p + 3]) / np.float32(255)


@loop
def rays_of_pixels(chosen, first, direction_at, directions, poses, colours, out):
    """For each of the pixels chosen (N,), counted picture after picture, its ray and its colour.

    Picture v has the pixels first[v] to first[v + 1], of colours (P * 4,) uint8, and its camera's directions,
    not turned yet, from direction_at[v] on in directions (D * 3,). poses is (rotation (n, 3, 3), position
    (n, 3)), camera to world. out is (origins (N, 3), unit directions (N, 3), colours (N, 4) in [0, 1], the
    picture's number (N,) int64).
    """
    n = chosen.shape[0]
    for part in prange((n + RAYS_PER_TASK - 1) // RAYS_PER_TASK):
        low, high = part * RAYS_PER_TASK, min(n, (part + 1) * RAYS_PER_TASK)
        rays_of_pixels_task(chosen, first, direction_at, directions, poses, colours, low, high, out)
