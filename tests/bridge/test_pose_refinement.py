"""How well a field shows photos whose own poses are inexact."""

from dataclasses import replace

import numpy as np
import pytest

from fusedrf_cli.bridge.pose_refinement import align
from fusedrf_cli.engine.distillation.poses import changed_each, poses_of
from fusedrf_cli.engine.rendering.cameras import Camera, orbit
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image
from tests.engine.conftest import BOX
from tests.engine.distillation.test_exposure import BALL


def beside(camera: Camera, pixels: float) -> Camera:
    """The camera turned up by so many pixels, about its own x axis."""
    up = camera.camera_to_world[:3, 0] * pixels / camera.fl_x
    turned = changed_each(poses_of([camera]), np.concatenate([up, np.zeros(3)])[None])
    matrix = camera.camera_to_world.copy()
    matrix[:3, :3] = turned.rotation[0]
    return replace(camera, camera_to_world=matrix)


@pytest.mark.parametrize("pixels", [-3.0, 1.5])
def test_a_camera_is_aligned_by_one_half_of_its_photo_and_the_other_fits(pixels):
    """Of a patterned ball: with the pose that was found the half that was not looked at is shown as it is."""
    camera = orbit(BOX, 1, 48, 48)[0]
    camera = replace(camera, fl_x=2.5 * camera.fl_x, fl_y=2.5 * camera.fl_y)  # the ball fills the picture
    truth = render_image(BALL, camera).over()
    left = np.tile(np.arange(48) < 24, (48, 1))
    off = beside(camera, pixels)
    found = align(BALL, off, truth, left, 0.0, 1)
    before, after = (psnr(render_image(BALL, c).over()[~left], truth[~left]) for c in (off, found))
    assert before < 28 and after > before + 10
