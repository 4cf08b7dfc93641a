"""What an object leaves behind when it is taken out: filled from photos, or smoothly, or left empty."""

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.ndimage import binary_dilation

from formats.camera_set import read_camera_set
from formats.capture_frame import scene_frame
from formats.photos import load_photos
from formats.scene import SceneGraph
from formats.views import Capture, View
from fusedrf_cli.bridge.budget import Budget
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.posing import posed_capture
from fusedrf_cli.bridge.scene_bounds import SceneBounds, SceneBoundsConfig, near_of
from fusedrf_cli.bridge.training import fit_memory, fit_settings, trained_kind, warn_of_nonfinite
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField, occupied_at
from fusedrf_cli.engine.composition.composite import as_composite
from fusedrf_cli.engine.distillation.camera_visibility import shown_cells
from fusedrf_cli.engine.distillation.distill import DistillRun
from fusedrf_cli.engine.distillation.fit import FitRun
from fusedrf_cli.engine.distillation.ray_dataset import Pictures
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.fields.base import RadianceField, StoredField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, mapped, placement
from fusedrf_cli.engine.kinds import field_cutting, registry
from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.selection.cells import CellConfig, CellGrid, Selection
from fusedrf_cli.engine.selection.holes import patches
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded
from fusedrf_cli.requests import HoleRequest, Learning, TrainRequest


@dataclass(frozen=True)
class InpaintingConfig:
    """How a hole is learnt and filled."""

    seconds: float | None = 120.0
    """Of learning from --refit's photos, where no time budget is given; None: by steps, as `train` does."""
    share: float = 0.8
    """Of a time budget that goes to it."""
    faint: float = 0.03
    """Opacity of the object from which a pixel of a photo is left out."""
    grown: int = 4
    """Pixels around those that are left out too: what the object's rim colours."""
    settings: DistilConfig = DistilConfig(rays=120_000, steps=500, rgb_steps=500, view_size=160)
    numbers: int = 2_000_000
    """Of the tensor that a smooth surface is learnt into, at most."""


LEARNT, FILLED = "restored/refit", "restored/filled"
"""Names of nodes of what is put into the hole."""


@dataclass(frozen=True)
class Frame:
    """The field in which there is a hole, and where it lies."""

    path: str
    scene: SceneGraph
    """Of the bundle that it is in."""
    field: RadianceField
    origin: np.ndarray
    """Of its frame in the world: a position (3,), or a placement (4, 4)."""


class Teacher:
    """Teaches fields what others show, within one command's budget."""

    def __init__(self, request: Learning, rgb: bool, device: str, progress, tries: int = 1):
        """rgb: whether it finishes on pictures; tries: how many times it may be asked, about."""
        self.seed, self.rgb, self.device, self.progress = request.seed, rgb, device, progress
        self.budget, self.tries = Budget(request.time_budget), tries

    def __call__(self, teacher: RadianceField, student: StoredField) -> StoredField:
        """The student, taught, with its numbers on the CPU."""
        seconds = self.budget.part(max(1, self.tries))
        self.tries -= 1
        settings = replace(current(InpaintingConfig).settings, seed=self.seed, time_budget=seconds)
        rays = RaySampler([teacher.occupancy.look_at_box])
        run = DistillRun(teacher, student.to(self.device), rays, settings, self.rgb)
        learnt, _ = run.finish(advance=lambda share, figures: self.progress.advance(share, **figures))
        self.budget.spent += run.learnt_seconds
        return learnt.to("cpu")


def smooth_patches(
    rest: RadianceField, box: np.ndarray, up: np.ndarray, gone: StoredField | None = None
) -> tuple[list[Placed], float]:
    """Smooth surfaces for the hole that an object of a box (6,) leaves, placed in the frame of `rest`, and
    the share of what was behind it that is seen nowhere (`patches`)."""
    surfaces, share = patches(rest, box, up, gone)
    return [Placed(FILLED, patch, np.eye(4)) for patch in surfaces], share


def up_of(scene: SceneGraph, origin: np.ndarray) -> np.ndarray:
    """(3,) the direction, in a frame at an origin, that a scene's cameras hold upwards, or the world's z."""
    up = np.array([0.0, 0.0, 1.0]) if scene.cameras is None else read_camera_set(scene.cameras).up
    local_up = up @ placement(origin)[:3, :3]
    return local_up / np.linalg.norm(local_up)


def learnt_surfaces(surfaces: list[Placed], teach: Teacher) -> list[Placed]:
    """Smooth surfaces as fields that a bundle can hold, each placed where it was."""
    kind, placed = registry.kind(registry.DEFAULT), []
    for one in surfaces:
        teacher = ComposedField([one])
        generator = torch.Generator().manual_seed(teach.seed)
        student = kind.empty(
            teacher, StorageSetting(), current(InpaintingConfig).numbers, generator, one.name
        )
        placed.append(Placed(one.name, teach(teacher, student), placement(teacher.origin)))
    return placed


def fill_hole(
    request: HoleRequest,
    frame: Frame,
    rest: RadianceField,
    object_field: RadianceField,
    memory: Memory,
    device: str,
    progress,
) -> tuple[list[Placed], dict]:
    """What fills the hole that an object leaves in a field, as was asked for, placed in the field's frame,
    and what the report says of the hole."""
    info, fillings = {}, []
    if request.refit:
        learnt, info = learnt_from(request, frame, object_field, memory, device, progress)
        behind = in_hole(learnt, rest, object_field)
        if behind is None:
            progress.warn(f"{request.refit}: its photos show nothing in the place of the object")
        else:
            fillings.append(Placed(LEARNT, behind, np.eye(4)))
    composed = rest
    if fillings:
        composed = as_composite(ComposedField([Placed("", rest, np.eye(4)), *fillings], origin=np.eye(4)))
    box = object_field.occupancy.look_at_box
    surfaces, unseen = smooth_patches(composed, box, up_of(frame.scene, frame.origin), object_field)
    if request.fill and surfaces:
        progress.phase("filling", None)
        fillings += learnt_surfaces(surfaces, Teacher(request, False, device, progress, len(surfaces)))
    return fillings, info | {"unseen": round(unseen, 3), "filled": bool(request.fill and surfaces)}


def in_hole(learnt: StoredField, rest: RadianceField, object_field: RadianceField) -> StoredField | None:
    """What a field learnt anew has around an object where what is left has nothing."""
    lattice = CellGrid.over(learnt, box_in(learnt, object_field.occupancy), current(CellConfig).fine)
    kind, free = registry.kind(learnt.kind), ~occupied_at(rest, lattice.points)
    behind = kind.cut_out(learnt, Selection(lattice, free)) if free.any() else None
    return behind and kind.trimmed(behind)


def box_in(field: RadianceField, cells: OccupancyGrid) -> np.ndarray:
    """(6,) in the coordinates of a field's space the part of its box around occupied cells of its frame."""
    box, space = cells.tight_aabb(1), field.occupancy.space
    if cells.space is not space:
        points = mapped(field_cutting.to_frame(cells.centres(), cells.space), space)
        box = np.concatenate([points.min(0) - cells.cell, points.max(0) + cells.cell])
    aabb = field.occupancy.aabb
    return np.concatenate([np.maximum(box[:3], aabb[:3]), np.minimum(box[3:], aabb[3:])])


# -- learning from photos ------------------------------------------------------------------------------------


def learnt_from(
    request: HoleRequest,
    frame: Frame,
    object_field: RadianceField | None,
    memory: Memory,
    device: str,
    progress,
) -> tuple[StoredField, dict]:
    """A field in the frame of the bundle's, learnt from photos with the pixels of an object left out (None:
    the photos show none), and what the report says of it."""
    progress.phase("reading photos", None)
    capture = posed_as(posed_capture(request.refit, None, request.threads, progress), frame, progress)
    bounds = bounds_like(frame, capture)
    train_request = default_training(request)
    kind = trained_kind(train_request, bounds.unbounded, device)
    settings = fit_settings(train_request, kind, capture, bounds, device)
    plan = kind.untrained(bounds.box, settings.longest, settings.storage)
    memory.expect(fit_memory(capture, plan, settings), advice="give fewer or smaller photos")
    cameras = [camera_of(view).seen_from(bounds.origin) for view in capture.train]
    pictures = photos_without(object_field, capture, cameras, progress)
    run = FitRun.start(cameras, pictures, bounds.box, settings, LEARNT, bounds.cells)
    progress.phase("training", 1.0)
    field = run.finish(lambda share, figures: progress.advance(share, **figures))
    warn_of_nonfinite(run.nan_guard.figures(), progress)
    return field.to("cpu"), {"photos": len(capture.train), "training_psnr": run.psnr}


def posed_as(capture: Capture, frame: Frame, progress) -> Capture:
    """A capture whose photos stand where the bundle's cameras of their names do, or, of a bundle that keeps
    none of them, where the capture says; all of them to learn from."""
    views = capture.train + capture.test
    named_views = (
        {} if frame.scene.cameras is None else {v.name: v for v in read_camera_set(frame.scene.cameras).views}
    )
    posed = tuple(
        replace(v, camera_to_world=named_views[v.name].camera_to_world)
        for v in views
        if v.name in named_views
    )
    if not posed and named_views:
        progress.warn(
            f"{capture.path}: none of its photos is named as a camera of {frame.path}; they are taken to "
            "stand in its world where they say"
        )
    return replace(capture, train=posed or views, test=())


def bounds_like(frame: Frame, capture: Capture) -> SceneBounds:
    """The extent of the bundle's own field, for cameras of its world."""
    config = current(SceneBoundsConfig)
    origin, field = placement(frame.origin), frame.field
    box = field.occupancy.aabb
    if field.occupancy.space is bounded:
        return SceneBounds(box, origin)
    poses = np.array([view.camera_to_world for view in capture.train])
    bounds = SceneBounds(box, origin, True)
    near = near_of(capture.train, scene_frame(poses).distance) / bounds.unit
    clear = [max(near, config.near_of_points * (view.near or 0) / bounds.unit) for view in capture.train]
    shown = shown_cells([bounds.camera(camera_of(view)) for view in capture.train], near, clear)
    return replace(bounds, near=near, cells=shown.within(box))


def default_training(request: HoleRequest) -> TrainRequest:
    """A training as `train` without options would do it."""
    config = current(InpaintingConfig)
    seconds = config.share * request.time_budget if request.time_budget else config.seconds
    return TrainRequest(
        request.refit, request.output, overwrite=request.overwrite, precision="float16",
        memory=request.memory, time_budget=seconds, seed=request.seed, device=request.device,
        threads=request.threads,
    )  # fmt: skip


def photos_without(
    object_field: RadianceField | None, capture: Capture, cameras: list[Camera], progress
) -> Pictures:
    """The photos of a capture without the pixels that show an object, given in the frame of the cameras."""
    loaded = load_photos(capture.train)
    if object_field is None:
        return Pictures(loaded.pixels, loaded.ignored)
    progress.phase("masking photos", len(cameras))
    ignored = np.zeros(len(loaded.pixels), bool) if loaded.ignored is None else loaded.ignored
    for number, (camera, view) in enumerate(zip(cameras, capture.train, strict=True)):
        part = ignored[loaded.first[number] : loaded.first[number + 1]]
        part |= shown_in(object_field, camera, view).ravel()
        progress.advance(number + 1)
    return Pictures(loaded.pixels, ignored)


def shown_in(object_field: RadianceField, camera: Camera, view: View) -> np.ndarray:
    """(H, W) bool: the pixels of a view that an object shows in, and a few around them."""
    config = current(InpaintingConfig)
    shown = render_image(object_field, camera).opacity > config.faint
    return binary_dilation(shown, iterations=config.grown) if shown.any() else shown
