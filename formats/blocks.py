"""Fields of several objects, as earlier versions wrote them: tensors of one `vm` field, placed by blocks in
its metadata (SPEC, section 2). They are read as nodes of the scene graph, one for each block, and a field for
each tensor, which has its arrays byte for byte."""

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np

from formats.field_header import FieldHeader, decode_header
from formats.graph import belongs, free_name, placement_of
from formats.history import distilled, listed
from formats.nodes import WHITE
from formats.records import encode_stored, mapped_array, member_name
from formats.scene import Box, Matrix4, Node, SceneGraph

KIND = "vm"
UNNAMED = ("", "fused", "restored")
"""Names of blocks that stand for no object; one whose object goes by such a name is named `NAME/NAME`."""
RULE = "max"  # by which blocks are one field
ARRAY = re.compile(r"tensor_([0-9]{1,4})\.(.+)")
NEEDS = {"held": (".detail_held", ".occupancy.bricks"), "runs": (".runs",)}
"""Ends of names of arrays that ask for what a reader must know (SPEC, 2.1 and 2.5)."""


Part = Annotated[float, msgspec.Meta(ge=0, le=1)]


class StoredBlock(msgspec.Struct):
    """What a field's metadata says of one of its blocks."""

    name: str
    tensor: Annotated[int, msgspec.Meta(ge=0)]
    object_to_field: Matrix4
    tint: tuple[Part, Part, Part] = WHITE


class StoredTensor(msgspec.Struct):
    """What a field's metadata says of a tensor that blocks place, as far as it is read here."""

    aabb: Box


@dataclass(frozen=True)
class Instance:
    """A block, read as a node."""

    name: str
    """Of the block, or of its object."""
    is_object: bool
    """Whether it stands for one that history tells of."""
    member: str
    object_to_field: np.ndarray
    """(4, 4)."""
    tint: tuple[float, ...]


@dataclass(frozen=True)
class Unfolded:
    """A bundle's scene and fields, in which every object is a node with a field of its own."""

    scene: SceneGraph
    views: dict[str, bytes | memoryview]
    """The fields' bytes, by member."""
    headers: dict[str, FieldHeader]
    instances: dict[str, tuple[Instance, ...]]
    """What stands for a field that held several objects, by its former member."""


def unfolded(
    scene: SceneGraph,
    views: Mapping[str, bytes | memoryview],
    headers: Mapping[str, FieldHeader],
    writing: bool = False,
) -> Unfolded:
    """A scene whose fields of blocks are nodes. What is not well formed stays as it is, for whoever reads
    that field to refuse. writing: a field that holds one object has no name of its own. Raises a FormatError
    where the nodes are no scene."""
    views, headers, instances = dict(views), dict(headers), {}
    placed, objects = {leaf.field for leaf in scene.leaves()}, set(distilled(scene.history))
    for member, header in [*headers.items()]:
        blocks = blocks_in(header, objects if member in placed else set(), writing)
        if not blocks:
            continue
        fields = {n: encode_tensor(views[member], header, n) for n in sorted({b.tensor for b in blocks})}
        members = {n: member_name(data) for n, data in fields.items()}
        instances[member] = tuple(
            Instance(
                object_name(b.name),
                b.name not in UNNAMED,
                members[b.tensor],
                np.array(b.object_to_field),
                b.tint,
            )
            for b in blocks
        )
        del views[member], headers[member]
        views |= {members[n]: data for n, data in fields.items()}
        headers |= {members[n]: decode_header(data, member) for n, data in fields.items()}
    if instances:
        scene = with_nodes(scene, instances)
    return Unfolded(scene, views, headers, instances)


def blocks_in(header: FieldHeader, names: set[str], writing: bool) -> list[StoredBlock]:
    """The blocks of a field that holds several objects, or one that is placed in it or goes by one of some
    names; none of any other field."""
    if header.kind != KIND:
        return []
    try:
        blocks = msgspec.convert(header.metadata.get("blocks"), list[StoredBlock])
        tensors = msgspec.convert(header.metadata.get("tensors"), list[StoredTensor])
        matrices = np.array([block.object_to_field for block in blocks], np.float64)
    except (msgspec.ValidationError, OverflowError):
        return []
    arrays = [ARRAY.fullmatch(name) for name in header.specs]
    if not all(arrays) or any(int(match[1]) >= len(tensors) for match in arrays):
        return []
    if not blocks or any(block.tensor >= len(tensors) for block in blocks):
        return []
    alone = len(blocks) == len(tensors) == 1 and np.array_equal(matrices[0], np.eye(4))
    called = blocks[0].name not in UNNAMED and object_name(blocks[0].name) in names
    if not alone or blocks[0].tint != WHITE or called:
        return blocks
    return [StoredBlock("", 0, blocks[0].object_to_field)] if writing and blocks[0].name else []


def object_name(block: str) -> str:
    """The name of the object that a block stands for."""
    return next((name for name in UNNAMED if block == f"{name}/{name}"), block)


def encode_tensor(data: bytes | memoryview, header: FieldHeader, number: int) -> bytes:
    """The bytes of a field that is one tensor of another, with the arrays that it has there."""
    tensor = header.metadata["tensors"][number]
    stored = {name: mapped_array(data, spec) for name, spec in own_arrays(header.specs, number)}
    coded = {name: spec.entry for name, spec in own_arrays(header.coded, number)}
    needs = {"hashed"} if "hashed" in tensor else set()
    needs |= {word for word, ends in NEEDS.items() if any(name.endswith(ends) for name in stored)}
    block = {"name": "", "object_to_field": np.eye(4).tolist(), "tensor": 0}
    metadata = {**header.metadata, "aabb": tensor["aabb"], "tensors": [tensor], "blocks": [block]}
    metadata = {key: value for key, value in metadata.items() if key != "needs"}
    return encode_stored(KIND, metadata | ({"needs": sorted(needs)} if needs else {}), stored, coded)


def own_arrays(arrays: Mapping[str, object], number: int) -> Iterator[tuple[str, object]]:
    """Those of a tensor, by the names that they have where it is alone."""
    for name, array in arrays.items():
        if name.startswith(f"tensor_{number}."):
            yield f"tensor_0.{name.partition('.')[2]}", array


# -- the graph -----------------------------------------------------------------------------------------------


def with_nodes(scene: SceneGraph, instances: dict[str, tuple[Instance, ...]]) -> SceneGraph:
    """The scene with a node for each instance of the fields that its nodes name, and a history that tells of
    the others alone."""
    used_names = {node.name for node, _, _ in scene.walk() if node.field not in instances}
    background = {n["name"] for n in distilled(scene.history).values() if n.get("background")}
    members: dict[str, str] = {}
    """Of the objects."""

    def placed(node: Node, within: np.ndarray) -> list[Node]:
        new_nodes, names = instances[node.field], {}
        for i, one in sorted(enumerate(new_nodes), key=lambda pair: not pair[1].is_object):
            names[i] = free_name(one.name, used_names, node.name)
            if one.is_object:
                members[names[i]] = one.member
        placed_nodes = []
        for i, one in enumerate(new_nodes):
            placement, tint = placement_of(within @ one.object_to_field), {"tint": list(one.tint)}
            behind = node.background or one.name in background
            tint = {} if one.tint == WHITE else tint
            placed_nodes.append(Node(names[i], one.member, None, placement, behind, (), {}, tint))
        return placed_nodes

    def nodes_for(node: Node) -> list[Node]:
        children = [one for child in node.children for one in nodes_for(child)]
        if node.field not in instances:
            return [replace(node, children=tuple(children))]
        several = scene.composition != RULE and len(instances[node.field]) > 1
        if not (node.showing or node.extras or children or several):
            return placed(node, node.node_to_parent)
        used_names.add(node.name)  # what it says holds for all of them
        new_nodes = (*placed(node, np.eye(4)), *children)
        rule = RULE if several else node.composition
        return [replace(node, field=None, background=False, children=new_nodes, composition=rule)]

    nodes = tuple(one for node in scene.nodes for one in nodes_for(node))
    return replace(scene, nodes=nodes, history=without_placements(scene.history, members))


def without_placements(history: tuple[dict, ...], members: dict[str, str]) -> tuple[dict, ...]:
    """A history without placements of objects that are nodes, by name, but with what these were made of."""
    known: dict[str, dict] = {}
    return tuple(_without_placements(entry, members, known) for entry in history)


def _without_placements(entry: dict, members: dict[str, str], known: dict[str, dict]) -> dict:
    names, inside, sources = [], [], {}
    for node in listed(entry.get("nodes")):
        name = node.get("name") if isinstance(node, dict) else None
        known_members = [one for one in members if belongs(one, {name})] if isinstance(name, str) else []
        if not known_members:
            inside.append(node)
            continue
        names.append(name)
        made_of = {} if node.get("kept") else {key: node[key] for key in ("source", "sha256") if key in node}
        for part in known_members if "field" in node and (made_of or node.get("kept")) else ():
            instance = {} if part == name else {"instance": part.removeprefix(f"{name}/")}
            changed = {"field": node["field"], **made_of, **instance}
            if known.setdefault(members[part], changed) is changed and changed["field"] != members[part]:
                sources[members[part]] = changed
    if not names:
        return entry
    changed = {key: value for key, value in entry.items() if key != "nodes"} | {"objects": names}
    return changed | ({"nodes": inside} if inside else {}) | ({"sources": sources} if sources else {})
