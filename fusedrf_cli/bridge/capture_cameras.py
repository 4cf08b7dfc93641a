"""What a bundle keeps for pictures of it: the cameras of a capture, and the box that pictures show."""

import numpy as np

from formats.camera_set import CameraSet, capture_camera_set, read_camera_set
from formats.errors import FormatError, LimitExceeded
from formats.graph import belongs
from formats.views import Capture
from fusedrf_cli.bridge.scene import LoadedScene, PlacedCameraSet
from fusedrf_cli.bridge.sizes import camera_bytes
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.occupancy import enclosing, placed_box


def cameras_of_capture(capture: Capture, cut_out: bool, progress) -> dict | None:
    """The cameras of a capture as scene.json has them; None of a mesh, and, with a warning, where they are
    more than a bundle keeps. cut_out: masks cut an object out of its photos, which show no surroundings then.
    """
    if capture.kind == "mesh":
        return None
    try:
        cameras = capture_camera_set(capture, capture.frame is not None and not cut_out).content()
        read_camera_set(cameras)
        if camera_bytes(cameras) > (most := 2 << 20):  # half of what a scene.json may have
            raise LimitExceeded(f"they take more than {most:,} bytes")
    except FormatError as error:
        progress.warn(f"{capture.path}: the bundle does not keep its cameras: {error}")
        return None
    return cameras


def camera_set_of(scene: LoadedScene, progress=None) -> CameraSet | None:
    """The cameras that a scene keeps, in its world: its own, else those of the source that
    `chosen_camera_set` names where its placement is one that cameras can follow; otherwise a warning says
    that they are left."""
    if scene.graph.cameras is not None:
        return read_camera_set(scene.graph.cameras)
    source = chosen_camera_set(scene.camera_sets)
    if source is None:
        return None
    camera_set = read_camera_set(source.cameras).placed(source.object_to_world)
    if camera_set is None and progress is not None:
        progress.warn(
            f"'{source.name}' is stretched, sheared or mirrored, which no camera can follow: its cameras are "
            "left out"
        )
    return camera_set


def chosen_camera_set(camera_sets: tuple[PlacedCameraSet, ...]) -> PlacedCameraSet | None:
    """Of sources that keep cameras the background, else the only one that shows surroundings, else the only
    one."""
    background = [camera_set for camera_set in camera_sets if camera_set.background]
    around = [camera_set for camera_set in camera_sets if camera_set.cameras.get("surroundings")]
    return next((group[0] for group in (background, around, camera_sets) if len(group) == 1), None)


def result_cameras(scene: LoadedScene, progress=None) -> dict | None:
    """What a bundle made of a scene keeps of its cameras, as scene.json has them."""
    if scene.graph.cameras is not None:
        return scene.graph.cameras
    camera_set = camera_set_of(scene, progress)
    return camera_set and camera_set.content()


def result_view_box(scene: LoadedScene, composed: ComposedField, cameras: dict | None) -> np.ndarray | None:
    """(6,) the box in the world that pictures of a scene show, which a field made of it keeps, so that its
    pictures stay where they are when objects come and go; None where they are taken from a capture's
    cameras."""
    if cameras is not None and cameras.get("surroundings"):
        return None
    field, origin = scene.lone() or (composed, composed.origin)
    return view_box_in_frame(scene, field, origin)


def view_box_in_frame(scene: LoadedScene, field, origin: np.ndarray) -> np.ndarray:
    """(6,) the box in the world that a scene says its pictures show, else all density of its field, whose
    frame lies at `origin` (see `render_image`)."""
    if scene.graph.framing is not None:
        return np.asarray(scene.graph.framing)
    return framed(scene, placed_box(field.occupancy.look_at_box, origin))


def framed(scene: LoadedScene, around: np.ndarray) -> np.ndarray:
    """(6,) the box that pictures of a scene show, in a box `around` all of it: where most of that is empty,
    as around splats of which some lie far from all others, what its sources' own pictures show, and all
    other fields."""
    if not scene.framings or any(p.unbounded for p in scene.placed):
        return around
    boxes = [placed_box(np.asarray(f.box), f.object_to_world) for f in scene.framings]
    framed_by_themselves = {f.name for f in scene.framings}
    for p in scene.placed:
        if not belongs(p.name, framed_by_themselves):
            boxes.append(placed_box(p.occupancy.look_at_box, p.object_to_world))
    box = enclosing(boxes)
    box = np.concatenate([np.maximum(box[:3], around[:3]), np.minimum(box[3:], around[3:])])
    sides = box[3:] - box[:3]
    return box if sides.min() > 0 and 2 * sides.max() < (around[3:] - around[:3]).max() else around
