"""`fuse`: a scene to one field, of any kind, by one search over the ways and sizes it can be made in."""

import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, replace
from pathlib import Path

from formats.bundle import BundleWriter, OpenBundle
from formats.embedding import Embedding
from formats.scene import dump_scene
from fusedrf_cli import __version__
from fusedrf_cli.bridge.choose import Choosing, Tried, flags
from fusedrf_cli.bridge.making import Kept, Maker, MakingConfig, Scene
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
from fusedrf_cli.bridge.scene import (
    LoadedScene,
    check_graph,
    history_nodes,
    refuse_options,
    unusable_kind,
    write_field,
)
from fusedrf_cli.bridge.sizes import BundleSizes, graph_bytes
from fusedrf_cli.bridge.sources import load_to_fuse
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.detail import Detail, DetailConfig
from fusedrf_cli.engine.fields.base import holds_matter
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.student import DistilConfig, Student, StudentRequest, TooSmall
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import InvalidInput, QualityNotReached, UsageProblem
from fusedrf_cli.report import readable_size
from fusedrf_cli.requests import FuseRequest

DEFAULT_MAX_SIZE = 25_000_000  # and what the places among the sources take
FUSED = "fused"  # the node of the field
NODES = "blocks"  # the word by which nothing is learnt: every source stays a node with a field of its own
CONDITION_NOTED = 1.01  # a stretch beyond this shows in a translucent medium (by 1/255 of its opacity)


Load = Callable[[FuseRequest, Memory, str, object], LoadedScene]
"""What is to be fused, within a memory, on a device, with a progress that is told of what goes on."""


def fuse(
    request: FuseRequest, progress, load: Load = load_to_fuse, somewhere: Callable = written_somewhere
) -> dict:
    """Turn a composed scene into one field and write it with the scene's history; `somewhere` writes, as
    `written_somewhere` does."""
    with engine(request.device, request.threads, progress) as place:
        progress.phase("reading", None)
        check_checkpoint(request.output, request.resume, request.overwrite)
        saved = load_checkpoint(request.output, "fuse") if request.resume else None
        memory = Memory(request.memory)
        loaded = load(request, memory, place, progress)
        loaded = without_empty(loaded, request.scene, progress)
        scene = Scene.of(loaded)
        if request.kind == NODES and registry.kind(NODES).suits(scene.composed).score is None:
            return as_nodes(request, loaded, scene.composed, memory, progress)
        kind, suits = choose_kind(request.kind, loaded, scene.composed)
        refuse_options(kind, request)
        started = time.monotonic()
        kept = {f.member: f.bundle for f in loaded.fields} if request.keep_sources else {}
        nodes = history_nodes(loaded, request.output, kept)
        cameras = kept_cameras(loaded, progress)
        framing = kept_framing(loaded, scene.composed, cameras)
        check_graph(request.output, FUSED, scene.composed.origin, framing, cameras)
        pixels = current(MakingConfig).views * DistilConfig.view_size**2
        tell_of_work(request.scene, scene.composed, pixels, progress)
        overhead = graph_bytes(nodes, cameras)
        found, student, figures_of_it = best_of(
            request, scene, kind, overhead, memory, place, progress, saved
        )
        entry = {
            "event": "fused",
            "kind": kind.name,
            "composition": loaded.composition,
            "nodes": nodes,
            "settings": {
                "seed": request.seed,
                "max_size": student.request.limit,
                "rgb": request.rgb,
                "from_scratch": request.from_scratch,
            },
            "psnr": reached_by(found, student),
        }
        with held_back(request.output):  # what was made comes before what is found out about it
            size = somewhere(
                request.output,
                lambda output: write_field(
                    output,
                    found.field,
                    FUSED,
                    precision=found.tried.way.precision,
                    overwrite=request.overwrite,
                    origin=scene.composed.origin,
                    history=(entry,),
                    kept=kept,
                    framing=framing,
                    cameras=cameras,
                ),
            )
            checkpoint_path(request.output).unlink(missing_ok=True)
        details = student.details(found.field)
        warn_of_detail(details, remedy(kind, loaded, scene.composed), progress)
        figures = figures_of_it()
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


def as_nodes(
    request: FuseRequest, loaded: LoadedScene, composed: ComposedField, memory: Memory, progress
) -> dict:
    """Write a scene whose fields are kept whole, whatever their kinds and rules: the graph, and the bytes of
    every field that it places. UsageProblem where that takes more than is allowed."""
    started = time.monotonic()
    for word in ("ranks", "sh_degree", "target_psnr"):
        if getattr(request, word) is not None:
            option = f"--{word.replace('_', '-')}"
            raise UsageProblem(f"{option} applies to scenes of vm fields by 'max' alone; leave it out")
    writer = BundleWriter()
    graph = Embedding(writer, request.allow_outside, request.precision).of(loaded.graph, loaded.path)
    cameras = kept_cameras(loaded, progress)
    framing = kept_framing(loaded, composed, cameras)
    entry = {"event": "fused", "kind": NODES, "objects": [node.name for node in graph.nodes]}
    graph = replace(
        graph,
        history=(entry,),
        generator=f"fusedrf {__version__}",
        framing=None if framing is None else tuple(float(number) for number in framing),
        cameras=cameras,
    )
    size = sum(len(data) for data in writer.members.values()) + len(dump_scene(graph))
    if request.max_size is not None and size > request.max_size:
        raise UsageProblem(
            f"--max-size is too small: the fields as they are take {readable_size(size)}, and only fields of "
            "kind vm are made smaller, by 'max' composition; give more, or another --kind"
        )
    writer.write(request.output, graph, overwrite=request.overwrite)
    return {
        "output": request.output,
        "bytes": Path(request.output).stat().st_size,
        "source_bytes": source_bytes(loaded),
        "kind": NODES,
        "nodes": len(graph.leaves()),
        "fields": len(writer.members),
        "why": "every field as its source has it",
        "total_seconds": time.monotonic() - started,
        "memory": memory.report(),
    }


def best_of(
    request: FuseRequest,
    scene: Scene,
    kind: Kind,
    overhead: int,
    memory: Memory,
    place: str,
    progress,
    saved: Saved | None = None,
) -> tuple[Kept, Student, Callable[[], dict]]:
    """The best stand of a kind for a scene, and what tells of it for the report, which may try more;
    overhead: bytes of the bundle besides its field. UsageProblem where nothing fits the size that is
    allowed."""
    asked = student_request(request, scene, overhead)
    try:
        student = kind.student(scene.composed, asked)
        together = make_room(memory, student, scene, request)
        maker, choosing, seconds = begin(student, scene, request, place, progress, together)
        found = search(maker, choosing, student, request, saved, seconds)
    except TooSmall as error:
        raise UsageProblem(
            f"--max-size is too small: the file takes {readable_size(error.smallest)} at its coarsest, "
            f"where {readable_size(asked.limit)} were allowed; give more"
        ) from error
    return found, student, lambda: figures_of(found, maker, choosing, seconds)


def student_request(request: FuseRequest, scene: Scene, overhead: int) -> StudentRequest:
    """What is asked of the kind's student; overhead: bytes of the bundle besides its field."""
    return StudentRequest(
        sizes=BundleSizes(),
        limit=request.max_size or DEFAULT_MAX_SIZE + place_bytes(scene.loaded),
        overhead=overhead,
        target=request.target_psnr,
        precision=request.precision,
        ranks=request.ranks,
        sh_degree=request.sh_degree,
        source_bytes=tuple(scene.loaded.sizes),
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
    student: Student, scene: Scene, request: FuseRequest, place: str, progress, together: bool
) -> tuple[Maker, Choosing, dict[str, float]]:
    """What makes students, what chooses among them, and the seconds that measuring the scene took."""
    started = time.monotonic()
    progress.phase("measuring", None)
    maker = Maker(student, scene, request, place, progress, together)
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
        found = choosing.smallest_reaching(groups, target, limit, student.gain if request.rgb else 0.0)
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
    kind = student.kind.name
    learnt = did is not None and student.learnt
    count = len(choosing.tried)
    started = time.monotonic()
    neighbours = {}
    if student.learnt and count > 1:
        neighbours = {"next_smaller": choosing.tried[-2].report(kind)}
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
    return figures | {
        "chosen": {
            **student.kind.describe(found.field),
            "precision": tried.way.precision,
            "flags": flags(kind, tried.way, tried.limit),
            "why": why(found, student, request, count),
            **({"start": found.start} if found.start else {}),
            "voxel": float(found.field.voxel_size),
            "finest_teacher_voxel": float(maker.scene.composed.voxel_size),
            **neighbours,
        },
        **(did.numeric if did is not None else {}),
    }


def why(found: Kept, student: Student, request: FuseRequest, count: int) -> str:
    """One sentence on the choice."""
    what, target = student.why(found.field), request.target_psnr
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
    """Say which objects a fused field will not hold as they are: stretched translucent ones, those it has too
    few voxels for, and those that share their cells with more than two."""
    config = current(DetailConfig)
    for d in details:
        if d.opacity_off and d.stretch > CONDITION_NOTED:
            progress.warn(
                f"'{d.name}' is stretched by {d.stretch:.2f}: where it is translucent its "
                f"opacity may be off by up to {d.opacity_off:.3f}"
            )
        if d.voxels_across < config.enough_voxels:
            progress.warn(f"'{d.name}' is only {d.voxels_across:.2g} voxels across; use {remedy}")
        if d.lost > config.lost_noted:
            progress.warn(
                f"{d.lost:.0%} of '{d.name}' is not shown, since more than two objects meet there in one "
                "cell of a grid over the whole scene; render the scene itself, or fuse its parts apart"
            )
    coarse = [d for d in details if d.held_voxel > d.own_voxel * (1 + 1e-6)]
    if coarse:
        worst = max(coarse, key=lambda d: d.held_voxel / d.own_voxel)
        progress.warn(
            f"{len(coarse)} of {len(details)} objects are held at coarser voxels than their own, "
            f"'{worst.name}' at {worst.held_voxel / worst.own_voxel:.1f} times; use {remedy}"
        )
