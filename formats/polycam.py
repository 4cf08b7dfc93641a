"""Polycam's raw export: a folder `keyframes` with a JSON per photo.

Its world has y up; rows are cycled so that z is up, as nerfstudio does.
"""

from pathlib import Path

from formats.cameras import checked_focal, checked_size, read_document, stated_number
from formats.errors import BadIntrinsics, BadPose
from formats.photos import visible_files
from formats.views import View, checked_pose

FOLDERS = (("corrected_images", "corrected_cameras"), ("images", "cameras"))
"""Folders of photos and cameras; those that Polycam has optimised come first."""
ROWS = (2, 0, 1)


def keyframes(path: Path) -> tuple[Path, Path] | None:
    """The folders of photos and of cameras of an export, or of its `keyframes`; None if it is none."""
    for folder in (path / "keyframes", path):
        for photos, cameras in FOLDERS:
            if (folder / photos).is_dir() and visible_files(folder / cameras, ".json"):
                return folder / photos, folder / cameras
    return None


def read_camera(path: Path, size: tuple[int, int]) -> View:
    """The camera of one photo, which has `size` (width, height) where the file does not say.

    Raises BadIntrinsics, BadJson, BadPose, BadSchema.
    """
    document = read_document(path)
    rows = [[document.get(f"t_{row}{column}") for column in range(4)] for row in ROWS]
    if any(isinstance(number, bool) or not isinstance(number, int | float) for row in rows for number in row):
        raise BadPose(f"{path}: expected its pose as twelve numbers t_00 to t_23; export it again")
    if document.get("width") is None or document.get("height") is None:
        document |= dict(zip(("width", "height"), size, strict=True))
    keys = ("fx", "fy", "cx", "cy", "width", "height")
    numbers = {key: stated_number((document,), key, str(path), None) for key in keys}
    if None in numbers.values():
        raise BadIntrinsics(f"{path}: expected {', '.join(keys)} to be numbers; export it again")
    inner = [float(numbers[key]) for key in ("fx", "fy", "cx", "cy")]
    for focal in inner[:2]:
        checked_focal(focal, str(path))
    size = checked_size(round(numbers["width"]), round(numbers["height"]), str(path))
    pose, repair = checked_pose(rows, str(path))
    return View(path.stem, pose, *inner, *size, repair=repair)
