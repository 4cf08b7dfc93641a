"""`add` and `delete`: edits of a fused bundle that leave everything outside the touched region as it was, or
as near to it as its kind of field can."""

import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from formats.bundle import OpenBundle, is_bundle
from formats.past import keep
from formats.rig import read_rig
from formats.scene import Leaf, Matrix4, SceneGraph
from fusedrf_cli.bridge.budget import Budget
from fusedrf_cli.bridge.history import graph_nodes, summed_up
from fusedrf_cli.bridge.looks import Subject, looks
from fusedrf_cli.bridge.memory import FLOAT, RESAMPLING, Memory, ownership, picture, sources
from fusedrf_cli.bridge.memory import result as finished
from fusedrf_cli.bridge.rigs import rig_of
from fusedrf_cli.bridge.running import engine, held_back, written_somewhere
from fusedrf_cli.bridge.scene import (
    LoadedScene,
    history_nodes,
    load_scene,
    make_field,
    needs_of,
    short_origin,
    stored,
    write_field,
)
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField, largest
from fusedrf_cli.engine.distillation.distill import DistillRun
from fusedrf_cli.engine.distillation.judging import JUDGED_SEED, Judge, RegionJudge
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.fields.base import RadianceField, StoredField
from fusedrf_cli.engine.fields.occupancy import placed_box, placement, transformed_aabb
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.editing import Edited
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.student import DistilConfig
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.spaces import bounded
from fusedrf_cli.errors import InvalidInput
from fusedrf_cli.requests import AddRequest, ArrangeRequest, EditRequest, Learning

REGION_SETTINGS = DistilConfig(rays=120_000, steps=500, rgb_steps=500, view_size=160)
LOCAL_VIEW = 100
"""Pixels a side of the views of an edit that changes nothing outside of its region: what it put in is shown
as it was made, and asking the scene as composed takes most of such an edit's time."""
SAME_BITS = "outside of it all numbers are the same bits"
ROUNDED = "outside of it all numbers are the same bits, but for those near it, which are rounded anew"
NEARLY = "outside of it the field was held to what it showed, and is not the same to the bit"


class HistoryNode(msgspec.Struct):
    """What an edit reads of a node in a bundle's history."""

    name: str
    object_to_world: Matrix4
    aabb: Annotated[list[float], msgspec.Meta(min_length=6, max_length=6)]
    field: str
    source: str = ""
    sha256: str = ""


@dataclass(frozen=True)
class Fused:
    """A bundle of one field that is to be edited."""

    bundle: OpenBundle
    scene: SceneGraph
    others: list[str]
    """Members besides the field: sources that were kept inside."""
    node: Leaf
    field: StoredField
    kind: Kind
    precision: str
    """Of the field as it is stored."""

    @property
    def path(self) -> str:
        """Of the bundle."""
        return str(self.bundle.path)

    @property
    def origin(self) -> np.ndarray:
        """Where the field's frame lies in the world: a position (3,), or a placement (4, 4)."""
        return short_origin(self.node.object_to_world)

    @property
    def framing(self) -> np.ndarray | tuple[float, ...] | None:
        """(6,) the box in the world that pictures show, before the edit and after it; None where they are
        taken from a capture's cameras."""
        if self.scene.framing is not None or (self.scene.cameras or {}).get("surroundings"):
            return self.scene.framing
        return placed_box(self.field.occupancy.subject, self.origin)

    @property
    def names(self) -> set[str]:
        """Of the objects that can be deleted: those that the history and those that the field tell of."""
        parts = {part.name for part in self.kind.parts(self.field)} - {self.node.name}
        return {n["name"] for n in graph_nodes(self.scene)} | parts


class Teacher:
    """Teaches students for an edit (engine/kinds/editing.py: Teach), within one command's budget."""

    def __init__(self, request: Learning, rgb: bool, place: str, progress, tries: int = 1):
        """rgb: whether it finishes on pictures; tries: how many times it may be asked, about."""
        self.seed, self.rgb, self.place, self.progress = request.seed, rgb, place, progress
        self.budget, self.tries = Budget(request.time_budget), tries

    def __call__(
        self, teacher: RadianceField, student: StoredField, boxes: list[np.ndarray], fresh: bool
    ) -> tuple[StoredField, dict]:
        """See Teach."""
        seconds = self.budget.part(max(1, self.tries))
        self.tries -= 1
        settings = replace(REGION_SETTINGS, seed=self.seed, time_budget=seconds)
        settings = settings if fresh else replace(settings, coarse_from=None)
        run = DistillRun(teacher, student.to(self.place), RaySampler(boxes), settings, self.rgb)
        learnt, did = run.finish(advance=lambda share, figures: self.progress.advance(share, **figures))
        self.budget.spent += run.learnt_seconds
        psnr = {"before_rgb": did.psnr_before_rgb, "after_rgb": did.psnr_after_rgb}
        return learnt.to("cpu"), {"psnr": psnr, "seconds": did.seconds}


def add(request: AddRequest, progress) -> dict:
    """Put one more object into a fused field; cells that it does not reach keep their numbers where the kind
    of field allows that. Without a precision the field keeps its own.
    """
    with engine(request.device, request.threads, progress) as place:
        started = time.monotonic()
        progress.phase("reading", None)
        memory = Memory(request.memory)
        fused = read_fused(request.fused, memory)
        precision = request.precision or fused.precision
        if request.name in fused.names:
            raise InvalidInput(f"{request.fused}: there is a '{request.name}' already; choose another --name")
        new = load_scene(request.source, budget=memory, place=place)
        memory.expect(*addition_memory(fused.field, new), advice="add a smaller object")
        placed = [placed_at(p, opened(p.field), request) for p in new.placed]
        objects = [p.moved(fused.origin) for p in placed]
        parts = [Placed("", fused.field.to(place), np.eye(4)), *objects]
        if any(p.unbounded for p in objects) and largest(parts) is not parts[0]:
            raise InvalidInput(
                f"{request.source}: it fills all of space, around more than {request.fused} does; place both "
                "in a scene.json and fuse that"
            )
        truth = ComposedField(parts, origin=np.eye(4))
        progress.phase("adding", 1.0)
        try:
            teach = Teacher(request, request.rgb, place, progress, len(objects))
            edited = fused.kind.added(fused.field, objects, teach)
        except ValueError as error:
            raise InvalidInput(f"{request.fused}: {error}") from error
        progress.phase("measuring", None)
        origin = placement(fused.origin)
        size = LOCAL_VIEW if edited.local else REGION_SETTINGS.view_size
        cameras = cameras_of(request, fused, new, placed, truth, origin, size)
        if edited.local:  # what the region hides is all that can differ
            judge = RegionJudge(truth, cameras, origin, placed_box(edited.box, fused.origin))
        else:
            judge = Judge(truth, cameras, origin)
        nodes = history_nodes(new, request.output, {})
        entry = {
            "event": "added",
            "nodes": [placed_note(n, request.object_to_world, request.name) for n in nodes],
        }
        try:
            reached = judge(stored(edited.field, precision).to(place))
        except KeyboardInterrupt:
            if not edited.local:  # it was learnt
                with held_back(request.output):
                    write_edited(request, fused, edited.field, precision, entry)
            raise
        size = write_edited(request, fused, edited.field, precision, entry | {"psnr": reached})
    figures = {**edited.figures, "psnr": {"before_rgb": reached}, "memory": memory.report()}
    return edit_report(request, size, request.name, fused, edited, figures, started)


def write_edited(request: EditRequest, fused: Fused, field: StoredField, precision: str, entry: dict) -> int:
    """Write the edited field with one more entry of history; the bytes written."""
    if request.keep_history:
        entry = entry | {"before": keep(fused.path, request.output)}

    def write(output: str) -> int:
        return write_field(
            output,
            field,
            fused.node.name,
            precision=precision,
            overwrite=request.overwrite,
            origin=fused.origin,
            history=summed_up((*fused.scene.history, entry)),
            kept=dict.fromkeys(fused.others, fused.bundle),
            extras=fused.scene.extras,
            framing=fused.framing,
            cameras=fused.scene.cameras,
        )

    learnt = isinstance(request, Learning)
    return written_somewhere(request.output, write) if learnt else write(request.output)


def addition_memory(field: StoredField, new: LoadedScene) -> list[dict[str, float]]:
    """The stages of adding a scene's fields to a field: putting together, measuring."""
    view, old = REGION_SETTINGS.view_size, field.params.numel() * FLOAT
    sizes, numbers = [old, *new.sizes], (old + sum(new.sizes)) // FLOAT
    return [
        sources(sizes, copies=RESAMPLING) | finished(numbers, measured=False) | ownership(field.aabb),
        sources(sizes) | finished(numbers) | ownership(field.aabb) | picture(view, view // 2, composed=True),
    ]


def read_fused(path: str, memory: Memory, turned: bool = False) -> Fused:
    """A bundle of one field, in a frame that may be turned or scaled; InvalidInput when it is something
    else."""
    if not is_bundle(path):
        raise InvalidInput(f"{path}: not a bundle; fuse the scene to a .rfpack first")
    bundle = OpenBundle(path)
    scene = bundle.scene
    check_history(scene, path)
    leaves = [leaf for leaf in scene.leaves() if leaf.field is not None]
    if len(leaves) != 1:
        raise InvalidInput(
            f"{path}: holds {len(leaves)} placed fields where one fused field was expected; fuse it first"
        )
    (leaf,) = leaves
    if not leaf.whole:
        raise InvalidInput(
            f"{path}: its field is cropped, thinned or hidden, and cannot be edited; fuse it first"
        )
    needs = needs_of(bundle, leaf.field)
    memory.expect({"the field while it is read": needs.held + needs.reading}, advice="edit a smaller field")
    field = make_field(bundle.field(leaf.field), path)
    linear = leaf.object_to_world[:3, :3]
    upright = linear[0, 0] > 0 and np.array_equal(linear, linear[0, 0] * np.eye(3))
    if not upright and not turned and field.occupancy.space is bounded:
        raise InvalidInput(f"{path}: its field is turned or stretched, and cannot be edited; fuse it first")
    others = [member for member in bundle.headers if member != leaf.field]
    precision = bundle.headers[leaf.field].precision
    return Fused(bundle, scene, others, leaf, field, registry.kind(field.kind), precision)


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


def cameras_of(
    request: AddRequest,
    fused: Fused,
    new: LoadedScene,
    placed: list[Placed],
    truth: ComposedField,
    origin: np.ndarray,
    side: int,
) -> list[Camera]:
    """The views, `side` pixels a side, that an addition is judged by: of the whole, whose frame lies at
    `origin` (4, 4), and of what was added."""
    kept = fused.scene.cameras
    own = rig_of(new)
    rig = own and own.placed(request.object_to_world)
    subjects = [
        Subject(p.name, placed_box(p.field.occupancy.subject, p.object_to_world), rig)
        for p in placed
        if not p.unbounded
    ]
    box = placed_box(truth.occupancy.subject, origin)
    seed = JUDGED_SEED, 3, request.seed
    whole = None if kept is None else read_rig(kept)
    return [look.camera for look in looks(whole, box, subjects, REGION_SETTINGS.views, (side, side), seed)]


def placed_at(placed: Placed, field: StoredField, request: AddRequest) -> Placed:
    """A field placed as another one and then once more, under a name; InvalidInput where both placements
    together are singular."""
    try:
        return Placed(request.name, field, request.object_to_world @ placed.object_to_world)
    except ValueError as error:
        raise InvalidInput(f"{request.source}: {error}; give an invertible placement") from error


def placed_note(node: dict, object_to_world: np.ndarray, name: str) -> dict:
    """A history node of an added object, in the world it was added to."""
    return node | {
        "name": name,
        "object_to_world": (object_to_world @ np.asarray(node["object_to_world"])).tolist(),
        "aabb": transformed_aabb(np.asarray(node["aabb"]), object_to_world).tolist(),
    }


def edit_report(
    request: EditRequest | ArrangeRequest,
    size: int,
    names: str,
    fused: Fused,
    edited: Edited,
    figures: dict,
    started: float,
) -> dict:
    """The report of an edit."""
    extent = edited.box[3:] - edited.box[:3]
    whole = edited.field.occupancy.aabb[3:] - edited.field.occupancy.aabb[:3]
    rounded, near = None, SAME_BITS if edited.local else NEARLY
    kept = isinstance(request, ArrangeRequest)  # whose numbers are written as they are
    if edited.local and not kept and not (request.precision or fused.precision).startswith("float"):
        rounded = fused.kind.rounded(edited.field, edited.box)
    return {
        "output": request.output,
        "bytes": size,
        "source_bytes": Path(request.fused).stat().st_size,
        "touched": {
            "names": names,
            "aabb": placed_box(edited.box, fused.origin).tolist(),
            **({} if rounded is None else {"rounded_in": placed_box(rounded, fused.origin).tolist()}),
            **fused.kind.counts(edited.field),
            "share_of_box": float(min(1.0, np.prod(extent / whole))),
            "how": f"{edited.how}; {near if rounded is None else ROUNDED}",
        },
        **figures,
        "total_seconds": time.monotonic() - started,
    }
