"""What the machine can do at most, measured."""

import time
from dataclasses import dataclass

import numpy as np
from numba import get_num_threads, njit, prange

from fusedrf_cli.engine.kernels.parts import LINE
from fusedrf_cli.engine.kernels.prefetch import prefetch

FETCHED = 1 << 22  # random cache lines
AHEAD = 16
ROUNDS = 1 << 21


@dataclass(frozen=True)
class Peaks:
    """All cores together."""

    flops: float
    """float32 multiplications and additions per second."""
    stream: float
    """Bytes per second of an array as large as the field, read one after the other."""
    lines: float
    """Cache lines per second of that array, read at random and asked for ahead."""


@njit(fastmath={"contract"}, _nrt=False)  # free to fuse, not to find the chain's end by algebra
def multiply_add_task(rounds, values):
    """128 independent chains of multiply-adds."""
    factor, term = np.float32(0.999), np.float32(1e-3)
    for _ in range(rounds):
        for i in range(np.uint64(128)):
            values[i] = values[i] * factor + term


@njit(parallel=True)
def multiply_add(rounds, values):
    """`multiply_add_task` on each core."""
    for core in prange(values.shape[0]):
        multiply_add_task(rounds, values[core])


@njit(fastmath=True, error_model="numpy", _nrt=False)
def stream_task(values, low, high):
    """The sum of a stretch of numbers."""
    total = np.float32(0)
    for i in range(np.uint64(low), np.uint64(high)):
        total += values[i]
    return total


@njit(parallel=True)
def stream(values, out):
    """`stream_task` on each core."""
    size = values.shape[0] // out.shape[0]
    for core in prange(out.shape[0]):
        out[core] = stream_task(values, core * size, (core + 1) * size)


@njit(fastmath=True, error_model="numpy", _nrt=False)
def fetch_task(values, order, low, high):
    """The sum of one number of each of many cache lines."""
    total = np.float32(0)
    for i in range(np.uint64(low), np.uint64(high - AHEAD)):
        prefetch(values, order[i + np.uint64(AHEAD)])
        total += values[order[i]]
    return total


@njit(parallel=True)
def fetch(values, order, out):
    """`fetch_task` on each core."""
    size = order.shape[0] // out.shape[0]
    for core in prange(out.shape[0]):
        out[core] = fetch_task(values, order, core * size, (core + 1) * size)


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
    cores = get_num_threads()
    chains, out = np.ones((cores, 128), np.float32), np.zeros(cores, np.float32)
    field = np.ones(field_size, np.float32)
    order = LINE * np.random.default_rng(0).integers(0, field_size // LINE, FETCHED, np.uint64)
    return Peaks(
        2 * 128 * ROUNDS * cores / best_seconds(multiply_add, ROUNDS, chains),
        4 * field_size / best_seconds(stream, field, out),
        FETCHED / best_seconds(fetch, field, order, out),
    )
