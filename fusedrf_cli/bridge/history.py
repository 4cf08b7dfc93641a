"""What was done to a fused field, kept short: its latest edits one by one, and what those before led to."""

from collections.abc import Iterable

from formats.scene import SceneGraph

KEPT = 32
"""Edits that are told one by one; twice as many before they are summed up."""


def graph_nodes(scene: SceneGraph) -> list[dict]:
    """The named objects that the history says are in the field now."""
    return list(nodes_of(scene.history).values())


def nodes_of(history: Iterable[dict]) -> dict[str, dict]:
    """By name, the objects that entries put in and did not take out again; one that does both, as where an
    object is replaced, takes out first."""
    nodes: dict[str, dict] = {}
    for entry in history:
        for name in entry.get("names", ()):
            nodes.pop(name, None)
        for node in entry.get("nodes", ()):
            nodes[node["name"]] = node
    return nodes


def summed_up(history: tuple[dict, ...]) -> tuple[dict, ...]:
    """A history that tells of the same objects in at most 2 KEPT entries: the first one keeps what it says of
    how the field was fused, names the objects that were there KEPT edits ago, and counts the edits that led
    there."""
    if len(history) <= 2 * KEPT:
        return history
    early, late = history[:-KEPT], history[-KEPT:]
    first = early[0] if early[0].get("event") == "fused" else {"event": "edited"}
    edits = sum(entry.get("edits", 0) + 1 for entry in early) - 1
    told = {key: value for key, value in first.items() if key != "names"}
    return (told | {"nodes": list(nodes_of(early).values()), "edits": edits}, *late)
