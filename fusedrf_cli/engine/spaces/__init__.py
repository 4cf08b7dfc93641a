"""Spaces: what a ray is in the coordinates that a field's numbers and its occupancy grid lie in."""

from types import ModuleType

from fusedrf_cli.engine.spaces import bounded, unbounded

SPACES = {"bounded": bounded, "unbounded": unbounded}


def space_named(name: object) -> ModuleType:
    """The space that a stored field says it lies in. Raises ValueError for another word."""
    if name not in SPACES:
        raise ValueError(f"space should be one of {', '.join(SPACES)}, found {name!r}")
    return SPACES[name]


def name_of(space: ModuleType) -> str:
    """What a stored field calls its space."""
    return next(name for name, known in SPACES.items() if known is space)
