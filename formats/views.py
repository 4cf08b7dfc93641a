"""Posed pictures: a `View` is one camera and what it saw, a `Capture` is all views of one subject.

`camera_to_world` is (4,4) float64, OpenGL axes: +x right, +y up, looking along -z. A camera-frame point (x,
y, z) lands on pixel (cx + fl_x * u, cy + fl_y * v), where (u, v) is (x / -z, -y / -z), z < 0, bent by the
distortion, or for a fisheye (x, -y) * r(a) / |(x, y)| with a the angle from -z. Pixel coordinates grow right
and down, and the centre of the top left pixel is (0.5, 0.5).
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from formats.capture_frame import SceneFrame
from formats.errors import BadPose, NoViews
from formats.points import SparsePoints

LEAST_VIEWS = 3
"""Depth does not follow from fewer photos."""
APART = 1e-13
"""Cameras nearer to each other than this share of their distance from the origin stand at one point."""
NO_DISTORTION = (0.0, 0.0, 0.0, 0.0, 0.0)
ORTHONORMAL_TOLERANCE = 1e-3
"""Of the last row of a pose."""
EXACT, ROUNDED = 1e-4, 2e-2
"""How far from orthonormal the axes of a pose may be that are taken as they are, as they have from float32 or
five decimals, and that are taken for the nearest rotation, as they have from two decimals."""
SCALED = 1e-2
"""Axes that are so much longer or shorter than 1 were scaled."""
FARTHEST = 1e13
"""Cameras stand within this of the world's origin."""


@dataclass(frozen=True, eq=False)
class View:
    """One posed picture; `name` is its file stem, unique within its file or split."""

    name: str
    camera_to_world: np.ndarray
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    width: int
    height: int
    distortion: tuple[float, ...] = NO_DISTORTION
    """k1, k2, k3 (radial), p1, p2 (tangential), as OpenCV defines them, and where it needs more k4, d1, d2,
    d3: the radial factor is (1 + k1 r² + k2 r⁴ + k3 r⁶ + k4 r⁸) / (1 + d1 r² + d2 r⁴ + d3 r⁶). Of a fisheye
    k1, k2, k3, k4: r(a) = a (1 + k1 a² + k2 a⁴ + k3 a⁶ + k4 a⁸)."""
    fisheye: bool = False
    image_path: Path | None = None
    orientation: int = 1
    """EXIF orientation to apply to the photo's stored pixels to get this camera's; 1 for none."""
    exif: int = 1
    """The orientation that the photo's EXIF states, applied or not."""
    reduction: int = 1
    """Pixels a side of the turned photo that one of this camera's is the mean of; those that are left over at
    its right and lower border are not used."""
    mask_path: Path | None = None
    """A picture of the same aspect ratio, black where the photo must be ignored; or the photo itself, whose
    transparent pixels must be."""
    alpha: bool = True
    """Whether the photo's alpha channel, if it has one, says where nothing is; False: all of it is opaque."""
    premultiplied: bool = False
    """Whether the photo's colours are multiplied by its alpha."""
    near: float | None = None
    far: float | None = None
    """Depths (along -z, world units) between which lie the sparse points that it sees, except for one in a
    thousand on each side."""
    seen: np.ndarray | None = None
    """(N,) int64: which of the capture's sparse points were found in its photo, each once; None where nothing
    says so."""
    pixels: np.ndarray | None = None
    """(height, width, 4) uint8, straight alpha, of a view that was made in memory."""
    repair: str = ""
    """What was mended of its pose, as the end of a sentence; empty where nothing was."""

    def stretched(self, width: int, height: int) -> "View":
        """The same camera behind a picture resampled to `width` x `height`, each axis by its own factor."""
        x, y = width / self.width, height / self.height
        focal = {"fl_x": self.fl_x * x, "fl_y": self.fl_y * y, "cx": self.cx * x, "cy": self.cy * y}
        return replace(self, width=width, height=height, **focal)

    def reduced(self, factor: int) -> "View":
        """The same camera behind its photo made smaller by a whole factor."""
        focal = {key: getattr(self, key) / factor for key in ("fl_x", "fl_y", "cx", "cy")}
        size = {"width": self.width // factor, "height": self.height // factor}
        return replace(self, **size, **focal, reduction=self.reduction * factor)

    def corners(self, depth: float, box: tuple[int, int, int, int] | None = None) -> np.ndarray:
        """(4, 3) world points at a depth behind the corners of the picture, or of a box (left, top, right,
        bottom) in it; distortion is neglected."""
        left, top, right, bottom = box or (0, 0, self.width, self.height)
        x = np.array([left, right, left, right]) - self.cx
        y = np.array([top, top, bottom, bottom]) - self.cy
        local = np.stack([x / self.fl_x, -y / self.fl_y, -np.ones(4)], 1) * depth
        return local @ self.camera_to_world[:3, :3].T + self.camera_to_world[:3, 3]

    def shown(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
        """Where the picture shows world points (N, 3): column, row, how far they are, along the axis or, of a
        fisheye, in all, and which of them lie in the picture, (N,) each."""
        x, y, back = ((points - self.camera_to_world[:3, 3]) @ self.camera_to_world[:3, :3]).T
        if self.fisheye:
            away, aside = np.sqrt(x * x + y * y + back * back), np.hypot(x, y)
            angle = np.arctan2(aside, -back)
            stretch, slope = _polynomial(self.distortion, angle * angle)
            rising = stretch + 2 * angle * angle * slope > 0
            u, v = np.array([x, -y]) * angle * stretch / np.maximum(aside, 1e-12)
        else:
            away, rising = -back, True
            u, v = np.array([x, -y]) / np.where(away > 0, away, np.inf)
            if any(self.distortion):
                u, v, rising = _bent(u, v, self.distortion)
        column, row = self.cx + self.fl_x * u, self.cy + self.fl_y * v
        across, down = (column >= 0) & (column < self.width), (row >= 0) & (row < self.height)
        return column, row, away, (away > 0) & rising & across & down

    def reframed(self, width: int, height: int) -> "View":
        """The same camera at another size: its horizontal field of view stays, rows are cut or added."""
        scale = width / self.width
        cy = height / 2 + (self.cy - self.height / 2) * scale
        focal = {"fl_x": self.fl_x * scale, "fl_y": self.fl_y * scale, "cx": self.cx * scale, "cy": cy}
        return replace(self, width=width, height=height, **focal)


def _bent(u: np.ndarray, v: np.ndarray, distortion: tuple[float, ...]) -> tuple[np.ndarray, ...]:
    """Where a lens shows (u, v), and whether no fold of it lies nearer, beyond which points come back."""
    k1, k2, k3, p1, p2, k4, *below = (*distortion, *(0.0,) * (9 - len(distortion)))
    r2 = u * u + v * v
    (up, up_slope), (down, down_slope) = _polynomial((k1, k2, k3, k4), r2), _polynomial(below, r2)
    stretch = up / down
    rising = stretch + 2 * r2 * (up_slope - stretch * down_slope) / down > 0
    across = 2 * p1 * u * v + p2 * (r2 + 2 * u * u)
    return u * stretch + across, v * stretch + p1 * (r2 + 2 * v * v) + 2 * p2 * u * v, rising


def _polynomial(factors: Sequence[float], x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """1 + f1 x + f2 x² + ..., and its slope."""
    value, slope = np.zeros_like(x), np.zeros_like(x)
    for factor in (*reversed(factors), 1.0):
        value, slope = value * x + factor, slope * x + value
    return value, slope


@dataclass(frozen=True, eq=False)
class Capture:
    """Posed pictures of one subject; `test` views are for measuring only."""

    path: Path
    kind: str
    """"blender", "transforms", "colmap", "llff", "polycam", "pose files", "opensfm" or "mesh"."""
    train: tuple[View, ...]
    test: tuple[View, ...]
    aabb: np.ndarray
    """(6,) float64 [xmin ymin zmin xmax ymax zmax] in world units: where the subject is taken to be; where
    alpha or a white ground shows its outlines, what they leave room for."""
    opaque: bool
    """No picture's alpha says where nothing is."""
    object_aabb: np.ndarray | None = None
    """(6,) the box of the object that the masks cut out, where they do."""
    missing: tuple[str, ...] = ()
    """Photos that are listed but do not exist; their frames are left out."""
    points: SparsePoints | None = None
    """Sparse points from structure from motion, where the capture has them."""
    frame: SceneFrame | None = None
    """The layout of the cameras, where the box follows from it."""
    notes: tuple[str, ...] = ()
    """Sentences about choices made while reading."""

    def summary(self) -> dict:
        """What was read and chosen, for a report."""
        views = self.train + self.test
        facts = {"kind": self.kind, "missing": len(self.missing)}
        if views[0].image_path is not None:
            facts["photos"] = f"{views[0].width}x{views[0].height}"
        if self.points is not None:
            facts["sparse_points"] = len(self.points.positions)
        if masked := sum(view.mask_path is not None for view in views):
            facts["masked"] = masked
        if self.frame is not None:
            frame = self.frame
            facts |= {"layout": frame.layout, "focus": frame.focus.tolist(), "distance": frame.distance}
        return {**facts, "notes": list(self.notes)} if self.notes else facts


def hold_out(capture: Capture, every: int) -> Capture:
    """Train views 0, `every`, 2 `every`, ... moved behind the test views; NoViews if none is left."""
    train = tuple(view for i, view in enumerate(capture.train) if i % every)
    if not train:
        raise NoViews(
            f"{capture.path}: holding out every {every} of {len(capture.train)} views leaves none "
            "to train on; hold out fewer"
        )
    return replace(capture, train=train, test=capture.test + capture.train[::every])


def check_parallax(capture: Capture) -> None:
    """Photos from which depth follows: at least LEAST_VIEWS, not all from one point. Raises BadPose, NoViews.

    Views of a mesh are not photos: nobody can take more.
    """
    views = capture.train
    if capture.kind == "mesh":
        return
    if len(views) < LEAST_VIEWS:
        held_out = f" beside {len(capture.test)} that only measure" if capture.test else ""
        raise NoViews(
            f"{capture.path}: has {len(views)} photos to learn from{held_out}, but depth follows only from "
            f"{LEAST_VIEWS} or more; add photos from other places"
        )
    eyes = np.array([view.camera_to_world[:3, 3] for view in views])
    if np.ptp(eyes, axis=0).max() <= APART * np.abs(eyes).max():
        raise BadPose(
            f"{capture.path}: the cameras of all {len(views)} photos, {views[0].name} to {views[-1].name}, "
            "stand at one point, from which no depth follows; take photos from different places, or estimate "
            "their poses again with `fusedrf pose`"
        )


def checked_pose(matrix: object, where: str) -> tuple[np.ndarray, str]:
    """A rigid (4,4) float64 pose from 16 or 12 numbers in rows of four, and what was mended of it (`repair`
    of a View). Scaled axes are brought to length 1, and axes that are not quite square, as rounding leaves
    them, to the nearest rotation. Raises BadPose led by `where`."""
    if matrix is None:
        raise BadPose(f"{where}: has no camera pose, expected 4x4 numbers, camera-to-world; export it again")
    try:
        pose = np.array(matrix, dtype=np.float64).reshape(-1, 4)
    except (TypeError, ValueError, OverflowError):
        raise BadPose(f"{where}: the camera pose is not a 4x4 matrix of numbers") from None
    if pose.shape == (3, 4):
        pose = np.vstack([pose, [0, 0, 0, 1]])
    if pose.shape != (4, 4):
        raise BadPose(f"{where}: the camera pose has {pose.size} numbers, expected four rows of four")
    if not np.isfinite(pose).all():
        raise BadPose(
            f"{where}: the camera pose holds NaN or infinity; drop this frame or export the poses again"
        )
    if np.abs(pose[3] - [0, 0, 0, 1]).max() > ORTHONORMAL_TOLERANCE:
        turned = np.abs(pose[:, 3] - [0, 0, 0, 1]).max() <= ORTHONORMAL_TOLERANCE
        cure = "; it is transposed: write its columns as rows" if turned else ""
        raise BadPose(
            f"{where}: the camera pose ends in the row {pose[3].tolist()}, expected [0, 0, 0, 1]{cure}"
        )
    if np.abs(pose[:3, 3]).max() >= FARTHEST:
        raise BadPose(
            f"{where}: the camera stands {np.abs(pose[:3, 3]).max():.3g} from the world's origin, expected "
            f"less than {FARTHEST:g}; export the poses in another unit, or around another origin"
        )
    pose[:3, :3], repair = _rotation(pose[:3, :3], where)
    return pose, repair


def _rotation(axes: np.ndarray, where: str) -> tuple[np.ndarray, str]:
    """The rotation (3, 3) that a pose's axes are, and what was mended of them."""
    with np.errstate(all="ignore"):
        lengths = np.linalg.norm(axes, axis=0)
        unit = axes / lengths
        error = float(np.abs(unit.T @ unit - np.eye(3)).max())
    if not error <= ROUNDED:  # also NaN, of an axis without length
        listing = ", ".join(f"{length:.4g}" for length in lengths)
        raise BadPose(
            f"{where}: the camera pose is no rotation (column lengths {listing}, {error:.2g} from "
            "orthonormal); drop this frame or export the poses again"
        )
    if np.linalg.det(unit) < 0:
        raise BadPose(f"{where}: the camera pose is mirrored (determinant -1); check the exporter's axes")
    stretch = float(np.abs(lengths - 1).max())
    if max(error, stretch) <= EXACT:
        return axes, ""
    u, _, v = np.linalg.svd(unit)
    if stretch > SCALED:
        return u @ v, "have scaled axes, which were brought to length 1"
    return u @ v, "are rounded, and the nearest rotations were taken"
