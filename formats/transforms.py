"""Captures whose cameras stand in `transforms*.json`: Blender's, instant-ngp's and nerfstudio's."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np

from formats import colmap
from formats.cameras import (
    frame_file,
    frame_names,
    frame_view,
    frame_where,
    read_document,
    read_frames,
    written_path,
)
from formats.errors import BadSchema, FormatError, MissingFile
from formats.frame import depth_range
from formats.images import read_image_header
from formats.photos import Folder, copies, find_photo, is_file, natural, on_photo, photo_folder
from formats.points import MAX_POINTS, Points, read_ply_points
from formats.views import View

BLENDER_FILE = re.compile(r"transforms_(train|val|test)\.json")
NGP_SCALE, NGP_OFFSET = 0.33, 0.5
MAX_PROJECTED = 20_000
"""At most so many points are projected into each view."""
AGREEING = 0.95
"""Share of a model's observations that lie in the pictures that they are of, if it is of this capture."""


@dataclass(frozen=True)
class Part:
    """The views of one split, whether any has alpha, the missing photos, and notes on where photos are read
    from."""

    views: tuple[View, ...] = ()
    alpha: bool = False
    missing: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()


def read_part(path: Path, downscale: int | None) -> Part:
    """All frames of a file."""
    document = read_document(path)
    return _views(path, document, list(enumerate(read_frames(path, document))), downscale)


def read_splits(path: Path, downscale: int | None) -> tuple[dict, Part, Part]:
    """The document of a nerfstudio or instant-ngp file, and its frames to train on and to test with."""
    document = read_document(path)
    frames = list(enumerate(read_frames(path, document)))
    train, test = (_views(path, document, part, downscale) for part in _split(path, document, frames))
    return document, train, test


# --- frames -------------------------------------------------------------------------------------------------


def _views(path: Path, document: dict, frames: list[tuple[int, dict]], downscale: int | None) -> Part:
    """Views of the (index, frame) pairs whose photo exists, their cameras scaled to what is read of it."""
    frames = sorted(frames, key=lambda item: natural(frame_file(item[1])))
    folders = _folders(path, [frame_file(frame) for _, frame in frames], downscale)
    photos = [_photo(path, folders, frame_file(frame)) for _, frame in frames]
    found = [(i, frame, photo) for (i, frame), photo in zip(frames, photos, strict=True) if photo]
    names = frame_names([frame for _, frame, _ in found])
    views, alpha = [], False
    for (i, frame, photo), name in zip(found, names, strict=True):
        where = frame_where(path, i, frame)
        header = read_image_header(photo)
        view = frame_view(where, document, frame, name, header[:2])
        reduction = folders[_rooted(frame_file(frame))[0]].reduction(header, downscale)
        mask = _mask(path, folders, frame, where)
        view = replace(view, seen=_stated_points(where, frame))
        views.append(on_photo(view, photo, header, where, mask, reduction))
        alpha |= header.alpha
    missing = [frame_file(f) for (_, f), photo in zip(frames, photos, strict=True) if not photo]
    return Part(tuple(views), alpha, tuple(missing), tuple(_notes(path, folders)))


def _stated_points(where: str, frame: dict) -> np.ndarray | None:
    """Which points `sparse_points` lists, as `fusedrf pose` writes them (View.seen); None without it."""
    listed = frame.get("sparse_points")
    if listed is None:
        return None
    whole = isinstance(listed, list) and all(type(i) is int and 0 <= i < MAX_POINTS for i in listed)
    if not whole:
        raise BadSchema(f"{where}: expected sparse_points to be a list of whole numbers, one for each point")
    return np.unique(np.array(listed, np.int64))


def _rooted(file: str) -> tuple[str, str]:
    """A photo's path split after its last folder `images`, or else before the file name."""
    parts = PurePosixPath(file).parts
    folders = parts[:-1]
    cut = len(folders) - folders[::-1].index("images") if "images" in folders else len(folders)
    return str(PurePosixPath(*parts[:cut])), str(PurePosixPath(*parts[cut:]))


def _folders(path: Path, files: Iterable[str], downscale: int | None) -> dict[str, Folder]:
    """For each folder of photos in the file, the one that is read: itself or a smaller copy."""
    named: dict[str, list[str]] = {}
    for root, name in map(_rooted, filter(None, files)):
        named.setdefault(root, []).append(name)
    places = {root: path.parent / root for root in named}
    # Beside the capture itself lie other captures, not copies of it.
    among = {root: copies(at) if at != path.parent else [Folder(at)] for root, at in places.items()}
    chosen = {root: photo_folder(among[root], names, downscale) for root, names in named.items()}
    return {root: folder for root, folder in chosen.items() if folder}


def _photo(path: Path, folders: dict[str, Folder], file: str) -> Path | None:
    root, name = _rooted(file) if file else ("", "")
    return find_photo(folders[root].path, name) if root in folders else None


def _notes(path: Path, folders: dict[str, Folder]) -> Iterable[str]:
    for root, folder in folders.items():
        if folder.factor > 1:
            yield f"{path}: photos are read from {folder.path.name} instead of {root}"


def _mask(path: Path, folders: dict[str, Folder], frame: dict, where: str) -> Path | None:
    """The frame's mask, from a folder like `masks_4` where the photo is from `images_4` and there is one."""
    written = written_path(frame, "mask_path")
    if not written:
        return None
    mask, root = path.parent / written, _rooted(frame_file(frame))[0]
    copy = f"_{folders[root].factor}" if folders[root].factor > 1 else ""
    reduced = mask.parent.with_name(mask.parent.name + copy) / mask.name if mask.parent.name else mask
    found = next((file for file in (reduced, mask) if is_file(file)), None)
    if found is None:
        raise MissingFile(f"{where}: its mask {mask} does not exist; add it, or remove mask_path")
    return found


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

    points: Points | None = None
    """In the frame of the poses."""
    seen: Mapping[str, np.ndarray] | None = None
    """View.seen by the stem of each photo's file, where a model says it; None where the frames may."""
    notes: tuple[str, ...] = ()

    def told(self, path: Path, views: tuple[View, ...]) -> tuple[View, ...]:
        """Views with the depths between which they show the points, and with those found in their photos."""
        if self.points is None:
            return tuple(replace(view, seen=None) for view in views)
        few, told = _sample(self.points), []
        for view in views:
            near, far = depth_range(view.camera_to_world, few[_seen(view, few)])
            seen = view.seen if self.seen is None else self.seen.get(view.image_path.stem)
            if seen is not None and seen.max(initial=-1) >= len(self.points.positions):
                raise BadSchema(
                    f"{path}: {view.name} shows sparse point {seen.max()}, but there are "
                    f"{len(self.points.positions):,} of them; estimate the poses again"
                )
            told.append(replace(view, near=near, far=far, seen=seen))
        return tuple(told)


def sparse_points(path: Path, document: dict, views: tuple[View, ...]) -> Sparse:
    """The points of the COLMAP model that the capture was made from, where it lies beside and is of the same
    photos, or else those that `ply_file_path` names; and a note where they were to be there but are not."""
    written = written_path(document, "ply_file_path")
    ply, model = bool(written) and is_file(path.parent / written), Sparse()
    if "applied_transform" in document and (folder := colmap.model_folder(path.parent)) is not None:
        try:
            points, seen = colmap.read_points(folder)
        except FormatError as error:
            if not ply:
                raise
            model = Sparse(notes=(f"{error}; {path} is read without that model",))
        else:
            model = _agreeing(Sparse(_placed(path, document, points, views), seen), views)
    if model.seen is None and ply:
        points = _placed(path, document, read_ply_points(path.parent / written), views)
        return Sparse(points, None, model.notes)
    if model.points is None and written:
        return Sparse(notes=(f"{path}: its sparse points {written} do not exist and are not used",))
    return model


def _placed(path: Path, document: dict, points: Points | None, views: tuple[View, ...]) -> Points | None:
    """Points in the frame of the poses; None where there are none. Depending on the version of nerfstudio the
    file holds points before or after the transform."""
    if points is None or not len(points.positions) or not views:
        return None
    candidates = [points, *(points.moved(matrix) for matrix in _applied(path, document))]
    return max(candidates, key=lambda moved: _seen_share(moved, views))


def _agreeing(sparse: Sparse, views: tuple[View, ...]) -> Sparse:
    """Points without what a model says of photos that do not show them so: it is of others, or posed anew."""
    found = [(view, sparse.seen.get(view.image_path.stem)) for view in views]
    found = [(view, seen) for view, seen in found if seen is not None and len(seen)]
    if sparse.points is None or not found:
        return replace(sparse, seen=None)
    shown = np.concatenate([_seen(view, sparse.points.positions[seen]) for view, seen in found])
    return sparse if shown.mean() > AGREEING else replace(sparse, seen=None)


def _applied(path: Path, document: dict) -> list[np.ndarray]:
    """The (3, 4) transform and scale that took COLMAP's world to the poses', where the file has them."""
    if "applied_transform" not in document:
        return []
    try:
        matrix = np.array(document["applied_transform"], np.float64).reshape(-1, 4)[:3]
        scale = float(document.get("applied_scale", 1.0))
    except (TypeError, ValueError, OverflowError):
        matrix, scale = np.empty(0), 1.0
    if matrix.shape != (3, 4) or not np.isfinite(matrix).all() or not 0 < scale < 1e12:
        raise BadSchema(f"{path}: expected applied_transform to be a 3x4 matrix, and applied_scale positive")
    return [matrix * scale]


def _sample(points: Points) -> np.ndarray:
    return points.positions[:: max(1, len(points.positions) // MAX_PROJECTED)]


def _seen(view: View, positions: np.ndarray) -> np.ndarray:
    """Which of (N, 3) positions a view shows, if nothing hides them; distortion is left out."""
    x, y, back = ((positions - view.camera_to_world[:3, 3]) @ view.camera_to_world[:3, :3]).T
    depth = np.where(back < 0, -back, np.inf)
    column, row = view.cx + view.fl_x * x / depth, view.cy - view.fl_y * y / depth
    return (back < 0) & (abs(column * 2 / view.width - 1) <= 1) & (abs(row * 2 / view.height - 1) <= 1)


def _seen_share(points: Points, views: tuple[View, ...]) -> float:
    few = _sample(points)[::10]
    return float(np.mean([_seen(view, few).mean() for view in views[:: max(1, len(views) // 20)]]))
