"""The views that a fused scene is judged by: all of it as it was photographed, and its objects one by one,
from the distances and in the resolutions at which their sources were photographed.

A view of everything shows objects small, before much that is empty, and what is lost of them does not show.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from formats.camera_set import CameraSet, read_camera_set
from formats.views import View
from fusedrf_cli.bridge.capture_cameras import camera_set_of, framed
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.scene import LoadedScene
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import Composite, as_composite
from fusedrf_cli.engine.distillation.evaluation import EvaluatorConfig
from fusedrf_cli.engine.fields.occupancy import placed_box
from fusedrf_cli.engine.rendering.cameras import Camera, framing_camera, scattered
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import unbounded


@dataclass(frozen=True)
class EvaluationViewConfig:
    """How many views judge a scene, and what they show."""

    whole: int = 3
    """Of the views, at least so many show the whole scene; the others show objects."""
    most_objects: int = 6
    """That get a view of their own, in addition to those that were asked for."""
    neighbours: int = 4
    """A view of a capture is taken somewhere between a camera and one of so many that are nearest to it."""
    unphotographed: int = 400
    """Pixels a side of the pictures of an object that no photo shows, in which it is framed."""
    own_views: int = 100
    """Of `unbounded_views`: cameras of the photos, at most."""
    more_views: int = 60
    """Cameras between those."""
    small: int = 96
    """Pixels a side of both."""
    views_seed: int = 5_000_011
    tries: int = 12
    """Views of an object in an unbounded scene that are drawn until one shows it."""
    rough: int = 12
    """Pixels a side of such a view."""
    shown: float = 0.2
    """Share of them that must show it as far away as it is alone."""
    veiled: float = 0.05
    """Up to that part of its box's diagonal."""
    lowest: float = 0.05
    """Radians above the horizon of such views."""
    highest: float = 1.3


@dataclass(frozen=True, eq=False)
class ViewTarget:
    """What views look at."""

    name: str
    box: np.ndarray
    """(6,) in the world, around its density, or around what an unbounded scene's cameras look at."""
    camera_set: CameraSet | None
    """The cameras that photographed it, in the world."""


@dataclass(frozen=True, eq=False)
class EvaluationView:
    """One view, and the object that it is of, if any."""

    camera: Camera
    """In the world."""
    of: str | None = None


def view_targets(scene: LoadedScene) -> list[ViewTarget]:
    """The objects of a scene, which do not fill all of space."""
    return [
        ViewTarget(
            p.name,
            p.aabb,
            camera_set_around(scene, p.name),
        )
        for p in scene.placed
        if not p.unbounded
    ]


def camera_set_around(scene: LoadedScene, name: str) -> CameraSet | None:
    """The cameras that photographed a placed object, in the scene's world."""
    for camera_set in scene.camera_sets:
        if name == camera_set.name or name.startswith(f"{camera_set.name}/"):
            return read_camera_set(camera_set.cameras).placed(camera_set.object_to_world)
    return camera_set_of(scene) if scene.graph.cameras is not None else None


def evaluation_views_of(
    scene: LoadedScene, composed: ComposedField, count: int, size: tuple[int, int], seed: int | tuple
) -> list[EvaluationView]:
    """At least `count` seeded views (see `evaluation_views`) of a scene, which `composed` is as one field."""
    box = framed(scene, placed_box(composed.occupancy.look_at_box, composed.origin))
    seen = share_seen(scene, composed) if composed.occupancy.space is unbounded else all_of_it
    return evaluation_views(camera_set_of(scene), box, view_targets(scene), count, size, seed, seen)


Seen = Callable[[Camera, ViewTarget], float]
"""The share of a view in which an object can be seen."""


def all_of_it(camera: Camera, target: ViewTarget) -> float:
    """That a view shows nothing but the object, so that any will do."""
    return 1.0


def share_seen(scene: LoadedScene, composed: ComposedField) -> Seen:
    """`share_shown` of the objects of a scene, which `composed` is as one field."""
    answered = as_composite if isinstance(composed, Composite) else lambda alone: alone
    alone = {p.name: answered(ComposedField([p])) for p in scene.placed if not p.unbounded}
    return partial(share_shown, composed, alone)


def share_shown(
    composed: ComposedField, alone: Mapping[str, ComposedField], camera: Camera, target: ViewTarget
) -> float:
    """The share of a view in which an object of a scene, `alone` by its name, can be seen: a place may stand
    before it, or around the camera, since the object was photographed elsewhere."""
    config = current(EvaluationViewConfig)
    wide, high = camera.width / config.rough, camera.height / config.rough
    rough = replace(
        camera, width=config.rough, height=config.rough,
        fl_x=camera.fl_x / wide, cx=camera.cx / wide, fl_y=camera.fl_y / high, cy=camera.cy / high,
    )  # fmt: skip
    of_all, of_it = (render_image(f, rough, origin=f.origin) for f in (composed, alone[target.name]))
    there = of_it.opacity > current(EvaluatorConfig).covered
    veil = config.veiled * np.linalg.norm(target.box[3:] - target.box[:3])
    apart = np.abs(of_all.depth[there] - of_it.depth[there])
    return np.count_nonzero(apart <= veil) / config.rough**2


def evaluation_views(
    camera_set: CameraSet | None,
    box: np.ndarray,
    objects: Sequence[ViewTarget],
    count: int,
    size: tuple[int, int],
    seed: int | tuple,
    seen: Seen = all_of_it,
) -> list[EvaluationView]:
    """`count` seeded views of a size (width, height), or more where there are objects: of the whole scene, as
    a rig that shows its surroundings saw it, else from around a box (6,) of the world; and of its objects in
    turn, in an order drawn anew for every seed, from where they are `seen` in enough of a view."""
    config = current(EvaluationViewConfig)
    rng = np.random.default_rng(seed)
    close = max(min(len(objects), config.most_objects), count - config.whole) if objects else 0
    n_scene = max(count - close, config.whole) if close else count
    if camera_set is not None and camera_set.surroundings:
        views = [
            EvaluationView(photographed(camera_set, None, size, rng, i % 2 == 1)) for i in range(n_scene)
        ]
    else:
        drawn = scattered(box, n_scene, *size, seed=int(rng.integers(1 << 62)), lowest=config.lowest)
        views = [EvaluationView(camera) for camera in drawn]
    order = rng.permutation(len(objects)) if close else []
    for number in range(close):
        target = objects[order[number % len(objects)]]
        views.append(EvaluationView(visible_close_up(target, size, rng, seen), target.name))
    named = enumerate(views)
    return [replace(view, camera=replace(view.camera, name=f"view_{i:04d}")) for i, view in named]


def unbounded_views(scene: LoadedScene, composed: ComposedField) -> tuple[Camera, ...]:
    """Small cameras in the frame of a scene: those of the photos of its place, and more from between them;
    none where the scene keeps no cameras of an unbounded scene."""
    config = current(EvaluationViewConfig)
    camera_set = camera_set_of(scene)
    if camera_set is None or not camera_set.surroundings or composed.occupancy.space is not unbounded:
        return ()
    rng = np.random.default_rng(config.views_seed)
    chosen = np.unique(
        np.linspace(0, len(camera_set.views) - 1, min(len(camera_set.views), config.own_views)).astype(int)
    )
    views = [camera_set.views[i] for i in chosen] + [
        between(camera_set.views, rng) for _ in range(config.more_views)
    ]
    size = config.small, config.small
    pictures = (replace(view, distortion=(), fisheye=False).reframed(*size) for view in views)
    return tuple(
        replace(camera_of(view), distortion=(0.0,) * 5).seen_from(composed.origin) for view in pictures
    )


def close_up(target: ViewTarget, size: tuple[int, int], rng: np.random.Generator) -> Camera:
    """A view of an object as its photos show it; of one without any, as large as it is framed in
    `unphotographed` pixels."""
    config = current(EvaluationViewConfig)
    at = spot(target.box, rng)
    if target.camera_set is not None:
        return photographed(target.camera_set, at, size, rng, True)
    azimuth, elevation = rng.uniform(0, 2 * np.pi), rng.uniform(config.lowest, config.highest)
    camera = framing_camera(target.box, azimuth, elevation, config.unphotographed, config.unphotographed)
    return window(camera, at, size, rng)


def visible_close_up(
    target: ViewTarget, size: tuple[int, int], rng: np.random.Generator, seen: Seen
) -> Camera:
    """The first close-up that shows enough of the object, or the one of all tries that shows most of it."""
    config = current(EvaluationViewConfig)
    most, best = -1.0, None
    for _ in range(config.tries):
        camera = close_up(target, size, rng)
        share = seen(camera, target)
        if share >= config.shown:
            return camera
        if share > most:
            most, best = share, camera
    return best


def spot(box: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(3,) a point of the middle half of a box (6,)."""
    return box[:3] + rng.uniform(0.25, 0.75, 3) * (box[3:] - box[:3])


def photographed(
    camera_set: CameraSet, at: np.ndarray | None, size: tuple[int, int], rng: np.random.Generator, full: bool
) -> Camera:
    """A view from between the cameras of a rig. In the photos' resolution (`full`) it shows a part of one,
    around a point (3,) or anywhere; else all of it."""
    view = between(camera_set.views, rng)
    pinhole = replace(view, distortion=(), fisheye=False)
    if not full or min(view.width / size[0], view.height / size[1]) <= 1:
        return replace(camera_of(pinhole.reframed(*size)), distortion=(0.0,) * 5)
    return window(replace(camera_of(pinhole), distortion=(0.0,) * 5), at, size, rng)


def window(camera: Camera, at: np.ndarray | None, size: tuple[int, int], rng: np.random.Generator) -> Camera:
    """The part of a camera's picture of a size, around where it shows a point (3,) as far as it does, or, of
    None, anywhere."""
    width, height = size
    left, top = rng.uniform(0, 1, 2) * (camera.width - width, camera.height - height)
    if at is not None:
        x, y, back = (at - camera.camera_to_world[:3, 3]) @ camera.camera_to_world[:3, :3]
        if back < 0:
            left = camera.cx - camera.fl_x * x / back - width / 2
            top = camera.cy + camera.fl_y * y / back - height / 2
    left = round(float(np.clip(left, 0, max(0, camera.width - width))))
    top = round(float(np.clip(top, 0, max(0, camera.height - height))))
    return replace(camera, cx=camera.cx - left, cy=camera.cy - top, width=width, height=height)


def between(views: Sequence[View], rng: np.random.Generator) -> View:
    """A view with the lens of one of the views, from somewhere on the way to one near to it."""
    config = current(EvaluationViewConfig)
    poses = np.array([view.camera_to_world for view in views])
    first = int(rng.integers(len(views)))
    apart = np.linalg.norm(poses[:, :3, 3] - poses[first, :3, 3], axis=1)
    alike = poses[:, :3, 2] @ poses[first, :3, 2] > 0.7
    near = [i for i in np.argsort(apart, kind="stable") if alike[i] and i != first][: config.neighbours]
    second = near[int(rng.integers(len(near)))] if near else first
    share = float(rng.uniform(0, 1))
    pose = np.eye(4)
    pose[:3, 3] = (1 - share) * poses[first, :3, 3] + share * poses[second, :3, 3]
    turns = Rotation.from_matrix(poses[[first, second], :3, :3])
    pose[:3, :3] = Slerp([0, 1], turns)(share).as_matrix()
    return replace(views[first], camera_to_world=pose)
