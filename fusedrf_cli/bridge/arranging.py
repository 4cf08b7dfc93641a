"""`move`, `duplicate` and `rename`: objects that a fused field holds apart, placed or named anew. No number
of the field changes, and nothing is learnt."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fusedrf_cli.bridge.editing import Fused, edit_report, placed_note, read_fused, write_edited
from fusedrf_cli.bridge.history import graph_nodes
from fusedrf_cli.bridge.memory import Memory, ownership
from fusedrf_cli.bridge.running import engine
from fusedrf_cli.engine.fields.occupancy import placed_box, placement, seen_change
from fusedrf_cli.engine.kinds.editing import Edited, Part, enclosing
from fusedrf_cli.errors import InvalidInput
from fusedrf_cli.requests import ArrangeRequest

Arranged = list[tuple[str, np.ndarray]]


@dataclass(frozen=True)
class Change:
    """What becomes of one object."""

    event: str
    """Of the history."""
    name: str
    """Of the object afterwards, or of its copy."""
    keeps: bool
    """Whether the object stays what it was, and the change is a copy of it."""
    matrix: np.ndarray
    """(4, 4) of the world: applied to where the object stands."""


def move(request: ArrangeRequest, progress) -> dict:
    """Place an object anew: scaled and turned about the middle of its box, then moved."""
    return arrange(request, "moved", progress)


def duplicate(request: ArrangeRequest, progress) -> dict:
    """Put a copy of an object beside it, which shares its numbers."""
    return arrange(request, "duplicated", progress)


def rename(request: ArrangeRequest, progress) -> dict:
    """Give an object another name."""
    return arrange(request, "renamed", progress)


def arrange(request: ArrangeRequest, event: str, progress) -> dict:
    """Do one of the three, and write the bundle with one more entry of history."""
    with engine("cpu", None, progress):
        started = time.monotonic()
        progress.phase("reading", None)
        memory = Memory(request.memory)
        fused = read_fused(request.fused, memory)
        memory.expect(ownership(fused.field.occupancy.aabb), advice="edit a smaller field")
        parts = [part for part in fused.kind.parts(fused.field) if part.belongs({request.name})]
        check(request, fused, parts)
        box = placed_box(enclosing([part.box for part in parts]), fused.origin)
        matrix = request.object_to_world
        matrix = matrix if request.absolute else about(matrix, (box[:3] + box[3:]) / 2)
        change = Change(event, request.new_name or request.name, event == "duplicated", matrix)
        progress.phase(event, None)
        origin = placement(fused.origin)
        arranged = becoming(request.name, change, seen_change(matrix, origin))
        try:
            field = fused.kind.arranged(fused.field, arranged)
        except ValueError as error:
            raise InvalidInput(f"{request.fused}: {error}") from error
        after = [part for part in fused.kind.parts(field) if part.belongs({change.name})]
        size = write_edited(request, fused, field, fused.precision, entry_of(request, fused, change))
        touched = enclosing([part.box for part in [*after, *([] if change.keeps else parts)]])
        edited = Edited(field, touched, f"{event}, with the numbers that it had")
    return edit_report(request, size, change.name, fused, edited, {"memory": memory.report()}, started)


def check(request: ArrangeRequest, fused: Fused, parts: list[Part]) -> None:
    """InvalidInput where the object is not there or not held apart, or its new name is taken."""
    if not parts and request.name in fused.names:
        raise InvalidInput(
            f"{request.fused}: '{request.name}' is not held apart in its field of kind '{fused.kind.name}'; "
            "fuse the scene with --kind blocks, or delete the object and add it again"
        )
    if not parts:
        raise InvalidInput(
            f"{request.fused}: there is no '{request.name}'; it holds "
            f"{', '.join(sorted(fused.names)) or 'nothing that has a name'}"
        )
    if request.new_name is not None and request.new_name in fused.names:
        raise InvalidInput(f"{request.fused}: there is a '{request.new_name}' already; choose another name")


def about(matrix: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(4, 4) that scales and turns about a point (3,) as `matrix` does about the origin, and then moves."""
    found = matrix.copy()
    found[:3, 3] += centre - matrix[:3, :3] @ centre
    return found


def becoming(name: str, change: Change, matrix: np.ndarray) -> Callable[[str, np.ndarray], Arranged]:
    """What each part of a field becomes (`Kind.arranged`); matrix (4, 4) is the change's in the field's
    frame."""

    def parts(part: str, at: np.ndarray) -> Arranged:
        if part != name and not part.startswith(f"{name}/"):
            return [(part, at)]
        changed = (change.name + part.removeprefix(name), matrix @ at)
        return [(part, at), changed] if change.keeps else [changed]

    return parts


def entry_of(request: ArrangeRequest, fused: Fused, change: Change) -> dict:
    """The entry of history: the object as it stands now and is called, where the history tells of it."""
    nodes = [
        placed_note(node, change.matrix, change.name)
        for node in graph_nodes(fused.scene)
        if node["name"] == request.name
    ]
    entry = {"event": change.event, "nodes": nodes}
    gone = change.name != request.name and not change.keeps
    return entry | ({"names": [request.name]} if gone else {})
