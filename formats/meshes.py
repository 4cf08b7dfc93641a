"""Meshes as captures: a .glb, .gltf, .obj or .ply seen by a ring of cameras all around, unlit.

Rays are cast by Embree through trimesh's `embreex`. Axes stay the file's own. Colour is pure albedo in sRGB:
texture (bilinear, repeated) times material colour times vertex colour, or face colour. In glTF the factors
and vertex colours are linear, as its specification says, and are multiplied there; elsewhere every colour is
taken as sRGB. A ray that meets either side of a face hits it, and the material's alpha is ignored.
"""

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from formats.errors import BadMesh, FormatError
from formats.inputs import open_input
from formats.views import Capture, View

GLTF = ("glb", "gltf")
FIELD_OF_VIEW = math.radians(40)
MARGIN = 0.02
"""Of the mesh's size, added to its box on every side and to the sphere that the cameras frame."""
ROWS = 32
"""Pixel rows cast at once, which bounds memory."""
UPRIGHT = np.array([[1.0, 0, 0, 0], [0, 0, -1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
"""glTF's world, in which +y is up, to one in which +z is."""
UPRIGHT_NOTE = "glTF has +y up: the mesh was turned about x so that +z is up"
GOLDEN_ANGLE = math.pi * (3 - math.sqrt(5))


def is_mesh(path: Path | str) -> bool:
    """By content for .glb and .ply (splats and point clouds are not meshes), by name for .obj and .gltf."""
    return mesh_type(path) is not None


def mesh_type(path: Path | str) -> str | None:
    """ "glb", "ply", "obj", "gltf" or None."""
    if Path(path).is_dir():
        return None
    try:
        with open_input(path) as file:
            head = file.read(4096)
    except FormatError:
        return None
    if head.startswith(b"glTF"):
        return "glb"
    if head.startswith((b"ply\n", b"ply\r")):
        return "ply" if b"element face" in head else None
    ending = Path(path).suffix.lower()[1:]
    return ending if ending in ("obj", "gltf") else None


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

    `samples_per_pixel` is a square number. Straight alpha is the share of a pixel's rays that hit, colour the
    mean over those. `seed` turns the spheres of train and test cameras. aabb: the mesh's bounds and 2% of
    their longest side. Raises BadMesh, MissingFile.
    """
    mesh = _load(path)
    random = np.random.default_rng(seed)
    train, test = (
        _around(mesh, n, size, prefix, random) for n, prefix in ((n_train, "train"), (n_test, "test"))
    )
    with ThreadPoolExecutor() as threads:
        pixels = list(threads.map(lambda view: render_mesh(mesh, view, samples_per_pixel), train + test))
    seen = tuple(replace(view, pixels=picture) for view, picture in zip(train + test, pixels, strict=True))
    notes = (f"{path}: {UPRIGHT_NOTE}",) if mesh_type(path) in GLTF else ()
    return Capture(Path(path), "mesh", seen[:n_train], seen[n_train:], mesh.aabb, opaque=False, notes=notes)


def mesh_facts(path: Path | str) -> dict:
    """What a mesh holds, without views of it: kind, surfaces, triangles, textures as "WxH", box, notes.

    Raises as `mesh_capture`.
    """
    mesh = _load(path)
    textures = {id(s.texture): s.texture.shape for s in mesh.surfaces if s.texture is not None}
    return {
        "kind": mesh_type(path),
        "surfaces": len(mesh.surfaces),
        "triangles": sum(len(surface.faces) for surface in mesh.surfaces),
        "textures": [f"{width}x{height}" for height, width, _ in textures.values()],
        "aabb": mesh.aabb.tolist(),
        "notes": [f"{path}: {UPRIGHT_NOTE}"] if mesh_type(path) in GLTF else [],
    }


# --- loading ------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class _Surface:
    """What colours the faces of one geometry; colours are float32 in [0, 1]."""

    faces: np.ndarray
    """(F, 3) indices into uv and vertex_colours."""
    factor: np.ndarray
    """(3,) material colour."""
    texture: np.ndarray | None = None
    """(H, W, 3) uint8 sRGB."""
    uv: np.ndarray | None = None
    """(V, 2), origin at the lower left of the texture."""
    vertex_colours: np.ndarray | None = None
    face_colours: np.ndarray | None = None
    linear: bool = False
    """factor and colours are linear, as in glTF."""


@dataclass(frozen=True, eq=False)
class _Mesh:
    """All geometries of a file, placed in its world."""

    vertices: np.ndarray
    surfaces: list[_Surface]
    first_faces: np.ndarray
    """(n_surfaces,) index of each surface's first face among all faces."""
    scene: object
    """Embree's, in the unit sphere around `centre`, since it counts in float32."""
    centre: np.ndarray
    radius: float

    @property
    def aabb(self) -> np.ndarray:
        low, high = self.vertices.min(0), self.vertices.max(0)
        margin = MARGIN * (high - low).max()
        return np.concatenate([low - margin, high + margin])


def _load(path: Path | str) -> _Mesh:
    placed, vertices, first_vertices = placed_geometries(path), [], []
    for geometry, to_world in placed:
        first_vertices.append(sum(len(v) for v in vertices))
        vertices.append(geometry.vertices @ to_world[:3, :3].T + to_world[:3, 3])
    linear = mesh_type(path) in GLTF
    surfaces = [_surface(geometry, linear) for geometry, _ in placed]
    faces = np.concatenate([s.faces + first for s, first in zip(surfaces, first_vertices, strict=True)])
    first_faces = np.cumsum([0, *(len(s.faces) for s in surfaces[:-1])])
    points = np.concatenate(vertices)
    used = points[np.unique(faces)]
    if not np.isfinite(used).all():
        raise BadMesh(f"{path}: the mesh has vertices that are NaN or infinite; export it again")
    centre = (used.min(0) + used.max(0)) / 2
    radius = float(np.linalg.norm(used - centre, axis=1).max())
    if radius == 0:
        raise BadMesh(f"{path}: all vertices of the mesh are one point, expected a surface")
    return _Mesh(used, surfaces, first_faces, _embree((points - centre) / radius, faces), centre, radius)


def placed_geometries(path: Path | str) -> list[tuple]:
    """(trimesh geometry, geometry_to_world) for every placed surface with faces."""
    import trimesh

    open_input(path).close()  # a missing file gets its own error
    kind = mesh_type(path)
    if kind is None:
        raise BadMesh(f"{path}: not a mesh that can be read; expected .glb, .gltf, .obj or .ply with faces")
    try:
        # Unprocessed: merging equal positions would merge their colours.
        scene = trimesh.load_scene(str(path), file_type=kind, process=False)
        nodes = [scene.graph[node] for node in scene.graph.nodes_geometry]
        placed = [(scene.geometry[name], to_world) for to_world, name in nodes]
    except Exception as error:  # the loaders raise errors of any class on broken files
        raise BadMesh(
            f"{path}: the mesh cannot be loaded ({type(error).__name__}: {error}); export it again"
        ) from error
    placed = [(g, m) for g, m in placed if isinstance(g, trimesh.Trimesh) and len(g.faces)]
    if not placed:
        raise BadMesh(f"{path}: the mesh has no faces, expected a surface of triangles")
    for geometry, _ in placed:
        if geometry.faces.min() < 0 or geometry.faces.max() >= len(geometry.vertices):
            raise BadMesh(f"{path}: a face refers to a vertex that does not exist; export the mesh again")
    return [(g, UPRIGHT @ m) for g, m in placed] if kind in GLTF else placed


def _embree(vertices: np.ndarray, faces: np.ndarray):
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene=scene, vertices=vertices.astype(np.float32), indices=faces.astype(np.int32))
    return scene


def _surface(geometry, linear: bool) -> _Surface:
    visual, faces, white = geometry.visual, np.asarray(geometry.faces), np.ones(3, np.float32)
    if visual.kind == "texture":
        image, factor = _material(visual.material)
        colours = visual.vertex_attributes.get("color")
        surface = _Surface(faces, factor, linear=linear)
        if image is not None and visual.uv is not None:
            surface = replace(
                surface, texture=np.array(image.convert("RGB")), uv=np.asarray(visual.uv, np.float32)
            )
        return surface if colours is None else replace(surface, vertex_colours=_unit(colours))
    if visual.kind == "vertex":
        return _Surface(faces, white, vertex_colours=_unit(visual.vertex_colors), linear=linear)
    if visual.kind == "face":
        return _Surface(faces, white, face_colours=_unit(visual.face_colors), linear=linear)
    return _Surface(faces, 0.8 * white)


def _material(material) -> tuple:
    """(picture or None, factor (3,)) of a glTF material, or of an .obj's, whose picture replaces its Kd."""
    image = getattr(material, "baseColorTexture", None) or getattr(material, "image", None)
    factor = getattr(material, "baseColorFactor", None)
    if factor is None and image is None:
        factor = getattr(material, "diffuse", None)
    return image, np.ones(3, np.float32) if factor is None else _unit(factor)


def _unit(colours: np.ndarray) -> np.ndarray:
    """RGB in [0, 1] of integer or float colours with or without alpha."""
    colours = np.asarray(colours)[..., :3]
    most = np.iinfo(colours.dtype).max if colours.dtype.kind in "ui" else 1
    return np.clip(colours.astype(np.float32) / most, 0, 1)


# --- cameras ------------------------------------------------------------------------------------------------


def _around(mesh: _Mesh, n: int, size: int, prefix: str, random: np.random.Generator) -> list[View]:
    """`n` cameras spread evenly over a sphere, turned at random, whose views just frame the mesh's sphere."""
    distance = (1 + MARGIN) * mesh.radius / math.sin(FIELD_OF_VIEW / 2)
    focal = 0.5 * size / math.tan(FIELD_OF_VIEW / 2)
    turn = np.linalg.qr(random.normal(size=(3, 3)))[0]
    step = np.arange(n)
    z, angle = 1 - (2 * step + 1) / max(n, 1), GOLDEN_ANGLE * step
    ring = np.sqrt(1 - z * z)
    outward = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1) @ turn.T
    poses = [_look_at(mesh.centre + distance * direction, mesh.centre) for direction in outward]
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


# --- rendering ----------------------------------------------------------------------------------------------


def render_mesh(mesh: _Mesh, view: View, samples_per_pixel: int) -> np.ndarray:
    """(H, W, 4) uint8, straight alpha, by a regular grid of rays per pixel inside the mesh's screen box."""
    picture = np.zeros((view.height, view.width, 4), np.uint8)
    left, top, right, bottom = _screen_box(mesh, view)
    for row in range(top, bottom, ROWS):
        window = (left, row, right, min(row + ROWS, bottom))
        picture[row : window[3], left:right] = _render_window(
            mesh, view, window, math.isqrt(samples_per_pixel)
        )
    return picture


def _screen_box(mesh: _Mesh, view: View) -> tuple[int, int, int, int]:
    """Left, top, right, bottom pixel bounds of all vertices, which lie before the camera."""
    x, y, z = ((mesh.vertices - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]).T
    u, v = view.cx - view.fl_x * x / z, view.cy + view.fl_y * y / z
    low, high = np.floor([u.min(), v.min()]).astype(int), np.ceil([u.max(), v.max()]).astype(int)
    return *np.maximum(low - 1, 0), *np.minimum(high + 1, (view.width, view.height))


def _render_window(mesh: _Mesh, view: View, window: tuple[int, int, int, int], side: int) -> np.ndarray:
    left, top, right, bottom = window
    shape = (bottom - top, right - left, side * side)
    directions = _directions(view, window, side)
    eye = ((view.camera_to_world[:3, 3] - mesh.centre) / mesh.radius).astype(np.float32)
    hits = mesh.scene.run(np.broadcast_to(eye, directions.shape).copy(), directions, output=1)
    seen = np.flatnonzero(hits["primID"] >= 0)
    colours = np.zeros((len(directions), 3), np.float32)
    colours[seen] = _shade(mesh, *(hits[key][seen] for key in ("primID", "u", "v")))
    count = (hits["primID"] >= 0).reshape(shape).sum(2)[..., None]
    mean = colours.reshape(*shape, 3).sum(2) / np.maximum(count, 1)
    return np.rint(255 * np.concatenate([mean, count / side**2], 2)).astype(np.uint8)


def _directions(view: View, window: tuple[int, int, int, int], side: int) -> np.ndarray:
    """(rows * columns * side^2, 3) float32 world directions, the rays of a pixel next to each other."""
    left, top, right, bottom = window
    sub = (np.arange(side) + 0.5) / side
    right_axis, up_axis, back = view.camera_to_world[:3, :3].T
    x = (np.arange(left, right)[:, None] + sub - view.cx)[..., None] / view.fl_x * right_axis - back
    y = (np.arange(top, bottom)[:, None] + sub - view.cy)[..., None] / view.fl_y * -up_axis
    rays = x.astype(np.float32)[None, :, None, :] + y.astype(np.float32)[:, None, :, None]
    return rays.reshape(-1, 3)


def _shade(mesh: _Mesh, face: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 3) sRGB in [0, 1] at barycentric (1 - u - v, u, v) of faces counted over the whole mesh."""
    weights = np.stack([1 - u - v, u, v], 1)
    owner = np.searchsorted(mesh.first_faces, face, side="right") - 1
    colours = np.empty((len(face), 3), np.float32)
    for index in np.unique(owner):
        own = owner == index
        colours[own] = _albedo(mesh.surfaces[index], face[own] - mesh.first_faces[index], weights[own])
    return colours


def _albedo(surface: _Surface, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    corners = surface.faces[face]
    colour = np.broadcast_to(surface.factor, (len(face), 3))
    if surface.texture is not None:
        colour = colour * _texels(surface.texture, _interpolate(weights, surface.uv[corners]), surface.linear)
    if surface.vertex_colours is not None:
        colour = colour * _interpolate(weights, surface.vertex_colours[corners])
    if surface.face_colours is not None:
        colour = colour * surface.face_colours[face]
    return _encoded(colour) if surface.linear else colour


def _interpolate(weights: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(n, 3) weights over (n, 3, k) corner values."""
    return sum(weights[:, corner, None] * corners[:, corner] for corner in range(3))


def _texels(texture: np.ndarray, uv: np.ndarray, linear: bool) -> np.ndarray:
    """Bilinear, repeating; `linear` decodes the sRGB texels before they are mixed."""
    height, width, _ = texture.shape
    texels = texture.reshape(-1, 3)
    x, y = (uv[:, 0] % 1) * width - 0.5, ((1 - uv[:, 1]) % 1) * height - 0.5
    left, top = np.floor(x).astype(np.int32), np.floor(y).astype(np.int32)
    across, down = (x - left).astype(np.float32), (y - top).astype(np.float32)
    levels = np.arange(256, dtype=np.float32) / 255
    table = _decoded(levels) if linear else levels
    mixed = np.zeros((len(uv), 3), np.float32)
    for row, row_weight in ((top % height, 1 - down), ((top + 1) % height, down)):
        for column, weight in ((left % width, 1 - across), ((left + 1) % width, across)):
            mixed += table[texels[row * width + column]] * (row_weight * weight)[:, None]
    return mixed


def _decoded(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _encoded(linear: np.ndarray) -> np.ndarray:
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )
