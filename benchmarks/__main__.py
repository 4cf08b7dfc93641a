"""Kernel speed against the torch reference in the same run: python -m benchmarks (or make bench).

Prints a Markdown table. Ratios are medians over runs that alternate with the reference's, since whatever else
runs slows both alike.
"""

import statistics
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch

from benchmarks.commit import commit_line
from fusedrf_cli.engine.distillation.losses import point_step
from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.distillation.teacher import TeacherPoints
from fusedrf_cli.engine.fields.computed import Batch
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels import cpu, reference
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape
from fusedrf_cli.engine.rendering.cameras import framing_camera
from fusedrf_cli.engine.rendering.volume import reach_of, render_image
from fusedrf_cli.engine.spaces import bounded

POINTS, RAYS, REPEATS, TEXELS, CELLS, FRAME = 1 << 17, 1 << 11, 5, 224, 96, 800
BOX = np.array([-1.0, -1, -1, 1, 1, 1])
STEP = 1.0 / TEXELS
EARLY_STOP = 1e-3


@dataclass(frozen=True)
class Row:
    """One piece of work, done by the kernels and by the reference."""

    what: str
    unit: str
    count: float
    """Units of work in a call of `ours`."""
    ours: Callable[[], object]
    theirs: Callable[[], object]
    their_count: float


def alternate(row: Row) -> tuple[float, float]:
    """(median seconds of a unit by the kernels, median of the reference's over it), runs taking turns."""
    row.ours(), row.theirs()  # compiles, and fills caches
    seconds, ratios = [], []
    for _ in range(REPEATS):
        took = []
        for work, count in ((row.ours, row.count), (row.theirs, row.their_count)):
            started = time.perf_counter()
            work()
            took.append((time.perf_counter() - started) / count)
        seconds.append(took[0])
        ratios.append(took[1] / took[0])
    return statistics.median(seconds), statistics.median(ratios)


def shell_field(generator: torch.Generator) -> VMField:
    """A VM tensor of random numbers that is dense in a shell of cells: like a surface, most of it is
    empty."""
    field = VMField.create(VMShape(), BOX, (TEXELS,) * 3, generator)
    grid = OccupancyGrid.full(BOX, CELLS)
    centres = BOX[:3] + (np.indices(grid.occupied.shape).reshape(3, -1).T + 0.5) * grid.cell
    radius = np.linalg.norm(centres, axis=1).reshape(grid.occupied.shape)
    field.shift = 0.0
    return field.with_occupancy(OccupancyGrid(BOX, abs(radius - 0.7) < 0.04))


def query_row(field: VMField, generator: torch.Generator, with_colour: bool) -> Row:
    """A query of random points and its backward pass, all cells occupied."""
    points = torch.rand(POINTS, 3, generator=generator, dtype=torch.float64) * 2 - 1
    dirs = torch.nn.functional.normalize(
        torch.randn(POINTS, 3, generator=generator, dtype=torch.float64), dim=1
    )
    grads = torch.zeros(torch.get_num_threads(), field.params.numel()).numpy()
    back = points, dirs, torch.ones(POINTS), torch.full((POINTS, 3), float(with_colour)), grads

    def ours():
        field.query(points, dirs, with_colour)
        field.query_backward(*back)

    params, unit = field.params.clone().requires_grad_(), ((points + 1) / 2).float()
    density = field.slots["density"]

    def theirs():
        if with_colour:
            sigma, rgb = field.reference(params, points, dirs)
            (sigma.sum() + rgb.sum()).backward()
        else:
            sections = field.with_params(params).slot_sections()["density"]
            features = density.module.reference(field, sections, unit, None, **density.options)
            sigma = field.slots["sigma"]
            sigma.module.reference(field, {}, features, **sigma.options)[0].sum().backward()

    what = "query forward and backward, density" + with_colour * " and colour"
    return Row(what, "point", POINTS, ours, theirs, POINTS)


def rays_through(generator: torch.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rays from all sides to random points of the box."""
    origin = torch.nn.functional.normalize(
        torch.randn(RAYS, 3, generator=generator, dtype=torch.float64), dim=1
    )
    rays_o = (3 * origin).numpy()
    rays_d = torch.rand(RAYS, 3, generator=generator, dtype=torch.float64).numpy() * 1.6 - 0.8 - rays_o
    return rays_o, rays_d / np.linalg.norm(rays_d, axis=1, keepdims=True)


def march_row(field: VMField, rays_o: np.ndarray, rays_d: np.ndarray) -> Row:
    """All samples of rays that lie in occupied cells."""
    half, alive = np.full(RAYS, 0.5), np.ones(RAYS, bool)
    (ts, spans), found = np.zeros((2, RAYS, int(4 / STEP))), np.zeros(RAYS, np.int64)
    loops, reach = cpu.loops_for(None, (), bounded), reach_of(RAYS, 0.0, np.inf)

    def ours():
        start = np.zeros(RAYS, np.int64)
        loops.march(field.grid, rays_o, rays_d, reach, half, STEP, start, alive, ts, spans, found)

    tensors = torch.from_numpy(rays_o), torch.from_numpy(rays_d)

    def theirs():
        reference.lattice(field, *tensors, 0.0, STEP, torch.tensor(0.5))

    return Row("march to the samples of a ray", "ray", RAYS, ours, theirs, RAYS)


def train_row(field: VMField, rays_o: np.ndarray, rays_d: np.ndarray) -> Row:
    """A step of training: render, compare, backward, Adam."""
    target, white = np.full((RAYS, 4), 0.5, np.float32), np.ones((RAYS, 3), np.float32)
    batch = Batch(rays_o, rays_d, np.full(RAYS, 0.5), target, white, 0.1, 0.0, STEP, EARLY_STOP)
    mine = Adam.of(field)

    def ours():
        field.train_rays(batch, mine.grads, np.zeros((mine.parts, 3)))
        mine.step(0.0)

    copy = field.with_params(field.params.clone().requires_grad_())
    other = torch.optim.Adam([copy.params], 0.0)
    few = RAYS // 8
    tensors = torch.from_numpy(rays_o[:few]), torch.from_numpy(rays_d[:few])

    def theirs():
        other.zero_grad()
        out = reference.render_rays(copy, *tensors, 0.0, STEP, EARLY_STOP)
        colour = out[:, :3] + (1 - out[:, 3:4])
        (((colour - 0.5) ** 2).mean() + 0.1 * ((out[:, 3] - 0.5) ** 2).mean()).backward()
        other.step()

    return Row("training step", "ray", RAYS, ours, theirs, few)


def fuse_row(field: VMField, generator: torch.Generator, rays_o: np.ndarray, rays_d: np.ndarray) -> Row:
    """A step of distilling: points of a teacher, 3D losses, Adam."""
    centres = torch.from_numpy(field.occupancy.centres())
    points = centres[torch.randint(len(centres), (POINTS,), generator=generator)]
    dirs = torch.from_numpy(rays_d).repeat(POINTS // RAYS, 1)
    asked = torch.full((POINTS,), 20.0), torch.full((POINTS, 3), 0.5)
    mine, pool = Adam.of(field), TeacherPoints(points, dirs, *asked, torch.ones(POINTS))
    batch, chosen = pool.batch(0, 1 << 15), torch.arange(1 << 15)

    def ours():
        point_step(field, batch, STEP, mine)
        mine.step(0.0)

    params = field.params.clone().requires_grad_()
    other = torch.optim.Adam([params], 0.0)

    def theirs():
        other.zero_grad()
        sigma, rgb = field.reference(params, points[chosen], dirs[chosen])
        depth = torch.log1p(10 * STEP * sigma) - torch.log1p(10 * STEP * asked[0][chosen])
        ((depth**2).mean() + 2 * ((rgb - 0.5) ** 2).mean()).backward()
        other.step()

    return Row("fusing step, points", "point", len(chosen), ours, theirs, len(chosen))


def frame_row(field: VMField) -> Row:
    """A frame; the reference renders one ray in 400."""
    camera = framing_camera(field.occupancy.tight_aabb(0), 0.9, 0.45, FRAME, FRAME)
    rays_o, rays_d = camera.rays()
    some = torch.from_numpy(rays_o[::400].copy()), torch.from_numpy(rays_d[::400].copy())

    def theirs():
        with torch.no_grad():
            reference.render_rays(field, *some, 0.0, STEP, EARLY_STOP)

    what = f"frame of {FRAME} x {FRAME}"
    return Row(what, "ray", FRAME**2, lambda: render_image(field, camera), theirs, len(some[0]))


def line(row: Row) -> str:
    """The row of the table."""
    seconds, ratio = alternate(row)
    return f"| {row.what} | {1e-6 / seconds:.2f} M {row.unit}s/s | {ratio:.1f} |"


def main() -> None:
    """Measure and print the table."""
    generator = torch.Generator().manual_seed(0)
    full = VMField.create(VMShape(), BOX, (TEXELS,) * 3, generator)
    shell = shell_field(generator)
    rays = rays_through(generator)
    print(f"{commit_line()}\n")
    print(f"{TEXELS} texels per axis, ranks 16 and 24, SH degree 2; {torch.get_num_threads()} threads\n")
    print("| work | rate | times faster than torch |")
    print("|---|---|---|")
    for row in (
        query_row(full, generator, False),
        query_row(full, generator, True),
        march_row(shell, *rays),
        train_row(shell, *rays),
        fuse_row(shell, generator, *rays),
        frame_row(shell),
    ):
        print(line(row), flush=True)


if __name__ == "__main__":
    main()
