"""Distil any radiance field into a student of any kind (FusedRF; PVD for one teacher).

Three phases: ask the teacher on rays through it, fit the student's σ and colour at the points of those rays
(3D losses), at half the resolution first, then pass over the rays themselves (RGB loss) at a far lower rate,
kept only if the student got better on views of its own.
"""

import weakref
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

import numpy as np
import torch

from fusedrf_cli.engine.distillation.evaluation import HoldOutRays, scattered_evaluator
from fusedrf_cli.engine.distillation.losses import (
    point_step,
)
from fusedrf_cli.engine.distillation.nan_guard import NanGuard
from fusedrf_cli.engine.distillation.occupancy_update import OccupancyUpdateConfig, prune_low_density
from fusedrf_cli.engine.distillation.optimiser import Adam, alike
from fusedrf_cli.engine.distillation.ray_dataset import TeacherRays
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.distillation.schedule import Schedule
from fusedrf_cli.engine.distillation.shuffle import Shuffle
from fusedrf_cli.engine.distillation.student import halved, pruned, resampled_like, starts_coarse
from fusedrf_cli.engine.distillation.teacher import (
    TeacherSamples,
    query_teacher,
    render_teacher,
)
from fusedrf_cli.engine.fields.base import RadianceField, StoredField, sampling_step
from fusedrf_cli.engine.kernels import working_time
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.settings import current


@dataclass
class DistillReport:
    """What a distillation did."""

    seconds: dict[str, float] = field(default_factory=dict)
    psnr_before_rgb: float = float("nan")
    psnr_after_rgb: float | None = None
    rgb_kept: bool | None = None
    found_nothing: bool = False
    """Whether the student held no density after the points, so that the teacher's occupancy was kept."""
    steps: dict[str, int] = field(default_factory=dict)
    """Steps made, by phase."""
    curve: list[tuple[float, int, float]] = field(default_factory=list)
    """(seconds since the start, steps of all phases, PSNR in dB on rays that nothing is trained on)."""
    numeric: dict[str, int] = field(default_factory=dict)
    """Steps skipped and returns to a good state, where there were any (nan_guard.py)."""


def distill(
    teacher: RadianceField,
    student: StoredField,
    sampler: RaySampler,
    config: DistilConfig,
    rgb: bool = True,
    phase: Callable[[str], None] = lambda name: None,
    advance: Callable[[float, dict], None] = lambda share, figures: None,
) -> tuple[StoredField, DistillReport]:
    """Teach a student in the teacher's frame, in which the sampler draws rays.

    Raises FloatingPointError when the student's numbers do not stay finite.
    """
    return DistillRun(teacher, student, sampler, config, rgb).finish(phase, advance)


class DistillRun:
    """The moving parts of one distillation, which can be saved between two steps and taken up again.

    What the teacher was asked is not saved: the same seed asks the same.
    """

    def __init__(
        self,
        teacher: RadianceField,
        student: StoredField,
        sampler: RaySampler,
        config: DistilConfig,
        rgb: bool = True,
        evaluator: Callable[[StoredField], float] | None = None,
    ):
        """The arguments are those of `distill`. The evaluator says how near a student comes, in dB; None: one
        of the same teacher and config.
        """
        self.teacher, self.sampler, self.rgb, self.evaluator = teacher, sampler, rgb, evaluator
        self.config, self.step = config, sampling_step(student)
        coarse = config.steps > 0 and starts_coarse(student, config.coarse_from)
        self.student, self.refined = (halved(student), student) if coarse else (student, None)
        """What learns now, and, while that is coarse, the student whose resolution it will take."""
        self.generator = torch.Generator()
        self.report = DistillReport()
        self.optimiser = Adam.of(self.student)
        itself = weakref.ref(self)  # a circle of references would keep hundreds of megabytes for longer
        self.nan_guard = NanGuard(lambda: itself().optimiser.numbers())
        self.phase, self.steps, self.elapsed = "points", 0, 0.0
        self.points_seconds = 0.0
        """That points took, once they are done."""
        self.learnt_seconds = 0.0
        """That this process has learnt for."""
        self.schedule = Schedule(config)
        self.began = working_time()
        self.before: torch.Tensor | None = None
        """The student's numbers before the RGB phase."""
        self.shuffle, self.count = Shuffle(config.rays, self.generator), config.rays_at_first
        self.held: tuple[dict[str, np.ndarray], dict] | None = None
        """What `checkpoint` says between the steps, where other things may take long."""
        self.asked, self.random = False, None
        """Whether the teacher was asked, and the state the generator has to be in then; None: as it is."""
        self.rays: tuple[int, int] | None = None
        """Along how many rays it was asked for points, and how many it showed; None: as there is time for."""

    def finish(
        self,
        phase: Callable[[str], None] = lambda name: None,
        advance: Callable[[float, dict], None] = lambda share, figures: None,
        uninterrupted: Callable[[], AbstractContextManager] = nullcontext,
    ) -> tuple[StoredField, DistillReport]:
        """Run to the end. Every step happens inside an `uninterrupted()`, which may hold an interrupt
        back."""
        report, config = self.report, self.config
        self.began = working_time() - (report.curve[-1][0] if report.curve else 0.0)
        clock = _Clock(report.seconds)
        self.held = self.checkpoint()
        phase("asking the teachers")
        self.generator.manual_seed(config.seed + 1)
        evaluator = self.evaluator or scattered_evaluator(
            self.teacher, config.views, config.view_size, config.seed
        )
        dataset, shown = self._ask()
        held_out = HoldOutRays(self.teacher, self.sampler, self.step, config.seed)
        if self.random is not None:
            self.generator.set_state(self.random)
        self.asked = True
        clock.lap("teachers")
        if self.phase == "points":
            phase("points")
            if len(dataset.points) and config.steps:
                self._learn(PointPass(dataset, self), config.steps, held_out, advance, uninterrupted)
            with uninterrupted():
                self._begin_pictures()
                report.psnr_before_rgb = evaluator(self.student)
            clock.lap("points")
        if self.rgb:
            phase("pictures")
            self._learn(RayPass(shown, self), config.rgb_steps, held_out, advance, uninterrupted)
            report.steps["pictures"] = self.steps
            report.psnr_after_rgb = evaluator(self.student)
            report.rgb_kept = report.psnr_after_rgb > report.psnr_before_rgb
            if not report.rgb_kept:
                self.student.params.copy_(self.before)
            clock.lap("pictures")
        with uninterrupted():
            self._prune_low_density(dataset)
        self.held = None
        report.numeric = self.nan_guard.figures()
        return self.student, report

    def _ask(self) -> tuple[TeacherSamples, TeacherSamples]:
        """What the teacher says along rays with points on them, and along all rays that pictures are learnt
        from: along the same as before an interrupt, else along those that there is time for."""
        config, before, began = self.config, self.rays, working_time()
        seconds = np.inf if config.time_budget is None else config.asking * config.time_budget

        def enough(asked: int) -> bool:
            return working_time() - began > seconds

        def enough_points(asked: int) -> bool:
            return enough(asked) if before is None else asked >= before[0]

        def enough_shown(asked: int) -> bool:
            return enough(asked) if before is None else asked + len(points.rays_o) >= before[1]

        rays = self.sampler.draw(config.rays, self.generator)
        if config.steps:
            points = query_teacher(self.teacher, *rays, self.step, self.generator, enough_points)
        else:
            points = render_teacher(self.teacher, *rays, enough_points)
        shown, more = points, (config.rgb_rays or 0) - len(points.rays_o)
        if more > 0 and self.rgb:
            rays = self.sampler.draw(more, self.generator)
            shown = points.and_rendered(render_teacher(self.teacher, *rays, enough_shown))
        self.rays = len(points.rays_o), len(shown.rays_o)
        self.shuffle.count = self.rays[1]
        return points, shown

    def _begin_pictures(self) -> None:
        """What was learnt from points is the RGB phase's start, and what it has to surpass."""
        if self.refined is not None:
            self._refine()
        self.nan_guard.check()
        self.before = self.student.params.clone()
        self._prune()
        if self.config.steps:  # else nothing was learnt before
            self.optimiser = Adam.of(self.student)
            self.nan_guard.renew()
        self.report.steps["points"] = self.steps
        self.phase, self.steps, self.points_seconds, self.elapsed = "pictures", 0, self.elapsed, 0.0
        self.schedule = Schedule(self.config)

    def _refine(self) -> None:
        """Go on at the full resolution, with moments that start anew."""
        self.nan_guard.check()
        self.student, self.refined = resampled_like(self.student, self.refined), None
        self.optimiser = Adam.of(self.student)
        self.nan_guard.renew()

    def _has_prunable_cells(self) -> bool:
        """Whether the student learnt where there is nothing; only one on one grid over its own box did."""
        return self.student.resolution is not None and self.config.steps > 0

    def _prune_low_density(self, dataset: TeacherSamples) -> None:
        """Leave out the room that cells had for density to grow into, as `prune_low_density` does; what it
        shows is held against the teacher's pictures."""
        config = current(OccupancyUpdateConfig)
        if self._has_prunable_cells() and not self.report.found_nothing:
            rays = dataset.rays_o[: config.rays_that_judge], dataset.rays_d[: config.rays_that_judge]
            truth = dataset.pixels[: config.rays_that_judge].numpy()
            self.student = self.student.with_occupancy(prune_low_density(self.student, *rays, truth=truth))

    def _prune(self) -> None:
        """Leave out the cells that turned out empty, unless that would be all of them."""
        if not self._has_prunable_cells():
            return
        occupancy = pruned(self.student)
        self.report.found_nothing = bool(self.teacher.occupancy.occupied.any() > occupancy.occupied.any())
        if not self.report.found_nothing:
            self.student = self.student.with_occupancy(occupancy)

    def _learn(
        self,
        gradient: "PointPass | RayPass",
        steps: int,
        held_out: HoldOutRays,
        advance: Callable,
        uninterrupted: Callable,
    ) -> None:
        """The steps of one phase."""
        entered = working_time()
        started = entered - self.elapsed
        self.held = None
        while (share := self._share(steps, working_time() - started)) < self.schedule.end:
            with uninterrupted():
                if self.refined is not None and share >= self.config.coarse_until:
                    self._refine()
                self.nan_guard.keep()
                sums, figures = gradient()
                self.nan_guard.step(sums, self.optimiser, gradient.rate * self.schedule.factor(share))
                self.steps += 1
                if self.steps % self.config.look_every == 0:
                    self._measure(held_out, share)
                self.elapsed = working_time() - started
            if self.steps % 20 == 1:
                advance(share / self.schedule.end, figures)
        self.learnt_seconds += working_time() - entered
        self.nan_guard.check()
        self.held = self.checkpoint()

    def _measure(self, held_out: HoldOutRays, share: float) -> None:
        """A point of the learning curve, which the schedule follows."""
        psnr = held_out(self.student)
        if self.refined is None:
            self.schedule.observe(share, psnr)
        steps = self.steps + self.report.steps.get("points", 0)
        self.report.curve.append((working_time() - self.began, steps, psnr))

    def _share(self, steps: int, seconds: float) -> float:
        """The share of the phase that is done: of its steps, or of its seconds where a budget is given, of
        which points have a part at most where pictures follow."""
        if not steps:
            return self.schedule.end
        config = self.config
        if config.time_budget is None:
            return self.steps / steps
        whole, then = config.time_budget, self.rgb and config.rgb_steps
        if self.phase == "points":
            of_steps = self.steps / steps if then and config.enough_steps else 0.0
            whole *= config.points_part if then else 1.0
        else:
            of_steps, whole = 0.0, whole - self.points_seconds
        return max(of_steps, seconds / whole) if whole > 0 else self.schedule.end

    def checkpoint(self) -> tuple[dict[str, np.ndarray], dict]:
        """Arrays and JSON-able state from which `restore` goes on as if nothing had happened."""
        arrays, drawn = self.shuffle.state()
        arrays |= {"params": self.student.params.cpu().numpy()} | self.optimiser.state()
        random = self.generator.get_state() if self.asked else self.random
        if random is not None:
            arrays["random"] = random.numpy()
        if self.before is not None:
            arrays["before"] = self.before.cpu().numpy()
        state = {
            "command": "fuse",
            "phase": self.phase,
            "steps": self.steps,
            "elapsed": self.elapsed,
            "points_seconds": self.points_seconds,
            "adam_steps": self.optimiser.steps,
            "psnr_before_rgb": self.report.psnr_before_rgb,
            "rays": self.count,
            "asked": self.rays and self.rays[0],
            "shown": self.rays and self.rays[1],
            "guard": self.nan_guard.state(),
            "schedule": self.schedule.state(),
            "coarse": self.refined is not None,
            "points_steps": self.report.steps.get("points"),
            "curve": self.report.curve,
            **drawn,
        }
        return arrays, state

    def restore(self, arrays: dict[str, np.ndarray], state: dict) -> None:
        """Take up a run that `checkpoint` saved, over the same teacher and config. Raises ValueError,
        KeyError, TypeError or RuntimeError for what is none."""
        if state["phase"] != ("pictures" if "before" in arrays else "points"):
            raise ValueError(f"the phase {state['phase'][:40]!r}, but pictures begin with the numbers before")
        if self.refined is not None and not state["coarse"]:
            self._refine()
        if "before" in arrays:
            self._take("before", arrays)
            self._begin_pictures()
            self.report.psnr_before_rgb = float(state["psnr_before_rgb"])
            self.report.steps["points"] = state["points_steps"]
        self._take("params", arrays)
        self.optimiser.restore(arrays, state["adam_steps"])
        self.count = state["rays"]
        self.phase, self.steps, self.elapsed = state["phase"], state["steps"], max(state["elapsed"], 0)
        self.points_seconds = max(state["points_seconds"], 0)
        self.nan_guard.restore(state["guard"])
        self.schedule.restore(state["schedule"])
        self.report.curve = [(float(at), int(steps), float(psnr)) for at, steps, psnr in state["curve"]]
        if state["asked"] is not None:
            self.rays = int(state["asked"]), int(state["shown"])
            self.shuffle.count = self.rays[1]
        self.shuffle.restore(arrays, state)
        self.random = torch.from_numpy(arrays["random"]) if "random" in arrays else None
        if self.random is not None:
            torch.Generator().set_state(self.random)  # a RuntimeError now rather than later

    def _take(self, name: str, arrays: dict[str, np.ndarray]) -> None:
        params = self.student.params
        params.copy_(torch.from_numpy(alike(arrays[name], params, name)))


class _Clock:
    """Seconds per phase."""

    def __init__(self, seconds: dict[str, float]):
        self.seconds, self.last = seconds, working_time()

    def lap(self, name: str) -> None:
        now = working_time()
        self.seconds[name], self.last = now - self.last, now


class PointPass:
    """The 3D losses at the points of the pool, in its random order (losses.py)."""

    def __init__(self, dataset: TeacherSamples, run: DistillRun):
        self.pool, self.run, self.rate = dataset, run, run.config.rate

    def __call__(self) -> tuple[np.ndarray, dict]:
        """Leave the gradient of the next points with the optimiser; the losses, and figures to tell."""
        run = self.run
        points = self.pool.points.batch(run.steps, run.config.points_per_step)
        loss = point_step(run.student, points, run.step, run.optimiser)
        return np.array([loss]), {"loss": loss}


class RayPass:
    """The RGB loss over the teacher's own rays, colour over white and opacity."""

    def __init__(self, dataset: TeacherSamples, run: DistillRun):
        self.run, self.rate = run, run.config.rgb_rate
        self.rays = TeacherRays(dataset.rays_o, dataset.rays_d, dataset.pixels.numpy(), run.shuffle)

    def __call__(self) -> tuple[np.ndarray, dict]:
        """Leave the gradient of the next rays with the optimiser; the losses, and figures to tell."""
        run, config = self.run, self.run.config
        batch = self.rays.batch(run.count, run.step, config.opacity_weight, config.early_stop)
        sums, count = run.optimiser.learn_rays(batch), len(batch.rays_o)
        target = config.rgb_samples * count / max(sums[2], 1)
        run.count = int(np.clip(0.9 * run.count + 0.1 * target, 256, 1 << 14))
        return sums, {"psnr": float(-10 * np.log10(max(sums[0] / count, 1e-10)))}
