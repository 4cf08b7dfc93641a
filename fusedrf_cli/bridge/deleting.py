"""`delete`: objects out of a fused field, and what they hid in their place where it is known."""

import os
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from formats.records import FieldRecord
from fusedrf_cli.bridge.anew import unchanged
from fusedrf_cli.bridge.editing import Fused, Teacher, edit_report, read_fused, write_edited
from fusedrf_cli.bridge.history import graph_nodes
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.mending import hole_of, learnt_from, put_in, up_of
from fusedrf_cli.bridge.running import engine
from fusedrf_cli.bridge.scene import make_field
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields.occupancy import seen_box
from fusedrf_cli.engine.kinds.editing import Edited, enclosing
from fusedrf_cli.errors import InvalidInput
from fusedrf_cli.requests import DeleteRequest


def delete(request: DeleteRequest, progress) -> dict:
    """Take objects out of a fused field: those that it holds apart are dropped; the region of another is
    emptied or learnt again.

    What an object hid is taken from the remaining sources where these are known, else left empty. Without a
    precision the field keeps its own.
    """
    with engine(request.device, request.threads, progress) as place:
        started = time.monotonic()
        progress.phase("reading", None)
        memory = Memory(request.memory)
        fused = read_fused(request.fused, memory)
        names = set(request.names)
        check_names(request, fused)
        edited, restored = without_objects(request, fused, names, memory, place, progress)
        if edited is None:
            raise nothing_left(request)
        hole = None
        if request.fill or not restored:
            edited, hole = with_hole(request, fused, edited, place, progress)
        entry = {"event": "deleted", "names": list(request.names), "restored": restored}
        size = write_edited(request, fused, edited.field, request.precision or fused.precision, entry)
    figures = (
        {"restored": restored, "hole": hole, "seconds": {}} | edited.figures | {"memory": memory.report()}
    )
    return edit_report(request, size, ", ".join(request.names), fused, edited, figures, started)


def without_objects(
    request: DeleteRequest, fused: Fused, names: set[str], memory: Memory, place: str, progress
) -> tuple[Edited | None, bool]:
    """The field without some objects, None where nothing is left; and whether what they hid is shown."""
    kind, field, told = fused.kind, fused.field, {}
    apart = [part for part in kind.parts(field) if part.belongs(names)]
    edits: list[Edited] = []
    if apart:
        field = kind.without(field, names)
        if field is None:
            return None, True
        how = "taken out, since it was held apart"
        edits.append(Edited(field, enclosing([part.box for part in apart]), how))
    inside = [
        node
        for node in graph_nodes(fused.scene)
        if node["name"] in names and not any(part.belongs({node["name"]}) for part in apart)
    ]
    teach = Teacher(request, request.rgb, place, progress, len(inside))
    rest = remaining(request, fused, place, progress) if inside else None
    if inside and rest is None and request.refit:
        learnt, told = learnt_from(request, fused, None, memory, place, progress)
        rest = [Placed(request.refit, learnt, np.eye(4))]
    if inside and rest is None:
        progress.warn(
            "what the deleted objects hid stays empty; --refit PHOTOS learns it from photos, --fill goes on "
            "smoothly with what is seen around it"
        )
    if request.refit and "photos" not in told:
        progress.warn("--refit is not needed: what the deleted objects hid is known")
    restored = rest is not None or not inside
    for node in inside:
        progress.phase(f"deleting {node['name']}", 1.0)
        box = seen_box(np.asarray(node["aabb"], np.float64), fused.origin)
        edited = kind.refilled(field, box, rest, teach)
        if edited is None:
            return None, restored
        field = edited.field
        edits.append(edited)
    edited = joined(edits)
    return replace(edited, figures=edited.figures | told), restored


def with_hole(
    request: DeleteRequest, fused: Fused, edited: Edited, place: str, progress
) -> tuple[Edited, dict]:
    """What is left, with the hole filled where that was asked for, and what the report says of it."""
    surfaces, unseen = hole_of(edited.field, edited.box, up_of(fused))
    filled = bool(request.fill and surfaces)
    if filled:
        progress.phase("filling", None)
        teach = Teacher(request, request.rgb, place, progress, len(surfaces))
        edited = replace(edited, field=put_in(fused, edited.field, surfaces, teach))
    return edited, {"unseen": round(unseen, 3), "filled": filled}


def joined(edits: list[Edited]) -> Edited:
    """One edit that tells of several, one after the other."""
    figures = {}
    for edit in edits:
        figures |= edit.figures
    how = "; ".join(dict.fromkeys(edit.how for edit in edits))
    box, local = enclosing([edit.box for edit in edits]), all(edit.local for edit in edits)
    return Edited(edits[-1].field, box, how, local, figures)


def check_names(request: DeleteRequest, fused: Fused) -> None:
    """InvalidInput for a name that is not there, or where all of them are to go."""
    for name in request.names:
        if name not in fused.names:
            raise InvalidInput(
                f"{request.fused}: there is no '{name}'; it holds "
                f"{', '.join(sorted(fused.names)) or 'nothing that has a name'}"
            )
    if set(request.names) == fused.names:
        raise nothing_left(request)


def nothing_left(request: DeleteRequest) -> InvalidInput:
    """The refusal of a deletion that would empty the field."""
    return InvalidInput(
        f"{request.fused}: deleting {', '.join(sorted(request.names))} would leave nothing; keep one object, "
        "or delete the file"
    )


def remaining(request: DeleteRequest, fused: Fused, place: str, progress) -> list[Placed] | None:
    """The other objects of the graph as placed fields, from inside the bundle or from their files; None, with
    a warning, where one of them is not found as it was."""
    found, path = [], Path(fused.path)
    for node in graph_nodes(fused.scene):
        name = node["name"]
        if name in request.names:
            continue
        if node["field"] in fused.others:
            record = fused.bundle.field(node["field"])
        else:
            record = record_from_file(node, path, request.allow_outside)
        if record is None:
            progress.warn(f"the source of '{name}' is gone, has changed, or lies outside of the folder")
            return None
        field = make_field(record, name).to(place)
        placed = Placed(name, field, np.asarray(node["object_to_world"], np.float64))
        found.append(placed.moved(fused.origin))
    return found


def record_from_file(node: dict, path: Path, allow_outside: bool) -> FieldRecord | None:
    """A source's field from the file the history names, if it is still there, unchanged, and may be read."""
    source = (path.resolve().parent / node.get("source", "")).resolve()
    inside = source.is_relative_to(path.resolve().parent)
    if (
        "source" not in node
        or not os.path.isfile(source)
        or not (inside or allow_outside)
        or (bundle := unchanged(source, node["sha256"])) is None
    ):
        return None
    return bundle.field(node["field"]) if node["field"] in bundle.headers else None
