"""Pictures of an object that was cut out: alone, what is left without it, and where it was."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from formats.atomic import atomic_folder, check_writable
from formats.errors import OutputExists
from formats.filenames import distinct
from formats.images import write_png
from formats.photos import pictures
from formats.views import View
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.rendering import to_pixels
from fusedrf_cli.bridge.selecting import small
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import enclosing
from fusedrf_cli.engine.rendering.cameras import Camera, framing, framing_lens
from fusedrf_cli.engine.rendering.volume import RenderedImage, render_image
from fusedrf_cli.engine.settings import current
from fusedrf_cli.requests import ExtractRequest


@dataclass(frozen=True)
class PreviewConfig:
    """What previews show."""

    shown: int = 400
    """Pixels along the longer side of a preview."""
    previews: int = 4
    before: float = 1.05
    """A pixel of the whole shows something before the object where its distance is so many times less."""
    alike: float = 0.1
    """And its colour differs by so much."""


Shown = tuple[RadianceField, np.ndarray]
"""A field, and where its frame lies in the world: a position (3,), or a placement (4, 4)."""


def check_preview(request: ExtractRequest) -> None:
    """Before any work: the folder of previews may be written, and what would be replaced are previews.
    `--overwrite` is asked for the sake of the bundle, and must not take other files with it."""
    check_writable(request.preview, request.overwrite, folders=True)
    folder = Path(request.preview)
    files = folder.iterdir() if folder.is_dir() else ()
    others = [file for file in files if not re.fullmatch(r".*_(object|marked|rest)\.png", file.name)]
    if others:
        raise OutputExists(
            f"{folder}: holds {others[0].name}, which is no preview; choose a folder that is new or empty"
        )


def previews(
    request: ExtractRequest,
    shown: dict[str, Shown | None],
    box: np.ndarray,
    camera_set: dict[str, View],
    progress,
) -> list[str]:
    """Write pictures of a few views of the "object" in its box (6,), in the world, of the "rest", and of the
    "whole" with the object marked."""
    views = [small(view, current(PreviewConfig).shown) for view in shown_views(request, camera_set)]
    cameras = [camera_of(view) for view in views] or [framed(box)]
    progress.phase("previews", len(cameras))
    files, folder = [], Path(request.preview)
    names = distinct([camera.name or "view" for camera in cameras], ("_object", "_marked", "_rest"))
    with atomic_folder(folder, overwrite=request.overwrite) as temporary:
        for number, (camera, stem) in enumerate(zip(cameras, names, strict=True)):
            for what, pixels in pictures_of(shown, camera).items():
                name = f"{stem}_{what}.png"
                write_png(temporary / name, pixels)
                files.append(str(folder / name))
            progress.advance(number + 1)
    return files


def shown_views(request: ExtractRequest, camera_set: dict[str, View]) -> list[View]:
    """The views that were masked or pointed at, else some of all."""
    config = current(PreviewConfig)
    stems = {path.stem for path in pictures(Path(request.masks))} if request.masks else set()
    stems |= {name for name, *_ in request.points}
    named = [view for name, view in camera_set.items() if name in stems] or list(camera_set.values())
    return (
        [named[i] for i in np.unique(np.linspace(0, len(named) - 1, config.previews).astype(int))]
        if named
        else []
    )


def framed(box: np.ndarray) -> Camera:
    """A view of where the object stands, for want of cameras."""
    config = current(PreviewConfig)
    lens = framing_lens(config.shown, config.shown)
    grown = enclosing([box + 0.5 * (box[3:] - box[:3]).max() * np.repeat([-1, 1], 3)])
    return framing(grown, lens).camera(lens)


def pictures_of(shown: dict[str, Shown | None], camera: Camera) -> dict[str, np.ndarray]:
    """(H, W, 3 or 4) uint8 of the object alone, over nothing; of the rest; and of the whole, in which the
    object is red."""

    config = current(PreviewConfig)

    def shot(what: str) -> RenderedImage:
        field, origin = shown[what]
        return render_image(field, camera, origin=origin)

    whole, by_itself = shot("whole"), shot("object")
    marked, own = whole.over(), by_itself.over()
    hidden = (by_itself.depth > whole.depth * config.before) & (np.abs(marked - own).mean(-1) > config.alike)
    before = (by_itself.opacity > 0.5) & ~hidden
    marked[before] = 0.5 * marked[before] + 0.5 * np.array([1.0, 0.2, 0.1])
    pictures = {"object": to_pixels(by_itself, None), "marked": np.rint(255 * marked).astype(np.uint8)}
    if shown["rest"] is not None:
        pictures["rest"] = to_pixels(shot("rest"), (1.0, 1.0, 1.0))
    return pictures
