"""Finds the kinds of field: each is a folder beside this file, or one of WAYS, or comes from another package
by an entry point of the group fusedrf.kinds, and says what it is in an object named KIND.

Names are found without importing anything, for `--help`; a kind is imported when it is used.
"""

import contextlib
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from fusedrf_cli.engine.kinds.kind import Kind

AUTO = "auto"  # the name under which a kind is chosen by what the kinds say of a scene
INSTANCES = "blocks"  # the name under which nothing is learnt: every source stays a field of its own
WAYS = {INSTANCES: f"{__package__}.instances"}
"""Ways of fusing whose fields are of other kinds, and the modules that hold them."""
IMPORTED = frozenset({"assembled", "splats"})
"""Kinds that other systems' files become; nothing is learnt as one of them."""
DEFAULT = "vm"  # what photos of an object, or meshes, become where no kind is named
SURROUNDINGS = "hash"  # what photos of surroundings become
SHARING = "dense-mlp"  # what photos of several captures become that share a decoder


class UnknownKind(ValueError):
    """No kind of that name is known."""


class BrokenKind(ValueError):
    """A plug-in's kind that cannot be used; the others can."""


@cache
def own_kinds() -> dict[str, str]:
    """Names of the kinds that come with the package, and the modules that hold them."""
    folders = sorted(path.parent.name for path in Path(__file__).parent.glob("*/__init__.py"))
    return {name.replace("_", "-"): f"{__package__}.{name}" for name in folders} | WAYS


def plugged_in() -> dict[str, EntryPoint]:
    """Names of the kinds of other packages. Where two packages offer the same name the first is taken, and a
    name of our own is never replaced."""
    by_name: dict[str, EntryPoint] = {}
    for point in entry_points(group="fusedrf.kinds"):
        if point.name not in own_kinds():
            by_name.setdefault(point.name, point)
    return by_name


def names() -> list[str]:
    """Names of all kinds, sorted; nothing is imported."""
    return sorted({*own_kinds(), *plugged_in()})


@cache
def kind(name: str) -> "Kind":
    """The kind of a name. Raises UnknownKind, or BrokenKind for a plug-in that fails to import or is no
    kind."""
    if name in own_kinds():
        return import_module(own_kinds()[name]).KIND
    point = plugged_in().get(name)
    if point is None:
        raise UnknownKind(f"unknown kind '{name}'; this version knows {', '.join(names())}")
    package = package_of(name)
    try:
        loaded = point.load()
    except Exception as error:  # whatever a stranger's module raises, the other kinds work
        raise BrokenKind(
            f"the kind '{name}' of the package '{package}' does not load "
            f"({type(error).__name__}: {error}); update or uninstall that package"
        ) from error
    from fusedrf_cli.engine.kinds.kind import Kind

    loaded = getattr(loaded, "KIND", loaded)
    if not isinstance(loaded, Kind) or loaded.name != name:
        raise BrokenKind(
            f"the kind '{name}' of the package '{package}' is no Kind of that name; update or uninstall "
            "that package"
        )
    return loaded


def package_of(name: str) -> str:
    """The package that a kind comes from."""
    point = plugged_in().get(name)
    if point is None:
        return __package__.partition("_")[0]
    return point.dist.name if point.dist else point.value


def kinds() -> "list[Kind]":
    """All kinds that load; a plug-in that does not is left out."""
    usable = []
    for name in names():
        with contextlib.suppress(BrokenKind):
            usable.append(kind(name))
    return usable
