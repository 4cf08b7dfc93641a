"""The views that `render` takes: those of a file, those of the capture that a scene keeps, or ones that look
at what the scene shows."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from formats.camera_set import FARTHEST, CameraSet
from formats.cameras import read_cameras
from formats.views import NO_DISTORTION, View
from fusedrf_cli.bridge.capture_cameras import camera_set_of, chosen_camera_set, view_box_in_frame
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.scene import LoadedScene
from fusedrf_cli.engine.rendering.cameras import UP, Camera, Outlook, azimuth_of, framing, framing_lens
from fusedrf_cli.engine.settings import current
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.requests import RenderRequest


@dataclass(frozen=True)
class ViewConfig:
    """What is shown where nothing was asked for."""

    default_size: tuple[int, int] = (800, 800)
    leaning: float = 0.7
    """Cosine: photos held within 45 degrees of +z leave +z upright."""
    one_sided: float = np.radians(120)
    """Without any camera: photos taken from one side."""
    least_apart: float = 1e-13
    """Of a target's distance from the world's origin."""


def choose_views(request: RenderRequest, scene: LoadedScene, field, origin: np.ndarray) -> list[Camera]:
    """The views a user asked for; with no choice, one photo's of a capture that shows its surroundings, else
    one that frames everything. The field is the scene's, its frame lies at `origin` (see `render_image`)."""
    if request.cameras or request.path:
        return [camera_of(view) for view in read_cameras(request.cameras or request.path, request.size)]
    camera_set, up = camera_set_of(scene), upward(request, scene)
    if request.views:
        return [camera_of(sized(view, request.size)) for view in captured(request, scene, camera_set)]
    if camera_set is not None and camera_set.surroundings:
        photo = camera_of(sized(camera_set.typical, request.size))
        if request.orbit is None and not aimed(request):
            return [photo]
        lens, outlook = pinhole(photo), standing(camera_set, up)
    else:
        lens = framing_lens(*(request.size or current(ViewConfig).default_size))
        outlook = replace(framing(view_box_in_frame(scene, field, origin), lens), up=up)
    outlook = turned(outlook, request)
    if request.orbit is None:
        return [outlook.camera(lens)]
    photographed = camera_set is not None and camera_set.surroundings and request.view_from is None
    return outlook.orbit(lens, request.orbit, arc_of(camera_set, up) if photographed else None)


def aimed(request: RenderRequest) -> bool:
    """Whether the view is to be other than the default one."""
    options = (request.look_at, request.view_from, request.up)
    return any(word is not None for word in options) or request.zoom != 1


def unit_vector(direction: Sequence[float]) -> np.ndarray:
    """(3,) of length 1, along a direction of any other. UsageProblem for one of length 0."""
    if not any(direction):
        raise UsageProblem(
            "0,0,0 is no direction, as which --up is given; give that of an axis, such as 0,0,1"
        )
    scaled = np.array(direction) / np.abs(direction).max()  # whose square neither overflows nor vanishes
    return scaled / np.linalg.norm(scaled)


def upward(request: RenderRequest, scene: LoadedScene) -> np.ndarray:
    """(3,) unit vector: which way of the world is up. As was asked for, or as photos of an unbounded scene
    were held; for anything else +z, but where the photos of one object were held quite otherwise."""
    if request.up is not None:
        return unit_vector(request.up)
    if scene.graph.up is not None:
        return unit_vector(scene.graph.up)
    camera_set = camera_set_of(scene)
    if camera_set is None or camera_set.surroundings:
        return UP if camera_set is None else camera_set.up
    has_own_cameras = scene.graph.cameras is not None and scene.graph.framing is None
    return camera_set.up if has_own_cameras and camera_set.up @ UP < current(ViewConfig).leaning else UP


def turned(outlook: Outlook, request: RenderRequest) -> Outlook:
    """The outlook as --look-at, --view-from and --zoom change it; UsageProblem where no camera could
    stand apart from its target in float64."""
    config = current(ViewConfig)
    if request.look_at is not None:
        outlook = replace(outlook, target=np.array(request.look_at))
    if request.view_from is not None:
        azimuth, elevation = np.radians(request.view_from)
        outlook = replace(outlook, azimuth=azimuth, elevation=elevation)
    outlook = replace(outlook, distance=outlook.distance / request.zoom)
    far = float(np.abs(outlook.target).max())
    if not max(1 / FARTHEST, far * config.least_apart) < outlook.distance < FARTHEST or far >= FARTHEST:
        raise UsageProblem(
            f"--look-at and --zoom put a camera {outlook.distance:.3g} from a point that is {far:.3g} from "
            "the world's origin, which its numbers cannot hold; give a nearer point, or another --zoom"
        )
    return outlook


# -- a capture's cameras -------------------------------------------------------------------------------------


def sized(view: View, size: tuple[int, int] | None) -> View:
    """A view at a size (width, height), or at its own."""
    return view.reframed(*size) if size else view


def standing(camera_set: CameraSet, up: np.ndarray) -> Outlook:
    """The outlook on the focus of a rig from the median distance of its cameras and their height along `up`,
    a unit vector (3,), and from the side of the typical one."""
    eye = camera_set.typical.camera_to_world[:3, 3]
    elevation = float(np.arcsin(np.clip(camera_set.height(up) / camera_set.distance, -1, 1)))
    return Outlook(
        camera_set.focus, camera_set.distance, azimuth_of(eye - camera_set.focus, up), elevation, up
    )


def arc_of(camera_set: CameraSet, up: np.ndarray) -> tuple[float, float] | None:
    """The azimuths about `up` between which the cameras of a rig stand around its focus, the second the
    larger; None where they stand all around. What no camera saw of an unbounded scene is floaters."""
    around = np.sort([azimuth_of(eye - camera_set.focus, up) for eye in camera_set.poses[:, :3, 3]])
    gaps = np.diff(np.append(around, around[0] + 2 * np.pi))
    widest = int(gaps.argmax())
    if gaps[widest] < current(ViewConfig).one_sided:
        return None
    end = float(around[widest])
    return end + float(gaps[widest]) - 2 * np.pi, end


def pinhole(camera: Camera) -> Camera:
    """A lens with the focal lengths of another, without distortion and centred on the picture."""
    centre = {"cx": camera.width / 2, "cy": camera.height / 2}
    return replace(camera, **centre, distortion=NO_DISTORTION, fisheye=False, name="view")


def captured(request: RenderRequest, scene: LoadedScene, camera_set: CameraSet | None) -> tuple[View, ...]:
    """The views of --views, each with a name of its own; InvalidInput where the scene keeps none."""
    if camera_set is None:
        raise InvalidInput(f"{request.scene}: {why_no_cameras(scene)}")
    if request.views == "heldout" and not camera_set.test:
        raise InvalidInput(
            f"{request.scene}: none of its {len(camera_set.views)} cameras was held out; give --views "
            "capture, or train with --holdout N"
        )
    if request.views == "heldout":
        return camera_set.test
    names = {view.name for view in camera_set.train}
    return camera_set.train + tuple(
        replace(view, name=free_name(view.name, names)) for view in camera_set.test
    )


def free_name(name: str, names: set[str]) -> str:
    """A name that no other picture has, which is taken from now on: the photos that are held out may be named
    as those that are not."""
    while name in names:
        name = f"{name}_heldout"
    names.add(name)
    return name


def why_no_cameras(scene: LoadedScene) -> str:
    """Why --views has none to take, and what helps."""
    if (source := chosen_camera_set(scene.camera_sets)) is not None:
        return (
            f"the cameras of '{source.name}' cannot follow a placement that stretches, shears or mirrors it; "
            "give --cameras"
        )
    if scene.camera_sets:
        names = ", ".join(f"'{camera_set.name}'" for camera_set in scene.camera_sets)
        return f"{names} each keep cameras; mark one of them by --background-node, or give --cameras"
    return "keeps no cameras of a capture; train it again from its photos, or give --cameras"
