"""What the machine can do at most, measured."""

import time
from dataclasses import dataclass

import numpy as np
from numba import njit, prange

from fusedrf_cli.engine.kernels.prefetch import LINE, prefetch

STREAMED = 1 << 25  # floats, far more than caches hold
FETCHED = 1 << 22  # random cache lines
AHEAD = 16
ROUNDS = 1 << 21


@dataclass(frozen=True)
class Peaks:
    """All cores together."""

    flops: float
    """float32 multiplications and additions per second."""
    stream: float
    """Bytes per second, read one after the other."""
    lines: float
    """Cache lines per second, read at random and asked for ahead."""


@njit(parallel=True, fastmath=True)
def multiply_add(rounds, cores, out):
    """128 independent chains of multiply-adds on each core."""
    for core in prange(cores):
        values = np.ones(128, np.float32)
        factor, term = np.float32(0.999), np.float32(1e-3)
        for _ in range(rounds):
            for i in range(128):
                values[i] = values[i] * factor + term
        out[core] = values.sum()


@njit(parallel=True, fastmath=True)
def stream(values, cores, out):
    """Sum a long vector."""
    size = values.shape[0] // cores
    for core in prange(cores):
        total = np.float32(0)
        for i in range(core * size, (core + 1) * size):
            total += values[i]
        out[core] = total


@njit(parallel=True, fastmath=True)
def fetch(values, order, cores, out):
    """Read one number of each of many cache lines."""
    size = order.shape[0] // cores
    for core in prange(cores):
        total = np.float32(0)
        for i in range(core * size, (core + 1) * size - AHEAD):
            prefetch(values, order[i + AHEAD])
            total += values[order[i]]
        out[core] = total


def best_seconds(function, *arguments) -> float:
    """The shortest of some runs after one that compiles."""
    function(*arguments)
    seconds = []
    for _ in range(5):
        started = time.perf_counter()
        function(*arguments)
        seconds.append(time.perf_counter() - started)
    return min(seconds)


def measured_peaks(field_size: int) -> Peaks:
    """Peaks now; field_size are the floats of the array that random lines are taken from."""
    from numba import get_num_threads

    cores = get_num_threads()
    out = np.zeros(cores, np.float32)
    long, field = np.ones(STREAMED, np.float32), np.ones(field_size, np.float32)
    order = LINE * np.random.default_rng(0).integers(0, field_size // LINE, FETCHED)
    return Peaks(
        2 * 128 * ROUNDS * cores / best_seconds(multiply_add, ROUNDS, cores, out),
        4 * STREAMED / best_seconds(stream, long, cores, out),
        FETCHED / best_seconds(fetch, field, order, cores, out),
    )
