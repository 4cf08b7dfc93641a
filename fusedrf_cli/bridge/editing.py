"""A bundle that is being edited: its scene graph, and the fields that come to those it has, which keep their
bytes."""

import os
import time
from collections.abc import Container, Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path

import numpy as np

from formats.blocks import UNNAMED
from formats.bundle import BundleWriter, FieldSet, OpenBundle, is_bundle
from formats.embedding import Embedding, as_one
from formats.graph import (
    belongs,
    chosen,
    free_name,
    leaf_names,
    placement_of,
    with_nodes,
)
from formats.history import check_history, distilled, summed_up
from formats.records import FieldRecord
from formats.scene import Node, SceneGraph
from formats.undo import before, chain, history_folder, keep
from fusedrf_cli import __version__
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.runtime import written_somewhere
from fusedrf_cli.bridge.scene import LoadedScene, load_bundle, outlines
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import enclosing
from fusedrf_cli.engine.fields.streamed import StreamedField
from fusedrf_cli.errors import InvalidInput
from fusedrf_cli.requests import (
    AddRequest,
    EditRequest,
    Learning,
    ReplaceRequest,
)

PLACED = "added", "moved", "duplicated"
"""Edits that put an object where none was."""
SAME_BITS = "an edit of the scene graph: all fields keep their bits"


class Draft:
    """A bundle that is being edited: its graph as it is to be, and the fields that come to those it has."""

    def __init__(self, path: str, memory: Memory | None = None, device: str = "cpu"):
        """InvalidInput where there is no bundle at the path, BadSchema where its history is malformed."""
        if not is_bundle(path):
            raise InvalidInput(f"{path}: not a bundle; fuse the scene to a .rfpack first")
        self.path, self.memory, self.device = path, memory, device
        self.bundle = OpenBundle(path)
        check_history(self.bundle.scene, path)
        self.graph, self.writer = self.bundle.scene, BundleWriter()
        self.outlined: dict[str, StreamedField] = {}

    @property
    def fields(self) -> FieldSet:
        """The fields that it has, and those that come."""
        return self.bundle.with_fields(self.writer.members)

    def after(self) -> LoadedScene:
        """The scene as it is to be, with all its fields read."""
        return load_bundle(self.fields, self.graph, self.memory, self.device)

    def box_in(self, graph: SceneGraph, names: Container[str] | None = None) -> np.ndarray | None:
        """(6,) in the world around what leaves of such names show, None: all, of a graph over these fields;
        None where that is nothing. Headers and grids tell it."""
        placed = outlines(self.fields, graph, self.memory, self.outlined)
        boxes = [one.aabb for one in placed if names is None or belongs(one.name, names)]
        return enclosing(boxes) if boxes else None

    def put(self, field: StoredField, precision: str) -> str:
        """The member that a field is stored as."""
        return self.writer.add_field(FieldRecord(field.kind, *field.state()), precision)

    def add_node(self, name: str, field: StoredField, object_to_world: np.ndarray, precision: str) -> None:
        """One more node, placed by a (4, 4), of such a name, with a number where it is taken."""
        free = free_name(name, {node.name for node, _, _ in self.graph.walk()})
        node = Node(free, self.put(field, precision), None, placement_of(object_to_world))
        self.graph = with_nodes(self.graph, [node])

    @cached_property
    def inside(self) -> dict[str, dict]:
        """The objects that were distilled into one field, by name, as the history tells of them."""
        return distilled(self.bundle.scene.history)

    @property
    def names(self) -> set[str]:
        """Of all objects."""
        nodes = {node.name for node, _, _ in self.graph.walk()}
        if self.inside:
            nodes = {name for name in nodes if not belongs(name, UNNAMED)}
        return nodes | self.inside.keys()

    def check(self, name: str) -> None:
        """InvalidInput where there is no object of a name."""
        if not any(belongs(one, {name}) for one in self.names):
            raise InvalidInput(
                f"{self.path}: there is no '{name}'; it holds "
                f"{', '.join(sorted(self.names)) or 'nothing that has a name'}"
            )

    def check_free(self, name: str) -> None:
        """InvalidInput where an object has a name already."""
        if name in self.names:
            raise InvalidInput(
                f"{self.path}: there is a '{name}' already; choose another name, or rename or delete that one"
            )

    def box(self, names: Iterable[str]) -> np.ndarray | None:
        """(6,) in the world around objects as they were; None where none of them is visible."""
        names = set(names)
        boxes = [np.asarray(self.inside[name]["aabb"]) for name in names & self.inside.keys()]
        nodes = chosen(self.bundle.scene, names - self.inside.keys())
        around = self.box_in(self.bundle.scene, leaf_names(nodes)) if nodes else None
        boxes += [] if around is None else [around]
        return enclosing(boxes) if boxes else None

    @cached_property
    def framing(self) -> tuple[float, ...] | None:
        """(6,) the box in the world that pictures show, before the edit and after it; None where they are
        taken from a capture's cameras."""
        scene = self.bundle.scene
        if scene.framing is not None or (scene.cameras or {}).get("surroundings"):
            return scene.framing
        return tuple(self.box_in(scene).tolist())

    def write(self, request: EditRequest, entry: dict, learnt: bool = False) -> int:
        """Write the bundle with one more entry of history; the bytes written. learnt: it took long."""
        if request.undoable:
            entry = entry | {"before": keep(self.path, request.output)}
        used = {leaf.field for leaf in self.graph.leaves()}
        was = {leaf.field for leaf in self.bundle.scene.leaves()}
        for member in self.bundle.headers:  # what no node places was kept for the history
            if member in used or member not in was:
                self.writer.copy_field(self.bundle, member)
        framing = self.framing
        history = summed_up((*self.graph.history, entry), used)
        generator = f"fusedrf {__version__}"
        graph = replace(self.graph, history=history, framing=framing, generator=generator)

        def write(output: str) -> int:
            self.writer.write(output, graph, overwrite=request.overwrite)
            return Path(output).stat().st_size

        return written_somewhere(request.output, write) if learnt else write(request.output)


# -- edits ---------------------------------------------------------------------------------------------------


class Edit:
    """One edit, from reading to its report."""

    def __init__(self, request: EditRequest, progress, device: str = "cpu"):
        self.started, self.request, self.progress = time.monotonic(), request, progress
        progress.phase("reading", None)
        self.memory = Memory(request.memory)
        self.draft = Draft(request.fused, self.memory, device)
        copied = {"fields of a bundle of an earlier version": self.draft.bundle.copied}
        self.memory.expect(copied, advice="allow more by --memory")
        in_place = os.path.realpath(request.fused) == os.path.realpath(request.output)
        undoable = before(self.draft.bundle.scene) is not None
        if undoable and in_place and not request.undoable:
            kept = len(chain(history_folder(request.fused), request.fused))
            earlier = f"neither this edit nor the {kept} before it can be undone"
            progress.warn(f"{request.fused}: without --undoable {earlier}")

    def done(
        self,
        event: str,
        objects: list[str],
        nodes: Sequence[Node],
        before: Sequence[str] = (),
        entry: dict | None = None,
        boxes: Sequence[np.ndarray] = (),
        how: str = SAME_BITS,
    ) -> dict:
        """Write the bundle, whose history tells of what was done to objects, and report it. What was touched
        are nodes as they are now, others, by name, as they were, and boxes (6,) in the world."""
        draft, entry, boxes = self.draft, entry or {}, list(boxes)
        placements = [
            draft.box_in(draft.graph, leaf_names(nodes)) if nodes else None,
            draft.box(before) if before else None,
        ]
        boxes += [box for box in placements if box is not None]
        if event in PLACED:
            self.warn_outside(objects, placements[0])
        entry = {"event": event} | ({"objects": objects} if objects else {}) | entry
        size = draft.write(self.request, entry, isinstance(self.request, Learning))
        names = objects or entry.get("names", [])
        return self.report(size, names, enclosing(boxes) if boxes else None, how)

    def warn_outside(self, objects: Sequence[str], box: np.ndarray | None) -> None:
        """A warning where objects in a box (6,) of the world will not be seen, since pictures stay as they
        were."""
        framing = self.draft.framing
        if framing is None or box is None:
            return
        middle, low, high = (box[:3] + box[3:]) / 2, *np.split(np.asarray(framing), 2)
        if np.linalg.norm(2 * middle - low - high) > np.linalg.norm(high - low):  # pictures show a ball
            self.progress.warn(
                f"{', '.join(objects)} lies outside of what pictures show, which stay as they were; "
                f"`render --look-at {','.join(f'{x:.4g}' for x in middle)}` shows it"
            )

    def report(self, size: int, names: Iterable[str], box: np.ndarray | None, how: str) -> dict:
        """The report of an edit that touched a box (6,) of the world."""
        request = self.request
        return {
            "output": request.output,
            "bytes": size,
            "source_bytes": self.draft.bundle.size,
            "touched": {
                "names": ", ".join(names),
                "aabb": None if box is None else box.tolist(),
                "nodes": len(self.draft.graph.leaves()),
                "how": how,
            },
            "total_seconds": time.monotonic() - self.started,
            "memory": self.memory.report(),
        }


def brought(
    draft: Draft,
    request: AddRequest | ReplaceRequest,
    name: str,
    matrix: np.ndarray,
    background: bool = False,
) -> Node:
    """The scene of a request's source as a node of a draft, placed by a (4, 4). Its fields are read, so that
    none comes that is malformed. InvalidInput where it cannot be one."""
    source = request.source
    embedding = Embedding(draft.writer, precision=request.precision)
    scene = embedding.scene(source)
    node = as_one(scene, name, matrix, draft.graph.composition, background)
    if not leaf_names([node]):
        raise InvalidInput(f"{source}: it holds no field; choose another source")
    alone = replace(draft.graph, nodes=(node,))
    if any(leaf.visible for leaf in alone.leaves()):
        load_bundle(draft.fields, alone, draft.memory)
    return node
