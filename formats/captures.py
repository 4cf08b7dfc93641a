"""Captures on disk: posed photos as Blender, instant-ngp, nerfstudio, COLMAP, LLFF and Polycam lay them out.

What a folder is follows from what it holds, in this order: `transforms_train.json` (Blender),
`transforms.json` (instant-ngp, nerfstudio), a COLMAP model, `poses_bounds.npy` (LLFF), `keyframes` (Polycam).
World axes and units stay as the file has them: nothing is recentred, turned or scaled.
"""

import json
import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from formats import colmap, llff, polycam
from formats.atomic import atomic_writer
from formats.cameras import frame_names, read_cameras, read_document
from formats.errors import BadModel, FormatError, MissingFile, NoPoses, NoViews
from formats.frame import default_box, object_box, scene_frame, shown_box, subject_box
from formats.images import read_image_header, write_png
from formats.meshes import is_mesh, mesh_capture
from formats.photos import (
    LONGEST,
    find_photo,
    has_pictures,
    is_file,
    load_ignored,
    load_images,
    load_photos,
    natural,
    object_boxes,
    on_photo,
    photo_folder,
    pictures,
    plain_background,
    reduced,
)
from formats.points import Points
from formats.transforms import (
    BLENDER_FILE,
    Part,
    read_part,
    read_splits,
    sparse_points,
    stated_aabb,
    with_depths,
)
from formats.views import Capture, View, hold_out

__all__ = [
    "Capture",
    "View",
    "hold_out",
    "is_capture",
    "is_mesh",
    "load_ignored",
    "load_images",
    "load_photos",
    "read_cameras",
    "read_capture",
    "write_capture",
]

BLENDER_AABB = np.array([-1.5, -1.5, -1.5, 1.5, 1.5, 1.5])


def is_capture(path: Path | str) -> bool:
    """Does this look like posed photos? A folder without poses does too: reading it says what lacks."""
    path = Path(path)
    if path.is_dir():
        return (
            any(path.glob("transforms*.json"))
            or colmap.model_folder(path) is not None
            or is_file(path / llff.NAME)
            or polycam.keyframes(path) is not None
            or has_pictures(path)
        )
    try:
        return path.name == llff.NAME or (path.suffix.lower() == ".json" and "frames" in read_document(path))
    except FormatError:
        return False


def read_capture(path: Path | str) -> Capture:
    """The views of a folder, of one file with poses, or of a mesh, which is rendered (see `mesh_capture`).

    Photos are found and measured here, and decoded by `load_photos` and `load_images`. Frames are in natural
    order of their paths; those whose photo is missing are left out and listed. Raises BadImage,
    BadIntrinsics, BadJson, BadMask, BadMesh, BadModel, BadPose, BadSchema, LimitExceeded, MissingFile,
    NoPoses, NoViews, UnsupportedCamera.
    """
    path = Path(path)
    if not path.exists():
        raise MissingFile(
            f"{path}: no such file or folder; give a capture's folder, its transforms.json, or a mesh"
        )
    if is_mesh(path):
        return mesh_capture(path)
    if path.is_dir():
        return _read_folder(path)
    if path.name == llff.NAME:
        return _read_llff(path)
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
    if (model := colmap.model_folder(path)) is not None:
        return _read_colmap(path, model)
    if is_file(path / llff.NAME):
        return _read_llff(path / llff.NAME)
    if (folders := polycam.keyframes(path)) is not None:
        return _read_polycam(path, *folders)
    found = "pictures but" if has_pictures(path) else "neither pictures nor"
    raise NoPoses(
        f"{path}: found {found} no camera poses (transforms.json, transforms_train.json, COLMAP's sparse/0, "
        "LLFF's poses_bounds.npy or Polycam's keyframes); estimate them first, for example with COLMAP"
    )


# --- one reader per layout ----------------------------------------------------------------------------------


def _read_blender(path: Path, train: Path | None = None, test: Path | None = None) -> Capture:
    parts = [read_part(file) if file else Part() for file in (train, test)]
    return _capture(path, "blender", *parts, stated=BLENDER_AABB)


def _read_transforms(path: Path) -> Capture:
    document, train, test = read_splits(path)
    points, notes = sparse_points(path, document, train.views + test.views)
    train, test = (replace(part, views=with_depths(part.views, points)) for part in (train, test))
    return _capture(path, "transforms", train, test, stated_aabb(path, document), points, notes)


def _read_colmap(path: Path, folder: Path) -> Capture:
    model = colmap.read_model(folder)
    base = colmap.capture_folder(folder) if path == folder else path
    images = sorted(model.images, key=lambda image: natural(image.name))
    photos, notes = _model_photos(folder, base, [image.name for image in images])
    names = frame_names([{"file_path": image.name} for image in images])
    views, alpha = [], False
    for image, name, photo in zip(images, names, photos, strict=True):
        if photo is None:
            continue
        header = read_image_header(photo)
        view = replace(image.view, name=name)
        views.append(on_photo(view, photo, header, image.where, _model_mask(base, image.name)))
        alpha |= header.alpha
    missing = [image.name for image, photo in zip(images, photos, strict=True) if photo is None]
    part = Part(tuple(views), alpha, tuple(missing), tuple(notes))
    return _capture(path, "colmap", part, Part(), None, model.points)


def _model_photos(folder: Path, base: Path, names: list[str]) -> tuple[list[Path | None], list[str]]:
    """The photo of each name of a model, None where it is missing, and a note on where they are from."""
    for root in (base / "images", base / "input", base):
        chosen = photo_folder(root, names)
        if chosen is not None:
            note = f"{folder}: photos are read from {chosen.name}"
            return [find_photo(chosen, name) for name in names], [note] if chosen != root else []
    # The smaller copies of LLFF's scenes have other names, in the same order as the full-size photos.
    for place in (base / "images", *reduced(base / "images")):
        files = pictures(place)
        if len(files) == len(names):
            ranked = dict(zip(sorted(names), files, strict=True))
            note = f"{folder}: photos of {place.name} have other names and are matched by order"
            return [ranked[name] for name in names], [note]
    raise MissingFile(
        f"{folder}: names {len(names)} photos such as {names[0]}, but {base / 'images'} has none of them; "
        "put the photos there"
    )


def _model_mask(base: Path, name: str) -> Path | None:
    """COLMAP's mask of a photo, `masks/a.jpg.png`, or one by the photo's own name."""
    masks = base / "masks"
    exact = masks / f"{name}.png"
    return exact if is_file(exact) else find_photo(masks, name)


def _read_llff(path: Path) -> Capture:
    rows = llff.read_poses_bounds(path)
    images = path.parent / "images"
    counts = {place: pictures(place) for place in (images, *reduced(images))}
    suited = [files for files in counts.values() if len(files) == len(rows) > 0]
    if not suited:
        found = ", ".join(f"{len(files)} in {place.name}" for place, files in counts.items())
        raise BadModel(
            f"{path}: has {len(rows)} poses, one per photo by the order of names, but there are {found}; "
            "restore all photos, or estimate the poses again"
        )
    headers = [read_image_header(files[0]) for files in suited]
    small = [max(header.width, header.height) <= LONGEST for header in headers]
    photos = suited[small.index(True) if any(small) else -1]
    views, alpha = [], False
    for (where, view), photo in zip(rows, photos, strict=True):
        header = read_image_header(photo)
        views.append(on_photo(replace(view, name=photo.stem), photo, header, f"{where} ({photo.name})"))
        alpha |= header.alpha
    folder = photos[0].parent
    notes = () if folder == images else (f"{path}: photos are read from {folder.name}",)
    return _capture(path, "llff", Part(tuple(views), alpha, (), notes), Part(), None)


def _read_polycam(path: Path, images: Path, cameras: Path) -> Capture:
    views, alpha, missing = [], False, []
    for file in sorted(cameras.glob("*.json"), key=lambda file: natural(file.name)):
        view, photo = polycam.read_camera(file), find_photo(images, file.stem)
        if photo is None:
            missing.append(file.stem)
            continue
        header = read_image_header(photo)
        views.append(on_photo(view, photo, header, str(file)))
        alpha |= header.alpha
    return _capture(path, "polycam", Part(tuple(views), alpha, tuple(missing)), Part(), None)


# --- what they share ----------------------------------------------------------------------------------------


def _capture(
    path: Path,
    kind: str,
    train: Part,
    test: Part,
    stated: np.ndarray | None,
    points: Points | None = None,
    notes: tuple[str, ...] = (),
) -> Capture:
    views, missing = train.views + test.views, train.missing + test.missing
    if not views:
        raise NoViews(
            f"{path}: no view is left, {len(missing)} of {len(missing)} listed frames have no photo on disk; "
            "put the photos where the file_path entries say"
        )
    opaque = not (train.alpha or test.alpha)
    poses = np.array([view.camera_to_world for view in views])
    frame, box = None, subject_box(poses) if stated is None else stated.copy()
    if opaque and not plain_background(views):
        frame, box = _surroundings(views, poses, points)
    cut_out = None
    if (kept := object_boxes(views)) is not None:
        corners = [view.corners(1.0, bounds) for view, bounds in zip(views, kept, strict=True)]
        cut_out = object_box(poses[:, :3, 3], np.array(corners))
    notes = tuple(dict.fromkeys((*train.notes, *test.notes, *notes, *_doubts(path, poses))))
    return Capture(path, kind, train.views, test.views, box, opaque, cut_out, missing, points, frame, notes)


def _doubts(path: Path, poses: np.ndarray) -> Iterator[str]:
    """Sentences about poses from which no depth follows."""
    if len(poses) < 3:
        yield f"{path}: has {len(poses)} photos; depth needs at least three from different places"
    elif np.ptp(poses[:, :3, 3], axis=0).max() == 0:
        yield f"{path}: all cameras are at one point, from which no depth follows; move between photos"


def _surroundings(views: tuple[View, ...], poses: np.ndarray, points: Points | None) -> tuple:
    """The frame of photos that show a subject and all around it, and a box large enough for that."""
    depths = [math.sqrt(view.near * view.far) for view in views if view.near and view.far]
    frame = scene_frame(poses, float(np.median(depths)) if depths else None)
    if frame.layout != "forward-facing":
        return frame, default_box(frame, poses, None if points is None else points.positions)
    seen = [(view, view.near or 0.5 * frame.distance, view.far or 4 * frame.distance) for view in views]
    return frame, shown_box(np.concatenate([view.corners(d) for view, *ends in seen for d in ends]))


# --- writing ------------------------------------------------------------------------------------------------


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
    more = any(view.fisheye or any(view.distortion[5:]) for view in views)
    shared = _intrinsics(views[0], more)
    frames = [
        {
            "file_path": f"./{split}/{view.name}",
            **{key: value for key, value in _intrinsics(view, more).items() if value != shared[key]},
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


def _intrinsics(view: View, more: bool) -> dict:
    """The keys of a camera; with those of fisheyes and higher distortion where `more` are asked for."""
    keys = ("fl_x", "fl_y", "cx", "cy")
    inner = {key: getattr(view, key) for key in keys} | {"w": view.width, "h": view.height}
    if view.fisheye:
        model, bends = "OPENCV_FISHEYE", dict(zip(("k1", "k2", "k3", "k4"), view.distortion, strict=True))
    else:
        *low, k4, d1, d2, d3 = (*view.distortion, *(0.0,) * (9 - len(view.distortion)))
        bends = dict(zip(("k1", "k2", "k3", "p1", "p2"), low, strict=True))
        model = "FULL_OPENCV" if d1 or d2 or d3 else "OPENCV"
        bends |= {"k4": d1, "k5": d2, "k6": d3} if model == "FULL_OPENCV" else {"k4": k4}
    bends = dict.fromkeys(("k1", "k2", "k3", "p1", "p2"), 0.0) | bends
    if not more:
        return inner | {key: value for key, value in bends.items() if key != "k4"}
    return {**inner, "camera_model": model, **dict.fromkeys(("k4", "k5", "k6"), 0.0), **bends}
