"""A scene with all that it names, as nodes of one bundle: the fields of its sources are taken over byte for
byte, and what several nodes place is stored once."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from formats.bundle import BundleWriter, OpenBundle, is_bundle
from formats.errors import BadSchema
from formats.graph import holding, placement_of
from formats.scene import Node, SceneGraph
from formats.sources import expand_scene, resolve_source


class Embedding:
    """Takes scenes and their fields over into one bundle."""

    def __init__(self, writer: BundleWriter, allow_outside: bool = False, precision: str | None = None):
        """precision: of fields that are stored anew; None: as they are."""
        self.writer, self.allow_outside, self.precision = writer, allow_outside, precision
        self.bundles: dict[Path, OpenBundle] = {}
        self.members: dict[tuple[Path, str], str] = {}

    def scene(self, path: Path | str) -> SceneGraph:
        """The scene of a bundle or a scene.json, whose nodes name members of the writer alone. Raises what
        reading them raises, and BadSchema where a source is no bundle."""
        path = Path(path)
        scene = self.bundle(path).scene if is_bundle(path) else expand_scene(path, self.allow_outside)
        return self.of(scene, path)

    def of(self, scene: SceneGraph, path: Path) -> SceneGraph:
        """The same, of a scene that was read from a path."""
        nodes = tuple(self.node(node, path, "", scene.composition) for node in scene.nodes)
        return replace(scene, nodes=nodes)

    def bundle(self, path: Path) -> OpenBundle:
        """The bundle at a path, opened once."""
        if path not in self.bundles:
            if not is_bundle(path):
                raise BadSchema(f"{path}: not a bundle; train it to a .rfpack first")
            self.bundles[path] = OpenBundle(path)
        return self.bundles[path]

    def node(self, node: Node, path: Path, prefix: str, rule: str) -> Node:
        """A node of the scene at a path, its name led by a prefix, among nodes that are one by a rule."""
        rule = node.composition or rule
        children = tuple(self.node(child, path, prefix, rule) for child in node.children)
        node = replace(node, name=prefix + node.name, children=children)
        if node.field is not None:
            return replace(node, field=self.member(self.bundle(path), node.field))
        if node.source is None:
            return node
        target = resolve_source(path, node.source, self.allow_outside, node.name)
        inner = self.bundle(target).scene
        child_nodes = tuple(
            self.node(child, target, f"{node.name}/", inner.composition) for child in inner.nodes
        )
        return in_place_of(node, child_nodes, rule, inner.composition)

    def member(self, bundle: OpenBundle, member: str) -> str:
        """The member of the writer that holds a bundle's field."""
        key = bundle.path, member
        if key not in self.members and self.precision is None:
            self.members[key] = self.writer.copy_field(bundle, member)
        elif key not in self.members:
            self.members[key] = self.writer.add_field(bundle.field(member), self.precision)
        return self.members[key]


def in_place_of(node: Node, nodes: tuple[Node, ...], rule: str, own_rule: str) -> Node:
    """A node that holds what its source is: itself with the field of the only node that there is, else a
    group of them, which are one by a rule of their own."""
    if len(nodes) == 1 and not node.children:
        (only,) = nodes
        at_rest = np.array_equal(only.node_to_parent, np.eye(4))
        if only.field is not None and not (only.children or only.showing or only.extras):
            if at_rest:
                return replace(node, source=None, field=only.field)
            if "crop" not in node.showing:  # it lies in the node's own frame
                placement = placement_of(node.node_to_parent @ only.node_to_parent)
                own = only.node_to_parent.tolist()
                return replace(node, source=None, field=only.field, placement=placement, source_matrix=own)
    return holding(node, nodes, rule, own_rule)


def as_one(scene: SceneGraph, name: str, matrix: np.ndarray, rule: str, background: bool = False) -> Node:
    """A scene as one node of another one of a rule, placed by a (4, 4): the name leads those of the nodes in
    it."""
    nodes = tuple(with_prefix(node, f"{name}/") for node in scene.nodes)
    node = Node(name, placement=placement_of(matrix), background=background)
    return in_place_of(node, nodes, rule, scene.composition)


def with_prefix(node: Node, prefix: str) -> Node:
    """A node whose name and those of the nodes in it are led by a prefix."""
    children = tuple(with_prefix(child, prefix) for child in node.children)
    return replace(node, name=prefix + node.name, children=children)
