"""`delete`: objects out of a bundle. Those that are nodes go from the graph. One that was distilled into a
field with others is cut out of it: cells of that field are emptied, and what its sources show there comes as
nodes, where they are known. No number is changed."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property

import numpy as np

from formats.bundle import PART
from formats.graph import belongs, placement_of, with_field, without
from formats.nodes import Leaf, Node
from fusedrf_cli.bridge.distilled import holders_in, inside
from fusedrf_cli.bridge.editing import SAME_BITS, Edit
from fusedrf_cli.bridge.inpainting import (
    LEARNT,
    Frame,
    Teacher,
    learnt_from,
    learnt_surfaces,
    smooth_patches,
    up_of,
)
from fusedrf_cli.bridge.rendering import renderable
from fusedrf_cli.bridge.runtime import engine
from fusedrf_cli.bridge.scene import load_fields, make_field, showing_of
from fusedrf_cli.bridge.sources import leaf_of, source_of
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.resolution_report import extent
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import enclosing, placement, seen_box
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.field_cutting import FieldCuttingConfig
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import InvalidInput
from fusedrf_cli.requests import DeleteRequest

RESTORED = "restored"
"""Nodes of what fills a cut are named `restored/...`."""
EMPTIED = "cells of the field that it was distilled into emptied, and filled by nodes; no number changes"


def delete(request: DeleteRequest, progress) -> dict:
    """Take objects out of a bundle. What an object hid in a field that it was distilled into is taken from
    the remaining sources where these are known, else from photos or left empty."""
    with engine(request.device, request.threads, progress) as device:
        edit = Edit(request, progress, device)
        draft = edit.draft
        for name in request.names:
            draft.check(name)
        if {*request.names} >= draft.names:
            raise nothing_left(request.fused, request.names)
        deletion = Deletion(edit, request.names, request.allow_outside)
        deletion.drop()
        deletion.cut(request)
        if request.refit and "photos" not in deletion.told:
            progress.warn("--refit is not needed: what the deleted objects hid is known")
        if not draft.graph.leaves():
            raise nothing_left(request.fused, request.names)
        hole = deletion.mend(request) if request.fill or not deletion.restored else None
        entry = {"names": list(request.names), "restored": deletion.restored}
        how = EMPTIED if deletion.inside else SAME_BITS
        report = edit.done("deleted", [], [], (), entry, deletion.boxes, how)
        return report | {"restored": deletion.restored, "hole": hole, "seconds": {}} | deletion.told


def nothing_left(path: str, names: Sequence[str]) -> InvalidInput:
    """The refusal of a deletion that would empty a bundle."""
    return InvalidInput(
        f"{path}: deleting {', '.join(sorted(names))} would leave nothing; keep one object, or delete "
        "the file"
    )


class Deletion:
    """Takes objects out of a draft."""

    def __init__(self, edit: Edit, names: Sequence[str], allow_outside: bool):
        self.edit, self.draft, self.allow_outside = edit, edit.draft, allow_outside
        self.names, self.progress = set(names), edit.progress
        self.inside = {name: node for name, node in self.draft.inside.items() if name in self.names}
        """Those that were distilled into a field."""
        self.unnamed = {leaf.name for leaf in holders_in(self.draft.graph)}
        """The nodes of the fields that they were distilled into."""
        self.boxes: list[np.ndarray] = []
        """(6,) in the world, each: what was touched."""
        self.restored = True
        """Whether what they hid is shown."""
        self.told: dict = {}
        """For the report."""
        self.learnt: list[tuple[Placed, str]] | None = None
        """What photos show, and the precision to store it in."""

    def drop(self) -> None:
        """Take out those that are nodes."""
        box = self.draft.box(self.names)
        self.boxes += [] if box is None else [box]
        self.draft.graph = without(self.draft.graph, self.names)

    def cut(self, request: DeleteRequest | None = None) -> None:
        """Empty the cells of those that were distilled, and fill them with what the others show there; where
        that is not known, with what a request's photos show."""
        for name, node in self.inside.items():
            self.progress.phase(f"deleting {name}", None)
            box = np.asarray(node["aabb"], np.float64)
            holders = self.holders(box)
            if not holders:
                self.boxes.append(box)
                continue
            rest = self.remaining(box)
            if rest is None and request is not None and request.refit:
                rest = self.from_photos(request, *holders[0])
            elif rest is None:
                self.progress.warn(
                    "what the deleted objects hid stays empty; --refit PHOTOS learns it from photos, --fill "
                    "goes on smoothly with what is seen around it"
                )
            self.restored &= rest is not None
            widest = max(self.empty(leaf, one, box) for leaf, one in holders)
            self.boxes.append(box + widest * np.repeat([-1.0, 1.0], 3))
            for one, precision in rest or ():
                self.fill(one, precision, box, widest)

    def holders(self, box: np.ndarray) -> list[tuple[Leaf, Placed]]:
        """The nodes that reach into a box (6,) of the world, of those of the fields that objects were
        distilled into and of what filled earlier cuts, and their fields as they are stored."""
        holders = []
        for leaf in self.draft.graph.leaves():
            if leaf.field is not None and (leaf.name in self.unnamed or belongs(leaf.name, (RESTORED,))):
                field = make_field(self.draft.fields.field(leaf.field), self.draft.path)
                one = Placed(leaf.name, field, leaf.object_to_world)
                holders += [(leaf, one)] if one.reaches(box) else []
        return holders

    def empty(self, leaf: Leaf, one: Placed, box: np.ndarray) -> float:
        """Empty the cells of a node's field that reach into a box (6,) of the world; the side of such a
        cell."""
        left = self.part(one, "restricted", lambda at: ~inside(at, box))
        precision = self.draft.fields.headers[leaf.field].precision
        member = None if left is None else self.draft.put(left, precision)
        self.draft.graph = with_field(self.draft.graph, leaf.name, member)
        return side_of(one)

    def fill(self, one: Placed, precision: str, box: np.ndarray, widest: float) -> None:
        """Add a node that shows what a field has in a box (6,) of the world, and in cells that reach into it;
        widest: the side of those that were emptied."""
        # Two cells beyond the cut: those are kept that lie wholly inside.
        part = self.part_in(one, box, widest + 2 * side_of(one))
        if part is not None:
            name = one.name if belongs(one.name, (RESTORED,)) else f"{RESTORED}/{one.name}"
            self.draft.add_node(name, part, one.object_to_world, precision)

    def part_in(self, one: Placed, box: np.ndarray, beside: float) -> StoredField | None:
        """What a field has in a box (6,) of the world, and so far beside it."""
        grown = box + beside * np.repeat([-1, 1], 3)
        part = self.part(one, "cropped", lambda at: inside(at, grown))
        return part and registry.kind(part.kind).trimmed(part)

    def part(self, one: Placed, how: str, holds: Callable[[np.ndarray], np.ndarray]) -> StoredField | None:
        """What of a field lies where `holds` says so of points (N, 3) of the world: `cropped` or `restricted`
        by its kind."""
        matrix, part_of = one.object_to_world, getattr(registry.kind(one.field.kind), how)
        try:
            return part_of(one.field, lambda at: holds(at @ matrix[:3, :3].T + matrix[:3, 3]))
        except ValueError as error:
            raise InvalidInput(f"{self.draft.path}: {error}") from error

    def remaining(self, box: np.ndarray) -> list[tuple[Placed, str]] | None:
        """The other objects that were distilled, as far as they reach into a box (6,) of the world, and the
        precisions that they are stored in: from inside the bundle or from their files. None, with a warning,
        where one of them is not found as it was."""
        left = []
        for name, node, sources in self.others:
            if not sources and (node.get("background") or boxes_overlap(np.asarray(node["aabb"]), box)):
                self.progress.warn(
                    f"the source of '{name}' is gone, has changed, or lies outside of the folder"
                )
                return None
            left += [
                (replace(one, field=opened(one.field)), precision)
                for one, precision in sources
                if one.reaches(box)
            ]
        return left

    @cached_property
    def others(self) -> list[tuple[str, dict, list[tuple[Placed, str]]]]:
        """The other objects that were distilled: their names, what the history says of them, and their
        sources and the precisions that these are stored in; no sources where they are not found."""
        draft, others = self.draft, []
        for name, node in draft.inside.items():
            if name not in self.names:
                found = source_of(node, leaf_of(node), draft.bundle, self.allow_outside)
                sources = [
                    (
                        load_fields(file.path, draft.graph, [(leaf, file, member)], None).placed[0],
                        file.headers[member].precision,
                    )
                    for leaf, file, member in found
                ]
                others.append((name, node, sources))
        return others

    def from_photos(self, request: DeleteRequest, leaf: Leaf, one: Placed) -> list[tuple[Placed, str]]:
        """What photos show, learnt once, in the frame of a node's field."""
        if self.learnt is None:
            edit, precision = self.edit, self.draft.fields.headers[leaf.field].precision
            frame = Frame(self.draft.path, self.draft.graph, one.field, one.object_to_world)
            field, self.told = learnt_from(
                request, frame, None, edit.memory, self.draft.device, self.progress
            )
            self.learnt = [(Placed(LEARNT, field, one.object_to_world), precision)]
        return self.learnt

    def mend(self, request: DeleteRequest) -> dict:
        """What the report says of the hole that is left, which is filled where that was asked for."""
        rest, origin = renderable(self.draft.after())
        at = placement(origin)
        box = seen_box(enclosing(self.boxes), at)
        surfaces, unseen = smooth_patches(rest, box, up_of(self.draft.graph, at))
        if request.fill and surfaces:
            self.progress.phase("filling", None)
            teach = Teacher(request, request.finetune, self.draft.device, self.progress, len(surfaces))
            for one in learnt_surfaces(surfaces, teach):
                self.draft.add_node(one.name, one.field, at @ one.object_to_world, self.precision)
        return {"unseen": round(unseen, 3), "filled": bool(request.fill and surfaces)}

    @property
    def precision(self) -> str:
        """In which most of the bundle's fields are stored."""
        precisions = [
            header.precision for header in self.draft.bundle.headers.values() if header.kind != PART
        ]
        return max(precisions, key=precisions.count)


def released(deletion: Deletion, name: str, new_name: str) -> Node:
    """An object that was distilled as a node of another name: with the numbers of its source where that is
    found, else with those that the field has in its box."""
    draft, entry = deletion.draft, deletion.draft.inside[name]
    leaf = replace(leaf_of(entry), name=new_name)
    own = source_of(entry, leaf, draft.bundle, deletion.allow_outside)
    nodes = []
    for part, file, member in own:
        draft.writer.copy_field(file, member)
        at = placement_of(part.object_to_world)
        nodes.append(Node(part.name, member, None, at, showing=showing_of(part)))
    if not own:
        deletion.progress.warn(
            f"the source of '{name}' is gone, has changed, or lies outside of the folder: what its box holds "
            "of the field is taken for it"
        )
        box = np.asarray(entry["aabb"], np.float64)
        for number, (holder, one) in enumerate(deletion.holders(box)):
            part = deletion.part_in(one, box, side_of(one))
            if part is not None:
                member = draft.put(part, draft.fields.headers[holder.field].precision)
                at = placement_of(one.object_to_world)
                nodes.append(Node(f"{new_name}/{number}", member, None, at, showing=showing_of(holder)))
    if not nodes:
        raise InvalidInput(f"{draft.path}: there is nothing of '{name}' in its field; delete it")
    if len(nodes) > 1:
        return Node(new_name, children=tuple(nodes))
    return replace(nodes[0], name=new_name, source_matrix=entry.get("source_matrix"))


def boxes_overlap(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether two boxes (6,) have anything in common."""
    return bool((one[:3] <= other[3:]).all() and (other[:3] <= one[3:]).all())


def side_of(one: Placed) -> float:
    """The side in the world of the cells in which a field is cropped."""
    return max(one.voxel_size, extent(one) / current(FieldCuttingConfig).cut)
