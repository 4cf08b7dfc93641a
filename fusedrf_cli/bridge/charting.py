"""`chart`: a scene fused in the ways that are worth it, each measured against the scene as composed."""

import contextlib
import csv
import os
import statistics
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from formats.atomic import atomic_folder, temporary_sibling
from formats.errors import ResourceError
from fusedrf_cli import plots
from fusedrf_cli.bridge.evaluation_views import evaluation_views_of
from fusedrf_cli.bridge.field_cache import FieldCache
from fusedrf_cli.bridge.fusing import fuse, source_bytes
from fusedrf_cli.bridge.memory import Memory, measured, sources
from fusedrf_cli.bridge.rendering import composite_of, frame_memory, renderable
from fusedrf_cli.bridge.runtime import checkpoint_path, engine
from fusedrf_cli.bridge.scene import load_scene, unusable_kind
from fusedrf_cli.bridge.sources import scene_as_stored
from fusedrf_cli.bridge.sweep_flags import flags_of
from fusedrf_cli.engine.composition.composite import Composite
from fusedrf_cli.engine.distillation.evaluation import EvaluatorConfig
from fusedrf_cli.engine.fields.occupancy import placed_box
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.sweeps import Sweep, SweepPoint
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera, scattered
from fusedrf_cli.engine.rendering.metrics import psnr, ssim
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import FusedRFError, Interrupted, InvalidInput, UsageProblem
from fusedrf_cli.progress import NullProgress
from fusedrf_cli.requests import ChartRequest, FuseRequest


@dataclass(frozen=True)
class ChartConfig:
    """How fused fields are compared, and in which order they are tried."""

    views: int = 8
    stream: int = 2
    """Of views, beside `judged_seed`: a pair seeds a stream that no single number, as of --seed, does."""
    rounds: int = 5
    """Of frames, all fields taking turns."""
    per_pixel_kept: int = 12
    """Bytes of a pixel that is compared with."""
    noise: float = 0.05
    """Share by which costs differ that are taken as equal."""
    behind: float = 0.5
    """dB that a point is worse by than one of another group in as few bytes, which is then ahead."""
    lagging: int = 3
    """How many times longer a group waits that is behind others."""


@dataclass
class Point:
    """One way to fuse the scene, and what it gave."""

    flags: str
    kind: str
    psnr: float
    """dB against the scene as composed, mean of `views` views over white that nothing was trained on."""
    ssim: float
    covered: float
    """dB over the pixels in which the scene as composed shows something."""
    seconds: float
    """Of fusing, once the kernels are loaded."""
    bytes: int
    ms: float = float("nan")
    """Median time of a frame."""
    frontier: list[str] = field(default_factory=list)
    """The costs (plots.AXES) at which no other point is as good for less."""
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Benchmark:
    """What all fused fields of a scene are held to."""

    scene: str
    memory: Memory
    size: tuple[int, int]
    allow_outside: bool
    device: str
    box: np.ndarray
    """(6,) of the world, which frames are timed of."""
    cameras: list[Camera]
    """In the world."""
    truth: list[np.ndarray]
    """(H, W, 3) float32 over white, of every camera."""
    covered: list[np.ndarray]
    """(H, W) bool of every camera: the pixels that the scene covers."""
    source_bytes: int

    @classmethod
    def prepare(
        cls,
        scene: str,
        memory: Memory,
        size: tuple[int, int],
        allow_outside: bool = False,
        device: str = "cpu",
        box: np.ndarray | None = None,
    ):
        """Render the scene as composed, by default from where the scene and its objects were photographed;
        given a box (6,) of the world, from all around that."""
        chart = current(ChartConfig)
        config = current(EvaluatorConfig)
        held_out = config.judged_seed, chart.stream
        loaded = load_scene(scene, allow_outside, memory, device)
        needed = sources(loaded.sizes) | frame_memory(None, *size) | measured(*size)
        composed = composite_of(loaded, memory, needed)
        needed |= frame_memory(composed, *size)
        if box is None:
            cameras = [
                look.camera for look in evaluation_views_of(loaded, composed, chart.views, size, held_out)
            ]
            box = placed_box(composed.occupancy.look_at_box, composed.origin)
        else:
            cameras = scattered(box, chart.views, *size, seed=held_out)
        needed["the pictures to compare with"] = len(cameras) * size[0] * size[1] * chart.per_pixel_kept
        memory.expect(needed, advice="give a smaller --size")
        shots = [render_image(composed, c, origin=composed.origin) for c in cameras]
        truth, seen = [shot.over() for shot in shots], [shot.opacity > config.covered for shot in shots]
        total = source_bytes(loaded)
        return cls(scene, memory, size, allow_outside, device, box, cameras, truth, seen, total)

    @property
    def covered_share(self) -> float:
        """How much of the views the scene covers."""
        return float(np.mean(self.covered))

    def quality(self, bundle: Path) -> dict[str, float]:
        """Mean `psnr` and `ssim` of a fused bundle, and `covered`, the PSNR of the pixels that are."""
        render, origin = renderable(load_scene(str(bundle), budget=self.memory, device=self.device))
        shots = [render_image(render, c, origin=origin).over() for c in self.cameras]
        pairs = list(zip(shots, self.truth, strict=True))
        inside = [psnr(a[m], b[m]) for (a, b), m in zip(pairs, self.covered, strict=True) if m.any()]
        measures = {"psnr": [psnr(*p) for p in pairs], "ssim": [ssim(*p) for p in pairs], "covered": inside}
        return {name: float(np.mean(values)) if values else np.nan for name, values in measures.items()}

    def frame_times(self, bundles: Sequence[Path], advance: Callable[[int], None]) -> list[float]:
        """Median milliseconds of a frame of the scene as composed, and of every fused bundle: all take
        turns, so that what else the machine does meets them alike.
        """
        camera = framing_camera(self.box, 0.9, 0.45, *self.size)
        loaded = load_scene(self.scene, self.allow_outside, self.memory, self.device)
        needed = frame_memory(None, *self.size)
        composed = composite_of(loaded, self.memory, needed)
        needed |= sources(loaded.resident) if isinstance(composed, Composite) else {}
        field_cache = FieldCache(self.memory.room(needed | frame_memory(composed, *self.size)))
        sizes = [sum(load_scene(str(path), budget=self.memory).sizes) for path in bundles]
        seconds = [[] for _ in range(1 + len(bundles))]
        for done in range(1 + current(ChartConfig).rounds):  # the first warms up
            seconds[0].append(frame_seconds(composed, camera, composed.origin))
            for i, (path, size) in enumerate(zip(bundles, sizes, strict=True), 1):
                source_field = field_cache.take(
                    str(path), size, lambda path=path: renderable(load_scene(str(path), device=self.device))
                )
                seconds[i].append(frame_seconds(source_field[0], camera, source_field[1]))
            advance(done + 1)
        return [1000 * statistics.median(times[1:]) for times in seconds]


def frame_seconds(render, camera, origin: np.ndarray) -> float:
    """Time of one frame."""
    started = time.perf_counter()
    render_image(render, camera, origin=origin)
    return time.perf_counter() - started


def chart(request: ChartRequest, progress) -> dict:
    """Fuse a scene in the ways that are worth it, measure each, and draw them in a folder.

    Raises the error of fusing where no way can be gone.
    """
    plots.check()
    output, budget, size = request.output, request.budget, request.size
    with engine(request.device, request.threads, progress) as device, scratch(output) as paths:
        progress.phase("the scene as composed", None)
        benchmark = Benchmark.prepare(
            request.scene, Memory(request.memory), size, request.allow_outside, device
        )
        run = Charting(benchmark, paths, request, progress)
        progress.phase("fusing", budget)
        try:
            waiting = {kind: registry.kind(kind).sweeps(request.least_psnr) for kind in request.kinds}
        except ValueError as error:
            raise unusable_kind(error) from error
        with run.kept():
            left = run.climb(waiting, budget)
            progress.phase("frames", 1 + current(ChartConfig).rounds)
            composed_ms, *ms = benchmark.frame_times(run.bundles, progress.advance)
    for point, value in zip(run.points, ms, strict=True):
        point.ms = value
    mark_frontiers(run.points)
    best = sorted((p for p in run.points if p.frontier), key=lambda p: (-p.psnr, p.bytes))
    composed = {"ms": composed_ms, "bytes": benchmark.source_bytes}
    with atomic_folder(output, overwrite=request.overwrite) as folder:
        write_csv(folder / "chart.csv", run.points, composed)
        for suffix in ("png", "svg"):
            title = Path(request.scene).name
            plots.chart(run.points, best, composed, title, folder / f"chart.{suffix}")
    if left:
        progress.warn(f"{left} ladders were left off where --budget {budget:g} ended; give more to go on")
    columns = ("flags", "psnr", "covered", "ssim", "bytes", "seconds", "ms")
    return {
        "output": output,
        "views": f"{len(benchmark.cameras)} of {size[0]}x{size[1]}, which nothing was trained or chosen on",
        "covered_share": benchmark.covered_share,
        "composed": composed,
        "tried": len(run.points),
        "frontier": [{"no": i} | {c: getattr(p, c) for c in columns} for i, p in enumerate(best, 1)],
        "points": [asdict(p) for p in run.points],
    }


@contextlib.contextmanager
def scratch(output: str) -> Iterator[Iterator[Path]]:
    """Names for bundles beside the output, which are removed at the end: sources are found from there by the
    same paths as from a bundle that a person puts there, so that the bytes are the same.
    """
    target, paths = Path(os.path.realpath(output)), []

    def names() -> Iterator[Path]:
        while True:
            paths.append(temporary_sibling(target))
            yield paths[-1]

    try:
        yield names()
    finally:
        for path in paths:
            path.unlink(missing_ok=True)
            checkpoint_path(str(path)).unlink(missing_ok=True)


@dataclass(eq=False)
class SweepRun:
    """How far one ladder was climbed."""

    sweep: Sweep
    sweep_point: SweepPoint
    """The next one."""
    points: list[Point] = field(default_factory=list)

    def climb(self, point: Point | None) -> bool:
        """Take what the rung gave, if anything; whether there is another one."""
        self.points += [point] if point is not None else []
        with contextlib.suppress(StopIteration):
            self.sweep_point = self.sweep.send(point and (point.bytes, point.psnr))
            return True
        return False

    def behind(self, others: Iterable[Point]) -> bool:
        """Whether its last point is well surpassed by another one with no more bytes. It may overtake at
        smaller sizes, so that it only waits.
        """
        config = current(ChartConfig)
        last = self.points[-1] if self.points else None
        return last is not None and any(
            p.bytes <= last.bytes and p.psnr >= last.psnr + config.behind for p in others
        )


class Charting:
    """The points found so far, and the bundles they were measured on."""

    def __init__(self, benchmark: Benchmark, paths: Iterator[Path], request: ChartRequest, progress):
        self.benchmark, self.paths, self.request, self.progress = benchmark, paths, request, progress
        self.points: list[Point] = []
        self.bundles: list[Path] = []
        self.refused: dict[str, FusedRFError] = {}
        self.warm: set[tuple[str, str]] = set()

    @contextlib.contextmanager
    def kept(self) -> Iterator[None]:
        """Where this block is interrupted, or a disk is full, the points that were found are left as a
        table."""
        try:
            yield
        except (Interrupted, OSError, ResourceError) as error:
            outcome = "nothing was written"
            if self.points:
                output = self.request.output
                composed = {"ms": float("nan"), "bytes": self.benchmark.source_bytes}
                with atomic_folder(output, overwrite=self.request.overwrite) as folder:
                    write_csv(folder / "chart.csv", self.points, composed)
                outcome = f"the {len(self.points)} points found so far are in {Path(output) / 'chart.csv'}"
            if isinstance(error, Interrupted):
                error.sentence = f"interrupted; {outcome}"  # and no checkpoint is left to go on from
            else:
                self.progress.warn(outcome)
            raise

    def climb(self, waiting: dict[str, dict[str, list[Sweep]]], budget: float) -> int:
        """Try rung after rung of the ladders of every kind, in their groups, until the seconds are spent:
        next comes the group that has had the least time, of which one counts for `lagging` where other groups
        surpass all of it, and of its ladders one that is not behind, with the fewest rungs. Returns how many
        ladders were left off.
        """
        runs = {
            (kind, name): [SweepRun(sweep, next(sweep)) for sweep in members]
            for kind, groups in waiting.items()
            for name, members in groups.items()
        }
        started, spent = time.monotonic(), dict.fromkeys(runs, 0.0)
        while any(runs.values()) and (now := time.monotonic() - started) < budget:
            self.progress.advance(now)
            due = {
                g: current(ChartConfig).lagging * spent[g] if self.lags(members) else spent[g]
                for g, members in runs.items()
                if members
            }
            group = min(due, key=due.get)
            swept = [p for c in runs[group] for p in c.points]
            run = min(runs[group], key=lambda c: (c.behind(swept), len(c.points)))
            point = self.try_point(group, run.sweep_point)
            if not run.climb(point):
                runs[group].remove(run)
            spent[group] += time.monotonic() - started - now
            runs = {g: members for g, members in runs.items() if g[0] not in self.refused}
        if not self.points:
            nothing = "no way to fuse was left to try; ask for other --kinds, or give more --budget"
            raise next(iter(self.refused.values()), UsageProblem(nothing))
        return sum(map(len, runs.values()))

    def lags(self, runs: list[SweepRun]) -> bool:
        """Whether every ladder of a group is behind the points that there are."""
        return all(run.behind(self.points) for run in runs)

    def try_point(self, group: tuple[str, str], sweep_point: SweepPoint) -> Point | None:
        """The point of a rung, or None and a warning where the scene cannot be fused so; group is the kind,
        and a name of what loads the same kernels.
        """
        kind, path, request = group[0], next(self.paths), self.request
        flags = flags_of(kind, sweep_point, request.seed)
        same = {
            name: getattr(request, name) for name in ("memory", "allow_outside", "seed", "device", "threads")
        }
        fuse_request = FuseRequest(
            request.scene, str(path), kind=kind, overwrite=True, **same, **asdict(sweep_point)
        )
        try:
            if group not in self.warm:  # the first of a group also loads kernels, so the second one counts
                self.fuse(fuse_request)
                self.warm.add(group)
            report, warnings = self.fuse(fuse_request)
        except FusedRFError as error:
            if isinstance(error, InvalidInput):  # this scene never becomes that kind
                self.refused[kind] = error
            self.progress.warn(f"left out {flags}: {error}")
            return None
        quality = self.benchmark.quality(path)
        cost = {"seconds": report["total_seconds"], "bytes": report["bytes"]}
        point = Point(flags, kind, **quality, **cost)
        point.warnings = warnings
        self.points.append(point)
        self.bundles.append(path)
        self.progress.note(f"{point.flags}: {point.psnr:.2f} dB, {point.bytes:,} bytes")
        return point

    def fuse(self, fuse_request: FuseRequest) -> tuple[dict, list[str]]:
        """A fuse's report, and what it warned of."""
        progress = NullProgress()
        return fuse(
            fuse_request, progress, scene_as_stored, lambda output, write: write(output)
        ), progress.warnings


def mark_frontiers(points: list[Point]) -> None:
    """Note at every point for which costs (plots.AXES) no other one is at least as good for less. Times that
    differ by less than `noise` are taken as equal.
    """
    for cost in plots.AXES:
        margin, least = 1 if cost == "bytes" else 1 + current(ChartConfig).noise, np.inf
        for point in sorted(points, key=lambda p: (-p.psnr, getattr(p, cost), p.seconds)):
            if getattr(point, cost) * margin < least:
                least = getattr(point, cost)
                point.frontier.append(cost)


def write_csv(path: Path, points: list[Point], composed: dict) -> None:
    """All points, and the scene as composed, one per line."""
    columns = ("flags", "kind", "psnr", "covered", "ssim", "seconds", "bytes", "ms")
    with path.open("w", newline="", encoding="utf-8") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow([*columns, "frontier"])
        table.writerow(["", "composed", "", "", "", "", composed["bytes"], f"{composed['ms']:.3f}"])
        for p in points:
            values = (p.flags, p.kind, f"{p.psnr:.3f}", f"{p.covered:.3f}", f"{p.ssim:.5f}")
            table.writerow([*values, f"{p.seconds:.3f}", p.bytes, f"{p.ms:.3f}", " ".join(p.frontier)])
