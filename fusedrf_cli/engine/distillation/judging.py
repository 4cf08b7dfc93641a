"""PSNR of a student against its teacher: on views, to decide, and on rays, to follow."""

import numpy as np
import torch

from fusedrf_cli.engine.distillation.teacher import ask, random_rays
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.rendering.cameras import scattered
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image, render_rays

HELD_OUT = 1 << 12  # rays whose PSNR is the learning curve
HELD_OUT_SEED = 9_000_001
WHITE = np.ones(3)
JUDGED_SEED = 7_000_001  # views the student is judged on are drawn from a stream of their own


class Judge:
    """PSNR of a student against its teacher on seeded views that nothing was trained on."""

    def __init__(self, teacher: RadianceField, views: int, size: int, seed: int):
        box = teacher.occupancy.subject
        self.cameras = scattered(box, views, size, size, seed=JUDGED_SEED + seed)
        self.truth = [render_image(teacher, c).over(WHITE) for c in self.cameras]

    def __call__(self, student: RadianceField) -> float:
        """PSNR in dB of all pixels of all views together, over white."""
        return psnr(
            np.stack([render_image(student, c).over(WHITE) for c in self.cameras]), np.stack(self.truth)
        )


class HeldOut:
    """PSNR of a student on a few rays that nothing is trained on: quick to ask, for curves and schedules."""

    def __init__(self, teacher: RadianceField, boxes: list[np.ndarray], step: float, seed: int):
        generator = torch.Generator().manual_seed(HELD_OUT_SEED + seed)
        self.rays, self.step = random_rays(boxes, HELD_OUT, generator), step
        self.truth = over_white(ask(teacher, *self.rays, step, generator).pixels.numpy())

    def __call__(self, student: RadianceField) -> float:
        """PSNR in dB of all rays together, over white."""
        return psnr(over_white(render_rays(student, *self.rays, step=self.step)), self.truth)


def over_white(pixels: np.ndarray) -> np.ndarray:
    """(N, 3) of pixels (N, 4 or more): rgb premultiplied by opacity, opacity."""
    return pixels[:, :3] + 1 - pixels[:, 3:4]
