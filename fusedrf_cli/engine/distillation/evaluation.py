"""PSNR of a student against its teacher: on views, to decide, and on rays, to follow."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.distillation.teacher import query_teacher
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.rendering.cameras import Camera, scattered
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image, render_rays
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class EvaluatorConfig:
    """What a student is judged on."""

    held_out: int = 1 << 12
    """Rays whose PSNR is the learning curve."""
    held_out_seed: int = 9_000_001
    covered: float = 0.5
    """Of a pixel's light that a scene keeps from what is behind it."""
    judged_seed: int = 7_000_001
    """Views the student is judged on are drawn from a stream of their own."""


@dataclass(frozen=True)
class Evaluation:
    """How like its teacher a student is, PSNR in dB over white."""

    psnr: float
    """Of all pixels of all views together."""
    covered: float | None
    """Of those in which the teacher shows something; None: there are none."""
    share: float
    """How much of the views is covered."""
    views: tuple[float, ...]
    """Of each view."""


class Evaluator:
    """PSNR of a student against its teacher on views that nothing was trained on."""

    def __init__(self, teacher: RadianceField, cameras: Sequence[Camera], origin: np.ndarray | None = None):
        """Cameras of one size, in the world; origin: where the frame of teacher and student lies in it (see
        `render_image`)."""
        self.cameras, self.origin = cameras, origin
        shots = [render_image(teacher, camera, origin=origin) for camera in cameras]
        self.truth = np.stack([shot.over() for shot in shots])
        self.covered = np.stack([shot.opacity > current(EvaluatorConfig).covered for shot in shots])

    def shots(self, student: RadianceField) -> np.ndarray:
        """(views, H, W, 3) over white."""
        return np.stack([render_image(student, c, origin=self.origin).over() for c in self.cameras])

    def __call__(self, student: RadianceField) -> float:
        """PSNR in dB of all pixels of all views together, over white."""
        return psnr(self.shots(student), self.truth)

    def evaluate(self, student: RadianceField) -> Evaluation:
        """The same, and what it hides."""
        shots, seen = self.shots(student), self.covered
        covered = psnr(shots[seen], self.truth[seen]) if seen.any() else None
        each = tuple(psnr(*pair) for pair in zip(shots, self.truth, strict=True))
        return Evaluation(psnr(shots, self.truth), covered, float(seen.mean()), each)


def scattered_evaluator(teacher: RadianceField, views: int, size: int, seed: int) -> Evaluator:
    """A judge by seeded views from around a teacher's density."""
    config = current(EvaluatorConfig)
    cameras = scattered(teacher.occupancy.look_at_box, views, size, size, seed=config.judged_seed + seed)
    return Evaluator(teacher, cameras)


class HoldOutRays:
    """PSNR of a student on a few rays that nothing is trained on: quick to ask, for curves and schedules."""

    def __init__(self, teacher: RadianceField, sampler: RaySampler, step: float, seed: int):
        config = current(EvaluatorConfig)
        generator = torch.Generator().manual_seed(config.held_out_seed + seed)
        self.rays, self.step = sampler.draw(config.held_out, generator), step
        self.truth = over_white(query_teacher(teacher, *self.rays, step, generator).pixels.numpy())

    def __call__(self, student: RadianceField) -> float:
        """PSNR in dB of all rays together, over white."""
        return psnr(over_white(render_rays(student, *self.rays, step=self.step)), self.truth)


def over_white(pixels: np.ndarray) -> np.ndarray:
    """(N, 3) of pixels (N, 4 or more): rgb premultiplied by opacity, opacity."""
    return pixels[:, :3] + 1 - pixels[:, 3:4]
