"""What `train` makes of an analytic scene at each preset, and how it bears being placed: the worst cases of
A1, A3, A4, A7 and B5 next to the seconds of training. All against the closed form, from views never seen."""

import dataclasses
import time
from functools import cache

import numpy as np
import pytest

from fusedrf_cli.bridge.training import TrainPresets
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.distillation.fit import fit
from fusedrf_cli.engine.rendering.cameras import orbit, scattered
from fusedrf_cli.engine.rendering.metrics import psnr
from tests.analytic.fields import Box, Tint
from tests.analytic.measure import photo
from tests.analytic.rays import affine, turn
from tests.analytic.scenes import RED, SAND, Scene, moved_camera, scene_of

pytestmark = pytest.mark.slow

PRESETS = ("draft", "normal", "high")
SIDE, SHOTS, ELEVATIONS = 80, 16, (-0.5, 0.3, 1.0)
FACING = Tint(facing=np.array([[-1.5, 0, 0], [0, -1.5, 0], [0, 0, -1.5]]))
LOOK_AT_BOX = scene_of(
    ("cube", Box(80.0, 0.3, tint=FACING), np.eye(4)),
    ("plate", Box(80.0, (0.6, 0.4, 0.05), tint=SAND), affine(turn(20, (0, 0, 1)), (0, 0, -0.35))),
    ("post", Box(80.0, (0.06, 0.06, 0.5), tint=RED), affine(turn(15, (1, 0, 0)), (0.45, 0, 0.1))),
)
BOX = np.array([-0.8, -0.8, -0.8, 0.8, 0.8, 0.8])
PLACINGS = {
    "A1": ("scaled by 0.01", affine(0.01, (0, 0, 0))),
    "A3": ("mirrored", np.diag([-1.0, 1, 1, 1])),
    "A4": ("turned by 40°", affine(turn(40), (0.2, 0, 0.1))),
    "A7": ("moved by 1e6", affine(1.0, np.array([1, -1, 1]) * 1e6)),
}
PLACING_COSTS = 1.0  # dB between the worst views of the field placed and as it was trained: C8's spread
MEETING = 30.0  # dB of the worst view of two fields that meet


@cache
def trained(preset: str) -> tuple:
    """(field, seconds) of the subject trained at a preset from 48 pictures of the closed form."""
    cameras = [camera for e in ELEVATIONS for camera in orbit(BOX, SHOTS, SIDE, SIDE, e)]
    images = []
    for camera in cameras:
        found = LOOK_AT_BOX.pixels(*camera.rays()).reshape(SIDE, SIDE, 4)
        straight = found[..., :3] / np.maximum(found[..., 3:], 1e-6)
        images.append(np.rint(255 * np.concatenate([straight, found[..., 3:]], -1)).astype(np.uint8))
    started = time.perf_counter()
    field = fit(cameras, np.stack(images), BOX, getattr(TrainPresets, preset))
    return field, time.perf_counter() - started


def worst_view(preset: str, matrices: list[np.ndarray], truth: Scene, moved: np.ndarray) -> tuple:
    """(worst PSNR of four unseen views that move along by a matrix, seconds of training)."""
    field, seconds = trained(preset)
    composed = ComposedField([Placed(f"n{i}", field, m) for i, m in enumerate(matrices)])
    scale = np.cbrt(abs(np.linalg.det(moved[:3, :3])))
    found = []
    for camera in scattered(BOX, 4, SIDE, SIDE, seed=77):
        camera = moved_camera(camera, moved)
        pose = camera.camera_to_world.copy()
        pose[:3, :3] /= scale
        camera = dataclasses.replace(camera, camera_to_world=pose)
        found.append(psnr(photo(composed, camera, composed.origin), truth.image(camera)))
    return min(found), seconds


@pytest.mark.parametrize("preset", PRESETS)
@pytest.mark.parametrize("name", PLACINGS)
def test_a_trained_field_bears_its_placing(row, name, preset):
    what, matrix = PLACINGS[name]
    bar = worst_view(preset, [np.eye(4)], LOOK_AT_BOX, np.eye(4))[0] - PLACING_COSTS
    figure, seconds = worst_view(preset, [matrix], LOOK_AT_BOX.under(matrix), matrix)
    row.check(name, f"trained, {what}", figure, bar, scene="S8", unit="dB", preset=preset, seconds=seconds)


@pytest.mark.parametrize("preset", PRESETS)
def test_b5_trained_fields_through_each_other(row, preset):
    """The subject and a turned copy in one place: whoever is denser at a point, both are the union."""
    other = affine(turn(90, (0, 0, 1)), (0.1, 0.1, 0.3))
    truth = Scene(LOOK_AT_BOX.parts + LOOK_AT_BOX.under(other).parts)
    figure, seconds = worst_view(preset, [np.eye(4), other], truth, np.eye(4))
    what = "trained, two through each other"
    row.check("B5", what, figure, MEETING, scene="S8", unit="dB", preset=preset, seconds=seconds)
