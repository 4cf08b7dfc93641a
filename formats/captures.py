"""Captures on disk: posed photos as Blender, instant-ngp and nerfstudio lay them out.

A folder with `transforms_train.json` (and `_test`) is Blender-style; one with `transforms.json` is
instant-ngp's or nerfstudio's. World axes and units stay as the file has them: nothing is recentred, turned or
scaled.
"""

import json
import math
import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from formats.atomic import atomic_writer
from formats.cameras import (
    EXTENSIONS,
    frame_file,
    frame_names,
    frame_photo,
    frame_view,
    frame_where,
    read_cameras,
    read_document,
    read_frames,
)
from formats.errors import (
    BadIntrinsics,
    BadSchema,
    FormatError,
    MissingFile,
    MixedSizes,
    NoPoses,
    NoViews,
    ResourceError,
)
from formats.images import read_image, read_image_header, write_png
from formats.meshes import is_mesh, mesh_capture
from formats.views import Capture, View, cameras_aabb, hold_out

__all__ = [
    "Capture",
    "View",
    "hold_out",
    "is_capture",
    "is_mesh",
    "load_images",
    "read_cameras",
    "read_capture",
    "write_capture",
]

BLENDER_AABB = np.array([-1.5, -1.5, -1.5, 1.5, 1.5, 1.5])
BLENDER_FILE = re.compile(r"transforms_(train|val|test)\.json")
NGP_SCALE, NGP_OFFSET = 0.33, 0.5
MAX_ASPECT_ERROR = 0.02
"""How far a photo's width / height may be from the file's: a small copy rounds, a turned one is wrong."""
COUNT_DIGITS = re.compile(r"(\d+)")


def is_capture(path: Path | str) -> bool:
    """Does this look like posed photos? A folder without poses does too: reading it says what lacks."""
    path = Path(path)
    if path.is_dir():
        return any(path.glob("transforms*.json")) or _has_pictures(path)
    try:
        return path.suffix.lower() == ".json" and "frames" in read_document(path)
    except FormatError:
        return False


def read_capture(path: Path | str) -> Capture:
    """The views of a folder, of one `transforms*.json`, or of a mesh, which is rendered (see `mesh_capture`).

    Photos are found and measured here, and decoded by `load_images`. Frames are in natural order of their
    paths; those whose photo is missing are left out and counted. Raises BadImage, BadIntrinsics, BadJson,
    BadMesh, BadPose, BadSchema, MissingFile, NoPoses, NoViews, UnsupportedCamera.
    """
    path = Path(path)
    if not path.exists():
        raise MissingFile(
            f"{path}: no such file or folder; name a capture's folder, its transforms.json, or a mesh"
        )
    if is_mesh(path):
        return mesh_capture(path)
    if path.is_dir():
        return _read_folder(path)
    if match := BLENDER_FILE.fullmatch(path.name):
        return _read_blender(path, **{"test" if match[1] == "test" else "train": path})
    return _read_transforms(path)


def _read_folder(path: Path) -> Capture:
    train, val, test, single = (path / f"transforms{split}.json" for split in ("_train", "_val", "_test", ""))
    if train.exists() or val.exists():
        return _read_blender(path, train if train.exists() else val, test if test.exists() else None)
    if single.exists():
        return _read_transforms(single)
    if test.exists():
        return _read_blender(path, test=test)
    found = "pictures but" if _has_pictures(path) else "neither pictures nor"
    raise NoPoses(
        f"{path}: found {found} no transforms.json or transforms_train.json with the camera poses; estimate "
        "them first, for example with COLMAP and nerfstudio's ns-process-data or instant-ngp's colmap2nerf.py"
    )


def _has_pictures(folder: Path) -> bool:
    places = (place for place in (folder, folder / "images") if place.is_dir())
    return any(file.suffix in EXTENSIONS for place in places for file in place.iterdir())


def _read_blender(path: Path, train: Path | None = None, test: Path | None = None) -> Capture:
    parts = [_read_part(file) if file else _Part() for file in (train, test)]
    return _capture(path, "blender", *parts, aabb=BLENDER_AABB)


def _read_transforms(path: Path) -> Capture:
    document = read_document(path)
    frames = list(enumerate(read_frames(path, document)))
    parts = [_photo_views(path, document, part) for part in _split(path, document, frames)]
    return _capture(path, "transforms", *parts, aabb=_stated_aabb(path, document))


@dataclass(frozen=True)
class _Part:
    """The views of one split, whether any has alpha, and how many frames have no photo."""

    views: tuple[View, ...] = ()
    alpha: bool = False
    missing: int = 0


def _capture(path: Path, kind: str, train: _Part, test: _Part, aabb: np.ndarray | None) -> Capture:
    views = train.views + test.views
    missing = train.missing + test.missing
    if not views:
        raise NoViews(
            f"{path}: no view is left, {missing} of {missing} listed frames have no photo on disk; "
            "put the photos where the file_path entries say"
        )
    box = cameras_aabb(views) if aabb is None else aabb.copy()
    return Capture(path, kind, train.views, test.views, box, not (train.alpha or test.alpha), missing)


def _read_part(path: Path) -> _Part:
    document = read_document(path)
    return _photo_views(path, document, list(enumerate(read_frames(path, document))))


def _photo_views(path: Path, document: dict, frames: list[tuple[int, dict]]) -> _Part:
    """Views of the (index, frame) pairs whose photo exists, intrinsics stretched to the photo's own size."""
    frames = sorted(frames, key=lambda item: _natural(frame_file(item[1])))
    found = [(i, frame, photo) for i, frame in frames if (photo := frame_photo(path, frame))]
    names = frame_names([frame for _, frame, _ in found])
    views, alpha = [], False
    for (i, frame, photo), name in zip(found, names, strict=True):
        where = frame_where(path, i, frame)
        *size, has_alpha = read_image_header(photo)
        views.append(_on_photo(frame_view(where, document, frame, name, tuple(size)), photo, size, where))
        alpha |= has_alpha
    return _Part(tuple(views), alpha, len(frames) - len(found))


def _on_photo(view: View, photo: Path, size: Sequence[int], where: str) -> View:
    width, height = size
    if abs(width * view.height / (height * view.width) - 1) > MAX_ASPECT_ERROR:
        raise BadIntrinsics(
            f"{where}: w and h say {view.width}x{view.height}, but {photo.name} is {width}x{height}, another "
            "shape; use the photos that the poses were estimated from"
        )
    return replace(view.stretched(width, height), image_path=photo)


def _natural(text: str) -> list:
    """Sort key that takes runs of digits as numbers: r_2 before r_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in COUNT_DIGITS.split(text)]


def _split(path: Path, document: dict, frames: list) -> tuple[list, list]:
    """Train and test frames by nerfstudio's optional lists of names; without them all are to train on."""
    train = _listed(path, document, "train_filenames")
    test = _listed(path, document, "test_filenames") or _listed(path, document, "val_filenames") or set()
    is_train = train.__contains__ if train is not None else lambda file: file not in test
    named = [(frame_file(item[1]), item) for item in frames]
    return [item for file, item in named if is_train(file)], [item for file, item in named if file in test]


def _listed(path: Path, document: dict, key: str) -> set[str] | None:
    names = document.get(key)
    if names is None:
        return None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BadSchema(f'{path}: expected "{key}" to be a list of file paths')
    return {frame_file({"file_path": name}) for name in names}


def _stated_aabb(path: Path, document: dict) -> np.ndarray | None:
    """instant-ngp's box: the cube of side aabb_scale around 0.5, where world x is at scale x + offset."""
    if document.get("aabb_scale") is None:
        return None
    scales = [document["aabb_scale"], document.get("scale", NGP_SCALE)]
    try:
        side, scale = np.array(scales, dtype=np.float64)
        offset = np.broadcast_to(np.array(document.get("offset", NGP_OFFSET), dtype=np.float64), 3)
    except (TypeError, ValueError, OverflowError):
        side, scale, offset = -1.0, 1.0, np.zeros(3)
    if not (np.isfinite([side, scale, *offset]).all() and side > 0 and scale > 0):
        raise BadSchema(
            f"{path}: expected aabb_scale and scale to be positive numbers, and offset one or three"
        )
    centre, half = (0.5 - offset) / scale, 0.5 * side / scale
    return np.concatenate([centre - half, centre + half])


def load_images(views: Sequence[View]) -> np.ndarray:
    """(n, H, W, 4) uint8, straight alpha (255 for opaque photos), in the order of `views`.

    Raises MixedSizes before anything is decoded, NoViews, BadImage, LimitExceeded, ResourceError (memory).
    """
    if not views:
        raise NoViews("no views are given to load, expected at least one")
    first = views[0]
    for view in views:
        if (view.width, view.height) != (first.width, first.height):
            raise MixedSizes(
                f"{_photo(first)} is {first.width}x{first.height} but {_photo(view)} is {view.width}x"
                f"{view.height}; bring all photos of a capture to one size"
            )
    try:
        images = np.empty((len(views), first.height, first.width, 4), np.uint8)
    except MemoryError as error:
        size = len(views) * first.height * first.width * 4
        raise ResourceError(
            f"{_photo(first)} and the others need {size:,} bytes of memory; use smaller photos"
        ) from error
    with ThreadPoolExecutor() as threads:
        for _ in threads.map(_load_into, images, views):
            pass
    return images


def _photo(view: View) -> Path | str:
    return view.image_path or view.name


def _load_into(target: np.ndarray, view: View) -> None:
    if view.pixels is None and view.image_path is None:
        raise MissingFile(f"view {view.name}: has a camera but no photo")
    pixels = read_image(view.image_path) if view.pixels is None else view.pixels
    if pixels.shape != target.shape:
        height, width = pixels.shape[:2]
        raise MixedSizes(
            f"{_photo(view)} is {width}x{height} now, expected {view.width}x{view.height}; read it again"
        )
    target[:] = pixels


def write_capture(
    folder: Path | str, views: Sequence[View], pixels: np.ndarray, split: str = "train"
) -> None:
    """Blender-style `transforms_<split>.json` in `folder`, with `<split>/<name>.png` per view.

    `pixels` (n, H, W, 3 or 4) uint8, straight alpha. Intrinsics are written in full, so any camera comes
    back.
    """
    folder = Path(folder)
    (folder / split).mkdir(parents=True, exist_ok=True)
    for view, picture in zip(views, pixels, strict=True):
        write_png(folder / split / f"{view.name}.png", picture)
    shared = _intrinsics(views[0])
    frames = [
        {
            "file_path": f"./{split}/{view.name}",
            **{key: value for key, value in _intrinsics(view).items() if value != shared[key]},
            "transform_matrix": view.camera_to_world.tolist(),
        }
        for view in views
    ]
    document = {
        "camera_angle_x": 2 * math.atan(0.5 * views[0].width / views[0].fl_x),
        **shared,
        "frames": frames,
    }
    with atomic_writer(folder / f"transforms_{split}.json") as file:
        file.write(json.dumps(document, indent=1, allow_nan=False).encode() + b"\n")


def _intrinsics(view: View) -> dict:
    bends = dict(zip(("k1", "k2", "k3", "p1", "p2"), view.distortion, strict=True))
    keys = ("fl_x", "fl_y", "cx", "cy")
    return {**{key: getattr(view, key) for key in keys}, "w": view.width, "h": view.height, **bends}
