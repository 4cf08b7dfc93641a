"""Bundles of an object that was cut out, and of what is left without it, before they are written."""

from collections.abc import Container, Sequence
from copy import copy
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from formats.bundle import BundleWriter, FieldSet, OpenBundle
from formats.embedding import as_one
from formats.graph import free_name, lifted, placement_of, renamed, with_leaves, with_nodes
from formats.history import summed_up
from formats.records import BITS, FieldRecord
from formats.scene import Leaf, Node, SceneGraph, dump_scene
from fusedrf_cli import __version__
from fusedrf_cli.bridge.cutting import Fields, Whole
from fusedrf_cli.bridge.field_bundle import stored
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import placement
from fusedrf_cli.engine.kinds import registry


class Cutout:
    """Nodes of a bundle with parts of their fields: a graph, and the bytes that it names."""

    def __init__(
        self, whole: Whole, fields: Fields, hidden: Container[str], precision: str | None, rounded: bool
    ):
        """fields: by the names of visible nodes; those of the bundle keep their bytes. hidden: which nodes
        that are not visible are in it. precision: of all numbers; None: a part is stored as its node's field,
        or, where that would round its numbers once more and they may not be `rounded`, in float16."""
        self.whole, self.precision, self.rounded = whole, precision, rounded
        self.writer = BundleWriter()
        members = {
            leaf.name: self.member(leaf, placed, fields.get(leaf.name)) for leaf, placed in whole.nodes
        }

        def after(node: Node) -> Node | None:
            if node.name not in members and node.name in hidden:
                members[node.name] = self.copied(node.field)
            member = members.get(node.name)
            return None if member is None else replace(node, field=member)

        self.graph = with_leaves(whole.scene, after)

    def member(self, leaf: Leaf, placed: Placed, part: StoredField | None) -> str | None:
        """What a part of a node's field is stored as; None of what shows nothing."""
        bundle = self.whole.draft.bundle
        if part is self.whole.raw[leaf.name]:
            return self.copied(leaf.field)
        if part is None or not placed.crops.cells_of(part.occupancy).occupied.any():
            return None
        part = registry.kind(part.kind).trimmed(part)
        precision = self.precision or bundle.headers[leaf.field].precision
        if self.precision is None and not self.rounded and precision in BITS:
            same = torch.equal(stored(part, precision).params, part.params)
            precision = precision if same else "float16"
        return self.put(part, precision)

    def copied(self, member: str) -> str:
        """A member of the bundle, byte for byte but where another precision was asked for."""
        bundle = self.whole.draft.bundle
        if self.precision is not None:
            return self.writer.add_field(bundle.field(member), self.precision)
        return self.writer.copy_field(bundle, member)

    def put(self, field: StoredField, precision: str) -> str:
        """A field as a member."""
        return self.writer.add_field(FieldRecord(field.kind, *field.state()), precision)

    @property
    def size(self) -> int:
        """Bytes of its fields and of its graph."""
        return sum(map(len, self.writer.members.values())) + len(dump_scene(self.graph))

    def alone(self) -> "Cutout":
        """The same nodes without a history and what it needs."""
        other = copy(self)
        other.writer, placed = BundleWriter(), {leaf.field for leaf in self.graph.leaves()}
        other.graph = replace(self.graph, history=(), extras={})
        for member in placed:
            other.writer.copy_field(self.fields, member)
        return other

    def take(self, smaller: OpenBundle) -> None:
        """Have the nodes of another bundle, which shows the same, in place of its own."""
        for leaf in self.graph.leaves():
            self.writer.members.pop(leaf.field, None)
        for leaf in smaller.scene.leaves():
            self.writer.copy_field(smaller, leaf.field)
        nodes, own = smaller.scene.nodes, self.graph.nodes
        if len(nodes) == len(own) == 1 and nodes[0].name != own[0].name:
            nodes = (renamed(nodes[0], nodes[0].name, own[0].name, apart=True),)
        self.graph = replace(self.graph, nodes=nodes, composition=smaller.scene.composition)

    @property
    def fields(self) -> FieldSet:
        """Those that it has, and those of the bundle."""
        return self.whole.draft.bundle.with_fields(self.writer.members)

    @property
    def kinds(self) -> str:
        """Of its fields."""
        return self.said("kind")

    @property
    def precisions(self) -> str:
        """In which its numbers are stored."""
        return self.said("precision")

    def said(self, word: str) -> str:
        """What the headers of its fields say, each once."""
        fields = self.fields
        placed = {leaf.field for leaf in self.graph.leaves()}
        return ", ".join(sorted({getattr(fields.headers[member], word) for member in placed}))

    def write(self, output: str, overwrite: bool) -> int:
        """Write it; the bytes written."""
        self.writer.write(output, self.graph, overwrite=overwrite)
        return Path(output).stat().st_size


class ObjectCutout(Cutout):
    """The object, as a bundle of its own: one node, or a group of several."""

    def __init__(
        self,
        whole: Whole,
        fields: Fields,
        precision: str | None,
        name: str,
        named: Container[str],
        framing: Sequence[float],
        cameras: dict | None,
    ):
        """named: those nodes by their names, where it is nodes of its name as they are. framing: (6,) in the
        world."""
        super().__init__(whole, fields, named, precision, False)
        nodes = tuple(lifted(foreground(node), {name} if named else ()) for node in self.graph.nodes)
        self.graph = SceneGraph(
            nodes if named else self.as_one(nodes, name),
            self.graph.composition,
            framing=tuple(float(x) for x in framing),
            cameras=cameras,
            up=self.graph.up,
            generator=f"fusedrf {__version__}",
        )

    def as_one(self, nodes: tuple[Node, ...], name: str) -> tuple[Node, ...]:
        """Nodes as one of a name, which holds them."""
        if len(nodes) == 1:
            return (renamed(nodes[0], nodes[0].name, name, apart=True),)
        rule = self.graph.composition
        return (as_one(SceneGraph(nodes, rule), name, np.eye(4), rule),)


class RestCutout(Cutout):
    """What is left, with all else that the bundle has."""

    def __init__(
        self,
        whole: Whole,
        fields: Fields,
        precision: str | None,
        name: str | None,
        named: Container[str],
    ):
        """name: of what was taken out; named: its nodes, by their names, where it is nodes as they are."""
        hidden = {leaf.name for leaf in whole.scene.leaves() if leaf.name not in named}
        super().__init__(whole, fields, hidden, precision, True)
        bundle, draft = whole.draft.bundle, whole.draft
        placed = {leaf.field for leaf in whole.scene.leaves()}
        for member in bundle.headers:  # what no node places was kept for the history
            if member not in placed and member not in self.writer.members:
                self.writer.copy_field(bundle, member)
        entry = {"event": "extracted", "names": [name] if name else []}
        used = {leaf.field for leaf in self.graph.leaves()}
        self.graph = replace(
            self.graph,
            history=summed_up((*self.graph.history, entry), used),
            framing=draft.framing,
            generator=f"fusedrf {__version__}",
        )

    def add(self, one: Placed) -> None:
        """One more node, of a field that lies in the whole's frame."""
        at = placement(self.whole.origin) @ one.object_to_world
        member = self.put(one.field, self.precision or self.whole.precision)
        name = free_name(one.name, {node.name for node, _, _ in self.graph.walk()})
        self.graph = with_nodes(self.graph, [Node(name, member, None, placement_of(at))])


def foreground(node: Node) -> Node:
    """A node that is no background, as what stands free is none, and neither are those in it."""
    return replace(node, background=False, children=tuple(foreground(child) for child in node.children))
