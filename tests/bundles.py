"""Bundles of one field, bundles in bytes, and what bundles may hold, for tests."""

from collections.abc import Iterable
from pathlib import Path

from formats import archive, bundle
from formats.bundle import Bundle, BundleWriter
from formats.records import FieldRecord
from formats.scene import SceneGraph, make_node
from fusedrf_cli.engine.kinds import registry


def write_single(
    path: Path | str,
    record: FieldRecord,
    name: str,
    *,
    precision: str = "float16",
    history: Iterable[dict] = (),
    overwrite: bool = False,
    up: tuple[float, ...] | None = None,
) -> None:
    """A bundle whose scene is one node `name` that holds one field."""
    writer = BundleWriter()
    node = make_node(name, field=writer.add_field(record, precision))
    scene = SceneGraph((node,), history=tuple(history), generator="fusedrf", up=up)
    writer.write(path, scene, overwrite=overwrite)


def parse_bundle(data: bytes | bytearray, where: str) -> Bundle:
    """As `read_bundle`, of bytes."""
    return bundle._bundle(archive.parse_archive(memoryview(data), where), where, verify=True)


def field_kinds() -> dict[str, type]:
    """The fields that bundles may hold and that learn, by kind."""
    kinds = (kind for kind in registry.kinds() if kind.name not in registry.IMPORTED)
    return {kind.name: kind.field for kind in kinds if kind.field is not None}
