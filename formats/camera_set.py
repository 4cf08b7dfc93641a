"""The rig of a capture: its cameras as a bundle keeps them, and what they look at; see `formats/SPEC.md`.

Poses are camera-to-world, OpenGL axes (formats/views.py). Lengths are those of the world that the cameras
stand in.
"""

import math
from collections import Counter
from dataclasses import dataclass, replace
from typing import Annotated

import msgspec
import numpy as np

from formats.capture_frame import scene_frame
from formats.errors import BadSchema
from formats.images import MAX_SIDE
from formats.names import distinct_names, is_name
from formats.nodes import QUATERNION_SLACK
from formats.rotations import matrices, quaternions
from formats.upright import upward
from formats.views import FARTHEST, NO_DISTORTION, Capture, View

MAX_CAMERAS = 10_000
LARGEST = 1e9
"""Of a lens's numbers, in pixels."""
DIGITS = 8
"""Decimals of a quaternion, and of a position counted in distances to the focus: at a focal length of 10,000
pixels less than a thousandth of a pixel."""
SIMILAR = 1e-4
"""How far from a rotation and one scale a placement may be that cameras go along with."""
INNER = 6
"""Numbers of a lens before its distortion: width, height, fl_x, fl_y, cx, cy."""
FISHEYE = 4
"""How many numbers of distortion only a fisheye has."""
DISTORTIONS = (0, FISHEYE, 5, 6, 9)

Numbers3 = Annotated[list[float], msgspec.Meta(min_length=3, max_length=3)]
Pose = Annotated[list[float], msgspec.Meta(min_length=7, max_length=7)]
Lens = Annotated[list[float], msgspec.Meta(min_length=INNER, max_length=INNER + DISTORTIONS[-1])]
PerCamera = msgspec.Meta(min_length=1, max_length=MAX_CAMERAS)


class RigSchema(msgspec.Struct, omit_defaults=True):
    """The cameras of a capture, those that were held out last."""

    focus: Numbers3
    distance: float
    lenses: Annotated[list[Lens], PerCamera]
    names: Annotated[list[str], PerCamera]
    poses: Annotated[list[Pose], PerCamera]
    lens: Annotated[list[int], msgspec.Meta(max_length=MAX_CAMERAS)] = []
    held_out: int = 0
    surroundings: bool = False


@dataclass(frozen=True, eq=False)
class CameraSet:
    """Cameras of one capture, in the world."""

    train: tuple[View, ...]
    test: tuple[View, ...]
    """Held out: nothing was learnt from their photos."""
    focus: np.ndarray
    """(3,) float64: where the cameras look."""
    distance: float
    """The median of the cameras' distances from the focus."""
    surroundings: bool
    """Photos show what is all around the cameras. Otherwise they show an object that stands free."""

    @property
    def views(self) -> tuple[View, ...]:
        """All cameras."""
        return self.train + self.test

    @property
    def reach(self) -> float:
        """The largest number of the cameras' positions, of the focus and of their distance, or of 1 over
        that."""
        most = max(np.abs(self.poses[:, :3, 3]).max(), np.abs(self.focus).max())
        return float(max(most, self.distance, 1 / self.distance))

    @property
    def poses(self) -> np.ndarray:
        """(N, 4, 4) of all cameras."""
        return np.array([view.camera_to_world for view in self.views])

    @property
    def up(self) -> np.ndarray:
        """(3,) unit vector: see `upward`."""
        return upward(self.poses)

    def height(self, up: np.ndarray) -> float:
        """The median of the cameras' heights above the focus, along a unit vector (3,)."""
        return float(np.median((self.poses[:, :3, 3] - self.focus) @ up))

    @property
    def typical(self) -> View:
        """The camera nearest to the median one, by where it stands, in distances, and where it looks."""
        poses = self.poses
        stands = np.concatenate([poses[:, :3, 3] / self.distance, -poses[:, :3, 2]], 1)
        return self.views[int(np.linalg.norm(stands - np.median(stands, 0), axis=1).argmin())]

    def placed(self, object_to_world: np.ndarray) -> "CameraSet | None":
        """The cameras after (4, 4) was applied to the world they stand in; they see what they saw. None where
        it stretches, shears or mirrors that world, which no camera does, or moves one beyond FARTHEST."""
        linear = object_to_world[:3, :3]
        if np.array_equal(object_to_world, np.eye(4)):
            return self
        scale = float(np.cbrt(np.linalg.det(linear)))
        if scale <= 0 or np.abs(linear.T @ linear / scale**2 - np.eye(3)).max() > SIMILAR:
            return None
        turn = matrices(quaternions(linear[None] / scale))[0]
        focus, distance = linear @ self.focus + object_to_world[:3, 3], self.distance * scale
        train, test = (
            tuple(_moved(view, turn, object_to_world) for view in part) for part in (self.train, self.test)
        )
        moved = replace(self, train=train, test=test, focus=focus, distance=distance)
        return moved if np.abs(moved.poses[:, :3, 3]).max() < FARTHEST > np.abs(focus).max() else None

    def content(self) -> dict:
        """As scene.json has it; numbers are rounded to DIGITS."""
        decimals = DIGITS - math.floor(math.log10(self.distance))
        poses, rows = self.poses, [lens_row(view) for view in self.views]
        lenses = {row: number for number, row in enumerate(dict.fromkeys(rows))}
        turns = quaternions(poses[:, :3, :3])
        return {
            "surroundings": self.surroundings,
            "focus": _rounded(self.focus, decimals),
            "distance": float(self.distance),
            "lenses": [list(lens) for lens in lenses],
            **({"lens": [lenses[row] for row in rows]} if len(lenses) > 1 else {}),
            "names": [
                *distinct_names(v.name for v in self.train),
                *distinct_names(v.name for v in self.test),
            ],
            "poses": [
                _rounded(eye, decimals) + _rounded(turn, DIGITS)
                for eye, turn in zip(poses[:, :3, 3], turns, strict=True)
            ],
            "held_out": len(self.test),
        }

    def summary(self) -> dict:
        """What is told of the cameras, JSON-able: how many, how many held out, the size of most photos."""
        sizes = Counter((view.width, view.height) for view in self.views)
        return {
            "count": len(self.views),
            "held_out": len(self.test),
            "photo_size": list(sizes.most_common(1)[0][0]),
            "sizes": len(sizes),
            "surroundings": self.surroundings,
        }


def capture_camera_set(capture: Capture, surroundings: bool) -> CameraSet:
    """The cameras of a capture, and what they look at."""
    views = capture.train + capture.test
    frame = capture.frame or scene_frame(np.array([view.camera_to_world for view in views]))
    return CameraSet(capture.train, capture.test, frame.focus, frame.distance, surroundings)


def read_camera_set(content: object) -> CameraSet:
    """The cameras of a scene.json. Raises BadSchema."""
    try:
        spec = msgspec.convert(content, RigSchema)
    except msgspec.ValidationError as error:
        raise BadSchema(f"cameras: {error}") from error
    count, kinds = len(spec.names), len(spec.lenses)
    if len(spec.poses) != count or len(spec.lens or spec.names) != count:
        raise BadSchema(f"cameras: {count} names, {len(spec.poses)} poses, expected one of each per camera")
    if not spec.lens and kinds > 1 or not all(0 <= number < kinds for number in spec.lens):
        raise BadSchema(f"cameras: every camera should name one of the {kinds} lenses by its number")
    if not 0 <= spec.held_out <= count:
        raise BadSchema(f"cameras: {spec.held_out} held out of {count}, expected no more than there are")
    if not 1 / FARTHEST < spec.distance < FARTHEST or max(map(abs, spec.focus)) >= FARTHEST:
        raise BadSchema(f"cameras: focus {spec.focus} at a distance of {spec.distance:g} is out of range")
    first_test = count - spec.held_out
    for names in (spec.names[:first_test], spec.names[first_test:]):
        _check_names(names)
    lenses = [_lens(row) for row in spec.lenses]
    chosen = (lenses[number] for number in spec.lens or [0] * count)
    views = tuple(
        View(name, pose, **lens)
        for name, pose, lens in zip(spec.names, _poses(spec.poses), chosen, strict=True)
    )
    focus = np.array(spec.focus)
    return CameraSet(views[:first_test], views[first_test:], focus, spec.distance, spec.surroundings)


def lens_row(view: View) -> tuple[float, ...]:
    """The numbers of a view's lens as scene.json has them, without distortion where there is none."""
    inner = (view.width, view.height, *map(float, (view.fl_x, view.fl_y, view.cx, view.cy)))
    return (*inner, *map(float, view.distortion)) if view.fisheye or any(view.distortion) else inner


def _lens(row: list[float]) -> dict:
    """The words of a View that a lens gives."""
    width, height, *focal = row[:INNER]
    distortion = tuple(row[INNER:])
    if len(distortion) not in DISTORTIONS:
        counts = ", ".join(str(INNER + more) for more in DISTORTIONS)
        raise BadSchema(f"cameras: a lens of {len(row)} numbers, expected {counts}")
    is_whole = width.is_integer() and height.is_integer()
    if not (is_whole and 1 <= min(width, height) and max(width, height) <= MAX_SIDE):
        raise BadSchema(f"cameras: a photo of {width:g}x{height:g} pixels, expected 1 to {MAX_SIDE} a side")
    if not (min(focal[:2]) > 1 / LARGEST and max(map(abs, (*focal, *distortion))) < LARGEST):
        raise BadSchema("cameras: a lens whose focal length, centre or distortion is out of range")
    return {
        **dict(zip(("fl_x", "fl_y", "cx", "cy"), focal, strict=True)),
        "width": int(width),
        "height": int(height),
        "distortion": distortion or NO_DISTORTION,
        "fisheye": len(distortion) == FISHEYE,
    }


def _poses(rows: list[list[float]]) -> np.ndarray:
    """(N, 4, 4) of positions and quaternions."""
    numbers = np.array(rows)
    eyes, turns = numbers[:, :3], numbers[:, 3:]
    lengths = np.sqrt((np.clip(turns, -2, 2) ** 2).sum(1))
    if np.abs(eyes).max() >= FARTHEST or np.abs(lengths - 1).max() > QUATERNION_SLACK:
        raise BadSchema(
            f"cameras: a pose should be a position within {FARTHEST:g} and a unit quaternion xyzw"
        )
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = matrices(turns / lengths[:, None]), eyes
    return poses


def _moved(view: View, turn: np.ndarray, object_to_world: np.ndarray) -> View:
    """A view turned by (3, 3), at the place where (4, 4) takes its own."""
    pose = np.eye(4)
    pose[:3, :3] = turn @ view.camera_to_world[:3, :3]
    pose[:3, 3] = object_to_world[:3, :3] @ view.camera_to_world[:3, 3] + object_to_world[:3, 3]
    return replace(view, camera_to_world=pose)


def _rounded(numbers: np.ndarray, decimals: int) -> list[float]:
    return [round(float(number), decimals) + 0.0 for number in numbers]  # + 0.0: no "-0"


# --- names --------------------------------------------------------------------------------------------------


def _check_names(names: list[str]) -> None:
    """Raises BadSchema for a name that is none, or that two cameras of one part have."""
    wrong = next((name for name in names if not is_name(name)), None)
    if wrong is not None:
        raise BadSchema(f"cameras: {wrong[:40]!r} cannot name a picture, expected printable text without /")
    if len(set(names)) < len(names):
        twice = Counter(names).most_common(1)[0][0]
        raise BadSchema(f"cameras: two of them are named {twice!r}, expected a name for each")
