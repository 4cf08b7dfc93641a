"""A bundle of fields as they were made."""

from collections.abc import Mapping
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
    """`write_fields` of one field; its node is placed at `origin`: a position (3,), or a placement (4, 4)."""
    return write_fields(
        output, {name: field}, {name: origin}, precision=precision, overwrite=overwrite, about=about
    )


def write_fields(
    output: str,
    fields: Mapping[str, StoredField],
    origins: Mapping[str, np.ndarray | None],
    *,
    precision: str,
    overwrite: bool,
    about: SceneGraph,
) -> int:
    """Write fields as a bundle, a node of its name each, placed at its origin. Of a field that holds several
    objects each becomes a node. Returns the bytes written. History, framing and cameras are those of
    `about`."""
    writer = BundleWriter()
    members = {
        name: writer.add_field(FieldRecord(field.kind, *field.state()), precision)
        for name, field in fields.items()
    }
    graph = writer.unfolded(graph_of(members, origins, about))
    writer.write(output, graph, overwrite=overwrite)
    return Path(output).stat().st_size


def graph_of(
    members: Mapping[str, str], origins: Mapping[str, np.ndarray | None], about: SceneGraph
) -> SceneGraph:
    """The scene of a bundle of fields, which are its members; see `write_fields`."""
    nodes = tuple(
        make_node(name, field=member, **({} if at is None else placement_of(placement(at))))
        for (name, member), at in zip(members.items(), map(origins.get, members), strict=True)
    )
    return replace(about, nodes=nodes, generator=f"fusedrf {__version__}")


def check_graph(output: str, origins: Mapping[str, np.ndarray | None], about: SceneGraph) -> None:
    """Before fields are learnt: raise what `write_fields` would because of where they lie and what is kept
    with them."""
    try:
        dump_scene(graph_of(dict.fromkeys(origins, NO_MEMBER), origins, about))
    except FormatError as error:
        raise error.within(output) from error
