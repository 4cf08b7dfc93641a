"""A place without what no view of it shows."""

from dataclasses import replace

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.kinds.sparse.visible_cells import visible_only
from fusedrf_cli.engine.rendering.cameras import framing_lens, look_at
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image
from tests.bridge.test_unbounded import fine_walls
from tests.engine.conftest import random_vm

LIES = np.diag([0.5, 0.5, 0.5, 1.0])
LIES[:3, 3] = 0.1, -0.2, 0.3
EYE = np.array([0.1, -0.2, 0.3])


def looking(to, side: int = 96):
    """A camera in the middle of the room, in the scene's frame."""
    pose = look_at(EYE, EYE + np.array(to, float), np.array([0.0, 0.0, 1.0]))
    return replace(framing_lens(side, side), camera_to_world=pose)


def test_what_the_views_show_stays_and_the_rest_goes():
    scene = ComposedField([Placed("room", fine_walls(), LIES)])
    views = [look.seen_from(scene.origin) for look in (looking((1, 0, 0)), looking((1, 0.2, 0.1)))]
    cut = visible_only(scene, views)
    before, after = (s.placed[0].field.occupancy for s in (scene, cut))
    shares = [grid.occupied.mean() for grid in (before, after)]
    assert 0 < shares[1] < 0.3 * shares[0]
    assert not (after.contains(after.centres()) & ~before.contains(after.centres())).any()
    for to, rim in (((1, 0, 0), 0), ((1, 0.1, 0.05), 8)):  # a rim of the one between was seen by neither
        shots = [render_image(s, looking(to, 64), origin=s.origin) for s in (scene, cut)]
        assert psnr(*(shot.over((1, 1, 1))[rim : 64 - rim, rim : 64 - rim] for shot in shots)) > 60
    assert render_image(cut, looking((-1, 0, 0), 32), origin=cut.origin).opacity.max() < 0.05


def test_objects_are_as_they_were():
    thing = random_vm(dtype=torch.float32, cells=4)
    alone = ComposedField([Placed("thing", thing, np.eye(4))])
    assert visible_only(alone, [looking((1, 0, 0))]) is alone
    scene = ComposedField([Placed("room", fine_walls(), LIES), Placed("thing", thing, np.eye(4))])
    assert visible_only(scene, [looking((1, 0, 0)).seen_from(scene.origin)]).placed[1] is scene.placed[1]
