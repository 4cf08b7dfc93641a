"""Cameras in JSON: the frames of a `transforms*.json` and nerfstudio's `camera_path.json`, as `View`s.

Poses are camera-to-world with OpenGL axes in all of them. A frame's own intrinsics go before the file's; of
one source the first of `x_fov` (degrees), `fl_x` (pixels), `camera_angle_x` (radians) counts, and the same
for y. Without a focal length for y pixels are square; without a principal point it is the centre.
"""

import json
import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path, PurePosixPath

from formats.errors import BadIntrinsics, BadJson, BadSchema, LimitExceeded, NoViews, UnsupportedCamera
from formats.images import MAX_SIDE, read_image_header
from formats.matching import Listings
from formats.names import distinct_names
from formats.other_files import foreign_json
from formats.photos import split_ending
from formats.safe_input import decoded, read_input
from formats.views import View, checked_pose

MAX_JSON = 256 * 2**20
PERSPECTIVE = {"", "PERSPECTIVE", "PINHOLE", "SIMPLE_PINHOLE", "RADIAL", "SIMPLE_RADIAL", "OPENCV"}
RATIONAL = "FULL_OPENCV"
FISHEYE = {"FISHEYE", "OPENCV_FISHEYE", "SIMPLE_FISHEYE", "RADIAL_FISHEYE", "SIMPLE_RADIAL_FISHEYE"}
BENDS, FISHEYE_BENDS = ("k1", "k2", "k3", "p1", "p2"), ("k1", "k2", "k3", "k4")
RATIONAL_BENDS = ("k4", "k5", "k6")
SMALL = 16
"""Pixels a side of pictures so small that a centre of less than one pixel may be meant."""
LEAST_PIXELS, MOST_PIXELS = 1e-3, 1e8
"""Of a focal length; a principal point and distortion are within the latter."""
MAX_VALUES = 20_000_000
"""Commas of a file of cameras, which bound the memory that it takes to read."""
JSON_TOKEN = re.compile(r'"(?:[^"\\]++|\\.)*+(?:"|\\?\Z)|//[^\n]*|/\*.*?(?:\*/|\Z)', re.DOTALL)
"""A text or a comment. One that does not end takes the rest of the file: nothing is looked at twice."""


def read_cameras(path: Path | str, size: tuple[int, int] | None = None) -> tuple[View, ...]:
    """The cameras of a `transforms*.json`, whose photos need not exist, or of a `camera_path.json`, in file
    order.

    `size` (width, height) replaces the file's; then a transforms.json keeps its horizontal field of view and
    a camera path its vertical one, which is how each states them. Raises BadIntrinsics where no size is
    known, BadPose, BadJson, BadSchema, MissingFile, NoViews, UnsupportedCamera.
    """
    path = Path(path)
    document = read_document(path)
    views = (
        _path_views(path, document, size) if "camera_path" in document else _frame_views(path, document, size)
    )
    if not views:
        raise NoViews(f"{path}: lists no cameras; expected at least one frame")
    return views


# --- transforms.json ----------------------------------------------------------------------------------------


def read_document(path: Path, most: int = MAX_VALUES) -> dict:
    """A JSON object, in which // and /* */ comments are allowed as instant-ngp allows them.
    Raises LimitExceeded for more than `most` values, BadJson, BadSchema."""
    data = read_input(path, MAX_JSON)
    if data.count(b",") > most:
        raise LimitExceeded(f"{path}: JSON of more than {most:,} values; at most so many are read")
    try:
        text = decoded(data)
        if not text.strip():
            raise BadJson(f"{path}: the file is empty; export it again")
        if "//" in text or "/*" in text:
            text = JSON_TOKEN.sub(_without_comment, text)
        document = json.loads(text)
    except RecursionError as error:
        raise BadJson(f"{path}: JSON is nested too deep to be read") from error
    except ValueError as error:
        raise BadJson(f"{path}: not JSON: {error}{_cure(error)}") from error
    if not isinstance(document, dict):
        problem = f"{path}: found a JSON {type(document).__name__}, expected an object with frames"
        raise foreign_json(path) or BadSchema(problem)
    return document


def _without_comment(token: re.Match) -> str:
    """A text as it is, or the lines that a comment takes, so that errors name the right one."""
    return token[0] if token[0].startswith('"') else " " + "\n" * token[0].count("\n")


def _cure(error: ValueError) -> str:
    """What to do about a slip that is easily made; empty for others."""
    if isinstance(error, UnicodeDecodeError):
        return "; save it as UTF-8"
    slips = ("Expecting property name", "Illegal trailing comma", "Expecting value")
    slip = isinstance(error, json.JSONDecodeError) and error.msg.startswith(slips)
    return "; remove a comma before it, or write what is missing" if slip else ""


def read_frames(path: Path, document: dict, key: str = "frames") -> list[dict]:
    """The frames as listed, empty for those that are no objects; BadSchema unless they are a list of some."""
    frames = document.get(key)
    if frames is None and key == "frames" and (foreign := foreign_json(path)):
        raise foreign
    if not isinstance(frames, list) or frames and not any(isinstance(frame, dict) for frame in frames):
        raise BadSchema(f'{path}: expected "{key}" to be a list of objects, one per camera, with their poses')
    return [frame if isinstance(frame, dict) else {} for frame in frames]


def frame_file(frame: dict) -> str:
    """The frame's `file_path` with forward slashes and without a leading "./"; empty where there is none."""
    return written_path(frame, "file_path")


def written_path(keys: dict, key: str) -> str:
    """A path that a file states, with forward slashes and without a leading "./"; empty without one."""
    written = keys.get(key)
    return str(PurePosixPath(written.replace("\\", "/"))) if isinstance(written, str) and written else ""


def frame_names(files: Sequence[str]) -> list[str]:
    """A distinct name per file: its stem, or the path joined by _ where two share a stem."""
    files = [PurePosixPath(file or f"{i:05d}") for i, file in enumerate(files)]
    stems = [split_ending(file.name)[0] for file in files]
    shared = Counter(stems)
    names = [
        stem
        if shared[stem] == 1
        else "_".join([*(p for p in file.parent.parts if p not in ("/", "..")), stem])
        for file, stem in zip(files, stems, strict=True)
    ]
    return distinct_names(names)


def frame_view(where: str, document: dict, frame: dict, name: str, size: tuple[int, int] | None) -> View:
    """The camera of one frame at the size that the file states, else at `size` (width, height)."""
    sources = (frame, document)
    fisheye, distortion = _lens(sources, where)
    width, height = _size(sources, size, where)
    x, y = _focal(sources, "x", width, where), _focal(sources, "y", height, where)
    if not (x or y):
        raise BadIntrinsics(
            f"{where}: no focal length; expected fl_x, x_fov or camera_angle_x here or in the file"
        )
    cx, cy = stated_number(sources, "cx", where, width / 2), stated_number(sources, "cy", where, height / 2)
    if min(width, height) > SMALL and 0 < cx <= 1 and 0 < cy <= 1:
        raise BadIntrinsics(
            f"{where}: cx and cy are {cx:g} and {cy:g}, shares of the picture; give cx, cy, fl_x and fl_y in "
            "pixels"
        )
    pose, repair = checked_pose(frame.get("transform_matrix"), where)
    return View(name, pose, x or y, y or x, cx, cy, width, height, distortion, fisheye, repair=repair)


def frame_where(path: Path, index: int, frame: dict) -> str:
    """How errors name a frame."""
    return f"{path}: frame {index} ({frame_file(frame) or 'no file_path'})"


def _frame_views(path: Path, document: dict, size: tuple[int, int] | None) -> tuple[View, ...]:
    frames = read_frames(path, document)
    listings, files = Listings(), [frame_file(frame) for frame in frames]
    paths = (path.parent / file for file in files if file)
    photos = (at.with_name(name) for at in paths for _, name in listings.find(at.parent, at.name))
    first_photo = next(photos, None)
    photo_size = read_image_header(first_photo)[:2] if first_photo else size
    named = enumerate(zip(frames, frame_names(files), strict=True))
    views = [frame_view(frame_where(path, i, f), document, f, name, photo_size) for i, (f, name) in named]
    return tuple(view.reframed(*size) if size else view for view in views)


def _size(sources: tuple[dict, dict], size: tuple[int, int] | None, where: str) -> tuple[int, int]:
    stated = [stated_number(sources, key, where, None) for key in ("w", "h")]
    width, height = (round(side) for side in stated) if None not in stated else size or (None, None)
    if width is None:
        raise BadIntrinsics(
            f"{where}: no w and h, and no photo to take them from; give the size of the pictures"
        )
    return checked_size(width, height, where)


def checked_size(width: int, height: int, where: str) -> tuple[int, int]:
    """Both sides within 1..MAX_SIDE; BadIntrinsics otherwise."""
    if not (0 < width <= MAX_SIDE and 0 < height <= MAX_SIDE):
        raise BadIntrinsics(f"{where}: a picture of {width}x{height} pixels, expected 1 to {MAX_SIDE} a side")
    return width, height


def _focal(sources: tuple[dict, dict], axis: str, side: int, where: str) -> float | None:
    """Pixels; None where neither source says."""
    for source in sources:
        if (degrees := stated_number((source,), f"{axis}_fov", where, None)) is not None:
            return fov_focal(math.radians(degrees), side, where)
        if (pixels := stated_number((source,), f"fl_{axis}", where, None)) is not None:
            return checked_focal(pixels, where)
        if (radians := stated_number((source,), f"camera_angle_{axis}", where, None)) is not None:
            return fov_focal(radians, side, where)
    return None


def fov_focal(radians: float, side: int, where: str) -> float:
    """Focal length in pixels of a field of view across `side` pixels; BadIntrinsics if outside (0, pi)."""
    if not 0 < radians < math.pi:
        raise BadIntrinsics(
            f"{where}: field of view of {math.degrees(radians):g} degrees, expected within 0 to 180 "
            "(camera_angle_x is in radians, x_fov in degrees)"
        )
    return checked_focal(0.5 * side / math.tan(0.5 * radians), where)


def checked_focal(pixels: float, where: str) -> float:
    """A focal length that cameras have; BadIntrinsics otherwise."""
    if not LEAST_PIXELS <= pixels <= MOST_PIXELS:
        what = f"{LEAST_PIXELS:g} to {MOST_PIXELS:g}" if pixels > 0 else "a positive one"
        raise BadIntrinsics(f"{where}: focal length of {pixels:g} pixels, expected {what}")
    return pixels


def stated_number(sources: tuple[dict, ...], key: str, where: str, default: float | None) -> float | None:
    """What the first source that knows it says, a finite number; else the default."""
    number = next((source[key] for source in sources if source.get(key) is not None), default)
    if number is None:
        return None
    if isinstance(number, str):
        raise BadIntrinsics(f"{where}: {key} is the text {number[:40]!r}, expected a number without quotes")
    if isinstance(number, bool) or not isinstance(number, int | float) or not abs(number) <= MOST_PIXELS:
        raise BadIntrinsics(
            f"{where}: {key} is {str(number)[:40]}, expected a finite number up to {MOST_PIXELS:g}"
        )
    return float(number)


def _lens(sources: tuple[dict, dict], where: str) -> tuple[bool, tuple[float, ...]]:
    """Whether it is a fisheye, and its distortion, as a View has them.

    k4 is the factor of r⁸, as nerfstudio and Metashape mean it, except beside k5 or k6 or in a FULL_OPENCV,
    where it divides.
    """
    model = str(next((source["camera_model"] for source in sources if "camera_model" in source), "")).upper()
    numbers = {key: stated_number(sources, key, where, 0.0) for key in (*BENDS, *RATIONAL_BENDS)}
    if model in FISHEYE or any(source.get("is_fisheye") for source in sources):
        if numbers["p1"] or numbers["p2"]:
            raise UnsupportedCamera(
                f"{where}: a fisheye with p1 or p2, expected k1 to k4; undistort the photos"
            )
        return True, tuple(numbers[key] for key in FISHEYE_BENDS)
    if model not in PERSPECTIVE | {RATIONAL}:
        raise UnsupportedCamera(
            f"{where}: a camera with {model[:40]}, expected a pinhole or a fisheye with OpenCV's distortion; "
            "undistort the photos first"
        )
    plain = tuple(numbers[key] for key in BENDS)
    if model == RATIONAL or numbers["k5"] or numbers["k6"]:
        return False, (*plain, 0.0, *(numbers[key] for key in RATIONAL_BENDS))
    return False, (*plain, numbers["k4"]) if numbers["k4"] else plain


# --- camera_path.json ---------------------------------------------------------------------------------------


def _path_views(path: Path, document: dict, size: tuple[int, int] | None) -> tuple[View, ...]:
    kind = str(document.get("camera_type", "perspective")).lower()
    if kind != "perspective":
        raise UnsupportedCamera(f"{path}: camera_type {kind[:40]!r}, expected perspective")
    if not size:
        sides = [
            stated_number((document,), f"render_{side}", str(path), None) for side in ("width", "height")
        ]
        if None in sides:
            raise BadIntrinsics(f"{path}: no render_width and render_height; give the size of the pictures")
        size = checked_size(*(round(side) for side in sides), str(path))
    frames = read_frames(path, document, "camera_path")
    return tuple(_path_view(f"{path}: frame {i}", frame, f"{i:05d}", size) for i, frame in enumerate(frames))


def _path_view(where: str, frame: dict, name: str, size: tuple[int, int]) -> View:
    """nerfstudio's `fov` is the vertical one, in degrees."""
    width, height = size
    degrees = stated_number((frame,), "fov", where, None)
    if degrees is None:
        raise BadIntrinsics(f"{where}: no fov; expected the vertical field of view in degrees")
    focal = fov_focal(math.radians(degrees), height, where)
    pose, repair = checked_pose(frame.get("camera_to_world"), where)
    return View(name, pose, focal, focal, width / 2, height / 2, width, height, repair=repair)
