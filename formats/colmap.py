"""COLMAP's sparse models: cameras, posed images and points, from the binary files or the text ones.

Binary files are little endian; images hold world-to-camera as a quaternion (w, x, y, z) and a translation,
with x right, y down, z forward. Files `rigs` and `frames` of newer versions are not needed.
"""

import os
import struct
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from operator import itemgetter
from pathlib import Path, PurePosixPath

import numpy as np

from formats.cameras import BENDS, FISHEYE_BENDS, MOST_PIXELS, checked_focal, checked_size
from formats.capture_frame import depth_range
from formats.colmap_points import ListedPoints, binary_points, text_points
from formats.colmap_text import check_count, number, numbered_lines, pose_number
from formats.errors import (
    BadIntrinsics,
    BadModel,
    BadPose,
    FormatError,
    UnsupportedCamera,
    noted,
)
from formats.frame_list import once, read_sound
from formats.matching import stem_key
from formats.photos import folders
from formats.points import MAX_POINTS, SparsePoints, points_notes
from formats.rotations import matrices
from formats.safe_input import MAX_BYTES, open_input, read_input
from formats.views import FARTHEST, View

MAX_CAMERAS_BYTES = 64 * 2**20
MAX_NAME = 4096
MODELS = {
    "SIMPLE_PINHOLE": "f cx cy",
    "PINHOLE": "fx fy cx cy",
    "SIMPLE_RADIAL": "f cx cy k1",
    "RADIAL": "f cx cy k1 k2",
    "OPENCV": "fx fy cx cy k1 k2 p1 p2",
    "OPENCV_FISHEYE": "fx fy cx cy k1 k2 k3 k4",
    "FULL_OPENCV": "fx fy cx cy k1 k2 p1 p2 k3 d1 d2 d3",
    "SIMPLE_RADIAL_FISHEYE": "f cx cy k1",
    "RADIAL_FISHEYE": "f cx cy k1 k2",
    "SIMPLE_FISHEYE": "f cx cy",
    "FISHEYE": "fx fy cx cy",
}
"""Parameters of the models that can be rendered, in COLMAP's order. FULL_OPENCV's last three are OpenCV's k4,
k5 and k6."""
NUMBERS = (
    "SIMPLE_PINHOLE PINHOLE SIMPLE_RADIAL RADIAL OPENCV OPENCV_FISHEYE FULL_OPENCV FOV SIMPLE_RADIAL_FISHEYE "
    "RADIAL_FISHEYE THIN_PRISM_FISHEYE RAD_TAN_THIN_PRISM_FISHEYE SIMPLE_DIVISION DIVISION SIMPLE_FISHEYE "
    "FISHEYE EUCM EQUIRECTANGULAR"
).split()
"""Names of the models by their number in binary files."""
MODELS_IN = ("sparse", "colmap")
"""Folders that models lie in, in the folder of their capture."""
MODELS_BELOW = ("sparse", "colmap/sparse", "distorted/sparse")
"""Where COLMAP, nerfstudio and scripts of Gaussian splatting store models; the last, of the photos as taken,
in `input`, where the others are not."""
PHOTOS_IN = ("images", "input")
"""Folders that its photos lie in."""
NO_POINT = 2**64 - 1
SMALLEST_IMAGE = 73
"""Bytes of an image without a name or observations."""


@dataclass(frozen=True, eq=False)
class Image:
    """One posed image of a model."""

    name: str
    """Path of the photo inside the folder of photos."""
    where: str
    """How errors name it."""
    view: View
    """Its camera, for a photo of the size given in the model."""


@dataclass(frozen=True, eq=False)
class Model:
    """The content of a folder like `sparse/0`."""

    folder: Path
    images: tuple[Image, ...]
    points: SparsePoints | None
    notes: tuple[str, ...] = ()
    """What of the model is not used, and why."""


def model_folder(path: Path) -> Path | None:
    """The folder of a model at `path`, or of the largest one below it where COLMAP and nerfstudio store it;
    None without one."""
    return next(iter(model_folders(path)), None)


def model_folders(path: Path) -> list[Path]:
    """The folder at `path` where that is a model's, or those below it, by how many images they have."""
    for place in (path, *(path / inner for inner in MODELS_BELOW)):
        below = [place]
        if place != path or path.name == "sparse":
            below += folders(place)
        if models := [folder for folder in below if _has(folder, "cameras") and _has(folder, "images")]:
            return sorted(models, key=image_count, reverse=True)
    return []


def image_count(folder: Path) -> int:
    """How many images a model has, as its file states it; 0 where that cannot be read."""
    try:
        if (folder / "images.bin").is_file():
            with open_input(folder / "images.bin") as file:
                count, size = int.from_bytes(file.read(8), "little"), os.fstat(file.fileno()).st_size
            return count if count <= size // SMALLEST_IMAGE else 0
        path = folder / "images.txt"
        return len(_text_images(path, read_input(path)))
    except (FormatError, OSError):
        return 0


def capture_folder(model: Path) -> Path:
    """The folder above a model, in which the photos lie: `x` of `x/sparse/0` and of `x/colmap/sparse/0`. A
    capture may itself be called so."""
    for _ in range(3):
        holds_photos = any((model / name).is_dir() for name in PHOTOS_IN)
        if not holds_photos and (model.name.isdecimal() or model.name in MODELS_IN):
            model = model.resolve().parent
    return model


def _has(folder: Path, name: str) -> bool:
    return any((folder / f"{name}.{ending}").is_file() for ending in ("bin", "txt"))


def read_model(folder: Path, most_points: int = MAX_POINTS) -> Model:
    """The model of a folder; binary files are preferred. Points are optional, and of more than `most_points`
    only some are read.

    Raises BadIntrinsics, BadModel, BadPose, LimitExceeded, MissingFile, ResourceError, UnsupportedCamera.
    """
    cameras = _read(folder, "cameras", {"bin": _binary_cameras, "txt": _text_cameras}, MAX_CAMERAS_BYTES)
    listed = _images(folder)
    if not listed:
        raise BadModel(f"{folder}: its images file is empty; export the model again")
    points, notes = None, []
    with noted(notes, "the model is read without its points"):
        points = _points(folder, most_points)

    def read(listing: tuple) -> Image:
        where, name, quaternion, translation, camera, seen = listing
        if camera not in cameras:
            raise BadModel(
                f"{where}: is of camera {camera}, which the cameras file does not list; export again"
            )
        pose = _pose(quaternion, translation, where)
        view = replace(cameras[camera], camera_to_world=pose)
        if points is not None:
            indices = points.found(seen)
            near, far = depth_range(pose, points.points.positions[indices])
            view = replace(view, near=near, far=far, seen=points.sure(indices))
        return Image(name, where, view)

    listed, repeated = once(folder, listed, itemgetter(1), lambda item: (*item[2], *item[3]))
    images, broken = read_sound(folder, listed, read, itemgetter(1))
    notes = (*repeated, *broken, *notes, *points_notes(folder, points and points.points))
    return Model(folder, tuple(images), points and points.points, notes)


def _images(folder: Path) -> list[tuple]:
    return _read(folder, "images", {"bin": _binary_images, "txt": _text_images})


def read_points(folder: Path, most: int = MAX_POINTS) -> tuple[SparsePoints | None, dict[str, np.ndarray]]:
    """The points alone, at most so many, None where the model has none; and, by the `stem_key` of each
    photo's file, which of them were found in it (View.seen). Photos that share a stem are left out."""
    known = _points(folder, most)
    if known is None:
        return None, {}
    named = [(stem_key(PurePosixPath(name).name), ids) for _, name, *_, ids in _images(folder)]
    stems = Counter(stem for stem, _ in named)
    return known.points, {stem: known.sure(known.found(ids)) for stem, ids in named if stems[stem] == 1}


def _points(folder: Path, most: int) -> ListedPoints | None:
    if not _has(folder, "points3D"):
        return None
    parsers = {"bin": partial(binary_points, most), "txt": partial(text_points, most)}
    return _read(folder, "points3D", parsers)


def _read(folder: Path, name: str, parsers: dict, limit: int = MAX_BYTES):
    ending = "bin" if (folder / f"{name}.bin").is_file() else "txt"
    path = folder / f"{name}.{ending}"
    data = read_input(path, limit)
    try:
        return parsers[ending](path, data)
    except struct.error:
        raise BadModel(f"{path}: the file is truncated; copy or export it again") from None


def _pose(quaternion: np.ndarray, translation: np.ndarray, where: str) -> np.ndarray:
    """(4, 4) camera-to-world, OpenGL axes, of a world-to-camera rotation and translation."""
    numbers = np.array([*quaternion, *translation], np.float64)
    usable = np.abs(numbers).max() < FARTHEST  # False for NaN too
    length = float(np.linalg.norm(numbers[:4])) if usable else 0.0
    if not 1e-3 < length < 1e3:
        raise BadPose(
            f"{where}: its pose is not a rotation with a translation below {FARTHEST:g}; remove the image, "
            "or map again"
        )
    w, x, y, z = numbers[:4] / length
    rotation = matrices(np.array([x, y, z, w]))
    pose = np.eye(4)
    pose[:3, :3] = rotation.T * [1, -1, -1]
    pose[:3, 3] = -rotation.T @ numbers[4:]
    return pose


# --- cameras ------------------------------------------------------------------------------------------------


def _camera(where: str, model: str, width: int, height: int, numbers) -> View:
    """A camera with the identity as pose."""
    names = MODELS[model].split()
    if len(numbers) != len(names):
        raise BadModel(
            f"{where}: {model} has {len(numbers)} parameters, expected {len(names)}: {MODELS[model]}"
        )
    if not all(abs(number) < MOST_PIXELS for number in numbers):
        raise BadIntrinsics(
            f"{where}: a parameter is not a number below {MOST_PIXELS:g}; export the model again"
        )
    parameters = dict(zip(names, map(float, numbers), strict=True))
    fl_x, fl_y = (parameters.get(key, parameters.get("f", 0.0)) for key in ("fx", "fy"))
    for focal in (fl_x, fl_y):
        checked_focal(focal, where)
    checked_size(width, height, where)
    fisheye = "FISHEYE" in model
    keys = FISHEYE_BENDS if fisheye else (*BENDS, "k4", "d1", "d2", "d3")
    bends = tuple(parameters.get(key, 0.0) for key in keys)
    if not fisheye and not any(bends[5:]):
        bends = bends[:5]
    return View("", np.eye(4), fl_x, fl_y, parameters["cx"], parameters["cy"], width, height, bends, fisheye)


def _known(where: str, model: str) -> str:
    if model not in MODELS:
        raise UnsupportedCamera(
            f"{where}: a camera of the model {model[:40]}, expected one of {', '.join(MODELS)}; undistort "
            "the photos with COLMAP's image_undistorter"
        )
    return model


def _binary_cameras(path: Path, data: bytes) -> dict[int, View]:
    (count,) = struct.unpack_from("<Q", data)
    check_count(path, count, len(data), 24)
    cameras, at = {}, 8
    for _ in range(count):
        camera, number, width, height = struct.unpack_from("<IiQQ", data, at)
        where = f"{path}: camera {camera}"
        named = NUMBERS[number] if 0 <= number < len(NUMBERS) else f"number {number}"
        model = _known(where, named)
        layout = f"<{len(MODELS[model].split())}d"
        numbers = struct.unpack_from(layout, data, at + 24)
        cameras[camera] = _camera(where, model, width, height, numbers)
        at += 24 + struct.calcsize(layout)
    return cameras


def _text_cameras(path: Path, data: bytes) -> dict[int, View]:
    cameras = {}
    for line, text in numbered_lines(path, data):
        words = text.split()
        if not words:
            continue
        if len(words) < 5:
            raise BadModel(f"{path}: line {line}: expected an id, a model, width, height and its parameters")
        camera, width, height = (number(path, line, words[i], int) for i in (0, 2, 3))
        where = f"{path}: camera {camera}"
        numbers = [number(path, line, word, float) for word in words[4:]]
        cameras[camera] = _camera(where, _known(where, words[1].upper()), width, height, numbers)
    return cameras


# --- images -------------------------------------------------------------------------------------------------


def _binary_images(path: Path, data: bytes) -> Iterator[tuple]:
    """(where, name, quaternion, translation, camera, ids of the points it saw) of each image."""
    (count,) = struct.unpack_from("<Q", data)
    check_count(path, count, len(data), SMALLEST_IMAGE)
    at, listings = 8, []
    for _ in range(count):
        image, *numbers, camera = struct.unpack_from("<I7dI", data, at)
        end = data.find(b"\0", at + 64, at + 64 + MAX_NAME)
        if end < 0:
            raise BadModel(f"{path}: image {image} has no complete name; copy or export it again")
        name = data[at + 64 : end].decode("utf-8", "replace")
        (observed,) = struct.unpack_from("<Q", data, end + 1)
        at = end + 9
        if observed > (len(data) - at) // 24:
            raise BadModel(f"{path}: the file is truncated in image {image}; copy or export it again")
        seen = np.frombuffer(data, "<u8", 3 * observed, at)[2::3]
        at += 24 * observed
        where = f"{path}: image {image} ({name})"
        listings.append((where, name, numbers[:4], numbers[4:], camera, seen[seen != NO_POINT]))
    return listings


def _text_images(path: Path, data: bytes) -> list[tuple]:
    """As `_binary_images`; the second line of an image holds x, y and point of each observation. It may be
    empty, or be missing where the poses were not found by COLMAP."""
    listings, lines = [], deque(numbered_lines(path, data))
    while lines:
        line, text = lines.popleft()
        if not text:
            continue
        words = text.split(None, 9)
        if len(words) < 10:
            raise BadModel(f"{path}: line {line}: expected an id, a pose, a camera and a name")
        image, camera = (number(path, line, words[i], int) for i in (0, 8))
        numbers = [pose_number(path, line, word) for word in words[1:8]]
        name = words[9]
        seen = np.empty(0, np.int64)
        if lines and not _is_image(lines[0][1]):
            line, text = lines.popleft()
            observed = text.split()
            try:
                seen = np.array(observed[2::3], np.int64)
                if len(observed) % 3:
                    raise ValueError
            except (ValueError, OverflowError):
                raise BadModel(
                    f"{path}: line {line}: expected x, y and a point's id again and again"
                ) from None
        where = f"{path}: image {image} ({name})"
        listings.append((where, name, numbers[:4], numbers[4:], camera, seen[seen >= 0].astype(np.uint64)))
    return listings


def _is_image(text: str) -> bool:
    """Whether a line is the first of an image: its last words are a name, no numbers, or too few for a
    point's."""
    words = text.split(None, 9)
    if len(words) < 10:
        return False
    try:
        int(words[0]), int(words[8]), [float(word) for word in words[1:8]]
    except ValueError:
        return False
    rest = words[9].split()
    try:
        [float(word) for word in rest]
    except ValueError:
        return True
    return len(rest) % 3 != 0
