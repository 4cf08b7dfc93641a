"""`extract`: an object out of a bundle, told by masks, points, shapes or its name, and what is left without
it."""

import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from formats.bundle import OpenBundle
from formats.camera_set import CameraSet, read_camera_set
from formats.errors import FormatError
from formats.graph import chosen, leaf_names
from formats.scene import SceneGraph
from formats.views import View
from fusedrf_cli.bridge.cutouts import Cutout, ObjectCutout, RestCutout
from fusedrf_cli.bridge.cutting import Fields, Whole, cut, cut_with_hidden, nodes_of
from fusedrf_cli.bridge.distilled import DistilledShape, holders_in
from fusedrf_cli.bridge.editing import Draft
from fusedrf_cli.bridge.fusing import fuse
from fusedrf_cli.bridge.inpainting import Frame, fill_hole
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.previews import check_preview, previews
from fusedrf_cli.bridge.rendering import renderable
from fusedrf_cli.bridge.runtime import engine, without_interrupts, written_somewhere
from fusedrf_cli.bridge.scene import load_scene
from fusedrf_cli.bridge.selecting import (
    ObjectCues,
    SelectingConfig,
    check_cues,
    cues_of,
    in_frame,
    nothing_selected,
    selected,
    small,
    views_by_name,
    watching,
)
from fusedrf_cli.bridge.sources import scene_as_stored
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import placed_box, placement, squeezed
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.rendering.cameras import Camera, framing, framing_lens
from fusedrf_cli.engine.selection.voting import shown_by, well_shown
from fusedrf_cli.engine.selection.weights import cell_weights
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.requests import ExtractRequest, FuseRequest

OBJECT = "object"
"""The node of an object that was not chosen by a name."""


@dataclass(frozen=True)
class ExtractingConfig:
    """From when what was seen of an object counts."""

    seen_from: float = 2e-3
    """Weight of what was seen of an object."""
    seen: float = 0.1
    """Of how much cameras see of a cell that they see well (`well_shown`): less is not seen, and what a field
    has there it has by chance."""
    unsure: float = 0.6
    """How far those who chose agree, under which it is said that they do not."""


def extract(request: ExtractRequest, progress) -> dict:
    """Write an object of a bundle, or the bundle without it, as a bundle of its own."""
    with engine(request.device, request.threads, progress) as device:
        started = time.monotonic()
        if (request.refit or request.fill) and not request.invert:
            raise UsageProblem("--refit and --fill mend what is left of the field; give --invert too")
        if request.preview:
            check_preview(request)
        progress.phase("reading", None)
        memory = Memory(request.memory)
        draft = Draft(request.field, memory)
        named = named_nodes(request, draft)
        named_views = views_by_name(request, draft.graph)
        check_cues(request, named_views)
        pieces = Whole.read(draft)
        progress.phase("choosing", None)
        object_field, shown, rest, figures = parted(request, pieces, named, named_views, progress)
        box = placed_box(shown.occupancy.look_at_box, pieces.origin)
        left = pieces.composed(rest) if request.invert or request.preview else None
        if request.invert:
            if left is None:
                raise InvalidInput(f"{request.field}: nothing is left beside the object; leave --invert out")
            cutout = RestCutout(pieces, rest, request.precision, request.name, named)
            frame = Frame(pieces.path, pieces.scene, pieces.field, pieces.origin)
            fillings, figures["hole"] = fill_hole(request, frame, left, shown, memory, device, progress)
            for one in fillings:
                cutout.add(one)
        else:
            cameras = own_cameras(pieces.scene, box)
            name = request.name or OBJECT
            cutout = ObjectCutout(pieces, object_field, request.precision, name, named, box, cameras)
        if request.max_size is not None:
            figures |= within_size(request, cutout, progress)
        with without_interrupts(request.output):
            size = written_somewhere(request.output, lambda output: cutout.write(output, request.overwrite))
        if request.preview:
            pictured = {
                "whole": (pieces.field, pieces.origin),
                "object": (shown, pieces.origin),
                "rest": None if left is None else (left, pieces.origin),
            }
            pictured["rest" if request.invert else "object"] = renderable(load_scene(request.output))
            figures["preview"] = previews(request, pictured, box, named_views, progress)
    return {
        "output": request.output,
        "bytes": size,
        "kind": cutout.kinds,
        "precision": cutout.precisions,
        "nodes": len(cutout.graph.leaves()),
        "box": [float(x) for x in box],
        **figures,
        "total_seconds": time.monotonic() - started,
        "memory": memory.report(),
    }


def named_nodes(request: ExtractRequest, draft: Draft) -> set[str]:
    """The nodes that hold a field and go by the name that was asked for, or are in one that does; none where
    that is an object in a distilled field. InvalidInput where there is nothing of that name."""
    if request.name is None:
        return set()
    if request.masks or request.points or request.boxes or request.spheres or request.mesh:
        raise UsageProblem("--name takes a whole part; leave out what else tells of the object")
    if request.name in draft.inside:
        return set()
    named = leaf_names(chosen(draft.graph, {request.name}))
    if not named:
        held = ", ".join(sorted(draft.names))
        raise InvalidInput(f"{request.field}: there is no part '{request.name}'; it holds {held}")
    if named.isdisjoint(leaf.name for leaf in draft.graph.leaves() if leaf.visible):
        raise InvalidInput(f"{request.field}: '{request.name}' is hidden; show it, or choose another part")
    return named


def parted(
    request: ExtractRequest, whole: Whole, named: set[str], named_views: dict[str, View], progress
) -> tuple[Fields, RadianceField, Fields, dict]:
    """The object's fields, what they show, those that are left, and what the report says of how it was
    chosen; named: its nodes, where it is those. InvalidInput where there is no such object."""
    if named:
        objects, rest = whole.named(named)
        return objects, whole.composed(objects), rest, {}
    extracting = current(ExtractingConfig)
    config = current(SelectingConfig)
    by_name = request.name is not None
    cues = cues_by_name(request.name, whole) if by_name else cues_of(request, whole, named_views, progress)
    selection = selected(whole.field, cues)
    cameras = watching(whole)
    shown = shown_by(whole.field, selection.lattice, cameras)
    well = extracting.seen * well_shown(selection, shown)
    selection = selection.without(shown < well)
    if not selection.shows:
        raise InvalidInput(f"{request.field}: {nothing_selected(request)}")
    if selection.sure < extracting.unsure and cues.is_guess:
        progress.warn(
            f"what tells of the object agrees by {selection.sure:.0%} only; look at --preview, and "
            "give more masks or points"
        )
    progress.phase("cutting", None)
    touched = set(whole.raw)
    if by_name:
        touched = {leaf.name for leaf in holders_in(whole.scene)}
    elif cues.is_guess and len(touched) > 1:
        touched = nodes_of(whole, selection)
    if request.invert and cameras:
        objects, rest = cut_with_hidden(whole, selection, shown, well, cameras, touched)
    else:
        objects, rest = cut(whole, selection, bool(request.invert or request.preview), touched)
    object_shown = whole.composed(objects)
    if object_shown is None:
        raise InvalidInput(f"{request.field}: {nothing_selected(request)}")
    share = seen_share(
        [in_frame(small(view, config.seen_side), whole) for view in some(named_views)], object_shown
    )
    return objects, object_shown, rest, {"sure": round(selection.sure, 3), "seen": share}


def cues_by_name(name: str, whole: Whole) -> ObjectCues:
    """What tells of an object that was distilled into a field with others: where it stood, and the cells of
    its source; of what they stood in, that it is none of them."""
    inside, origin = whole.draft.inside, placement(whole.origin)
    background = bool(inside[name].get("background"))
    beside = 0.5 * whole.field.voxel_size * squeezed(origin)
    named = [node for key, node in inside.items() if (key != name) == background]
    shapes = [DistilledShape(node, whole.draft.bundle, beside) for node in named]

    def holds(points: np.ndarray) -> np.ndarray:
        at, found = points @ origin[:3, :3].T + origin[:3, 3], np.zeros(len(points), bool)
        for shape in shapes:
            found |= shape.holds(at)
        return found != background

    none = np.zeros((0, 3))
    return ObjectCues(holds, [], [], none, none, touches=True)


# -- what was seen of it -------------------------------------------------------------------------------------


def some(named_views: dict[str, View]) -> list[View]:
    """At most 60 views, evenly spaced."""
    views = list(named_views.values())
    return [views[i] for i in np.unique(np.linspace(0, len(views) - 1, 60).astype(int))] if views else []


def seen_share(capture_views: list[Camera], object_field: RadianceField) -> float | None:
    """Of the object's cells that some view around it shows, the share that cameras of the frame show; None
    where there are none."""
    extracting = current(ExtractingConfig)
    config = current(SelectingConfig)
    if not capture_views:
        return None
    lens = framing_lens(config.seen_side, config.seen_side)
    around = [
        replace(framing(object_field.occupancy.look_at_box, lens, azimuth, elevation).camera(lens), name="")
        for elevation in (-0.6, 0.0, 0.6, 1.2)
        for azimuth in np.arange(6) * np.pi / 3
    ]
    shown, all_round = (
        weighed(object_field, cameras) > extracting.seen_from for cameras in (capture_views, around)
    )
    total = int(all_round.sum())
    return round(float((shown & all_round).sum() / total), 3) if total else None


def weighed(field: RadianceField, cameras: list[Camera]) -> np.ndarray:
    """(X, Y, Z) for each cell the sum of the weights that pixels of cameras in the frame give it."""
    total = 0.0
    for camera in cameras:
        rays_o, rays_d = camera.rays()
        half, every = np.full(len(rays_o), 0.5), np.ones(len(rays_o), bool)
        total = total + cell_weights(field, rays_o, rays_d, half, every, field.occupancy)[1]
    return total


def own_cameras(scene: SceneGraph, box: np.ndarray) -> dict | None:
    """The cameras that photographed an object in a box (6,) of the world, as of one that stands free."""
    if scene.cameras is None:
        return None
    camera_set: CameraSet = read_camera_set(scene.cameras)
    focus = (box[:3] + box[3:]) / 2
    distance = float(np.median(np.linalg.norm(camera_set.poses[:, :3, 3] - focus, axis=1)))
    try:
        return replace(camera_set, focus=focus, distance=distance, surroundings=False).content()
    except FormatError:
        return None


# -- its size ------------------------------------------------------------------------------------------------


def within_size(request: ExtractRequest, cutout: Cutout, progress) -> dict:
    """Let the fields of a cutout be as small as was asked for, where its bundle would be larger, as `fuse
    --max-size` makes them; what the report says of that. UsageProblem where they cannot be so small."""
    if cutout.size <= request.max_size:
        return {}
    alone = cutout.alone()
    beside = cutout.size - alone.size
    with tempfile.TemporaryDirectory() as folder:
        pieces, smaller = (str(Path(folder, f"{name}.rfpack")) for name in ("pieces", "smaller"))
        alone.write(pieces, False)
        fused = fuse(
            FuseRequest(
                pieces, smaller, kind=registry.INSTANCES, max_size=max(1, request.max_size - beside),
                precision=request.precision, memory=request.memory, time_budget=request.time_budget,
                seed=request.seed, device=request.device, threads=request.threads,
            ),
            progress,
            load=scene_as_stored,
        )  # fmt: skip
        cutout.take(OpenBundle(smaller))
    return {name: fused[name] for name in ("psnr", "chosen") if name in fused}
