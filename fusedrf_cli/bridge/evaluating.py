"""`eval`: PSNR and SSIM against photos or another scene."""

from collections.abc import Iterator

import numpy as np

from formats.captures import is_capture, read_capture
from fusedrf_cli.bridge.memory import Memory, measured, picture, sources
from fusedrf_cli.bridge.pictures import WHITE, camera_of, likeness, truth_of
from fusedrf_cli.bridge.rendering import picture_memory, renderable
from fusedrf_cli.bridge.running import engine
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.distillation.judging import JUDGED_SEED
from fusedrf_cli.engine.fields.occupancy import placed_box
from fusedrf_cli.engine.rendering.cameras import Camera, scattered
from fusedrf_cli.engine.rendering.metrics import SSIM_WINDOW
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.errors import InvalidInput
from fusedrf_cli.requests import EvaluateRequest

SCENE_VIEWS = 8
SCENE_SIZE = (400, 400)
SCENE_SEED = 1_000


def evaluate(request: EvaluateRequest, progress) -> dict:
    """Compare a bundle, over white, with the pixels of a capture's views that masks do not exclude, or with
    another scene on seeded views that fusing never uses.
    """
    bundle, against, allow_outside = request.bundle, request.against, request.allow_outside
    with engine(request.device, request.threads, progress) as place:
        progress.phase("reading", None)
        budget = Memory(request.memory)
        loaded = load_scene(bundle, allow_outside, budget, place)
        field, origin = renderable(loaded)
        pairs = (
            capture_pairs(against, request.split, request.size)
            if is_capture(against)
            else scene_pairs(against, request.size, allow_outside, budget, place)
        )
        views = []
        for i, (camera, (truth, kept), total) in enumerate(pairs):
            if i == 0:
                side = camera.width, camera.height
                needed = picture_memory(field, [camera], film=False) | measured(*side)
                budget.expect(sources(loaded.sizes) | needed, advice="give a smaller --size")
                progress.phase("rendering", total)
                if min(side) < SSIM_WINDOW:
                    progress.warn(
                        f"SSIM compares windows of {SSIM_WINDOW} pixels a side, and the pictures are "
                        f"{side[0]}x{side[1]}: it is left out"
                    )
            shot = render_image(field, camera, origin=origin).over(WHITE)
            views.append({"name": camera.name, **likeness(shot, truth, kept)})
            progress.advance(i + 1, psnr=views[-1]["psnr"])
    return {
        "bundle": bundle,
        "against": against,
        "mean": {k: float(np.mean([v[k] for v in views])) for k in ("psnr", "ssim")},
        "views": views,
        "memory": budget.report(),
    }


def capture_pairs(
    against: str, split: str, size: tuple[int, int] | None
) -> Iterator[tuple[Camera, tuple[np.ndarray, np.ndarray], int]]:
    """(camera, (H, W, 3) truth over white and (H, W) bool, which pixels count, how many) of a capture's
    photos, without those of which masks exclude every pixel; InvalidInput where that is all of them."""
    capture = read_capture(against)
    views = {"test": capture.test, "train": capture.train, "all": (*capture.train, *capture.test)}[split]
    if not views:
        raise InvalidInput(f"{against}: the capture has no {split} views; choose another --split")
    if size is not None and size != (views[0].width, views[0].height):
        raise InvalidInput(
            f"{against}: the photos are {views[0].width}x{views[0].height}; leave --size out to compare "
            "with them"
        )
    found = False
    for view in views:
        truth, kept = truth_of(view)
        if kept.any():
            found = True
            yield camera_of(view), (truth, kept), len(views)
    if not found:
        raise InvalidInput(f"{against}: the masks exclude every pixel; they are black where to ignore")


def scene_pairs(
    against: str, size: tuple[int, int] | None, allow_outside: bool, budget: Memory, place: str
) -> Iterator[tuple[Camera, tuple[np.ndarray, np.ndarray], int]]:
    """The same of another scene, seen from views around it, of which every pixel counts."""
    loaded = load_scene(against, allow_outside, budget, place)
    field, origin = renderable(loaded)
    box = placed_box(field.occupancy.subject, origin)
    width, height = size or SCENE_SIZE
    composed = not hasattr(field, "render_rays")
    needed = sources(loaded.sizes) | picture(width, height, composed) | measured(width, height)
    budget.expect(needed, advice="give a smaller --size")
    for camera in scattered(box, SCENE_VIEWS, width, height, seed=JUDGED_SEED + SCENE_SEED):
        truth = render_image(field, camera, origin=origin).over(WHITE)
        yield camera, (truth, np.ones(truth.shape[:2], bool)), SCENE_VIEWS
