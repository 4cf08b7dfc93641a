"""Meshes as captures: seen by a ring of cameras all around, unlit.

Axes stay the file's own, but for glTF's, whose +y is up. Colour is in sRGB: texture times material colour
times vertex colour, or face colour, and emission on top. In glTF the factors and vertex colours are linear,
as its specification says, and are multiplied there; elsewhere every colour is taken as sRGB. What a file
names and is not shown is a note of the capture (`formats/surfaces`).
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from formats.capture_frame import BORDER, box_around, sphere
from formats.errors import BadMesh, FormatError
from formats.other_files import not_a_mesh
from formats.ply_elements import MAX_HEADER
from formats.safe_input import open_input
from formats.surfaces.gltf import read_gltf
from formats.surfaces.obj import read_obj
from formats.surfaces.off import read_off
from formats.surfaces.ply import read_ply
from formats.surfaces.stl import read_stl
from formats.surfaces.surface import Notes, Surface
from formats.surfaces.tracing import Mesh, embree_scene, render_mesh, seen_from_behind
from formats.views import Capture, View

READERS = {
    "glb": read_gltf,
    "gltf": read_gltf,
    "obj": read_obj,
    "ply": read_ply,
    "stl": read_stl,
    "off": read_off,
}
GLTF = ("glb", "gltf")
FIELD_OF_VIEW = math.radians(40)
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""glTF's world, in which +y is up, to one in which +z is."""
UPRIGHT_NOTE = "glTF has +y up: the mesh was turned about x so that +z is up"
FROM_BEHIND = (
    "surfaces that the file wants seen from their front alone are open to the back, and a field shows them "
    "from both sides"
)
FARTHEST = 1e150
"""Coordinates whose squares are numbers."""
SMALLEST = 1e-12
"""Of the farthest coordinate: a mesh smaller than that is a point."""


def is_mesh(path: Path | str) -> bool:
    """By content for .glb and .ply (splats and point clouds are not meshes), by name for the others."""
    return mesh_type(path) is not None


def mesh_type(path: Path | str) -> str | None:
    """ "glb", "ply", "obj", "gltf", "stl", "off" or None."""
    if Path(path).is_dir():
        return None
    try:
        with open_input(path) as file:
            head = file.read(MAX_HEADER)
    except FormatError:
        return None
    if head.startswith(b"glTF"):
        return "glb"
    if head.startswith((b"ply\n", b"ply\r")):
        return "ply" if b"element face" in head or b"element tristrips" in head else None
    ending = Path(path).suffix.lower()[1:]
    if ending == "glb" and head.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        return "gltf"
    return ending if ending in ("obj", "gltf", "stl", "off") else None


def mesh_capture(
    path: Path | str,
    *,
    n_train: int = 100,
    n_test: int = 0,
    size: int = 400,
    samples_per_pixel: int = 16,
    seed: int = 0,
) -> Capture:
    """Square views from a Fibonacci sphere of cameras, rendered in memory; each shows the whole mesh.

    `samples_per_pixel` is a square number. Straight alpha is the share of a pixel's rays that are stopped,
    colour the mean over those. `seed` turns the spheres of train and test cameras. aabb: the mesh's bounds
    and 2% of their longest side. Raises BadJson, BadMesh, LimitExceeded, MissingExtra, MissingFile,
    OutsideFolder.
    """
    mesh = _load(path)
    random = np.random.default_rng(seed)
    train, test = (
        _around(mesh, n, size, prefix, random) for n, prefix in ((n_train, "train"), (n_test, "test"))
    )
    with ThreadPoolExecutor() as threads:
        pixels = list(threads.map(lambda view: render_mesh(mesh, view, samples_per_pixel), train + test))
    seen = tuple(replace(view, pixels=picture) for view, picture in zip(train + test, pixels, strict=True))
    return Capture(
        Path(path),
        "mesh",
        seen[:n_train],
        seen[n_train:],
        box_around(mesh.vertices),
        opaque=False,
        notes=mesh.notes,
    )


def mesh_facts(path: Path | str) -> dict:
    """What a mesh holds, without views of it: kind, surfaces, triangles, textures as "WxH", box, notes.

    Raises as `mesh_capture`.
    """
    mesh = _load(path)
    paints = [p for surface in mesh.surfaces for p in (surface.paint, surface.glow) if p is not None]
    pictures = {id(p.texture.pixels): p.texture.pixels.shape for p in paints if p.texture is not None}
    return {
        "kind": mesh_type(path),
        "surfaces": len(mesh.surfaces),
        "triangles": len(mesh.triangles[1]),
        "textures": [f"{width}x{height}" for height, width, _ in pictures.values()],
        "vertex_colours": any(s.colours is not None or s.face_colours is not None for s in mesh.surfaces),
        "see_through": not mesh.opaque,
        "aabb": box_around(mesh.vertices).tolist(),
        "notes": list(mesh.notes),
    }


# --- loading ------------------------------------------------------------------------------------------------


def mesh_surfaces(path: Path | str) -> tuple[list[Surface], tuple[str, ...]]:
    """The surfaces of a mesh's file, glTF's turned so that +z is up, and notes. Raises as `mesh_capture`."""
    open_input(path).close()  # a missing file gets its own error
    kind = mesh_type(path)
    if kind is None:
        raise not_a_mesh(Path(path))
    notes = Notes(path)
    if kind in GLTF:
        notes.add(UPRIGHT_NOTE)
    try:
        with np.errstate(all="ignore"):  # numbers of hostile files; what is not finite is looked for later
            surfaces = [surface for surface in READERS[kind](path, notes) if len(surface.faces)]
    except MemoryError as error:
        raise BadMesh(f"{path}: the mesh does not fit into memory; simplify it") from error
    if not surfaces:
        raise BadMesh(f"{path}: the mesh has no faces, expected a surface of triangles")
    if kind in GLTF:
        for surface in surfaces:
            surface.positions[:] = surface.positions @ UPRIGHT[:3, :3].T
    return surfaces, notes.sentences()


def _load(path: Path | str) -> Mesh:
    surfaces, notes = mesh_surfaces(path)
    starts = np.cumsum([0, *(len(surface.positions) for surface in surfaces[:-1])])
    faces = np.concatenate([s.faces + np.int32(first) for s, first in zip(surfaces, starts, strict=True)])
    points = np.concatenate([surface.positions for surface in surfaces])
    surfaces = [replace(surface, positions=None) for surface in surfaces]  # not held twice
    unused = np.ones(len(points), bool)
    unused[faces.reshape(-1)] = False
    points[unused] = points[faces[0, 0]]
    if not (np.abs(points).max() < FARTHEST):  # false for NaN too
        raise BadMesh(f"{path}: the mesh has vertices that are NaN or infinite; export it again")
    centre = (points.min(0) + points.max(0)) / 2
    radius = math.sqrt(
        max(((part - centre) ** 2).sum(1).max() for part in np.array_split(points, 64) if len(part))
    )
    if radius <= SMALLEST * np.abs(points).max():
        raise BadMesh(f"{path}: all vertices of the mesh are one point, expected a surface")
    unit = np.empty(points.shape, np.float32)
    for axis in range(3):
        unit[:, axis] = (points[:, axis] - centre[axis]) / radius
    first_faces = np.cumsum([0, *(len(s.faces) for s in surfaces[:-1])])
    scene = embree_scene(unit, faces)
    mesh = Mesh(points, surfaces, first_faces, centre, radius, (unit, faces), notes, scene)
    return replace(mesh, notes=(*notes, f"{path}: {FROM_BEHIND}")) if seen_from_behind(mesh) else mesh


# --- cameras ------------------------------------------------------------------------------------------------


def _around(mesh: Mesh, n: int, size: int, prefix: str, random: np.random.Generator) -> list[View]:
    """`n` cameras spread evenly over a sphere, turned at random, whose views just frame the mesh's sphere."""
    distance = (1 + BORDER) * mesh.radius / math.sin(FIELD_OF_VIEW / 2)
    focal = 0.5 * size / math.tan(FIELD_OF_VIEW / 2)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    poses = [_look_at(mesh.centre + distance * out, mesh.centre) for out in sphere(n) @ turn.T]
    middle = size / 2
    return [
        View(f"{prefix}_{i:03d}", p, focal, focal, middle, middle, size, size) for i, p in enumerate(poses)
    ]


def _look_at(eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """camera_to_world with z up in the picture; y is up where the camera looks along z."""
    back = (eye - target) / np.linalg.norm(eye - target)
    up = np.array([0.0, 0, 1]) if abs(back[2]) < 1 - 1e-6 else np.array([0.0, 1, 0])
    right = np.cross(up, back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3] = np.stack([right, np.cross(back, right), back, eye], 1)
    return pose
