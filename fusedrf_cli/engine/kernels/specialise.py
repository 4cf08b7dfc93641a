"""Templates and scalar functions over one namespace per (kind, sizes, space): one set of loops for all.

A function that is to call others by name gets the same code over another dictionary of globals, in which the
names mean this kind's functions and this field's sizes. Closures would do as well, but numba compiles what
captures functions again in every process.
"""

import hashlib
import sys
from functools import cache
from pathlib import Path
from types import FunctionType, ModuleType

from numba import get_num_threads, njit

from fusedrf_cli.engine.kernels import instances, learning, light, loops, primitives
from fusedrf_cli.engine.kernels.field_free import FLAGS, loop, serial

ROLES = {"each": loop, "sweep": loop, "march": loop, "each_task": serial, "sweep_task": serial}
inlined = njit(**FLAGS, forceinline=True, _nrt=False)


class Loops:
    """The CPU's loops for the fields of a kind that share some sizes."""

    def __init__(self, device_module: ModuleType | None, sizes: dict[str, int], space: ModuleType):
        """device_module: the kind's scalar functions; None: there is no field, only the space to march in."""
        self.tag, self.names = specialised(device_module, sizes, space)
        self.runs: dict[tuple[str, str], FunctionType] = {}

    def each(self, item: str, field, grid, query, count: int, out, per_task: int = loops.POINTS_PER_TASK):
        """An item of work, a function of loops.py or of the kind, for each i < count, which fills `out`."""
        self._over("each", item)(field, grid, query, count, per_task, get_num_threads(), out)

    def sweep(self, item: str, field, grid, batch, count: int, most: int, out):
        """An item of work of at most so many samples for each i < count, which adds to the rows of out:
        (grads (parts, P), loss (parts, 3))."""
        self._over("sweep", item)(field, grid, batch, count, most, *out)

    def march(self, *arguments):
        """See `march` of loops.py."""
        self.names["march"](*arguments)

    def _over(self, loop_name: str, item: str):
        """The loop over an item, compiled when it is called first."""
        run = self.runs.get((loop_name, item))
        if run is None:
            names = {**self.names, "item": self.names[item]}
            for name in (f"{loop_name}_task", loop_name):
                names[name] = ROLES[name](rebound(getattr(loops, name), names, f"{self.tag}_{item}"))
            run = self.runs[loop_name, item] = names[loop_name]
        return run


@cache
def loops_for(
    device_module: ModuleType | None, sizes: tuple[tuple[str, int], ...], space: ModuleType
) -> Loops:
    """The loops of a kind for some sizes, made once."""
    return Loops(device_module, dict(sizes), space)


def specialised(
    device_module: ModuleType | None, sizes: dict[str, int], space: ModuleType
) -> tuple[str, dict]:
    """A name for the combination, and its namespace of compiled functions."""
    names, functions = namespace(device_module, space)
    if getattr(space, "CURVED", False) and names["next_index"] is not loops.next_index:
        raise ValueError(
            f"{device_module.__name__} follows straight rays, which {space.__name__} has none of"
        )
    names |= sizes
    tag = combination(device_module, sizes, space, names)
    for name, function in functions.items():
        names[name] = ROLES.get(name, inlined)(rebound(function, names, tag))
    return tag, names


def namespace(device_module: ModuleType | None, space: ModuleType) -> tuple[dict, dict[str, FunctionType]]:
    """What the names mean before anything is compiled, and which of them are plain functions to compile."""
    own = [device_module] if device_module else []
    modules = [loops, learning, instances, light, *bases_of(space), space, *own]
    names = {name: value for module in (primitives, *modules) for name, value in vars(module).items()}
    module_names = {module.__name__ for module in modules}
    functions = {
        n: f for n, f in names.items() if isinstance(f, FunctionType) and f.__module__ in module_names
    }
    return names, functions | getattr(device_module, "functions", {})


def bases_of(space: ModuleType) -> list[ModuleType]:
    """The modules of other spaces that a space takes functions from."""
    taken = {f.__module__ for f in vars(space).values() if isinstance(f, FunctionType)}
    return [sys.modules[name] for name in sorted(taken - {space.__name__})]


def rebound(function: FunctionType, names: dict, tag: str) -> FunctionType:
    """The same code over another namespace. Compiled code is kept by qualified name and types of arguments,
    so that the name must tell combinations apart: with one name for two, the second would load the machine
    code of the first."""
    copy = FunctionType(function.__code__, names, function.__name__, function.__defaults__)
    copy.__qualname__ = f"{function.__name__}_{tag}"
    copy.__module__ = function.__module__
    return copy


def combination(
    device_module: ModuleType | None, sizes: dict[str, int], space: ModuleType, names: dict
) -> str:
    """A name of its own for a kind's module, sizes and space, and for the text of all files that their
    functions come from: numba looks for changes only in the file of the loop, not of what it inlines."""
    files = {getattr(f, "py_func", f).__code__.co_filename for f in names.values() if is_compilable(f)}
    text = [device_module.__name__ if device_module else "", space.__name__, repr(sorted(sizes.items()))]
    text += [text_digest(file) for file in sorted(files)]
    kind = device_module.__name__.split(".")[-2] if device_module and "." in device_module.__name__ else "any"
    return f"{kind}_{hashlib.sha256(' '.join(text).encode()).hexdigest()[:16]}"


def is_compilable(value: object) -> bool:
    """Whether a name is a plain function or one of numba's."""
    return isinstance(getattr(value, "py_func", value), FunctionType)


@cache
def text_digest(file: str) -> str:
    """Of what a file says; of its name where it is none."""
    path = Path(file)
    return hashlib.sha256(path.read_bytes() if path.is_file() else file.encode()).hexdigest()
