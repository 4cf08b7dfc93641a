"""A bundle of one field."""

from dataclasses import replace
from pathlib import Path

import numpy as np

from formats.bundle import BundleWriter
from formats.errors import FormatError
from formats.graph import placement_of
from formats.records import FieldRecord, as_stored
from formats.scene import SceneGraph, dump_scene, make_node
from fusedrf_cli import __version__
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import placement

NO_MEMBER = "fields/0000000000000000.safetensors"


def stored(field: StoredField, precision: str) -> StoredField:
    """The field as it will come back from a bundle of that precision."""
    return field.stored(lambda array, name, runs: as_stored(array, precision, name, runs))


def write_field(
    output: str,
    field,
    name: str,
    *,
    precision: str,
    overwrite: bool,
    origin: np.ndarray | None = None,
    about: SceneGraph = SceneGraph(()),
) -> int:
    """Write one field as a bundle; its node is placed at `origin`: a position (3,), or a placement (4, 4). Of
    a field that holds several objects each becomes a node. Returns the bytes written. History, framing and
    cameras are those of `about`."""
    writer = BundleWriter()
    member = writer.add_field(FieldRecord(field.kind, *field.state()), precision)
    graph = writer.unfolded(graph_of(member, name, origin, about))
    writer.write(output, graph, overwrite=overwrite)
    return Path(output).stat().st_size


def graph_of(member: str, name: str, origin: np.ndarray | None, about: SceneGraph) -> SceneGraph:
    """The scene of a bundle of one field; see `write_field`."""
    node = make_node(name, field=member, **({} if origin is None else placement_of(placement(origin))))
    return replace(about, nodes=(node,), generator=f"fusedrf {__version__}")


def check_graph(output: str, name: str, origin: np.ndarray | None, about: SceneGraph) -> None:
    """Before a field is learnt: raise what `write_field` would because of where it lies and what is kept
    with it."""
    try:
        dump_scene(graph_of(NO_MEMBER, name, origin, about))
    except FormatError as error:
        raise error.within(output) from error
