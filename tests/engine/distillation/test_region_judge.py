"""A judge that asks only rays through a region."""

import numpy as np
import pytest

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.distillation.judging import Judge, RegionJudge, meets
from fusedrf_cli.engine.rendering.cameras import scattered

from ..conftest import BOX, Ball, rays_at


def test_fields_that_differ_in_a_box_have_the_psnr_of_whole_pictures():
    near, far = np.eye(4), np.eye(4)
    near[0, 3], far[0, 3] = -1.5, 1.5
    ball = Ball(4.0)
    place = Placed("left", ball, near)
    before = ComposedField([place, Placed("right", ball, far)])
    after = ComposedField([place, Placed("right", Ball(1.0), far)])
    cameras = scattered(before.aabb + np.tile(before.origin, 2), 3, 40, 40, seed=5)
    judge = RegionJudge(before, cameras, before.origin, Placed("right", ball, far).aabb)
    whole = Judge(before, cameras, before.origin)
    assert 15 < whole(after) < 60
    assert judge(after) == pytest.approx(whole(after), abs=1e-3)
    assert judge.pixels == 4800 and 0 < len(judge.rays[0]) < 0.6 * judge.pixels
    assert judge(before) == 100


def test_rays_that_meet_a_box_are_found():
    rays_o, rays_d = rays_at(BOX, 300)
    assert meets(rays_o, rays_d, BOX).all()
    assert not meets(rays_o, -rays_d, BOX).any()
    straight = np.array([[0.0, 0.0, 1.0]] * 3)
    origins = np.array([[0.0, 0.0, -9.0], [BOX[3] + 0.1, 0.0, -9.0], [BOX[3], 0.0, -9.0]])
    assert meets(origins, straight, BOX).tolist() == [True, False, True]
    assert meets(np.zeros((1, 3)), straight[:1], BOX).all()  # from inside
