"""Cameras with a pinhole or a fisheye lens, distorted as OpenCV describes it: pixels to rays.

Axes are OpenGL's: +x right, +y up, looking along -z. Pixel (i, j) is column i, row j from the top, its centre
at (i + 0.5, j + 0.5).
"""

from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np

from fusedrf_cli.engine.kernels import cpu
from fusedrf_cli.engine.kernels.lens import NEWTON_NEAR, NEWTON_STEPS
from fusedrf_cli.engine.kernels.lens import bend as bend_numbers
from fusedrf_cli.engine.settings import current

TILE = 16  # pixels along the side of a tile
bend = bend_numbers.py_func  # of arrays


@dataclass(frozen=True)
class Camera:
    """One view: where it is and how it projects."""

    camera_to_world: np.ndarray
    """(4, 4) float64."""
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, k3, p1, p2 and, where there are more, k4, d1, d2, d3 (see `lens.bend`); of a fisheye k1,
    k2, k3, k4 (see `bend_angle`)."""
    name: str = ""
    fisheye: bool = False
    """The distance from the image's centre grows with the angle from the axis, not with its tangent."""

    @property
    def intrinsics(self) -> tuple[float, ...]:
        """All that shapes the camera's own ray directions, as a key."""
        inner = (self.fl_x, self.fl_y, self.cx, self.cy, self.width, self.height)
        return (*inner, self.fisheye, *self.distortion)

    def seen_from(self, origin: np.ndarray) -> "Camera":
        """The same camera in a frame that lies at `origin` (4, 4), turned and scaled alike along all axes."""
        inverse, pose = np.linalg.inv(origin[:3, :3]), np.array(self.camera_to_world, np.float64)
        pose[:3, 3] -= origin[:3, 3]  # first, so that it is exact however far away both are
        pose[:3] = inverse @ pose[:3]
        pose[:3, :3] /= np.linalg.norm(pose[:3, 0])
        return replace(self, camera_to_world=pose)

    def local_directions(self, rows: slice = slice(None)) -> np.ndarray:
        """(rows, width, 3) float64 directions in the camera's frame: z = -1, or of unit length where the lens
        is a fisheye, which may see what lies beside and behind it."""
        columns = (np.arange(self.width) + 0.5 - self.cx) / self.fl_x
        lines = (np.arange(self.height)[rows] + 0.5 - self.cy) / self.fl_y
        x, y = np.meshgrid(columns, lines)
        if self.fisheye:
            return fisheye_directions(x, y, self.distortion)
        if any(self.distortion):
            x, y = undistort(x, y, self.distortion)
        return np.stack([x, -y, -np.ones_like(x)], -1)

    def rays(
        self, rows: slice = slice(None), order: np.ndarray | None = None
    ) -> tuple[np.ndarray, np.ndarray]:
        """rays_o, rays_d, each (rows * width, 3) float64 in world space, rays_d of unit length, row by row,
        or those of the rows' pixels in another order (N,) int64."""
        top, bottom, _ = rows.indices(self.height)
        if order is None:
            order = np.arange((bottom - top) * self.width)
        rays_o, rays_d = np.empty((len(order), 3)), np.empty((len(order), 3))
        pose = np.ascontiguousarray(self.camera_to_world, np.float64)
        if self.fisheye:
            rays_d[:] = self.local_directions(rows).reshape(-1, 3)[order] @ pose[:3, :3].T
            rays_d /= np.linalg.norm(rays_d, axis=1, keepdims=True)
            rays_o[:] = pose[:3, 3]
        else:
            inner = map(float, (self.fl_x, self.fl_y, self.cx, self.cy))
            lens = of_nine(self.distortion), any(self.distortion)
            cpu.lens_rays(pose, *inner, *lens, self.width, top, order, rays_o, rays_d)
        return rays_o, rays_d


@lru_cache(maxsize=4)
def tile_order(width: int, rows: int) -> np.ndarray:
    """(rows * width,) int64 pixels, counted row by row, tile after tile: rays of a tile pass the same
    texels."""
    high, wide = -(-rows // TILE), -(-width // TILE)
    padded = np.full((high * TILE, wide * TILE), -1)
    padded[:rows, :width] = np.arange(rows * width).reshape(rows, width)
    order = padded.reshape(high, TILE, wide, TILE).swapaxes(1, 2).ravel()
    return order[order >= 0]


def undistort(x: np.ndarray, y: np.ndarray, distortion: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Invert `lens.bend`: distorted to ideal normalised image coordinates (y down). A pixel that no
    ray reaches gets the nearest that was found."""
    ideal = np.empty((np.size(x), 2))
    cpu.unbent(np.stack([np.ravel(x), np.ravel(y)], 1), of_nine(distortion), ideal)
    return ideal[:, 0].reshape(np.shape(x)), ideal[:, 1].reshape(np.shape(x))


def of_nine(distortion: tuple[float, ...]) -> tuple[float, ...]:
    """A lens's numbers as `lens.bend` takes them."""
    return tuple(map(float, distortion)) + (0.0,) * (9 - len(distortion))


def bend_angle(angle: np.ndarray, distortion: tuple[float, ...]) -> tuple[np.ndarray, np.ndarray]:
    """OpenCV's fisheye: angle from the axis, radians, to distance from the centre in focal lengths,
    θ (1 + k1 θ² + k2 θ⁴ + k3 θ⁶ + k4 θ⁸), and its derivative."""
    k1, k2, k3, k4 = (*distortion, *(0.0,) * (4 - len(distortion)))[:4]
    a2 = angle * angle
    radius = angle * (1 + a2 * (k1 + a2 * (k2 + a2 * (k3 + a2 * k4))))
    return radius, 1 + a2 * (3 * k1 + a2 * (5 * k2 + a2 * (7 * k3 + a2 * 9 * k4)))


def projected(camera: Camera, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where a camera, or a view, shows points (N, 3): pixels (N, 2), column and row; how far they are (N,),
    along its axis or, of a fisheye, in all; and which of them lie in the picture, (N,) bool."""
    x, y, back = ((points - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]).T
    if camera.fisheye:
        away, aside = np.linalg.norm([x, y, back], axis=0), np.hypot(x, y)
        radius, slope = bend_angle(np.arctan2(aside, -back), camera.distortion)
        u, v = np.array([x, -y]) * radius / np.maximum(aside, 1e-12)
    else:
        away = -back
        before = np.where(away > 0, away, np.inf)
        (u, v), (a, b, d) = bend(x / before, -y / before, of_nine(camera.distortion))
        slope = a * d - b * b
    pixels = np.stack([camera.cx + camera.fl_x * u, camera.cy + camera.fl_y * v], 1)
    unfolded = (away > 0) & (slope > 0)  # beyond a fold of the lens points would come back into the picture
    return pixels, away, unfolded & ((pixels >= 0) & (pixels < (camera.width, camera.height))).all(1)


def fisheye_directions(x: np.ndarray, y: np.ndarray, distortion: tuple[float, ...]) -> np.ndarray:
    """(..., 3) float64 unit directions, OpenGL axes, of a fisheye's normalised image coordinates (y down).

    `bend_angle` is inverted by Newton steps kept between bounds. Pixels past the widest angle that the lens
    shows (where the distance from the centre grows no more, at most a half turn) get that angle.
    """
    radius = np.hypot(x, y)
    table = np.linspace(0, np.pi, 2049)
    reached, slope = bend_angle(table, distortion)
    rising = np.argmax(slope <= 0) if (slope <= 0).any() else len(table)
    table, reached = table[: max(rising, 2)], reached[: max(rising, 2)]
    angle = np.interp(radius, reached, table)
    step = table[1]
    low, high = np.maximum(angle - step, 0), np.minimum(angle + step, table[-1])
    for _ in range(NEWTON_STEPS):
        bent, slope = bend_angle(angle, distortion)
        following = np.clip(angle - (bent - radius) / np.where(slope > 1e-9, slope, 1e-9), low, high)
        if np.abs(following - angle).max(initial=0) < NEWTON_NEAR:
            break
        angle = following
    across = np.sin(angle) / np.where(radius > 0, radius, 1)
    return np.stack([x * across, -y * across, -np.cos(angle)], -1)


def look_at(eye: np.ndarray, target: np.ndarray, up: np.ndarray) -> np.ndarray:
    """(4, 4) camera_to_world of a camera at eye that looks at target, its +y as near to up as can be."""
    back = np.asarray(eye, np.float64) - target
    back = back / np.linalg.norm(back)
    right = np.cross(up, back)
    if np.linalg.norm(right) < 1e-6:
        right = np.cross([0.0, 1.0, 0.0] if abs(back[1]) < 0.9 else [1.0, 0.0, 0.0], back)
    right /= np.linalg.norm(right)
    pose = np.eye(4)
    pose[:3, 0], pose[:3, 1], pose[:3, 2], pose[:3, 3] = right, np.cross(back, right), back, eye
    return pose


UP = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True, eq=False)
class Outlook:
    """From which side, and from how far, cameras look at a target; angles in radians."""

    target: np.ndarray
    """(3,) float64."""
    distance: float
    azimuth: float
    """About `up`, from +x where that is +z (see `level`)."""
    elevation: float
    """Above the plane through the target that is at right angles to `up`."""
    up: np.ndarray = field(default_factory=UP.copy)
    """(3,) unit vector."""

    def camera(self, lens: Camera, turn: float = 0.0, name: str = "view") -> Camera:
        """A camera with the lens of another one, turned by an angle about `up`."""
        east, north = level(self.up)
        azimuth, flat = self.azimuth + turn, np.cos(self.elevation)
        away = np.cos(azimuth) * flat * east + np.sin(azimuth) * flat * north
        eye = self.target + (away + np.sin(self.elevation) * self.up) * self.distance
        return replace(lens, camera_to_world=look_at(eye, self.target, self.up), name=name)

    def orbit(self, lens: Camera, count: int, arc: tuple[float, float] | None = None) -> list[Camera]:
        """`count` cameras evenly around the target, all at one elevation; or, between two azimuths, the
        second the larger, to and fro, so that the last comes back to the first."""
        turns = [2 * np.pi * i / count for i in range(count)]
        if arc is not None:
            middle, half = (arc[0] + arc[1]) / 2, (arc[1] - arc[0]) / 2
            ahead = (self.azimuth - middle + np.pi) % (2 * np.pi) - np.pi
            first = np.arcsin(np.clip(ahead / max(half, 1e-9), -1, 1))
            turns = [middle + half * np.sin(first + turn) - self.azimuth for turn in turns]
        return [self.camera(lens, turn, f"orbit_{i:04d}") for i, turn in enumerate(turns)]


def level(up: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Two unit vectors (3,) at right angles to each other and to up: azimuth 0, which is +x or, where that is
    nearly up or down, +y; and a quarter turn on, anticlockwise seen from above."""
    ahead = np.array([1.0, 0.0, 0.0] if abs(up[0]) < 0.9 else [0.0, 1.0, 0.0])
    east = ahead - (ahead @ up) * up
    east /= np.linalg.norm(east)
    return east, np.cross(up, east)


def azimuth_of(away: np.ndarray, up: np.ndarray) -> float:
    """The angle about up, radians, at which a vector (3,) points; see `level`."""
    east, north = level(up)
    return float(np.arctan2(away @ north, away @ east))


@dataclass(frozen=True)
class FramingConfig:
    """From where a box is framed."""

    fov: float = 0.6911112
    """Radians, horizontal: the field of view of NeRF-Synthetic's cameras."""
    azimuth: float = 0.9
    """Radians about +z from +x, from which a box is framed."""
    elevation: float = 0.45
    """Radians above the horizon."""


def framing_lens(width: int, height: int) -> Camera:
    """The camera, at the origin, that boxes are framed with."""
    focal = 0.5 * width / np.tan(current(FramingConfig).fov / 2)
    return Camera(np.eye(4), focal, focal, width / 2, height / 2, width, height, name="view")


def framing(
    aabb: np.ndarray, lens: Camera, azimuth: float | None = None, elevation: float | None = None
) -> Outlook:
    """The outlook from which a camera that stands outside a box (6,) frames its bounding ball; angles of None
    are those of FramingConfig."""
    config = current(FramingConfig)
    azimuth = config.azimuth if azimuth is None else azimuth
    elevation = config.elevation if elevation is None else elevation
    centre, radius = (aabb[:3] + aabb[3:]) / 2, float(np.linalg.norm(aabb[3:] - aabb[:3]) / 2)
    narrow = np.arctan(0.5 * min(lens.width, lens.height) / lens.fl_x)
    return Outlook(centre, 0.92 * radius / np.sin(narrow), azimuth, elevation)


def framing_camera(
    aabb: np.ndarray, azimuth: float, elevation: float, width: int, height: int, name: str = "view"
) -> Camera:
    """A camera outside a box (6,) that frames its bounding ball; azimuth from +x about +z, elevation above
    the xy plane, radians."""
    lens = framing_lens(width, height)
    return framing(aabb, lens, azimuth, elevation).camera(lens, name=name)


def orbit(
    aabb: np.ndarray, count: int, width: int, height: int, elevation: float | None = None
) -> list[Camera]:
    """`count` cameras evenly around a box, all at one elevation; see `framing`."""
    lens = framing_lens(width, height)
    return framing(aabb, lens, elevation=elevation).orbit(lens, count)


def scattered(
    aabb: np.ndarray,
    count: int,
    width: int,
    height: int,
    seed: int | tuple[int, ...],
    lowest: float = 0.05,
) -> list[Camera]:
    """`count` cameras at seeded random azimuths and elevations above `lowest` radians: the views nothing is
    trained on."""
    rng = np.random.default_rng(seed)
    spots = zip(rng.uniform(0, 2 * np.pi, count), rng.uniform(lowest, 1.3, count), strict=True)
    return [framing_camera(aabb, a, e, width, height, name=f"view_{i:04d}") for i, (a, e) in enumerate(spots)]
