"""`fuse`: a scene to a bundle, of any kinds, by one search over the ways and sizes it can be made in."""

import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, replace

from formats.bundle import OpenBundle
from fusedrf_cli.bridge.background import Background, kept_background
from fusedrf_cli.bridge.bundling import FusedBundle, stored_bytes, unchanged_bytes
from fusedrf_cli.bridge.choose import Choosing, Tried, flags
from fusedrf_cli.bridge.making import Kept, Maker, MakingConfig, Result, Scene
from fusedrf_cli.bridge.memory import Memory, MemoryConfig, asking_in_waves, learning_is_asked, stages
from fusedrf_cli.bridge.memory import sources as in_memory
from fusedrf_cli.bridge.rendering import tell_of_work
from fusedrf_cli.bridge.rigs import kept_cameras, kept_framing
from fusedrf_cli.bridge.running import (
    Saved,
    check_checkpoint,
    checkpoint_mismatch,
    checkpoint_path,
    engine,
    held_back,
    load_checkpoint,
    written_somewhere,
)
from fusedrf_cli.bridge.scene import LoadedScene, note_options, refuse_options, unusable_kind
from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.bridge.sources import load_to_fuse
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.detail import Detail, DetailConfig
from fusedrf_cli.engine.fields.base import holds_matter
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.instances import distinct_fields
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.student import DistilConfig, Student, StudentRequest, TooSmall
from fusedrf_cli.engine.rendering.metrics import PSNR_CAP
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import InvalidInput, QualityNotReached, UsageProblem
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


def fuse(
    request: FuseRequest, progress, load: Load = load_to_fuse, somewhere: Callable = written_somewhere
) -> dict:
    """Turn a composed scene into a bundle of it, of one field or of a field for each source, with the scene's
    history; `somewhere` writes, as `written_somewhere` does."""
    with engine(request.device, request.threads, progress) as place:
        progress.phase("reading", None)
        check_checkpoint(request.output, request.resume, request.overwrite)
        saved = load_checkpoint(request.output, "fuse") if request.resume else None
        memory = Memory(request.memory)
        everything = load(request, memory, place, progress)
        loaded = without_empty(everything, request.scene, progress)
        scene = Scene.of(loaded)
        kind, suits = choose_kind(request.kind, loaded, scene.composed)
        refuse_options(kind, request)
        if kind.field is None:
            note_options(request, loaded, progress)
        started = time.monotonic()
        bundle = FusedBundle(request, everything, loaded, kind.field is not None)
        cameras = kept_cameras(loaded, progress)
        bundle.shown_as(kept_framing(loaded, scene.composed, cameras), cameras)
        pixels = current(MakingConfig).views * DistilConfig.view_size**2
        tell_of_work(request.scene, scene.composed, pixels, progress)
        made = best_of(request, scene, kind, bundle.overhead, memory, place, progress, saved)
        entry = {
            "event": "fused",
            "kind": kind.name,
            "composition": loaded.composition,
            "settings": {
                "seed": request.seed,
                "max_size": made.student.request.limit,
                "rgb": request.finetune,
                "from_scratch": request.from_scratch,
            },
            "psnr": reached_by(made.kept, made.student),
        }
        with held_back(request.output):  # what was made comes before what is found out about it
            size = somewhere(
                request.output, lambda output: bundle.write(output, made.kept, made.background, entry)
            )
            checkpoint_path(request.output).unlink(missing_ok=True)
        details = made.details()
        warn_of_detail(details, remedy(kind, loaded, scene.composed), progress)
        figures = made.figures()
    report = {
        "output": request.output,
        "bytes": size,
        "source_bytes": source_bytes(loaded),
        "kind": kind.name,
        **({"kind_because": suits} if request.kind == registry.AUTO else {}),
        **figures,
        "objects": [asdict(d) for d in details],
        "total_seconds": time.monotonic() - started,
        "memory": memory.report(),
    }
    check_target(report, request.target_psnr, request.output)
    return report


@dataclass(frozen=True)
class Made:
    """The best of what was made of a scene."""

    kept: Kept
    student: Student
    figures: Callable[[], dict]
    """What tells of it for the report, which may try more."""
    background: Background | None = None
    """That stays beside it."""

    def details(self) -> list[Detail]:
        """What it holds of the scene's objects."""
        if self.background is None:
            return self.student.details(self.kept.field)
        _, learnt = self.kept.field.placed
        return [self.background.detail, *self.student.details(learnt.field)]


def best_of(
    request: FuseRequest,
    scene: Scene,
    kind: Kind,
    overhead: int,
    memory: Memory,
    place: str,
    progress,
    saved: Saved | None = None,
) -> Made:
    """The best stand of a kind for a scene; overhead: bytes of the bundle besides its fields. UsageProblem
    where nothing fits the size that is allowed."""
    asked = student_request(request, scene, overhead)
    background = kept_background(kind, scene.composed, asked)
    composed = scene.composed
    if background is not None:
        composed, asked = background.objects, replace(asked, overhead=overhead + background.bytes)
    try:
        student = kind.student(composed, asked)
        if student.unchanged() is not None:
            return as_it_is(student, scene)
        together = make_room(memory, student, scene, request)
        maker, choosing, seconds = begin(student, scene, request, place, progress, together, background)
        kept = search(maker, choosing, student, request, saved, seconds)
    except TooSmall as error:
        raise UsageProblem(
            f"--max-size is too small: the file takes {readable_size(error.smallest)} at its coarsest, "
            f"where {readable_size(asked.limit)} were allowed; give more"
        ) from error
    return Made(kept, student, lambda: figures_of(kept, maker, choosing, seconds), background)


def as_it_is(student: Student, scene: Scene) -> Made:
    """A scene whose fields are all as their sources have them: it shows what the scene does."""
    whole, way = student.unchanged(), student.plain()
    tried = Tried(way, student.request.limit, whole.bytes, PSNR_CAP, PSNR_CAP, True, True)
    kept = Kept(tried, whole.field)

    def figures() -> dict:
        return {"psnr": reached_by(kept, student), "seconds": {}} | chosen_of(kept, student, scene, 1, {})

    return Made(kept, student, figures)


def student_request(request: FuseRequest, scene: Scene, overhead: int) -> StudentRequest:
    """What is asked of the kind's student; overhead: bytes of the bundle besides its fields."""
    return StudentRequest(
        sizes=BundleSizes(),
        limit=request.max_size or current(FusingConfig).default_max_size + place_bytes(scene.loaded),
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


def best_suited(composed: ComposedField) -> tuple[Kind, str]:
    """The kind that suits a scene best, and why."""
    found = [(kind.suits(composed), kind) for kind in registry.kinds()]
    suits, kind = max((pair for pair in found if pair[0].score is not None), key=lambda pair: pair[0].score)
    return kind, suits.why


def remedy(kind: Kind, loaded: LoadedScene, composed: ComposedField) -> str:
    """What helps an object that is held too coarsely."""
    best = best_suited(composed)[0]
    return "a larger --max-size" if best is kind else f"--kind {best.name}, or a larger --max-size"


# -- the search ----------------------------------------------------------------------------------------------


def begin(
    student: Student,
    scene: Scene,
    request: FuseRequest,
    place: str,
    progress,
    together: bool,
    background: Background | None = None,
) -> tuple[Maker, Choosing, dict[str, float]]:
    """What makes students, what chooses among them, and the seconds that measuring the scene took."""
    started = time.monotonic()
    progress.phase("measuring", None)
    maker = Maker(student, scene, request, place, progress, together, background)
    choosing = Choosing(maker.make, student.kind.name, progress.note)
    progress.phase(student.kind.name, None)
    return maker, choosing, {"measuring the scene": time.monotonic() - started}


def search(
    maker: Maker,
    choosing: Choosing,
    student: Student,
    request: FuseRequest,
    saved: Saved | None,
    seconds: dict[str, float],
) -> Kept:
    """The best of what was tried, its numbers as they were measured. Raises TooSmall where nothing fits."""
    started = time.monotonic()
    if saved is not None:
        if saved[1].get("kind") != student.kind.name or not (student.learnt or maker.tries_once):
            raise checkpoint_mismatch(request.output)
        maker.saved = saved
    if student.learnt:
        choosing.first_reaching(maker.learn(), request.target_psnr)
    else:
        choose(choosing, student, request)
    if maker.best is None:
        raise TooSmall(student.smallest())
    seconds["making"] = time.monotonic() - started
    return maker.best


def choose(choosing: Choosing, student: Student, request: FuseRequest) -> Tried | None:
    """The best of the ways that need no learning to begin with; None where none fits."""
    groups, limit, target = student.ways(), student.request.limit, request.target_psnr
    found = None
    if target is not None:
        found = choosing.smallest_reaching(groups, target, limit, student.gain if request.finetune else 0.0)
    elif not student.compares:
        return choosing.make(student.plain(), limit, True)
    else:
        plain = choosing.make(student.plain(), limit, False)
        if plain is not None and plain.whole:
            return choosing.make(student.plain(), limit, True)
    if found is None:
        ways = [way for group in groups for way in group] if student.compares else [student.plain()]
        found = choosing.best_within(ways, limit)
    return found


def reached_by(found: Kept, student: Student) -> dict:
    """The dB that a choice reached on the views that it was chosen by."""
    tried, did = found.tried, found.did
    learnt = did is not None and student.learnt
    after = did.psnr_after_rgb if learnt else tried.psnr if tried.psnr > tried.before else None
    psnr = {"before_rgb": tried.before, "after_rgb": after}
    return psnr | ({"rgb_kept": did.rgb_kept} if learnt else {}) | {"stored": tried.psnr}


def figures_of(found: Kept, maker: Maker, choosing: Choosing, seconds: dict[str, float]) -> dict:
    """What the report says of a choice."""
    tried, did, student, request = found.tried, found.did, maker.student, maker.request
    learnt = did is not None and student.learnt
    count = len(choosing.tried)
    started = time.monotonic()
    neighbours = {}
    if student.learnt and count > 1:
        neighbours = {"next_smaller": choosing.tried[-2].report(student.kind.name)}
    elif not student.learnt and (count > 1 or request.target_psnr is not None) and not maker.budget.over:
        neighbours = choosing.neighbours(tried)
        seconds["neighbours"] = time.monotonic() - started
    figures = {
        "psnr": reached_by(found, student) | maker.verdict(found),
        "seconds": seconds | (did.seconds if did is not None else {}),
    }
    if learnt:
        figures["steps"] = did.steps
        figures["curve"] = [dict(zip(("seconds", "steps", "psnr"), p, strict=True)) for p in did.curve]
    told = chosen_of(found, student, maker.scene, count, neighbours, maker.background)
    return figures | told | (did.numeric if did is not None else {})


def chosen_of(
    found: Kept,
    student: Student,
    scene: Scene,
    count: int,
    neighbours: dict,
    background: Background | None = None,
) -> dict:
    """What the report says of what was chosen, of so many choices, and of how many nodes it is."""
    field, tried = found.field, found.tried
    nodes = len(field.leaves()) if isinstance(field, ComposedField) else 1
    fields = len(distinct_fields(field)) if isinstance(field, ComposedField) else 1
    own = field if background is None else field.placed[1].field
    return {
        "nodes": nodes,
        "fields": fields,
        "chosen": {
            **student.kind.describe(own),
            "precision": tried.way.precision,
            "flags": flags(student.kind.name, tried.way, tried.limit),
            "why": why(found, own, student, count, background),
            **({"start": found.start} if found.start else {}),
            "voxel": float(own.voxel_size),
            "finest_teacher_voxel": float(scene.composed.voxel_size),
            **neighbours,
        },
    }


def why(
    found: Kept, field: Result, student: Student, count: int, background: Background | None = None
) -> str:
    """One sentence on the choice of a field."""
    what, target = student.why(field), student.request.target
    if background is not None:
        name, kind = background.placed.name, student.kind.name
        what = f"'{name}' as it is, and one {kind} field for all that stands in it"
    if target is not None and found.tried.psnr >= target:
        return f"{what}: the smallest that reaches {target:g} dB, of {count} choices tried"
    if count > 1:
        return f"{what}: the best under {student.request.limit} bytes, of {count} choices tried"
    if found.tried.exact:
        return f"{what}, as the sources have them"
    return f"{what}, under {student.request.limit} bytes"


def check_target(report: dict, target_psnr: float | None, output: str) -> None:
    """QualityNotReached, after the output was written, where a target was given and missed."""
    reached = report["psnr"]["stored"]
    if target_psnr is not None and reached < target_psnr:
        raise QualityNotReached(
            f"{output}: reached {reached:.2f} dB where --target-psnr asked for {target_psnr:g}; give more "
            "--max-size or --time-budget",
            report=report,
        )


# -- the scene -----------------------------------------------------------------------------------------------


def source_bytes(loaded: LoadedScene) -> int:
    """Bytes of the distinct source files."""
    return file_bytes(f.bundle for f in loaded.fields)


def place_bytes(loaded: LoadedScene) -> int:
    """Bytes of the distinct source files of fields that fill all of space."""
    return file_bytes(f.bundle for f in loaded.fields if f.placed.unbounded)


def file_bytes(bundles: Iterable[OpenBundle]) -> int:
    """Bytes of the distinct files."""
    return sum(bundle.size for bundle in set(bundles))


def without_empty(loaded: LoadedScene, scene: str, progress) -> LoadedScene:
    """The scene without the fields that show nothing, each named in a warning; InvalidInput where none is
    left."""
    full = {id(p.field): p.field for p in loaded.placed}
    full = {key for key, field in full.items() if holds_matter(field)}
    for f in loaded.fields:
        if id(f.placed.field) not in full:
            progress.warn(f"'{f.placed.name}' is empty and was left out")
    kept = tuple(f for f in loaded.fields if id(f.placed.field) in full)
    if not kept:
        raise InvalidInput(f"{scene}: all its fields are empty; train them again")
    return replace(loaded, fields=kept)


def make_room(memory: Memory, student: Student, scene: Scene, request: FuseRequest) -> bool:
    """Keep no more sources in memory than fit beside what every stage of a student needs; ResourceProblem
    where not even the largest does. Whether all of them may be held at once."""
    needed = stages(student, scene.composed, request, student.scene)
    sizes, shelf = scene.loaded.sizes, scene.loaded.shelf
    room = min(memory.room(parts) - copies * max(sizes) for copies, parts in needed)
    together = room >= sum(sizes)
    if not together and student.lesson is None and learning_is_asked(student, request):
        needed.append((0.0, asking_in_waves(student, scene.composed)))
    if not together:  # then one is read now and then in every stage
        needed = [(max(copies, current(MemoryConfig).reading), parts) for copies, parts in needed]
        room = min(memory.room(parts) - copies * max(sizes) for copies, parts in needed)
    shelf.resize(room)
    memory.expect(
        *(in_memory(sizes, shelf.room, copies) | parts for copies, parts in needed),
        advice="give a smaller --max-size",
    )
    return together


def warn_of_detail(details: list[Detail], remedy: str, progress) -> None:
    """Say which objects a fused field will not hold as they are: stretched translucent ones, and those it has
    too few voxels for."""
    config = current(DetailConfig)
    for d in details:
        if d.opacity_off and d.stretch > current(FusingConfig).condition_noted:
            progress.warn(
                f"'{d.name}' is stretched by {d.stretch:.2f}: where it is translucent its "
                f"opacity may be off by up to {d.opacity_off:.3f}"
            )
        if d.voxels_across < config.enough_voxels:
            progress.warn(f"'{d.name}' is only {d.voxels_across:.2g} voxels across; use {remedy}")
    if coarse := [d for d in details if d.held_voxel > d.own_voxel * (1 + 1e-6)]:
        worst = max(coarse, key=lambda d: d.held_voxel / d.own_voxel)
        progress.warn(
            f"{len(coarse)} of {len(details)} objects are held at coarser voxels than their own, "
            f"'{worst.name}' at {worst.held_voxel / worst.own_voxel:.1f} times; use {remedy}"
        )
