"""Poses as a text file for each photo: the folders of NSVF, ScanNet and 7-Scenes.

A pose is 4 x 4 numbers, camera-to-world with x right, y down and z forward. All photos have one focal length
and centre, in pixels of the photos as they are:

    NSVF       rgb/0_0000.png    pose/0_0000.txt    intrinsics.txt    bbox.txt
    ScanNet    color/0.jpg       pose/0.txt         intrinsic/intrinsic_color.txt
    7-Scenes   frame-000000.color.png beside frame-000000.pose.txt, without any
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from formats.cameras import MOST_PIXELS, checked_focal
from formats.errors import BadIntrinsics, BadModel, BadPose, MissingFile
from formats.photos import is_file, visible_files
from formats.safe_input import decoded, read_input
from formats.views import View, checked_pose

MAX_BYTES = 1 << 16
PHOTOS, POSES = ("rgb", "color", "images"), ("pose", "poses")
INTRINSICS = (
    *("intrinsics.txt", "intrinsic/intrinsic_color.txt", "intrinsics/intrinsic_color.txt"),
    *("intrinsic_color.txt", "intrinsic.txt", "camera-intrinsics.txt", "camera_intrinsics.txt"),
)
SCENES = ".pose.txt"
"""How the poses of 7-Scenes end."""
SCENES_FOCAL, SCENES_WIDTH = 585.0, 640
"""What 7-Scenes states for all its photos, in a text beside the data."""
SPLIT = re.compile(r"([012])_\d+")
"""NSVF's names begin with 0 for photos to learn from, 1 to validate and 2 to test with."""


@dataclass(frozen=True)
class PoseFiles:
    """Where the poses of a capture's photos lie."""

    photos: Path
    """The folder of the photos."""
    poses: dict[str, Path]
    """By the photo's name, with or without its ending, in natural order."""
    intrinsics: Path | None
    box: Path | None
    """NSVF's box of the object."""

    @property
    def folder(self) -> Path:
        """That of the poses."""
        return next(iter(self.poses.values())).parent

    @property
    def is_scenes(self) -> bool:
        """Whether the photos are named as 7-Scenes names them."""
        return self.folder == self.photos


def pose_files(path: Path) -> PoseFiles | None:
    """Those of a capture's folder; None where none lie there."""
    beside = {f"{file.name.removesuffix(SCENES)}.color.png": file for file in visible_files(path, SCENES)}
    if beside:
        return PoseFiles(path, beside, _first(path, INTRINSICS) or _first(path.parent, INTRINSICS), None)
    for photos, poses in ((photos, poses) for photos in PHOTOS for poses in POSES):
        if (path / photos).is_dir() and (texts := visible_files(path / poses, ".txt")):
            named = {file.stem: file for file in texts}
            return PoseFiles(path / photos, named, _first(path, INTRINSICS), _first(path, ("bbox.txt",)))
    return None


def _first(folder: Path, names: Sequence[str]) -> Path | None:
    return next((folder / name for name in names if is_file(folder / name)), None)


def read_lens(files: PoseFiles) -> tuple[np.ndarray | None, list[str]]:
    """(4,) focal lengths and centre along x and y, None where nothing states them but 7-Scenes' own text, and
    notes. Raises BadIntrinsics, BadModel, MissingFile."""
    if files.intrinsics is None:
        if not files.is_scenes:
            raise MissingFile(
                f"{files.folder.parent}: has poses but no focal length; add intrinsics.txt with 4x4 numbers"
            )
        return None, [
            f"{files.folder}: no file states the focal length; that of 7-Scenes is taken, {SCENES_FOCAL:g} "
            f"pixels of a photo {SCENES_WIDTH} wide"
        ]
    where, numbers = files.intrinsics, _numbers(files.intrinsics)
    side = {9: 3, 16: 4}.get(len(numbers), 0)
    if side and numbers[side + 1] > 0:
        lens = numbers.reshape(side, side)[[0, 1, 0, 1], [0, 1, 2, 2]]
    elif len(numbers) >= 3:  # NSVF's other form: focal length and centre first
        lens = numbers[[0, 0, 1, 2]]
    else:
        raise BadIntrinsics(f"{where}: holds {len(numbers)} numbers, expected 3x3 or 4x4 of the camera")
    if not (np.abs(lens) <= MOST_PIXELS).all():
        raise BadIntrinsics(f"{where}: its numbers are no focal lengths and centre; export it again")
    for focal in lens[:2]:
        checked_focal(float(focal), str(where))
    return lens, []


def read_view(file: Path, lens: np.ndarray | None, size: tuple[int, int]) -> View:
    """The camera of one photo, which has `size` (width, height). Raises BadModel, BadPose."""
    numbers = _numbers(file)
    if len(numbers) not in (12, 16):
        raise BadPose(f"{file}: holds {len(numbers)} numbers, expected 4x4 of a pose; export it again")
    matrix = numbers.reshape(-1, 4)
    if not np.isfinite(matrix).all() or (matrix == -1).all():
        raise BadPose(f"{file}: the camera's pose was lost")
    pose, repair = checked_pose(matrix * [1, -1, -1, 1], str(file))
    width, height = size
    if lens is None:
        focal = SCENES_FOCAL * width / SCENES_WIDTH
        lens = np.array([focal, focal, width / 2, height / 2])
    return View(file.stem, pose, *map(float, lens), width, height, repair=repair)


def read_box(files: PoseFiles) -> np.ndarray | None:
    """(6,) box of what is shown; None where no file states one. Raises BadModel."""
    if files.box is None:
        return None
    numbers = _numbers(files.box)
    if len(numbers) < 6 or not (numbers[:3] < numbers[3:6]).all():
        raise BadModel(f"{files.box}: expected the six sides of a box, the lower first; export it again")
    return numbers[:6]


def splits(names: Sequence[str]) -> tuple[list[str], list[str], str | None]:
    """Names of photos to learn from and to test with, and a sentence where some are in neither."""
    matches = {name: SPLIT.match(name) for name in names}
    if not all(matches.values()) or not any(match[1] == "0" for match in matches.values()):
        return list(names), [], None
    by_split = {part: [name for name, match in matches.items() if match[1] == part] for part in "012"}
    train, validating, test = by_split.values()
    if not (test and validating):
        return train, test or validating, None
    return train, test, f"{len(validating)} photos to validate with, such as {validating[0]}, are not used"


def _numbers(path: Path) -> np.ndarray:
    """All numbers of a text (N,) float64, NaN among them."""
    text = decoded(read_input(path, MAX_BYTES), "replace").replace(",", " ")
    try:
        return np.array([float(word) for word in text.split()], np.float64)
    except ValueError:
        raise BadModel(f"{path}: expected numbers with spaces between them; export it again") from None
