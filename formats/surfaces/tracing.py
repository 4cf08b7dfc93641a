"""Pictures of surfaces: rays are cast by Embree, colour is unlit, in sRGB.

A ray meets either side of a face. Where a material is cut out (alpha below its cutoff) it goes on to what is
behind; where it is see-through, the colours along the ray are blended front to back by alpha, in sRGB.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from formats.capture_frame import sphere
from formats.surfaces.surface import Paint, Surface, Texture
from formats.views import View

ROWS = 32
"""Pixel rows cast at once, which bounds memory."""
LAYERS = 64
"""See-through surfaces that a ray is followed through."""
ADVANCE = 1e-5
"""How far behind a surface a ray goes on, in units of the mesh's radius."""
LEFT = 1 / 512
"""What passes of a ray that is not followed any more."""
ON_BORDER = 1e-3
"""Of a texel: coordinates so near to a border do not reach beyond it."""
PROBES = 32
PROBE_SIDE = 32


@dataclass(frozen=True, eq=False)
class Mesh:
    """All surfaces of a file, placed in its world, to be seen by rays."""

    vertices: np.ndarray
    """(V, 3) float64, of all surfaces in turn."""
    surfaces: list[Surface]
    first_faces: np.ndarray
    """(n_surfaces,) index of each surface's first face among all faces."""
    centre: np.ndarray
    radius: float
    triangles: tuple[np.ndarray, np.ndarray]
    """Vertices in the unit sphere around `centre`, float32, since Embree counts in that, and (F, 3) faces."""
    notes: tuple[str, ...] = ()
    scene: object = field(default=None, repr=False)
    """Embree's."""

    @property
    def opaque(self) -> bool:
        return not any(surface.blend or surface.cutoff is not None for surface in self.surfaces)


def embree_scene(vertices: np.ndarray, faces: np.ndarray):
    from embreex.mesh_construction import TriangleMesh
    from embreex.rtcore_scene import EmbreeScene

    scene = EmbreeScene()
    TriangleMesh(scene=scene, vertices=vertices, indices=faces)
    return scene


def render_mesh(mesh: Mesh, view: View, samples_per_pixel: int) -> np.ndarray:
    """(H, W, 4) uint8, straight alpha, by a regular grid of rays per pixel inside the mesh's screen box."""
    picture = np.zeros((view.height, view.width, 4), np.uint8)
    left, top, right, bottom = _screen_box(mesh, view)
    for row in range(top, bottom, ROWS):
        window = (left, row, right, min(row + ROWS, bottom))
        picture[row : window[3], left:right] = _render_window(
            mesh, view, window, math.isqrt(samples_per_pixel)
        )
    return picture


def seen_from_behind(mesh: Mesh) -> bool:
    """Whether rays from all around first meet the back of a face that its file wants seen from the front."""
    if not any(surface.single_sided for surface in mesh.surfaces):
        return False
    points, faces = mesh.triangles
    single = np.array([surface.single_sided for surface in mesh.surfaces])
    grid = (np.arange(PROBE_SIDE) + 0.5) * 2 / PROBE_SIDE - 1
    across, along = (axis.ravel()[:, None] for axis in np.meshgrid(grid, grid))
    for outward in sphere(PROBES):
        right = np.cross(outward, [0, 0, 1] if abs(outward[2]) < 0.9 else [1, 0, 0])
        right /= np.linalg.norm(right)
        eyes = (2 * outward + across * right + along * np.cross(right, outward)).astype(np.float32)
        rays = np.broadcast_to(-outward.astype(np.float32), eyes.shape).copy()
        hit = mesh.scene.run(eyes, rays, output=1)["primID"]
        hit = hit[hit >= 0]
        hit = hit[single[_owners(mesh, hit)]]
        a, b, c = (points[faces[hit, corner]].astype(np.float64) for corner in range(3))
        facing = np.cross(b - a, c - a) @ outward
        if (facing < 0).any():
            return True
    return False


def _screen_box(mesh: Mesh, view: View) -> tuple[int, int, int, int]:
    """Left, top, right, bottom pixel bounds of all vertices; the whole picture where one is not before it."""
    x, y, z = ((mesh.vertices - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]).T
    if z.max() >= 0:
        return 0, 0, view.width, view.height
    u, v = view.cx - view.fl_x * x / z, view.cy + view.fl_y * y / z
    size = np.array([view.width, view.height])
    low, high = np.floor([u.min(), v.min()]) - 1, np.ceil([u.max(), v.max()]) + 1
    (left, top), (right, bottom) = np.clip(low, 0, size).astype(int), np.clip(high, 0, size).astype(int)
    return left, top, right, bottom


def _render_window(mesh: Mesh, view: View, window: tuple[int, int, int, int], side: int) -> np.ndarray:
    left, top, right, bottom = window
    shape = (bottom - top, right - left, side * side)
    directions = _directions(view, window, side)
    eye = ((view.camera_to_world[:3, 3] - mesh.centre) / mesh.radius).astype(np.float32)
    colours, covered = _traced(mesh, np.broadcast_to(eye, directions.shape).copy(), directions)
    cover = covered.reshape(shape).sum(2)[..., None]
    mean = colours.reshape(*shape, 3).sum(2) / np.maximum(cover, 1e-6)
    picture = np.rint(255 * np.clip(np.concatenate([mean, cover / side**2], 2), 0, 1)).astype(np.uint8)
    picture[picture[..., 3] == 0] = 0
    return picture


def _directions(view: View, window: tuple[int, int, int, int], side: int) -> np.ndarray:
    """(rows * columns * side^2, 3) float32 world directions, the rays of a pixel next to each other."""
    left, top, right, bottom = window
    sub = (np.arange(side) + 0.5) / side
    right_axis, up_axis, back = view.camera_to_world[:3, :3].T
    x = (np.arange(left, right)[:, None] + sub - view.cx)[..., None] / view.fl_x * right_axis - back
    y = (np.arange(top, bottom)[:, None] + sub - view.cy)[..., None] / view.fl_y * -up_axis
    rays = x.astype(np.float32)[None, :, None, :] + y.astype(np.float32)[:, None, :, None]
    return rays.reshape(-1, 3)


def _traced(mesh: Mesh, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(n, 3) colours times coverage, and (n,) coverage of rays; `origins` is written to."""
    colours, passing = np.zeros((len(origins), 3), np.float32), np.ones(len(origins), np.float32)
    going = np.arange(len(origins))
    for _ in range(LAYERS):
        hits = mesh.scene.run(origins[going], directions[going], output=1)
        seen = np.flatnonzero(hits["primID"] >= 0)
        if not len(seen):
            break
        going = going[seen]
        shades = _shade(mesh, *(hits[key][seen] for key in ("primID", "u", "v")))
        alpha = shades[:, 3]
        colours[going] += shades[:, :3] * (passing[going] * alpha)[:, None]
        passing[going] *= 1 - alpha
        on = passing[going] > LEFT
        far, going = hits["tfar"][seen][on], going[on]
        if not len(going):
            break
        origins[going] += directions[going] * (far + ADVANCE * np.maximum(1, far))[:, None]
    return colours, 1 - passing


def _owners(mesh: Mesh, face: np.ndarray) -> np.ndarray:
    return np.searchsorted(mesh.first_faces, face, side="right") - 1


def _shade(mesh: Mesh, face: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """(n, 4) sRGB and alpha in [0, 1] at barycentric (1 - u - v, u, v) of faces of the whole mesh."""
    weights = np.stack([1 - u - v, u, v], 1)
    owner = _owners(mesh, face)
    colours = np.empty((len(face), 4), np.float32)
    for index in np.unique(owner):
        chosen_faces = owner == index
        colours[chosen_faces] = _shown(
            mesh.surfaces[index], face[chosen_faces] - mesh.first_faces[index], weights[chosen_faces]
        )
    return colours


def _shown(surface: Surface, face: np.ndarray, weights: np.ndarray) -> np.ndarray:
    corners = surface.faces[face]
    colour = _painted(surface.paint, corners, weights, surface.linear)
    if surface.colours is not None:
        colour = colour * _interpolate(weights, surface.colours[corners])
    if surface.face_colours is not None:
        colour = colour * surface.face_colours[face]
    if surface.glow is not None:
        colour = colour.copy()
        colour[:, :3] += _painted(surface.glow, corners, weights, surface.linear)[:, :3]
    rgb = np.clip(colour[:, :3], 0, 1)
    if surface.cutoff is not None:
        alpha = (colour[:, 3] >= surface.cutoff).astype(np.float32)
    else:
        alpha = np.clip(colour[:, 3], 0, 1) if surface.blend else np.ones(len(face), np.float32)
    return np.concatenate([_encoded(rgb) if surface.linear else rgb, alpha[:, None]], 1)


def _painted(paint: Paint, corners: np.ndarray, weights: np.ndarray, linear: bool) -> np.ndarray:
    """(n, 4) factor times texture, linear or not."""
    colour = np.broadcast_to(paint.factor, (len(corners), 4))
    if paint.uv is None:
        return colour
    uv = _interpolate(weights, paint.uv[corners])
    if paint.texture is not None:
        colour = colour * texels(paint.texture, uv, linear, paint.reach)
    if paint.coverage is not None:
        colour = colour.copy()
        colour[:, 3] = paint.factor[3] * texels(paint.coverage, uv, linear, paint.reach)[:, 3]
    return colour


def _interpolate(weights: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """(n, 3) weights over (n, 3, k) corner values."""
    return sum(weights[:, corner, None] * corners[:, corner] for corner in range(3))


def texels(texture: Texture, uv: np.ndarray, linear: bool, reach: np.ndarray | None = None) -> np.ndarray:
    """(n, 4) of the texture at (n, 2) coordinates, bilinear or nearest, mixed in linear light if asked; of
    the texels that lie within `reach` (2, 2), where that is given."""
    size = np.array(texture.pixels.shape[1::-1])
    flat = texture.pixels.reshape(-1, 4)
    position = uv.astype(np.float64) * size
    levels = np.arange(256, dtype=np.float32) / 255
    table = _decoded(levels) if linear else levels
    if reach is not None:
        first = np.floor(reach[0] * size + ON_BORDER)
        last = np.maximum(np.ceil(reach[1] * size - ON_BORDER) - 1, first)

    def at(texel: np.ndarray) -> np.ndarray:
        inside = texel if reach is None else np.clip(texel, first, last)
        column, row = (
            _wrapped(inside[:, axis].astype(np.int64), size[axis], texture.wrap[axis]) for axis in (0, 1)
        )
        values = flat[row * size[0] + column]
        return np.concatenate([table[values[:, :3]], levels[values[:, 3:]]], 1)

    if texture.nearest:
        return at(np.floor(position))
    corner = np.floor(position - 0.5)
    right, down = (position - 0.5 - corner).astype(np.float32).T
    mixed = np.zeros((len(uv), 4), np.float32)
    for x, weight_x in ((0, 1 - right), (1, right)):
        for y, weight_y in ((0, 1 - down), (1, down)):
            mixed += at(corner + [x, y]) * (weight_x * weight_y)[:, None]
    return mixed


def _wrapped(index: np.ndarray, size: int, mode: str) -> np.ndarray:
    """Texel indices beyond a border brought back within [0, size)."""
    if mode == "clamp":
        return np.clip(index, 0, size - 1)
    if mode == "mirror":
        index = index % (2 * size)
        return np.minimum(index, 2 * size - 1 - index)
    return index % size


def _decoded(srgb: np.ndarray) -> np.ndarray:
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _encoded(linear: np.ndarray) -> np.ndarray:
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055
    )
