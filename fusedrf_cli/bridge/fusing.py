"""`fuse`: a scene to a bundle, of any kinds, by one search over the ways and sizes it can be made in."""

import math
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace

from formats.bundle import OpenBundle
from fusedrf_cli.bridge.background import Background, background_for
from fusedrf_cli.bridge.building import BestTrial, BuildingConfig, FuseScene, Maker
from fusedrf_cli.bridge.bundling import FusedBundle, stored_bytes, unchanged_bytes
from fusedrf_cli.bridge.capture_cameras import result_cameras, result_view_box
from fusedrf_cli.bridge.cutting import cut_to_crops
from fusedrf_cli.bridge.fuse_report import check_target, chosen_of, figures_of, fused_entry, reached_by
from fusedrf_cli.bridge.memory import Memory, MemoryConfig, asking_in_waves, stages, will_learn
from fusedrf_cli.bridge.memory import sources as in_memory
from fusedrf_cli.bridge.rendering import warn_of_work
from fusedrf_cli.bridge.runtime import (
    Saved,
    check_checkpoint,
    checkpoint_mismatch,
    checkpoint_path,
    engine,
    load_checkpoint,
    without_interrupts,
    written_somewhere,
)
from fusedrf_cli.bridge.scene import (
    LoadedScene,
    note_options,
    refuse_options,
    unusable_kind,
)
from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.bridge.sources import load_to_fuse
from fusedrf_cli.bridge.storage_search import StorageSearch, Trial
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.resolution_report import ResolutionConfig, ResolutionReport
from fusedrf_cli.engine.fields.base import is_occupied
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import BuildRequest, DistilledBuilder, TooSmall
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.rendering.metrics import PSNR_CAP
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.report import readable_size
from fusedrf_cli.requests import FuseRequest


@dataclass(frozen=True)
class FusingConfig:
    """What a fuse keeps within, and tells."""

    default_max_size: int = 25_000_000
    """Bytes, beside what the places among the sources take."""
    condition_noted: float = 1.01
    """A stretch beyond this shows in a translucent medium (by 1/255 of its opacity)."""


Load = Callable[[FuseRequest, Memory, str, object], LoadedScene]
"""What is to be fused, within a memory, on a device, with a progress that is told of what goes on."""


class NodesTooLarge(UsageProblem):
    """No way to keep the sources as nodes fits the size that is allowed."""

    def __init__(self, size: str, kind: str):
        """size: what they take at their coarsest; kind: of one field that may be learnt instead."""
        super().__init__(f"as nodes the sources take {size} at their coarsest")
        self.kind = kind


def fuse(
    request: FuseRequest, progress, load: Load = load_to_fuse, somewhere: Callable = written_somewhere
) -> dict:
    """Turn a composed scene into a bundle of it, of one field or of a field for each source, with the scene's
    history; `somewhere` writes, as `written_somewhere` does. Where `auto` would keep the sources as nodes and
    these do not fit, one field is learnt; a run that goes on learns the kind that it had chosen."""
    if (chosen := chosen_before(request)) is not None:
        report = fuse_as(replace(request, kind=chosen), progress, load, somewhere, nodes_fit=False)
        return report | {"kind_because": "the run that went on had chosen it"}
    try:
        return fuse_as(request, progress, load, somewhere)
    except NodesTooLarge as error:
        progress.warn(f"{error}, more than --max-size: one field of the kind {error.kind} is learnt instead")
        try:
            report = fuse_as(replace(request, kind=error.kind), progress, load, somewhere, nodes_fit=False)
        except UsageProblem as neither:
            raise UsageProblem(f"{neither}; {error}") from neither
        return report | {"kind_because": str(error)}


def chosen_before(request: FuseRequest) -> str | None:
    """The kind of field that a run to go on had chosen; None where there is none to go on, or it said so."""
    if not request.resume or request.kind != registry.AUTO:
        return None
    name = load_checkpoint(request.output, "fuse")[1].get("kind")
    return name if name in registry.names() and registry.kind(name).field is not None else None


def fuse_as(request: FuseRequest, progress, load: Load, somewhere: Callable, nodes_fit: bool = True) -> dict:
    """`fuse` by the kind that suits the scene; nodes_fit: whether its sources may be told to stay nodes.
    Raises NodesTooLarge."""
    started = time.monotonic()
    with engine(request.device, request.threads, progress) as device:
        progress.phase("reading", None)
        check_checkpoint(request.output, request.resume, request.overwrite)
        saved = load_checkpoint(request.output, "fuse") if request.resume else None
        memory = Memory(request.memory)
        everything = load(request, memory, device, progress)
        kind, suits = choose_kind(request.kind, everything, everything.composed())
        if kind.field is not None or not may_stay_as_it_is(request, everything):
            everything = cut_to_crops(everything)
        loaded = without_empty(everything, request.scene, progress)
        scene = FuseScene.of(loaded)
        refuse_options(kind, request)
        if kind.field is None:
            note_options(request, loaded, progress)
        bundle = FusedBundle(request, everything, scene, kind.field is not None)
        warn_of_hidden(bundle.hidden, progress)
        cameras = result_cameras(loaded, progress)
        bundle.shown_as(result_view_box(loaded, scene.composed, cameras), cameras)
        pixels = current(BuildingConfig).views * current(DistilConfig).view_size ** 2
        warn_of_work(request.scene, scene.composed, pixels, progress)
        made = best_of(request, scene, kind, bundle.overhead, memory, device, progress, saved)
        entry = fused_entry(request, kind.name, loaded.composition, made.kept, made.builder)
        with without_interrupts(request.output):  # what was made comes before what is found out about it
            size = somewhere(
                request.output, lambda output: bundle.write(output, made.kept, made.background, entry)
            )
            checkpoint_path(request.output).unlink(missing_ok=True)
        reports = made.resolution_reports()
        other = best_suited(scene.composed)[0] if nodes_fit else kind
        warn_of_resolution(reports, remedy(kind, other), progress)
        if kind.field is None and request.max_size is None:
            warn_of_default_size(made.builder.request, progress)
        figures = made.figures()
    report = {
        "output": request.output,
        "bytes": size,
        "source_bytes": source_bytes(loaded),
        "kind": kind.name,
        **({"kind_because": suits} if request.kind == registry.AUTO else {}),
        **figures,
        "objects": [asdict(d) for d in reports],
        "total_seconds": time.monotonic() - started,
        "memory": memory.report(),
    }
    check_target(report, request.target_psnr, request.output)
    return report


@dataclass(frozen=True)
class Candidate:
    """The best of what was made of a scene."""

    kept: BestTrial
    builder: DistilledBuilder
    figures: Callable[[], dict]
    """What tells of it for the report, which may try more."""
    background: Background | None = None
    """That stays beside it."""

    def resolution_reports(self) -> list[ResolutionReport]:
        """What it holds of the scene's objects."""
        if self.background is None:
            return self.builder.resolution_reports(self.kept.field)
        _, learnt = self.kept.field.placed
        return [self.background.detail, *self.builder.resolution_reports(learnt.field)]


def best_of(
    request: FuseRequest,
    scene: FuseScene,
    kind: Kind,
    overhead: int,
    memory: Memory,
    device: str,
    progress,
    saved: Saved | None = None,
) -> Candidate:
    """The best stand of a kind for a scene; overhead: bytes of the bundle besides its fields. UsageProblem
    where nothing fits the size that is allowed."""
    builder_request = build_request(request, scene, overhead)
    background = background_for(kind, scene.composed, builder_request)
    composed = scene.composed
    if background is not None:
        composed, builder_request = (
            background.objects,
            replace(builder_request, overhead=overhead + background.bytes),
        )
    try:
        builder = kind.builder(composed, builder_request)
        if builder.unchanged() is not None:
            return as_it_is(builder, scene)
        together = make_room(memory, builder, scene, request)
        maker, choosing, seconds = begin(builder, scene, request, device, progress, together, background)
        kept = search(maker, choosing, builder, request, saved, seconds)
    except TooSmall as error:
        size = readable_size(error.smallest)
        if request.kind == registry.AUTO and kind.field is None:
            best = best_suited(composed, builder_request.limit - builder_request.overhead)[0]
            raise NodesTooLarge(size, best.name) from error
        raise UsageProblem(
            f"--max-size is too small: the file takes {size} at its coarsest, "
            f"where {readable_size(builder_request.limit)} were allowed; give more"
        ) from error
    return Candidate(kept, builder, lambda: figures_of(kept, maker, choosing, seconds), background)


def as_it_is(builder: DistilledBuilder, scene: FuseScene) -> Candidate:
    """A scene whose fields are all as their sources have them: it shows what the scene does."""
    whole, storage = builder.unchanged(), builder.plain()
    trial = Trial(storage, builder.request.limit, whole.bytes, PSNR_CAP, PSNR_CAP, True, True)
    kept = BestTrial(trial, whole.field, own_storage=whole.storage)

    def figures() -> dict:
        return {"psnr": reached_by(kept, builder), "seconds": {}} | chosen_of(kept, builder, scene, 1, {})

    return Candidate(kept, builder, figures)


def limit_of(request: FuseRequest, loaded: LoadedScene) -> int:
    """Bytes of the file, at most."""
    return request.max_size or current(FusingConfig).default_max_size + unbounded_bytes(loaded)


def may_stay_as_it_is(request: FuseRequest, loaded: LoadedScene) -> bool:
    """Whether the fields of a scene that stay nodes may all keep their bytes."""
    changes = request.precision or request.ranks or request.sh_degree is not None or request.target_psnr
    size = unchanged_bytes(loaded)
    return not changes and size is not None and size <= limit_of(request, loaded)


def build_request(request: FuseRequest, scene: FuseScene, overhead: int) -> BuildRequest:
    """What is asked of the kind's student; overhead: bytes of the bundle besides its fields."""
    return BuildRequest(
        sizes=BundleSizes(),
        limit=limit_of(request, scene.loaded),
        overhead=overhead,
        target=request.target_psnr,
        precision=request.precision,
        ranks=request.ranks,
        sh_degree=request.sh_degree,
        source_bytes=tuple(scene.loaded.sizes),
        stored_bytes=stored_bytes(scene.loaded),
        unchanged_bytes=unchanged_bytes(scene.loaded),
        seconds=request.time_budget,
        from_scratch=request.from_scratch,
        views=scene.views,
    )


# -- kinds ---------------------------------------------------------------------------------------------------


def choose_kind(name: str, loaded: LoadedScene, composed: ComposedField) -> tuple[Kind, str]:
    """The kind that was asked for, or for auto the one that says of itself that it suits the scene best; and
    why it does. InvalidInput where it cannot hold the scene."""
    if name == registry.AUTO:
        return best_suited(composed)
    try:
        kind = registry.kind(name)
    except ValueError as error:
        raise unusable_kind(error) from error
    suits = kind.suits(composed)
    if suits.score is None:
        raise InvalidInput(f"{loaded.path}: {suits.why}; use --kind {best_suited(composed)[0].name}")
    return kind, suits.why


def best_suited(composed: ComposedField, learnt_within: int | None = None) -> tuple[Kind, str]:
    """The kind that suits a scene best, and why; learnt_within: bytes of those that make one field of it,
    None: all."""
    every = learnt_within is None
    suited = [(k.suits(composed, learnt_within), k) for k in registry.kinds() if every or k.field is not None]
    suits, kind = max((pair for pair in suited if pair[0].score is not None), key=lambda pair: pair[0].score)
    return kind, suits.why


def remedy(kind: Kind, best: Kind) -> str:
    """What helps an object that is held too coarsely by a kind, where another one is the best."""
    return "a larger --max-size" if best is kind else f"--kind {best.name}, or a larger --max-size"


# -- the search ----------------------------------------------------------------------------------------------


def begin(
    builder: DistilledBuilder,
    scene: FuseScene,
    request: FuseRequest,
    device: str,
    progress,
    together: bool,
    background: Background | None = None,
) -> tuple[Maker, StorageSearch, dict[str, float]]:
    """What makes students, what chooses among them, and the seconds that measuring the scene took."""
    started = time.monotonic()
    progress.phase("measuring", None)
    maker = Maker(builder, scene, request, device, progress, together, background)
    choosing = StorageSearch(maker.make, builder.kind.name, progress.note)
    progress.phase(builder.kind.name, None)
    return maker, choosing, {"measuring the scene": time.monotonic() - started}


def search(
    maker: Maker,
    choosing: StorageSearch,
    builder: DistilledBuilder,
    request: FuseRequest,
    saved: Saved | None,
    seconds: dict[str, float],
) -> BestTrial:
    """The best of what was tried, its numbers as they were measured. Raises TooSmall where nothing fits."""
    started = time.monotonic()
    if saved is not None:
        if saved[1].get("kind") != builder.kind.name or not (builder.learnt or maker.tries_once):
            raise checkpoint_mismatch(request.output)
        maker.saved = saved
    if builder.learnt:
        choosing.first_reaching(maker.learn(), request.target_psnr)
    else:
        choose(choosing, builder, request)
    if maker.best is None:
        raise TooSmall(builder.smallest())
    seconds["making"] = time.monotonic() - started
    return maker.best


def choose(choosing: StorageSearch, builder: DistilledBuilder, request: FuseRequest) -> Trial | None:
    """The best of the ways that need no learning to begin with; None where none fits."""
    groups, limit, target = builder.storage_settings(), builder.request.limit, request.target_psnr
    trial = None
    if target is not None:
        trial = choosing.smallest_reaching(groups, target, limit, builder.gain if request.finetune else 0.0)
    elif not builder.compares:
        return choosing.make(builder.plain(), limit, True)
    else:
        plain = choosing.make(builder.plain(), limit, False)
        if plain is not None and plain.whole:
            return choosing.make(builder.plain(), limit, True)
    if trial is None:
        storage_settings = (
            [storage for group in groups for storage in group] if builder.compares else [builder.plain()]
        )
        trial = choosing.best_within(storage_settings, limit)
    return trial


# -- the scene -----------------------------------------------------------------------------------------------


def source_bytes(loaded: LoadedScene) -> int:
    """Bytes of the distinct source files."""
    return file_bytes(f.bundle for f in loaded.fields)


def unbounded_bytes(loaded: LoadedScene) -> int:
    """Bytes of the distinct source files of fields that fill all of space."""
    return file_bytes(f.bundle for f in loaded.fields if f.placed.unbounded)


def file_bytes(bundles: Iterable[OpenBundle]) -> int:
    """Bytes of the distinct files."""
    return sum(bundle.size for bundle in set(bundles))


def without_empty(loaded: LoadedScene, scene: str, progress) -> LoadedScene:
    """The scene without the fields that show nothing, each named in a warning; InvalidInput where none is
    left."""
    full = {id(p.field): p.field for p in loaded.placed}
    full = {key for key, field in full.items() if is_occupied(field)}
    for f in loaded.fields:
        if id(f.placed.field) not in full:
            progress.warn(f"'{f.placed.name}' is empty and was left out")
    fields = tuple(f for f in loaded.fields if id(f.placed.field) in full)
    if not fields:
        raise InvalidInput(f"{scene}: all its fields are empty; train them again")
    return replace(loaded, fields=fields)


def warn_of_hidden(names: list[str], progress) -> None:
    """Say which nodes are left out because they are hidden."""
    if names:
        few = ", ".join(f"'{name}'" for name in names[:5]) + (", …" if len(names) > 5 else "")
        progress.warn(f"what is hidden was left out: {few}; show it to have it fused")


def make_room(memory: Memory, builder: DistilledBuilder, scene: FuseScene, request: FuseRequest) -> bool:
    """Keep no more sources in memory than fit beside what every stage of a student needs; ResourceProblem
    where not even the largest does. Whether all of them may be held at once."""
    needed = stages(builder, scene.composed, request, builder.scene)
    sizes, field_cache = scene.loaded.sizes, scene.loaded.field_cache
    room = min(memory.room(parts) - copies * max(sizes) for copies, parts in needed)
    together = room >= sum(sizes)
    if not together and builder.distil_config is None and will_learn(builder, request):
        needed.append((0.0, asking_in_waves(builder, scene.composed)))
    if not together:  # then one is read now and then in every stage
        needed = [(max(copies, current(MemoryConfig).reading), parts) for copies, parts in needed]
        room = min(memory.room(parts) - copies * max(sizes) for copies, parts in needed)
    field_cache.resize(room)
    memory.expect(
        *(in_memory(sizes, field_cache.room, copies) | parts for copies, parts in needed),
        advice="give a smaller --max-size",
    )
    return together


def warn_of_default_size(request: BuildRequest, progress) -> None:
    """Say which size would have kept the sources as they are, where only the default one was in the way."""
    size = request.unchanged_bytes and request.overhead + request.unchanged_bytes
    changes = request.precision or request.ranks or request.sh_degree is not None or request.target
    if size and size > request.limit and not changes:
        progress.warn(
            f"fields were made smaller to fit into {readable_size(request.limit)}, the limit where none is "
            f"given; --max-size {math.ceil(size / 1e6)}MB would keep the sources as they are"
        )


def warn_of_resolution(reports: list[ResolutionReport], remedy: str, progress) -> None:
    """Say which objects a fused field will not hold as they are: stretched translucent ones, and those it has
    too few voxels for."""
    config = current(ResolutionConfig)
    for d in reports:
        if d.opacity_off and d.stretch > current(FusingConfig).condition_noted:
            progress.warn(
                f"'{d.name}' is stretched by {d.stretch:.2f}: where it is translucent its "
                f"opacity may be off by up to {d.opacity_off:.3f}"
            )
        if d.voxels_across < config.enough_voxels:
            progress.warn(f"'{d.name}' is only {d.voxels_across:.2g} voxels across; use {remedy}")
    if coarse := [d for d in reports if d.held_voxel > config.noted * d.own_voxel]:
        worst = max(coarse, key=lambda d: d.held_voxel / d.own_voxel)
        progress.warn(
            f"{len(coarse)} of {len(reports)} objects are held at coarser voxels than their own, "
            f"'{worst.name}' at {worst.held_voxel / worst.own_voxel:.1f} times; use {remedy}"
        )
