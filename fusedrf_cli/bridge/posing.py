"""`pose`: where photos were taken; and the same for `train`, which keeps it in the user's cache."""

import atexit
import contextlib
import hashlib
import json
import os
import time
from collections.abc import Sequence
from dataclasses import replace
from importlib.metadata import version
from pathlib import Path

from platformdirs import user_cache_path

from formats.captures import poses_elsewhere, read_capture
from formats.errors import NoPoses, ResourceError
from formats.locks import temporary_folder
from formats.photos import has_pictures
from formats.posing import (
    CAMERAS,
    TEMPORARY,
    PosedPhotos,
    check_extra,
    estimate,
    photos_to_pose,
    whole_photos,
    write_posed,
)
from formats.views import Capture
from fusedrf_cli import __version__
from fusedrf_cli.bridge.runtime import available_cores, written_somewhere
from fusedrf_cli.requests import PoseRequest

WORLD = (
    "z is up as the cameras were held, the cameras' focus is the origin, the first photo looks along +y; "
    "units are arbitrary"
)
"""Of a capture whose poses were estimated."""


def pose(request: PoseRequest, progress) -> dict:
    """Estimate poses and write them as a capture."""
    started = time.monotonic()
    photos = _whole_photos(request.photos, progress)
    posed = estimate(request.photos, photos, request.threads or available_cores(), progress)
    _warn_of_unposed(request.photos, posed.unposed, posed.plain, len(photos), progress)
    written_somewhere(
        request.output, lambda folder: write_posed(folder, posed, request.overwrite, relative=True)
    )
    view = posed.views[0]
    return {
        "output": request.output,
        "photos": len(photos),
        "posed": len(posed.views),
        "left_out": list(posed.unposed),
        "models": list(posed.models),
        "focal_length": {"pixels": view.fl_x, "width": view.width},
        "sparse_points": len(posed.points.positions),
        "error_pixels": posed.error,
        "world": WORLD,
        "seconds": time.monotonic() - started,
    }


def posed_capture(source: str, downscale: int | None, threads: int | None, progress) -> Capture:
    """A capture, or photos without poses, whose poses are then estimated, or taken from an earlier time."""
    try:
        return read_capture(source, downscale)
    except NoPoses:
        if not has_pictures(Path(source)):
            raise
    photos = _whole_photos(source, progress)
    folder = _cached(source, photos)
    if not (folder / CAMERAS).exists():
        progress.tell(f"{source}: has photos but no poses, so these are estimated first")
        posed = estimate(source, photos, threads or available_cores(), progress)
        folder = _keep(posed, folder)
        progress.phase("reading", None)
    unposed = json.loads((folder / CAMERAS).read_text())["unposed"]
    _warn_of_unposed(source, unposed, (), len(photos), progress)
    capture = read_capture(folder, downscale)
    note = (
        f"{source}: where {len(photos) - len(unposed)} of {len(photos)} photos were taken is estimated from "
        f"them: {WORLD}; it is kept in {folder}"
    )
    elsewhere = filter(None, [poses_elsewhere(Path(source))])
    return replace(capture, path=Path(source), notes=(*elsewhere, note, *capture.notes))


def _whole_photos(source: str, progress) -> list[Path]:
    """The photos of a folder, but for a few that are cut off, which is said."""
    photos, notes = whole_photos(source, photos_to_pose(source))
    for note in notes:
        progress.warn(note)
    return photos


def _cached(source: str, photos: Sequence[Path]) -> Path:
    """Where the poses of these photos are kept, in the user's cache; they are others when a photo changes."""
    check_extra(source)
    stated = [(os.path.realpath(photo), *_stamp(photo)) for photo in photos]
    facts = json.dumps([__version__, version("pycolmap"), stated])
    return user_cache_path("fusedrf") / "poses" / hashlib.sha256(facts.encode()).hexdigest()[:16]


def _stamp(photo: Path) -> tuple[int, int]:
    status = photo.stat()
    return status.st_size, status.st_mtime_ns


def _keep(posed: PosedPhotos, folder: Path) -> Path:
    """Write poses to the cache, or where that cannot be written to a folder that ends with the process."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        write_posed(folder, posed, overwrite=True, relative=False)
    except (OSError, ResourceError):
        lasting = contextlib.ExitStack()
        folder = lasting.enter_context(temporary_folder(TEMPORARY)) / folder.name
        atexit.register(lasting.close)
        write_posed(folder, posed, overwrite=True, relative=False)
    return folder


def _warn_of_unposed(source: str, unposed: Sequence[str], plain: Sequence[str], count: int, progress) -> None:
    """Say which photos did not find a pose, where some did not."""
    if not unposed:
        return
    most = 12  # photos that are named
    more = f" and {len(unposed) - most} more" if len(unposed) > most else ""
    names = ", ".join(unposed[:most]) + more
    why = f"; {', '.join(plain[:most])} are blurred or plain" if plain else ""
    progress.warn(f"{source}: {len(unposed)} of {count} photos found no pose and were left out: {names}{why}")
