"""What a bundle's `history` tells: how it was made and edited, the objects that were distilled into a field
with others, and the files that fields were made of. What stands in the scene graph stands there alone.

An entry is free-form (SPEC, section 3). Of its keys `event` says what was done, `objects` to which nodes of
the graph, `nodes` which objects were distilled into one field, each with its placement and box in the world,
`names` which objects were taken out, and `sources` from which file each member of the bundle was made.
"""

from collections.abc import Container, Iterable
from typing import Annotated

import msgspec
import numpy as np

from formats.errors import BadSchema, FormatError
from formats.nodes import check_affine
from formats.scene import Matrix4, SceneGraph

KEPT = 32
"""Edits that are told one by one; twice as many before they are summed up."""

Name = Annotated[str, msgspec.Meta(min_length=1, max_length=1024)]


class DistilledNode(msgspec.Struct):
    """What an entry says of an object that was distilled into a field."""

    name: Name
    object_to_world: Matrix4
    aabb: Annotated[list[float], msgspec.Meta(min_length=6, max_length=6)]
    """In the world."""
    field: str = ""
    source: str = ""
    sha256: str = ""
    background: bool = False
    source_matrix: Matrix4 | None = None
    """See `Node`."""


class Source(msgspec.Struct):
    """What an entry says of the field that a member was made of."""

    field: str
    """The member of that name: of the file, or, where none is named, of this bundle."""
    source: str = ""
    """A path from the bundle's folder."""
    sha256: str = ""
    """Of the file."""
    instance: str = ""
    """Which one it was, of a field that held several objects."""


def distilled(history: Iterable[dict]) -> dict[str, dict]:
    """By name, the objects in distilled fields: those that entries put in and did not take out again; one
    that does both, as where an object is replaced, takes out first."""
    nodes: dict[str, dict] = {}
    for entry in history:
        for name in listed(entry.get("names")):
            if isinstance(name, str):
                nodes.pop(name, None)
        for node in listed(entry.get("nodes")):
            if isinstance(node, dict) and isinstance(node.get("name"), str):
                nodes[node["name"]] = node
    return nodes


def sources(history: Iterable[dict]) -> dict[str, dict]:
    """What each member of the bundle was made of, where entries tell."""
    by_member: dict[str, dict] = {}
    for entry in history:
        entries = entry.get("sources")
        by_member |= entries if isinstance(entries, dict) else {}
    return by_member


def check_history(scene: SceneGraph, path: str) -> None:
    """BadSchema where the history, which the format leaves free, does not tell of objects as an edit needs
    them."""
    for entry in scene.history:
        try:
            msgspec.convert(entry.get("names", []), list[str])
            entries = list(msgspec.convert(entry.get("sources", {}), dict[str, Source]).values())
            for node in msgspec.convert(entry.get("nodes", []), list[DistilledNode]):
                for matrix in (node.object_to_world, node.source_matrix or np.eye(4)):
                    check_affine(np.array(matrix), f"'{node.name}'")
                entries.append(node)
            if not all(one.source.isprintable() for one in entries):
                raise ValueError("a source that is no path")
        except (ValueError, FormatError) as error:
            raise BadSchema(f"{path}: its history is malformed ({error}); fuse the scene again") from error


def summed_up(history: tuple[dict, ...], members: Container[str]) -> tuple[dict, ...]:
    """A history that tells of the same objects in at most 2 KEPT entries: the first one keeps what it says of
    how the field was fused, names the objects that were there KEPT edits ago, and counts the edits that led
    there. Of sources it tells those of some members alone."""
    if len(history) <= 2 * KEPT:
        return history
    early, late = history[:-KEPT], history[-KEPT:]
    first = early[0] if early[0].get("event") == "fused" else {"event": "edited"}
    edits = sum(entry.get("edits", 0) + 1 for entry in early) - 1
    rest = {key: value for key, value in first.items() if key not in ("names", "objects")}
    rest |= {"nodes": list(distilled(early).values()), "edits": edits}
    made_of = {member: one for member, one in sources(early).items() if member in members}
    return (rest | ({"sources": made_of} if made_of else {}), *late)


def listed(values: object) -> list:
    """The values, if they are a list."""
    return values if isinstance(values, list) else []


def names_of(entry: dict) -> list[str]:
    """The objects that an entry tells of."""
    nodes = [node.get("name") for node in listed(entry.get("nodes")) if isinstance(node, dict)]
    names = [name for key in ("names", "objects") for name in listed(entry.get(key))]
    return [name for name in dict.fromkeys([*names, *nodes]) if isinstance(name, str)]


def psnr_of(entry: dict) -> float | None:
    """The dB that an edit or a fuse reached, as its entry says."""
    psnr = entry.get("psnr")
    psnr = psnr.get("stored", psnr.get("psnr")) if isinstance(psnr, dict) else psnr
    return float(psnr) if isinstance(psnr, int | float) else None
