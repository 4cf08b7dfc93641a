"""Spaces: what a ray is in the coordinates that a field's numbers and its occupancy grid lie in.

A space is a module; one with CONSTANTS is a module for each of their values, see `space_of`.
"""

from functools import cache
from types import FunctionType, ModuleType

from fusedrf_cli.engine.spaces import bounded, contracted_l2, contracted_linf, ndc, unbounded

SPACES = {
    "bounded": bounded,
    "unbounded": unbounded,
    "contracted_l2": contracted_l2,
    "contracted_linf": contracted_linf,
    "ndc": ndc,
}


def space_named(entry: object) -> ModuleType:
    """The space that a stored field says it lies in: a word, or an object of the word as `name` and of
    constants. Raises ValueError for anything else."""
    given = dict(entry) if isinstance(entry, dict) else {"name": entry}
    name = given.pop("name", None)
    if not isinstance(name, str) or name not in SPACES:
        raise ValueError(f"space should be one of {', '.join(SPACES)}, found {name!r}")
    limits = getattr(SPACES[name], "CONSTANTS", {})
    for constant, value in given.items():
        low, high = limits.get(constant, (1, 0))
        if type(value) not in (int, float) or not low <= value <= high:
            raise ValueError(
                f"space '{name}' has the constants {', '.join(limits) or 'none'}, in their limits; found "
                f"{constant} = {value!r}"
            )
    return space_of(SPACES[name], **{constant: float(value) for constant, value in given.items()})


def name_of(space: ModuleType) -> str | dict:
    """What a stored field calls its space: inverse of `space_named`."""
    name = next(name for name, known in SPACES.items() if known is getattr(space, "VARIANT_OF", space))
    if space is SPACES[name]:
        return name
    given = {constant: getattr(space, constant.upper()) for constant in space.CONSTANTS}
    usual = {constant: getattr(SPACES[name], constant.upper()) for constant in given}
    return {"name": name} | {constant: value for constant, value in given.items() if value != usual[constant]}


@cache
def _variant(space: ModuleType, constants: tuple[tuple[str, float], ...]) -> ModuleType:
    other = ModuleType(f"{space.__name__}{constants}")
    names = vars(other)
    names.update({n: v for n, v in vars(space).items() if not n.startswith("__")}, VARIANT_OF=space)
    for name, value in vars(space).items():
        if isinstance(value, FunctionType) and value.__module__ == space.__name__:
            names[name] = FunctionType(value.__code__, names, name, value.__defaults__)
            names[name].__module__ = space.__name__
    names.update((constant.upper(), value) for constant, value in constants)
    return other


def space_of(space: ModuleType, **constants: float) -> ModuleType:
    """A space with some of its constants, by their names in files, other than usual: one module for the same
    values."""
    values = {constant: getattr(space, constant.upper()) for constant in getattr(space, "CONSTANTS", {})}
    changed = values | constants
    return space if changed == values else _variant(space, tuple(sorted(changed.items())))
