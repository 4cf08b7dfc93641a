"""The bundle that `fuse` writes: a node for every source, or one of what was learnt, their fields, and a
history that tells what they were made of."""

import os
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from formats.bundle import BundleWriter, OpenBundle
from formats.embedding import Embedding
from formats.errors import FormatError
from formats.graph import free_name, placement_of, with_leaves
from formats.records import FieldRecord
from formats.scene import Leaf, Node, SceneGraph
from fusedrf_cli import __version__
from fusedrf_cli.bridge.background import LEARNT, Background
from fusedrf_cli.bridge.building import BestTrial, FuseScene
from fusedrf_cli.bridge.field_bundle import NO_MEMBER
from fusedrf_cli.bridge.scene import LoadedScene, SourceField, showing_of
from fusedrf_cli.bridge.sizes import graph_bytes
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import placement
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.instances import distinct_fields
from fusedrf_cli.requests import FuseRequest


class FusedBundle:
    """What a scene is fused to, but for its numbers."""

    def __init__(self, request: FuseRequest, everything: LoadedScene, scene: FuseScene, learnt: bool):
        """everything: the scene with those of its fields that show nothing, which are left out; learnt:
        whether one field is learnt from it, and its sources are no nodes. Raises the FormatError of a scene
        that cannot be written."""
        self.request, self.loaded, self.composed, self.learnt = request, scene.loaded, scene.composed, learnt
        self.kept = {f.member: f.bundle for f in self.loaded.fields} if request.keep_sources else {}
        whole = named_graph(request, everything)
        self.hidden = [leaf.name for leaf in whole.leaves() if not leaf.visible]
        """Nodes that are left out."""
        self.graph = with_shown(whole, everything, self.loaded)
        self.nodes = [self.history_node(leaf, source) for leaf, source in self.leaves]
        self.framing: tuple[float, ...] | None = None
        self.cameras: dict | None = None

    def shown_as(self, framing: np.ndarray | None, cameras: dict | None) -> None:
        """Keep what pictures of the scene show. Raises the FormatError of a scene that cannot be written."""
        self.framing = None if framing is None else tuple(float(number) for number in framing)
        self.cameras = cameras
        try:
            self.overhead = graph_bytes(self.scene(self.skeleton, {"nodes": self.nodes}))
        except FormatError as error:
            raise error.within(self.request.output) from error

    @property
    def skeleton(self) -> SceneGraph:
        """The graph before its fields are made."""
        return SceneGraph((self.learnt_node(NO_MEMBER),)) if self.learnt else self.graph

    def learnt_node(self, member: str) -> Node:
        """The node of what was learnt, in the composed scene's frame."""
        return Node(LEARNT, member, None, placement_of(placement(self.composed.origin)))

    def scene(self, graph: SceneGraph, entry: dict) -> SceneGraph:
        """A graph as it is written, with an entry of its history."""
        return replace(
            graph,
            history=(entry,),
            generator=f"fusedrf {__version__}",
            framing=self.framing,
            cameras=self.cameras,
            up=self.loaded.graph.up,
        )

    def write(self, output: str, made: BestTrial, background: Background | None, entry: dict) -> int:
        """Write what was made as a bundle; its bytes. entry: of its history, but for what it was made of."""
        writer = BundleWriter()
        how = self.of_learnt(writer, made, background) if self.learnt else self.of_instances(writer, made)
        graph = writer.unfolded(how)
        names = [leaf.name for leaf in graph.leaves() if not self.learnt or leaf.name != LEARNT]
        if self.learnt:
            entry = entry | {"nodes": [node for node in self.nodes if node["name"] not in names]}
        sources = self.sources_of(graph)
        for member, bundle in self.kept.items():
            writer.copy_field(bundle, member)
        entry = entry | ({"objects": names} if names else {}) | ({"sources": sources} if sources else {})
        writer.write(output, self.scene(graph, entry), overwrite=self.request.overwrite)
        return Path(output).stat().st_size

    def of_learnt(self, writer: BundleWriter, made: BestTrial, background: Background | None) -> SceneGraph:
        """The graph of what was learnt, and of a background that stays."""
        precision = made.storage.precision
        if background is None:
            return SceneGraph((self.learnt_node(add(writer, made.field, precision)),))
        source = self.background_source
        stays, learnt = made.field.placed
        member = add(writer, learnt.field, precision)
        if background.precision is None:
            own = writer.copy_field(source.bundle, source.member)
        else:
            own = add(writer, stays.field, background.precision)
        name = free_name(source.placed.name, {LEARNT})
        leaf = next(leaf for leaf, f in self.leaves if f is source)
        at = placement_of(leaf.object_to_world)
        shown = {"showing": showing_of(stays), "source_matrix": leaf.source_matrix}
        node = Node(name, own, None, at, True, **shown)
        at = placement_of(placement(self.composed.origin) @ learnt.object_to_world)
        return SceneGraph((node, Node(LEARNT, member, None, at)))

    def of_instances(self, writer: BundleWriter, made: BestTrial) -> SceneGraph:
        """The scene's graph with the fields that were made of its own."""
        result = made.field
        fields = distinct_fields(result) if isinstance(result, ComposedField) else [result]
        of_source = dict(zip(map(id, distinct_fields(self.composed)), fields, strict=True))
        precisions = {id(one): made.storage.precision_of(i) for i, one in enumerate(fields)}
        members = {}

        def member(source: SourceField) -> str:
            field = of_source[id(source.placed.field)]
            if field is source.placed.field:
                return writer.copy_field(source.bundle, source.member)
            if id(field) not in members:
                members[id(field)] = add(writer, opened(field), precisions[id(field)])
            return members[id(field)]

        named = iter(map(member, self.loaded.fields))
        graph = with_leaves(self.graph, lambda node: replace(node, field=next(named)))
        return uncropped(graph) if any(f.cut for f in self.loaded.fields) else graph

    @property
    def leaves(self) -> list[tuple[Leaf, SourceField]]:
        """The graph's leaves, and the sources that they are."""
        return list(zip(self.graph.leaves(), self.loaded.fields, strict=True))

    @property
    def background_source(self) -> SourceField:
        """The source that is unbounded."""
        return next(f for f in self.loaded.fields if f.placed.unbounded)

    def history_node(self, leaf: Leaf, f: SourceField) -> dict:
        """What a history entry says of a source: name, placement, box, path from the output's folder,
        checksum, kept member."""
        node = {
            "name": f.placed.name,
            "object_to_world": f.placed.object_to_world.tolist(),
            "aabb": f.placed.aabb.tolist(),
            "field": f.member,
            "background": f.background,
            "kept": f.member in self.kept and f.whole,
        }
        if f.whole:  # an edit reads it again as it is
            folder = Path(self.request.output).resolve().parent
            path = os.path.relpath(f.bundle.path.resolve(), folder)
            node |= {"source": path, "sha256": f.bundle.sha256}
        return node if leaf.source_matrix is None else node | {"source_matrix": leaf.source_matrix}

    def sources_of(self, graph: SceneGraph) -> dict[str, dict]:
        """What the members of a graph were made of that are not those of their sources."""
        placed = [leaf for leaf in graph.leaves() if not self.learnt or leaf.name != LEARNT]
        own = self.loaded.fields if not self.learnt else [self.background_source for _ in placed]
        by_member: dict[str, dict] = {}
        for leaf, f in zip(placed, own, strict=True):
            if leaf.field == f.member or f.cut:
                continue
            entry = {"field": f.member}
            if f.member not in self.kept:
                folder = Path(self.request.output).resolve().parent
                entry["source"] = os.path.relpath(f.bundle.path.resolve(), folder)
                entry["sha256"] = f.bundle.sha256
            by_member.setdefault(leaf.field, entry)
        return by_member


def add(writer: BundleWriter, field: StoredField, precision: str) -> str:
    """The member of a field that is stored in a precision."""
    return writer.add_field(FieldRecord(field.kind, *field.state()), precision)


class Named(Embedding):
    """A scene whose nodes name all fields by the members of the bundles that they are in."""

    def __init__(self, allow_outside: bool, bundles: Iterable[OpenBundle]):
        """bundles: that are open already."""
        super().__init__(BundleWriter(), allow_outside)
        self.bundles = {bundle.path: bundle for bundle in bundles}

    def member(self, bundle: OpenBundle, member: str) -> str:
        """See Embedding: its own name, which is made of its bytes."""
        return member


def named_graph(request: FuseRequest, everything: LoadedScene) -> SceneGraph:
    """The graph of a scene with the nodes of all its sources."""
    bundles = (f.bundle for f in everything.fields)
    return Named(request.allow_outside, bundles).of(everything.graph, everything.path)


def with_shown(graph: SceneGraph, everything: LoadedScene, loaded: LoadedScene) -> SceneGraph:
    """The graph of all of a scene without the nodes that are hidden, and those whose fields show nothing."""
    shown = {id(f) for f in loaded.fields}
    visible = iter([leaf.visible for leaf in graph.leaves()])
    fields = iter(everything.fields)

    def after(node: Node) -> Node | None:
        return node if next(visible) and id(next(fields)) in shown else None

    return with_leaves(graph, after)


def uncropped(graph: SceneGraph) -> SceneGraph:
    """A graph none of whose nodes is cropped."""

    def after(node: Node) -> Node:
        showing = {word: value for word, value in node.showing.items() if word != "crop"}
        return replace(node, showing=showing, children=tuple(map(after, node.children)))

    return replace(graph, nodes=tuple(map(after, graph.nodes)))


def stored_bytes(loaded: LoadedScene) -> Mapping[int, int]:
    """Bytes of the members of fields that their bundles have, with what they share, by the field's id."""
    known = (f for f in loaded.fields if f.member in f.bundle.headers and not f.cut)
    return {id(f.placed.field): sum(f.bundle.sizes(f.member).values()) for f in known}


def unchanged_bytes(loaded: LoadedScene) -> int | None:
    """Bytes of the members of all fields; None: they are not known."""
    if not all(f.member in f.bundle.headers for f in loaded.fields):
        return None
    sizes: dict[str, int] = {}
    for f in loaded.fields:
        sizes |= f.bundle.sizes(f.member)
    return sum(sizes.values())
