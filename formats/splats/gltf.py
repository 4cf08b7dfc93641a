"""Splats of glTF 2.0: primitives with KHR_gaussian_splatting, placed by their nodes, also packed as SPZ.

https://github.com/KhronosGroup/glTF (extensions/2.0/Khronos/KHR_gaussian_splatting, as ratified, in which
scales are linear; in drafts they were logarithms). glTF's axes are left, up, front; what SPZ packs has those
of its primitive.
"""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from formats.errors import BadSplats, LimitExceeded, counted
from formats.splats.placing import keeps_shapes, placed
from formats.splats.splats import Splats, check_count, gathered, joined, of_colours
from formats.splats.spz import read_spz
from formats.surfaces import gltf_schema as schema
from formats.surfaces.accessors import Buffers
from formats.surfaces.gltf import KNOWN, check_extensions, read_document
from formats.surfaces.gltf_nodes import Nodes
from formats.surfaces.named_files import Beside
from formats.surfaces.surface import Notes

SPLATTING = "KHR_gaussian_splatting"
SPZ = (
    "KHR_gaussian_splatting_compression_spz_2",
    "KHR_gaussian_splatting_compression_spz",
    "KHR_spz_gaussian_splats_compression",
)
"""The newest of its drafts first."""
PACKED_AXES = (
    "holds SPZ, whose axes are taken for those of glTF, as CesiumJS does; by the draft of its extension the "
    "splats would stand turned by half a turn about y"
)
COLOUR = "COLOR_0"
LINEAR = "lin_rec709_display"
DEGREES = 3
AXES = np.diag([-1.0, -1, 1, 1])
"""From left, up, front to right, down, front."""
MAX_PLACEMENTS = 1000
FARTHEST = 1e12
"""Largest number of a node's placement."""


class Splatting(schema.Part):
    """The extension of a primitive."""

    kernel: str = "ellipse"
    color_space: str = ""


class Packed(schema.Part, kw_only=True):
    """SPZ within it."""

    buffer_view: schema.Index


def names_splats(text: bytes) -> bool:
    """Whether the JSON of a glTF file has primitives of splats."""
    return SPLATTING.encode() in text or SPZ[-1].encode() in text


def read_gltf_splats(path: Path | str, data: bytes) -> Splats:
    """In the world of the file, but for its axes. Raises BadJson, BadMesh, BadSplats, LimitExceeded,
    MissingExtra, MissingFile, NewerVersion, OutsideFolder."""
    notes = Notes(path)
    document, binary = read_document(path, data)
    check_extensions(document, path, notes, KNOWN | {SPLATTING, *SPZ})
    buffers = Buffers(document, path, Beside(path), binary)
    return _Reader(document, path, buffers, notes).splats()


class _Reader:
    """One document's splats."""

    def __init__(self, document: schema.Document, path: Path | str, buffers: Buffers, notes: Notes):
        self.document, self.path, self.buffers, self.notes = document, path, buffers, notes
        self.nodes = Nodes(document, path, buffers, notes)
        self.parts: dict[tuple[int, int], _Part] = {}

    def splats(self) -> Splats:
        placements, others = self._placements()
        if others:
            self.notes.add(f"{counted(others, 'primitive', 'primitives')} without splats left out")
        self.nodes.tell()
        check_count(self.path, len(placements))
        logarithms = any((part.scales < 0).any() for part in self.parts.values() if not part.packed)
        if logarithms:
            self.notes.add("its scales are logarithms, as drafts of the extension had them; they are read so")
        sound = {key: self._sound(part, logarithms) for key, part in self.parts.items()}
        splats = joined(
            self.path, "a glTF file of splats", [self._placed(sound[key], world) for key, world in placements]
        )
        return replace(splats, notes=self.notes.sentences() + splats.notes)

    def _placements(self) -> tuple[list[tuple[tuple[int, int], np.ndarray]], int]:
        """Parts of splats by their keys and where each lies, and how many primitives are something else."""
        placements, others, total = [], 0, 0
        for index in self.nodes.shown:
            mesh_index = self.document.nodes[index].mesh
            if mesh_index is None:
                continue
            mesh = self.buffers.item("meshes", mesh_index)
            for number, primitive in enumerate(mesh.primitives):
                where = f"{self.path}: mesh {mesh.name[:60] or mesh_index!r}, primitive {number}"
                if SPLATTING not in primitive.extensions and _packed(primitive, where) is None:
                    others += 1
                    continue
                key = mesh_index, number
                if key not in self.parts:
                    self.parts[key] = self._part(primitive, where)
                worlds = self.nodes.instances(index)
                placements += [(key, world) for world in worlds]
                total += len(worlds) * len(self.parts[key].centres)
                check_count(self.path, max(total, 1), self.buffers.size)
                if len(placements) > MAX_PLACEMENTS:
                    raise LimitExceeded(
                        f"{self.path}: places splats more than {MAX_PLACEMENTS:,} times; join its primitives"
                    )
        return placements, others

    # --- primitives -----------------------------------------------------------------------------------------

    def _part(self, primitive: schema.Primitive, where: str) -> "_Part":
        called = where.removeprefix(f"{self.path}: ")
        splatting = primitive.extension(SPLATTING, Splatting, where) or Splatting()
        if splatting.color_space == LINEAR:
            linear = "states linear colours; they are read as if they were sRGB, and look darker than meant"
            self.notes.add(linear, called)
        if splatting.kernel != "ellipse":
            self.notes.add(f"has the kernel {splatting.kernel[:40]!r}, and is shown as ellipses", called)
        if (packed := _packed(primitive, where)) is not None:
            self.notes.add(PACKED_AXES, called)
            return self._unpacked(bytes(self.buffers.view(packed.buffer_view)), where)
        rows = {name: self._attribute(primitive, name, width, where) for name, width in ATTRIBUTES.items()}
        rows["OPACITY"], harmonics = self._shown(primitive, where)
        if len({len(each) for each in (*rows.values(), harmonics)}) > 1:
            raise BadSplats(f"{where}: its attributes differ in their number; export the file again")
        return _Part(
            rows["POSITION"],
            rows["SCALE"],
            np.roll(rows["ROTATION"], 1, axis=1),
            rows["OPACITY"][:, 0],
            harmonics,
            packed=False,
        )

    def _unpacked(self, data: bytes, where: str) -> "_Part":
        splats = read_spz(where, data, as_stored=True)
        for note in splats.notes:
            self.notes.add(note.removeprefix(f"{where}: "), where.removeprefix(f"{self.path}: "))
        return _Part(
            splats.centres, splats.scales, splats.rotations, splats.opacities, splats.harmonics, packed=True
        )

    def _attribute(self, primitive: schema.Primitive, name: str, width: int, where: str) -> np.ndarray:
        full = name if name == "POSITION" else f"{SPLATTING}:{name}"
        if full not in primitive.attributes and f"_{name}" in primitive.attributes:  # of the first draft
            full = f"_{name}"
        if full not in primitive.attributes:
            raise BadSplats(f"{where}: its splats lack {full}; export the file again")
        # whole numbers of these stand for [0, 1] or [-1, 1], also where an exporter forgot to say so
        shares = name in ("ROTATION", "OPACITY")
        return self.buffers.numbers(primitive.attributes[full], (width,), scaled=shares)

    def _shown(self, primitive: schema.Primitive, where: str) -> tuple[np.ndarray, np.ndarray]:
        """Opacities (N, 1) and harmonics (N, K, 3); the first draft has colours and opacities in COLOR_0."""
        own = [f"{SPLATTING}:{name}" in primitive.attributes for name in ("OPACITY", "SH_DEGREE_0_COEF_0")]
        if any(own) or COLOUR not in primitive.attributes:
            return self._attribute(primitive, "OPACITY", 1, where), self._harmonics(primitive, where)
        rgba = self.buffers.numbers(primitive.attributes[COLOUR], (4,), scaled=True)
        self.notes.add("has one colour for each splat, as a draft of the extension had it")
        return rgba[:, 3:], of_colours(rgba[:, :3])

    def _harmonics(self, primitive: schema.Primitive, where: str) -> np.ndarray:
        """(N, K, 3) of whole degrees."""
        names = [
            [f"SH_DEGREE_{degree}_COEF_{n}" for n in range(2 * degree + 1)] for degree in range(DEGREES + 1)
        ]
        there = [any(f"{SPLATTING}:{name}" in primitive.attributes for name in each) for each in names]
        top = max((degree for degree in range(DEGREES + 1) if there[degree]), default=0)
        columns = [self._attribute(primitive, name, 3, where) for each in names[: top + 1] for name in each]
        if len({len(column) for column in columns}) > 1:
            raise BadSplats(f"{where}: its harmonics differ in their number; export the file again")
        return np.stack(columns, 1)

    # --- where they lie -------------------------------------------------------------------------------------

    def _sound(self, part: "_Part", logarithms: bool) -> Splats:
        scales = part.scales.astype(np.float64)
        splats = gathered(
            self.path,
            "a glTF file of splats",
            centres=part.centres,
            scales=np.exp(scales) if logarithms and not part.packed else scales,
            rotations=part.rotations,
            opacities=part.opacities,
            harmonics=part.harmonics,
        )
        for note in splats.notes:
            self.notes.add(note.removeprefix(f"{self.path}: "))
        return splats

    def _placed(self, splats: Splats, world: np.ndarray) -> Splats:
        if not np.abs(world).max() < FARTHEST:
            raise BadSplats(f"{self.path}: places splats by a node beyond any measure; export it again")
        if splats.harmonics.shape[1] > 1 and not keeps_shapes(world[:3, :3]):
            self.notes.add("nodes stretch splats; their colours are turned as by the nearest rotation")
        return placed(splats, AXES @ world)


ATTRIBUTES = {"POSITION": 3, "SCALE": 3, "ROTATION": 4}


@dataclass(frozen=True, eq=False)
class _Part:
    """Splats of one primitive, as `gathered` takes them, but that scales may be logarithms."""

    centres: np.ndarray
    scales: np.ndarray
    rotations: np.ndarray
    opacities: np.ndarray
    harmonics: np.ndarray
    packed: bool
    """Whether they come from SPZ, so that scales are none."""


def _packed(primitive: schema.Primitive, where: str) -> Packed | None:
    """The SPZ of a primitive, which lies in the extension of splats, in early drafts beside it."""
    splatting = primitive.extension(SPLATTING, Splatting, where)
    for owner in (splatting, primitive):
        for name in SPZ:
            if owner is not None and name in owner.extensions:
                return owner.extension(name, Packed, where)
    return None
