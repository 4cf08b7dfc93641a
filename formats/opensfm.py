"""OpenSfM's `reconstruction.json`, which OpenDroneMap keeps too: cameras, posed shots and points.

A shot's rotation is an axis times an angle, world-to-camera with x right, y down and z forward. Focal lengths
and centres are shares of a photo's longer side, centres from its middle. The axes are east, north and up, in
metres from a reference, where GPS is known.
"""

import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from formats.cameras import BENDS, FISHEYE_BENDS, MAX_JSON, checked_focal, checked_size, stated_number
from formats.colmap import Image, Model
from formats.errors import BadJson, BadModel, BadPose, FormatError, UnsupportedCamera
from formats.frame_list import read_sound
from formats.photos import is_file
from formats.points import MAX_POINTS, SparsePoints
from formats.rotations import matrices
from formats.safe_input import decoded, open_input, read_input
from formats.views import View, checked_pose

NAME, PROJECT = "reconstruction.json", "opensfm"
"""The file, and the folder that OpenDroneMap keeps it in beside its photos."""
PINHOLES = ("perspective", "simple_radial", "radial", "brown")
FISHEYES = ("fisheye", "fisheye_opencv")
HEAD = 1 << 16


def reconstruction(path: Path) -> Path | None:
    """The file of a folder, or of its `opensfm`; None without one."""
    paths = (path / NAME, path / PROJECT / NAME)
    return next(
        (candidate for candidate in paths if is_file(candidate) and is_reconstruction(candidate)), None
    )


def is_reconstruction(path: Path) -> bool:
    """Whether a file begins as OpenSfM writes it."""
    try:
        with open_input(path) as file:
            head = file.read(HEAD)
    except FormatError:
        return False
    return head.lstrip().startswith(b"[") and (b'"cameras"' in head or b'"shots"' in head)


def read_model(path: Path) -> Model:
    """The largest reconstruction of a file.

    Raises BadIntrinsics, BadJson, BadModel, BadPose, LimitExceeded, MissingFile, UnsupportedCamera.
    """
    try:
        listed = json.loads(decoded(read_input(path, MAX_JSON)))
    except (ValueError, RecursionError) as error:
        raise BadJson(f"{path}: not JSON that can be read ({error}); export it again") from error
    models = [part for part in listed if isinstance(part, dict) and isinstance(part.get("shots"), dict)]
    largest = max(models, key=lambda part: len(part["shots"]), default={"shots": {}})
    shots, cameras = largest["shots"], largest.get("cameras")
    if not shots or not isinstance(cameras, dict):
        raise BadModel(f"{path}: holds no shots with their cameras; reconstruct again")

    def read(name: str) -> Image:
        where = f"{path}: shot {name}"
        shot = shots[name] if isinstance(shots[name], dict) else {}
        camera = cameras.get(shot.get("camera"))
        if not isinstance(camera, dict):
            raise BadModel(f"{where}: is of a camera that the file does not list; reconstruct again")
        return Image(name, where, _view(where, camera, shot))

    images, broken = read_sound(path, list(shots), read, str)
    notes = list(broken)
    if len(models) > 1:
        others = ", ".join(str(len(part["shots"])) for part in models if part is not largest)
        notes.append(f"{path}: the reconstruction of {len(shots)} photos is read, and not those of {others}")
    return Model(path, tuple(images), _points(largest.get("points")), tuple(notes))


def _view(where: str, camera: dict, shot: dict) -> View:
    turn, shift = (_numbers(shot.get(key), 3) for key in ("rotation", "translation"))
    if turn is None or shift is None:
        raise BadPose(f"{where}: expected rotation and translation of three numbers; reconstruct again")
    angle = np.linalg.norm(turn)
    axis = turn / angle if angle else turn
    to_camera = matrices(np.array([*axis * np.sin(angle / 2), np.cos(angle / 2)]))
    pose = np.column_stack([to_camera.T * [1, -1, -1], -to_camera.T @ shift])
    pose, repair = checked_pose(pose, where)
    kind = str(camera.get("projection_type", "perspective"))
    if kind not in PINHOLES + FISHEYES:
        raise UnsupportedCamera(
            f"{where}: a camera of the type {kind[:40]}, expected a pinhole or a fisheye; undistort them"
        )
    keys = ("width", "height", "focal", "focal_x", "focal_y", "c_x", "c_y", *BENDS, "k4")
    numbers = {key: stated_number((camera,), key, where, 0.0) for key in keys}
    width, height = checked_size(round(numbers["width"]), round(numbers["height"]), where)
    longer = max(width, height)
    focals = [
        checked_focal(longer * (numbers[key] or numbers["focal"]), where) for key in ("focal_x", "focal_y")
    ]
    centre = width / 2 + longer * numbers["c_x"], height / 2 + longer * numbers["c_y"]
    bends = FISHEYE_BENDS if kind in FISHEYES else BENDS
    bends = tuple(numbers[key] for key in bends)
    return View("", pose, *focals, *centre, width, height, bends, kind in FISHEYES, repair=repair)


def _numbers(listed: object, count: int) -> np.ndarray | None:
    """(count,) float64 of a list of finite numbers; None of anything else."""
    if not isinstance(listed, list) or len(listed) != count:
        return None
    if not all(type(number) in (int, float) and abs(number) < 1e30 for number in listed):
        return None
    return np.array(listed, np.float64)


def _points(listed: object) -> SparsePoints | None:
    """Those of a reconstruction, without damaged ones."""
    if not isinstance(listed, Mapping):
        return None
    rows = [
        (_numbers(point.get("coordinates"), 3), _numbers(point.get("color"), 3))
        for point in list(listed.values())[:MAX_POINTS]
        if isinstance(point, dict)
    ]
    rows = [(at, np.full(3, 255.0) if colour is None else colour) for at, colour in rows if at is not None]
    if not rows:
        return None
    positions, colours = (np.array(column) for column in zip(*rows, strict=True))
    return SparsePoints(positions, np.clip(colours, 0, 255).astype(np.uint8))
