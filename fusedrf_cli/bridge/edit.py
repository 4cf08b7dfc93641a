"""`add` and `delete`: edits of a fused bundle that leave everything outside the touched region as it was."""

import os
import time
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np
import torch

from formats.bundle import is_bundle, read_field, read_headers, sha256_of
from formats.records import FieldRecord
from formats.scene import Leaf, Matrix4, SceneGraph
from fusedrf_cli.bridge.fuse_sparse import stored_sparse
from fusedrf_cli.bridge.memory import FLOAT, READING, RESAMPLING, Memory, ownership, picture, sources
from fusedrf_cli.bridge.memory import result as finished
from fusedrf_cli.bridge.running import engine
from fusedrf_cli.bridge.scene import (
    LoadedScene,
    held_size,
    history_nodes,
    load_scene,
    make_field,
    stored,
    write_field,
)
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.blocks import blocks_of, named, without
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.region import RESTORED, ClippedField, cleared, region_of
from fusedrf_cli.engine.composition.sparse_edit import added, emptied, with_fringe
from fusedrf_cli.engine.distillation.distill import distill
from fusedrf_cli.engine.distillation.judging import Judge
from fusedrf_cli.engine.distillation.settings import DistillSettings
from fusedrf_cli.engine.distillation.student import empty_student
from fusedrf_cli.engine.fields.occupancy import transformed_aabb
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.sparse.field import SparseField
from fusedrf_cli.engine.kinds.vm.field import Block, VMField
from fusedrf_cli.errors import InvalidInput

REGION_SETTINGS = DistillSettings(
    max_numbers=2_000_000, rays=120_000, steps=500, rgb_steps=500, view_size=160
)


class HistoryNode(msgspec.Struct):
    """What an edit reads of a node in a bundle's history."""

    name: str
    object_to_world: Matrix4
    aabb: Annotated[list[float], msgspec.Meta(min_length=6, max_length=6)]
    field: str
    source: str = ""
    sha256: str = ""


def add(
    fused: str,
    source: str,
    output: str,
    *,
    name: str,
    object_to_world: np.ndarray,
    time_budget: float | None,
    rgb: bool,
    memory: int | None,
    precision: str | None,
    overwrite: bool,
    seed: int,
    device: str,
    threads: int | None,
    progress,
) -> dict:
    """Put one more object into a fused field. Its blocks are appended; cells that it does not reach keep
    their owner and numbers. Without a precision the field keeps its own.
    """
    with engine(device, threads, progress):
        started = time.monotonic()
        progress.phase("reading", None)
        budget = Memory(memory)
        scene, members, node, field, own = read_fused(fused, budget)
        precision = precision or own
        if name in names_in(scene, field, node.name):
            raise InvalidInput(f"{fused}: there is a '{name}' already; choose another --name")
        new = load_scene(source, budget=budget)
        budget.expect(*addition_memory(field, new), advice="add a smaller object")
        origin = node.object_to_world[:3, 3]
        objects = [
            placed_at(p, opened(p.field), name, object_to_world, source).moved(origin) for p in new.placed
        ]
        settings = replace(REGION_SETTINGS, seed=seed, time_budget=time_budget)
        progress.phase("adding", 1.0)
        originals, base = objects, Placed("", field, np.eye(4))
        try:
            if type(field) is SparseField:
                result = with_objects(field, objects)
            else:
                objects = [as_vm(p, settings, rgb, progress) for p in objects]
                result = blocks_of([base, *objects])
        except ValueError as error:
            raise InvalidInput(f"{fused}: {error}") from error
        box = enclosing(
            [transformed_aabb(p.field.occupancy.tight_aabb(0), p.object_to_world) for p in objects]
        )
        progress.phase("measuring", None)
        truth = ComposedField([base, *originals])
        reached = Judge(truth, settings.views, settings.view_size, seed)(
            as_read(result, precision, truth.origin)
        )
        entry = {
            "event": "added",
            "nodes": [placed_note(n, object_to_world, name) for n in history_nodes(new, output, {})],
            "psnr": reached,
        }
        history = (*scene.history, entry)
        size = write_field(
            output,
            result,
            node.name,
            precision=precision,
            overwrite=overwrite,
            origin=origin,
            history=history,
            kept=dict.fromkeys(members, fused),
            extras=scene.extras,
        )
    return edit_report(
        output,
        size,
        fused,
        name,
        box + np.tile(origin, 2),
        result,
        {"psnr": {"before_rgb": reached}, "memory": budget.report()},
        started,
    )


def delete(
    fused: str,
    names: tuple[str, ...],
    output: str,
    *,
    time_budget: float | None,
    rgb: bool,
    precision: str | None,
    allow_outside: bool,
    overwrite: bool,
    seed: int,
    device: str,
    threads: int | None,
    progress,
) -> dict:
    """Take objects out of a fused field: their blocks are dropped; out of a distilled tensor only the cells
    they reached are cut.

    What an object hid inside the tensor is learned again from the remaining sources where these are known,
    else left empty. Without a precision the field keeps its own.
    """
    with engine(device, threads, progress):
        started = time.monotonic()
        progress.phase("reading", None)
        scene, members, node, field, own = read_fused(fused)
        precision = precision or own
        known = names_in(scene, field, node.name)
        for name in names:
            if name not in known:
                raise InvalidInput(
                    f"{fused}: there is no '{name}' to delete; it holds "
                    f"{', '.join(sorted(known)) or 'nothing that has a name'}"
                )
        if set(names) == known:
            raise nothing_left(fused, tuple(sorted(names)))
        origin = node.object_to_world[:3, 3]
        dropped = [b for b in blocks_in(field) if named(b, set(names))]
        boxes = [
            transformed_aabb(field.tensors[b.tensor].occupancy.tight_aabb(0), b.object_to_field)
            for b in dropped
        ]
        result = without(field, set(names)) if dropped else field
        if result is None:
            raise nothing_left(fused, names)
        figures = {"restored": True, "seconds": {}}
        inside = [
            entry
            for entry in graph_nodes(scene)
            if entry["name"] in names and not any(named(b, {entry["name"]}) for b in dropped)
        ]
        for entry in inside:
            progress.phase(f"deleting {entry['name']}", 1.0)
            box = np.asarray(entry["aabb"], np.float64) - np.tile(origin, 2)
            boxes.append(box)
            rest = remaining(scene, members, Path(fused), names, origin, allow_outside, progress)
            figures["restored"] &= rest is not None
            if type(result) is SparseField:
                if rest is not None:
                    box = boxes[-1] = with_fringe(result, box)
                result = emptied(result, box, rest or [])
                if result is None:
                    raise nothing_left(fused, names)
                continue
            settings = replace(REGION_SETTINGS, seed=seed, time_budget=time_budget)
            result, learned = cut(result, box, rest, settings, rgb, progress)
            figures |= learned
        history = (
            *scene.history,
            {"event": "deleted", "names": list(names), "restored": figures["restored"]},
        )
        size = write_field(
            output,
            result,
            node.name,
            precision=precision,
            overwrite=overwrite,
            origin=origin,
            history=history,
            kept=dict.fromkeys(members, fused),
            extras=scene.extras,
        )
    return edit_report(
        output, size, fused, ", ".join(names), enclosing(boxes) + np.tile(origin, 2), result, figures, started
    )


def nothing_left(fused: str, names: tuple[str, ...]) -> InvalidInput:
    """The refusal of a deletion that would empty the field."""
    return InvalidInput(
        f"{fused}: deleting {', '.join(names)} would leave nothing; keep one object, or delete the file"
    )


def addition_memory(field: VMField | SparseField, new: LoadedScene) -> list[dict[str, float]]:
    """The stages of adding a scene's fields to a field: putting together, measuring."""
    view, old = REGION_SETTINGS.view_size, field.params.numel() * FLOAT
    sizes, numbers = [old, *new.sizes], (old + sum(new.sizes)) // FLOAT
    return [
        sources(sizes, copies=RESAMPLING) | finished(numbers, measured=False) | ownership(field.aabb),
        sources(sizes) | finished(numbers) | ownership(field.aabb) | picture(view, view // 2, composed=True),
    ]


def read_fused(path: str, budget: Memory | None = None) -> tuple[SceneGraph, list[str], Leaf, VMField, str]:
    """The scene of a bundle of one field, its other members (kept sources), the field's leaf, the field, and
    its precision; InvalidInput when it is something else.
    """
    if not is_bundle(path):
        raise InvalidInput(f"{path}: not a bundle; fuse the scene to a .rfpack first")
    scene, headers = read_headers(path)
    check_history(scene, path)
    leaves = [leaf for leaf in scene.leaves() if leaf.field is not None]
    if len(leaves) != 1:
        raise InvalidInput(
            f"{path}: holds {len(leaves)} placed fields where one fused field was expected; fuse it first"
        )
    if budget is not None:
        budget.expect(
            sources([held_size(headers[leaves[0].field])], copies=READING), advice="edit a smaller field"
        )
    field = make_field(read_field(path, leaves[0].field), path)
    upright = np.array_equal(leaves[0].object_to_world[:3, :3], np.eye(3))
    if type(field) not in (VMField, SparseField) or not upright:
        raise InvalidInput(f"{path}: a field of kind '{field.kind}' cannot be edited; fuse it first")
    own = headers[leaves[0].field].precision
    return scene, [m for m in headers if m != leaves[0].field], leaves[0], field, own


def check_history(scene: SceneGraph, path: str) -> None:
    """InvalidInput where the history, which the format leaves free, does not tell of nodes as an edit needs
    them.
    """
    for entry in scene.history:
        try:
            msgspec.convert(entry.get("names", []), list[str])
            for node in msgspec.convert(entry.get("nodes", []), list[HistoryNode]):
                Placed(node.name, None, np.array(node.object_to_world))
                if not node.source.isprintable():
                    raise ValueError("a source that is no path")
        except ValueError as error:
            raise InvalidInput(f"{path}: its history is malformed ({error}); fuse the scene again") from error


def graph_nodes(scene: SceneGraph) -> list[dict]:
    """The named objects that the history says are in the field now."""
    nodes: dict[str, dict] = {}
    for entry in scene.history:
        for node in entry.get("nodes", ()):
            nodes[node["name"]] = node
        for name in entry.get("names", ()):
            nodes.pop(name, None)
    return list(nodes.values())


def names_in(scene: SceneGraph, field: VMField | SparseField, whole: str) -> set[str]:
    """Names that can be deleted: of the history and of the blocks."""
    return {n["name"] for n in graph_nodes(scene)} | {b.name for b in blocks_in(field)} - {
        whole,
        "",
        "fused",
        RESTORED,
    }


def blocks_in(field: VMField | SparseField) -> tuple[Block, ...]:
    """The blocks of a field; one of bricks has none."""
    return field.blocks if type(field) is VMField else ()


def as_vm(placed: Placed, settings: DistillSettings, rgb: bool, progress) -> Placed:
    """A placed VM field with the same content: itself, or what distilling another kind gives, in the
    object's own frame.
    """
    if type(placed.field) is VMField:
        return placed
    teacher = ComposedField([Placed(placed.name, placed.field, np.eye(4))])
    student = empty_student(teacher, settings, torch.Generator().manual_seed(settings.seed), placed.name)
    student, _ = distill(
        teacher,
        student,
        [teacher.occupancy.tight_aabb(0)],
        settings,
        rgb,
        advance=lambda s, f: progress.advance(s, **f),
    )
    back = placed.object_to_world.copy()
    back[:3, 3] += back[:3, :3] @ teacher.origin
    return Placed(placed.name, student, back)


def with_objects(field: SparseField, objects: list[Placed]) -> SparseField:
    """A sparse field with placed objects put in, one after the other."""
    for placed in objects:
        field = added(field, placed)
    return field


def as_read(field: VMField | SparseField, precision: str, origin: np.ndarray) -> VMField | SparseField:
    """A field as it will be read from a bundle of that precision, in a frame whose origin is at `origin` (3,)
    of its own."""
    if type(field) is SparseField:
        return stored_sparse(field, precision).moved(origin)
    return moved_frame(stored(field, precision), origin)


def moved_frame(field: VMField, origin: np.ndarray) -> VMField:
    """The same field in a frame whose origin is at `origin` (3,) of its own."""
    shift = np.eye(4)
    shift[:3, 3] = -origin
    blocks = tuple(replace(b, object_to_field=shift @ b.object_to_field) for b in field.blocks)
    return VMField.assembled(field.shape, field.tensors, blocks, field.params)


def placed_at(placed: Placed, field, name: str, object_to_world: np.ndarray, source: str) -> Placed:
    """A field placed as another one and then once more, under a name; InvalidInput where both placements
    together are singular."""
    try:
        return Placed(name, field, object_to_world @ placed.object_to_world)
    except ValueError as error:
        raise InvalidInput(f"{source}: {error}; give an invertible placement") from error


def placed_note(node: dict, object_to_world: np.ndarray, name: str) -> dict:
    """A history node of an added object, in the world it was added to."""
    return node | {
        "name": name,
        "object_to_world": (object_to_world @ np.asarray(node["object_to_world"])).tolist(),
        "aabb": transformed_aabb(np.asarray(node["aabb"]), object_to_world).tolist(),
    }


def remaining(
    scene: SceneGraph,
    members: list[str],
    path: Path,
    gone: tuple[str, ...],
    origin: np.ndarray,
    allow_outside: bool,
    progress,
) -> list[Placed] | None:
    """The other objects of the graph as placed fields, from inside the bundle or from their files; None,
    with a warning, where one is not
    to be had."""
    found = []
    for node in graph_nodes(scene):
        if node["name"] in gone:
            continue
        record = (
            read_field(path, node["field"])
            if node["field"] in members
            else record_from_file(node, path, allow_outside)
        )
        if record is None:
            progress.warn(
                f"the source of '{node['name']}' is not to be had, so what the deleted objects hid stays "
                "empty"
            )
            return None
        field = make_field(record, node["name"])
        found.append(
            Placed(node["name"], field, np.asarray(node["object_to_world"], np.float64)).moved(origin)
        )
    return found


def record_from_file(node: dict, path: Path, allow_outside: bool) -> FieldRecord | None:
    """A source's field from the file the history names, if it is still there, unchanged, and may be read."""
    source = (path.resolve().parent / node.get("source", "")).resolve()
    inside = source.is_relative_to(path.resolve().parent)
    if (
        "source" not in node
        or not os.path.isfile(source)
        or not (inside or allow_outside)
        or sha256_of(source) != node["sha256"]
    ):
        return None
    return read_field(source, node["field"]) if node["field"] in read_headers(source)[1] else None


def cut(
    field: VMField, box: np.ndarray, rest: list[Placed] | None, settings: DistillSettings, rgb: bool, progress
) -> tuple[VMField, dict]:
    """Empty the cells of a box in the distilled tensor, and fill them with a tensor of their own that holds
    what the rest shows there.
    """
    region = region_of(field, box)
    emptied = cleared(field, region)
    rest = [p for p in rest or [] if overlaps(p.aabb, region)]
    if not rest:
        return emptied, {}
    teacher = ComposedField(rest)
    local = ClippedField(teacher, region - np.tile(teacher.origin, 2))
    if not local.occupancy.occupied.any():
        return emptied, {}
    student = empty_student(local, settings, torch.Generator().manual_seed(settings.seed), RESTORED)
    student, did = distill(
        local,
        student,
        [local.occupancy.tight_aabb(0)],
        settings,
        rgb,
        advance=lambda s, f: progress.advance(s, **f),
    )
    back = np.eye(4)
    back[:3, 3] = teacher.origin
    whole = blocks_of([Placed("", emptied, np.eye(4)), Placed(RESTORED, student, back)])
    return whole, {
        "psnr": {"before_rgb": did.psnr_before_rgb, "after_rgb": did.psnr_after_rgb},
        "seconds": did.seconds,
    }


def parts_of(field: VMField | SparseField) -> dict[str, int]:
    """What a field is made of, and how many of it."""
    if type(field) is SparseField:
        return {"bricks": len(field.tree.level)}
    return {"blocks": len(field.blocks)}


def overlaps(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two boxes (6,) share a volume."""
    return bool((a[:3] < b[3:]).all() and (b[:3] < a[3:]).all())


def enclosing(boxes: list[np.ndarray]) -> np.ndarray:
    """(6,) the box around boxes."""
    return np.concatenate([np.min([b[:3] for b in boxes], 0), np.max([b[3:] for b in boxes], 0)])


def edit_report(
    output: str,
    size: int,
    before: str,
    names: str,
    box: np.ndarray,
    field: VMField | SparseField,
    figures: dict,
    started: float,
) -> dict:
    """The report of an edit."""
    extent = box[3:] - box[:3]
    whole = field.occupancy.aabb[3:] - field.occupancy.aabb[:3]
    return {
        "output": output,
        "bytes": size,
        "source_bytes": Path(before).stat().st_size,
        "touched": {
            "names": names,
            "aabb": box.tolist(),
            **parts_of(field),
            "share_of_box": float(min(1.0, np.prod(extent / whole))),
        },
        **figures,
        "total_seconds": time.monotonic() - started,
    }
