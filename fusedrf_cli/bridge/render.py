"""`render`: pictures of any scene."""

import time
from pathlib import Path

import numpy as np

from formats.atomic import atomic_folder
from formats.captures import read_cameras
from formats.images import check_film, write_depth_png, write_film, write_png
from fusedrf_cli.bridge.running import engine
from fusedrf_cli.bridge.scene import LoadedScene, load_scene
from fusedrf_cli.bridge.train import camera_of
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera, orbit
from fusedrf_cli.engine.rendering.volume import RenderedImage, render_image
from fusedrf_cli.errors import UsageProblem

DEFAULT_SIZE = (800, 800)
FILMS = (".gif", ".mp4")


def render(
    scene: str,
    output: str,
    *,
    cameras: str | None,
    path: str | None,
    orbit: int | None,
    size: tuple[int, int] | None,
    background: tuple[float, float, float] | None,
    depth: bool,
    fps: float,
    allow_outside: bool,
    overwrite: bool,
    seed: int,
    device: str,
    threads: int | None,
    progress,
) -> dict:
    """Render views of a bundle or scene to a picture, a folder of pictures or a film, by the output's
    name.
    """
    suffix = Path(output).suffix.lower()
    if suffix in FILMS:
        check_film(output)
        if depth or background is None:
            raise UsageProblem("a film has neither depth nor transparency; render to a folder instead")
    with engine(device, threads, progress):
        progress.phase("reading", None)
        loaded = load_scene(scene, allow_outside)
        field, origin = renderable(loaded)
        views = choose_views(field, origin, cameras or path, orbit, size)
        if suffix == ".png" and len(views) > 1:
            raise UsageProblem(
                f"{output}: {len(views)} views do not fit one picture; give a folder, a .gif or a .mp4"
            )
        progress.phase("rendering", len(views))
        shots = _shots(field, origin, views, progress)
        if suffix in FILMS:
            write_film(output, (to_pixels(shot, background) for shot in shots), fps)
            files = [output]
        elif suffix == ".png":
            files = [_write(Path(output), next(shots), background, depth)]
        else:
            files = _write_folder(Path(output), views, shots, background, depth, overwrite)
    return {"output": output, "files": files, "views": len(views), "size": [views[0].width, views[0].height]}


def renderable(loaded: LoadedScene) -> tuple[object, np.ndarray]:
    """The field to march and the world position of its frame's origin: a lone field that is only moved is
    taken as it is.
    """
    if len(loaded.fields) == 1:
        placed = loaded.fields[0].placed
        if np.array_equal(placed.object_to_world[:3, :3], np.eye(3)):
            return placed.field, placed.object_to_world[:3, 3]
    composed = loaded.composed()
    return composed, composed.origin


def choose_views(
    field, origin: np.ndarray, cameras: str | None, count: int | None, size: tuple[int, int] | None
) -> list[Camera]:
    """The views a user asked for; with no choice, one that frames everything."""
    if cameras:
        return [camera_of(v) for v in read_cameras(cameras, size)]
    box = field.occupancy.tight_aabb(0) + np.tile(origin, 2)
    width, height = size or DEFAULT_SIZE
    return orbit(box, count, width, height) if count else [framing_camera(box, 0.9, 0.45, width, height)]


def _shots(field, origin: np.ndarray, views: list[Camera], progress):
    for i, view in enumerate(views):
        started = time.monotonic()
        yield render_image(field, view, origin=origin)
        progress.advance(i + 1, seconds_per_view=time.monotonic() - started)


def to_pixels(shot: RenderedImage, background: tuple[float, float, float] | None) -> np.ndarray:
    """(H, W, 3) uint8 over a background, or (H, W, 4) with straight alpha where it is None."""
    if background is not None:
        return np.rint(255 * shot.over(background)).astype(np.uint8)
    alpha = shot.opacity[..., None]
    straight = np.divide(shot.rgb, alpha, out=np.zeros_like(shot.rgb), where=alpha > 0)
    return np.rint(255 * np.clip(np.concatenate([straight, alpha], -1), 0, 1)).astype(np.uint8)


def _write(path: Path, shot: RenderedImage, background, depth: bool) -> dict | str:
    """One picture, and its depth beside it; returns what the report says of it."""
    write_png(path, to_pixels(shot, background))
    if not depth:
        return str(path)
    beside = path.with_name(f"{path.stem}_depth.png")
    return {"path": str(path), "depth": write_depth_png(beside, shot.depth)}


def _write_folder(folder: Path, views: list[Camera], shots, background, depth: bool, overwrite: bool) -> list:
    with atomic_folder(folder, overwrite=overwrite) as temporary:
        files = [
            _write(temporary / f"{view.name}.png", shot, background, depth)
            for view, shot in zip(views, shots, strict=True)
        ]
    return [str(folder / Path(f if isinstance(f, str) else f["path"]).name) for f in files]
