"""`replace`: another object in the place of one in a fused field."""

import time

import numpy as np

from fusedrf_cli.bridge.deleting import check_names, joined, without_objects
from fusedrf_cli.bridge.editing import (
    Teacher,
    addition_memory,
    edit_report,
    placed_note,
    read_fused,
    write_edited,
)
from fusedrf_cli.bridge.history import graph_nodes
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.running import engine
from fusedrf_cli.bridge.scene import history_nodes, load_scene
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.errors import InvalidInput
from fusedrf_cli.requests import ReplaceRequest


def replace(request: ReplaceRequest, progress) -> dict:
    """Take an object out of a fused field, and put another one where it stood, under its name."""
    with engine(request.device, request.threads, progress) as place:
        started = time.monotonic()
        progress.phase("reading", None)
        memory = Memory(request.memory)
        fused = read_fused(request.fused, memory)
        check_names(request, fused)
        stood = {node["name"]: node for node in graph_nodes(fused.scene)}.get(request.name)
        if stood is None:
            raise InvalidInput(
                f"{request.fused}: its history does not say where '{request.name}' stands; delete it, and "
                "add the other one with a placement"
            )
        at = np.asarray(stood["object_to_world"], np.float64)
        new = load_scene(request.source, budget=memory, place=place)
        memory.expect(*addition_memory(fused.field, new), advice="put a smaller object in its place")
        edited, _ = without_objects(request, fused, {request.name}, memory, place, progress)
        if edited is None:
            raise InvalidInput(f"{request.fused}: holds nothing else; fuse {request.source} alone")
        progress.phase("adding", 1.0)
        objects = [
            Placed(request.name, opened(p.field), at @ p.object_to_world).moved(fused.origin)
            for p in new.placed
        ]
        teach = Teacher(request, request.rgb, place, progress, len(objects))
        try:
            added = fused.kind.added(edited.field, objects, teach)
        except ValueError as error:
            raise InvalidInput(f"{request.fused}: {error}") from error
        entry = {
            "event": "replaced",
            "names": [request.name],
            "nodes": [placed_note(n, at, request.name) for n in history_nodes(new, request.output, {})],
        }
        edited = joined([edited, added])
        size = write_edited(request, fused, edited.field, request.precision or fused.precision, entry)
    figures = edited.figures | {"memory": memory.report()}
    return edit_report(request, size, request.name, fused, edited, figures, started)
