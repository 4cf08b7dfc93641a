"""`train`: photos or a mesh to one field."""

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from formats.atomic import check_space
from formats.captures import hold_out, is_mesh, load_ignored, load_images, load_photos, read_capture
from formats.meshes import mesh_capture
from formats.records import coded_bytes
from formats.views import Capture, View
from fusedrf_cli.bridge.memory import Memory, fitting, photos
from fusedrf_cli.bridge.running import checkpoint_path, engine, load_checkpoint, resumable
from fusedrf_cli.bridge.scene import write_field
from fusedrf_cli.engine.distillation.fit import FitRun, FitSettings, Pictures, texels
from fusedrf_cli.engine.kinds.vm.field import VMShape
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.metrics import psnr, ssim
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.errors import InvalidInput, QualityNotReached, UsageProblem
from fusedrf_cli.report import readable_size

QUALITY = {
    "draft": FitSettings(longest=128, steps=1500, samples=1 << 14),
    "normal": FitSettings(longest=224, steps=4000, samples=1 << 14),
    "high": FitSettings(longest=256, steps=9000, samples=1 << 15),
}
WHITE = (1.0, 1.0, 1.0)


def train(
    source: str,
    output: str,
    *,
    kind: str,
    colour: str,
    sh_degree: int,
    quality: str,
    max_size: int | None,
    target_psnr: float | None,
    time_budget: float | None,
    holdout: int | None,
    views: int,
    size: int,
    memory: int | None,
    precision: str,
    aabb: tuple[float, ...] | None,
    masks: str,
    resume: bool,
    overwrite: bool,
    seed: int,
    device: str,
    threads: int | None,
    progress,
) -> dict:
    """Fit one field to a capture and write it; with `holdout` every N-th view only measures."""
    if colour == "mlp" and device == "cuda":
        raise UsageProblem("--colour mlp is computed on the CPU only; use --device cpu, or --colour sh")
    with engine("cpu" if colour == "mlp" else device, threads, progress) as place:
        budget = Memory(memory)
        saved = load_checkpoint(output, "train") if resume else None
        progress.phase("reading", None)
        capture = (
            mesh_capture(source, n_train=views, size=size, seed=seed)
            if is_mesh(source)
            else read_capture(source)
        )
        if capture.missing:
            progress.warn(f"{source}: {len(capture.missing)} frames have no photo and were left out")
        if holdout:
            capture = hold_out(capture, holdout)
        cut_out = masks == "alpha" and any(view.mask_path for view in capture.train)
        default = capture.aabb if not cut_out or capture.object_aabb is None else capture.object_aabb
        box = np.asarray(aabb if aabb is not None else default, np.float64)
        shape = VMShape(sh_degree=2 if colour == "mlp" else sh_degree)
        settings = replace(
            QUALITY[quality],
            shape=shape,
            seed=seed,
            time_budget=time_budget,
            colour=colour,
            target_psnr=target_psnr,
            opacity_weight=0.0 if capture.opaque and not cut_out else 0.1,
            near=0.0,
            device=place,
        )
        settings = replace(settings, longest=fitting_longest(box, settings, max_size, precision))
        needed = tensor_bytes(settings.shape, texels(box, settings.longest), precision)
        check_size(needed, max_size)
        check_space(output, needed)
        budget.expect(
            fit_memory(capture, box, settings), advice="use fewer or smaller photos, or a lower --quality"
        )
        loaded = load_photos(capture.train, masks)
        if loaded.ignored is not None and loaded.ignored.all():
            raise InvalidInput(f"{source}: the masks exclude every pixel; masks are black where to ignore")
        cameras, pictures = [camera_of(v) for v in capture.train], Pictures(loaded.pixels, loaded.ignored)
        run = FitRun.start(cameras, pictures, box, settings, Path(source).resolve().stem)
        if saved:
            run.restore(*saved)
        field, seconds = _run(run, output, progress)
        progress.phase("measuring", None)
        measured = measure(field, capture) if holdout else None
        size = write_field(output, field, Path(output).stem, precision=precision, overwrite=overwrite)
        checkpoint_path(output).unlink(missing_ok=True)
    reached = measured["psnr"] if measured else run.psnr
    report = {
        "output": output,
        "bytes": size,
        "kind": field.kind,
        "views": len(capture.train),
        "capture": capture.summary(),
        "aabb": box.tolist(),
        "steps": run.steps,
        "resolution": list(field.tensors[0].resolution),
        "seconds": {"training": seconds},
        "training_psnr": run.psnr,
        "holdout": measured,
        "memory": budget.report(),
        **run.guard.figures(),
    }
    if target_psnr is not None and reached < target_psnr:
        raise QualityNotReached(
            f"{output}: reached {reached:.2f} dB where --target-psnr asked for {target_psnr:g}; give more "
            "--time-budget or --quality high",
            report=report,
        )
    return report


def fit_memory(capture: Capture, box: np.ndarray, settings: FitSettings) -> dict[str, float]:
    """What a fit to a capture's photos over a box (6,) needs."""
    pixels = max(view.width * view.height for view in capture.train)
    cameras = len({camera_of(v).intrinsics for v in capture.train})
    return {
        **photos(len(capture.train), pixels, 1, cameras),
        **fitting(settings, box, torch.get_num_threads()),
    }


def _run(run: FitRun, output: str, progress) -> tuple[object, float]:
    """Train to the end; an interrupt leaves a checkpoint and goes on its way."""
    progress.phase("training", 1.0)
    started = time.monotonic()
    with resumable(output, run.checkpoint) as whole:
        field = run.finish(lambda share, figures: progress.advance(share, **figures), whole)
    warn_of_numbers(run.guard.figures(), progress)
    if not run.found_matter:
        progress.warn(
            f"{output}: no matter was found, so that all of the box was kept; look at the photos' alpha, "
            "their poses, and --aabb"
        )
    return field, time.monotonic() - started


def warn_of_numbers(figures: dict[str, int], progress) -> None:
    """Say that steps were not finite, where some were (`Guard.figures`)."""
    if figures:
        progress.warn(
            f"{figures['skipped_steps']} steps were not finite and were skipped; returned "
            f"{figures['roll_backs']} times to the last good state"
        )


def fitting_longest(aabb: np.ndarray, settings: FitSettings, max_size: int | None, precision: str) -> int:
    """Texels on the longest axis, fewer than the settings' where the file would grow past max_size
    (bytes).
    """
    longest = settings.longest
    while (
        max_size
        and longest > 16
        and tensor_bytes(settings.shape, texels(aabb, longest), precision) > max_size
    ):
        longest -= 4
    return longest


def tensor_bytes(shape: VMShape, resolution: tuple[int, int, int], precision: str) -> int:
    """The most bytes that a tensor's numbers take in a bundle."""
    return sum(coded_bytes(section, precision) for _, section in shape.sections(resolution))


def check_size(smallest: int, allowed: float | None) -> None:
    """UsageProblem where even the smallest output, in bytes, is more than --max-size allows its numbers."""
    if allowed is not None and smallest > allowed:
        raise UsageProblem(
            f"--max-size is too small: the coarsest numbers take {readable_size(smallest)} besides "
            "what tells where they are; give more"
        )


def camera_of(view: View) -> Camera:
    """A capture's view as the engine's camera."""
    return Camera(
        view.camera_to_world,
        view.fl_x,
        view.fl_y,
        view.cx,
        view.cy,
        view.width,
        view.height,
        tuple(view.distortion),
        view.name,
        view.fisheye,
    )


def measure(field, capture: Capture) -> dict:
    """Mean PSNR and SSIM of the held-out views over white, of the pixels that masks do not exclude."""
    figures = []
    for view in capture.test:
        truth = over_white(load_images([view]))[0]
        shot = render_image(field, camera_of(view)).over(WHITE)
        ignored = load_ignored(view)
        kept = slice(None) if ignored is None else ~ignored
        if ignored is not None:
            shot[ignored] = truth[ignored]
        if ignored is None or not ignored.all():
            figures.append((psnr(shot[kept], truth[kept]), ssim(shot, truth)))
    mean = np.mean(figures, 0) if figures else (float("nan"), float("nan"))
    return {"psnr": float(mean[0]), "ssim": float(mean[1]), "views": len(figures)}


def over_white(images: np.ndarray) -> np.ndarray:
    """(n, H, W, 4) uint8 straight alpha to (n, H, W, 3) float32 over white."""
    values = images.astype(np.float32) / 255
    return values[..., :3] * values[..., 3:] + 1 - values[..., 3:]
