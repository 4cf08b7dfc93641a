"""Photos whose poses were refined while a field was learnt from them: where they were taken from now, and
what that is worth on photos that the field has not seen, whose poses are as inexact."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from formats.views import Capture
from fusedrf_cli.bridge.pictures import camera_of, truth_of
from fusedrf_cli.bridge.scene_bounds import SceneBounds
from fusedrf_cli.engine.distillation.fit import FitRun
from fusedrf_cli.engine.distillation.poses import (
    Poses,
    angles_between,
    changed_each,
    poses_of,
    refined,
)
from fusedrf_cli.engine.distillation.ray_dataset import Pictures, RayDataset
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class PoseRefinementConfig:
    """How the poses of held-out photos are found."""

    rounds: int = 12
    aligned_by: tuple[float, float] = (4.0, 0.5)
    """Pixels by which poses are tried: at first, at last."""
    rays: int = 600
    """Of each photo."""


def with_poses(capture: Capture, bounds: SceneBounds, poses: Poses) -> Capture:
    """A capture whose training photos were taken from poses in the field's frame."""
    views = []
    for view, rotation, position in zip(capture.train, *poses, strict=True):
        matrix = np.eye(4)
        turn = bounds.origin[:3, :3]
        matrix[:3, :3], matrix[:3, 3] = turn / bounds.unit @ rotation, turn @ position + bounds.centre
        views.append(replace(view, camera_to_world=matrix))
    return replace(capture, train=tuple(views))


def moved(run: FitRun, cameras: list[Camera], bounds: SceneBounds) -> dict[str, float]:
    """By how many degrees, and how far in the world, the median camera is from where it was said to be."""
    before, now = poses_of(cameras), run.pool.poses
    return {
        "turned_degrees": float(np.degrees(np.median(angles_between(before, now)))),
        "moved": float(np.median(np.linalg.norm(now.position - before.position, axis=1)) * bounds.unit),
    }


def aligned(field, capture: Capture, bounds: SceneBounds, near: float, seed: int) -> dict[str, float] | None:
    """PSNR in dB, means over the right halves of the held-out photos, in the pixels that their masks keep:
    with the poses that suit their left halves best, and `unaligned` with those that they came with. None
    where no photo has pixels in both halves."""
    shots = [truth_of(view) for view in capture.test]
    cameras = [bounds.camera(camera_of(view)) for view in capture.test]
    halves = [np.arange(mask.shape[1]) < mask.shape[1] // 2 for _, mask in shots]
    usable = [
        (mask & half).any() and (mask & ~half).any() for (_, mask), half in zip(shots, halves, strict=True)
    ]
    rows = []
    for camera, (truth, mask), half, there in zip(cameras, shots, halves, usable, strict=True):
        if there:
            best_camera = align(field, camera, truth, mask & half, near, seed)
            judged = mask & ~half
            row = [render_image(field, c).over() for c in (best_camera, camera)]
            rows.append([psnr(shot[judged], truth[judged]) for shot in row])
    if not rows:
        return None
    best, unaligned = np.mean(rows, 0)
    return {"psnr": float(best), "unaligned": float(unaligned), "views": len(rows)}


def align(field, camera: Camera, truth: np.ndarray, learnt: np.ndarray, near: float, seed: int) -> Camera:
    """The camera near one of the field's frame from which the field shows the pixels `learnt` (H, W) of a
    photo (H, W, 3) best."""
    config = current(PoseRefinementConfig)
    generator = torch.Generator().manual_seed(seed)
    pixels = np.concatenate([np.rint(255 * truth), np.full((*learnt.shape, 1), 255)], -1).astype(np.uint8)
    pool = RayDataset([camera], Pictures(pixels.reshape(-1, 4), ~learnt.reshape(-1)), generator)
    first, last = config.aligned_by
    for number in range(config.rounds):
        *rays, colours = pool.sample(config.rays, generator)
        probe = first * (last / first) ** (number / (config.rounds - 1)) * pool.pixel
        pool.set_poses(changed_each(pool.poses, refined(field, rays, colours, near, probe)))
    matrix = camera.camera_to_world.copy()
    matrix[:3, :3], matrix[:3, 3] = pool.rotation[0].numpy(), pool.position[0].numpy()
    return replace(camera, camera_to_world=matrix)
