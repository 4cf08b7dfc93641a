"""The `.rfpack` bundle: a scene graph and the fields it places, in one file; see `formats/SPEC.md`."""

import hashlib
import math
import re
from collections.abc import Container, Iterable, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from formats.archive import MAGIC, read_archive, sha256_of_bytes, write_archive
from formats.atomic import atomic_writer, check_writable
from formats.blocks import Instance, Unfolded, unfolded
from formats.camera_set import read_camera_set
from formats.errors import (
    BadHeader,
    BadSchema,
    ChecksumMismatch,
    FormatError,
    MissingMember,
    UnknownMember,
)
from formats.field_header import FieldHeader, decode_header
from formats.nodes import WHITE
from formats.object_summary import objects_in, world_aabb
from formats.records import FieldRecord, StoredArrays, decode_field, encode_field, member_name
from formats.safe_input import open_input
from formats.scene import FORMAT, MEMBER, SceneGraph, dump_scene, parse_scene, read_scene

SCENE = "scene.json"
SHARED = "shared"  # of a field's metadata: its parts that are members of their own
PART = "part"  # the kind of such a member


@dataclass(frozen=True)
class Bundle:
    """A scene graph and its fields by member name, `fields/<sha256[:16]>.safetensors`."""

    scene: SceneGraph
    fields: dict[str, FieldRecord]


class FieldSet:
    """Fields in their bytes, of which none is decoded before it is asked for."""

    def __init__(
        self,
        path: Path | str,
        views: Mapping[str, bytes | memoryview],
        headers: Mapping[str, FieldHeader] | None = None,
        instances: Mapping[str, tuple[Instance, ...]] | None = None,
    ):
        """views: their bytes, by member. path leads error sentences."""
        self.path, self.views, self.instances = Path(path), dict(views), dict(instances or {})
        where = str(path)
        self.headers = {
            name: (headers or {}).get(name) or decode_header(data, f"{where}: {name}")
            for name, data in self.views.items()
        }

    def with_fields(self, views: Mapping[str, bytes | memoryview]) -> "FieldSet":
        """These fields and others."""
        return FieldSet(self.path, self.views | dict(views), self.headers, self.instances)

    @property
    def copied(self) -> int:
        """Bytes of fields that lie in memory, not in the file alone: those of a version that is unfolded."""
        return sum(len(data) for data in self.views.values() if isinstance(data, bytes))

    def data(self, member: str) -> bytes | memoryview:
        """A field's bytes. Raises MissingMember."""
        if member not in self.headers:
            raise MissingMember(f"{self.path}: holds no member {member!r}")
        return self.views[member]

    def sizes(self, member: str) -> dict[str, int]:
        """Bytes of a field's member and of those that it shares with others, by their names. Raises as
        `shared_members`."""
        shared = shared_members(member, self.headers[member], self.headers, str(self.path))
        return {name: self.headers[name].size for name in (member, *shared.values())}

    def placed(self, member: str) -> tuple[Instance, ...]:
        """What a member stands for, which may have held several objects; nothing of one that is not here."""
        alone = (Instance("", False, member, np.eye(4), WHITE),) if member in self.headers else ()
        return self.instances.get(member, alone)

    def arrays(self, member: str) -> StoredArrays:
        """A field's own arrays, each decoded when it is asked for. Raises MissingMember."""
        return StoredArrays(self.data(member), self.headers[member], f"{self.path}: {member}")

    def field(self, member: str) -> FieldRecord:
        """One field. Raises MissingMember, and as `decode_field`."""
        record = decode_field(self.data(member), f"{self.path}: {member}")
        for part, name in shared_members(member, record, self.headers, str(self.path)).items():
            shared = decode_field(self.views[name], f"{self.path}: {name}")
            record.arrays.update({f"{part}.{key}": array for key, array in shared.arrays.items()})
        return record


class OpenBundle(FieldSet):
    """A bundle that was opened and verified once, and is read from that version to the end: whatever takes
    its name meanwhile is another file. Fields of several objects, which earlier versions wrote, are read as
    nodes, each with a field of its own (formats/blocks.py)."""

    def __init__(self, path: Path | str, *, verify: bool = True):
        """Every byte is checked, but no array decoded; without `verify` the checksums are not. Raises a
        FormatError naming the file and the member: see `formats/errors.py`."""
        views = read_archive(path, verify=verify)
        self._file = memoryview(views[SCENE].obj)
        read = _unfolded(views, str(path), verify)
        super().__init__(path, read.views, read.headers, read.instances)
        self.scene = read.scene

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return len(self._file)

    @cached_property
    def sha256(self) -> str:
        """Hex SHA-256 of the file's bytes."""
        return sha256_of_bytes(self._file)


class BundleWriter:
    """Collects encoded fields, then writes them with a scene graph that names them.

    >>> writer = BundleWriter()
    >>> member = writer.add_field(record)
    >>> writer.write("chair.rfpack", SceneGraph((make_node("chair", field=member),)))
    """

    def __init__(self):
        self.members: dict[str, bytes | memoryview] = {}

    def add_field(self, record: FieldRecord, precision: str = "float16") -> str:
        """The member name of `record`, encoded; equal fields share one member. Raises as `encode_field`.

        The parts that `record.metadata["shared"]` names, arrays NAME.*, become members of their own, so that
        what several fields share lies in the bundle once.
        """
        if SHARED in record.metadata:
            record = self._with_parts_apart(record, precision)
        data = encode_field(record, precision)
        name = member_name(data)
        self.members[name] = data
        return name

    def _with_parts_apart(self, record: FieldRecord, precision: str) -> FieldRecord:
        arrays, parts = dict(record.arrays), {}
        for part in record.metadata[SHARED]:
            remaining = {
                n.removeprefix(f"{part}."): arrays.pop(n) for n in record.arrays if n.startswith(f"{part}.")
            }
            parts[part] = self.add_field(FieldRecord(PART, remaining), precision)
        return FieldRecord(record.kind, arrays, record.metadata | {SHARED: parts})

    def copy_field(self, bundle: FieldSet | Path | str, member: str) -> str:
        """Take over a member of another bundle, and the parts it shares, byte for byte. Raises MissingMember,
        and of a path as `read_bundle`."""
        bundle = bundle if isinstance(bundle, FieldSet) else OpenBundle(bundle)
        for name in bundle.sizes(member) if member in bundle.headers else (member,):
            self.members[name] = bundle.data(name)
        return member

    def unfolded(self, scene: SceneGraph) -> SceneGraph:
        """A scene of the fields that were added, in which those of several objects became nodes with a field
        each (formats/blocks.py)."""
        headers = {name: decode_header(data, name) for name, data in self.members.items()}
        read = unfolded(scene, self.members, headers, writing=True)
        self.members = read.views
        return read.scene

    def write(self, path: Path | str, scene: SceneGraph, *, overwrite: bool = False) -> None:
        """The bundle of a scene at `path`, whole or not at all.

        Raises MissingMember (a node names a field not added), OutputExists, ResourceError, LimitExceeded.
        """
        check_fields(scene, self.members, str(path))
        content = dump_scene(scene)
        check_writable(path, overwrite)
        members = [(SCENE, content), *sorted(self.members.items())]
        with atomic_writer(path, reserve=sum(len(data) for _, data in members)) as file:
            write_archive(file, members)


def read_bundle(path: Path | str, *, verify: bool = True) -> Bundle:
    """The bundle at `path`, every byte of it checked; without `verify` the checksums are not.

    Raises a FormatError naming the file and the member: see `formats/errors.py`.
    """
    return _bundle(read_archive(path, verify=verify), str(path), verify)


def read_headers(path: Path | str, *, verify: bool = True) -> tuple[SceneGraph, dict[str, FieldHeader]]:
    """The scene of the bundle at `path` and the headers of its fields, by member; no array is decoded, but
    with `verify` every byte is checked. Raises as `read_bundle`.
    """
    bundle = OpenBundle(path, verify=verify)
    return bundle.scene, bundle.headers


def shared_members(
    member: str, field: FieldRecord | FieldHeader, members: Container[str], where: str
) -> dict[str, str]:
    """The members in which the parts lie that a field shares with others, by the part's name. Raises
    BadSchema and MissingMember."""
    parts = field.metadata.get(SHARED, {})
    if not isinstance(parts, dict) or not all(isinstance(name, str) for name in parts.values()):
        raise BadSchema(f"{where}: {member}: '{SHARED}' should name a member for each shared part")
    for part, name in parts.items():
        if name not in members or name == member:
            raise MissingMember(f"{where}: {member} shares {part!r} as {name!r}, no member of this bundle")
    return parts


def read_summary(path: Path | str) -> dict:
    """What `info` reports of a bundle or a plain scene.json, JSON-able; arrays are checked by CRC-32 alone.

    Boxes are (6,) lists: `aabb` in the frame of the file that the object came in, `world_aabb` the box
    around its eight placed corners.
    `objects` are what a fused field was made of (formats/object_summary.py); a plain scene has nodes alone.
    """
    with open_input(path) as file:
        is_json = file.read(64).lstrip()[:1] == b"{"
    if is_json:
        return summary_of(read_scene(path), str(path), Path(path).stat().st_size)
    views = read_archive(path)
    read = _unfolded(views, str(path), verify=False)
    # The size of the file that was mapped: the path may name another file by now.
    return summary_of(read.scene, str(path), len(views[SCENE].obj), read.headers)


def summary_of(
    scene: SceneGraph, path: str, size: int, headers: dict[str, FieldHeader] | None = None
) -> dict:
    """`read_summary` of a scene that was read from `path`, in so many bytes; headers: those of a bundle."""
    return {
        "path": path,
        "format": "scene" if headers is None else FORMAT,
        "bytes": size,
        **_scene_summary(scene, headers or {}),
        "fields": [_field_summary(name, header) for name, header in sorted((headers or {}).items())],
    }


def is_bundle(path: Path | str) -> bool:
    """Whether the file's content, not its name, is a bundle, whole or damaged."""
    try:
        with open_input(path) as file:
            head = file.read(40)
    except FormatError:
        return False
    return head[:4] == MAGIC or head[30:] == SCENE.encode()


def sha256_of(path: Path | str) -> str:
    """Hex SHA-256 of a file's bytes."""
    with open_input(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def check_fields(scene: SceneGraph, members: Iterable[str], where: str) -> None:
    """Every field that a node names is among `members`; MissingMember otherwise."""
    for leaf in scene.leaves():
        if leaf.field is not None and leaf.field not in members:
            raise MissingMember(
                f"{where}: node {leaf.name!r} names {leaf.field!r}, which is not a member of this bundle"
            )


def _bundle(views: dict[str, memoryview], where: str, verify: bool) -> Bundle:
    scene, fields = _scene_and_fields(views, where, verify)
    return Bundle(scene, {name: fields.field(name) for name in fields.headers})


def _unfolded(views: dict[str, memoryview], where: str, verify: bool) -> Unfolded:
    """The scene, and the headers of its fields."""
    scene, fields = _scene_and_fields(views, where, verify)
    for member, header in fields.headers.items():
        shared_members(member, header, fields.headers, where)
    try:
        return unfolded(scene, fields.views, fields.headers)
    except FormatError as error:
        raise error.within(where) from error


def _scene_and_fields(views: dict[str, memoryview], where: str, verify: bool) -> tuple[SceneGraph, FieldSet]:
    """What a bundle stores; the scene comes first, which says where a newer version is needed."""
    first = next(iter(views))
    if first != SCENE:
        raise UnknownMember(f"{where}: begins with member {first!r}, expected {SCENE!r}")
    scene = parse_scene(bytes(views[SCENE]), f"{where}: {SCENE}")
    members = _checked_members(views, where, verify)
    check_fields(scene, members, where)
    return scene, FieldSet(where, members)


def _checked_members(views: dict[str, memoryview], where: str, verify: bool) -> dict[str, memoryview]:
    """A bundle's fields by member; their names are checked, their order and, with `verify`, their SHA-256."""
    names = [name for name in views if name != SCENE]
    for name in names:
        if not re.fullmatch(MEMBER, name):
            raise UnknownMember(f"{where}: member {name!r}, expected {SCENE} and fields/<16 hex>.safetensors")
        if verify and member_name(views[name]) != name:
            raise ChecksumMismatch(f"{where}: member {name} is damaged (SHA-256); copy the file again")
    if names != sorted(names):
        raise BadHeader(f"{where}: its members are not sorted by name; write it with fusedrf")
    return {name: views[name] for name in names}


def _scene_summary(scene: SceneGraph, headers: dict[str, FieldHeader]) -> dict:
    nodes = []
    for node, depth, object_to_world in scene.walk():
        header = headers.get(node.field)
        aabb = own = header.box if header else None
        if aabb and node.source_matrix is not None:
            own = world_aabb(aabb, np.array(node.source_matrix))
        nodes.append(
            {
                "name": node.name,
                "depth": depth,
                "field": node.field,
                "source": node.source,
                "kind": header.kind if header else None,
                "background": node.background,
                "object_to_world": object_to_world.tolist(),
                "aabb": own,
                "world_aabb": world_aabb(aabb, object_to_world) if aabb else None,
            }
        )
    return {
        "version": scene.version,
        "generator": scene.generator,
        "composition": scene.composition,
        "framing": scene.framing and list(scene.framing),
        "up": scene.up and list(scene.up),
        "cameras": scene.cameras and read_camera_set(scene.cameras).summary(),
        "nodes": nodes,
        "objects": objects_in(scene, headers),
        "history": list(scene.history),
    }


def _field_summary(name: str, header: FieldHeader) -> dict:
    arrays = {key: {"dtype": dtype, "shape": list(s)} for key, (dtype, s) in sorted(header.arrays.items())}
    count = sum(math.prod(shape) for _, shape in header.arrays.values())
    return {
        "member": name,
        "kind": header.kind,
        "precision": header.precision,
        "bytes": header.size,
        "parameters": count,
        "arrays": arrays,
        "metadata": header.metadata,
    }
