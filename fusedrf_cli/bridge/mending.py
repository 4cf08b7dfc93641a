"""What an object leaves behind when it is taken out: filled from photos, or smoothly, or left empty."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import binary_dilation

from formats.frame import scene_frame
from formats.photos import load_photos
from formats.rig import read_rig
from formats.views import Capture, View
from fusedrf_cli.bridge.editing import Fused, Teacher
from fusedrf_cli.bridge.extent import NEAR_OF_POINTS, Extent, near_of
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.posing import posed_capture
from fusedrf_cli.bridge.training import fit_memory, fit_settings, warn_of_numbers
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.distillation.fit import FitRun
from fusedrf_cli.engine.distillation.pixels import Pictures
from fusedrf_cli.engine.distillation.visibility import shown_cells
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import placement
from fusedrf_cli.engine.kinds import registry, splitting
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.kinds.vm.trimming import without_unasked
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.selection.holes import patches
from fusedrf_cli.engine.spaces import bounded
from fusedrf_cli.errors import InvalidInput
from fusedrf_cli.requests import MendingRequest, TrainRequest

SECONDS = 120.0
"""Of learning from --refit's photos, where no time budget is given."""
SHARE = 0.8
"""Of a time budget that goes to it."""
FAINT = 0.03
"""Opacity of the object from which a pixel of a photo is left out."""
GROWN = 4
"""Pixels around those that are left out too: what the object's rim colours."""
LEARNT, FILLED = "refit", "filled"
"""Names of what is put into the hole."""


def hole_of(
    rest: StoredField, box: np.ndarray, up: np.ndarray, gone: StoredField | None = None
) -> tuple[list[Placed], float]:
    """Smooth surfaces for the hole that an object of a box (6,) leaves, placed in the frame of `rest`, and
    the share of what was behind it that is seen nowhere (`patches`)."""
    found, share = patches(rest, box, up, gone)
    return [Placed(FILLED, patch, np.eye(4)) for patch in found], share


def up_of(fused: Fused) -> np.ndarray:
    """(3,) the direction in the field's frame that its cameras hold upwards, or the world's z."""
    cameras = fused.scene.cameras
    up = np.array([0.0, 0.0, 1.0]) if cameras is None else read_rig(cameras).up
    own = up @ placement(fused.origin)[:3, :3]
    return own / np.linalg.norm(own)


def put_in(fused: Fused, field: StoredField, placed: list[Placed], teach: Teacher) -> StoredField:
    """A field of the bundle's kind with fields placed in its frame."""
    for one in placed:
        try:
            field = fused.kind.added(field, [one], teach).field
        except ValueError as error:
            raise InvalidInput(f"{fused.path}: {error}") from error
    return field


def mended(
    request: MendingRequest,
    fused: Fused,
    rest: StoredField,
    found: StoredField,
    memory: Memory,
    place: str,
    progress,
) -> tuple[StoredField, dict]:
    """What is left of a field without an object, with the hole filled as was asked for, and what the report
    says of the hole."""
    teach = Teacher(request, False, place, progress, 3)
    box, told = found.occupancy.subject, {}
    if request.refit:
        learnt, told = learnt_from(request, fused, found, memory, place, progress)
        behind = in_hole(learnt, rest, found)
        if behind is None:
            progress.warn(f"{request.refit}: its photos show nothing in the place of the object")
        else:
            rest = put_in(fused, rest, [Placed(LEARNT, behind, np.eye(4))], teach)
    surfaces, unseen = hole_of(rest, box, up_of(fused), found)
    if request.fill and surfaces:
        progress.phase("filling", None)
        rest = put_in(fused, rest, surfaces, teach)
    return rest, told | {"unseen": round(unseen, 3), "filled": bool(request.fill and surfaces)}


def in_hole(learnt: VMField, rest: StoredField, found: StoredField) -> StoredField | None:
    """What a field learnt anew has in the box of an object where what is left has nothing."""
    box, same = found.occupancy.aabb, found.space is learnt.space

    def inside(points: np.ndarray, size: np.ndarray) -> np.ndarray:
        held = ((points >= box[:3]) & (points <= box[3:])).all(1) if same else in_frame(points)
        held[held] = ~rest.occupancy.contains(points[held])
        return held

    def in_frame(points: np.ndarray) -> np.ndarray:
        at = splitting.placed(points, learnt.space)
        return ((at >= box[:3]) & (at <= box[3:])).all(1)

    looked_in = learnt.occupancy.aabb
    if same:
        looked_in = splitting.common_box(looked_in, box)
    behind = splitting.within(learnt, learnt.tensors[0].aabb, learnt.voxel_size, inside, looked_in)
    return behind and without_unasked(behind)


# -- learning from photos ------------------------------------------------------------------------------------


def learnt_from(
    request: MendingRequest,
    fused: Fused,
    found: StoredField | None,
    memory: Memory,
    place: str,
    progress,
) -> tuple[VMField, dict]:
    """A field in the frame of the bundle's, learnt from photos with the pixels of an object left out (None:
    the photos show none), and what the report says of it."""
    progress.phase("reading photos", None)
    capture = posed_as(posed_capture(request.refit, None, request.threads, progress), fused, progress)
    extent = extent_like(fused, capture)
    kind = registry.kind(registry.DEFAULT)
    wanted = wanted_of(request)
    settings = fit_settings(wanted, kind, capture, extent, place)
    plan = kind.untrained(extent.box, settings.longest, settings.way)
    memory.expect(fit_memory(capture, plan, settings), advice="give fewer or smaller photos")
    cameras = [camera_of(view).seen_from(extent.origin) for view in capture.train]
    pictures = without(found, capture, cameras, progress)
    run = FitRun.start(cameras, pictures, extent.box, settings, LEARNT, extent.cells)
    progress.phase("training", 1.0)
    field = run.finish(lambda share, figures: progress.advance(share, **figures))
    warn_of_numbers(run.guard.figures(), progress)
    return field.to("cpu"), {"photos": len(capture.train), "training_psnr": run.psnr}


def posed_as(capture: Capture, fused: Fused, progress) -> Capture:
    """A capture whose photos stand where the bundle's cameras of their names do, or, of a bundle that keeps
    none of them, where the capture says; all of them to learn from."""
    views = capture.train + capture.test
    rig = {} if fused.scene.cameras is None else {v.name: v for v in read_rig(fused.scene.cameras).views}
    known = tuple(replace(v, camera_to_world=rig[v.name].camera_to_world) for v in views if v.name in rig)
    if not known and rig:
        progress.warn(
            f"{capture.path}: none of its photos is named as a camera of {fused.path}; they are taken to "
            "stand in its world where they say"
        )
    return replace(capture, train=known or views, test=())


def extent_like(fused: Fused, capture: Capture) -> Extent:
    """The extent of the bundle's own field, for cameras of its world."""
    origin, field = placement(fused.origin), fused.field
    box = field.occupancy.aabb
    if field.occupancy.space is bounded:
        return Extent(box, origin)
    poses = np.array([view.camera_to_world for view in capture.train])
    extent = Extent(box, origin, True)
    near = near_of(capture.train, scene_frame(poses).distance) / extent.unit
    clear = [max(near, NEAR_OF_POINTS * (view.near or 0) / extent.unit) for view in capture.train]
    shown = shown_cells([extent.camera(camera_of(view)) for view in capture.train], near, clear)
    return replace(extent, near=near, cells=shown.within(box))


def wanted_of(request: MendingRequest) -> TrainRequest:
    """A training as `train` without options would do it."""
    seconds = SHARE * request.time_budget if request.time_budget else SECONDS
    return TrainRequest(
        request.refit, request.output, overwrite=request.overwrite, precision="float16",
        memory=request.memory, time_budget=seconds, seed=request.seed, device=request.device,
        threads=request.threads,
    )  # fmt: skip


def without(found: StoredField | None, capture: Capture, cameras: list[Camera], progress) -> Pictures:
    """The photos of a capture without the pixels that show an object, given in the frame of the cameras."""
    loaded = load_photos(capture.train)
    if found is None:
        return Pictures(loaded.pixels, loaded.ignored)
    progress.phase("masking photos", len(cameras))
    ignored = np.zeros(len(loaded.pixels), bool) if loaded.ignored is None else loaded.ignored
    for number, (camera, view) in enumerate(zip(cameras, capture.train, strict=True)):
        part = ignored[loaded.first[number] : loaded.first[number + 1]]
        part |= shows(found, camera, view).ravel()
        progress.advance(number + 1)
    return Pictures(loaded.pixels, ignored)


def shows(found: StoredField, camera: Camera, view: View) -> np.ndarray:
    """(H, W) bool: the pixels of a view that an object shows in, and a few around them."""
    shown = render_image(found, camera).opacity > FAINT
    return binary_dilation(shown, iterations=GROWN) if shown.any() else shown
