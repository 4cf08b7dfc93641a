"""A capture of the views that its files list: upright, framed, and with what is odd about it noted."""

import math
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from formats.capture_frame import box_around, default_box, scene_frame
from formats.errors import NoViews, printable
from formats.frame_list import SplitPart
from formats.masks import with_masks_beside
from formats.photos import alike_turned
from formats.points import SparsePoints
from formats.silhouettes import AMISS, AMISS_ON_WHITE, by_alpha, by_ground, by_masks, outline_box
from formats.upright import upward_doubt
from formats.views import LEAST_VIEWS, Capture, View


def capture_of(
    path: Path,
    kind: str,
    train: SplitPart,
    test: SplitPart,
    stated: np.ndarray | None,
    points: SparsePoints | None = None,
    notes: tuple[str, ...] = (),
) -> Capture:
    """The capture in `path`, of some kind, of views to learn from and views to measure with; `stated` (6,) is
    the box that its files name, `points` its sparse points. Raises NoViews where no photo is there."""
    views, missing = train.views + test.views, train.missing + test.missing
    if not views:
        raise NoViews(
            f"{path}: no view is left, {len(missing)} of {len(missing)} listed frames have no photo on disk; "
            "put the photos where the file_path entries say"
        )
    views, sideways = alike_turned(views)
    views, beside = with_masks_beside(views, path if path.is_dir() else path.parent)
    masked = by_masks(views)
    first_test = _left(views, masked.views, len(train.views))
    seen = by_alpha(masked.views)
    first_test = _left(masked.views, seen.views, first_test)
    poses = np.array([view.camera_to_world for view in seen.views])
    frame, box, opaque = None, stated, not seen.outlines
    all_notes = [sideways, *masked.notes, *seen.notes]
    if opaque:
        seen = by_ground(seen.views)
        all_notes += seen.notes
    if not seen.outlines:
        frame, box = _surroundings(seen.views, poses, points)
    elif not opaque or box is None:
        box = outline_box(seen, AMISS_ON_WHITE if opaque else AMISS)
    cut_out = outline_box(masked) if masked.outlines else None
    if frame is not None and len(seen.views) >= LEAST_VIEWS:
        all_notes.append(upward_doubt(poses))
    notes = (*train.notes, *test.notes, *notes, *beside, *(f"{path}: {note}" for note in all_notes if note))
    notes = (*notes, *_off_centre(path, seen.views), *_smaller(path, seen.views))
    notes = tuple(dict.fromkeys(map(printable, notes)))  # they have names from the file
    parts = seen.views[:first_test], seen.views[first_test:]
    return Capture(path, kind, *parts, box, opaque, cut_out, missing, points, frame, notes)


def _left(before: tuple[View, ...], after: tuple[View, ...], first: int) -> int:
    """How many of the first views are there still."""
    return first if len(after) == len(before) else sum(view in after for view in before[:first])


def _off_centre(path: Path, views: tuple[View, ...]) -> Iterator[str]:
    """A sentence about photos beside which their cameras look, as where their size was changed alone."""
    off = [v for v in views if not (0 <= v.cx <= v.width and 0 <= v.cy <= v.height)]
    if off:
        one = off[0]
        yield (
            f"{path}: the centres of {len(off)} of {len(views)} photos lie outside of them, such as "
            f"{one.cx:g}, {one.cy:g} of {one.name}, which is {one.width}x{one.height}; check that cx, cy, "
            "fl_x and fl_y are for photos of w and h"
        )


def _smaller(path: Path, views: tuple[View, ...]) -> Iterator[str]:
    """A sentence about photos that are made smaller on reading."""
    most = max(views, key=lambda view: view.reduction)
    if most.reduction > 1:
        yield (
            f"{path}: photos are made {most.reduction} times smaller, to {most.width}x{most.height}; "
            "--downscale 1 takes them whole"
        )


def _surroundings(views: tuple[View, ...], poses: np.ndarray, points: SparsePoints | None) -> tuple:
    """The frame of photos that show a subject and all around it, and a box large enough for that."""
    depths = [math.sqrt(view.near * view.far) for view in views if view.near and view.far]
    frame = scene_frame(poses, float(np.median(depths)) if depths else None)
    if frame.layout != "forward-facing":
        return frame, default_box(frame, poses, None if points is None else points.positions)
    seen = [(view, view.near or 0.5 * frame.distance, view.far or 4 * frame.distance) for view in views]
    return frame, box_around(np.concatenate([view.corners(d) for view, *ends in seen for d in ends]))
