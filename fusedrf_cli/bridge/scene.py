"""Files to placed engine fields, and back."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from formats.bundle import BundleWriter, is_bundle, read_bundle, sha256_of
from formats.records import FieldRecord
from formats.scene import SceneGraph, expand_scene, inline_scenes, make_node, parse_scene, resolve_source
from fusedrf_cli import __version__
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.base import field_kinds
from fusedrf_cli.errors import InvalidInput

STDIN_LIMIT = 4 << 20


@dataclass(frozen=True)
class SourceField:
    """A field that a scene places, and where it came from."""

    placed: Placed
    background: bool
    path: Path | None
    """The bundle it was read from."""
    member: str
    record: FieldRecord


@dataclass(frozen=True)
class LoadedScene:
    """A scene graph with its fields read."""

    fields: tuple[SourceField, ...]
    composition: str
    graph: SceneGraph
    path: Path | None

    @property
    def placed(self) -> list[Placed]:
        """The placed fields in node order."""
        return [f.placed for f in self.fields]

    def composed(self) -> ComposedField:
        """The scene as one field."""
        return ComposedField(self.placed, self.composition)


def make_field(record: FieldRecord, where: str):
    """An engine field from a bundle's record; InvalidInput for an unknown kind or arrays that do not fit
    it.
    """
    kinds = field_kinds()
    if record.kind not in kinds:
        raise InvalidInput(
            f"{where}: field of unknown kind '{record.kind}'; this version knows {', '.join(sorted(kinds))}"
        )
    try:
        return kinds[record.kind].from_state(record.arrays, record.metadata)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError) as error:
        raise InvalidInput(
            f"{where}: the '{record.kind}' field is malformed ({error}); make the bundle again"
        ) from error


def load_scene(path: str, allow_outside: bool = False) -> LoadedScene:
    """Read a bundle, a scene.json or '-' with all fields it places; equal members become one field, read
    once.
    """
    if path == "-":
        where = Path.cwd() / "scene.json"
        graph = inline_scenes(
            parse_scene(sys.stdin.buffer.read(STDIN_LIMIT + 1), "standard input"), where, allow_outside
        )
        return _load(graph, where, allow_outside)
    if is_bundle(path):
        bundle = read_bundle(path)
        return _load(bundle.scene, Path(path), allow_outside, bundle.fields)
    return _load(expand_scene(path, allow_outside), Path(path), allow_outside)


def _load(
    graph: SceneGraph, path: Path, allow_outside: bool, members: dict[str, FieldRecord] | None = None
) -> LoadedScene:
    cache: dict = {}
    found = []
    for leaf in graph.leaves():
        if leaf.field is not None:
            found.append(
                _source(
                    leaf.name,
                    leaf.object_to_world,
                    leaf.background,
                    path,
                    leaf.field,
                    (members or {})[leaf.field],
                    cache,
                )
            )
        elif leaf.source is not None:
            found += _load_source(leaf, path, allow_outside, cache)
    if not found:
        raise InvalidInput(f"{path}: the scene places no field; add a node with a 'source'")
    return LoadedScene(tuple(found), graph.composition, graph, path)


def _load_source(leaf, path: Path, allow_outside: bool, cache: dict) -> list[SourceField]:
    source = resolve_source(path, leaf.source, allow_outside)
    if source not in cache:
        if not is_bundle(source):
            raise InvalidInput(
                f"{path}: node '{leaf.name}': its source {leaf.source} is no bundle; train it to a "
                ".rfpack first"
            )
        cache[source] = read_bundle(source)
    bundle = cache[source]
    inner = [node for node in bundle.scene.leaves() if node.field is not None]
    if not inner:
        raise InvalidInput(
            f"{source}: the bundle holds no field, so node '{leaf.name}' would be empty; choose another "
            "source"
        )
    named = [leaf.name] if len(inner) == 1 else [f"{leaf.name}/{node.name}" for node in inner]
    return [
        _source(
            name,
            leaf.object_to_world @ node.object_to_world,
            leaf.background,
            source,
            node.field,
            bundle.fields[node.field],
            cache,
        )
        for name, node in zip(named, inner, strict=True)
    ]


def _source(
    name: str,
    object_to_world: np.ndarray,
    background: bool,
    path: Path,
    member: str,
    record: FieldRecord,
    cache: dict,
) -> SourceField:
    if member not in cache:
        cache[member] = make_field(record, f"{path}: node '{name}'")
    try:
        placed = Placed(name, cache[member], object_to_world)
    except ValueError as error:
        raise InvalidInput(f"{path}: {error}; give an invertible placement") from error
    return SourceField(placed, background, path, member, record)


def background_of(scene: LoadedScene) -> SourceField:
    """The node marked as background, else the one with the largest box."""
    marked = [f for f in scene.fields if f.background]
    return (
        marked[0]
        if marked
        else max(scene.fields, key=lambda f: float(np.prod(f.placed.aabb[3:] - f.placed.aabb[:3])))
    )


def history_nodes(scene: LoadedScene, output: str, kept: dict[str, str]) -> list[dict]:
    """What a history entry says of every source: name, placement, box, path from the output's folder,
    checksum, kept member.
    """
    folder, hashes, nodes = Path(output).resolve().parent, {}, []
    for f in scene.fields:
        if f.path is not None and f.path not in hashes and f.path.exists():
            hashes[f.path] = sha256_of(f.path)
        node = {
            "name": f.placed.name,
            "object_to_world": f.placed.object_to_world.tolist(),
            "aabb": f.placed.aabb.tolist(),
            "field": f.member,
            "background": f.background,
            "kept": f.member in kept,
        }
        if f.path in hashes:
            node |= {"source": os.path.relpath(f.path.resolve(), folder), "sha256": hashes[f.path]}
        nodes.append(node)
    return nodes


def write_field(
    output: str,
    field,
    name: str,
    *,
    precision: str,
    overwrite: bool,
    origin: np.ndarray | None = None,
    history: tuple[dict, ...] = (),
    kept: dict[str, FieldRecord] | None = None,
    extras: dict | None = None,
) -> int:
    """Write one field (and kept sources) as a bundle; its node is moved to origin (3,). Returns the bytes
    written. `extras` are the scene's keys that this version does not know.
    """
    writer = BundleWriter()
    for record in (kept or {}).values():
        writer.add_field(record, precision)
    arrays, metadata = field.state()
    member = writer.add_field(FieldRecord(field.kind, arrays, metadata), precision)
    where = None if origin is None or not np.any(origin) else [float(v) for v in origin]
    node = make_node(name, field=member, translation=where)
    generator = f"fusedrf {__version__}"
    graph = SceneGraph(nodes=(node,), history=history, generator=generator, extras=extras or {})
    writer.write(output, graph, overwrite=overwrite)
    return Path(output).stat().st_size
