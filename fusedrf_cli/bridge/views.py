"""The views that `render` takes: those of a file, those of the capture that a scene keeps, or ones that look
at what the scene shows."""

from dataclasses import dataclass, replace

import numpy as np

from formats.captures import read_cameras
from formats.rig import FARTHEST, Rig
from formats.views import NO_DISTORTION, View
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.rigs import chosen_rig, framed_box, rig_of
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
    rig, up = rig_of(scene), upward(request, scene)
    if request.views:
        return [camera_of(sized(view, request.size)) for view in captured(request, scene, rig)]
    if rig is not None and rig.surroundings:
        photo = camera_of(sized(rig.typical, request.size))
        if request.orbit is None and not aimed(request):
            return [photo]
        lens, outlook = pinhole(photo), standing(rig, up)
    else:
        lens = framing_lens(*(request.size or current(ViewConfig).default_size))
        outlook = replace(framing(framed_box(scene, field, origin), lens), up=up)
    outlook = turned(outlook, request)
    if request.orbit is None:
        return [outlook.camera(lens)]
    photographed = rig is not None and rig.surroundings and request.direction is None
    return outlook.orbit(lens, request.orbit, arc_of(rig, up) if photographed else None)


def aimed(request: RenderRequest) -> bool:
    """Whether the view is to be other than the default one."""
    asked = (request.look_at, request.direction, request.up)
    return any(word is not None for word in asked) or request.zoom != 1


def upward(request: RenderRequest, scene: LoadedScene) -> np.ndarray:
    """(3,) unit vector: which way of the world is up. As was asked for, or as photos of a place were held;
    for anything else +z, but where the photos of one object were held quite otherwise."""
    if request.up is not None:
        up = np.array(request.up) / np.abs(request.up).max()
        return up / np.linalg.norm(up)
    rig = rig_of(scene)
    if rig is None or rig.surroundings:
        return UP if rig is None else rig.up
    own = scene.graph.cameras is not None and scene.graph.framing is None
    return rig.up if own and rig.up @ UP < current(ViewConfig).leaning else UP


def turned(outlook: Outlook, request: RenderRequest) -> Outlook:
    """The outlook as --look-at, --from and --zoom change it; UsageProblem where no camera could stand apart
    from its target in float64."""
    config = current(ViewConfig)
    if request.look_at is not None:
        outlook = replace(outlook, target=np.array(request.look_at))
    if request.direction is not None:
        azimuth, elevation = np.radians(request.direction)
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


def standing(rig: Rig, up: np.ndarray) -> Outlook:
    """The outlook on the focus of a rig from the median distance of its cameras and their height along `up`,
    a unit vector (3,), and from the side of the typical one."""
    eye = rig.typical.camera_to_world[:3, 3]
    elevation = float(np.arcsin(np.clip(rig.height(up) / rig.distance, -1, 1)))
    return Outlook(rig.focus, rig.distance, azimuth_of(eye - rig.focus, up), elevation, up)


def arc_of(rig: Rig, up: np.ndarray) -> tuple[float, float] | None:
    """The azimuths about `up` between which the cameras of a rig stand around its focus, the second the
    larger; None where they stand all around. What no camera saw of a place is fog."""
    around = np.sort([azimuth_of(eye - rig.focus, up) for eye in rig.poses[:, :3, 3]])
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


def captured(request: RenderRequest, scene: LoadedScene, rig: Rig | None) -> tuple[View, ...]:
    """The views of --views, each with a name of its own; InvalidInput where the scene keeps none."""
    if rig is None:
        raise InvalidInput(f"{request.scene}: {why_no_cameras(scene)}")
    if request.views == "heldout" and not rig.test:
        raise InvalidInput(
            f"{request.scene}: none of its {len(rig.views)} cameras was held out; give --views capture, or "
            "train with --holdout N"
        )
    if request.views == "heldout":
        return rig.test
    taken = {view.name for view in rig.train}
    return rig.train + tuple(replace(view, name=free_name(view.name, taken)) for view in rig.test)


def free_name(name: str, taken: set[str]) -> str:
    """A name that no other picture has, which is taken from now on: the photos that are held out may be named
    as those that are not."""
    while name in taken:
        name = f"{name}_heldout"
    taken.add(name)
    return name


def why_no_cameras(scene: LoadedScene) -> str:
    """Why --views has none to take, and what helps."""
    if (source := chosen_rig(scene.rigs)) is not None:
        return (
            f"the cameras of '{source.name}' cannot follow a placement that stretches, shears or mirrors it; "
            "give --cameras"
        )
    if scene.rigs:
        names = ", ".join(f"'{rig.name}'" for rig in scene.rigs)
        return f"{names} each keep cameras; mark one of them by --background-node, or give --cameras"
    return "keeps no cameras of a capture; train it again from its photos, or give --cameras"
