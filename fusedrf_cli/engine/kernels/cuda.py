"""The loops on a GPU: the same functions, one thread per item of work.

They are compiled from the same source, with atomic sums where threads may add to the same place. Arrays may
lie on the device or on the host: what is on the host is copied to the device and, where a loop writes it,
back. NUMBA_ENABLE_CUDASIM=1 runs all of this without a GPU.
"""

from dataclasses import dataclass
from functools import cache, lru_cache
from types import FunctionType, ModuleType, SimpleNamespace

import numba
import numpy as np
from numba import cuda
from numba.core import event
from numba.np.numpy_support import from_dtype

from fusedrf_cli.engine.kernels import primitives, specialise
from fusedrf_cli.engine.kernels.learning import RaySamples
from fusedrf_cli.engine.kernels.loops import POINTS_PER_TASK
from fusedrf_cli.engine.settings import current

SIMULATED = bool(numba.config.ENABLE_CUDASIM)
THREADS = 1 if SIMULATED else 128  # the simulator's threads are Python's, one after the other


@dataclass(frozen=True)
class CudaConfig:
    """What has memory of a GPU at the same time."""

    rays_in_flight: int = 1 << 14
    """Rays of a training pass that have scratch memory at the same time."""
    points_in_flight: int = 1 << 18
    """The same of points."""
    near_in_flight: int = 1 << 22
    """Numbers of instances that rays may meet: in each of four arrays of 32 MB."""


if not SIMULATED:  # whose compiler has settings of its own
    from numba.cuda.core import caching, config
    from numba.cuda.core import event as gpu_event

    from fusedrf_cli.engine.kernels import locator
    from fusedrf_cli.engine.kernels.atomics import add_4

    locator.install(caching)
    config.CACHE_DIR = numba.config.CACHE_DIR
    config.CUDA_LOW_OCCUPANCY_WARNINGS = 0  # a scene of few rays is no mistake

    class Forwarded(gpu_event.Listener):
        """Tells numba's own listeners what the GPU's compiler does, as an event of a kind of theirs."""

        def __init__(self, kind: str):
            self.kind = kind

        def on_start(self, gpu_started: gpu_event.Event) -> None:
            event.start_event(self.kind)

        def on_end(self, gpu_started: gpu_event.Event) -> None:
            event.end_event(self.kind)

    gpu_event.register("numba-cuda:run_pass", Forwarded("numba:compile"))
    # all that its compiler does, with linking and with what it loads from the cache
    gpu_event.register("numba-cuda:compiler_lock", Forwarded("fusedrf:gpu"))

device = cuda.jit(device=True, fastmath=True)


if SIMULATED:

    def add_4(out, o, e0, e1, e2, e3):
        """`atomics.add_4`, for threads that run one after the other."""
        for r, value in enumerate((e0, e1, e2, e3)):
            out[o + np.uint64(r)] += value


@device
def accumulate(out, i, value):
    """`primitives.accumulate`, atomic."""
    cuda.atomic.add(out, i, value)


@device
def raise_to(out, i, value):
    """`primitives.raise_to`, atomic."""
    cuda.atomic.max(out, i, value)


@device
def scatter_4(out, o, weight, values, v):
    """`primitives.scatter_4`, atomic."""
    add_4(
        out, o, weight * values[v], weight * values[v + np.uint64(1)], weight * values[v + np.uint64(2)],
        weight * values[v + np.uint64(3)],
    )  # fmt: skip


@device
def scatter_8(out, o, weight, values, v):
    """`primitives.scatter_8`, atomic."""
    scatter_4(out, o, weight, values, v)
    scatter_4(out, o + np.uint64(4), weight, values, v + np.uint64(4))


@device
def ahead(field, array, packed, p):
    """Nothing: while some threads wait for memory, others work."""


@device
def not_filled(field, count, scratch):
    """Nothing: a thread has one sample."""


@device
def literally(value):
    """Nothing: the compiler sees constants all the same."""
    return value


def as_device_functions(names: dict) -> dict:
    """The namespace with every function in it, compiled for the CPU or not at all, as one of the device."""
    device_names = dict(names)
    for name, value in names.items():
        function = getattr(value, "py_func", None)
        if function is not None:
            device_names[name] = device(
                FunctionType(function.__code__, device_names, name, function.__defaults__)
            )
    device_names |= {
        "accumulate": accumulate, "raise_to": raise_to, "scatter_4": scatter_4, "scatter_8": scatter_8,
        "prefetch_density": ahead, "prefetch_colour": ahead, "literally": literally,
        "fill_lanes": not_filled, "LANES": 0,
    }  # fmt: skip
    return device_names


class Loops:
    """The GPU's loops for the fields of a kind that share some sizes; see specialise.Loops."""

    def __init__(self, device_module: ModuleType, sizes: dict[str, int], space: ModuleType):
        self.tag, names = specialise.specialised(device_module, sizes, space)
        room = {"SCRATCH_ROOM": max(sizes["SCRATCH"], 1), "MEMORY_ROOM": max(sizes["KEPT"], 1)}
        self.names = {**as_device_functions(names), **room, "cuda": cuda, "RaySamples": RaySamples}
        self.kernels = {}

    def each(self, item: str, field, grid, query, count: int, out, per_task: int = POINTS_PER_TASK):
        """See specialise.Loops."""
        launch(self._kernel(each_thread, item, field), count, (field, grid, query, count), (out,))

    def sweep(self, item: str, field, grid, batch, count: int, most: int, out):
        """See specialise.Loops; all is added to row 0 of both."""
        grads, loss = out
        config = current(CudaConfig)
        kernel = self._kernel(sweep_thread, item, field)
        # as much for few rays as for many: their number changes from step to step, and memory is slow to be
        # had
        in_flight = config.rays_in_flight if most > 1 else min(count, config.points_in_flight)
        if count:
            *room, losses = sweep_memory(most, in_flight, field.params.dtype)
            launch(kernel, in_flight, (field, grid, batch, count, *room, losses), (grads,))
            loss[0] += losses.copy_to_host().sum(0)

    def _kernel(self, template: FunctionType, item: str, field):
        """The kernel of an item, for the type of a field's numbers."""
        kind = np.dtype(field.params.dtype)
        key = template, item, kind
        if key not in self.kernels:
            names = {**self.names, "item": self.names[item], "REAL": from_dtype(kind)}
            self.kernels[key] = kernel_of(template, names, f"{self.tag}_{item}_{kind}")
        return self.kernels[key]


def kernel_of(template: FunctionType, names: dict, tag: str):
    """A kernel whose names mean those of a dictionary, which `tag` tells from all others."""
    return cuda.jit(fastmath=True, cache=True)(specialise.rebound(template, names, tag))


def each_thread(field, grid, query, count, out):
    """`each` of loops.py, a thread for each item."""
    i = cuda.grid(1)
    if i < count:
        scratch, memory = cuda.local.array(SCRATCH_ROOM, REAL), cuda.local.array(MEMORY_ROOM, REAL)
        for r in range(SCRATCH_ROOM):  # what lies there is another thread's
            scratch[r] = 0
        item(field, grid, query, i, scratch, memory, out)


def sweep_thread(field, grid, batch, count, wholes, reals, losses, grads):
    """`sweep` of loops.py: threads that share the items out, with memory for one shaded sample each, and with
    losses of their own: all would wait for each other to add to the same."""
    thread, threads = cuda.grid(1), reals.shape[2]
    scratch, memory = cuda.local.array(SCRATCH_ROOM, REAL), cuda.local.array(MEMORY_ROOM, REAL)
    if thread < threads:
        for r in range(SCRATCH_ROOM):
            scratch[r] = 0
        samples = RaySamples(
            wholes[0, :, thread], wholes[1, :, thread], wholes[2, :, thread], wholes[3, :, thread],
            wholes[4, :, thread], wholes[5, :, thread], reals[0, :, thread], reals[1, :, thread],
            reals[2, :, thread], reals[3, :, thread], reals[4, :, thread], reals[5:8, :, thread].T,
            memory,
        )  # fmt: skip
        losses[thread, 0], losses[thread, 1], losses[thread, 2] = 0, 0, 0
        for i in range(thread, count, threads):
            item(field, grid, batch, i, samples, scratch, grads[0], losses[thread])


@lru_cache(maxsize=2)
def sweep_memory(most: int, threads: int, kind: np.dtype) -> tuple:
    """What the ways back of so many threads need: (6, most, threads) whole numbers and (8, ..) reals, a
    thread's own next to its neighbours', as threads read them; and (threads, 3) losses."""
    integers, reals = (
        cuda.device_array((6, most, threads), np.int32),
        cuda.device_array((8, most, threads), kind),
    )
    return integers, reals, cuda.device_array((threads, 3))


@cache
def loops_for(device_module: ModuleType, sizes: tuple[tuple[str, int], ...], space: ModuleType) -> Loops:
    """The loops of a kind for some sizes, made once."""
    return Loops(device_module, dict(sizes), space)


@lru_cache(maxsize=1)
def plain_kernels() -> SimpleNamespace:
    """Kernels that know no kind of field."""
    names = {**as_device_functions(vars(primitives)), "cuda": cuda}
    kernels = {
        t.__name__: kernel_of(t, names, "plain") for t in (adam_thread, adam_lines_thread, sums_thread)
    }
    return SimpleNamespace(**kernels)


def adam_thread(
    params, grads, moment1, moment2, rate, low, high, beta1, beta2, eps, correction1, correction2
):
    """`adam` of field_free.py, a thread for each cache line."""
    start = low + LINE * cuda.grid(1)
    if start < high and touched(grads, np.uint64(start)):
        adam_line(
            params, grads, moment1, moment2, rate, np.uint64(start), beta1, beta2, eps, correction1,
            correction2,
        )  # fmt: skip


def adam_lines_thread(
    params, grads, moment1, moment2, rate, lines, beta1, beta2, eps, correction1, correction2
):
    """`adam_lines` of field_free.py, a thread for each cache line."""
    i = cuda.grid(1)
    if i < lines.shape[0] and touched(grads, np.uint64(lines[i])):
        adam_line(
            params, grads, moment1, moment2, rate, np.uint64(lines[i]), beta1, beta2, eps, correction1,
            correction2,
        )  # fmt: skip


def sums_thread(base, width, start, source, weight, target, keep, values):
    """`sums_of_rows` of field_free.py, a thread for each sum."""
    i = cuda.grid(1)
    if i < target.shape[0]:
        sum_of_rows(values, base, width, start, source, weight, target, i, keep)


def adam(params, grads, moment1, moment2, rate, low, high, beta1, beta2, eps, correction1, correction2):
    """See field_free.adam."""
    arrays = params, grads, moment1, moment2
    placed = [on_device(array) for array in arrays]
    rest = rate, low, high, beta1, beta2, eps, correction1, correction2
    lines = -(-(high - low) // primitives.LINE)
    if lines > 0:
        plain_kernels().adam_thread[(lines + THREADS - 1) // THREADS, THREADS](*placed, *rest)
    fetch(arrays, placed)


def adam_lines(params, grads, moment1, moment2, rate, lines, beta1, beta2, eps, correction1, correction2):
    """See field_free.adam_lines."""
    arrays = params, grads, moment1, moment2
    placed = [on_device(array) for array in arrays]
    rest = rate, on_device(lines), beta1, beta2, eps, correction1, correction2
    if len(lines):
        plain_kernels().adam_lines_thread[(len(lines) + THREADS - 1) // THREADS, THREADS](*placed, *rest)
    fetch(arrays, placed)


def sums_of_rows(values, base, width, start, source, weight, target, keep):
    """See field_free.sums_of_rows."""
    inputs = base, width, start, source, weight, target, keep
    launch(plain_kernels().sums_thread, len(target), inputs, (values,))


# -- numbers there and here ----------------------------------------------------------------------------------


def shared(tensor):
    """A torch tensor's numbers as the loops take them, not copied. The simulator's device is the host."""
    return tensor.detach().numpy() if SIMULATED else cuda.as_cuda_array(tensor.detach())


def on_device(value):
    """A host array's copy on the device, a tuple of arrays with all of them there; all else as it is."""
    if isinstance(value, np.ndarray):
        return value if SIMULATED else cuda.to_device(np.ascontiguousarray(value))
    if not hasattr(value, "_fields"):
        return value
    copies = {id(part): on_device(part) for part in value}  # what two slots of a field read is copied once
    return type(value)(*(copies[id(part)] for part in value))


def on_host(array) -> np.ndarray:
    """An array of the device, copied here; one that lies here as it is."""
    return array if isinstance(array, np.ndarray) else array.copy_to_host()


def segments() -> ModuleType:
    """The loops over rays of scenes of several instances."""
    from fusedrf_cli.engine.kernels import cuda_segments

    return cuda_segments


def launch(kernel, threads: int, inputs: tuple, outputs: tuple) -> None:
    """Run a kernel with so many threads; its last arguments are the arrays, or tuples of them, it writes."""
    if threads:
        placed = [on_device(array) for array in outputs]
        kernel[(threads + THREADS - 1) // THREADS, THREADS](*map(on_device, inputs), *placed)
        fetch(outputs, placed)


def fetch(host: tuple, placed: tuple) -> None:
    """Copy what lies on the device back to those arrays that lie on the host."""
    for array, there in zip(host, placed, strict=True):
        if hasattr(array, "_fields"):
            fetch(array, there)
        elif there is not array:
            there.copy_to_host(array)
