"""What of a capture's world a field covers: a box, or all of it around a core."""

from dataclasses import dataclass, replace

import numpy as np

from formats.frame import scene_frame
from formats.views import Capture, View
from fusedrf_cli.bridge.hull import visual_hull
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.engine.distillation.visibility import shown_cells
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.spaces.unbounded import WHOLE
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.requests import TrainRequest

CORE = {"inward": 0.6, "forward-facing": 0.6, "outward": 1.2}
"""Half the side of the core: in distances between cameras and focus, or, of cameras that look outwards, in
distances of the farthest camera from their middle."""
NEAR = 0.1
"""Of the distance between cameras and focus: nothing is learnt closer to a camera."""
NEAR_OF_POINTS = 0.6
"""Of the distance of a camera's nearest sparse points, where there are any: what its picture shows nearer is
empty, for all other cameras too."""


@dataclass(frozen=True, eq=False)
class Extent:
    """Where a field lies in the world."""

    box: np.ndarray
    """(6,) float64, in the coordinates of the field's space."""
    centre: np.ndarray
    """(3,) float64: the world position of its frame's origin."""
    unit: float = 1.0
    """How long its frame's unit is in the world."""
    unbounded: bool = False
    near: float = 0.0
    """In the frame's units, the distance from a camera before which nothing is learnt."""
    cells: OccupancyGrid | None = None
    """Over the box: where there can be anything to learn, an object that masks cut out or what photos of a
    place show; None: anywhere."""

    def camera(self, camera: Camera) -> Camera:
        """A camera of the world in the field's frame."""
        return camera.seen_from(self.centre, self.unit) if self.unbounded else camera

    @property
    def origin(self) -> np.ndarray:
        """(4, 4) where the field's frame lies in the world."""
        matrix = np.diag([self.unit, self.unit, self.unit, 1.0])
        matrix[:3, 3] = self.centre
        return matrix

    def report(self) -> dict:
        """What was chosen, in world units."""
        if self.unbounded:
            return {"space": "unbounded", "centre": self.centre.tolist(), "radius": self.unit}
        return {"space": "bounded", "aabb": self.box.tolist()}


def extent_of(request: TrainRequest, capture: Capture, cut_out: bool) -> Extent:
    """The extent that was asked for, or that suits the capture: photos that show a subject and all around it
    need unbounded space; one that masks cut out (`cut_out`), or that stands before nothing, a box."""
    asked = request.unbounded or request.centre is not None or request.radius is not None
    if request.aabb is not None and asked:
        raise UsageProblem("--aabb is a box, and --unbounded, --centre and --radius are of space without one")
    if request.unbounded is False and asked:
        raise UsageProblem("--centre and --radius are of unbounded space; leave --bounded out")
    boxed = request.aabb is not None or request.unbounded is False or cut_out or capture.frame is None
    if not boxed or asked:
        return _unbounded(request, capture)
    if capture.object_aabb is not None:
        return _around_object(request, capture)
    box = capture.aabb if request.aabb is None else request.aabb
    return Extent(np.asarray(box, np.float64), np.zeros(3))


def _around_object(request: TrainRequest, capture: Capture) -> Extent:
    """The visual hull of what the masks of the training photos keep, in the box of the object or the one that
    is asked for. Rays through pixels of the object alone do not tell what is empty around it."""
    box = capture.object_aabb if request.aabb is None else np.asarray(request.aabb, np.float64)
    hull = visual_hull(capture.train, box)
    return Extent(hull.aabb, np.zeros(3), cells=hull)


def _unbounded(request: TrainRequest, capture: Capture) -> Extent:
    views = capture.train + capture.test
    poses = np.array([view.camera_to_world for view in views])
    frame = capture.frame or scene_frame(poses)
    centre = frame.focus if request.centre is None else np.asarray(request.centre, np.float64)
    unit = frame.distance
    if frame.layout == "outward":
        unit = max(unit, float(np.linalg.norm(poses[:, :3, 3] - frame.focus, axis=1).max()))
    radius = CORE[frame.layout] * unit if request.radius is None else request.radius
    near = near_of(views, unit) / radius
    whole = Extent(WHOLE, centre, radius, True, near)
    clear = [max(near, NEAR_OF_POINTS * (view.near or 0) / radius) for view in views]
    shown = shown_cells([whole.camera(camera_of(view)) for view in views], near, clear)
    box = shown.tight_aabb(0)  # texels that no photo shows would be lost
    return replace(whole, box=box, cells=shown.within(box))


def near_of(views: tuple[View, ...], distance: float) -> float:
    """World distance from every camera before which there is nothing, as far as sparse points tell."""
    known = [view.near for view in views if view.near]
    return min(NEAR * distance, *(NEAR_OF_POINTS * near for near in known)) if known else NEAR * distance
