"""Camera poses out of photos alone, by structure from motion (the `[capture]` extra, see `colmap_worker.py`).

What comes out has z up, the focus of the cameras at the origin, and the first photo looking along +y. Its
units are arbitrary, as photos do not tell how large things are: the cameras stand some DISTANCE from the
focus.
"""

import json
import os
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from formats import colmap
from formats.atomic import atomic_folder
from formats.capture_frame import scene_frame
from formats.captures import write_cameras
from formats.colmap_worker import MAX_SIDE
from formats.errors import MissingExtra, MissingFile, NoPoses, NoViews, PosingFailed
from formats.frame_list import read_sound
from formats.images import Header, check_whole, decoded_at_once, read_focal, read_image_header, write_smaller
from formats.locks import temporary_folder
from formats.other_files import beside_photos, not_a_capture
from formats.photos import copies, natural, pictures
from formats.points import SparsePoints, write_ply_points
from formats.upright import vertical
from formats.views import View

LEAST_PHOTOS = 3
DISTANCE = 4.0
"""Median distance of the cameras from the origin: about that of the cameras of Blender's captures."""
FEW_FEATURES = 200
"""A photo of fewer features is blurred, or shows little but plain surfaces."""
UPS = {3: (0, -1), 4: (0, -1), 5: (-1, 0), 6: (-1, 0), 7: (1, 0), 8: (1, 0)}
"""Where up is in the stored picture (right, up), by EXIF orientation; (0, 1) of the others."""
CAMERAS = "transforms.json"
POINTS = "points.ply"
TEMPORARY = "fusedrf-poses-"
"""What the names of temporary folders begin with."""


@dataclass(frozen=True, eq=False)
class PosedPhotos:
    """Photos that found their pose."""

    views: tuple[View, ...]
    """For the photos as stored, whatever their EXIF orientation."""
    points: SparsePoints
    unposed: tuple[str, ...]
    """Names of the photos that did not find a pose."""
    plain: tuple[str, ...]
    """Those of them that have few features."""
    models: tuple[int, ...]
    """Photos of each model that came out, the largest first; only that one is used."""
    error: float
    """Mean distance of a point from where its photos show it, in pixels of the pictures that were compared
    (at most MAX_SIDE a side)."""


def check_extra(folder: Path | str) -> None:
    """MissingExtra where pycolmap is not installed. It is not imported: see `colmap_worker.py`."""
    if find_spec("pycolmap") is None:
        raise MissingExtra(
            f"{folder}: to estimate where its photos were taken needs an extra: "
            'pip install "fusedrf[capture]"'
        )


def photos_to_pose(folder: Path | str) -> list[Path]:
    """The photos of a folder, or of its `images` where there are more of them, in natural order.

    Raises BadImage, MissingExtra, MissingFile, NotACapture, NoViews.
    """
    folder = Path(folder)
    if not folder.exists():
        raise MissingFile(f"{folder}: no such folder; give the folder that the photos lie in")
    if not folder.is_dir():
        raise not_a_capture(folder)
    folders = (folder, *(copy.path for copy in copies(folder / "images")))
    photos = max(map(pictures, folders), key=len)  # one beside `images` is a thumbnail
    if not photos:
        raise not_a_capture(folder)
    read_image_header(photos[0])  # of a kind that is not read, it is named before any work
    if len(photos) < LEAST_PHOTOS:
        beside = beside_photos(folder)
        more = f"; it holds {beside[0]} as well, {beside[1].what}: {beside[1].cure}" if beside else ""
        raise NoViews(
            f"{folder}: holds {len(photos)} photos, but where they were taken follows from {LEAST_PHOTOS} or "
            f"more that overlap; take more, from different places{more}"
        )
    return sorted(photos, key=lambda file: natural(file.name))


def whole_photos(folder: Path | str, photos: Sequence[Path]) -> tuple[list[Path], list[str]]:
    """Photos without a few that are cut off, and notes on these. Raises as `read_sound`."""

    def read(photo: Path) -> Path:
        check_whole(photo)
        return photo

    return read_sound(folder, photos, read, str)


def estimate(folder: Path | str, photos: Sequence[Path], threads: int, progress) -> PosedPhotos:
    """Where photos were taken. `progress` has `phase` and `advance` of fusedrf_cli/progress.py.

    The same photos and threads give the same poses. An interrupt leaves nothing behind. Raises BadImage,
    LimitExceeded, MissingExtra, NoPoses, PosingFailed.
    """
    check_extra(folder)
    with temporary_folder(TEMPORARY) as work:
        headers = _prepare(work, photos, threads, progress)
        report = _run(folder, work, threads, progress)
        counts = dict(zip(photos, report["features"], strict=True))
        if not report["models"] or report["models"][0] < LEAST_PHOTOS:
            raise NoPoses(_not_found(folder, counts, max(report["models"], default=0)))
        model = colmap.read_model(work / "model")
    placed = {int(Path(image.name).stem): image.view for image in model.images}
    views = [
        replace(placed[i].stretched(*headers[i][:2]), image_path=photos[i], name=photos[i].stem)
        for i in sorted(placed)
    ]
    unposed = [photo for i, photo in enumerate(photos) if i not in placed]
    views, points = upright(views, model.points, [headers[i].orientation for i in sorted(placed)])
    return PosedPhotos(
        views,
        points,
        tuple(photo.name for photo in unposed),
        tuple(photo.name for photo in unposed if counts[photo] < FEW_FEATURES),
        tuple(report["models"]),
        report["error"],
    )


def _not_found(folder: Path | str, counts: dict[Path, int], placed: int) -> str:
    """The sentence for photos that give no model."""
    least = min(counts, key=counts.get)
    plain = sum(count < FEW_FEATURES for count in counts.values())
    shown = f" ({plain} of them, such as {least.name}, are blurred or plain)" if plain else ""
    return (
        f"{folder}: {placed or 'none'} of its {len(counts)} photos{shown} found their pose; likely they "
        "overlap too little, were taken from one spot, are blurred, or show plain walls or things that move: "
        "take more, moving a step between them, each with two thirds of what the one before shows"
    )


def write_posed(folder: Path | str, posed: PosedPhotos, overwrite: bool, relative: bool) -> None:
    """A capture that `read_capture` and nerfstudio read: CAMERAS, which names the photos where they lie, and
    POINTS. Paths are from `folder`, or whole unless `relative`. Raises OutputExists, ResourceError."""
    target = os.path.realpath(folder)
    files = [os.path.realpath(view.image_path.parent) for view in posed.views]
    files = [str(Path(at) / view.image_path.name) for at, view in zip(files, posed.views, strict=True)]
    if relative:
        files = [_from(target, file) for file in files]
    more = {"ply_file_path": POINTS, "unposed": list(posed.unposed)}
    with atomic_folder(folder, overwrite=overwrite) as temporary:
        write_ply_points(temporary / POINTS, posed.points)
        write_cameras(temporary / CAMERAS, posed.views, files, **more)


def _from(target: str, file: str) -> str:
    try:
        return Path(os.path.relpath(file, target)).as_posix()
    except ValueError:  # on another drive
        return file


# --- the process --------------------------------------------------------------------------------------------


def _prepare(work: Path, photos: Sequence[Path], threads: int, progress) -> list[Header]:
    """Write a job for `colmap_worker.py`, with the photos as PNG of at most MAX_SIDE; returns their headers.

    All are decoded here, so that broken ones are named at once and every kind that is read can be posed.
    """
    progress.phase("reading", len(photos))

    def prepare(item: tuple[int, Path]) -> tuple:
        i, photo = item
        size = write_smaller(photo, work / f"{i:06d}.png", MAX_SIDE)
        focal = read_focal(photo)
        return (*size, None if focal is None else focal * float(np.hypot(*size)))

    headers, cameras = [read_image_header(photo) for photo in photos], {}
    largest = max(headers, key=lambda header: header.width * header.height)
    at_once = min(threads, decoded_at_once(largest.width, largest.height))
    with ThreadPoolExecutor(at_once) as pool:
        for i, camera in enumerate(pool.map(prepare, enumerate(photos))):
            # Photos of one size and focal length are taken to be of one camera.
            cameras.setdefault(camera, []).append(f"{i:06d}.png")
            progress.advance(i + 1)
    keys = ("width", "height", "focal")
    listed = [dict(zip(keys, camera, strict=True), photos=names) for camera, names in cameras.items()]
    (work / "job.json").write_text(json.dumps({"threads": threads, "cameras": listed}))
    return headers


def _run(folder: Path | str, work: Path, threads: int, progress) -> dict:
    """What `colmap_worker.py` says last: features, models, error. It is ended whatever happens here."""
    paths = [str(Path(__file__).parents[1]), *filter(None, sys.path)]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(paths), "OMP_NUM_THREADS": str(threads)}
    with open(work / "log", "wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-P", "-m", "formats.colmap_worker", str(work)],
            stdin=subprocess.PIPE,  # which ends with this process
            stdout=subprocess.PIPE,
            stderr=log,
            env=environment,
            start_new_session=True,  # Ctrl-C comes here, and ends the other from here
        )
    report = {}
    with process:
        try:
            for line in process.stdout:
                report = json.loads(line)
                if "phase" in report:
                    progress.phase(report["phase"], report["total"])
                elif "done" in report:
                    progress.advance(report["done"])
        finally:
            if "features" not in report:
                process.kill()
    if process.returncode or "features" not in report:
        raise PosingFailed(_broken(folder, work / "log", process.returncode))
    return report


def _broken(folder: Path | str, log: Path, code: int) -> str:
    """The sentence for a process that ended early; its log's last line may say why."""
    lines = log.read_text("utf-8", "replace").strip().splitlines()
    last_line = f" ({lines[-1][:200]})" if lines else ""
    return (
        f"{folder}: structure from motion broke down with code {code}{last_line}; try again with --threads "
        "1, which takes less memory, or give poses from another program"
    )


# --- the world's axes ---------------------------------------------------------------------------------------


def upright(
    views: Sequence[View], points: SparsePoints, orientations: Sequence[int]
) -> tuple[tuple[View, ...], SparsePoints]:
    """The same with z up, the focus at the origin, the cameras about DISTANCE from it, and the first looking
    along +y. `orientations` are the photos' (EXIF), which say where up is in them."""
    poses = np.array([view.camera_to_world for view in views])
    turn = _level(poses, orientations)
    poses = turn @ poses
    positions = points.positions @ turn[:3, :3].T
    depths = [(pose[:3, 3] - np.median(positions, 0)) @ pose[:3, 2] for pose in poses]
    frame = scene_frame(poses, float(np.median(depths)))
    scale = DISTANCE / frame.distance
    poses[:, :3, 3] = (poses[:, :3, 3] - frame.focus) * scale
    turned = tuple(replace(view, camera_to_world=pose) for view, pose in zip(views, poses, strict=True))
    return turned, SparsePoints((positions - frame.focus) * scale, points.colours)


def _level(poses: np.ndarray, orientations: Sequence[int]) -> np.ndarray:
    """(4, 4) rotation that makes the cameras' vertical +z, and the first's look +y as far as it is level."""
    sides = np.array([UPS.get(orientation, (0, 1)) for orientation in orientations], float)
    ups = np.einsum("nij,nj->ni", poses[:, :3, :2], sides)
    rights, backs = np.cross(ups, poses[:, :3, 2]), poses[:, :3, 2]
    up, _ = vertical(rights, ups, backs)
    look = -poses[0, :3, 2]
    if np.linalg.norm(np.cross(look, up)) < 0.1:  # straight up or down: then what is up in it, lies ahead
        look = ups[0]
    ahead = look - (look @ up) * up
    ahead /= np.linalg.norm(ahead)
    turn = np.eye(4)
    turn[:3, :3] = np.cross(ahead, up), ahead, up
    return turn
