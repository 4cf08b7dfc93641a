"""`replace`: another object in the place of one."""

import numpy as np

from formats.graph import changed, chosen, moved, with_nodes
from formats.nodes import source_placement
from formats.scene import Node
from fusedrf_cli.bridge.deleting import EMPTIED, Deletion
from fusedrf_cli.bridge.editing import Edit, brought
from fusedrf_cli.bridge.runtime import engine
from fusedrf_cli.errors import InvalidInput
from fusedrf_cli.requests import ReplaceRequest


def replace(request: ReplaceRequest, progress) -> dict:
    """Put another object where one stood, under its name."""
    with engine("cpu", None, progress):
        edit = Edit(request, progress)
        draft, name = edit.draft, request.name
        draft.check(name)
        if name in draft.inside:
            return instead_of_distilled(edit, request)
        if len(chosen(draft.graph, {name})) != 1:
            raise InvalidInput(f"{request.fused}: '{name}' is several nodes; replace them one by one")

        def standing(node: Node, parent: np.ndarray) -> tuple[Node, ...]:
            new = brought(draft, request, name, np.eye(4), node.background)
            return (moved(new, np.eye(4), node.source_to_parent),)

        draft.graph = changed(draft.graph, {name}, standing)
        return edit.done("replaced", [name], chosen(draft.graph, {name}), (name,))


def instead_of_distilled(edit: Edit, request: ReplaceRequest) -> dict:
    """Cut an object out of the field that it was distilled into, and put the other one where it stood."""
    draft, name = edit.draft, request.name
    entry = draft.inside[name]
    at = source_placement(np.asarray(entry["object_to_world"], np.float64), entry.get("source_matrix"))
    deletion = Deletion(edit, (name,), request.allow_outside)
    deletion.cut()
    node = brought(draft, request, name, at)
    draft.graph = with_nodes(draft.graph, [node])
    entry = {"names": [name], "restored": deletion.restored}
    return edit.done("replaced", [name], [node], (), entry, deletion.boxes, EMPTIED)
