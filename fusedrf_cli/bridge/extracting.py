"""`extract`: an object out of a field, told by masks, points or shapes, and what is left without it."""

import re
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from formats.atomic import atomic_folder, check_writable
from formats.bundle import OpenBundle
from formats.captures import read_cameras
from formats.errors import BadMask, FormatError, OutputExists
from formats.filenames import distinct
from formats.graph import belongs
from formats.history import summed_up
from formats.hulls import Hull
from formats.images import read_mask, write_png
from formats.photos import pictures
from formats.records import BITS, BYTES_PER_NUMBER
from formats.rig import Rig, read_rig
from formats.scene import SceneGraph
from formats.views import View
from fusedrf_cli.bridge.background import LEARNT as FUSED
from fusedrf_cli.bridge.editing import Draft
from fusedrf_cli.bridge.fusing import best_of, best_suited
from fusedrf_cli.bridge.making import Scene
from fusedrf_cli.bridge.memory import FLOAT, Memory, ownership
from fusedrf_cli.bridge.memory import sources as in_memory
from fusedrf_cli.bridge.mending import Frame, mended
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.rendering import to_pixels
from fusedrf_cli.bridge.running import engine, held_back, written_somewhere
from fusedrf_cli.bridge.scene import (
    NO_MEMBER,
    LoadedScene,
    PlacedRig,
    SourceField,
    stored,
    write_field,
)
from fusedrf_cli.bridge.shelf import Shelf
from fusedrf_cli.bridge.sizes import BESIDES, BundleSizes, graph_bytes
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields.base import FieldNeeds, StoredField
from fusedrf_cli.engine.fields.occupancy import enclosing, placed_box, placement
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.vm.blocks import blocks_of
from fusedrf_cli.engine.rendering.cameras import Camera, framing, framing_lens
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.selection.cells import COARSE, FINE, Lattice, Selection
from fusedrf_cli.engine.selection.growing import chosen_by_points
from fusedrf_cli.engine.selection.voting import Look, chosen_by_masks, shown_by, well_shown
from fusedrf_cli.engine.spaces import bounded
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.requests import ExtractRequest, FuseRequest

LONGEST = 512
"""Pixels along the longer side of a view, in which masks are looked at."""
SHOWN = 400
"""Of a preview."""
PREVIEWS = 4
AROUND = 2
"""Cells around an object that was found in a first look."""
RADIUS = 3
"""Pixels of LONGEST around a point that say what it does, beside masks."""
PREVIEW = re.compile(r".*_(object|marked|rest)\.png")
"""Names of previews."""
MARKED = np.array([1.0, 0.2, 0.1])
BEFORE, ALIKE = 1.05, 0.1
"""A pixel of the whole shows something before the object where its distance is less by so much, and its
colour another."""
SEEN_SIDE, SEEN_FROM = 96, 2e-3
"""Pixels a side of the views that tell what of an object was ever seen, and the weight of what was."""
WATCHING = 48
"""Cameras of a capture that tell what was seen, at most."""
SEEN = 0.1
"""Of how much cameras see of a cell that they see well (`well_shown`): less is not seen, and what a field has
there it has by chance."""
VEILED = 0.2
"""Of how much cameras see of a cell without the object: it was hidden where they saw less before."""
LAYERS, FEW_REVEALED = 4, 1e-4
"""How often what was hidden is taken away, at most, and the share of cells from which it is."""
COPIES = 3.0
"""Of the field in memory, while it is taken apart."""
CELLS_BYTES = 400e6
"""Of cells and votes."""
UNSURE = 0.6


@dataclass(frozen=True)
class Whole:
    """A bundle as one field, out of which an object is taken."""

    draft: Draft
    field: StoredField
    origin: np.ndarray
    """Where its frame lies in the world: a position (3,), or a placement (4, 4)."""
    name: str
    """Of its node."""
    lone: bool
    """Whether it has one node alone."""

    @property
    def kind(self) -> Kind:
        """Of the field."""
        return registry.kind(self.field.kind)

    @property
    def bundle(self) -> OpenBundle:
        """That it is in."""
        return self.draft.bundle

    @property
    def scene(self) -> SceneGraph:
        """Of the bundle."""
        return self.draft.bundle.scene

    @property
    def path(self) -> str:
        """Of the bundle."""
        return self.draft.path

    @property
    def frame(self) -> Frame:
        """What is to be mended."""
        return Frame(self.path, self.scene, self.field, self.origin)

    @property
    def others(self) -> list[str]:
        """Members that no node places: sources that were kept inside."""
        placed = {leaf.field for leaf in self.scene.leaves()}
        return [member for member in self.bundle.headers if member not in placed]

    @property
    def precision(self) -> str:
        """The most exact one of its fields."""
        placed = {leaf.field for leaf in self.scene.leaves()} - {None}
        told = {self.bundle.headers[member].precision for member in placed}
        return max(told, key=BYTES_PER_NUMBER.get)


@dataclass(frozen=True)
class Told:
    """What tells of the object, in the field's frame."""

    shapes: Callable[[np.ndarray], np.ndarray] | None
    """Which points (N, 3) may be its, (N,) bool; None: all."""
    masks: list[Look]
    pointed: list[Look]
    inside: np.ndarray
    """(K, 3) points on it."""
    outside: np.ndarray
    """(L, 3) points that are not."""


@dataclass(frozen=True)
class Piece:
    """The object, or what is left, as it is written."""

    field: StoredField
    origin: np.ndarray
    """Where its frame lies in the world: a position (3,), or a placement (4, 4)."""
    precision: str = ""


def extract(request: ExtractRequest, progress) -> dict:
    """Write an object of a field, or the field without it, as a bundle of its own."""
    with engine(request.device, request.threads, progress) as place:
        started = time.monotonic()
        if (request.refit or request.fill) and not request.invert:
            raise UsageProblem("--refit and --fill mend what is left of the field; give --invert too")
        if request.preview:
            check_preview(request)
        progress.phase("reading", None)
        memory = Memory(request.memory)
        fused = read_whole(request.field, memory)
        held = fused.field.params.numel() * 4
        memory.expect(
            in_memory([held], copies=COPIES) | ownership(fused.field.aabb) | {"its cells": CELLS_BYTES},
            advice="take an object out of a smaller field",
        )
        rig = rig_for(request, fused)
        progress.phase("choosing", None)
        figures = {}
        if request.name is not None:
            parts = named(request, fused)
        else:
            told = told_by(request, fused, rig, progress)
            selection = selected(fused.field, told)
            cameras = watching(fused)
            shown = shown_by(fused.field, selection.lattice, cameras)
            well = SEEN * well_shown(selection, shown)
            selection = selection.without(shown < well)
            if not selection.shows:
                raise InvalidInput(f"{request.field}: {nothing(request)}")
            if selection.sure < UNSURE and (told.masks or len(told.inside)):
                progress.warn(
                    f"what tells of the object agrees by {selection.sure:.0%} only; look at --preview, and "
                    "give more masks or points"
                )
            progress.phase("cutting", None)
            try:
                both = bool(request.invert or request.preview)
                parts = cut(fused, selection, shown, well, cameras if request.invert else [], both)
            except ValueError as error:
                raise InvalidInput(f"{request.field}: {error}") from error
            figures = {"sure": round(selection.sure, 3), "seen": seen_share(fused, rig, parts[0])}
        found, rest = parts
        wanted, beside = rest if request.invert else found, []
        if wanted is None:
            raise InvalidInput(f"{request.field}: nothing is left beside the object; leave --invert out")
        if request.invert:
            frame = fused.frame
            fillings, figures["hole"] = mended(request, frame, wanted, found, memory, place, progress)
            wanted, beside = with_fillings(wanted, fillings)
            parts = found, wanted
        progress.phase("trimming", None)
        wanted = registry.kind(wanted.kind).trimmed(wanted)
        bundle = bundle_of(request, fused, found) | {"beside": beside}
        piece = Piece(wanted, fused.origin, precision_of(request, fused, wanted))
        if request.max_size is not None:
            piece, told = within_size(request, fused, piece, bundle, memory, place, progress)
            figures |= told
        with held_back(request.output):
            size = written_somewhere(
                request.output,
                lambda output: write_field(
                    output,
                    piece.field,
                    precision=piece.precision,
                    overwrite=request.overwrite,
                    origin=piece.origin,
                    **bundle,
                ),
            )
        whole = [None if part is None else Piece(part, fused.origin) for part in parts]
        whole[bool(request.invert)] = piece
        files = previews(request, fused, rig, whole, progress) if request.preview else []
        box = placed_box(found.occupancy.subject, fused.origin)
    return {
        "output": request.output,
        "bytes": size,
        "kind": piece.field.kind,
        "precision": piece.precision,
        "box": [float(x) for x in box],
        **figures,
        **({"preview": files} if files else {}),
        "total_seconds": time.monotonic() - started,
        "memory": memory.report(),
    }


def read_whole(path: str, memory: Memory) -> Whole:
    """The bundle at a path as one field. InvalidInput where its nodes are none that can be taken apart."""
    draft = Draft(path, memory)
    leaves, scene = draft.bundle.scene.leaves(), draft.before
    if len(leaves) == 1:
        if not leaves[0].whole:
            raise InvalidInput(f"{path}: its field is cropped, thinned or tinted; fuse it first")
        field, origin = scene.lone()
        return Whole(draft, field, origin, leaves[0].name, True)
    composed = scene.composed()
    try:
        field = blocks_of(composed.placed)
    except ValueError as error:
        kinds = ", ".join(sorted({p.field.kind for p in composed.placed}))
        raise InvalidInput(
            f"{path}: its nodes are fields of the kinds {kinds}, which cannot be taken apart together; "
            "delete nodes by name, or fuse it to one field first"
        ) from error
    return Whole(draft, field, composed.origin, FUSED, False)


def check_preview(request: ExtractRequest) -> None:
    """Before any work: the folder of previews may be written, and what would be replaced are previews.
    `--overwrite` is asked for the sake of the bundle, and must not take other files with it."""
    check_writable(request.preview, request.overwrite, folders=True)
    folder = Path(request.preview)
    files = folder.iterdir() if folder.is_dir() else ()
    others = [file for file in files if not PREVIEW.fullmatch(file.name)]
    if others:
        raise OutputExists(
            f"{folder}: holds {others[0].name}, which is no preview; choose a folder that is new or empty"
        )


# -- what tells of it ----------------------------------------------------------------------------------------


def rig_for(request: ExtractRequest, fused: Whole) -> dict[str, View]:
    """The views that masks and points are of, by name."""
    if request.cameras is not None:
        return {view.name: view for view in read_cameras(request.cameras)}
    if fused.scene.cameras is None:
        return {}
    rig = read_rig(fused.scene.cameras)
    return {view.name: view for view in rig.test + rig.train}


def told_by(request: ExtractRequest, fused: Whole, rig: dict[str, View], progress) -> Told:
    """What a request says, read and checked."""
    if not (request.masks or request.points or request.boxes or request.spheres or request.mesh):
        raise UsageProblem("say which object: --masks, --points, --box, --sphere, --mesh or --name")
    if (request.masks or request.points) and not rig:
        raise InvalidInput(
            f"{request.field}: it keeps no cameras that masks or points could be of; give --cameras"
        )
    masks = masked(request, fused, rig, progress) if request.masks else []
    pointed = [pointed_at(one, request, fused, rig) for one in request.points]
    if pointed and not masks and not any(shows for *_, shows in request.points):
        raise UsageProblem("--points: none of them shows the object; give one without ,out")
    places = {True: [], False: []}
    for look, (view, column, row, shows) in zip(pointed, request.points, strict=True):
        places[shows].append(surface_at(fused.field, look, f"--points {view}:{column:g},{row:g}"))
    own, other = (np.array(places[shows]).reshape(-1, 3) for shows in (True, False))
    return Told(within(request, fused), masks, pointed, own, other)


def within(request: ExtractRequest, fused: Whole) -> Callable[[np.ndarray], np.ndarray] | None:
    """Which points of the frame lie in the shapes: in any of the boxes, if there are some, in any of the
    spheres, and in the mesh."""
    hull = Hull(request.mesh) if request.mesh else None
    if not (request.boxes or request.spheres or hull):
        return None
    origin = placement(fused.origin)
    boxes, spheres = np.array(request.boxes).reshape(-1, 6), np.array(request.spheres).reshape(-1, 4)

    def holds(points: np.ndarray) -> np.ndarray:
        at = points @ origin[:3, :3].T + origin[:3, 3]
        found = np.ones(len(at), bool)
        if len(boxes):
            found &= np.any([((at >= b[:3]) & (at <= b[3:])).all(1) for b in boxes], 0)
        if len(spheres):
            found &= np.any([((at - s[:3]) ** 2).sum(1) <= s[3] ** 2 for s in spheres], 0)
        return found & hull.contains(at) if hull else found

    return holds


def masked(request: ExtractRequest, fused: Whole, rig: dict[str, View], progress) -> list[Look]:
    """The masks of a folder, each with the view that is named as it."""
    files = pictures(Path(request.masks))
    if not files:
        raise InvalidInput(
            f"{request.masks}: no folder of pictures; give one of masks, each named as the view that it masks"
        )
    pairs = [(path, rig.get(path.stem) or rig.get(Path(path.stem).stem)) for path in files]
    known = [(path, view) for path, view in pairs if view is not None]
    if not known:
        names = ", ".join(list(rig)[:3])
        raise InvalidInput(
            f"{request.masks}: none of its {len(files)} pictures is named as a view; the views are {names}, "
            f"… ({len(rig)} in all)"
        )
    if len(known) < len(files):
        progress.warn(
            f"{request.masks}: {len(files) - len(known)} pictures are named as no view, and left out"
        )
    found = [looked_at(view, path, fused) for path, view in known]
    shares = [look.inside.mean() for look in found]
    if not any(shares) or min(shares) == 1:
        raise BadMask(
            f"{request.masks}: the masks are {'black' if not any(shares) else 'white'} all over; paint the "
            "object white and all else black"
        )
    return found


def looked_at(view: View, path: Path, fused: Whole) -> Look:
    """A mask and its view, at most LONGEST pixels a side. Raises BadMask where their shapes differ."""
    mask = read_mask(path)
    high, wide = mask.shape
    if abs(wide * view.height - high * view.width) > 0.01 * wide * view.height:
        raise BadMask(
            f"{path}: {wide}x{high} pixels, but the view '{view.name}' has {view.width}x{view.height}; paint "
            "masks on pictures of that size"
        )
    smaller = small(view, LONGEST)
    rows = ((np.arange(smaller.height) + 0.5) * high / smaller.height).astype(int)
    columns = ((np.arange(smaller.width) + 0.5) * wide / smaller.width).astype(int)
    return Look(in_frame(smaller, fused), mask[np.ix_(rows, columns)])


def small(view: View, longest: int) -> View:
    """A view with at most so many pixels along its longer side."""
    share = min(1.0, longest / max(view.width, view.height))
    return (
        view if share == 1 else view.reframed(*(max(1, round(n * share)) for n in (view.width, view.height)))
    )


def in_frame(view: View, fused: Whole) -> Camera:
    """The camera of a view in the field's frame."""
    return camera_of(view).seen_from(placement(fused.origin))


def pointed_at(point: tuple, request: ExtractRequest, fused: Whole, rig: dict[str, View]) -> Look:
    """The pixels around a point, which say whether they show the object."""
    name, column, row, shows = point
    if name not in rig:
        names = ", ".join(list(rig)[:3])
        raise InvalidInput(
            f"{request.field}: there is no view '{name}'; the views are {names}, … ({len(rig)} in all)"
        )
    view = rig[name]
    if column >= view.width or row >= view.height:
        raise UsageProblem(
            f"--points: {column:g},{row:g} lies outside of the view '{name}' of {view.width}x{view.height} "
            "pixels"
        )
    smaller = small(view, LONGEST)
    x, y = column * smaller.width / view.width, row * smaller.height / view.height
    away = np.hypot(np.arange(smaller.width) + 0.5 - x, (np.arange(smaller.height) + 0.5 - y)[:, None])
    near = away <= max(RADIUS, away.min() + 1e-9)
    return Look(in_frame(smaller, fused), near & shows, near)


def surface_at(field: StoredField, look: Look, what: str) -> np.ndarray:
    """(3,) the point of the frame that the middle of a pointed look shows; InvalidInput where there is
    nothing."""
    rays_o, rays_d = look.camera.rays()
    away = look.depths(field).ravel()[look.counted.ravel()]
    if not np.isfinite(away).any():
        raise InvalidInput(f"{what}: there is nothing to be seen; point at what shows")
    chosen = look.counted.ravel()
    middle = np.median(away[np.isfinite(away)])
    way = rays_d[chosen].mean(0)
    return rays_o[chosen][0] + middle * way / np.linalg.norm(way)


# -- choosing ------------------------------------------------------------------------------------------------


def selected(field: StoredField, told: Told) -> Selection:
    """The object in two looks: at all of the field in coarse cells, and at the box that it lies in. Where it
    touches other matter colours correct what masks say."""
    found = choice(Lattice.over(field, field.occupancy.aabb, COARSE), told)
    if not found.shows:
        return found
    held = found.lattice.grid.marked(found.lattice.spread(found.chosen & found.lattice.dense))
    fine = choice(Lattice.over(field, held.tight_aabb(AROUND), FINE), told)
    return fine.without_foreign() if told.masks else fine


def choice(lattice: Lattice, told: Told) -> Selection:
    """What masks, points or, without these, the shapes alone say, within the shapes."""
    allowed = np.ones(len(lattice.points), bool) if told.shapes is None else told.shapes(lattice.points)
    if not allowed.any():
        return Selection(lattice, allowed)
    inner = lattice.kept(allowed)
    if told.masks:
        found = chosen_by_masks(inner, [*told.masks, *told.pointed])
    elif len(told.inside):
        found = chosen_by_points(inner, told.inside, told.outside, lattice.beside(allowed))
    else:
        found = Selection(inner, np.ones(len(inner.points), bool))
    chosen = allowed.copy()
    chosen[allowed] = found.chosen
    return Selection(lattice, chosen, found.sure)


def nothing(request: ExtractRequest) -> str:
    """Why nothing was chosen."""
    if request.masks or request.points:
        return "what the masks or points show holds nothing of the field; look at it from those views"
    return "there is nothing in the given shape; shapes are in the units of the world (see fusedrf info)"


def named(request: ExtractRequest, fused: Whole) -> tuple[StoredField | None, StoredField | None]:
    """The nodes that go by a name, and what is left without them."""
    if request.masks or request.points or request.boxes or request.spheres or request.mesh:
        raise UsageProblem("--name takes a whole part; leave out what else tells of the object")
    names = {leaf.name for leaf in fused.scene.leaves()}
    own = {name for name in names if belongs(name, {request.name})}
    if not own:
        held = ", ".join(sorted(names))
        raise InvalidInput(f"{request.field}: there is no part '{request.name}'; it holds {held}")
    if fused.lone:
        return fused.field, None
    return fused.kind.without(fused.field, names - own), fused.kind.without(fused.field, own)


def with_fillings(rest: StoredField, fillings: list[Placed]) -> tuple[StoredField, list[Placed]]:
    """What is left of a field with what fills its hole, and of that what has to be a field of its own."""
    if not fillings:
        return rest, []
    try:
        return blocks_of([Placed("", rest, np.eye(4)), *fillings]), []
    except ValueError:
        return rest, fillings


def seen_share(fused: Whole, rig: dict[str, View], found: StoredField | None) -> float | None:
    """Of the object's cells that some view around it shows, the share that the capture's views show; None
    where there are no views."""
    if not rig or found is None:
        return None
    chosen = [list(rig.values())[i] for i in np.unique(np.linspace(0, len(rig) - 1, 60).astype(int))]
    own = [in_frame(small(view, SEEN_SIDE), fused) for view in chosen]
    lens = framing_lens(SEEN_SIDE, SEEN_SIDE)
    around = [
        replace(framing(found.occupancy.subject, lens, azimuth, elevation).camera(lens), name="")
        for elevation in (-0.6, 0.0, 0.6, 1.2)
        for azimuth in np.arange(6) * np.pi / 3
    ]
    shown, all_round = (weighed(found, cameras) > SEEN_FROM for cameras in (own, around))
    total = int(all_round.sum())
    return round(float((shown & all_round).sum() / total), 3) if total else None


def weighed(field: StoredField, cameras: list[Camera]) -> np.ndarray:
    """(X, Y, Z) for each cell the sum of the weights that pixels of cameras in the frame give it."""
    from fusedrf_cli.engine.fields.base import sampling_step

    total = 0.0
    for camera in cameras:
        rays_o, rays_d = camera.rays()
        half, every = np.full(len(rays_o), 0.5), np.ones(len(rays_o), np.uint8)
        total = total + field.votes(rays_o, rays_d, half, every, sampling_step(field), field.occupancy)[1]
    return total


def watching(fused: Whole) -> list[Camera]:
    """Cameras of the capture, in the field's frame, that tell what of it was ever seen; of a field that
    keeps none, none."""
    views = [] if fused.scene.cameras is None else read_rig(fused.scene.cameras).views
    chosen = np.unique(np.linspace(0, len(views) - 1, WATCHING).astype(int)) if views else []
    return [in_frame(small(views[i], SEEN_SIDE), fused) for i in chosen]


def cut(
    fused: Whole,
    selection: Selection,
    shown: np.ndarray,
    least: float,
    cameras: list[Camera],
    both: bool,
) -> tuple[StoredField | None, StoredField | None]:
    """The object, and what is left, without what shows where the object was to cameras that did not see it
    before (`shown`, (M,); `least` where it is seen at all). Such is in a field by chance, and behind it lies
    more of it. Without `both` the object alone is cut out."""
    found = fused.kind.cut_out(fused.field, selection)
    if not both:
        return found, None
    gone = selection.with_islands() if cameras else selection  # of photos: what hangs in the air is an error
    left = fused.kind.cut_away(fused.field, gone)
    for _ in range(LAYERS if cameras else 0):
        if left is None:
            break
        now = shown_by(left, selection.lattice, cameras)
        revealed = ~gone.chosen & (now > least) & (shown < VEILED * now)
        if revealed.mean() < FEW_REVEALED:
            break
        gone = gone.joined(revealed)
        left = fused.kind.cut_away(fused.field, gone)
    return found, left


# -- writing -------------------------------------------------------------------------------------------------


def bundle_of(request: ExtractRequest, fused: Whole, found: StoredField) -> dict:
    """What `write_field` writes beside the field: of what is left all that the bundle had, of the object what
    is its own."""
    if request.invert:
        entry = {"event": "extracted", "names": [request.name] if request.name else []}
        history = summed_up((*fused.scene.history, entry), ())
        return {
            "name": fused.name,
            "history": history,
            "kept": dict.fromkeys(fused.others, fused.bundle),
            "extras": fused.scene.extras,
            "framing": fused.draft.framing,
            "cameras": fused.scene.cameras,
        }
    return {
        "name": request.name or "object",
        "framing": placed_box(found.occupancy.subject, fused.origin),
        "cameras": own_cameras(fused, found),
    }


def precision_of(request: ExtractRequest, fused: Whole, wanted: StoredField) -> str:
    """As asked for, or as the numbers of the field are stored; those of an object in 8 or 4 bits only where
    they stay what they are, else in float16."""
    if request.precision or request.invert:
        return request.precision or fused.precision
    if fused.precision not in BITS:
        return "float16"
    same = torch.equal(stored(wanted, fused.precision).params, wanted.params)
    return fused.precision if same else "float16"


def within_size(
    request: ExtractRequest,
    fused: Whole,
    piece: Piece,
    bundle: dict,
    memory: Memory,
    place: str,
    progress,
) -> tuple[Piece, dict]:
    """The piece, where its bundle is as small as was asked for, else as `fuse --max-size` makes it; and what
    the report says of that."""
    overhead = graph_bytes(list(bundle.get("history", ())), bundle["cameras"], bundle.get("extras"))
    overhead += sum(BESIDES + fused.bundle.headers[member].size for member in bundle.get("kept", ()))
    overhead += sum(BESIDES + BundleSizes().exactly(one.field, piece.precision) for one in bundle["beside"])
    if overhead + BundleSizes().exactly(piece.field, piece.precision) <= request.max_size:
        return piece, {}
    wanted = FuseRequest(
        request.field, request.output, overwrite=request.overwrite, max_size=request.max_size,
        precision=request.precision, memory=request.memory, time_budget=request.time_budget,
        seed=request.seed, device=request.device, threads=request.threads,
    )  # fmt: skip
    scene = Scene.of(alone(fused, piece, bundle))
    kind, _ = best_suited(scene.composed)
    if kind.field is not None:  # which would learn what the piece's own kind is made of
        kind = registry.kind(piece.field.kind)
    made = best_of(wanted, scene, kind, overhead, memory, place, progress)
    figures, precision = made.figures(), made.kept.tried.way.precision
    told = {name: figures[name] for name in ("psnr", "chosen")}
    if kind.field is None:  # it stays in its own frame
        (leaf,) = made.kept.field.leaves()
        return Piece(opened(leaf.field), piece.origin, precision), told
    return Piece(made.kept.field, scene.composed.origin, precision), told


def alone(fused: Whole, piece: Piece, bundle: dict) -> LoadedScene:
    """A piece as a scene of its own, with the cameras that its bundle keeps."""
    background = piece.field.space is not bounded
    at, cameras = placement(piece.origin), bundle["cameras"]
    placed = Placed(bundle["name"], piece.field, at)
    rigs = () if cameras is None else (PlacedRig(bundle["name"], background, cameras, np.eye(4)),)
    needs = FieldNeeds(held=piece.field.params.numel() * FLOAT, reading=0)
    field = SourceField(placed, background, fused.bundle, NO_MEMBER, needs)
    return LoadedScene((field,), "max", SceneGraph(()), Path(fused.path), Shelf(), rigs)


def own_cameras(fused: Whole, found: StoredField) -> dict | None:
    """The cameras that photographed the object, as of one that stands free."""
    if fused.scene.cameras is None:
        return None
    rig: Rig = read_rig(fused.scene.cameras)
    box = placed_box(found.occupancy.subject, fused.origin)
    focus = (box[:3] + box[3:]) / 2
    distance = float(np.median(np.linalg.norm(rig.poses[:, :3, 3] - focus, axis=1)))
    try:
        return replace(rig, focus=focus, distance=distance, surroundings=False).content()
    except FormatError:
        return None


def previews(
    request: ExtractRequest, fused: Whole, rig: dict[str, View], parts: list[Piece | None], progress
) -> list[str]:
    """Pictures of a few views: the object, the rest, and the whole with the object marked."""
    views = [small(view, SHOWN) for view in shown_views(request, rig)]
    cameras = [camera_of(view) for view in views] or [framed(parts[0])]
    progress.phase("previews", len(cameras))
    files, folder = [], Path(request.preview)
    names = distinct([camera.name or "view" for camera in cameras], ("_object", "_marked", "_rest"))
    with atomic_folder(folder, overwrite=request.overwrite) as temporary:
        for number, (camera, stem) in enumerate(zip(cameras, names, strict=True)):
            for what, pixels in pictures_of(fused, parts, camera).items():
                name = f"{stem}_{what}.png"
                write_png(temporary / name, pixels)
                files.append(str(folder / name))
            progress.advance(number + 1)
    return files


def shown_views(request: ExtractRequest, rig: dict[str, View]) -> list[View]:
    """The views that were masked or pointed at, else some of all."""
    stems = {path.stem for path in pictures(Path(request.masks))} if request.masks else set()
    stems |= {name for name, *_ in request.points}
    named = [view for name, view in rig.items() if name in stems] or list(rig.values())
    return (
        [named[i] for i in np.unique(np.linspace(0, len(named) - 1, PREVIEWS).astype(int))] if named else []
    )


def framed(found: Piece) -> Camera:
    """A view of where the object stands, for want of cameras."""
    lens = framing_lens(SHOWN, SHOWN)
    box = placed_box(found.field.occupancy.subject, found.origin)
    grown = enclosing([box + 0.5 * (box[3:] - box[:3]).max() * np.repeat([-1, 1], 3)])
    return framing(grown, lens).camera(lens)


def pictures_of(fused: Whole, parts: list[Piece | None], camera: Camera) -> dict[str, np.ndarray]:
    """(H, W, 3 or 4) uint8 of the object alone, over nothing; of the rest; and of the whole, in which the
    object is red."""
    found, rest = parts
    whole = render_image(fused.field, camera, origin=fused.origin)
    by_itself = render_image(found.field, camera, origin=found.origin)
    marked, own = whole.over((1, 1, 1)), by_itself.over((1, 1, 1))
    hidden = (by_itself.depth > whole.depth * BEFORE) & (np.abs(marked - own).mean(-1) > ALIKE)
    before = (by_itself.opacity > 0.5) & ~hidden
    marked[before] = 0.5 * marked[before] + 0.5 * MARKED
    shown = {"object": to_pixels(by_itself, None), "marked": np.rint(255 * marked).astype(np.uint8)}
    if rest is not None:
        shown["rest"] = to_pixels(render_image(rest.field, camera, origin=rest.origin), (1.0, 1.0, 1.0))
    return shown
