"""What of a capture's world a field covers: a box, or all of it around a core."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from formats.capture_frame import SceneFrame, scene_frame
from formats.views import Capture, View
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.visual_hull import visual_hull
from fusedrf_cli.engine.distillation.camera_visibility import shown_cells
from fusedrf_cli.engine.fields.occupancy import (
    OccupancyGrid,
    frame_around,
    placed_box,
    placement,
    seen_box,
)
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces.unbounded import WHOLE
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.requests import TrainRequest


@dataclass(frozen=True)
class SceneBoundsConfig:
    """How far what is learnt reaches."""

    fan_core: float = 0.65
    """Half the side of the core around cameras that all look one way, in distances of the nearest of their
    sparse points. Half as much, or half as much again, shows 0.3 to 0.5 dB less."""
    fan_cores: tuple[float, float] = (0.15, 0.4)
    """The least and the most of that, in distances of what they look at."""
    fan_core_unknown: float = 0.3
    """The same in distances of what they look at, where there are no sparse points."""
    near: float = 0.1
    """Of the distance between cameras and focus: nothing is learnt closer to a camera."""
    near_of_points: float = 0.6
    """Of the distance of a camera's nearest sparse points, where there are any: what its picture shows nearer
    is empty, for all other cameras too."""
    far_away: float = 64.0
    """Times its longest side from the world's origin a box has a frame of its own."""
    box_cells: int = 64
    """Along the longest axis of the hull that only gives the box of what alpha shows."""
    flattest: float = 1000.0
    """How many times as long as its shortest side a box's longest may be: readers refuse a field whose rays
    would take too many samples (engine/fields/base.py)."""


@dataclass(frozen=True, eq=False)
class SceneBounds:
    """Where a field lies in the world."""

    box: np.ndarray
    """(6,) float64, in the coordinates of the field's space."""
    origin: np.ndarray = field(default_factory=lambda: np.eye(4))
    """(4, 4) float64: where its frame lies in the world, turned and scaled alike along all axes."""
    unbounded: bool = False
    near: float = 0.0
    """In the frame's units, the distance from a camera before which nothing is learnt."""
    cells: OccupancyGrid | None = None
    """Over the box: where there can be anything to learn, an object that masks cut out or what photos of a
    place show; None: anywhere."""

    def view(self, view: View) -> View:
        """A view of the world in the field's frame."""
        return replace(view, camera_to_world=self.camera(camera_of(view)).camera_to_world)

    def camera(self, camera: Camera) -> Camera:
        """A camera of the world in the field's frame."""
        return camera if np.array_equal(self.origin, np.eye(4)) else camera.seen_from(self.origin)

    @property
    def centre(self) -> np.ndarray:
        """(3,) the world position of its frame's origin."""
        return self.origin[:3, 3]

    @property
    def unit(self) -> float:
        """How long its frame's unit is in the world."""
        return float(np.linalg.norm(self.origin[:3, 0]))

    def report(self) -> dict:
        """What was chosen, in world units."""
        if self.unbounded:
            return {"space": "unbounded", "centre": self.centre.tolist(), "radius": self.unit}
        return {"space": "bounded", "aabb": placed_box(self.box, self.origin).tolist()}


def check_flatness(bounds: SceneBounds) -> None:
    """UsageProblem, before work begins, for a box so flat that no reader would take the field."""
    config = current(SceneBoundsConfig)
    sides = bounds.box[3:] - bounds.box[:3]
    if not sides.max() <= config.flattest * sides.min():
        raise UsageProblem(
            f"the box {bounds.box.tolist()} is more than {config.flattest:,.0f} times as long as it is thin; "
            "give a thicker --aabb"
        )


def scene_bounds_of(request: TrainRequest, capture: Capture, cut_out: bool) -> SceneBounds:
    """The extent that was asked for, or that suits the capture: photos that show a subject and all around it
    need unbounded space; one that masks cut out (`cut_out`), or that stands before nothing, a box."""
    asks_unbounded = request.unbounded or request.centre is not None or request.radius is not None
    if request.aabb is not None and asks_unbounded:
        raise UsageProblem("--aabb is a box, and --unbounded, --centre and --radius are of space without one")
    if request.unbounded is False and asks_unbounded:
        raise UsageProblem("--centre and --radius are of unbounded space; leave --bounded out")
    boxed = request.aabb is not None or request.unbounded is False or cut_out or capture.frame is None
    if not boxed or asks_unbounded:
        return _unbounded(request, capture)
    box = capture.aabb if capture.object_aabb is None else capture.object_aabb
    box = np.asarray(box if request.aabb is None else request.aabb, np.float64)
    bounds = in_own_frame(box)
    views = [bounds.view(view) for view in capture.train]
    if capture.object_aabb is not None:
        # Rays through pixels of an object alone do not tell what is empty around it; its visual hull does.
        hull = visual_hull(views, bounds.box)
        return replace(bounds, box=hull.aabb, cells=hull)
    if request.aabb is not None or capture.opaque or capture.kind == "mesh":
        return bounds
    # Its cells are not kept to: transparent pixels tell what is empty in the box.
    return replace(bounds, box=visual_hull(views, bounds.box, current(SceneBoundsConfig).box_cells).aabb)


def in_own_frame(box: np.ndarray) -> SceneBounds:
    """The extent of a box (6,) of the world: in the world's frame, or, where it lies far away for its size or
    is of no ordinary size, in one of its own, so that numbers have the digits that they have anywhere."""
    config = current(SceneBoundsConfig)
    frame = placement(frame_around(box))
    near = np.abs(box).max() <= config.far_away * (box[3:] - box[:3]).max()
    if near and np.array_equal(frame[:3, :3], np.eye(3)):
        return SceneBounds(box)
    return SceneBounds(seen_box(box, frame), frame)


def _unbounded(request: TrainRequest, capture: Capture) -> SceneBounds:
    views = capture.train + capture.test
    poses = np.array([view.camera_to_world for view in views])
    frame = capture.frame or scene_frame(poses)
    reach = frame.distance
    if frame.layout == "outward":
        reach = max(reach, float(np.linalg.norm(poses[:, :3, 3] - frame.focus, axis=1).max()))
    near = near_of(views, reach)
    if frame.layout == "forward-facing" and request.centre is None and request.radius is None:
        origin = forward_facing_frame(frame, views)
    else:
        origin = core(frame, reach, request)
    unit = SceneBounds(WHOLE, origin).unit
    near /= unit
    full = SceneBounds(WHOLE, origin, True, near)
    clear = [max(near, current(SceneBoundsConfig).near_of_points * (view.near or 0) / unit) for view in views]
    shown = shown_cells([full.camera(camera_of(view)) for view in views], near, clear)
    box = shown.tight_aabb(0)  # texels that no photo shows would be lost
    return replace(full, box=box, cells=shown.within(box))


def core(frame: SceneFrame, reach: float, request: TrainRequest) -> np.ndarray:
    """(4, 4) the frame of a field whose core lies around what cameras look at, `reach` from them, or as was
    asked for; its axes are the world's."""
    # Half the core's side: in distances between cameras and focus, or, of cameras that look outwards, in
    # distances of the farthest camera from their middle.
    share = {"inward": 0.6, "forward-facing": 0.6, "outward": 1.2}[frame.layout]
    radius = share * reach if request.radius is None else request.radius
    matrix = np.diag([radius, radius, radius, 1.0])
    matrix[:3, 3] = frame.focus if request.centre is None else request.centre
    return matrix


def forward_facing_frame(frame: SceneFrame, views: Sequence[View]) -> np.ndarray:
    """(4, 4) the frame of a field before cameras that all look one way: its first axis is that way, and its
    core lies around the cameras. What they show lies before the core, where the other two coordinates are
    directions as seen from the middle of the cameras, so that texels are as fine as pixels near and far.
    (The normalised device coordinates of NeRF, Mildenhall et al. 2020, appendix C, are such too.)
    """
    config = current(SceneBoundsConfig)
    poses, nears = np.array([view.camera_to_world for view in views]), [v.near for v in views if v.near]
    nearest = config.fan_core * min(nears) if nears else config.fan_core_unknown * frame.distance
    unit = float(np.clip(nearest, *(share * frame.distance for share in config.fan_cores)))
    ahead = -poses[:, :3, 2].mean(0)
    ahead /= np.linalg.norm(ahead)
    left = np.cross(poses[:, :3, 1].mean(0), ahead)
    left /= np.linalg.norm(left)
    eyes = poses[:, :3, 3]
    rearmost = eyes.mean(0) + ahead * ((eyes - eyes.mean(0)) @ ahead).min()
    matrix = np.eye(4)
    matrix[:3, :3] = unit * np.stack([ahead, left, np.cross(ahead, left)], 1)
    matrix[:3, 3] = rearmost
    return matrix


def near_of(views: tuple[View, ...], distance: float) -> float:
    """World distance from every camera before which there is nothing, as far as sparse points tell."""
    config = current(SceneBoundsConfig)
    nears = [view.near for view in views if view.near]
    return min([config.near * distance, *(config.near_of_points * near for near in nears)])
