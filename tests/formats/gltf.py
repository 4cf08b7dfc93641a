"""glTF files in the making, and what a mesh shows of itself from one side."""

import json
import struct
from pathlib import Path

import numpy as np

from formats.meshes import _load, mesh_capture, render_mesh
from formats.views import View

TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
COMPONENTS = {"int8": 5120, "uint8": 5121, "int16": 5122, "uint16": 5123, "uint32": 5125, "float32": 5126}
CORNERS = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
UV = np.array([[0, 1], [1, 1], [1, 0], [0, 0]], np.float32)
FACES = np.array([0, 1, 2, 0, 2, 3], np.uint16)


class Gltf:
    """A square in z = 0, white without a material, seen from +z; change it, then `write` it."""

    def __init__(self):
        self.blob = b""
        self.doc = {
            "asset": {"version": "2.0"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0}],
        }
        self.primitive = {"attributes": {"POSITION": self.accessor(CORNERS)}, "indices": self.accessor(FACES)}
        self.doc["meshes"] = [{"primitives": [self.primitive]}]

    def list(self, name: str, entry) -> int:
        entries = self.doc.setdefault(name, [])
        entries.append(entry)
        return len(entries) - 1

    def view(self, data: bytes, **more) -> int:
        self.blob += bytes(-len(self.blob) % 4)
        place = {"buffer": 0, "byteOffset": len(self.blob), "byteLength": len(data)}
        self.blob += data
        return self.list("bufferViews", place | more)

    def accessor(self, array: np.ndarray, **more) -> int:
        table = np.ascontiguousarray(array).reshape(len(array), -1)
        kind = {"componentType": COMPONENTS[table.dtype.name], "type": TYPES[table.shape[1]]}
        return self.list(
            "accessors", {"bufferView": self.view(table.tobytes()), "count": len(array)} | kind | more
        )

    def attribute(self, name: str, array: np.ndarray, **more) -> None:
        self.primitive["attributes"][name] = self.accessor(array, **more)

    def material(self, picture: bytes | None = None, sampler: dict | None = None, **material) -> dict:
        """The square's material, whose base colour is a picture (PNG bytes) where one is given."""
        base = material.setdefault("pbrMetallicRoughness", {})
        if picture is not None:
            texture = {
                "source": self.list("images", {"bufferView": self.view(picture), "mimeType": "image/png"})
            }
            if sampler is not None:
                texture["sampler"] = self.list("samplers", sampler)
            base["baseColorTexture"] = {"index": self.list("textures", texture)}
            if "TEXCOORD_0" not in self.primitive["attributes"]:
                self.attribute("TEXCOORD_0", UV)
        self.primitive["material"] = self.list("materials", material)
        return material

    def write(self, path: Path) -> Path:
        doc = self.doc | {"buffers": [{"byteLength": len(self.blob)}, *self.doc.get("buffers", [])]}
        if path.suffix == ".gltf":
            doc["buffers"][0]["uri"] = f"{path.stem}.bin"
            path.with_suffix(".bin").write_bytes(self.blob)
            path.write_text(json.dumps(doc))
            return path
        text = json.dumps(doc).encode()
        text += b" " * (-len(text) % 4)
        blob = self.blob + bytes(-len(self.blob) % 4)
        chunks = (
            struct.pack("<II", len(text), 0x4E4F534A)
            + text
            + struct.pack("<II", len(blob), 0x004E4942)
            + blob
        )
        path.write_bytes(struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks)
        return path


def front(path: Path, size: int = 32, samples: int = 1, behind: bool = False) -> np.ndarray:
    """(size, size, 4) of the square [-1, 1]² of glTF's x and y, seen from +z from very far away."""
    far, sign = 1000.0, -1 if behind else 1
    pose = np.array([[sign, 0, 0, 0], [0, 0, -sign, -sign * far], [0, 1, 0, 0], [0, 0, 0, 1]], float)
    view = View("front", pose, far * size / 2, far * size / 2, size / 2, size / 2, size, size)
    return render_mesh(_load(path), view, samples)


def facing(path: Path, size: int = 32) -> np.ndarray:
    """The same of x and y of files in which z is up, seen from +z."""
    pose = np.eye(4)
    pose[2, 3] = 1000.0
    view = View("front", pose, 500.0 * size, 500.0 * size, size / 2, size / 2, size, size)
    return render_mesh(_load(path), view, 1)


def notes_of(path: Path) -> str:
    return "\n".join(mesh_capture(path, n_train=1, size=4, samples_per_pixel=1).notes)
