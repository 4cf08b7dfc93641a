"""Which objects a bundle holds, from its history and its fields' metadata."""

from collections import Counter
from collections.abc import Iterable, Iterator
from typing import Annotated

import msgspec
import numpy as np

from formats.records import FieldHeader
from formats.scene import Leaf, Matrix4, SceneGraph

Name = Annotated[str, msgspec.Meta(min_length=1, max_length=1024)]
Box = Annotated[list[float], msgspec.Meta(min_length=6, max_length=6)]


class HistoryNode(msgspec.Struct):
    """What a history entry says of an object that was put in."""

    name: Name
    object_to_world: Matrix4
    aabb: Box
    """In the world."""


class StoredBlock(msgspec.Struct):
    """What a field's metadata says of one of its blocks (SPEC, section 2)."""

    name: Name
    tensor: int
    object_to_field: Matrix4


class StoredTensor(msgspec.Struct):
    """What a field's metadata says of a tensor that blocks place."""

    aabb: Box
    """In the object's frame."""


def objects_in(scene: SceneGraph, headers: dict[str, FieldHeader]) -> list[dict]:
    """Name, kind, placement, world box, size and bytes of every object in a bundle, JSON-able.

    `bytes` are those of the object's own numbers, which `shared_by` objects use; both are None for an object
    that was distilled into one field with others. `kind` is that of the field which holds the object.
    """
    leaves = [leaf for leaf in scene.leaves() if leaf.field is not None]
    if len(leaves) != 1:
        return [_whole(leaf, headers[leaf.field], headers[leaf.field].size) for leaf in leaves]
    leaf, header, nodes = leaves[0], headers[leaves[0].field], current_nodes(scene.history)
    blocks = _read_all(header.metadata.get("blocks"), StoredBlock)
    if not nodes and len(blocks) <= 1:
        return [_whole(leaf, header, header.size)]
    was_fused = any(entry.get("event") == "fused" for entry in scene.history)
    return list(_objects_of(leaf, header, blocks, nodes, was_fused))


def current_nodes(history: Iterable[dict]) -> dict[str, HistoryNode]:
    """The objects that a history's entries put in and did not take out again, by name.

    Entries are free-form: what does not read as an object or a name is passed over.
    """
    nodes: dict[str, HistoryNode] = {}
    for entry in history:
        for node in _read_all(entry.get("nodes"), HistoryNode):
            nodes[node.name] = node
        for name in _read_all(entry.get("names"), Name):
            nodes.pop(name, None)
    return nodes


def world_aabb(aabb: list[float], object_to_world: np.ndarray) -> list[float]:
    """(6,) box in the world around the eight corners of a (6,) box in the object's frame."""
    low, high = np.array(aabb[:3]), np.array(aabb[3:])
    with np.errstate(all="ignore"):  # finite numbers of another program may multiply to infinity
        centre = object_to_world[:3, :3] @ (low + high) / 2 + object_to_world[:3, 3]
        half = np.abs(object_to_world[:3, :3]) @ (high - low) / 2
        return [*(centre - half).tolist(), *(centre + half).tolist()]


def _objects_of(
    leaf: Leaf,
    header: FieldHeader,
    blocks: list[StoredBlock],
    nodes: dict[str, HistoryNode],
    was_fused: bool,
) -> Iterator[dict]:
    """The objects of a field that was fused or edited. A block belongs to the object of the history that it
    is named after; one that belongs to none holds what was distilled together or, in a field that was never
    fused, what the field was before objects were added."""
    rows: dict[str, list[dict]] = {name: [] for name in nodes}
    others = []
    for block, row in zip(blocks, _block_rows(leaf, header, blocks), strict=True):
        owner = next((name for name in _itself_and_groups(block.name) if name in nodes), None)
        base = owner is None or (was_fused and block.name == leaf.name)
        (others if base else rows[owner]).append(row)
    if not was_fused:
        yield from others if blocks else [_whole(leaf, header, None)]
    for name, node in nodes.items():
        yield from rows[name]
        if not rows[name] and (others or not blocks):
            yield _row(name, header.kind, np.array(node.object_to_world), node.aabb)


def _block_rows(leaf: Leaf, header: FieldHeader, blocks: list[StoredBlock]) -> Iterator[dict]:
    users = Counter(block.tensor for block in blocks)
    sizes, tensors = _tensor_sizes(header), _as_list(header.metadata.get("tensors"))
    for block in blocks:
        with np.errstate(all="ignore"):  # finite numbers of another program may multiply to infinity
            matrix = leaf.object_to_world @ np.array(block.object_to_field)
        known = 0 <= block.tensor < len(tensors)
        tensor = _read(tensors[block.tensor], StoredTensor) if known else None
        box = world_aabb(tensor.aabb, matrix) if tensor else None
        size = sizes.get(block.tensor)
        yield _row(block.name, header.kind, matrix, box, size, users[block.tensor])


def _whole(leaf: Leaf, header: FieldHeader, size: int | None) -> dict:
    """A field that is one object."""
    aabb = header.metadata.get("aabb")
    box = world_aabb(aabb, leaf.object_to_world) if aabb else None
    return _row(leaf.name, header.kind, leaf.object_to_world, box, size, None if size is None else 1)


def _row(
    name: str,
    kind: str,
    object_to_world: np.ndarray,
    box: list[float] | None,
    size: int | None = None,
    shared_by: int | None = None,
) -> dict:
    with np.errstate(all="ignore"):
        extent = None if box is None else np.subtract(box[3:], box[:3]).tolist()
    return {
        "name": name,
        "kind": kind,
        "object_to_world": object_to_world.tolist(),
        "world_aabb": box,
        "size": extent,
        "bytes": size,
        "shared_by": shared_by,
    }


def _itself_and_groups(name: str) -> Iterator[str]:
    """'a/b/c', 'a/b', 'a': a name and those of the groups that it belongs to."""
    while name:
        yield name
        name = name.rpartition("/")[0]


def _tensor_sizes(header: FieldHeader) -> Counter:
    """Bytes of the arrays named `tensor_N.*`, by N."""
    sizes: Counter = Counter()
    for name, spec in header.specs.items():
        number = name.partition(".")[0].removeprefix("tensor_")
        if name.startswith("tensor_") and number.isdecimal():
            sizes[int(number)] += spec.stop - spec.start
    return sizes


def _read_all(values: object, kind: type) -> list:
    """Those of `values`, if it is a list, that read as `kind`."""
    return [found for value in _as_list(values) if (found := _read(value, kind)) is not None]


def _as_list(values: object) -> list:
    return values if isinstance(values, list) else []


def _read(value: object, kind: type):
    try:
        return msgspec.convert(value, kind)
    except msgspec.ValidationError:
        return None
