"""Distil any radiance field into a VM student (FusedRF; PVD for one teacher).

Three phases: ask the teacher on rays through it, fit the student's σ and colour at the points of those rays
(3D losses), then a
few passes over the rays themselves (RGB loss) at a tenth of the rate, kept only if the student got better on
views of its own.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.blocks import reshaped
from fusedrf_cli.engine.distillation.fit import EARLY_STOP, EMPTY_BELOW, texels
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.distillation.teacher import TeacherPool, ask, random_rays
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.fields.vm import PROBES, Block, VMField, VMShape, VMTensor
from fusedrf_cli.engine.kernels import cpu
from fusedrf_cli.engine.rendering.cameras import scattered
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image

RATE = 0.02
RATE_DECAY = 0.1
RGB_RATE = 0.1 * RATE
OPAQUE = 5.0  # optical depth of a step beyond which more density cannot be seen
DEPTH_GAIN = 10.0  # in log1p(gain τ): how much thin fog counts
COLOUR_WEIGHT = 2.0
POINTS_PER_STEP = 1 << 15
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

    Raises FloatingPointError when the student's numbers are not finite any more.
    """
    generator = torch.Generator().manual_seed(settings.seed + 1)
    report = DistillReport()
    clock = _Clock(report.seconds)
    if rgb and settings.time_budget is not None:
        settings = replace(settings, time_budget=settings.time_budget / 2)
    step = 0.5 * student.voxel_size
    phase("asking the teachers")
    judge = Judge(teacher, settings.views, settings.view_size, settings.seed)
    rays_o, rays_d = random_rays(boxes, settings.rays, generator)
    pool = ask(teacher, rays_o, rays_d, step, generator, keep_points=0.35)
    clock.lap("teachers")
    phase("points")
    fit_points(student, pool, step, settings, generator, advance)
    student = student.with_occupancy(pruned(student))
    report.psnr_before_rgb = judge(student)
    clock.lap("points")
    if rgb:
        phase("pictures")
        before = student.params.clone()
        fit_rays(student, pool, step, settings, generator, advance)
        report.psnr_after_rgb = judge(student)
        report.rgb_kept = report.psnr_after_rgb > report.psnr_before_rgb
        if not report.rgb_kept:
            student.params.copy_(before)
        clock.lap("pictures")
    if not torch.isfinite(student.params).all():
        raise FloatingPointError("the student's numbers are not finite")
    return student, report


class _Clock:
    """Seconds per phase."""

    def __init__(self, seconds: dict[str, float]):
        self.seconds, self.last = seconds, time.monotonic()

    def lap(self, name: str) -> None:
        now = time.monotonic()
        self.seconds[name], self.last = now - self.last, now


def shares(steps: int, budget: float | None):
    """Yield the share of a phase that is done before each step: of its steps, or of its seconds where a
    budget is given.
    """
    started, done = time.monotonic(), 0
    while (share := (time.monotonic() - started) / budget if budget is not None else done / steps) < 1:
        yield share
        done += 1


def fit_points(
    student: VMField,
    pool: TeacherPool,
    step: float,
    settings: DistillSettings,
    generator: torch.Generator,
    advance: Callable,
) -> None:
    """The 3D losses: (log1p(g τ_s) - log1p(g τ_t))^2 at the step's optical depth τ = σ δ, and colour
    weighted by alpha.

    Depths beyond OPAQUE look the same and are not told apart; a saturated student still feels a gradient,
    which an alpha loss
    would not give it.
    """
    if not len(pool.points):
        return
    optimiser = Adam(student, torch.get_num_threads())
    for i, share in enumerate(shares(settings.steps, settings.time_budget)):
        chosen = torch.randint(len(pool.points), (POINTS_PER_STEP,), generator=generator)
        loss = point_step(student, pool, chosen, step, optimiser)
        optimiser.step(RATE * RATE_DECAY**share)
        if i % 20 == 0:
            advance(share, {"loss": loss})


def point_step(
    student: VMField, pool: TeacherPool, chosen: torch.Tensor, step: float, optimiser: Adam
) -> float:
    """Loss of the chosen points, its gradient added to the optimiser's."""
    points, dirs = pool.points[chosen], pool.dirs[chosen]
    sigma, rgb = student.query(points, dirs)
    tau, wanted = sigma * step, (pool.sigma[chosen] * step).clamp_max(OPAQUE)
    error = torch.log1p(DEPTH_GAIN * tau) - torch.log1p(DEPTH_GAIN * wanted)
    error[(tau >= OPAQUE) & (wanted >= OPAQUE)] = 0
    alpha = 1 - torch.exp(-wanted)
    off = rgb - pool.rgb[chosen]
    n = len(chosen)
    d_sigma = 2 / n * error * DEPTH_GAIN / (1 + DEPTH_GAIN * tau) * step
    d_rgb = 2 / n * COLOUR_WEIGHT * alpha[:, None] * off
    cpu.query_backward(
        *student.kernel_shape,
        student.arrays,
        student.grid,
        points.numpy(),
        dirs.numpy(),
        d_sigma.numpy(),
        d_rgb.numpy(),
        optimiser.grads,
    )
    return float((error**2).mean() + COLOUR_WEIGHT * (alpha[:, None] * off**2).mean())


def fit_rays(
    student: VMField,
    pool: TeacherPool,
    step: float,
    settings: DistillSettings,
    generator: torch.Generator,
    advance: Callable,
) -> None:
    """The RGB loss over the teacher's own rays, colour over white and opacity."""
    optimiser = Adam(student, torch.get_num_threads())
    target = pool.pixels.clone()
    target[:, :3] += 1 - target[:, 3:]
    slots = int(np.linalg.norm(student.aabb[3:] - student.aabb[:3]) / step) + 2
    count, at, order = 1024, 0, torch.randperm(len(target), generator=generator)
    for i, share in enumerate(shares(settings.rgb_steps, settings.time_budget)):
        if at + count > len(order):
            order, at = torch.randperm(len(target), generator=generator), 0
        chosen = order[at : at + count].numpy()
        at += count
        jitter = torch.rand(len(chosen), generator=generator, dtype=torch.float64).numpy()
        loss = np.zeros((optimiser.parts, 3))
        cpu.train_rays(
            *student.kernel_shape,
            student.arrays,
            student.grid,
            pool.rays_o[chosen],
            pool.rays_d[chosen],
            0.0,
            jitter,
            step,
            EARLY_STOP,
            target[chosen].numpy(),
            np.ones((len(chosen), 3), np.float32),
            0.1,
            slots,
            optimiser.grads,
            loss,
        )
        optimiser.step(RGB_RATE * RATE_DECAY**share)
        count = int(
            np.clip(
                0.9 * count + 0.1 * settings.rgb_samples * len(chosen) / max(loss[:, 2].sum(), 1),
                256,
                1 << 14,
            )
        )
        if i % 20 == 0:
            advance(share, {"psnr": float(-10 * np.log10(max(loss[:, 0].sum() / len(chosen), 1e-10)))})


def pruned(student: VMField) -> OccupancyGrid:
    """The student's occupancy without the cells in which it turned out to hold nothing."""
    grid = student.occupancy
    cells = np.argwhere(grid.occupied)

    sigma = np.zeros(len(cells), np.float32)
    cpu.density_at_cells(
        student.kernel_shape[0], student.arrays, 0, grid.aabb[:3].copy(), grid.cell, cells, PROBES, sigma
    )
    occupied = np.zeros_like(grid.occupied)
    occupied[tuple(cells[sigma * grid.cell.min() > EMPTY_BELOW].T)] = True
    kept = OccupancyGrid(grid.aabb, occupied).dilated().occupied & grid.occupied
    return OccupancyGrid(grid.aabb, kept)
