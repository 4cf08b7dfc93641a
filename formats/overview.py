"""What `train` would read of a capture or a mesh, for `info`: quickly, and without learning anything."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from formats.camera_set import upward
from formats.captures import is_capture, is_mesh, poses_elsewhere, read_capture
from formats.errors import FormatError, NoPoses
from formats.images import read_focal, read_image_header
from formats.meshes import mesh_facts
from formats.other_files import is_json, kind_of, not_a_capture
from formats.photos import has_pictures
from formats.posing import photos_to_pose, whole_photos
from formats.views import Capture, View, check_parallax

ROUNDING = 1e-12
LENSES = {False: "pinhole", True: "fisheye"}


def overview(path: Path | str) -> dict | None:
    """The facts of a capture, of photos without poses, or of a mesh, JSON-able; None of a bundle or a scene.

    Raises as `read_capture` and `mesh_capture`.
    """
    path = Path(path)
    if not path.exists():
        return None
    if is_mesh(path):
        return {"path": str(path), "format": "mesh", **mesh_facts(path)}
    if path.is_file() and not is_capture(path):
        if is_json(path) or path.suffix == ".rfpack" or kind_of(path) == "bundle":
            return None
        raise not_a_capture(path)
    try:
        return {"path": str(path), "format": "capture", **capture_facts(read_capture(path))}
    except NoPoses:
        if not has_pictures(path):
            raise
    return {"path": str(path), "format": "photos", **photo_facts(path)}


def capture_facts(capture: Capture) -> dict:
    """What is read of a capture: which photos, how large and through which lenses, where the subject is taken
    to be, masks, points, notes. `box` is (6,), in world units as all the rest."""
    views = capture.train + capture.test
    poses = np.array([view.camera_to_world for view in views])
    cut_out, frame = capture.object_aabb is not None, capture.frame
    unbounded = frame is not None and not cut_out
    notes = list(capture.notes)
    try:
        check_parallax(capture)
    except FormatError as error:
        notes.append(str(error))
    return {
        "kind": capture.kind,
        "photos": {"to_learn_from": len(capture.train), "held_out": len(capture.test)},
        "left_out": [{"photo": name, "why": "there is no such file"} for name in capture.missing],
        "sizes": _sizes((view.width, view.height) for view in views),
        "made_smaller": max(view.reduction for view in views),
        "turned": sum(view.orientation != 1 for view in views),
        "lenses": _lenses(views),
        "space": "unbounded" if unbounded else "bounded",
        "box": None if unbounded else _plain(capture.object_aabb if cut_out else capture.aabb),
        "layout": frame and frame.layout,
        "looks_at": frame and _plain(frame.focus, frame.distance),
        "from_distance": frame and frame.distance,
        "up": _plain(upward(poses)),
        "transparent": not capture.opaque,
        "masks": sum(view.mask_path is not None for view in views),
        "masks_cut_out_an_object": cut_out,
        "points": 0 if capture.points is None else len(capture.points.positions),
        "notes": notes,
    }


def photo_facts(path: Path) -> dict:
    """The same, as far as it is known, of photos whose poses are to be estimated."""
    photos, broken = whole_photos(path, photos_to_pose(path))
    headers = [read_image_header(photo) for photo in photos]
    note = f"{path}: its photos have no poses; `train` estimates them first, as `fusedrf pose` does"
    return {
        "kind": "photos",
        "photos": {"to_pose": len(photos)},
        "sizes": _sizes((header.width, header.height) for header in headers),
        "turned": sum(header.orientation != 1 for header in headers),
        "focal_lengths": sum(read_focal(photo) is not None for photo in photos),
        "notes": [note, *broken, *filter(None, [poses_elsewhere(path)])],
    }


def _plain(numbers: np.ndarray, size: float = 0.0) -> list[float]:
    """Numbers of one unit, with 0 for what is only rounding beside the others, or beside a size."""
    least = ROUNDING * max(size, np.abs(numbers).max())
    return np.where(np.abs(numbers) > least, numbers, 0.0).tolist()


def _sizes(sizes) -> list[dict]:
    """How many photos have which size, the most common first."""
    return [{"size": f"{w}x{h}", "photos": count} for (w, h), count in Counter(sizes).most_common()]


def _lenses(views: Sequence[View]) -> list[dict]:
    """How many photos were taken through which lens, the most common first; focal lengths in pixels."""
    lenses = Counter((v.fisheye, round(v.fl_x, 3), round(v.fl_y, 3), v.distortion) for v in views)
    return [
        {
            "lens": LENSES[fisheye],
            "focal": [x, y],
            "distortion": list(bends) if any(bends) else None,
            "photos": n,
        }
        for (fisheye, x, y, bends), n in lenses.most_common()
    ]
