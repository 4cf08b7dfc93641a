"""glTF 2.0 files, .gltf and .glb: the surfaces of their scene, placed, at rest.

Nodes, skins and morph weights stand as the file has them; animations are not played. What the file
requires and is not known is an error; whatever else it names and is not shown is a note.
"""

import struct
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from formats.errors import BadMesh, MissingExtra, listed
from formats.safe_input import read_input
from formats.surfaces import gltf_schema as schema
from formats.surfaces.accessors import MESHOPT, Buffers, normalised
from formats.surfaces.draco import DRACO, draco_arrays
from formats.surfaces.gltf_materials import (
    GLOSSINESS,
    PICTURE_EXTENSIONS,
    STRENGTH,
    TRANSFORM,
    UNLIT,
    Materials,
    Slot,
)
from formats.surfaces.gltf_nodes import INSTANCING, VISIBILITY, Nodes
from formats.surfaces.named_files import Beside
from formats.surfaces.surface import (
    Notes,
    Paint,
    Surface,
    check_budget,
    check_indices,
    laid,
    sound_colours,
)

KNOWN = {
    DRACO,
    *MESHOPT,
    INSTANCING,
    VISIBILITY,
    "KHR_mesh_quantization",
    TRANSFORM,
    GLOSSINESS,
    STRENGTH,
    UNLIT,
    *PICTURE_EXTENSIONS,
}
COLOUR_ONLY = "KHR_materials_"
"""Extensions of this name change how a material takes light, which is not shown; its colour is."""
WITHOUT_LOOKS = {
    "KHR_xmp_json_ld",
    "KHR_xmp",
    "KHR_node_selectability",
    "KHR_node_hoverability",
}
MAX_FILE = 2**32
JSON_CHUNK, BINARY_CHUNK = 0x4E4F534A, 0x004E4942
TRIANGLES, STRIP, FAN = 4, 5, 6
SKINNED_AT_ONCE = 1 << 16


def read_gltf(path: Path | str, notes: Notes) -> list[Surface]:
    """All triangles of the shown scene. Raises BadJson, BadMesh, LimitExceeded, MissingExtra, MissingFile,
    OutsideFolder."""
    document, binary = read_document(path, read_input(path, MAX_FILE))
    check_extensions(document, path, notes, KNOWN)
    buffers = Buffers(document, path, Beside(path), binary)
    return _Reader(document, path, buffers, notes).surfaces()


def read_document(path: Path | str, data: bytes) -> tuple[schema.Document, memoryview | None]:
    """The JSON of a .gltf or .glb, and the binary chunk of a .glb. Raises BadJson, BadMesh, LimitExceeded."""
    if not data.startswith(b"glTF"):
        return schema.decode(data, str(path)), None
    if len(data) < 12:
        raise BadMesh(f"{path}: ends within its header; copy or export it again")
    _, version, length = struct.unpack_from("<4sII", data)
    if version != 2:
        raise BadMesh(f"{path}: a .glb of version {version}, but 2 is read; convert it to glTF 2.0")
    if length > len(data):
        raise BadMesh(f"{path}: has {len(data):,} of {length:,} bytes; copy or export it again")
    chunks = list(_chunks(data[:length], path))
    if not chunks or chunks[0][0] != JSON_CHUNK:
        raise BadMesh(f"{path}: does not begin with a chunk of JSON; export it again")
    binary = chunks[1][1] if len(chunks) > 1 and chunks[1][0] == BINARY_CHUNK else None
    return schema.decode(bytes(chunks[0][1]).rstrip(b"\0 "), str(path)), binary


def _chunks(data: bytes, path: Path | str) -> Iterator[tuple[int, memoryview]]:
    at = 12
    while at + 8 <= len(data):
        length, kind = struct.unpack_from("<II", data, at)
        if at + 8 + length > len(data):
            raise BadMesh(f"{path}: ends within a chunk of {length:,} bytes; copy or export it again")
        yield kind, memoryview(data)[at + 8 : at + 8 + length]
        at += 8 + length


def check_extensions(document: schema.Document, path: Path | str, notes: Notes, known: set[str]) -> None:
    """Raises BadMesh where one is required that is not `known`; others are notes."""

    def unknown(names):
        return [name for name in names if name not in known | WITHOUT_LOOKS]

    required = [name for name in unknown(document.extensions_required) if not name.startswith(COLOUR_ONLY)]
    if required:
        raise BadMesh(f"{path}: requires {listed(required)}, which is not known here; export it without that")
    owners = [document, *document.nodes, *document.meshes]
    owners += [primitive for mesh in document.meshes for primitive in mesh.primitives]
    there = [name for owner in owners for name in owner.extensions]
    if used := unknown(dict.fromkeys([*document.extensions_used, *document.extensions_required, *there])):
        notes.add(f"uses {listed(used)}, which is not shown")


class _Reader:
    """One document's surfaces."""

    def __init__(self, document: schema.Document, path: Path | str, buffers: Buffers, notes: Notes):
        self.document, self.path, self.buffers, self.notes = document, path, buffers, notes
        self.materials = Materials(document, buffers, notes)
        self.nodes = Nodes(document, path, buffers, notes)
        self.left_out = 0
        self.triangles = 0
        self.shapes: dict[tuple[int, int], _Shape] = {}

    def surfaces(self) -> list[Surface]:
        surfaces = []
        for index in self.nodes.shown:
            if self.document.nodes[index].mesh is not None:
                surfaces += self._node(index)
        self._tell()
        return [surface for surface in surfaces if len(surface.faces)]

    def _tell(self) -> None:
        if self.left_out:
            self.notes.add(f"{self.left_out} primitives of points or lines are left out")
        self.nodes.tell()
        self.materials.tell_unused()

    # --- nodes ----------------------------------------------------------------------------------------------

    def _node(self, index: int) -> list[Surface]:
        node = self.document.nodes[index]
        mesh = self.buffers.item("meshes", node.mesh)
        weights = mesh.weights if node.weights is None else node.weights
        worlds = self.nodes.instances(index)
        surfaces = []
        for number, primitive in enumerate(mesh.primitives):
            where = f"{self.path}: mesh {mesh.name[:60] or node.mesh!r}, primitive {number}"
            if primitive.mode not in (TRIANGLES, STRIP, FAN):
                self.left_out += 1
                continue
            shape = self.shapes.get((node.mesh, number))
            if shape is None:
                shape = self.shapes[node.mesh, number] = _Shape(self, primitive, where)
            self.triangles += len(shape.faces) * len(worlds)
            check_budget(self.path, self.triangles, self.buffers.size)
            surfaces += shape.placed(worlds, weights, node.skin)
        return surfaces

    def joints(self, index: int) -> np.ndarray:
        """(n_joints, 4, 4) from the mesh at rest to the world."""
        skin = self.buffers.item("skins", index)
        for joint in skin.joints:
            self.buffers.item("nodes", joint)
        worlds = np.array([self.nodes.worlds[joint] for joint in skin.joints]).reshape(-1, 4, 4)
        if skin.inverse_bind_matrices is None:
            return worlds
        inverse = self.buffers.numbers(skin.inverse_bind_matrices, (16,)).astype(np.float64)
        if len(inverse) < len(worlds):
            raise BadMesh(f"{self.path}: skin {index} has fewer bind matrices than joints; export it again")
        return worlds @ inverse[: len(worlds)].reshape(-1, 4, 4).transpose(0, 2, 1)


class _Shape:
    """One primitive of triangles: its faces and the attributes of the vertices that they use."""

    def __init__(self, reader: _Reader, primitive: schema.Primitive, where: str):
        self.reader, self.buffers, self.primitive, self.where = reader, reader.buffers, primitive, where
        self.called = where.removeprefix(f"{reader.path}: ")
        self.unpacked = self._draco()
        if "POSITION" not in primitive.attributes:
            self.faces, self.chosen = np.empty((0, 3), np.int32), np.empty(0, np.int64)
            reader.notes.add("has no positions and is left out", self.called)
            return
        count = self._count()
        indices, mode = self._indices(count), TRIANGLES if self.unpacked else primitive.mode
        if mode == TRIANGLES and len(indices) % 3:
            left = "counts corners that are no whole triangles; the last ones are left out"
            reader.notes.add(left, self.called)
        faces = _triangles(indices, mode)
        check_indices(where, faces.reshape(-1), count)
        used = np.zeros(count, bool)
        used[faces.reshape(-1)] = True
        self.chosen = np.flatnonzero(used)
        self.faces = (np.cumsum(used) - 1)[faces].astype(np.int32).reshape(-1, 3)

    def _count(self) -> int:
        if "POSITION" in self.unpacked:
            return len(self.unpacked["POSITION"])
        index = self.primitive.attributes["POSITION"]
        return len(self.buffers.rows(index, (3,)))

    def _indices(self, count: int) -> np.ndarray:
        if "indices" in self.unpacked:
            return self.unpacked["indices"].reshape(-1).astype(np.int64)
        if self.primitive.indices is None:
            return np.arange(count)
        rows = self.buffers.rows(self.primitive.indices, (1,))
        if rows.dtype.kind != "u":
            raise BadMesh(f"{self.where}: its indices are {rows.dtype}, expected whole numbers without sign")
        if len(rows) and rows.max() == np.iinfo(rows.dtype).max:
            reserved = "counts up to the index that glTF reserves; it is shown as a vertex like others"
            self.reader.notes.add(reserved, self.called)
        return rows[:, 0].astype(np.int64)

    def _draco(self) -> dict[str, np.ndarray]:
        """Decoded attributes by name, and "indices"; nothing where the primitive is not compressed, or where
        it has its plain numbers too and the library is missing."""
        draco = self.primitive.extension(DRACO, schema.Draco, self.where)
        if draco is None:
            return {}
        try:
            return draco_arrays(bytes(self.buffers.view(draco.buffer_view)), draco.attributes, self.where)
        except MissingExtra:
            accessors = [self.buffers.item("accessors", i) for i in self.primitive.attributes.values()]
            if any(accessor.buffer_view is None for accessor in accessors):
                raise
            return {}

    def _attribute(self, name: str, widths: tuple[int, ...]) -> np.ndarray | None:
        """(used vertices, n) float32 of an attribute, None where there is none."""
        index = self.primitive.attributes.get(name)
        colour = name.startswith("COLOR_")  # some exporters forget that its integers are normalised
        if name in self.unpacked:
            rows = self.unpacked[name]
            if rows.ndim != 2 or rows.shape[1] not in widths:
                raise BadMesh(f"{self.where}: {name} has {rows.shape[1:]} numbers a vertex")
            scaled = colour or index is not None and self.buffers.item("accessors", index).normalized
            rows = rows[self.chosen]
            return normalised(rows) if scaled else rows.astype(np.float32)
        return None if index is None else self.buffers.numbers(index, widths, self.chosen, colour)

    def _morphed(self, name: str, widths: tuple[int, ...], weights: list[float]) -> np.ndarray | None:
        """An attribute with its morph targets added by their weights."""
        plain = self._attribute(name, widths)
        if plain is None:
            return None
        for weight, target in zip(weights, self.primitive.targets, strict=False):
            if weight and name in target:
                moved = self.buffers.numbers(target[name], (), self.chosen)
                if moved.shape[1] not in widths or moved.shape[1] > plain.shape[1]:
                    raise BadMesh(f"{self.where}: a morph target of {name} has {moved.shape[1]} numbers")
                plain = plain.copy()
                plain[:, : moved.shape[1]] += np.float32(weight) * moved
        return plain

    def placed(self, worlds: list[np.ndarray], weights: list[float], skin: int | None) -> list[Surface]:
        """The primitive's surface in each of its worlds (mesh_to_world, (4, 4))."""
        if not len(self.faces):
            return []
        look = self.reader.materials.look(self.primitive.material)
        colours = self._morphed("COLOR_0", (3, 4), weights)
        rest = {
            "faces": self.faces,
            "paint": self._paint(look.base, weights),
            "glow": None if look.glow is None else self._paint(look.glow, weights),
            "colours": None if colours is None else sound_colours(colours),
            "linear": True,
            "cutoff": look.cutoff,
            "blend": look.blend,
            "single_sided": look.single_sided,
        }
        if more := [
            name for name in self.primitive.attributes if name.startswith("COLOR_") and name != "COLOR_0"
        ]:
            self.reader.notes.add(f"vertex colours {listed(more)} are not used, COLOR_0 is")
        points = self._morphed("POSITION", (3,), weights).astype(np.float64)
        mirrored = rest | {"faces": self.faces[:, [0, 2, 1]]}  # their fronts stay fronts
        if skin is not None and "JOINTS_0" in self.primitive.attributes:
            points, turned = self._skinned(points, skin)
            return [Surface(points, **(mirrored if turned else rest))]
        return [
            Surface(
                points @ world[:3, :3].T + world[:3, 3],
                **(mirrored if np.linalg.det(world[:3, :3]) < 0 else rest),
            )
            for world in worlds
        ]

    def _paint(self, slot: Slot, weights: list[float]) -> Paint:
        if slot.texture is None:
            return Paint(slot.factor)
        uv = self._morphed(f"TEXCOORD_{slot.tex_coord}", (2,), weights)
        if uv is None:
            lost = f"has a texture, but no TEXCOORD_{slot.tex_coord} for it; its upper left corner is shown"
            self.reader.notes.add(lost, self.called)
            uv = np.zeros((len(self.chosen), 2), np.float32)
        if slot.transform is not None:
            uv = uv @ slot.transform[:, :2].T + slot.transform[:, 2]
        return laid(Paint(slot.factor, slot.texture), uv)

    def _skinned(self, points: np.ndarray, skin: int) -> tuple[np.ndarray, bool]:
        """Points moved by the joints that hold them, and whether those mirror; the node's own place does not
        count."""
        joints = self.reader.joints(skin)[:, :3]
        sets = [i for i in range(8) if f"JOINTS_{i}" in self.primitive.attributes]
        holds = [self._attribute(f"JOINTS_{i}", (4,)).astype(np.int64) for i in sets]
        weights = [self._attribute(f"WEIGHTS_{i}", (4,)) for i in sets]
        if any(rows is None for rows in weights):
            raise BadMesh(f"{self.where}: has joints without weights; export the file again")
        hold, weight = np.concatenate(holds, 1), np.concatenate(weights, 1).astype(np.float64)
        weight[~weight.any(1), 0] = 1  # held by nothing: by its first joint, as other viewers show it
        hold = np.where(weight == 0, 0, hold)
        check_indices(f"{self.where}: skin {skin}", hold.reshape(-1), len(joints))
        total = weight.sum(1, keepdims=True)
        weight = np.divide(weight, total, out=np.zeros_like(weight), where=total > 0)
        out = np.empty_like(points)
        for start in range(0, len(points), SKINNED_AT_ONCE):
            part = slice(start, start + SKINNED_AT_ONCE)
            moves = np.einsum("vk,vkij->vij", weight[part], joints[hold[part]])
            out[part] = np.einsum("vij,vj->vi", moves[:, :, :3], points[part]) + moves[:, :, 3]
        return out, bool((np.linalg.det(joints[np.unique(hold[weight != 0]), :, :3]) < 0).all())


def _triangles(indices: np.ndarray, mode: int) -> np.ndarray:
    """(F, 3) of a list, strip or fan of indices; what is left over is dropped."""
    if mode == TRIANGLES:
        return indices[: len(indices) // 3 * 3].reshape(-1, 3)
    if len(indices) < 3:
        return np.empty((0, 3), np.int64)
    if mode == STRIP:
        faces = np.stack([indices[:-2], indices[1:-1], indices[2:]], 1)
        faces[1::2] = faces[1::2, [0, 2, 1]]
        return faces
    return np.stack([indices[1:-1], indices[2:], np.full(len(indices) - 2, indices[0])], 1)
