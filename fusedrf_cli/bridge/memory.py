"""What a command will need of memory, added up from the arrays it is known to make, before it makes them.

All figures are bytes. The formulas follow the code that allocates: where that keeps another array, the number
here has to grow with it (tests/bridge/test_memory.py holds each against the peak of a real process).
"""

import contextlib
import resource
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import torch

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import SLOTS_AT_ONCE, Composite
from fusedrf_cli.engine.distillation.finetune import FinetuneConfig
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.distillation.teacher import expected_points
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, cell_counts
from fusedrf_cli.engine.kinds.builder import DistilledBuilder, Plan
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.rendering.volume import RenderConfig
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import ResourceProblem
from fusedrf_cli.report import readable_size
from fusedrf_cli.requests import FuseRequest


@dataclass(frozen=True)
class MemoryConfig:
    """Bytes, but for copies and shares, that work takes."""

    share_of_free: float = 0.8
    compiled: int = 50 << 20
    """Kernels, once they are loaded, and the libraries that come with them."""
    reading: float = 1.5
    """Copies of a field's numbers while it is read: decoded arrays, and the file's pages."""
    per_pixel: int = 350
    """Of a band: rays in float64, before and after turning, those of one block apart, pixels."""
    per_sample: int = 300
    """Of a wave through the general renderer: distances, points in each field, σ, colour."""
    per_cell: int = 24
    """Of an occupancy grid over a scene: counts, marks, and the distances that are made of them."""
    per_segment: int = 400
    """Of a ray of a composite: its segments, their ends, and the numbers that sort them."""
    per_slot: int = 1400
    """Of an instance in a segment that several share: its samples."""
    per_measured: int = 150
    """Of a pixel that is compared: both pictures, and what SSIM makes of them."""
    per_tried_cell: int = 120
    """Of the cells that a fit asks for their density: indices, centres and their copies."""
    per_ray: int = 112
    """Of a teacher's rays: where they are, what they show, and copies while they are joined."""
    per_point: int = 60
    """Of a teacher's points in pieces, one of their columns joined, and its place there."""
    per_pixel_of_photos: int = 4
    """Its colour."""
    per_masked_pixel: int = 10
    """More where masks leave some out: which, and the numbers of those that are left."""
    per_own_ray: int = 24
    """Of each camera's pixel: directions in float32, twice while they are joined."""
    per_made_ray: int = 100
    """Of one camera's pixel: directions in float64, while they are made."""


FLOAT = 4
OCCUPANCY = "its occupancy"


class Memory:
    """How much a command may take, and what it said it would."""

    def __init__(self, limit: int | None = None):
        """limit for the whole process; None: what it holds now and `share_of_free` of what is free."""
        config = current(MemoryConfig)
        self.base = resident()
        self.asked = limit is not None
        self.limit = limit if self.asked else int(self.base + config.share_of_free * available())
        self.predicted = 0

    def expect(self, *stages: Mapping[str, float], advice: str) -> None:
        """Hold the largest of the stages, each a sum of parts by what they are, against the limit. Raises
        ResourceProblem, with advice.
        """
        parts = max(stages, key=lambda stage: sum(stage.values()))
        needed = int(self.base + current(MemoryConfig).compiled + sum(parts.values()))
        self.predicted = max(self.predicted, needed)
        if needed > self.limit:
            most = max(parts, key=parts.get)
            have = "--memory allows" if self.asked else "are to be had"
            raise ResourceProblem(
                f"this needs about {readable_size(needed)} of memory, {readable_size(int(parts[most]))} of "
                f"it for {most}, and {readable_size(self.limit)} {have}; {advice}"
            )

    def room(self, parts: Mapping[str, float]) -> float:
        """What the limit leaves beside parts."""
        return self.limit - self.base - current(MemoryConfig).compiled - sum(parts.values())

    def report(self) -> dict[str, int | None]:
        """For a command's report: what was expected, None where nothing was, and the most that this process
        ever held."""
        return {"predicted_bytes": self.predicted or None, "peak_bytes": peak()}


def resident() -> int:
    """What this process holds now."""
    return psutil.Process().memory_info().rss


def peak() -> int:
    """The most this process ever held; what getrusage says may be the process's that started it."""
    with contextlib.suppress(OSError, StopIteration):
        lines = Path("/proc/self/status").read_text().splitlines()
        return next(int(line.split()[1]) * 1024 for line in lines if line.startswith("VmHWM"))
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def available() -> int:
    """What can be had without swapping, by the system's own estimate, within a control group's limit."""
    free = psutil.virtual_memory().available
    for folder, most, used in (
        ("/sys/fs/cgroup", "memory.max", "memory.current"),
        ("/sys/fs/cgroup/memory", "memory.limit_in_bytes", "memory.usage_in_bytes"),
    ):
        try:
            limit, used_bytes = (Path(folder, name).read_text().strip() for name in (most, used))
            free = min(free, max(0, int(limit) - int(used_bytes)))
        except (OSError, ValueError):  # no such group, or "max": no limit
            continue
    return free


def sources(sizes: list[int], room: float = float("inf"), copies: float = 0.0) -> dict[str, float]:
    """Distinct fields of those sizes, as many as there is room for, and copies of the largest while it is
    worked on: `reading`, `resampling` or none.
    """
    return {"the sources": max(min(sum(sizes), room), max(sizes)) + copies * max(sizes)}


def picture(width: int, height: int, composed: bool) -> dict[str, float]:
    """Rendering one picture by bands; `composed`: by the general renderer."""
    memory = current(MemoryConfig)
    config = current(RenderConfig)
    band = min(width * max(1, config.pixels_at_once // width), width * height)
    waves = min(band, config.rays_at_once) * config.samples_per_wave * memory.per_sample if composed else 0
    return {"a band of the picture": band * memory.per_pixel + waves}


def segments(rays: int) -> dict[str, float]:
    """Rays of a picture of a Composite, so many in all, and the samples of several instances."""
    config = current(MemoryConfig)
    rays = min(rays, Composite.rays_at_once)
    return {"segments of rays": rays * config.per_segment + SLOTS_AT_ONCE * config.per_slot}


def measured(width: int, height: int) -> dict[str, float]:
    """Holding a whole picture against another."""
    return {"two pictures and their comparison": width * height * current(MemoryConfig).per_measured}


def ownership(aabb: np.ndarray) -> dict[str, float]:
    """Grids over a scene's box (6,)."""
    memory = current(MemoryConfig)
    config = current(OccupancyConfig)
    return {"grids over the scene": memory.per_cell * float(np.prod(cell_counts(aabb, config.scene_cells)))}


def result(numbers: int, measured: bool = True) -> dict[str, float]:
    """A finished field of so many numbers: itself, and while it is measured also as it will be stored."""
    return {"the result": numbers * (FLOAT + (2 + FLOAT) * measured)}


def learning(numbers: int, threads: int, moments: int = 2) -> dict[str, float]:
    """A field while it learns: numbers and Adam's moments, both once more for the guard to go back to, and a
    row of gradients per thread."""
    return {"the field that learns": numbers * FLOAT * (2 * (1 + moments) + threads)}


def decoding(pixels: int, masked: bool, beside: int) -> dict[str, float]:
    """Photos of so many pixels together while they are read, and what their decoders take beside them."""
    config = current(MemoryConfig)
    return {"the photos": pixels * (config.per_pixel_of_photos + masked), "decoding them": beside}


def photos(count: int, width: int, height: int, cameras: int, masked: bool) -> dict[str, float]:
    """Photos as they are drawn from, some pixels left out where they are `masked`, and the rays of so many
    different cameras."""
    config = current(MemoryConfig)
    pixels = width * height
    per_pixel = config.per_pixel_of_photos + config.per_masked_pixel * masked
    per_ray = cameras * config.per_own_ray + config.per_made_ray
    return {"the photos": pixels * (count * per_pixel + per_ray)}


def fitting(plan: Plan, longest: int, threads: int, unbounded: bool) -> dict[str, float]:
    """The field of a fit at its full resolution, with so many texels along the longest axis, while its
    occupancy is made anew."""
    grid = np.prod(cell_counts(plan.box, min(current(OccupancyConfig).cells, longest)))
    learns = learning(plan.numbers, threads, 1 if unbounded else 2)
    return {**learns, OCCUPANCY: float(grid) * current(MemoryConfig).per_tried_cell}


def together(*fits: Mapping[str, float]) -> dict[str, float]:
    """What several fits need that take turns: all that each needs, but one occupancy at a time."""
    parts: dict[str, float] = {}
    for fit in fits:
        for what, needed in fit.items():
            before = parts.get(what, 0.0)
            parts[what] = max(before, needed) if what == OCCUPANCY else before + needed
    return parts


def teaching(settings: DistilConfig, points: int) -> dict[str, float]:
    """What is asked of the teachers."""
    config = current(MemoryConfig)
    rays = max(settings.rays, settings.rgb_rays or 0)
    return {"the teachers' answers": rays * config.per_ray + points * config.per_point}


def rays_to_learn_from(rays: int) -> dict[str, float]:
    """Rays to learn from, and what they show."""
    return {"rays to learn from": rays * current(MemoryConfig).per_ray}


def stages(
    builder: DistilledBuilder, scene: ComposedField, request: FuseRequest, teacher: RadianceField
) -> list[tuple[float, dict[str, float]]]:
    """The stages of fusing a scene: making a student, measuring it, learning from a teacher. Each is so many
    copies of the largest source, and bytes by what they are for."""
    needs = builder.needs()
    numbers, learnt, grids = needs.numbers, needs.numbers - needs.settled, ownership(scene.aabb)
    settings = builder.distil_config_for(learnt, request.time_budget) or current(DistilConfig)
    if builder.distil_config is None:
        taught = rays_to_learn_from(current(FinetuneConfig).rays)
    else:
        points = needs.points
        if points is None:
            step = 0.5 * builder.largest().voxel
            sampler = RaySampler.of(builder.scene, builder.request.views)
            points = expected_points(teacher, sampler, settings.rays, step, request.seed)
        taught = teaching(settings, points)
    # kept beside what learns: the field as it was made, and the numbers that its pictures have to surpass
    copies = (not builder.learnt) + (builder.distil_config is not None and request.finetune)
    learns = (
        learning(learnt, torch.get_num_threads()) | {"its starts": copies * learnt * FLOAT} | taught | grids
        if will_learn(builder, request)
        else {}
    )
    if learns and request.target_psnr is not None:
        learns["the best so far"] = numbers * FLOAT
    making = needs.making | (taught | picture(256, 256, composed=True) if builder.learnt else {})
    return [
        (needs.copies, result(numbers, measured=False) | making | grids),
        (0.0, result(numbers) | grids | evaluation_memory(builder)),
        (0.0, learns | {"what does not learn": needs.settled * FLOAT} if learns else {}),
    ]


def asking_in_waves(builder: DistilledBuilder, scene: ComposedField) -> dict[str, float]:
    """Rays that a made student learns from, while they are asked of sources that are read one by one."""
    finished = result(builder.needs().numbers, measured=False)
    return (
        finished
        | rays_to_learn_from(current(FinetuneConfig).rays)
        | ownership(scene.aabb)
        | picture(256, 256, composed=True)
    )


def will_learn(builder: DistilledBuilder, request: FuseRequest) -> bool:
    """Whether anything is going to be learnt."""
    return builder.learnt or request.finetune


def evaluation_memory(builder: DistilledBuilder) -> dict[str, float]:
    """Looking at a scene to measure; some views are filled by one of its objects."""
    side = (builder.distil_config or current(DistilConfig)).view_size
    return picture(side, side, composed=True)
