"""`fuse`: a scene to one field."""

import time
from dataclasses import asdict, replace

import numpy as np
import torch

from fusedrf_cli.bridge.fuse_sparse import fuse_sparse
from fusedrf_cli.bridge.memory import (
    FLOAT,
    READING,
    RESAMPLING,
    Memory,
    learning,
    ownership,
    picture,
    result,
    sources,
    teaching,
)
from fusedrf_cli.bridge.running import checkpoint_path, engine, load_checkpoint, resumable
from fusedrf_cli.bridge.scene import (
    LoadedScene,
    background_of,
    history_nodes,
    load_scene,
    placed_on,
    write_field,
)
from fusedrf_cli.bridge.train import BYTES_PER_NUMBER, check_size, warn_of_numbers
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.blocks import blocks_of
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.detail import (
    ENOUGH_VOXELS,
    LOST_NOTED,
    Detail,
    block_details,
    tensor_details,
)
from fusedrf_cli.engine.distillation.distill import (
    DistillRun,
    DistillSettings,
    Judge,
    empty_student,
    resolution_for,
    student_from,
)
from fusedrf_cli.engine.distillation.fit import texels
from fusedrf_cli.engine.distillation.teacher import ask, random_rays
from fusedrf_cli.engine.fields.base import holds_matter
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.fields.vm import VMField
from fusedrf_cli.errors import InvalidInput, QualityNotReached

DEFAULT_MAX_SIZE = 25_000_000
RECKONED_RAYS = 2000  # of which the number of points is reckoned
HEADER_BYTES = 16384  # scene graph, history and headers of a bundle, about
CONDITION_NOTED = 1.01  # a stretch beyond this shows in a translucent medium (by 1/255 of its opacity)


def fuse(
    scene: str,
    output: str,
    *,
    kind: str,
    max_size: int | None,
    target_psnr: float | None,
    time_budget: float | None,
    rgb: bool,
    from_scratch: bool,
    keep_sources: bool,
    memory: int | None,
    precision: str,
    resume: bool,
    allow_outside: bool,
    overwrite: bool,
    seed: int,
    device: str,
    threads: int | None,
    progress,
) -> dict:
    """Turn a composed scene into one field and write it with the scene's history."""
    with engine(device, threads, progress) as place:
        progress.phase("reading", None)
        budget = Memory(memory)
        loaded = without_empty(load_scene(scene, allow_outside, budget, place), scene, progress)
        composed = loaded.composed()
        chosen = choose_kind(kind, loaded)
        limit = max_size or DEFAULT_MAX_SIZE
        started = time.monotonic()
        if chosen == "blocks":
            numbers = limit // BYTES_PER_NUMBER[precision]
            make_room(budget, loaded, *blocks_memory(loaded, composed, numbers))
            field, figures = fuse_blocks(loaded, composed, limit, precision, seed, place, progress)
        elif chosen == "sparse":
            settings = DistillSettings(seed=seed, time_budget=time_budget)
            field, figures = fuse_sparse(composed, limit, precision, settings, rgb, place, progress)
        else:
            overhead = composed.occupancy.occupied.size // 8 + HEADER_BYTES
            numbers = max(1, (limit - overhead) // BYTES_PER_NUMBER[precision])
            settings = DistillSettings(
                seed=seed,
                time_budget=time_budget,
                max_numbers=numbers,
            )
            least = settings.shape.size(texels(composed.aabb, 16)) * BYTES_PER_NUMBER[precision]
            check_size(least, limit - overhead)
            make_room(budget, loaded, *vm_memory(loaded, composed, settings))
            asked = settings, rgb, from_scratch, output, resume
            field, figures = fuse_vm(loaded, composed, *asked, place, progress)
        kept = {f.member: f.path for f in loaded.fields} if keep_sources else {}
        entry = {
            "event": "fused",
            "kind": chosen,
            "composition": loaded.composition,
            "nodes": history_nodes(loaded, output, kept),
            "settings": {"seed": seed, "max_size": limit, "rgb": rgb, "from_scratch": from_scratch},
            "psnr": figures["psnr"],
        }
        size = write_field(
            output,
            field,
            "fused",
            precision=precision,
            overwrite=overwrite,
            origin=composed.origin,
            history=(entry,),
            kept=kept,
        )
        checkpoint_path(output).unlink(missing_ok=True)
    report = {
        "output": output,
        "bytes": size,
        "source_bytes": source_bytes(loaded),
        "kind": chosen,
        **figures,
        "total_seconds": time.monotonic() - started,
        "memory": budget.report(),
    }
    check_target(report, target_psnr, output)
    return report


def make_room(budget: Memory, loaded: LoadedScene, *stages: tuple[float, dict[str, float]]) -> None:
    """Keep no more sources in memory than fit beside what every stage needs, which is so many copies of the
    largest one and other things; ResourceProblem where not even one does.
    """
    sizes, shelf = loaded.sizes, loaded.shelf
    room = min(budget.room(needed) - copies * max(sizes) for copies, needed in stages)
    if room < sum(sizes):  # then one is read now and then in every stage
        stages = tuple((max(copies, READING), needed) for copies, needed in stages)
        room = min(budget.room(needed) - copies * max(sizes) for copies, needed in stages)
    shelf.resize(room)
    budget.expect(
        *(sources(sizes, shelf.room, copies) | needed for copies, needed in stages),
        advice="give a smaller --max-size",
    )


def blocks_memory(
    loaded: LoadedScene, composed: ComposedField, numbers: int
) -> list[tuple[float, dict[str, float]]]:
    """The stages of compiling a scene to blocks of at most so many numbers: putting together, measuring."""
    numbers, grids = min(numbers, sum(loaded.sizes) // FLOAT), ownership(composed.aabb)
    return [
        (RESAMPLING, result(numbers, measured=False) | grids),
        (0.0, result(numbers) | grids | judged()),
    ]


def judged() -> dict[str, float]:
    """Looking at a scene to measure; it covers about half of a picture that frames it."""
    return picture(DistillSettings.view_size, DistillSettings.view_size // 2, composed=True)


def vm_memory(
    loaded: LoadedScene, composed: ComposedField, settings: DistillSettings
) -> list[tuple[float, dict[str, float]]]:
    """The stages of distilling a scene into one tensor: asking, learning. The points that its rays will keep
    are reckoned from a few of them.
    """
    box = composed.aabb
    resolution = resolution_for(box, composed.voxel_size, settings.shape, settings.max_numbers)
    numbers = settings.shape.size(resolution)
    generator = torch.Generator().manual_seed(settings.seed)
    boxes = [composed.occupancy.tight_aabb(0), *(p.aabb for p in composed.placed)]
    few = random_rays(boxes, RECKONED_RAYS, generator)
    step = 0.5 * float(np.max((box[3:] - box[:3]) / (np.asarray(resolution) - 1)))
    kept = len(ask(composed, *few, step, generator).points)
    answers = teaching(settings, kept * settings.rays // RECKONED_RAYS) | ownership(box)
    return [
        (0.0, result(numbers, measured=False) | answers | picture(256, 256, composed=True)),
        (0.0, learning(numbers, torch.get_num_threads()) | answers),
    ]


def check_target(report: dict, target_psnr: float | None, output: str) -> None:
    """QualityNotReached, after the output was written, where a target was given and missed."""
    found = (report["psnr"]["before_rgb"], report["psnr"].get("after_rgb"))
    reached = max(value for value in found if value is not None)  # what was worse was not kept
    if target_psnr is not None and reached < target_psnr:
        raise QualityNotReached(
            f"{output}: reached {reached:.2f} dB where --target-psnr asked for {target_psnr:g}; give more "
            "--max-size or --time-budget",
            report=report,
        )


def choose_kind(kind: str, loaded: LoadedScene) -> str:
    """What was asked for; for auto, blocks where they can stand for the scene (VM sources, max composition),
    which came far nearer to it in far less time (DESIGN), else vm.
    """
    possible = loaded.composition == "max" and all(p.field.kind == VMField.kind for p in loaded.placed)
    if kind == "blocks" and not possible:
        raise InvalidInput(f"{loaded.path}: blocks need vm sources and 'max' composition; use --kind vm")
    return kind if kind != "auto" else ("blocks" if possible else "vm")


def source_bytes(loaded: LoadedScene) -> int:
    """Bytes of the distinct source files."""
    return sum(
        path.stat().st_size for path in {f.path for f in loaded.fields} if path is not None and path.is_file()
    )


def fuse_blocks(
    loaded: LoadedScene, composed: ComposedField, limit: int, precision: str, seed: int, place: str, progress
) -> tuple[VMField, dict]:
    """Compile the scene to blocks, resampled where it would be larger than the limit, and measure what that
    cost.
    """
    progress.phase("blocks", None)
    started = time.monotonic()
    occupancies = {
        id(p.field): sum(t.occupancy.occupied.size for t in opened(p.field).tensors) // 8
        for p in composed.placed
    }
    room = int(0.99 * limit) - sum(occupancies.values()) - 65536
    field = blocks_of(composed.placed, room, precision)
    check_size(field.params.numel() * BYTES_PER_NUMBER[precision], room)
    details = block_details(composed.placed, field)
    warn_of_detail(details, "a larger --max-size", progress)
    seconds = {"blocks": time.monotonic() - started}
    progress.phase("measuring", None)
    views = DistillSettings.views
    reached = Judge(composed, views, DistillSettings.view_size, seed)(stored(field, precision).to(place))
    seconds["measuring"] = time.monotonic() - started - seconds["blocks"]
    whole = len({id(p.field) for p in composed.placed})
    resolution = [list(t.resolution) for t in field.tensors]
    why = (
        f"{len(field.blocks)} blocks over {whole} tensors, each in its object's own axes, under {limit} bytes"
    )
    return field, {
        "psnr": {"before_rgb": reached, "after_rgb": None, "views": views},
        "seconds": seconds,
        "chosen": {
            "resolution": resolution,
            "ranks": [field.shape.density_rank, field.shape.colour_rank],
            "why": why,
        },
        "objects": [asdict(d) for d in details],
    }


def stored(field: VMField, precision: str) -> VMField:
    """The field as it will come back from a bundle of that precision."""
    if precision == "float32":
        return field
    return VMField(
        field.shape, field.tensors, field.blocks, field.params.half().float(), field.occupancy, field.owners
    )


def fuse_vm(
    loaded: LoadedScene,
    composed: ComposedField,
    settings: DistillSettings,
    rgb: bool,
    from_scratch: bool,
    output: str,
    resume: bool,
    place: str,
    progress,
) -> tuple[VMField, dict]:
    """Distil the scene into one VM tensor, from the background's weights where they can be taken over."""
    generator = torch.Generator().manual_seed(settings.seed)
    background = background_of(loaded).placed
    moved = Placed(
        background.name,
        placed_on(opened(background.field), "cpu"),
        composed.placed[[p.name for p in loaded.placed].index(background.name)].object_to_world,
    )
    student = None if from_scratch else student_from(moved, composed, settings, generator)
    start = f"the weights of '{background.name}'" if student is not None else "nothing"
    if student is None:
        if not from_scratch:
            progress.warn(f"'{background.name}' is turned or stretched, so the student starts from nothing")
        student = empty_student(composed, settings, generator, "fused")
    student = student.to(place)
    details = tensor_details(composed.placed, student.voxel_size)
    warn_of_detail(details, "--kind blocks, or a larger --max-size", progress)
    # in an order that does not depend on the nodes', so that equal scenes draw equal rays
    boxes = [composed.occupancy.tight_aabb(0), *sorted((p.aabb for p in composed.placed), key=list)]
    run = DistillRun(composed, student, boxes, settings, rgb)
    # what the saved numbers depend on: with other words they would go on to something else
    made_with = {"numbers": student.params.numel(), "start": start, "rgb": rgb, "seed": settings.seed}
    made_with["boxes"] = [box.tolist() for box in boxes]
    if resume:
        arrays, state = load_checkpoint(output, "fuse")
        if any(state.get(word) != value for word, value in made_with.items()):
            raise InvalidInput(
                f"{checkpoint_path(output)}: made with other settings; repeat them, or run without --resume"
            )
        run.restore(arrays, state)

    def checkpoint() -> tuple[dict, dict]:
        arrays, state = run.checkpoint()
        return arrays, state | made_with

    with resumable(output, checkpoint) as whole:
        student, did = run.finish(
            lambda name: progress.phase(name, 1.0), lambda s, f: progress.advance(s, **f), whole
        )
    warn_of_numbers(did.numeric, progress)
    if did.found_nothing:
        progress.warn("the student holds no matter yet; no cell was given up. Give it more --time-budget")
    return student, {
        "psnr": {
            "before_rgb": did.psnr_before_rgb,
            "after_rgb": did.psnr_after_rgb,
            "rgb_kept": did.rgb_kept,
            "views": settings.views,
        },
        "seconds": did.seconds,
        "chosen": {
            "resolution": list(student.tensors[0].resolution),
            "ranks": [student.shape.density_rank, student.shape.colour_rank],
            "start": start,
            "voxel": float(student.voxel_size),
            "finest_teacher_voxel": float(composed.voxel_size),
        },
        **did.numeric,
        "objects": [asdict(d) for d in details],
    }


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


def warn_of_detail(details: list[Detail], remedy: str, progress) -> None:
    """Say which objects a fused field will not hold as they are: stretched translucent ones, those it has too
    few voxels for, and those that share their cells with more than two."""
    for d in details:
        if d.opacity_off and d.stretch > CONDITION_NOTED:
            progress.warn(
                f"'{d.name}' is stretched by {d.stretch:.2f}: where it is translucent its "
                f"opacity may be off by up to {d.opacity_off:.3f}"
            )
        if d.voxels_across < ENOUGH_VOXELS:
            progress.warn(f"'{d.name}' is only {d.voxels_across:.2g} voxels across; use {remedy}")
        if d.lost > LOST_NOTED:
            progress.warn(
                f"{d.lost:.0%} of '{d.name}' is not shown, since more than two objects meet there in one "
                "cell of a grid over the whole scene; render the scene as it is, or fuse its parts apart"
            )
    coarse = [d for d in details if d.held_voxel > d.own_voxel * (1 + 1e-6)]
    if coarse:
        worst = max(coarse, key=lambda d: d.held_voxel / d.own_voxel)
        progress.warn(
            f"{len(coarse)} of {len(details)} objects are held at coarser voxels than their own, "
            f"'{worst.name}' at {worst.held_voxel / worst.own_voxel:.1f} times; use {remedy}"
        )
