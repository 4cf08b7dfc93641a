"""Finetuning: a field that was made smaller learns from rendered rays what resampling and truncation cost."""

from collections.abc import Callable
from dataclasses import dataclass

import torch

from fusedrf_cli.engine.distillation.nan_guard import NanGuard
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.distillation.ray_dataset import TeacherRays
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.distillation.shuffle import Shuffle
from fusedrf_cli.engine.fields.base import RadianceField, StoredField, sampling_step
from fusedrf_cli.engine.kernels import working_time
from fusedrf_cli.engine.rendering.volume import render_rays
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class FinetuneConfig:
    """How a field is finetuned."""

    rays: int = 200_000
    """That are drawn and shown once, for all fields."""
    steps: int = 160
    rays_per_step: int = 3000
    rate: float = 3e-3
    """Of the first step."""
    rate_decay: float = 0.1
    """The last step's rate over the first's."""
    opacity_weight: float = 0.1
    """Against the colour."""
    early_stop: float = 1e-3
    """Transmittance at which a ray ends."""


class FinetuneRays:
    """Seeded rays around a scene and its objects, and what a teacher shows along them."""

    def __init__(
        self,
        teacher: RadianceField,
        sampler: RaySampler,
        seed: int,
        rays: int | None = None,
        share: float = 1.0,
    ):
        """The sampler draws rays, as many as the config says by default, in the teacher's frame. share: of
        the rays, and of those of a step, where the teacher is one of several that share them."""
        self.seed, self.config = seed, current(FinetuneConfig)
        self.rays_per_step = max(1, round(share * self.config.rays_per_step))
        generator = torch.Generator().manual_seed(seed)
        self.rays_o, self.rays_d = sampler.draw(rays or max(1, round(share * self.config.rays)), generator)
        self.shown = render_rays(teacher, self.rays_o, self.rays_d)[:, :4]
        """(R, 4) float32, premultiplied."""

    def teach(
        self,
        student: StoredField,
        steps: int | None = None,
        seconds: float | None = None,
        advance: Callable[[float], None] = lambda share: None,
    ) -> None:
        """Steps (default: the config's) of Adam on a student's numbers, in place, by the squared error of
        colour over white and of opacity; fewer where the seconds are over before. Raises FloatingPointError
        when the numbers do not stay finite.
        """
        config, optimiser = self.config, Adam.of(student)
        steps = steps or config.steps
        epochs = Shuffle(len(self.rays_o), torch.Generator().manual_seed(self.seed + 1))
        rays = TeacherRays(self.rays_o, self.rays_d, self.shown, epochs)
        guard = NanGuard(optimiser.numbers)
        how = sampling_step(student), config.opacity_weight, config.early_stop
        started, share = working_time(), 0.0
        for i in range(steps):
            share = i / steps if seconds is None else max(i / steps, (working_time() - started) / seconds)
            if share >= 1:
                break
            guard.keep()
            sums = optimiser.learn_rays(rays.batch(self.rays_per_step, *how))
            guard.step(sums, optimiser, config.rate * config.rate_decay**share)
            advance((i + 1) / steps)
        guard.check()
