"""Edits of a scene graph: nodes taken out, placed, named, copied and shown otherwise. They change no field.

A name means the node that has it, with all in it, and nodes that are named as parts of it, `NAME/...`.
"""

from collections.abc import Callable, Container, Iterable, Sequence
from dataclasses import replace

import numpy as np

from formats.errors import BadSchema, FormatError
from formats.nodes import WHITE, Crop, check_name, multiplied
from formats.scene import Node, SceneGraph

Becoming = Callable[[Node, np.ndarray], tuple[Node, ...]]
"""What becomes of a node, whose parent's frame lies in the world by a (4, 4)."""


def belongs(name: str, names: Container[str]) -> bool:
    """Whether a node goes by one of some names, or is a part of one that does."""
    return name in names or any(name[:i] in names for i, letter in enumerate(name) if letter == "/")


def chosen(scene: SceneGraph, names: Container[str]) -> list[Node]:
    """The topmost nodes that go by some names."""
    nodes: list[Node] = []
    changed(scene, names, lambda node, _: nodes.append(node) or (node,))
    return nodes


def leaf_names(nodes: Iterable[Node]) -> set[str]:
    """Names of those nodes, of some and of those in them, that hold a field or a source."""
    names, stack = set(), list(nodes)
    while stack:
        node = stack.pop()
        stack += node.children
        if node.field is not None or node.source is not None:
            names.add(node.name)
    return names


def changed(scene: SceneGraph, names: Container[str], becoming: Becoming) -> SceneGraph:
    """The scene after the topmost nodes that go by some names became others; groups that are left empty by
    that go. Raises what a node or a scene that cannot be raises."""

    def after(node: Node, parent: np.ndarray) -> tuple[Node, ...]:
        if belongs(node.name, names):
            return becoming(node, parent)
        node_to_world = parent @ node.node_to_parent
        children = tuple(one for child in node.children for one in after(child, node_to_world))
        if node.children and not children and node.field is None and node.source is None:
            return ()
        return (node if children == node.children else replace(node, children=children),)

    return replace(scene, nodes=tuple(one for node in scene.nodes for one in after(node, np.eye(4))))


def with_leaves(scene: SceneGraph, becoming: Callable[[Node], Node | None]) -> SceneGraph:
    """The scene whose nodes that hold a field, each without its children, became others, in document order;
    None: without it."""

    def after(node: Node) -> tuple[Node, ...]:
        own = replace(node, children=())
        own = own if node.field is None else becoming(own)
        children = tuple(one for child in node.children for one in after(child))
        if not children and (own is None or node.children and own.field is None and not own.children):
            return ()
        own = replace(node, field=None, children=()) if own is None else own
        return (replace(own, children=(*own.children, *children)),)

    return replace(scene, nodes=tuple(one for node in scene.nodes for one in after(node)))


def with_field(scene: SceneGraph, name: str, member: str | None) -> SceneGraph:
    """The scene whose node of a name holds another field; None: without it."""

    def after(node: Node) -> Node | None:
        if node.name != name:
            return node
        return None if member is None else replace(node, field=member)

    return with_leaves(scene, after)


def without(scene: SceneGraph, names: Container[str]) -> SceneGraph:
    """The scene without some nodes."""
    return changed(scene, names, lambda node, _: ())


def with_nodes(scene: SceneGraph, nodes: Iterable[Node]) -> SceneGraph:
    """The scene with more nodes, behind those it has."""
    return replace(scene, nodes=(*scene.nodes, *nodes))


def holding(node: Node, nodes: tuple[Node, ...], rule: str, own_rule: str) -> Node:
    """A node among others of a rule that holds nodes in place of its source, which are one by a rule of their
    own. Raises BadSchema where it has children of the other rule."""
    if own_rule != rule and node.children:
        raise BadSchema(
            f"node {node.name!r}: the composition of its source is {own_rule!r}, but that of its children "
            f"{rule!r}; put them into a group of their own"
        )
    if node.background:
        nodes = tuple(replace(one, background=True) for one in nodes)
    composition = node.composition if own_rule == rule else own_rule
    nodes = (*nodes, *node.children)
    return replace(node, source=None, background=False, children=nodes, composition=composition)


def lifted(node: Node, kept: Container[str] = ()) -> Node:
    """Of groups that hold but one node each that node, where it stood and as it was shown; a group stays that
    is cropped, or whose name is one of those that are kept."""
    while (
        len(node.children) == 1
        and node.field is None
        and node.source is None
        and not node.extras
        and "crop" not in node.showing
        and node.name not in kept
    ):
        (only,) = node.children
        outer, showing = node.showing, dict(only.showing)
        if "opacity" in outer:
            showing["opacity"] = outer["opacity"] * showing.get("opacity", 1.0)
        if "tint" in outer:
            showing["tint"] = list(multiplied(outer["tint"], showing.get("tint", WHITE)))
        placement = only.placement
        if not np.array_equal(node.node_to_parent, np.eye(4)):
            placement = placement_of(node.node_to_parent @ only.node_to_parent)
        rule = only.composition or (node.composition if only.children else None)
        node = replace(only, placement=placement, showing=showing, composition=rule)
    return node


def moved(node: Node, parent: np.ndarray, matrix: np.ndarray) -> Node:
    """A node to whose place in the world a (4, 4) was applied."""
    at = np.linalg.solve(parent, matrix @ parent @ node.node_to_parent)
    if np.array_equal(parent, np.eye(4)):
        at = matrix @ node.node_to_parent  # without rounding
    at[3] = 0, 0, 0, 1
    return replace(node, placement=placement_of(at))


def renamed(node: Node, name: str, new_name: str, apart: bool = False) -> Node:
    """A node that goes by one name as it goes by another; so do nodes in it that are named as its parts.
    apart: it is a copy, in which every node needs another name."""

    def renaming(one: str) -> str:
        if belongs(one, {name}):
            return new_name + one.removeprefix(name)
        return f"{new_name}/{one}" if apart else one

    children = tuple(renamed(child, name, new_name, apart) for child in node.children)
    return replace(node, name=renaming(node.name), children=children)


def shown(node: Node, showing: dict) -> Node:
    """A node with other words for what is shown of it; None takes one away."""
    words = {**node.showing, **showing}
    return replace(node, showing={key: value for key, value in words.items() if value is not None})


def cropped_as(node: Node, crop: Sequence[float] | None, names: set[str]) -> Node:
    """A node with another crop, which lies in the frame of the file that it stands for; None: without. Where
    that is not its own frame, it comes into a group, of a name that no node has, which is taken from now
    on."""
    if node.source_matrix is None or crop is None:
        return shown(node, {"crop": crop})
    placed = replace(node, placement=placement_of(np.array(node.source_matrix)))
    group = free_name(f"{node.name}/cropped", names)
    at = placement_of(node.source_to_parent)
    return Node(group, None, None, at, children=(placed,), showing={"crop": list(crop)})


def cropped(node: Node, crops: Sequence[Crop], names: set[str]) -> Node:
    """A node of which only what crops of its frame hold is shown. Where these lie in other frames than its
    own, it is in groups that are cropped, of names that no node has, which are taken from now on."""
    own = node.node_to_parent
    for crop in reversed(crops):
        at = own @ np.linalg.inv(crop.object_to_shape)
        if "crop" in node.showing or not np.array_equal(at, node.node_to_parent):
            inner = np.linalg.solve(at, node.node_to_parent)
            inner[3] = 0, 0, 0, 1
            node = replace(node, placement=placement_of(inner))
            group = free_name(f"{node.name}/cropped", names)
            node = Node(group, None, None, placement_of(at), children=(node,))
        node = shown(node, {"crop": list(crop.shape)})
    return node


def placement_of(matrix: np.ndarray) -> dict:
    """What a node says of where it lies, by a (4, 4)."""
    unit = float(matrix[0, 0])
    if not np.array_equal(matrix[:3, :3], unit * np.eye(3)):
        return {"matrix": matrix.tolist()}
    words = {"translation": matrix[:3, 3].tolist()} if matrix[:3, 3].any() else {}
    return words | ({} if unit == 1 else {"scale": [unit] * 3})


def free_name(base: str, names: set[str], otherwise: str = "object") -> str:
    """A name that no node has, which is taken from now on: the wanted one, where a node may be called so, or
    it with a number."""
    try:
        check_name(base)
    except FormatError:
        base = otherwise
    name, number = base, 1
    while name in names:
        number += 1
        name = f"{base}-{number}"
    names.add(name)
    return name
