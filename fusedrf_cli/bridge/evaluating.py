"""`eval`: PSNR and SSIM against photos or another scene."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from formats.captures import is_capture, read_capture
from fusedrf_cli.bridge.evaluation_views import evaluation_views_of
from fusedrf_cli.bridge.memory import Memory, measured, sources
from fusedrf_cli.bridge.pictures import camera_of, likeness, truth_of
from fusedrf_cli.bridge.rendering import composite_of, frame_memory, renderable, warn_of_work
from fusedrf_cli.bridge.runtime import engine
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.engine.distillation.evaluation import EvaluatorConfig
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.metrics import SSIM_WINDOW, psnr
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.requests import EvaluateRequest


@dataclass(frozen=True)
class EvaluationConfig:
    """The views of a scene that are compared."""

    views: int = 8
    size: tuple[int, int] = (400, 400)
    stream: int = 1
    """Beside `judged_seed`: they are drawn from a stream of their own."""


def evaluate(request: EvaluateRequest, progress) -> dict:
    """Compare a bundle, over white, with the pixels of a capture's views that masks do not exclude, or with
    another scene on seeded views that fusing never uses.
    """
    bundle, against, allow_outside = request.bundle, request.against, request.allow_outside
    with engine(request.device, request.threads, progress) as device:
        progress.phase("reading", None)
        budget = Memory(request.memory)
        loaded = load_scene(bundle, allow_outside, budget, device)
        pairs = (
            capture_pairs(against, request.split, request.size)
            if is_capture(against)
            else scene_pairs(against, request.size, allow_outside, budget, device)
        )
        views = []
        for i, (pair, total) in enumerate(pairs):
            camera = pair.camera
            if i == 0:
                side = camera.width, camera.height
                field, origin = renderable(loaded, budget, frame_memory(None, *side) | measured(*side))
                needed = frame_memory(field, *side) | measured(*side)
                budget.expect(sources(loaded.resident) | needed, advice="give a smaller --size")
                warn_of_work(bundle, field, total * side[0] * side[1], progress)
                progress.phase("rendering", total)
                if min(side) < SSIM_WINDOW:
                    progress.warn(
                        f"SSIM compares windows of {SSIM_WINDOW} pixels a side, and the pictures are "
                        f"{side[0]}x{side[1]}: it is left out"
                    )
            shot = render_image(field, camera, origin=origin).over()
            views.append({"name": camera.name, **pair.likeness(shot)})
            progress.advance(i + 1, psnr=views[-1]["psnr"])
    return {
        "bundle": bundle,
        "against": against,
        "mean": {k: float(np.mean([v[k] for v in views])) for k in ("psnr", "ssim")},
        **of_objects(views),
        "views": views,
        "memory": budget.report(),
    }


@dataclass(frozen=True, eq=False)
class Pair:
    """What a bundle's picture is compared with."""

    camera: Camera
    truth: np.ndarray
    """(H, W, 3) over white."""
    kept: np.ndarray
    """(H, W) bool: which pixels count."""
    covered: np.ndarray | None = None
    """(H, W) bool: those in which a scene shows something."""
    of: str | None = None
    """The object that the view is of."""

    def likeness(self, shot: np.ndarray) -> dict:
        """What the report says of a picture (H, W, 3)."""
        measures = likeness(shot, self.truth, self.kept)
        if self.covered is not None and self.covered.any():
            measures["covered_psnr"] = psnr(shot[self.covered], self.truth[self.covered])
            measures["covered_share"] = float(self.covered.mean())
        return measures | ({"of": self.of} if self.of else {})


def of_objects(views: list[dict]) -> dict:
    """The mean PSNR of the pixels that a scene covers, and the object that is shown worst in a view of its
    own; nothing where views were compared with photos."""
    covered = [view["covered_psnr"] for view in views if "covered_psnr" in view]
    measures = {"covered": {"psnr": float(np.mean(covered))}} if covered else {}
    objects = [(view["psnr"], view["of"]) for view in views if "of" in view]
    if objects:
        worst, name = min(objects)
        measures["worst_object"] = {"name": name, "psnr": worst}
    return measures


def capture_pairs(against: str, split: str, size: tuple[int, int] | None) -> Iterator[tuple[Pair, int]]:
    """What a capture's photos give, and how many there are, without those of which masks exclude every pixel;
    InvalidInput where that is all of them."""
    capture = read_capture(against)
    views = {"test": capture.test, "train": capture.train, "all": (*capture.train, *capture.test)}[split]
    if not views:
        other, count = ("train", len(capture.train)) if capture.train else ("test", len(capture.test))
        raise InvalidInput(
            f"{against}: the capture has no {split} views; compare with its {count} {other} views by --split "
            f"{other}"
        )
    if size is not None and size != (views[0].width, views[0].height):
        raise UsageProblem(
            f"{against}: the photos are {views[0].width}x{views[0].height}; leave --size out to compare "
            "with them"
        )
    is_evaluated = False
    for view in views:
        truth, mask = truth_of(view)
        if mask.any():
            is_evaluated = True
            yield Pair(camera_of(view), truth, mask), len(views)
    if not is_evaluated:
        raise InvalidInput(f"{against}: the masks exclude every pixel; they are black where to ignore")


def scene_pairs(
    against: str, size: tuple[int, int] | None, allow_outside: bool, budget: Memory, device: str
) -> Iterator[tuple[Pair, int]]:
    """The same of another scene, as `render` draws it, from where it and its objects were photographed; every
    pixel counts."""
    evaluation = current(EvaluationConfig)
    config = current(EvaluatorConfig)
    loaded = load_scene(against, allow_outside, budget, device)
    size, seed = size or evaluation.size, (config.judged_seed, evaluation.stream)
    field = composite_of(loaded, budget, frame_memory(None, *size) | measured(*size))
    views = evaluation_views_of(loaded, field, evaluation.views, size, seed)
    needed = frame_memory(field, *size) | measured(*size)
    budget.expect(sources(loaded.resident) | needed, advice="give a smaller --size")
    for look in views:
        shot = render_image(field, look.camera, origin=field.origin)
        every = np.ones(shot.opacity.shape, bool)
        yield Pair(look.camera, shot.over(), every, shot.opacity > config.covered, look.of), len(views)
