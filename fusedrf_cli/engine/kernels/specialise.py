"""Templates and scalar functions over one namespace per (kind, sizes, space): one set of loops for all.

A function that is to call others by name gets the same code over another dictionary of globals, in which the
names mean this kind's functions and this field's sizes. Closures would do as well, but numba compiles what
captures functions again in every process.
"""

import dis
import hashlib
import sys
from collections.abc import Callable
from functools import cache
from pathlib import Path
from types import BuiltinFunctionType, CodeType, FunctionType, ModuleType

from numba import get_num_threads, njit
from numba.core.dispatcher import Dispatcher

from fusedrf_cli.engine.kernels import ahead, instances, learning, light, loops, primitives
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
            compile_into(names, {name: getattr(loops, name) for name in (f"{loop_name}_task", loop_name)})
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
    digests = compile_into(names, functions)
    kind = device_module.__name__.split(".")[-2] if device_module and "." in device_module.__name__ else "any"
    return f"{kind}_{digest(*sorted(digests.values()))}", names


def compile_into(names: dict, functions: dict[str, FunctionType], roles: dict = ROLES) -> dict[str, str]:
    """Put functions into a namespace as numba's, and return their digests by name."""
    meanings = Meanings(names, functions)
    digests = {name: meanings.of(name) for name in functions}
    for name, function in functions.items():
        names[name] = compiled(roles.get(name, inlined), function, names, digests[name])
    return digests


def namespace(device_module: ModuleType | None, space: ModuleType) -> tuple[dict, dict[str, FunctionType]]:
    """What the names mean before anything is compiled, and which of them are plain functions to compile."""
    own = [device_module] if device_module else []
    modules = [loops, ahead, learning, instances, light, *bases_of(space), space, *own]
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


made: dict[tuple, Dispatcher] = {}
"""By role, name and meaning."""


def compiled(role: Callable, function: FunctionType, names: dict, tag: str) -> Dispatcher:
    """A function of a namespace as numba's, made once for all namespaces in which it means the same."""
    key = role, function.__name__, tag
    if key not in made:
        made[key] = role(rebound(function, names, tag))
    return made[key]


class Meanings:
    """What the functions of a namespace do, each with all that it calls and reads: a digest by name. Numba
    looks for changes only in the file of a loop, not of what it inlines."""

    def __init__(self, names: dict, functions: dict[str, FunctionType]):
        self.names, self.functions, self.known = names, functions, {}

    def of(self, name: str) -> str:
        """The digest of what a global name of these functions means; one that is not here is Python's."""
        if name not in self.known:
            if name in self.functions:
                self.known[name] = self.of_function(self.functions[name])
            else:
                self.known[name] = meaning(self.names[name]) if name in self.names else digest(name)
        return self.known[name]

    def of_function(self, function: FunctionType) -> str:
        """The digest of a function's code and of what its names mean."""
        text, used = code_text(function.__code__)
        return digest(text, repr(function.__defaults__), *map(self.of, used))


@cache
def code_text(code: CodeType) -> tuple[str, tuple[str, ...]]:
    """What code does but for the global names in it, and these in the order of their use."""
    used = tuple(dict.fromkeys(i.argval for i in dis.get_instructions(code) if i.opname == "LOAD_GLOBAL"))
    places = {name: f"global {place}" for place, name in enumerate(used)}
    names = [places.get(name, name) for name in code.co_names]
    return repr((code.co_code, code.co_consts, names, code.co_varnames, code.co_argcount)), used


def meaning(value: object) -> str:
    """The digest of what is no function of a namespace: of a function, of its file's text and its name."""
    function = getattr(value, "py_func", value)
    if isinstance(function, FunctionType):
        return digest(text_digest(function.__code__.co_filename), function.__qualname__)
    if isinstance(value, ModuleType):
        return digest(value.__name__)
    if isinstance(value, type | BuiltinFunctionType):
        return digest(repr(value), repr(getattr(value, "_fields", "")))
    definition = getattr(value, "_defn", None)  # numba's intrinsics
    return digest(repr(value)) if definition is None else meaning(definition)


def digest(*texts: str) -> str:
    """One digest of several texts."""
    return hashlib.sha256("\0".join(texts).encode()).hexdigest()[:16]


@cache
def text_digest(file: str) -> str:
    """Of what a file says; of its name where it is none."""
    path = Path(file)
    return hashlib.sha256(path.read_bytes() if path.is_file() else file.encode()).hexdigest()
