"""Polycam's raw export: a folder `keyframes` with a JSON per photo.

Its world has y up; rows are cycled so that z is up, as nerfstudio does.
"""

from pathlib import Path

from formats.cameras import checked_size, read_document
from formats.errors import BadIntrinsics, BadPose
from formats.views import View, checked_pose

FOLDERS = (("corrected_images", "corrected_cameras"), ("images", "cameras"))
"""Folders of photos and cameras; those that Polycam has optimised come first."""
ROWS = (2, 0, 1)


def keyframes(path: Path) -> tuple[Path, Path] | None:
    """The folders of photos and of cameras of an export, or of its `keyframes`; None if it is none."""
    for place in (path / "keyframes", path):
        for photos, cameras in FOLDERS:
            if (place / photos).is_dir() and any((place / cameras).glob("*.json")):
                return place / photos, place / cameras
    return None


def read_camera(path: Path) -> View:
    """The camera of one photo. Raises BadIntrinsics, BadJson, BadPose, BadSchema."""
    document = read_document(path)
    rows = [[document.get(f"t_{row}{column}") for column in range(4)] for row in ROWS]
    if any(isinstance(number, bool) or not isinstance(number, int | float) for row in rows for number in row):
        raise BadPose(f"{path}: expected its pose as twelve numbers t_00 to t_23; export it again")
    numbers = {}
    for key in ("fx", "fy", "cx", "cy", "width", "height"):
        numbers[key] = document.get(key)
        if isinstance(numbers[key], bool) or not isinstance(numbers[key], int | float):
            raise BadIntrinsics(f"{path}: expected {key} to be a number; export it again")
        if not abs(numbers[key]) < 1e30:
            raise BadIntrinsics(f"{path}: {key} is {str(numbers[key])[:40]}, expected a finite number")
    if not min(numbers["fx"], numbers["fy"]) > 0:
        raise BadIntrinsics(f"{path}: a focal length that is not positive; export it again")
    size = checked_size(round(numbers["width"]), round(numbers["height"]), str(path))
    inner = (float(numbers[key]) for key in ("fx", "fy", "cx", "cy"))
    return View(path.stem, checked_pose(rows, str(path)), *inner, *size)
