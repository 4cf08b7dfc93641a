"""Edits of objects in a bundle's scene graph: put in, placed, copied, named and shown otherwise. One that was
distilled into a field with others becomes a node first, with the numbers of its source if that is found."""

import numpy as np

from formats.bundle import read_summary
from formats.graph import changed, chosen, cropped_as, moved, renamed, shown, with_nodes
from formats.scene import Node
from fusedrf_cli.bridge.deleting import EMPTIED, Deletion, released
from fusedrf_cli.bridge.editing import SAME_BITS, Edit, brought
from fusedrf_cli.bridge.runtime import engine
from fusedrf_cli.errors import InvalidInput
from fusedrf_cli.placement import lying_note
from fusedrf_cli.requests import AddRequest, ArrangeRequest, ShowRequest


def add(request: AddRequest, progress) -> dict:
    """Put one more object into a bundle, as a node that is placed."""
    with engine("cpu", None, progress):
        edit = Edit(request, progress)
        draft = edit.draft
        draft.check_free(request.name)
        node = brought(draft, request, request.name, request.object_to_world)
        if draft.graph.up is None:
            note = lying_note(request.source, read_summary(request.source)["up"], node.node_to_parent)
            if note is not None:
                progress.warn(note)
        draft.graph = with_nodes(draft.graph, [node])
        return edit.done("added", [request.name], [node])


def move(request: ArrangeRequest, progress) -> dict:
    """Place an object anew: scaled and turned about the middle of its box, then moved."""
    return arrange(request, "moved", progress)


def duplicate(request: ArrangeRequest, progress) -> dict:
    """Put a copy of an object beside it, which places the same field."""
    return arrange(request, "duplicated", progress)


def rename(request: ArrangeRequest, progress) -> dict:
    """Give an object another name."""
    return arrange(request, "renamed", progress)


def arrange(request: ArrangeRequest, event: str, progress) -> dict:
    """Do one of the three."""
    with engine("cpu", None, progress):
        edit = Edit(request, progress)
        draft, name, new_name = edit.draft, request.name, request.new_name or request.name
        draft.check(name)
        if request.new_name is not None:
            draft.check_free(request.new_name)
        matrix, copies = request.object_to_world, event == "duplicated"
        if not request.absolute and not np.array_equal(matrix[:3, :3], np.eye(3)):
            box = draft.box({name})
            if box is None:
                raise InvalidInput(f"{request.fused}: '{name}' is hidden, and has no middle; give --matrix")
            matrix = about(matrix, (box[:3] + box[3:]) / 2)
        still = np.array_equal(matrix, np.eye(4))
        if name in draft.inside:
            if event == "renamed" and still:
                return renamed_inside(edit, name, new_name)
            freed = as_node(edit, name, new_name, copies)

            def placed(node: Node, parent: np.ndarray) -> tuple[Node, ...]:
                return (node if still else moved(node, parent, matrix),)

            draft.graph = changed(draft.graph, {new_name}, placed)
            return edit.done(event, [new_name], chosen(draft.graph, {new_name}), **freed)

        def arranged(node: Node, parent: np.ndarray) -> tuple[Node, ...]:
            one = node if still else moved(node, parent, matrix)
            one = renamed(one, name, new_name, copies) if new_name != name else one
            return (node, one) if copies else (one,)

        draft.graph = changed(draft.graph, {name}, arranged)
        before = () if copies else (name,)
        renamed_from = {"names": [name]} if event == "renamed" else {}
        return edit.done(event, [new_name], chosen(draft.graph, {new_name}), before, renamed_from)


def show(request: ShowRequest, progress) -> dict:
    """Show an object otherwise: cropped, tinted, or thinner."""
    with engine("cpu", None, progress):
        edit = Edit(request, progress)
        draft, name = edit.draft, request.name
        draft.check(name)
        freed = as_node(edit, name, name, False) if name in draft.inside else {}
        names = {node.name for node, _, _ in draft.graph.walk()}

        def shown_as(node: Node, parent: np.ndarray) -> tuple[Node, ...]:
            if "crop" in request.showing:
                return (cropped_as(node, request.showing["crop"], names),)
            return (shown(node, request.showing),)

        draft.graph = changed(draft.graph, {name}, shown_as)
        return edit.done(request.event, [name], chosen(draft.graph, {name}), **freed)


def as_node(edit: Edit, name: str, new_name: str, copies: bool) -> dict:
    """Let an object that was distilled be a node, and what it hid be shown where that is known; a copy leaves
    it where it is. Words of `Edit.done`."""
    deletion = Deletion(edit, (name,), False)
    node = released(deletion, name, new_name)
    if not copies:
        deletion.cut()
    edit.draft.graph = with_nodes(edit.draft.graph, [node])
    if copies:
        return {"how": SAME_BITS}
    return {
        "entry": {"names": [name], "restored": deletion.restored},
        "boxes": deletion.boxes,
        "how": EMPTIED,
    }


def renamed_inside(edit: Edit, name: str, new_name: str) -> dict:
    """Give an object that was distilled another name, which stands in the history alone."""
    node = edit.draft.inside[name] | {"name": new_name}
    entry = {"names": [name], "nodes": [node]}
    return edit.done("renamed", [], [], (), entry, [np.asarray(node["aabb"])])


def about(matrix: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(4, 4) that scales and turns about a point (3,) as `matrix` does about the origin, and then moves."""
    moved = matrix.copy()
    moved[:3, 3] += centre - matrix[:3, :3] @ centre
    return moved
