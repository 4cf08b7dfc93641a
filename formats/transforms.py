"""Captures whose cameras stand in `transforms*.json`: Blender's, instant-ngp's and nerfstudio's."""

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from formats import colmap
from formats.cameras import (
    frame_file,
    frame_view,
    frame_where,
    read_document,
    read_frames,
    written_path,
)
from formats.capture_frame import depth_range
from formats.errors import BadSchema, MissingFile, NoViews, counted, noted
from formats.frame_list import SplitPart, read_listed
from formats.images import Header
from formats.matching import find_file, stem_key
from formats.photos import Folder, natural
from formats.points import MAX_POINTS, SparsePoints, points_notes, read_ply_points
from formats.views import Capture, View

BLENDER_FILE = re.compile(r"transforms_(train|val|test)\.json")
NGP_SCALE, NGP_OFFSET = 0.33, 0.5
IDENTITY = np.eye(4)[:3]
MAX_PROJECTED = 20_000
"""At most so many points are projected into each view."""
AGREEING = 0.95
"""Share of a model's observations that lie in the pictures that they are of, if it is of this capture."""


def read_splits(path: Path, base: Path, downscale: int | None) -> tuple[dict, SplitPart, SplitPart]:
    """The document of a nerfstudio or instant-ngp file in a capture's folder `base` or below it, and its
    frames to train on and to test with."""
    document = read_document(path)
    if not (frames := list(enumerate(read_frames(path, document)))):
        raise NoViews(
            f'{path}: its list of "frames" is empty, expected one per photo; export the poses again'
        )
    *splits, notes = _split(path, document, frames)
    train, test = _views(path, document, base, splits, downscale)
    return document, replace(train, notes=(*train.notes, *notes)), test


# --- frames -------------------------------------------------------------------------------------------------

Numbered = tuple[int, dict]
"""A frame and its place in the file."""


def _views(
    path: Path, document: dict, base: Path, splits: Sequence[list[Numbered]], downscale: int | None
) -> list[SplitPart]:
    """Views of the frames of each split whose photo exists."""
    unsure: list[str] = []

    def camera(item: Numbered, header: Header, folder: Folder) -> tuple[str, View, Path | None]:
        frame, where = item[1], frame_where(path, *item)
        size, sure = _unstated_size(header, frame, document)
        if not sure:
            unsure.append(PurePosixPath(_file(item)).name)
        view = frame_view(where, document, frame, "", size)
        mask = _mask(path, folder.factor, frame, where)
        return where, replace(view, seen=_stated_points(where, frame)), mask

    def pose_of(item: Numbered) -> str:
        return json.dumps(item[1].get("transform_matrix"))

    homes = (str(path.parent.relative_to(base)), "") if path.parent != base else ("",)
    listed = [[(_file(item), item) for item in frames] for frames in splits]
    parts = read_listed(path, base, listed, camera, downscale, homes, pose_of)
    notes = []
    if nameless := sum(not file for frames in listed for file, _ in frames):
        notes.append(f"{path}: {counted(nameless, 'frame has', 'frames have')} no file_path and no photo")
    if unsure:
        notes.append(
            f"{path}: EXIF turns {counted(len(unsure), 'photo', 'photos')}, such as {unsure[0]}, and without "
            "w and h nothing tells whether the poses are of them so: they are read as stored"
        )
    return [replace(parts[0], notes=(*parts[0].notes, *notes)), *parts[1:]]


def _unstated_size(header: Header, frame: dict, document: dict) -> tuple[tuple[int, int], bool]:
    """The width and height of a photo that a camera is of which states none: as stored or as EXIF turns it,
    as its centre says; and whether that, or something else, tells."""
    stored = (header.width, header.height)
    keys = {key: frame.get(key, document.get(key)) for key in ("w", "h", "cx", "cy")}
    if header.orientation < 5 or stored[0] == stored[1] or None not in (keys["w"], keys["h"]):
        return stored, True
    centre = [keys[key] for key in ("cx", "cy")]
    if not all(isinstance(side, int | float) for side in centre):
        return stored, False
    off = [abs(centre[0] - wide / 2) + abs(centre[1] - high / 2) for wide, high in (stored, stored[::-1])]
    return stored if off[0] <= off[1] else stored[::-1], True


def _file(item: Numbered) -> str:
    return frame_file(item[1])


def _stated_points(where: str, frame: dict) -> np.ndarray | None:
    """Which points `sparse_points` lists, as `fusedrf pose` writes them (View.seen); None without it."""
    listed = frame.get("sparse_points")
    if listed is None:
        return None
    is_valid = isinstance(listed, list) and all(type(i) is int and 0 <= i < MAX_POINTS for i in listed)
    if not is_valid:
        raise BadSchema(f"{where}: expected sparse_points to be a list of whole numbers, one for each point")
    return np.unique(np.array(listed, np.int64))


def _mask(path: Path, factor: int, frame: dict, where: str) -> Path | None:
    """The frame's mask, from a folder like `masks_4` where the photo is from `images_4` and there is one."""
    written = written_path(frame, "mask_path")
    if not written:
        return None
    mask = PurePosixPath(written)
    copy = f"_{factor}" if factor > 1 else ""
    reduced = mask.parent.with_name(mask.parent.name + copy) / mask.name if mask.parent.name else mask
    mask_path = find_file(path.parent, str(reduced)) or find_file(path.parent, written)
    if mask_path is None:
        raise MissingFile(
            f"{where}: its mask {path.parent / mask} does not exist; add it, or remove mask_path"
        )
    return mask_path


def _split(
    path: Path, document: dict, frames: list[Numbered]
) -> tuple[list[Numbered], list[Numbered], list[str]]:
    """Train and test frames by nerfstudio's optional lists of names, and notes on what these leave out;
    without them all are to train on."""
    train = _listed(path, document, "train_filenames")
    test = _listed(path, document, "test_filenames") or _listed(path, document, "val_filenames") or set()
    files = [_file(item) for item in frames]
    is_train = [file in train if train is not None else file not in test for file in files]
    is_test = [file in test for file in files]
    uses = list(zip(files, is_train, is_test, strict=True))
    listed = (train or set()) | test
    if listed and not listed & set(files):
        raise BadSchema(
            f"{path}: its lists of file names have no frame's, but {min(listed, key=natural)} and the like; "
            "write them as the frames' file_path"
        )
    notes = []
    if unused := [file for file, learnt, held in uses if not (learnt or held)]:
        count = counted(len(unused), "frame is", "frames are")
        notes.append(f"{path}: {count} in no list of file names that is used, such as {unused[0]}")
    if both := [file for file, learnt, held in uses if learnt and held]:
        count = counted(len(both), "photo is", "photos are")
        notes.append(f"{path}: {count} both learnt from and held out, such as {both[0]}")
    if unknown := sorted(listed - set(files), key=natural):
        count = counted(len(unknown), "name is", "names are")
        notes.append(f"{path}: {count} of no frame in its lists of file names, such as {unknown[0]}")
    chosen = ([item for item, use in zip(frames, uses, strict=True) if use] for uses in (is_train, is_test))
    return *chosen, notes


def _listed(path: Path, document: dict, key: str) -> set[str] | None:
    names = document.get(key)
    if names is None:
        return None
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise BadSchema(f'{path}: expected "{key}" to be a list of file paths')
    return {frame_file({"file_path": name}) for name in names}


# --- boxes and points ---------------------------------------------------------------------------------------


def stated_aabb(path: Path, document: dict) -> np.ndarray | None:
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


@dataclass(frozen=True)
class Sparse:
    """What is known of a capture's sparse points."""

    points: SparsePoints | None = None
    """In the frame of the poses."""
    seen: Mapping[str, np.ndarray] | None = None
    """View.seen by the `stem_key` of each photo's file, where a model says it; None where the frames may."""
    notes: tuple[str, ...] = ()

    def told(self, path: Path, views: tuple[View, ...]) -> tuple[View, ...]:
        """Views with the depths between which they show the points, and with those found in their photos."""
        if self.points is None:
            return tuple(replace(view, seen=None) for view in views)
        few, with_ranges = _sample(self.points), []
        for view in views:
            near, far = depth_range(view.camera_to_world, few[view.shown(few)[3]])
            seen = view.seen if self.seen is None else self.seen.get(_photo_key(view))
            if seen is not None and self.seen is None and self.points.thinned > 1:
                seen = seen[seen % self.points.thinned == 0] // self.points.thinned
            if seen is not None and seen.max(initial=-1) >= len(self.points.positions):
                raise BadSchema(
                    f"{path}: {view.name} shows sparse point {seen.max()}, but there are "
                    f"{len(self.points.positions):,} of them; estimate the poses again"
                )
            with_ranges.append(replace(view, near=near, far=far, seen=seen))
        return tuple(with_ranges)


def _photo_key(view: View) -> str:
    return stem_key(view.image_path.name)


def sparse_points(path: Path, document: dict, views: tuple[View, ...], most: int = MAX_POINTS) -> Sparse:
    """The points of the COLMAP model that the capture was made from, where it lies beside and is of the same
    photos, or else those that `ply_file_path` names, at most so many; and a note where they were to be there
    but are not."""
    written, notes, model, cloud = written_path(document, "ply_file_path"), [], None, None
    points, seen, ply = None, None, find_file(path.parent, written) if written else None
    if "applied_transform" in document and (folder := colmap.model_folder(path.parent)) is not None:
        with noted(notes, f"{path} is read without that model"):
            model = colmap.read_points(folder, most)
    if model is not None:
        points = _placed(path, document, model[0], views)
        seen = model[1] if points is not None and _agrees(points, model[1], views) else None
    if seen is None and ply:
        with noted(notes, f"{path} is read without these points"):
            cloud = read_ply_points(ply, most)
        points = points if cloud is None else _placed(path, document, cloud, views)
    elif points is None and written:
        notes.append(f"{path}: its sparse points {written} do not exist and are not used")
    return Sparse(points, seen, (*notes, *points_notes(ply or path, points)))


def _placed(
    path: Path, document: dict, points: SparsePoints | None, views: tuple[View, ...]
) -> SparsePoints | None:
    """Points in the frame of the poses; None where there are none. Depending on the version of nerfstudio the
    file holds points before or after the transform."""
    if points is None or not len(points.positions) or not views:
        return None
    candidates = [points]
    if "applied_transform" in document:
        applied = _applied(path, document)
        candidates.append(points.moved(applied.matrix * applied.scale))
    some = views[:: max(1, len(views) // 20)]

    def share(moved: SparsePoints) -> float:
        """How many of the points some views show."""
        few = _sample(moved)[::10]
        return float(np.mean([view.shown(few)[3].mean() for view in some]))

    return max(candidates, key=share)


def _agrees(points: SparsePoints, seen: Mapping[str, np.ndarray], views: tuple[View, ...]) -> bool:
    """Whether photos show the points that a model says they do: if not, it is of others, or posed anew."""
    shown = [
        view.shown(points.positions[indices])[3]
        for view in views
        if (indices := seen.get(_photo_key(view))) is not None and len(indices)
    ]
    return bool(shown) and np.concatenate(shown).mean() > AGREEING


@dataclass(frozen=True, eq=False)
class Applied:
    """What nerfstudio did to the poses of a capture before it wrote them."""

    matrix: np.ndarray | None
    """(3, 4) applied to the world in which they were estimated, None: not stated, ..."""
    scale: float
    """... and then their scale."""


def applied_to(capture: Capture) -> Applied | None:
    """What was done to the poses of a capture before its file had them, by what that says; None where it says
    nothing. Raises BadSchema."""
    if capture.kind != "transforms":
        return None
    document = read_document(capture.path)
    return (
        _applied(capture.path, document) if {"applied_transform", "applied_scale"} & set(document) else None
    )


def _applied(path: Path, document: dict) -> Applied:
    """What a file says was done to its poses."""
    try:
        matrix = np.array(document.get("applied_transform", IDENTITY), np.float64).reshape(-1, 4)[:3]
        scale = float(document.get("applied_scale", 1.0))
    except (TypeError, ValueError, OverflowError):
        matrix, scale = np.empty(0), 1.0
    known = matrix.shape == (3, 4) and np.isfinite(matrix).all()
    if not known or not abs(np.linalg.det(matrix[:, :3])) > 1e-30 or not 0 < scale < 1e12:
        raise BadSchema(
            f"{path}: expected applied_transform to be a 3x4 matrix that can be undone, and applied_scale "
            "positive; write it again"
        )
    return Applied(matrix if "applied_transform" in document else None, scale)


def _sample(points: SparsePoints) -> np.ndarray:
    return points.positions[:: max(1, len(points.positions) // MAX_PROJECTED)]
