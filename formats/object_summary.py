"""Which objects a bundle holds: the nodes of its graph, and what was distilled into a field with others."""

from collections import Counter
from collections.abc import Iterator

import msgspec
import numpy as np

from formats.blocks import UNNAMED
from formats.field_header import FieldHeader
from formats.graph import belongs
from formats.history import DistilledNode, distilled
from formats.scene import SceneGraph


def objects_in(scene: SceneGraph, headers: dict[str, FieldHeader]) -> list[dict]:
    """Name, kind, placement, world box, size and bytes of every object in a bundle, JSON-able.

    `bytes` are those of the object's own field, which `shared_by` nodes use; both are None for an object that
    was distilled into one field with others, and `inside` names the node of that. `kind` is that of the field
    which holds the object.
    """
    leaves = [leaf for leaf in scene.leaves() if leaf.field is not None]
    users = Counter(leaf.field for leaf in leaves)
    inside = list(distilled_nodes(scene))
    rows = []
    for leaf in leaves:
        if inside and belongs(leaf.name, UNNAMED):  # it is what they were distilled to, or what fills a cut
            continue
        header, matrix = headers[leaf.field], leaf.object_to_world
        aabb = header.box
        box = world_aabb(aabb, matrix) if aabb else None
        rows.append(_row(leaf.name, header.kind, matrix, box, header.size, users[leaf.field]))
    holders = [leaf for leaf in leaves if belongs(leaf.name, UNNAMED)] or leaves
    kind = headers[holders[0].field].kind if holders else None
    field = holders[0].name if holders else None
    return rows + [_row(n.name, kind, np.array(n.object_to_world), n.aabb, inside=field) for n in inside]


def distilled_nodes(scene: SceneGraph) -> Iterator[DistilledNode]:
    """The objects that a history tells of, which is free-form: what does not read as one is passed over."""
    for node in distilled(scene.history).values():
        try:
            yield msgspec.convert(node, DistilledNode)
        except (msgspec.ValidationError, OverflowError):
            continue


def world_aabb(aabb: list[float], object_to_world: np.ndarray) -> list[float]:
    """(6,) box in the world around the eight corners of a (6,) box in the object's frame."""
    low, high = np.array(aabb[:3]), np.array(aabb[3:])
    with np.errstate(all="ignore"):  # finite numbers of another program may multiply to infinity
        centre = object_to_world[:3, :3] @ (low + high) / 2 + object_to_world[:3, 3]
        half = np.abs(object_to_world[:3, :3]) @ (high - low) / 2
        return [*(centre - half).tolist(), *(centre + half).tolist()]


def _row(
    name: str,
    kind: str | None,
    object_to_world: np.ndarray,
    box: list[float] | None,
    size: int | None = None,
    shared_by: int | None = None,
    inside: str | None = None,
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
        "inside": inside,
    }
