"""The `.rfpack` bundle: a scene graph and the fields it places, in one file; see `formats/SPEC.md`."""

import hashlib
import math
import re
from collections.abc import Container, Iterable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from formats.archive import MAGIC, parse_archive, pieces, read_archive, write_archive
from formats.atomic import atomic_writer, check_writable
from formats.contents import objects_in, world_aabb
from formats.errors import (
    BadHeader,
    BadSchema,
    ChecksumMismatch,
    FormatError,
    MissingMember,
    UnknownMember,
)
from formats.inputs import open_input
from formats.records import (
    FieldHeader,
    FieldRecord,
    decode_field,
    decode_header,
    encode_field,
    mapped_array,
)
from formats.rig import read_rig
from formats.scene import (
    FORMAT,
    MEMBER,
    SceneGraph,
    dump_scene,
    make_node,
    parse_scene,
    read_scene,
)

SCENE = "scene.json"
SHARED = "shared"  # of a field's metadata: its parts that are members of their own
PART = "part"  # the kind of such a member


@dataclass(frozen=True)
class Bundle:
    """A scene graph and its fields by member name, `fields/<sha256[:16]>.safetensors`."""

    scene: SceneGraph
    fields: dict[str, FieldRecord]


class OpenBundle:
    """A bundle that was opened and verified once, and is read from that version to the end: whatever takes
    its name meanwhile is another file."""

    def __init__(self, path: Path | str, *, verify: bool = True):
        """Every byte is checked, but no array decoded; without `verify` the checksums are not. Raises a
        FormatError naming the file and the member: see `formats/errors.py`."""
        self.path = Path(path)
        views = read_archive(path, verify=verify)
        self.scene, self.headers = _headers(views, str(path), verify)
        self._views = views

    @property
    def size(self) -> int:
        """Bytes of the file."""
        return len(self._views[SCENE].obj)

    @cached_property
    def sha256(self) -> str:
        """Hex SHA-256 of the file's bytes."""
        return _sha256(memoryview(self._views[SCENE].obj))

    def data(self, member: str) -> memoryview:
        """A field's bytes. Raises MissingMember."""
        if member not in self.headers:
            raise MissingMember(f"{self.path}: holds no member {member!r}")
        return self._views[member]

    def field(self, member: str) -> FieldRecord:
        """One field. Raises MissingMember, and as `decode_field`."""
        record = decode_field(self.data(member), f"{self.path}: {member}")
        for part, name in shared_members(member, record, self.headers, str(self.path)).items():
            _take_part(record, part, decode_field(self._views[name], f"{self.path}: {name}"))
        return record

    def array(self, member: str, name: str) -> np.ndarray:
        """One array of a field as it is stored, read-only. Raises MissingMember and KeyError."""
        return mapped_array(self.data(member), self.headers[member].specs[name])


class BundleWriter:
    """Collects encoded fields, then writes them with a scene graph that names them.

    >>> writer = BundleWriter()
    >>> member = writer.add_field(record)
    >>> writer.write("chair.rfpack", SceneGraph((make_node("chair", field=member),)))
    """

    def __init__(self, scene: SceneGraph | None = None):
        self.scene = scene
        self.members: dict[str, bytes] = {}

    def add_field(self, record: FieldRecord, precision: str = "float16") -> str:
        """The member name of `record`, encoded; equal fields share one member. Raises as `encode_field`.

        The parts that `record.metadata["shared"]` names, arrays NAME.*, become members of their own, so that
        what several fields share lies in the bundle once.
        """
        if SHARED in record.metadata:
            record = self._with_parts_apart(record, precision)
        name, data = field_member(record, precision)
        self.members[name] = data
        return name

    def _with_parts_apart(self, record: FieldRecord, precision: str) -> FieldRecord:
        arrays, parts = dict(record.arrays), {}
        for part in record.metadata[SHARED]:
            own = {
                n.removeprefix(f"{part}."): arrays.pop(n) for n in record.arrays if n.startswith(f"{part}.")
            }
            parts[part] = self.add_field(FieldRecord(PART, own), precision)
        return FieldRecord(record.kind, arrays, record.metadata | {SHARED: parts})

    def copy_field(self, bundle: OpenBundle | Path | str, member: str) -> str:
        """Take over a member of another bundle, and the parts it shares, byte for byte. Raises MissingMember,
        and of a path as `read_bundle`."""
        bundle = bundle if isinstance(bundle, OpenBundle) else OpenBundle(bundle)
        header, members = bundle.headers.get(member), bundle.headers
        shared = {} if header is None else shared_members(member, header, members, str(bundle.path))
        for name in (member, *shared.values()):
            self.members[name] = bytes(bundle.data(name))
        return member

    def write(self, path: Path | str, scene: SceneGraph | None = None, *, overwrite: bool = False) -> None:
        """The bundle at `path`, whole or not at all; `scene` defaults to the writer's own.

        Raises MissingMember (a node names a field not added), OutputExists, ResourceError, LimitExceeded.
        """
        scene = scene or self.scene
        check_fields(scene, self.members, str(path))
        content = dump_scene(scene)
        check_writable(path, overwrite)
        members = [(SCENE, content), *sorted(self.members.items())]
        with atomic_writer(path, reserve=sum(len(data) for _, data in members)) as file:
            write_archive(file, members)


def single_field_bundle(
    record: FieldRecord,
    name: str,
    *,
    precision: str = "float16",
    history: Iterable[dict] = (),
    generator: str = "fusedrf",
) -> BundleWriter:
    """A writer whose scene is one node `name` that holds one field; its `write(path)` needs no more."""
    writer = BundleWriter()
    member = writer.add_field(record, precision)
    writer.scene = SceneGraph((make_node(name, field=member),), history=tuple(history), generator=generator)
    return writer


def field_member(record: FieldRecord, precision: str = "float16") -> tuple[str, bytes]:
    """The member name and bytes of one field."""
    data = encode_field(record, precision)
    return member_name(data), data


def member_name(data: bytes | memoryview) -> str:
    """The name that a field's bytes give it."""
    return f"fields/{_sha256(data)[:16]}.safetensors"


def _sha256(data: bytes | memoryview) -> str:
    digest = hashlib.sha256()
    for piece in pieces(data):
        digest.update(piece)
    return digest.hexdigest()


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


def _take_part(record: FieldRecord, part: str, found: FieldRecord) -> None:
    """Give a field the arrays of a part that it shares, as PART.NAME."""
    record.arrays.update({f"{part}.{key}": array for key, array in found.arrays.items()})


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


def parse_bundle(data: bytes | memoryview, where: str) -> Bundle:
    """As `read_bundle`, of bytes."""
    return _bundle(parse_archive(memoryview(data), where), where, verify=True)


def read_summary(path: Path | str) -> dict:
    """What `info` reports of a bundle or a plain scene.json, JSON-able; arrays are checked by CRC-32 alone.

    Boxes are (6,) lists: `aabb` in the object's frame, `world_aabb` the box around its eight placed corners.
    `objects` are what a fused field was made of (formats/contents.py); a plain scene has nodes alone.
    """
    if _is_json(path):
        return summary_of(read_scene(path), str(path), _size(path))
    views = read_archive(path)
    scene, headers = _headers(views, str(path), verify=False)
    fields = [_field_summary(name, header) for name, header in headers.items()]
    return {
        "path": str(path),
        "format": FORMAT,
        # The size of the file that was mapped: the path may name another file by now.
        "bytes": len(views[SCENE].obj),
        **_scene_summary(scene, headers),
        "fields": fields,
    }


def summary_of(scene: SceneGraph, path: str, size: int) -> dict:
    """`read_summary` of a scene that was read from `path`, in so many bytes."""
    return {"path": path, "format": "scene", "bytes": size, **_scene_summary(scene, {}), "fields": []}


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
    scene = _scene(views, where)
    members = _checked_members(views, where, verify)
    check_fields(scene, members, where)
    fields = {name: decode_field(view, f"{where}: {name}") for name, view in members.items()}
    for member, record in fields.items():
        for part, name in shared_members(member, record, fields, where).items():
            _take_part(record, part, fields[name])
    return Bundle(scene, fields)


def _headers(
    views: dict[str, memoryview], where: str, verify: bool
) -> tuple[SceneGraph, dict[str, FieldHeader]]:
    scene = _scene(views, where)
    members = _checked_members(views, where, verify)
    check_fields(scene, members, where)
    headers = {name: decode_header(view, f"{where}: {name}") for name, view in members.items()}
    for member, header in headers.items():
        shared_members(member, header, headers, where)
    return scene, headers


def _scene(views: dict[str, memoryview], where: str) -> SceneGraph:
    first = next(iter(views))
    if first != SCENE:
        raise UnknownMember(f"{where}: begins with member {first!r}, expected {SCENE!r}")
    return parse_scene(bytes(views[SCENE]), f"{where}: {SCENE}")


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


def _is_json(path: Path | str) -> bool:
    with open_input(path) as file:
        return file.read(64).lstrip()[:1] == b"{"


def _size(path: Path | str) -> int:
    return Path(path).stat().st_size


def _scene_summary(scene: SceneGraph, headers: dict[str, FieldHeader]) -> dict:
    nodes = []
    for node, depth, object_to_world in scene.walk():
        header = headers.get(node.field)
        aabb = header.metadata.get("aabb") if header else None
        nodes.append(
            {
                "name": node.name,
                "depth": depth,
                "field": node.field,
                "source": node.source,
                "kind": header.kind if header else None,
                "background": node.background,
                "object_to_world": object_to_world.tolist(),
                "aabb": aabb,
                "world_aabb": world_aabb(aabb, object_to_world) if aabb else None,
            }
        )
    return {
        "version": scene.version,
        "generator": scene.generator,
        "composition": scene.composition,
        "framing": scene.framing and list(scene.framing),
        "cameras": scene.cameras and read_rig(scene.cameras).summary(),
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
