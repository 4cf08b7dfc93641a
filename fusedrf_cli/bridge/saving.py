"""A scene of fields that another program changed, back to a bundle."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from formats.bundle import BundleWriter
from formats.graph import cropped, placement_of, shown
from formats.records import FieldRecord
from formats.scene import Node, SceneGraph
from fusedrf_cli import __version__
from fusedrf_cli.bridge.capture_cameras import result_cameras
from fusedrf_cli.bridge.scene import LoadedScene, showing_of
from fusedrf_cli.engine.fields.base import StoredField


def save_scene(
    output: str | Path,
    scene: LoadedScene,
    fields: Mapping[str, StoredField],
    placements: Mapping[str, np.ndarray],
    *,
    precision: str,
    overwrite: bool,
) -> int:
    """Write a scene with the fields and placements (4, 4), object to world, of its nodes' names as they are
    now, as one bundle; returns its bytes. Fields that several nodes share are stored once.

    What else the scene's own bundle holds (kept sources, its history, keys of later versions) stays; cameras
    of a capture stay where they are in the world. Raises what `BundleWriter.write` and `make_node` raise.
    """
    writer, members, nodes = BundleWriter(), {}, []
    names = {source.placed.name for source in scene.fields}
    for source in scene.fields:
        name = source.placed.name
        field = fields[name]
        if id(field) not in members:
            members[id(field)] = writer.add_field(FieldRecord(field.kind, *field.state()), precision)
        node = placed_node(name, members[id(field)], placements[name], source.background)
        nodes.append(cropped(shown(node, showing_of(source.placed)), source.crops, names))
    history = ()
    if scene.bundle is not None:
        history = scene.graph.history
        placed = {source.member for source in scene.fields}
        for member in scene.bundle.headers.keys() - placed:
            writer.copy_field(scene.bundle, member)
    graph = SceneGraph(
        tuple(nodes),
        scene.composition,
        history,
        f"fusedrf {__version__}",
        extras=scene.graph.extras,
        framing=scene.graph.framing,
        cameras=result_cameras(scene),
        up=scene.graph.up,
    )
    writer.write(output, writer.unfolded(graph), overwrite=overwrite)
    return Path(output).stat().st_size


def placed_node(name: str, member: str, object_to_world: np.ndarray, background: bool) -> Node:
    """A node that holds a field, placed by a (4, 4)."""
    return Node(name, member, None, placement_of(object_to_world), background)
