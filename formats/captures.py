"""Captures on disk: posed photos as Blender, instant-ngp, nerfstudio, COLMAP and others lay them out.

What a folder is follows from what it holds, in this order: `transforms_train.json` (Blender),
`transforms.json` (instant-ngp, nerfstudio), a COLMAP model, `poses_bounds.npy` (LLFF), `keyframes` (Polycam),
a pose file for each photo (NSVF, ScanNet, 7-Scenes), `reconstruction.json` (OpenSfM).
World axes and units stay as the file has them: nothing is recentred, turned or scaled.
"""

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from formats import colmap, llff, opensfm, polycam
from formats.atomic import atomic_writer
from formats.cameras import BENDS, FISHEYE_BENDS, read_document
from formats.capture_of import capture_of
from formats.errors import BadModel, FormatError, MissingFile, NoPoses, NotACapture, NoViews, printable
from formats.frame_list import SplitPart, read_listed, read_sound, repair_notes
from formats.images import read_image_header, write_png
from formats.matching import PHOTO_FOLDERS, gone
from formats.meshes import is_mesh, mesh_capture
from formats.other_files import is_json, not_a_capture, other_cameras
from formats.photos import (
    Folder,
    chosen_copy,
    copies,
    folders,
    has_pictures,
    is_file,
    is_hidden,
    is_picture,
    natural,
    on_photo,
    pictures,
    visible_files,
)
from formats.pose_files import PoseFiles, pose_files, read_box, read_lens, read_view, splits
from formats.transforms import (
    BLENDER_FILE,
    read_splits,
    sparse_points,
    stated_aabb,
)
from formats.views import Capture, View

LEVELS, MAX_FOLDERS = 3, 500
"""How deep captures are looked for below a folder without poses, and in how many folders of one depth."""

CAMERAS = "cams"
"""A folder of cameras that are not read, as MVSNet has one."""


def is_capture(path: Path | str) -> bool:
    """Does this look like posed photos? A folder without poses does too: reading it says what lacks."""
    path = Path(path)
    if path.is_dir():
        return _has_poses(path) or has_pictures(path) or bool(_captures_below(path))
    try:
        if path.name == llff.NAME or path.name == opensfm.NAME and opensfm.is_reconstruction(path):
            return True
        return (path.suffix.lower() == ".json" or is_json(path)) and "frames" in read_document(path)
    except FormatError:
        return False


def _has_poses(path: Path) -> bool:
    """Whether cameras lie in a folder as one of the layouts has them."""
    return any(path.glob("transforms*.json")) or _layout(path) is not None


def _captures_below(path: Path) -> list[Path]:
    """Folders with poses in a folder without any, up to LEVELS deep and none inside another, by path."""
    captures, level = [], [path]
    for _ in range(LEVELS):
        inner = [folder for above in level for folder in folders(above)][:MAX_FOLDERS]
        level = []
        for folder in inner:
            (captures if _has_poses(folder) else level).append(folder)
    return sorted(captures, key=lambda folder: natural(str(folder)))


def poses_elsewhere(path: Path) -> str | None:
    """A sentence about poses that are not used of a folder of photos: in the folder above, in a JSON file of
    another name, or another program's in either; None without any."""
    above = path.resolve().parent
    if _has_poses(above):
        return f"{path}: {above}, the folder above it, has poses, which are not used; give that folder"
    places = [path, above] if path.name.lower() in PHOTO_FOLDERS else [path]
    places += [at / CAMERAS for at in places]
    for file in (file for at in places for file in sorted(at.glob("*"))):
        if not is_file(file) or is_hidden(file.name) or is_picture(file.name):
            continue
        if is_capture(file):
            return f"{path}: {file.name} has poses, which are not used; give that file"
        if (other := other_cameras(file)) is not None:
            return f"{path}: {file.name}, {other.what}, is not used; {other.cure}"
    return None


def read_capture(path: Path | str, downscale: int | None = None) -> Capture:
    """The views of a folder, of one file with poses, or of a mesh, which is rendered (see `mesh_capture`).

    Photos are found and measured here, and decoded by `load_photos` and `load_images`. Frames are in natural
    order of their paths; those whose photo is missing are left out and listed. A side of the photos is made
    `downscale` times smaller (None: until it is at most LONGEST), or a copy of that size is read.

    Raises BadImage, BadIntrinsics, BadJson, BadMask, BadMesh, BadModel, BadPose, BadSchema, LimitExceeded,
    MissingExtra, MissingFile, NoPoses, NoViews, NotACapture, UnsupportedCamera.
    """
    path = Path(path)
    if not path.exists():
        raise MissingFile(
            f"{path}: no such file or folder; give a capture's folder, its transforms.json, or a mesh"
        )
    if is_mesh(path):
        return mesh_capture(path)
    if path.is_dir():
        return _read_folder(path, downscale)
    if path.name == llff.NAME:
        return _read_llff(path, downscale)
    if path.suffix.lower() != ".json" and not is_json(path):
        raise not_a_capture(path)
    if path.name == opensfm.NAME and opensfm.is_reconstruction(path):
        return _read_opensfm(path, path, downscale)
    if match := BLENDER_FILE.fullmatch(path.name):
        return _read_blender(path, downscale, **{"test" if match[1] == "test" else "train": path})
    return _read_transforms(path, downscale)


def _layout(path: Path) -> Callable[[int | None], Capture] | None:
    """What reads the poses in a folder, at a scale, by its layout; None where none lie there."""
    train, val, test, single = (path / f"transforms{split}.json" for split in ("_train", "_val", "_test", ""))
    if train.exists() or val.exists():
        known = train if train.exists() else val
        return partial(_read_blender, path, train=known, test=test if test.exists() else None)
    if single.exists():
        return partial(_read_transforms, single)
    if test.exists():
        return partial(_read_blender, path, test=test)
    if (model := colmap.model_folder(path)) is not None:
        return partial(_read_colmap, path, model)
    if is_file(path / llff.NAME):
        return partial(_read_llff, path / llff.NAME)
    if (places := polycam.keyframes(path)) is not None:
        return partial(_read_polycam, path, *places)
    if (files := pose_files(path)) is not None:
        return partial(_read_pose_files, path, files)
    if (file := opensfm.reconstruction(path)) is not None:
        return partial(_read_opensfm, path, file)
    return None


def _read_folder(path: Path, downscale: int | None) -> Capture:
    if (read := _layout(path)) is not None:
        return read(downscale)
    if len(below := list(path.glob("*/transforms.json"))) == 1:
        return _read_transforms(below[0], downscale, path)
    below = _captures_below(path)
    if len(below) == 1:
        capture = _read_below(path, below[0], downscale)
        note = f"{path}: has no poses itself, so {below[0].relative_to(path)} is read, which has some"
        return replace(capture, notes=(printable(note), *capture.notes))
    if not has_pictures(path):
        if below:
            named = " and ".join(str(folder.relative_to(path)) for folder in below[:2])
            raise NotACapture(f"{path}: holds {len(below)} captures, such as {named}; give one of them")
        raise not_a_capture(path)
    raise NoPoses(
        f"{path}: found pictures but no camera poses (transforms.json, transforms_train.json, COLMAP's "
        "sparse/0, LLFF's poses_bounds.npy and others); estimate them first with `fusedrf pose`"
    )


def _read_below(path: Path, below: Path, downscale: int | None) -> Capture:
    """The capture in a folder below `path`; a model without photos there is of those in `path`."""
    model = None if has_pictures(below) else colmap.model_folder(below)
    return _read_folder(below, downscale) if model is None else _read_colmap(path, model, downscale)


# --- one reader per layout ----------------------------------------------------------------------------------


def _read_blender(
    path: Path, downscale: int | None, train: Path | None = None, test: Path | None = None
) -> Capture:
    first, notes = train or test, ()
    document, part, _ = read_splits(first, first.parent, downscale)
    parts = [part, SplitPart()] if train else [SplitPart(), part]
    if train and test:
        try:
            parts[1] = read_splits(test, test.parent, downscale)[1]
        except NoViews as error:
            notes = (f"{error}; none are held out by it",)
    return capture_of(path, "blender", *parts, stated_aabb(first, document), notes=notes)


def _read_transforms(path: Path, downscale: int | None, base: Path | None = None) -> Capture:
    document, train, test = read_splits(path, base or path.parent, downscale)
    sparse = sparse_points(path, document, train.views + test.views)
    train, test = (replace(part, views=sparse.told(path, part.views)) for part in (train, test))
    return capture_of(
        path, "transforms", train, test, stated_aabb(path, document), sparse.points, sparse.notes
    )


def _read_colmap(path: Path, folder: Path, downscale: int | None) -> Capture:
    model = colmap.read_model(folder)
    base = colmap.capture_folder(path) if path == folder or path.name in colmap.MODELS_IN else path
    others = _other_models(path, folder)
    try:
        notes = (*others, *model.notes)
        return _read_model(path, "colmap", model, base, (*colmap.PHOTOS_IN, ""), downscale, notes)
    except NoViews as error:
        # The smaller copies of LLFF's scenes have other names than COLMAP's model of them.
        if not is_file(path / llff.NAME):
            raise NoViews("; ".join([str(error), *others])) from error
        capture = _read_llff(path / llff.NAME, downscale)
        return replace(capture, notes=(f"{error}; {llff.NAME} is read instead", *capture.notes))


def _read_model(
    path: Path,
    kind: str,
    model: colmap.Model,
    base: Path,
    homes: Sequence[str],
    downscale: int | None,
    notes: Sequence[str],
) -> Capture:
    """A model whose photos lie in one of `homes` in the folder `base`."""
    images = [(image.name.replace("\\", "/"), image) for image in model.images]
    parts = read_listed(
        model.folder, base, [images], lambda image, *_: (image.where, image.view, None), downscale, homes
    )
    return capture_of(path, kind, *parts, SplitPart(), None, model.points, tuple(notes))


def _other_models(path: Path, folder: Path) -> list[str]:
    """A sentence about the models beside the one that is read."""
    others = [other for other in colmap.model_folders(path) if other != folder]
    if not others:
        return []
    named = ", ".join(f"{other.relative_to(path)} of {colmap.image_count(other)}" for other in others[:5])
    return [
        f"{path}: {folder.relative_to(path)}, a model of {colmap.image_count(folder)} photos, is read, "
        f"and not {named}; give the folder {others[0]} to read that one"
    ]


def _read_llff(path: Path, downscale: int | None) -> Capture:
    rows = llff.read_poses_bounds(path)
    images = path.parent / "images"
    folder = _counted(images, len(rows), downscale)
    if folder is None:
        counts = [(folder.path.name, len(pictures(folder.path))) for folder in copies(images)]
        counted = ", ".join(f"{count} in {name}" for name, count in counts)
        raise BadModel(
            f"{path}: has {len(rows)} poses, one per photo by the order of names, but there are {counted}; "
            "restore all photos, or estimate the poses again"
        )
    photos = pictures(folder.path)
    sound = [(i, photo) for i, photo in enumerate(photos) if photo.stat().st_size]

    def read(item: tuple[int, Path]) -> View:
        i, photo = item
        where, header = f"{path}: row {i} ({photo.name})", read_image_header(photo)
        view = replace(llff.row_view(where, rows[i]), name=photo.stem)
        return on_photo(view, photo, header, where, reduction=folder.reduction(header, downscale))

    views, broken = read_sound(path, sound, read, lambda item: item[1].name)
    order = (
        f"{path}: has no names, so its {len(rows)} rows go with the photos of {folder.path.name} by the "
        f"order of their names, {photos[0].name} to {photos[-1].name}"
    )
    empty = tuple(photo.name for photo in photos if not photo.stat().st_size)
    notes = (order, *(f"{path}: {note}" for note in gone(empty)), *broken, *repair_notes(path, views))
    part = SplitPart(tuple(views), empty, notes)
    return capture_of(path, "llff", part, SplitPart(), None)


def _counted(images: Path, count: int, downscale: int | None) -> Folder | None:
    """The folder out of `copies` to read photos from whose names say nothing: it has so many."""
    listed = [(folder, pictures(folder.path)) for folder in copies(images)]
    return chosen_copy([(folder, files[0]) for folder, files in listed if len(files) == count > 0], downscale)


def _read_polycam(path: Path, images: Path, cameras: Path, downscale: int | None) -> Capture:
    listed = [(file.stem, file) for file in visible_files(cameras, ".json")]
    parts = read_listed(
        cameras,
        images,
        [listed],
        lambda file, header, _: (str(file), polycam.read_camera(file, header[:2]), None),
        downscale,
    )
    photos, poses = polycam.FOLDERS[0]
    lost = images.name != photos and (images.parent / poses).is_dir()
    uncorrected = [f"{images.parent}: {poses} is not used, since there is no {photos}"] if lost else []
    return capture_of(path, "polycam", *parts, SplitPart(), None, notes=tuple(uncorrected))


def _read_pose_files(path: Path, files: PoseFiles, downscale: int | None) -> Capture:
    lens, notes = read_lens(files)
    *names, unused = splits(list(files.poses))
    parts = read_listed(
        files.folder,
        files.photos,
        [[(name, files.poses[name]) for name in split] for split in names],
        lambda file, header, _: (str(file), read_view(file, lens, header[:2]), None),
        downscale,
    )
    notes += [f"{path}: {unused}"] if unused else []
    return capture_of(path, "pose files", *parts, read_box(files), notes=tuple(notes))


def _read_opensfm(path: Path, file: Path, downscale: int | None) -> Capture:
    model = opensfm.read_model(file)
    base = file.parent if has_pictures(file.parent) or path == file.parent else file.parent.parent
    return _read_model(path, "opensfm", model, base, ("images", ""), downscale, model.notes)


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
    files = [f"./{split}/{view.name}" for view in views]
    views = [replace(view, seen=None) for view in views]  # of points that are not written
    write_cameras(folder / f"transforms_{split}.json", views, files)


def write_cameras(path: Path, views: Sequence[View], files: Sequence[str], **more) -> None:
    """A transforms.json with the cameras of views and the path of each one's photo; `more` are further keys
    of the file. Raises ResourceError."""
    higher = any(view.fisheye or any(view.distortion[5:]) for view in views)
    shared = _intrinsics(views[0], higher)
    frames = [
        {
            "file_path": file,
            **{key: value for key, value in _intrinsics(view, higher).items() if value != shared[key]},
            "transform_matrix": view.camera_to_world.tolist(),
            **({} if view.seen is None else {"sparse_points": view.seen.tolist()}),
        }
        for view, file in zip(views, files, strict=True)
    ]
    angle = 2 * math.atan(0.5 * views[0].width / views[0].fl_x)
    document = {"camera_angle_x": angle, **shared, **more, "frames": frames}
    with atomic_writer(path) as file:
        file.write(json.dumps(document, indent=1, allow_nan=False).encode() + b"\n")


def _intrinsics(view: View, more: bool) -> dict:
    """The keys of a camera; with those of fisheyes and higher distortion where `more` are asked for."""
    keys = ("fl_x", "fl_y", "cx", "cy")
    inner = {key: getattr(view, key) for key in keys} | {"w": view.width, "h": view.height}
    if view.fisheye:
        model, bends = "OPENCV_FISHEYE", dict(zip(FISHEYE_BENDS, view.distortion, strict=True))
    else:
        *low, k4, d1, d2, d3 = (*view.distortion, *(0.0,) * (9 - len(view.distortion)))
        bends = dict(zip(BENDS, low, strict=True))
        model = "FULL_OPENCV" if d1 or d2 or d3 else "OPENCV"
        bends |= {"k4": d1, "k5": d2, "k6": d3} if model == "FULL_OPENCV" else {"k4": k4}
    bends = dict.fromkeys(BENDS, 0.0) | bends
    if not more:
        return inner | {key: value for key, value in bends.items() if key != "k4"}
    return {**inner, "camera_model": model, **dict.fromkeys(("k4", "k5", "k6"), 0.0), **bends}
