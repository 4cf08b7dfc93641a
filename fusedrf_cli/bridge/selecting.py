"""Which cells of a bundle are an object's, by what a request says: masks of views, points, and shapes."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from formats.camera_set import read_camera_set
from formats.cameras import read_cameras
from formats.closed_meshes import Hull
from formats.errors import BadMask
from formats.images import read_mask
from formats.photos import pictures
from formats.scene import SceneGraph
from formats.views import View
from fusedrf_cli.bridge.cutting import Whole
from fusedrf_cli.bridge.distilled import inside
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import placement
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.selection.cells import CellConfig, CellGrid, Selection
from fusedrf_cli.engine.selection.growing import chosen_by_points
from fusedrf_cli.engine.selection.voting import MaskedView, chosen_by_masks
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.requests import ExtractRequest


@dataclass(frozen=True)
class SelectingConfig:
    """How an object is looked at, and how finely."""

    longest: int = 512
    """Pixels along the longer side of a view, in which masks are looked at."""
    around: int = 2
    """Cells around an object that was found in a first look."""
    radius: int = 3
    """Pixels of `longest` around a point that say what it does, beside masks."""
    seen_side: int = 96
    """Pixels a side of the views that tell what of an object was ever seen."""
    watching: int = 48
    """Cameras of a capture that tell what was seen, at most."""


@dataclass(frozen=True)
class ObjectCues:
    """What tells of the object, in the field's frame."""

    shapes: Callable[[np.ndarray], np.ndarray] | None
    """Which points (N, 3) may be its, (N,) bool; None: all."""
    masks: list[MaskedView]
    pointed: list[MaskedView]
    inside: np.ndarray
    """(K, 3) points on it."""
    outside: np.ndarray
    """(L, 3) points that are not."""
    touches: bool = False
    """Whether shapes are no closer around it than cells are wide."""

    @property
    def is_guess(self) -> bool:
        """Whether what is the object's is made out by what pictures show, not by shapes alone."""
        return bool(self.masks or len(self.inside))


# -- what tells of it ----------------------------------------------------------------------------------------


def views_by_name(request: ExtractRequest, scene: SceneGraph) -> dict[str, View]:
    """The views that masks and points are of, by name."""
    if request.cameras is not None:
        return {view.name: view for view in read_cameras(request.cameras)}
    if scene.cameras is None:
        return {}
    kept = read_camera_set(scene.cameras)
    return {view.name: view for view in kept.test + kept.train}


def check_cues(request: ExtractRequest, named_views: dict[str, View]) -> None:
    """Before any field is read: UsageProblem where nothing tells of the object, InvalidInput where masks or
    points are of no view."""
    if request.name is not None:
        return
    if not (request.masks or request.points or request.boxes or request.spheres or request.mesh):
        raise UsageProblem("say which object: --masks, --points, --box, --sphere, --mesh or --name")
    if (request.masks or request.points) and not named_views:
        raise InvalidInput(
            f"{request.field}: it keeps no cameras that masks or points could be of; give --cameras"
        )


def cues_of(request: ExtractRequest, fused: Whole, named_views: dict[str, View], progress) -> ObjectCues:
    """What a request says, read and checked."""
    masks = masked_views(request, fused, named_views, progress) if request.masks else []
    pointed = [pointed_at(one, request, fused, named_views) for one in request.points]
    if pointed and not masks and not any(shows for *_, shows in request.points):
        raise UsageProblem("--points: none of them shows the object; give one without ,out")
    points = {True: [], False: []}
    for look, (view, column, row, shows) in zip(pointed, request.points, strict=True):
        points[shows].append(surface_at(fused.field, look, f"--points {view}:{column:g},{row:g}"))
    shown, hidden = (np.array(points[shows]).reshape(-1, 3) for shows in (True, False))
    return ObjectCues(in_shapes(request, fused), masks, pointed, shown, hidden)


def in_shapes(request: ExtractRequest, fused: Whole) -> Callable[[np.ndarray], np.ndarray] | None:
    """Which points of the frame lie in the shapes: in any of the boxes, if there are some, in any of the
    spheres, and in the mesh."""
    hull = Hull(request.mesh) if request.mesh else None
    if not (request.boxes or request.spheres or hull):
        return None
    origin = placement(fused.origin)
    boxes, spheres = np.array(request.boxes).reshape(-1, 6), np.array(request.spheres).reshape(-1, 4)

    def holds(points: np.ndarray) -> np.ndarray:
        at = points @ origin[:3, :3].T + origin[:3, 3]
        held = np.ones(len(at), bool)
        if len(boxes):
            held &= np.any([inside(at, box) for box in boxes], 0)
        if len(spheres):
            held &= np.any([((at - s[:3]) ** 2).sum(1) <= s[3] ** 2 for s in spheres], 0)
        return held & hull.contains(at) if hull else held

    return holds


def masked_views(
    request: ExtractRequest, fused: Whole, named_views: dict[str, View], progress
) -> list[MaskedView]:
    """The masks of a folder, each with the view that is named as it."""
    files = pictures(Path(request.masks))
    if not files:
        raise InvalidInput(
            f"{request.masks}: no folder of pictures; give one of masks, each named as the view that it masks"
        )
    pairs = [(path, named_views.get(path.stem) or named_views.get(Path(path.stem).stem)) for path in files]
    matched = [(path, view) for path, view in pairs if view is not None]
    if not matched:
        names = ", ".join(list(named_views)[:3])
        raise InvalidInput(
            f"{request.masks}: none of its {len(files)} pictures is named as a view; the views are {names}, "
            f"… ({len(named_views)} in all)"
        )
    if len(matched) < len(files):
        progress.warn(
            f"{request.masks}: {len(files) - len(matched)} pictures are named as no view, and left out"
        )
    masks = [masked_view(view, path, fused) for path, view in matched]
    shares = [look.inside.mean() for look in masks]
    if not any(shares) or min(shares) == 1:
        raise BadMask(
            f"{request.masks}: the masks are {'black' if not any(shares) else 'white'} all over; paint the "
            "object white and all else black"
        )
    return masks


def masked_view(view: View, path: Path, fused: Whole) -> MaskedView:
    """A mask and its view, at most `longest` pixels a side. Raises BadMask where their shapes differ."""
    mask = read_mask(path)
    high, wide = mask.shape
    if abs(wide * view.height - high * view.width) > 0.01 * wide * view.height:
        raise BadMask(
            f"{path}: {wide}x{high} pixels, but the view '{view.name}' has {view.width}x{view.height}; paint "
            "masks on pictures of that size"
        )
    smaller = small(view, current(SelectingConfig).longest)
    rows = ((np.arange(smaller.height) + 0.5) * high / smaller.height).astype(int)
    columns = ((np.arange(smaller.width) + 0.5) * wide / smaller.width).astype(int)
    return MaskedView(in_frame(smaller, fused), mask[np.ix_(rows, columns)])


def small(view: View, longest: int) -> View:
    """A view with at most so many pixels along its longer side."""
    share = min(1.0, longest / max(view.width, view.height))
    return (
        view if share == 1 else view.reframed(*(max(1, round(n * share)) for n in (view.width, view.height)))
    )


def in_frame(view: View, fused: Whole) -> Camera:
    """The camera of a view in the field's frame."""
    return camera_of(view).seen_from(placement(fused.origin))


def pointed_at(
    point: tuple, request: ExtractRequest, fused: Whole, named_views: dict[str, View]
) -> MaskedView:
    """The pixels around a point, which say whether they show the object."""
    config = current(SelectingConfig)
    name, column, row, shows = point
    if name not in named_views:
        names = ", ".join(list(named_views)[:3])
        raise InvalidInput(
            f"{request.field}: there is no view '{name}'; the views are {names}, … ({len(named_views)} in "
            "all)"
        )
    view = named_views[name]
    if column >= view.width or row >= view.height:
        raise UsageProblem(
            f"--points: {column:g},{row:g} lies outside of the view '{name}' of {view.width}x{view.height} "
            "pixels"
        )
    smaller = small(view, config.longest)
    x, y = column * smaller.width / view.width, row * smaller.height / view.height
    away = np.hypot(np.arange(smaller.width) + 0.5 - x, (np.arange(smaller.height) + 0.5 - y)[:, None])
    near = away <= max(config.radius, away.min() + 1e-9)
    return MaskedView(in_frame(smaller, fused), near & shows, near)


def surface_at(field: RadianceField, look: MaskedView, what: str) -> np.ndarray:
    """(3,) the point of the frame that the middle of a pointed look shows; InvalidInput where there is
    nothing."""
    rays_o, rays_d = look.camera.rays()
    away = look.depths(field).ravel()[look.counted.ravel()]
    if not np.isfinite(away).any():
        raise InvalidInput(f"{what}: there is nothing to be seen; point at what shows")
    chosen = look.counted.ravel()
    middle = np.median(away[np.isfinite(away)])
    direction = rays_d[chosen].mean(0)
    return rays_o[chosen][0] + middle * direction / np.linalg.norm(direction)


def watching(fused: Whole) -> list[Camera]:
    """Cameras of the capture, in the field's frame, that tell what of it was ever seen; of a field that
    keeps none, none."""
    config = current(SelectingConfig)
    views = [] if fused.scene.cameras is None else read_camera_set(fused.scene.cameras).views
    chosen = np.unique(np.linspace(0, len(views) - 1, config.watching).astype(int)) if views else []
    return [in_frame(small(views[i], config.seen_side), fused) for i in chosen]


# -- choosing ------------------------------------------------------------------------------------------------


def selected(field: RadianceField, cues: ObjectCues) -> Selection:
    """The object in two looks: at all of the field in coarse cells, and at the box that it lies in. Where it
    touches other density colours correct what masks say."""
    config = current(CellConfig)
    selection = selection_by_cues(CellGrid.over(field, field.occupancy.aabb, config.coarse), cues)
    if not selection.shows:
        return selection
    grid = selection.lattice.grid.marked(selection.lattice.spread(selection.chosen & selection.lattice.dense))
    fine = selection_by_cues(
        CellGrid.over(field, grid.tight_aabb(current(SelectingConfig).around), config.fine), cues
    )
    return fine.without_foreign() if cues.masks or cues.touches else fine


def selection_by_cues(lattice: CellGrid, cues: ObjectCues) -> Selection:
    """What masks, points or, without these, the shapes alone say, within the shapes."""
    allowed = np.ones(len(lattice.points), bool) if cues.shapes is None else cues.shapes(lattice.points)
    if not allowed.any():
        return Selection(lattice, allowed)
    inner = lattice.kept(allowed)
    if cues.masks:
        selection = chosen_by_masks(inner, [*cues.masks, *cues.pointed])
    elif len(cues.inside):
        selection = chosen_by_points(inner, cues.inside, cues.outside, lattice.beside(allowed))
    else:
        selection = Selection(inner, np.ones(len(inner.points), bool))
    chosen = allowed.copy()
    chosen[allowed] = selection.chosen
    return Selection(lattice, chosen, selection.sure)


def nothing_selected(request: ExtractRequest) -> str:
    """Why nothing was chosen."""
    if request.masks or request.points:
        return "what the masks or points show holds nothing of the field; look at it from those views"
    return "there is nothing in the given shape; shapes are in the units of the world (see fusedrf info)"
