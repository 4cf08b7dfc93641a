"""Distil any radiance field into a VM student (FusedRF; PVD for one teacher).

Three phases: ask the teacher on rays through it, fit the student's σ and colour at the points of those rays
(3D losses), then a
few passes over the rays themselves (RGB loss) at a tenth of the rate, kept only if the student got better on
views of its own.
"""

import time
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.blocks import reshaped
from fusedrf_cli.engine.distillation.epochs import Epochs
from fusedrf_cli.engine.distillation.fit import EARLY_STOP, EMPTY_BELOW, texels
from fusedrf_cli.engine.distillation.guard import Guard
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.distillation.teacher import TeacherPool, ask, random_rays
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, harmless_depth
from fusedrf_cli.engine.fields.vm import PROBES, Block, VMField, VMShape, VMTensor
from fusedrf_cli.engine.rendering.cameras import scattered
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image

RATE = 0.02
RATE_DECAY = 0.1
RGB_RATE = 0.1 * RATE
OPAQUE = 5.0  # optical depth of a step beyond which more density cannot be seen
DEPTH_GAIN = 10.0  # in log1p(gain τ): how much thin fog counts
FAINT = 1e-8  # optical depth of a step under which a student that should be denser learns as if it had it
MOST_LIFT = 1e30
COLOUR_WEIGHT = 2.0
OPACITY_WEIGHT = 0.1
POINTS_PER_STEP = 1 << 15
RAYS_AT_FIRST = 1024
LOST_DEPTH = 5e-3  # optical depth that pruning may take off a ray: opacity to half a percent
WHITE = np.ones(3)
JUDGED_SEED = 7_000_001  # views the student is judged on are drawn from a stream of their own


@dataclass(frozen=True)
class DistillSettings:
    """What a distillation is asked for."""

    shape: VMShape = VMShape(16, 24, 2)
    max_numbers: int = 12_000_000
    """Numbers the student may have; its resolution follows."""
    rays: int = 400_000
    steps: int = 1200
    rgb_steps: int = 1500
    rgb_samples: int = 1 << 15
    time_budget: float | None = None
    """Seconds of learning, half for points and half for rays where there is an RGB phase. None: the steps
    decide, and equal seeds give equal bytes.
    """
    seed: int = 0
    views: int = 4
    view_size: int = 160


@dataclass
class DistillReport:
    """What a distillation did."""

    seconds: dict[str, float] = field(default_factory=dict)
    psnr_before_rgb: float = float("nan")
    psnr_after_rgb: float | None = None
    rgb_kept: bool | None = None
    found_nothing: bool = False
    """Whether the student held no matter after the points, so that the teacher's occupancy was kept."""
    numeric: dict[str, int] = field(default_factory=dict)
    """Steps skipped and returns to a good state, where there were any (guard.py)."""


class Judge:
    """PSNR of a student against its teacher on seeded views that nothing was trained on."""

    def __init__(self, teacher: RadianceField, views: int, size: int, seed: int):
        box = teacher.occupancy.tight_aabb(0)
        self.cameras = scattered(box, views, size, size, seed=JUDGED_SEED + seed)
        self.truth = [render_image(teacher, c).over(WHITE) for c in self.cameras]

    def __call__(self, student: RadianceField) -> float:
        """PSNR in dB of all pixels of all views together, over white."""
        return psnr(
            np.stack([render_image(student, c).over(WHITE) for c in self.cameras]), np.stack(self.truth)
        )


def resolution_for(aabb: np.ndarray, finest: float, shape: VMShape, max_numbers: int) -> tuple[int, int, int]:
    """Texels per axis: voxels no finer than the teachers' own, and no more numbers than allowed."""
    longest = int(np.ceil((aabb[3:] - aabb[:3]).max() / finest)) + 1
    while longest > 16 and shape.size(texels(aabb, longest)) > max_numbers:
        longest -= max(1, longest // 100)
    return texels(aabb, longest)


def empty_student(
    teacher: RadianceField, settings: DistillSettings, generator: torch.Generator, name: str
) -> VMField:
    """An untrained student over the teacher's box, whose occupancy is the teacher's."""
    box = teacher.occupancy.aabb
    resolution = resolution_for(box, teacher.voxel_size, settings.shape, settings.max_numbers)
    student = VMField.create(box, resolution, settings.shape, generator, name)
    return student.with_occupancy(teacher.occupancy)


def student_from(
    background: Placed, teacher: RadianceField, settings: DistillSettings, generator: torch.Generator
) -> VMField | None:
    """A student over the teacher's box that starts as the background (FusedRF §3), or None where that cannot
    be taken over.

    A VM decomposition follows its axes, so the background must be placed upright: moved and uniformly scaled
    only.
    """
    linear = background.object_to_world[:3, :3]
    scale = linear[0, 0]
    if type(background.field) is not VMField or len(background.field.blocks) != 1 or scale <= 0:
        return None
    if not np.allclose(linear, scale * np.eye(3), atol=1e-9 * scale):
        return None
    source = background.field.tensors[0]
    placed_box = source.aabb * scale + np.tile(background.object_to_world[:3, 3], 2)
    tensor = VMTensor(source.resolution, placed_box, source.scale / scale, source.shift)
    moved = VMField(
        background.field.shape,
        (tensor,),
        (Block(0, np.eye(4), "fused"),),
        background.field.params,
        OccupancyGrid.full(placed_box),
    )
    shape = VMShape(
        *(max(a, b) for a, b in zip(vars(moved.shape).values(), vars(settings.shape).values(), strict=True))
    )
    box = teacher.occupancy.aabb
    resolution = resolution_for(box, teacher.voxel_size, shape, settings.max_numbers)
    student = reshaped(moved, shape).resampled(box, resolution).with_occupancy(teacher.occupancy)
    wake(student, generator)
    return student


def wake(student: VMField, generator: torch.Generator) -> None:
    """Small noise on every factor: where plane and line are both 0 the gradient of their product is too, for
    ever.
    """
    for name, section in student.sections(0).items():
        if name != "colour_basis":
            section += 0.03 * torch.randn(section.shape, generator=generator)


def distill(
    teacher: RadianceField,
    student: VMField,
    boxes: list[np.ndarray],
    settings: DistillSettings,
    rgb: bool = True,
    phase: Callable[[str], None] = lambda name: None,
    advance: Callable[[float, dict], None] = lambda share, figures: None,
) -> tuple[VMField, DistillReport]:
    """Teach a one-block VM student in the teacher's frame; boxes are the scene's and the objects' (6,), for
    sampling.

    Raises FloatingPointError when the student's numbers do not stay finite.
    """
    return DistillRun(teacher, student, boxes, settings, rgb).finish(phase, advance)


class DistillRun:
    """The moving parts of one distillation, which can be saved between two steps and taken up again.

    What the teacher was asked is not saved: the same seed asks the same.
    """

    def __init__(
        self,
        teacher: RadianceField,
        student: VMField,
        boxes: list[np.ndarray],
        settings: DistillSettings,
        rgb: bool = True,
    ):
        """The arguments are those of `distill`."""
        self.teacher, self.student, self.boxes, self.rgb = teacher, student, boxes, rgb
        self.settings, self.step = settings, 0.5 * student.voxel_size
        self.generator = torch.Generator()
        self.report = DistillReport()
        self.optimiser = Adam.of(student)
        self.guard = Guard(lambda: self.optimiser.numbers())
        self.phase, self.steps, self.elapsed = "points", 0, 0.0
        self.before: torch.Tensor | None = None
        """The student's numbers before the RGB phase."""
        self.epochs, self.count = Epochs(settings.rays, self.generator), RAYS_AT_FIRST
        self.asked, self.random = False, None
        """Whether the teacher was asked, and the state the generator has to be in then; None: as it is."""

    def finish(
        self,
        phase: Callable[[str], None] = lambda name: None,
        advance: Callable[[float, dict], None] = lambda share, figures: None,
        whole: Callable[[], AbstractContextManager] = nullcontext,
    ) -> tuple[VMField, DistillReport]:
        """Run to the end. Every step happens inside a `whole()`, which may hold an interrupt back."""
        report, settings = self.report, self.settings
        clock = _Clock(report.seconds)
        phase("asking the teachers")
        self.generator.manual_seed(settings.seed + 1)
        judge = Judge(self.teacher, settings.views, settings.view_size, settings.seed)
        rays_o, rays_d = random_rays(self.boxes, settings.rays, self.generator)
        pool = ask(self.teacher, rays_o, rays_d, self.step, self.generator, keep_points=0.35)
        if self.random is not None:
            self.generator.set_state(self.random)
        self.asked = True
        clock.lap("teachers")
        if self.phase == "points":
            phase("points")
            if len(pool.points):
                self._learn(PointPass(pool, self), settings.steps, advance, whole)
            with whole():
                self._begin_pictures()
                report.psnr_before_rgb = judge(self.student)
            clock.lap("points")
        if self.rgb:
            phase("pictures")
            self._learn(RayPass(pool, self), settings.rgb_steps, advance, whole)
            report.psnr_after_rgb = judge(self.student)
            report.rgb_kept = report.psnr_after_rgb > report.psnr_before_rgb
            if not report.rgb_kept:
                self.student.params.copy_(self.before)
            clock.lap("pictures")
        report.numeric = self.guard.figures()
        return self.student, report

    def _begin_pictures(self) -> None:
        """What was learnt from points is the RGB phase's start, and what it has to surpass."""
        self.guard.check()
        self.before = self.student.params.clone()
        self._prune()
        self.optimiser = Adam.of(self.student)
        self.guard.renew()
        self.phase, self.steps, self.elapsed = "pictures", 0, 0.0

    def _prune(self) -> None:
        """Leave out the cells that turned out empty, unless that would be all of them; only a student of one
        block over its own box has cells to give up."""
        if type(self.student) is not VMField or len(self.student.blocks) != 1:
            return
        occupancy = pruned(self.student)
        self.report.found_nothing = bool(self.teacher.occupancy.occupied.any() > occupancy.occupied.any())
        if not self.report.found_nothing:
            self.student = self.student.with_occupancy(occupancy)

    def _learn(self, gradient: "PointPass | RayPass", steps: int, advance: Callable, whole: Callable) -> None:
        """The steps of one phase."""
        started = time.monotonic() - self.elapsed
        while (share := self._share(steps, time.monotonic() - started)) < 1:
            with whole():
                self.guard.keep()
                sums, figures = gradient()
                if self.guard.accepts(sums, self.optimiser):
                    self.optimiser.step(gradient.rate * RATE_DECAY**share * self.guard.rate)
                self.steps += 1
                self.elapsed = time.monotonic() - started
            if self.steps % 20 == 1:
                advance(share, figures)
        self.guard.check()

    def _share(self, steps: int, seconds: float) -> float:
        """The share of the phase that is done: of its steps, or of its seconds where a budget is given."""
        if self.settings.time_budget is None:
            return self.steps / steps
        return seconds / (self.settings.time_budget / (2 if self.rgb else 1))

    def checkpoint(self) -> tuple[dict[str, np.ndarray], dict]:
        """Arrays and JSON-able state from which `restore` goes on as if nothing had happened."""
        arrays, drawn = self.epochs.state()
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
            "adam_steps": self.optimiser.steps,
            "psnr_before_rgb": self.report.psnr_before_rgb,
            "rays": self.count,
            "guard": self.guard.state(),
            **drawn,
        }
        return arrays, state

    def restore(self, arrays: dict[str, np.ndarray], state: dict) -> None:
        """Take up a run that `checkpoint` saved, over the same teacher and settings."""
        if "before" in arrays:
            self.student.params.copy_(torch.from_numpy(arrays["before"]))
            self._begin_pictures()
            self.report.psnr_before_rgb = state["psnr_before_rgb"]
        self.student.params.copy_(torch.from_numpy(arrays["params"]))
        self.optimiser.restore(arrays, state["adam_steps"])
        self.count = state["rays"]
        self.phase, self.steps, self.elapsed = state["phase"], state["steps"], state["elapsed"]
        self.guard.restore(state["guard"])
        self.epochs.restore(arrays, state)
        self.random = torch.from_numpy(arrays["random"]) if "random" in arrays else None


class _Clock:
    """Seconds per phase."""

    def __init__(self, seconds: dict[str, float]):
        self.seconds, self.last = seconds, time.monotonic()

    def lap(self, name: str) -> None:
        now = time.monotonic()
        self.seconds[name], self.last = now - self.last, now


class PointPass:
    """The 3D losses: (log1p(g τ_s) - log1p(g τ_t))^2 at the step's optical depth τ = σ δ, and colour
    weighted by alpha.

    Depths beyond OPAQUE look the same and are not told apart; a saturated student still feels a gradient,
    which an alpha loss would not give it.
    """

    rate = RATE

    def __init__(self, pool: TeacherPool, run: DistillRun):
        self.pool, self.run = pool, run

    def __call__(self) -> tuple[np.ndarray, dict]:
        """Leave the gradient of random points with the optimiser; the losses, and figures to tell."""
        run = self.run
        chosen = torch.randint(len(self.pool.points), (POINTS_PER_STEP,), generator=run.generator)
        loss = point_step(run.student, self.pool, chosen, run.step, run.optimiser)
        return np.array([loss]), {"loss": loss}


def point_step(
    student: VMField, pool: TeacherPool, chosen: torch.Tensor, step: float, optimiser: Adam
) -> float:
    """Loss of the chosen points, its gradient added to the optimiser's."""
    points, dirs = pool.points[chosen], pool.dirs[chosen]
    sigma, rgb = student.query(points, dirs)
    tau, wanted = sigma * step, (pool.sigma[chosen] * step).clamp_max(OPAQUE)
    error = torch.log1p(DEPTH_GAIN * tau) - torch.log1p(DEPTH_GAIN * wanted)
    error[(tau >= OPAQUE) & (wanted >= OPAQUE)] = 0
    # σ = softplus(f) and its slope vanish together: far below FAINT the gradient would be too small a number
    lift = torch.where(error < 0, (FAINT / tau).clamp(1, MOST_LIFT), 1)
    alpha = 1 - torch.exp(-wanted)
    off = rgb - pool.rgb[chosen]
    n = len(chosen)
    d_sigma = 2 / n * error * DEPTH_GAIN / (1 + DEPTH_GAIN * tau) * step * lift
    d_rgb = 2 / n * COLOUR_WEIGHT * alpha[:, None] * off
    student.query_backward(points, dirs, d_sigma, d_rgb, optimiser.grads)
    return float((error**2).mean() + COLOUR_WEIGHT * (alpha[:, None] * off**2).mean())


class RayPass:
    """The RGB loss over the teacher's own rays, colour over white and opacity."""

    rate = RGB_RATE

    def __init__(self, pool: TeacherPool, run: DistillRun):
        self.pool, self.run = pool, run
        self.target = pool.pixels.clone()
        self.target[:, :3] += 1 - self.target[:, 3:]

    def __call__(self) -> tuple[np.ndarray, dict]:
        """Leave the gradient of the next rays with the optimiser; the losses, and figures to tell."""
        run, pool = self.run, self.pool
        chosen = run.epochs.draw(run.count).numpy()
        jitter = torch.rand(len(chosen), generator=run.generator, dtype=torch.float64).numpy()
        loss = np.zeros((run.optimiser.parts, 3))
        white = np.ones((len(chosen), 3), np.float32)
        rays = pool.rays_o[chosen], pool.rays_d[chosen], jitter, run.step, EARLY_STOP
        target = self.target[chosen].numpy()
        run.student.train_rays(*rays, target, white, OPACITY_WEIGHT, run.optimiser.grads, loss)
        sums = loss.sum(0)
        wanted = run.settings.rgb_samples * len(chosen) / max(sums[2], 1)
        run.count = int(np.clip(0.9 * run.count + 0.1 * wanted, 256, 1 << 14))
        return sums, {"psnr": float(-10 * np.log10(max(sums[0] / len(chosen), 1e-10)))}


def pruned(student: VMField) -> OccupancyGrid:
    """The student's occupancy without the cells in which it turned out to hold nothing."""
    grid = student.occupancy
    cells = np.argwhere(grid.occupied)

    sigma = np.zeros(len(cells), np.float32)
    student.loops.density_at_cells(
        student.kernel_shape[0], student.arrays, 0, grid.aabb[:3].copy(), grid.cell, cells, PROBES, sigma
    )
    depth = np.zeros(grid.occupied.shape, np.float32)
    depth[tuple(cells.T)] = sigma * grid.cell.min()
    occupied = depth > harmless_depth(depth, EMPTY_BELOW, LOST_DEPTH)
    kept = OccupancyGrid(grid.aabb, occupied).dilated().occupied & grid.occupied
    return OccupancyGrid(grid.aabb, kept)
