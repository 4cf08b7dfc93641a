"""Finishing: a field that was made smaller learns from rendered rays what resampling and truncation cost."""

from collections.abc import Callable

import numpy as np
import torch

from fusedrf_cli.engine.distillation.epochs import Epochs
from fusedrf_cli.engine.distillation.fit import EARLY_STOP
from fusedrf_cli.engine.distillation.guard import Guard
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.fields.base import RadianceField, StoredField, sampling_step
from fusedrf_cli.engine.fields.computed import Batch
from fusedrf_cli.engine.kernels import working_time
from fusedrf_cli.engine.rendering.volume import render_rays

RATE, RATE_DECAY = 3e-3, 0.1
RAYS = 200_000
RAYS_PER_STEP = 3000
STEPS = 160
OPACITY_WEIGHT = 0.1


class RayLesson:
    """Seeded rays around a scene and its objects, and what a teacher shows along them."""

    def __init__(self, teacher: RadianceField, sampler: RaySampler, seed: int, rays: int = RAYS):
        """The sampler draws rays in the teacher's frame."""
        self.seed = seed
        generator = torch.Generator().manual_seed(seed)
        self.rays_o, self.rays_d = sampler.draw(rays, generator)
        shown = render_rays(teacher, self.rays_o, self.rays_d)
        self.target = shown[:, :4].copy()
        """(R, 4) float32: colour over white, opacity."""
        self.target[:, :3] += 1 - self.target[:, 3:]

    def teach(
        self,
        student: StoredField,
        steps: int | None = None,
        seconds: float | None = None,
        advance: Callable[[float], None] = lambda share: None,
    ) -> None:
        """Steps (default: STEPS) of Adam on a student's numbers, in place, by the squared error of colour
        over white and of opacity; fewer where the seconds are over before. Raises FloatingPointError when the
        numbers do not stay finite.
        """
        steps = steps or STEPS
        generator = torch.Generator().manual_seed(self.seed + 1)
        epochs, optimiser = Epochs(len(self.rays_o), generator), Adam.of(student)
        guard = Guard(optimiser.numbers)
        step, white = sampling_step(student), np.ones((RAYS_PER_STEP, 3), np.float32)
        started, share = working_time(), 0.0
        for i in range(steps):
            share = i / steps if seconds is None else max(i / steps, (working_time() - started) / seconds)
            if share >= 1:
                break
            guard.keep()
            chosen = epochs.draw(RAYS_PER_STEP).numpy()
            jitter = torch.rand(len(chosen), generator=generator, dtype=torch.float64).numpy()
            loss = np.zeros((optimiser.parts, 3))
            rays = self.rays_o[chosen], self.rays_d[chosen], jitter, self.target[chosen], white[: len(chosen)]
            batch = Batch(*rays, OPACITY_WEIGHT, 0.0, step, EARLY_STOP)
            student.train_rays(batch, optimiser.grads, loss)
            if guard.accepts(loss.sum(0), optimiser):
                optimiser.step(RATE * RATE_DECAY**share * guard.rate)
            advance((i + 1) / steps)
        guard.check()
