"""The loops on a GPU: the same functions, one thread per item of work.

They are compiled from the same source, with atomic sums where threads may add to the same place. Arrays may
lie on the device or on the host: what is on the host is copied to the device and, where a loop writes it,
back. NUMBA_ENABLE_CUDASIM=1 runs all of this without a GPU.
"""

from functools import cache, lru_cache
from types import FunctionType, ModuleType, SimpleNamespace

import numba
import numpy as np
from numba import cuda
from numba.np.numpy_support import from_dtype

from fusedrf_cli.engine.kernels import parts, specialise
from fusedrf_cli.engine.kernels.loops import POINTS_PER_TASK, Kept

SIMULATED = bool(numba.config.ENABLE_CUDASIM)
THREADS = 1 if SIMULATED else 128  # the simulator's threads are Python's, one after the other
RAYS_IN_FLIGHT = 1 << 14  # rays of a training pass that have scratch memory at the same time
POINTS_IN_FLIGHT = 1 << 18

device = cuda.jit(device=True, fastmath=True)


@device
def accumulate(out, i, value):
    """`parts.accumulate`, atomic."""
    cuda.atomic.add(out, i, value)


@device
def scatter_8(out, o, weight, values, v):
    """`parts.scatter_8`, atomic."""
    for r in range(8):
        cuda.atomic.add(out, o + np.uint64(r), weight * values[v + np.uint64(r)])


@device
def ahead(field, array, held, p):
    """Nothing: while some threads wait for memory, others work."""


@device
def literally(value):
    """Nothing: the compiler sees constants all the same."""
    return value


REPLACED = {"accumulate": accumulate, "scatter_8": scatter_8, "ahead_density": ahead, "ahead_colour": ahead}
REPLACED["literally"] = literally


def as_device_functions(names: dict) -> dict:
    """The namespace with every function in it, compiled for the CPU or not at all, as one of the device."""
    found = dict(names)
    for name, value in names.items():
        function = getattr(value, "py_func", None)
        if function is not None:
            found[name] = device(FunctionType(function.__code__, found, name, function.__defaults__))
    found.update(REPLACED)
    return found


class Loops:
    """The GPU's loops for the fields of a kind that share some sizes; see specialise.Loops."""

    def __init__(self, bodies: ModuleType, sizes: dict[str, int], space: ModuleType):
        _, names = specialise.specialised(bodies, sizes, space)
        self.names = as_device_functions(names)
        self.scratch, self.memory = max(sizes["SCRATCH"], 1), max(sizes["KEPT"], 1)
        self.kernels = {}

    def each(self, item: str, field, grid, asked, count: int, out, per_task: int = POINTS_PER_TASK):
        """See specialise.Loops."""
        kernel = self._kernel(each_kernel, item, field)
        launch(kernel, count, (field, grid, asked, count), (out,))

    def sweep(self, item: str, field, grid, batch, count: int, most: int, grads, loss):
        """See specialise.Loops; all is added to row 0 of grads and loss."""
        kernel = self._kernel(sweep_kernel, item, field)
        # as much for few rays as for many: their number changes from step to step, and memory is slow to be
        # had
        in_flight = RAYS_IN_FLIGHT if most > 1 else min(count, POINTS_IN_FLIGHT)
        room = sweep_memory(most, in_flight, field.params.dtype) if count else ()
        launch(kernel, min(count, in_flight), (field, grid, batch, count, *room), (grads, loss))

    def _kernel(self, make, item: str, field):
        """The kernel of an item, for the type of a field's numbers."""
        key = make, item, field.params.dtype
        if key not in self.kernels:
            real = from_dtype(np.dtype(field.params.dtype))
            self.kernels[key] = make(self.names[item], self.scratch, self.memory, real)
        return self.kernels[key]


def each_kernel(item, scratch_size: int, memory_size: int, real):
    """`each` of loops.py, a thread for each item."""

    @cuda.jit(fastmath=True)
    def each(field, grid, asked, count, out):
        i = cuda.grid(1)
        if i < count:
            scratch, memory = cuda.local.array(scratch_size, real), cuda.local.array(memory_size, real)
            item(field, grid, asked, i, scratch, memory, out)

    return each


def sweep_kernel(item, scratch_size: int, memory_size: int, real):
    """`sweep` of loops.py: threads that share the items out, with memory for one shaded sample each."""

    @cuda.jit(fastmath=True)
    def sweep(field, grid, batch, count, wholes, reals, grads, loss):
        thread, threads = cuda.grid(1), reals.shape[2]
        scratch, memory = cuda.local.array(scratch_size, real), cuda.local.array(memory_size, real)
        if thread < threads:
            for r in range(scratch_size):
                scratch[r] = 0
            kept = Kept(
                wholes[0, :, thread], wholes[1, :, thread], wholes[2, :, thread], wholes[3, :, thread],
                wholes[4, :, thread], wholes[5, :, thread], reals[0, :, thread], reals[1, :, thread],
                reals[2, :, thread], reals[3, :, thread], reals[4, :, thread], reals[5:8, :, thread].T,
                memory,
            )  # fmt: skip
            for i in range(thread, count, threads):
                item(field, grid, batch, i, kept, scratch, grads[0], loss[0])

    return sweep


@lru_cache(maxsize=2)
def sweep_memory(most: int, threads: int, kind: np.dtype) -> tuple:
    """What the ways back of so many threads need: (6, most, threads) whole numbers and (8, ..) reals, a
    thread's own next to its neighbours', as threads read them."""
    shape = most, threads
    return cuda.device_array((6, *shape), np.int32), cuda.device_array((8, *shape), kind)


@cache
def loops_for(bodies: ModuleType, sizes: tuple[tuple[str, int], ...], space: ModuleType) -> Loops:
    """The loops of a kind for some sizes, made once."""
    return Loops(bodies, dict(sizes), space)


@lru_cache(maxsize=1)
def plain_kernels() -> SimpleNamespace:
    """Kernels that know no kind of field."""
    names = as_device_functions(vars(parts))
    touched, adam_line, line = names["touched"], names["adam_line"], parts.LINE
    sum_of_rows = names["sum_of_rows"]

    @cuda.jit(fastmath=True)
    def adam(params, grads, moment1, moment2, rate, low, high, beta1, beta2, eps, correction1, correction2):
        start = low + line * cuda.grid(1)
        if start < high and touched(grads, np.uint64(start)):
            adam_line(
                params, grads, moment1, moment2, rate, np.uint64(start), beta1, beta2, eps, correction1,
                correction2,
            )  # fmt: skip

    @cuda.jit(fastmath=True)
    def adam_lines(params, grads, moment1, moment2, rate, lines, beta1, beta2, eps, correction1, correction2):
        i = cuda.grid(1)
        if i < lines.shape[0] and touched(grads, np.uint64(lines[i])):
            adam_line(
                params, grads, moment1, moment2, rate, np.uint64(lines[i]), beta1, beta2, eps, correction1,
                correction2,
            )  # fmt: skip

    @cuda.jit(fastmath=True)
    def sums_of_rows(base, width, start, source, weight, target, keep, values):
        i = cuda.grid(1)
        if i < target.shape[0]:
            sum_of_rows(values, base, width, start, source, weight, target, i, keep)

    return SimpleNamespace(adam=adam, adam_lines=adam_lines, sums_of_rows=sums_of_rows)


def adam(params, grads, moment1, moment2, rate, low, high, beta1, beta2, eps, correction1, correction2):
    """See plain.adam."""
    arrays = params, grads, moment1, moment2
    placed = [on_device(array) for array in arrays]
    rest = rate, low, high, beta1, beta2, eps, correction1, correction2
    lines = -(-(high - low) // parts.LINE)
    if lines > 0:
        plain_kernels().adam[(lines + THREADS - 1) // THREADS, THREADS](*placed, *rest)
    fetch(arrays, placed)


def adam_lines(params, grads, moment1, moment2, rate, lines, beta1, beta2, eps, correction1, correction2):
    """See plain.adam_lines."""
    arrays = params, grads, moment1, moment2
    placed = [on_device(array) for array in arrays]
    rest = rate, on_device(lines), beta1, beta2, eps, correction1, correction2
    if len(lines):
        plain_kernels().adam_lines[(len(lines) + THREADS - 1) // THREADS, THREADS](*placed, *rest)
    fetch(arrays, placed)


def sums_of_rows(values, base, width, start, source, weight, target, keep):
    """See plain.sums_of_rows."""
    inputs = base, width, start, source, weight, target, keep
    launch(plain_kernels().sums_of_rows, len(target), inputs, (values,))


# -- numbers there and here ----------------------------------------------------------------------------------


def shared(tensor):
    """A torch tensor's numbers as the loops take them, not copied. The simulator's device is the host."""
    return tensor.detach().numpy() if SIMULATED else cuda.as_cuda_array(tensor.detach())


def on_device(value):
    """A host array's copy on the device, a tuple of arrays with all of them there; all else as it is."""
    if isinstance(value, np.ndarray):
        return value if SIMULATED else cuda.to_device(np.ascontiguousarray(value))
    return type(value)(*map(on_device, value)) if hasattr(value, "_fields") else value


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
