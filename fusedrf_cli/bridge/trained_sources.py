"""`train`: photos or meshes to fields, of one source to one alone, of several to as many that share a
decoder."""

import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from formats.atomic import check_space
from formats.graph import free_name
from formats.meshes import is_mesh
from formats.scene import SceneGraph
from fusedrf_cli.bridge.capture_cameras import cameras_of_capture, chosen_camera_set
from fusedrf_cli.bridge.depth_supervision import known_points
from fusedrf_cli.bridge.field_bundle import check_graph, stored, write_fields
from fusedrf_cli.bridge.holdout_evaluation import measure, warn_of_holdout
from fusedrf_cli.bridge.memory import Memory, together
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.pose_refinement import aligned, moved, with_poses
from fusedrf_cli.bridge.runtime import (
    check_checkpoint,
    checkpoint_mismatch,
    checkpoint_path,
    engine,
    load_checkpoint,
    resumable,
    take_up,
    without_interrupts,
    written_somewhere,
)
from fusedrf_cli.bridge.scene import PlacedCameraSet
from fusedrf_cli.bridge.scene_bounds import check_flatness, scene_bounds_of
from fusedrf_cli.bridge.sizes import camera_bytes
from fusedrf_cli.bridge.training import (
    TrainPresets,
    bytes_of,
    fit_memory,
    fit_settings,
    loading,
    masks_object,
    pictures_of,
    read_views,
    trained_kind,
    warn_of_nonfinite,
)
from fusedrf_cli.engine.distillation.fit import FitRun
from fusedrf_cli.engine.distillation.joint_fit import JointFit
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import QualityNotReached, UsageProblem
from fusedrf_cli.requests import TrainRequest


class TrainedSource:
    """One source of a training: its capture, where its field lies, and how that is learnt."""

    def __init__(self, request: TrainRequest, name: str, about: str, progress):
        """request: of this source alone, with its part of bytes and time; name: of its node; about: what
        sentences about its field begin with."""
        self.request, self.name, self.about, self.progress = request, name, about, progress
        self.capture = read_views(request, progress)
        self.cut_out = masks_object(request, self.capture)
        self.bounds = scene_bounds_of(request, self.capture, self.cut_out)
        check_flatness(self.bounds)
        self.camera_content = cameras_of_capture(self.capture, self.cut_out, progress)

    def plan(self, kind: Kind, precision: str, device: str, besides: int) -> None:
        """How it is fitted, with `besides` more bytes in its part of the bundle; see `fit_settings`."""
        self.request = replace(self.request, precision=precision)
        self.settings = fit_settings(self.request, kind, self.capture, self.bounds, device, besides)
        self.planned = kind.untrained(self.bounds.box, self.settings.longest, self.settings.storage)

    def begin(self) -> None:
        """Read the photos; the run before its first step."""
        bounds = self.bounds
        self.cameras = [bounds.camera(camera_of(view)) for view in self.capture.train]
        self.pictures = pictures_of(self.request, self.capture)
        depth_points = known_points(self.capture, bounds)
        name = Path(self.request.source).resolve().stem
        self.run = FitRun.start(
            self.cameras, self.pictures, bounds.box, self.settings, name, bounds.cells, depth_points
        )

    def end(self) -> None:
        """Once its run has ended: warn of what went wrong, and keep the poses that were found."""
        self.run.forget()
        warn_of_nonfinite(self.run.nan_guard.figures(), self.progress)
        if not self.run.found_density:
            self.progress.warn(
                f"{self.about}: no density was found, so that all of the box was kept; look at the photos' "
                "alpha, their poses, and --aabb"
            )
        if self.settings.poses:
            self.capture = with_poses(self.capture, self.bounds, self.run.pool.poses)
            self.camera_content = cameras_of_capture(self.capture, self.cut_out, self.progress)

    def measured(self, field: StoredField) -> dict | None:
        """What photos that were held out say of the field as it is stored; None where none were."""
        if not self.request.holdout:
            return None
        written, bounds = stored(field, self.request.precision), self.bounds
        found = measure(written, self.capture, self.pictures, bounds.origin, self.run.psnr)
        if self.settings.poses:
            found["aligned"] = aligned(written, self.capture, bounds, self.settings.near, self.request.seed)
        if self.capture.kind != "mesh":
            warn_of_holdout(self.about, found, self.progress)
        return found

    def report(self, kind: Kind, field: StoredField) -> dict:
        """What is told of it."""
        run = self.run
        return {
            "views": len(self.capture.train),
            "capture": self.capture.summary(),
            **self.bounds.report(),
            "steps": run.steps,
            **kind.describe(field),
            "training_psnr": run.psnr,
            "holdout": self.measured(field),
            "depths_of_points": run.depth_points and len(run.depth_points.points),
            "exposure": exposure(run),
            "poses": moved(run, self.cameras, self.bounds) if self.settings.poses else None,
            **run.nan_guard.figures(),
        }


def train(request: TrainRequest, progress) -> dict:
    """Fit a field to each source and write them; with `holdout` every N-th view only measures."""
    with engine(request.device, request.threads, progress) as device:
        memory = Memory(request.memory)
        check_checkpoint(request.output, request.resume, request.overwrite)
        saved = load_checkpoint(request.output, "train") if request.resume else None
        trained_kind(request)  # before anything is read
        progress.phase("reading", None)
        sources = read_sources(request, progress)
        kind = trained_kind(request, any(source.bounds.unbounded for source in sources), device)
        plan(request, kind, sources, memory, device)
        for source in sources:
            source.begin()
        run = JointFit([source.run for source in sources]) if request.shared_decoder else sources[0].run
        if saved:
            if saved[1].get("kind") != kind.name:
                raise checkpoint_mismatch(request.output)
            take_up(run, saved, request.output)
        fields, seconds = run_to_end(run, request.output, progress)
        for source in sources:
            source.end()
        with without_interrupts(request.output):  # what was learnt comes before what is found out about it
            size = write(request, sources, fields)
            checkpoint_path(request.output).unlink(missing_ok=True)
        progress.phase("measuring", None)
        told = {
            source.name: source.report(kind, field) for source, field in zip(sources, fields, strict=True)
        }
    report = {
        "output": request.output,
        "bytes": size,
        "kind": kind.name,
        **({"sources": told} if request.shared_decoder else told[sources[0].name]),
        "seconds": {"training": seconds},
        "memory": memory.report(),
    }
    check_quality(request, sources, report)
    return report


def read_sources(request: TrainRequest, progress) -> list[TrainedSource]:
    """Each source, with an equal part of what may be taken of bytes and of time. A source alone is named by
    the output, several by themselves."""
    if not request.shared_decoder:
        return [TrainedSource(request, Path(request.output).stem, request.output, progress)]
    count, names, sources = len(request.sources), set(), []
    for path in request.sources:
        own = replace(
            request,
            source=path,
            shared_decoder=False,
            max_size=request.max_size and max(1, request.max_size // count),
            time_budget=request.time_budget and request.time_budget / count,
        )
        name = free_name(name_of(path), names)
        sources.append(TrainedSource(own, name, f"{request.output}: node '{name}'", progress))
    return sources


def name_of(source: str) -> str:
    """What a node is called that is trained from a source: by its folder, or a mesh."""
    path = Path(source).resolve()
    return path.name if path.is_dir() else path.stem if is_mesh(source) else path.parent.name


def plan(
    request: TrainRequest, kind: Kind, sources: Sequence[TrainedSource], memory: Memory, device: str
) -> None:
    """Plan each fit, and hold against the limits what all will take before any photo is read. All have one
    precision, so that what they share is stored once."""
    unbounded = any(source.bounds.unbounded for source in sources)
    suits = current(TrainPresets).unbounded_precision if unbounded else "float16"
    about = kept_with(sources)
    check_graph(request.output, {source.name: source.bounds.origin for source in sources}, about)
    if about.cameras is None and sum(source.camera_content is not None for source in sources) > 1:
        sources[0].progress.tell(
            f"{request.output}: its nodes are of several captures, so that it keeps the cameras of none"
        )
    besides = camera_bytes(about.cameras)
    for source in sources:
        try:
            source.plan(kind, request.precision or suits, device, besides // len(sources))
        except UsageProblem as error:
            if len(sources) == 1:
                raise
            raise UsageProblem(
                f"{source.request.source}: {error}; all sources have equal parts of it"
            ) from error
    stored_bytes = [bytes_of(source.planned, source.request.precision) for source in sources]
    check_space(request.output, sum(stored_bytes) + besides)
    fits = [fit_memory(source.capture, source.planned, source.settings) for source in sources]
    begun = [together(*fits[:i], loading(source.capture)) for i, source in enumerate(sources)]
    advice = "use a smaller --max-size, fewer or smaller photos, or a lower --quality"
    memory.expect(*begun, together(*fits), advice=advice)


def kept_with(sources: Sequence[TrainedSource]) -> SceneGraph:
    """The graph of a bundle but for its nodes: of several captures it keeps those cameras that a scene of
    them would have."""
    sets = [
        PlacedCameraSet(source.name, False, source.camera_content, np.eye(4))
        for source in sources
        if source.camera_content is not None
    ]
    chosen = chosen_camera_set(tuple(sets))
    return SceneGraph((), cameras=chosen and chosen.cameras)


def run_to_end(run: FitRun | JointFit, output: str, progress) -> tuple[list[StoredField], float]:
    """The learnt fields, and the seconds that it took; an interrupt leaves a checkpoint and goes on its
    way."""
    progress.phase("training", 1.0)
    started = time.monotonic()
    with resumable(output, run.checkpoint, lambda: run.held, progress) as uninterrupted:
        learnt = run.finish(lambda share, figures: progress.advance(share, **figures), uninterrupted)
    return learnt if isinstance(run, JointFit) else [learnt], time.monotonic() - started


def write(request: TrainRequest, sources: Sequence[TrainedSource], fields: Sequence[StoredField]) -> int:
    """Write what was learnt; its bytes."""
    names = [source.name for source in sources]
    return written_somewhere(
        request.output,
        lambda output: write_fields(
            output,
            dict(zip(names, fields, strict=True)),
            {source.name: source.bounds.origin for source in sources},
            precision=sources[0].request.precision,
            overwrite=request.overwrite,
            about=kept_with(sources),
        ),
    )


def check_quality(request: TrainRequest, sources: Sequence[TrainedSource], report: dict) -> None:
    """QualityNotReached, with the report, where a field shows less than was asked for."""
    told = report.get("sources", {sources[0].name: report})
    for source in sources:
        own, target = told[source.name], request.target_psnr
        reached = own["holdout"]["psnr"] if own["holdout"] else own["training_psnr"]
        if target is not None and reached < target:
            raise QualityNotReached(
                f"{source.about}: reached {reached:.2f} dB where --target-psnr asked for {target:g}; give "
                "more --time-budget or --quality best",
                report=report,
            )


def exposure(run: FitRun) -> dict[str, float] | None:
    """The gains of the darkest and the brightest photo, over their geometric mean, where photos were found
    to differ."""
    if run.maps is None:
        return None
    gains = np.exp(np.log(run.maps[:, 0]).mean(1) - np.log(run.maps[:, 0]).mean())
    return {"darkest": float(gains.min()), "brightest": float(gains.max())}
