"""A scene to one distilled tensor: of the size that was asked for, or grown until it shows enough."""

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch

from formats.records import BYTES_PER_NUMBER
from fusedrf_cli.bridge.choose import Way
from fusedrf_cli.bridge.fusing import Asked, Fused
from fusedrf_cli.bridge.memory import learning, ownership, picture, result, teaching
from fusedrf_cli.bridge.running import checkpoint_path, load_checkpoint, resumable
from fusedrf_cli.bridge.scene import LoadedScene, background_of, placed_on, stored
from fusedrf_cli.bridge.sizes import HEADER, HEADER_PER_BLOCK, HEADER_PER_PLANE, HEADER_PER_TENSOR
from fusedrf_cli.bridge.train import check_size, tensor_bytes, warn_of_numbers
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.detail import tensor_details
from fusedrf_cli.engine.composition.trimming import truncated
from fusedrf_cli.engine.distillation.distill import DistillReport, DistillRun
from fusedrf_cli.engine.distillation.judging import Judge
from fusedrf_cli.engine.distillation.settings import DistillSettings
from fusedrf_cli.engine.distillation.student import empty_student, resolution_for, student_from
from fusedrf_cli.engine.distillation.teacher import ask, random_rays
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape
from fusedrf_cli.errors import InvalidInput

RAYS_PER_SECOND = 40_000  # that are asked for each second of learning
RECKONED_RAYS = 2000  # of which the number of points is reckoned
SMALLER = 0.98  # steps in which a size is looked for that fits
GROWTH = 2  # of the numbers, from one size to the next
SMALLEST = 32  # times less numbers than the limit allows: where growing begins
CHEAP_FIRST = ("int4", "int8")
PRECISE = "float16"


def fuse_vm(
    loaded: LoadedScene,
    composed: ComposedField,
    asked: Asked,
    from_scratch: bool,
    output: str,
    resume: bool,
    place: str,
    progress,
) -> Fused:
    """Distil the scene into one VM tensor, from the background's weights where they can be taken over.

    With a target the tensor starts small and grows, from what it has learnt, until it reaches it.
    """
    saved = load_checkpoint(output, "fuse") if resume else None
    student, tried = None, []
    progress.phase("measuring", None)
    judge = Judge(composed, DistillSettings.views, DistillSettings.view_size, asked.seed)
    for settings in sizes(composed, asked):
        begun, start = beginning(loaded, composed, settings, asked, from_scratch, student, progress)
        if saved is not None and asked.target and saved[1].get("numbers") != begun.params.numel():
            continue  # the run that was interrupted had grown further
        run, made_with = prepared(composed, begun.to(place), settings, asked, start, judge)
        if saved is not None:
            take_up(run, made_with, output, *saved)
            saved = None
        student, did = finished(run, made_with, output, progress)
        for precision in precisions(asked):
            reached = judge(stored(student, precision).to(place))
            tried.append((precision, settings.max_numbers, reached))
            if asked.target is None or reached >= asked.target:
                return told(composed, student, did, start, settings, asked, tried)
    if student is None:
        raise mismatch(output)
    return told(composed, student, did, start, settings, asked, tried)


def sizes(composed: ComposedField, asked: Asked) -> Iterator[DistillSettings]:
    """Settings of growing size, each at another resolution; without a target those of the largest alone."""
    settings, resolution = largest(composed, asked), None
    most = settings.max_numbers
    for k in range(SMALLEST.bit_length() - 1, -1, -1) if asked.target is not None else [0]:
        numbers = most // GROWTH**k
        found = resolution_for(composed.aabb, composed.voxel_size, settings.shape, numbers)
        fits = settings.shape.size(found) <= numbers
        if found != resolution and (fits or k == 0):
            resolution = found
            yield replace(settings, max_numbers=numbers)


def largest(composed: ComposedField, asked: Asked) -> DistillSettings:
    """The settings of the largest tensor that the limit allows; UsageProblem where it allows none."""
    ranks, default = asked.ranks, DistillSettings.shape
    degree = default.sh_degree if asked.sh_degree is None else asked.sh_degree
    shape = VMShape(*(ranks or (default.density_rank, default.colour_rank)), degree)
    each = BYTES_PER_NUMBER[precisions(asked)[-1]]
    room = asked.limit - besides(composed, asked)
    check_size(needed(composed, shape, 1, precisions(asked)[-1]), room)
    numbers = max(1, int(room / each))
    while needed(composed, shape, numbers, precisions(asked)[-1]) > room:  # small planes are not coded
        numbers = int(SMALLER * numbers)
    settings = DistillSettings(
        shape=shape, max_numbers=numbers, seed=asked.seed, time_budget=asked.time_budget
    )
    if asked.time_budget is not None:  # more than there is time to learn from need not be asked
        settings = replace(settings, rays=min(settings.rays, int(RAYS_PER_SECOND * asked.time_budget) + 1))
    return settings


def needed(composed: ComposedField, shape: VMShape, numbers: int, precision: str) -> int:
    """Bytes of a tensor of at most so many numbers over the scene."""
    resolution = resolution_for(composed.aabb, composed.voxel_size, shape, numbers)
    return tensor_bytes(shape, resolution, precision) + 6 * HEADER_PER_PLANE


def besides(composed: ComposedField, asked: Asked) -> int:
    """Bytes of the file that are no numbers."""
    headers = HEADER + HEADER_PER_TENSOR + HEADER_PER_BLOCK
    return asked.overhead + headers + composed.occupancy.occupied.size // 8


def precisions(asked: Asked) -> tuple[str, ...]:
    """The precisions to try, the cheapest first."""
    if asked.precision is not None:
        return (asked.precision,)
    return CHEAP_FIRST if asked.target is not None else (PRECISE,)


def beginning(
    loaded: LoadedScene,
    composed: ComposedField,
    settings: DistillSettings,
    asked: Asked,
    from_scratch: bool,
    before: VMField | None,
    progress,
) -> tuple[VMField, str]:
    """A student and what it starts from: a smaller one, the background, or nothing."""
    generator = torch.Generator().manual_seed(settings.seed)
    box = composed.aabb
    if before is not None:
        resolution = resolution_for(box, composed.voxel_size, settings.shape, settings.max_numbers)
        grown = before.resampled(box, resolution).with_occupancy(composed.occupancy)
        return grown, "a smaller student"
    background = background_of(loaded).placed
    field = placed_on(opened(background.field), "cpu")
    if asked.ranks is not None and type(field) is VMField:
        field = truncated(field, settings.shape)
    placement = composed.placed[[p.name for p in loaded.placed].index(background.name)].object_to_world
    if not from_scratch:
        moved = Placed(background.name, field, placement)
        student = student_from(moved, composed, settings, generator)
        if student is not None:
            return student, f"the weights of '{background.name}'"
        progress.warn(f"'{background.name}' is turned or stretched, so the student starts from nothing")
    return empty_student(composed, settings, generator, "fused"), "nothing"


def prepared(
    composed: ComposedField,
    student: VMField,
    settings: DistillSettings,
    asked: Asked,
    start: str,
    judge: Judge,
) -> tuple[DistillRun, dict]:
    """A run, and what its saved numbers depend on: with other words they would go on to something else."""
    # in an order that does not depend on the nodes', so that equal scenes draw equal rays
    boxes = [composed.occupancy.tight_aabb(0), *sorted((p.aabb for p in composed.placed), key=list)]
    made_with = {
        "numbers": student.params.numel(),
        # one that grows to a target goes on from whatever it started from
        "start": start if asked.target is None else None,
        "rgb": asked.rgb,
        "seed": settings.seed,
        "boxes": [box.tolist() for box in boxes],
    }
    return DistillRun(composed, student, boxes, settings, asked.rgb, judge=judge), made_with


def take_up(run: DistillRun, made_with: dict, output: str, arrays: dict, state: dict) -> None:
    """Go on from a checkpoint; InvalidInput where it was made with other settings."""
    if any(state.get(word) != value for word, value in made_with.items()):
        raise mismatch(output)
    run.restore(arrays, state)


def mismatch(output: str) -> InvalidInput:
    """The error of a checkpoint that was made with other settings."""
    return InvalidInput(
        f"{checkpoint_path(output)}: made with other settings; repeat them, or run without --resume"
    )


def finished(run: DistillRun, made_with: dict, output: str, progress) -> tuple[VMField, DistillReport]:
    """Run to the end; an interrupt saves a checkpoint."""

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
    return student, did


def told(
    composed: ComposedField,
    student: VMField,
    did: DistillReport,
    start: str,
    settings: DistillSettings,
    asked: Asked,
    tried: list[tuple[str, int, float]],
) -> Fused:
    """The student with its report."""
    precision, numbers, reached = tried[-1]

    def flags(precision: str, numbers: int) -> str:
        size = math.ceil(numbers * BYTES_PER_NUMBER[precision]) + besides(composed, asked)
        return Way(precision, asked.ranks, asked.sh_degree).flags("vm", size)

    figures = {
        "psnr": {
            "before_rgb": did.psnr_before_rgb,
            "after_rgb": did.psnr_after_rgb,
            "rgb_kept": did.rgb_kept,
            "stored": reached,
            "views": settings.views,
        },
        "seconds": did.seconds,
        "steps": did.steps,
        "curve": [dict(zip(("seconds", "steps", "psnr"), point, strict=True)) for point in did.curve],
        "chosen": {
            "resolution": list(student.tensors[0].resolution),
            "ranks": [student.shape.density_rank, student.shape.colour_rank],
            "sh_degree": student.shape.sh_degree,
            "precision": precision,
            "flags": flags(precision, numbers),
            "start": start,
            "voxel": float(student.voxel_size),
            "finest_teacher_voxel": float(composed.voxel_size),
        },
        **did.numeric,
    }
    if len(tried) > 1:
        figures["chosen"]["next_smaller"] = {"flags": flags(*tried[-2][:2]), "psnr": tried[-2][2]}
    details = tensor_details(composed.placed, student.voxel_size)
    return Fused(student, precision, figures, details, "--kind blocks, or a larger --max-size")


def vm_memory(composed: ComposedField, asked: Asked) -> list[tuple[float, dict[str, float]]]:
    """The stages of distilling a scene into one tensor: asking, learning. The points that its rays will keep
    are reckoned from a few of them.
    """
    box, settings = composed.aabb, largest(composed, asked)
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
