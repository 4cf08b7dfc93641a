"""`render`: pictures of any scene."""

import contextlib
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from formats.atomic import atomic_folder
from formats.filenames import DEPTH, depth_of, distinct
from formats.png import depth_png_writer, png_writer
from formats.video import FILMS, check_film, write_film
from fusedrf_cli.bridge.memory import Memory, picture, segments, sources
from fusedrf_cli.bridge.runtime import engine
from fusedrf_cli.bridge.scene import LoadedScene, load_scene
from fusedrf_cli.bridge.views import choose_views
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import Composite, as_composite
from fusedrf_cli.engine.fields.base import RadianceField, sampling_step
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.volume import RenderedImage, render_bands, render_image
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.request_parts import ending_of
from fusedrf_cli.requests import RenderRequest


@dataclass(frozen=True)
class WorkConfig:
    """When a rendering is said to take long, and what a film takes."""

    many_rays: int = 1 << 28
    """From which on a command says that it takes long."""
    many_samples: int = 1 << 14
    """Of a ray, from which on it says so where there are `much_work` of all rays."""
    much_work: int = 1 << 32
    frame_bytes: int = 60
    """Of a film's pixel: its floats, and their way to bytes."""


def render(request: RenderRequest, progress) -> dict:
    """Render views of a bundle or scene to a picture, a folder of pictures or a film, by the output's
    name.
    """
    output = request.output
    suffix = ending_of(output)
    if suffix in FILMS:
        check_film(output)
        if request.depth or request.background is None:
            raise UsageProblem("a film has neither depth nor transparency; render to a folder instead")
    with engine(request.device, request.threads, progress) as device:
        progress.phase("reading", None)
        budget = Memory(request.memory)
        loaded = load_scene(request.scene, request.allow_outside, budget, device)
        field, origin = reference(loaded)
        views = choose_views(request, loaded, field, origin)
        if suffix in FILMS:
            check_sizes(output, views)
        if suffix == ".png" and len(views) > 1:
            raise UsageProblem(
                f"{output}: {len(views)} views do not fit one picture; give a folder, a .gif or a .mp4"
            )
        if not request.reference:
            field, origin = renderable(loaded, budget, picture_memory(None, views, suffix in FILMS))
        needed = picture_memory(field, views, suffix in FILMS)
        is_composite = isinstance(field, Composite)
        loaded.field_cache.resize(sum(loaded.sizes) if is_composite else budget.room(needed))
        advice = "use --reference" if is_composite else "give a smaller --size"
        budget.expect(sources(loaded.resident, loaded.field_cache.room) | needed, advice=advice)
        warn_of_work(request.scene, field, rays_of(views), progress)
        progress.phase("rendering", len(views))
        how = {"origin": origin, "near": request.near, "far": request.far}
        how["step"] = None if request.step is None else request.step / unit_of(origin)
        shooting = _Shooting(field, how, request.background, request.depth, progress)
        if suffix in FILMS:
            write_film(output, shooting.frames(views), request.fps)
            files = [output]
        elif suffix == ".png":
            files = [shooting.picture(Path(output), views[0])]
        else:
            files = shooting.folder(Path(output), views, request.overwrite)
    return {
        "output": output,
        "files": files,
        "views": len(views),
        "size": [views[0].width, views[0].height],
        "memory": budget.report(),
    }


def unit_of(origin: np.ndarray) -> float:
    """How long a unit of a frame is in the world, where the frame lies at `origin` (see `render_image`)."""
    return float(np.cbrt(abs(np.linalg.det(origin[:3, :3])))) if origin.shape == (4, 4) else 1.0


def picture_memory(field, views: list[Camera], film: bool) -> dict[str, float]:
    """What rendering needs beside the sources; field None: of what is still to become a Composite."""
    largest = max(views, key=lambda view: view.width * view.height)
    needed = frame_memory(field, largest.width, largest.height)
    pixels = largest.width * largest.height
    return needed | ({"the film": pixels * (current(WorkConfig).frame_bytes + len(views))} if film else {})


def frame_memory(field, width: int, height: int) -> dict[str, float]:
    """The same of one picture of a size."""
    composed = field is not None and not hasattr(field, "render_rays")
    needed = picture(width, height, composed=composed)
    held = field is None or isinstance(field, Composite)
    return needed | (segments(width * height) if held else {})


def warn_of_work(scene: str, field, rays: int, progress) -> None:
    """A warning where so many rays through a field may take much longer than people expect."""
    config = current(WorkConfig)
    sampled = field.fields if isinstance(field, Composite) else [field]
    samples = max(f.occupancy.most_samples(sampling_step(f)) for f in sampled)
    if rays >= config.many_rays:
        progress.warn(f"{scene}: {rays:,} pixels may take long; give a smaller --size")
    elif samples >= config.many_samples and rays * samples >= config.much_work:
        progress.warn(
            f"{scene}: a ray takes up to {samples:,} samples, since something is that much finer than the "
            "whole is wide, and this may take long; leave out what is smallest, or farthest away"
        )


def rays_of(views: list[Camera]) -> int:
    """How many rays all the pictures take."""
    return sum(view.width * view.height for view in views)


def reference(loaded: LoadedScene) -> tuple[RadianceField, np.ndarray]:
    """A scene as one field, and where the frame of that lies in the world (see `render_image`): a lone field
    as it is, else the naive composition."""
    composed = loaded.lone() or loaded.composed()
    return composed if isinstance(composed, tuple) else (composed, composed.origin)


def renderable(
    loaded: LoadedScene, budget: Memory | None = None, needed: Mapping[str, float] | None = None
) -> tuple[RadianceField, np.ndarray]:
    """The same of what is marched; see `composite_of`."""
    if (lone := loaded.lone()) is not None:
        return lone
    composed = composite_of(loaded, budget, needed)
    return composed, composed.origin


def composite_of(
    loaded: LoadedScene, budget: Memory | None = None, needed: Mapping[str, float] | None = None
) -> ComposedField:
    """A scene as a Composite, whose fields are all in memory, where compiled loops compute all of them and
    the budget has room for them beside what is needed; else its naive composition."""
    composed = loaded.composed()
    if budget is not None and budget.room(sources(loaded.resident) | (needed or {})) < 0:
        return composed
    loaded.field_cache.resize(sum(loaded.sizes))
    return as_composite(composed)


def check_sizes(output: str, views: list[Camera]) -> None:
    """UsageProblem where the pictures of a film would differ in size."""
    sizes = {(view.width, view.height) for view in views}
    if len(sizes) > 1:
        raise UsageProblem(f"{output}: a film has one size, and its views have {len(sizes)}; give --size")


def to_pixels(shot: RenderedImage, background: tuple[float, float, float] | None) -> np.ndarray:
    """(H, W, 3) uint8 over a background, or (H, W, 4) with straight alpha where it is None."""
    if background is not None:
        return np.rint(255 * shot.over(background)).astype(np.uint8)
    alpha = shot.opacity[..., None]
    straight = np.divide(shot.rgb, alpha, out=np.zeros_like(shot.rgb), where=alpha > 0)
    return np.rint(255 * np.clip(np.concatenate([straight, alpha], -1), 0, 1)).astype(np.uint8)


@dataclass
class _Shooting:
    """What all pictures of one command share."""

    field: object
    how: dict
    """Where the field's frame lies, and what is shown of it: words of `render_image`."""
    background: tuple[float, float, float] | None
    depth: bool
    progress: object
    done: int = 0
    """Views, so far."""

    def frames(self, views: list[Camera]) -> Iterator[np.ndarray]:
        """(H, W, 3) uint8, one for each view, made when it is asked for."""
        for view in views:
            started = time.monotonic()
            yield to_pixels(render_image(self.field, view, **self.how), self.background)
            self.count(started)

    def picture(self, path: Path, view: Camera) -> dict | str:
        """Write one picture, and its depth beside it, as it is rendered; returns what the report says."""
        started, size, rows = time.monotonic(), (view.width, view.height), 0
        channels = 4 if self.background is None else 3
        with contextlib.ExitStack() as stack:
            add = stack.enter_context(png_writer(path, *size, channels))
            deep = stack.enter_context(depth_png_writer(depth_of(path), *size)) if self.depth else None
            for band in render_bands(self.field, view, **self.how):
                add(to_pixels(band, self.background))
                if deep:
                    deep[0](band.depth)
                rows += len(band.depth)
                self.progress.advance(self.done + rows / view.height)
        self.count(started)
        return {"path": str(path), "depth": deep[1]} if deep else str(path)

    def folder(self, folder: Path, views: list[Camera], overwrite: bool) -> list[str]:
        """A folder of one picture per view, named after it."""
        names = distinct([view.name for view in views], ("", DEPTH) if self.depth else ("",))
        for view, name in zip(views, names, strict=True):
            if view.name != name:
                self.progress.warn(f"{folder}: the view '{view.name}' is in {name}.png; another has its name")
        with atomic_folder(folder, overwrite=overwrite) as temporary:
            for view, name in zip(views, names, strict=True):
                self.picture(temporary / f"{name}.png", view)
        return [str(folder / f"{name}.png") for name in names]

    def count(self, started: float) -> None:
        """One view more is done."""
        self.done += 1
        self.progress.advance(self.done, seconds_per_view=time.monotonic() - started)
