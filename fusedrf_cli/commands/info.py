"""`fusedrf info`: what is in a bundle or scene, without decoding its arrays, or what `train` would read."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType


def _brief(summary: dict) -> dict:
    """The summary as people want it: matrices, arrays and checksums are for `--json`."""
    if "nodes" not in summary:
        return _brief_overview(summary)
    nodes = [
        {
            "name": "  " * (node["depth"] - 1) + node["name"],
            "kind": node["kind"],
            "source": node["source"],
            "background": node["background"] or None,
            "at": [row[3] for row in node["object_to_world"][:3]],
            "box": node["world_aabb"],
        }
        for node in summary["nodes"]
    ]
    shown = ("member", "kind", "precision", "bytes", "parameters")
    fields = [{key: field[key] for key in shown} for field in summary["fields"]]
    history = [_scalars(event) for event in summary["history"]]
    cameras = summary["cameras"] and _cameras(summary["cameras"])
    return {
        **summary,
        "cameras": cameras,
        "nodes": nodes,
        "objects": _inside(summary),
        "fields": fields,
        "history": history,
    }


def _brief_overview(facts: dict) -> dict:
    """What is to be told of a capture or mesh: what there is none of is left out, and tables are cut."""
    brief = {key: part for key, part in facts.items() if part and (key, part) != ("made_smaller", 1)}
    for key, noun in (("left_out", "photo"), ("sizes", "size"), ("lenses", "lens")):
        if (more := len(facts.get(key, [])) - 8) > 0:
            brief[key] = [*facts[key][:8], {noun: f"{more} more"}]
    return brief


def _cameras(cameras: dict) -> dict:
    """The cameras of a capture on one line."""
    sizes = cameras["sizes"]
    size = "x".join(map(str, cameras["photo_size"])) + (f" and {sizes - 1} more" if sizes > 1 else "")
    return {key: cameras[key] for key in ("count", "held_out")} | {"photo_size": size}


def _inside(summary: dict) -> list[dict]:
    """The objects of fused fields; nothing where they are just the nodes, which are listed already."""
    if {part["name"] for part in summary["objects"]} <= {node["name"] for node in summary["nodes"]}:
        return []
    return [
        {
            "name": part["name"],
            "kind": part["kind"],
            "inside": part["inside"],
            "at": [row[3] for row in part["object_to_world"][:3]],
            "size": part["size"],
            "bytes": part["bytes"],
            "shared_by": part["shared_by"] if (part["shared_by"] or 1) > 1 else None,
        }
        for part in summary["objects"]
    ]


def _scalars(event: dict) -> dict:
    """An event on one line: names are listed, whatever else has parts is for `--json`."""
    return {key: part for key, part in event.items() if key == "names" or not isinstance(part, dict | list)}


@click.command("info")
@click.argument("scene", type=InputType(stdin=True))
@options.reporting(brief=_brief)
def command(**words):
    """List what a bundle or scene holds, or what `train` would read.

    SCENE is a bundle, a scene.json, - for a scene on stdin, or a capture or mesh as `fusedrf train` takes it:
    of those photos, lenses, box, masks and notes are told. Of one that was learnt from photos their
    cameras are counted. Of a fused bundle the objects are listed with kind, position, size in the world and
    bytes; an object that was distilled into one field with others has no bytes of its own, but the node
    of that field inside which it is. Damage is found, but arrays are not decoded, so the answer is quick.
    With --json a node has its box in its own frame too, "aabb", which crops are in.

    \b
    Example:
      fusedrf info fused.rfpack --json
    """
    return verbs.info(**words)
