"""Holes that objects leave: found in what they touched, and filled by what is smoothest there."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.rendering.volume import render_rays
from fusedrf_cli.engine.selection.holes import membrane, patches
from tests.analytic.fields import AnalyticField

UP = np.array([0.0, 0.0, 1.0])
BOX = np.array([-0.3, -0.2, 0.0, 0.3, 0.2, 0.5])  # of an object on the table, inside of the hole's rim
RIM = 0.15


class Table(AnalyticField):
    """A slope z < rise * x, 0.2 thick, with a hole under the object; its colour is linear in x and y."""

    voxel_size = 0.01

    def __init__(self, rise: float = 0.0, turn=None, whole: bool = False):
        super().__init__(aabb=np.array([-1.0, -1, -1, 1, 1, 1]), cells=32)
        self.rise, self.turn, self.whole = rise, np.eye(3) if turn is None else turn, whole

    def sigma(self, points):
        x, y, z = (points @ self.turn).T
        hole = (np.abs(x) < RIM * 1.5) & (np.abs(y) < RIM) & (not self.whole)
        below = self.rise * x - z
        return 400.0 * ((below > 0) & (below < 0.2) & ~hole)

    def colour(self, points, dirs):
        x, y, _ = (points @ self.turn).T
        return np.stack([0.5 + 0.4 * x, 0.5 - 0.3 * y, 0.4 + 0.2 * (x + y)], 1)


def test_a_membrane_over_values_of_a_harmonic_function_is_that_function():
    """u² - v² is harmonic for the five-point stencil too."""
    u, v = np.meshgrid(np.arange(24.0), np.arange(17.0), indexing="ij")
    values = np.stack([u**2 - v**2, 3 * u - v + 1], -1)
    wanted = (u - 11) ** 2 + (v - 8) ** 2 < 30
    spoilt = np.where(wanted[..., None], 1e3, values)
    np.testing.assert_allclose(membrane(spoilt, ~wanted, wanted), values, atol=1e-4)


def test_a_membrane_is_free_where_nothing_is_known():
    """Along a strip that is known at one end alone it stays what it is there."""
    values = np.zeros((10, 1, 1))
    values[0] = 5.0
    known = np.zeros((10, 1), bool)
    known[0] = True
    np.testing.assert_allclose(membrane(values, known, ~known), 5.0, atol=1e-4)


@pytest.mark.parametrize("rise", [0.0, 0.2])
def test_the_table_goes_on_under_the_object(rise):
    """From above, the mended table is as the whole one is: depth and colour."""
    table = Table(rise)
    found, share = patches(table, BOX, UP)
    assert len(found) == 1 and 0.2 < share < 0.65
    mended = ComposedField([Placed("table", table, np.eye(4)), Placed("patch", found[0], np.eye(4))])
    g = np.random.default_rng(0)
    o = np.concatenate([g.uniform(-1, 1, (400, 2)) * [0.2, 0.14], np.ones((400, 1))], 1)
    d = np.tile([[0.0, 0, -1]], (400, 1))
    seen, true = (render_rays(field, o, d, step=0.002) for field in (mended, Table(rise, whole=True)))
    assert render_rays(table, o, d, step=0.002)[:, 3].mean() < 0.3  # there was a hole
    assert seen[:, 3].min() > 0.98
    np.testing.assert_allclose(seen[:, 4], true[:, 4], atol=0.02)
    assert np.abs(seen[:, :3] - true[:, :3]).mean() < 0.02


def test_a_picture_s_hole_is_filled_in_its_wall():
    """The same table stood upright is the wall behind an object before it."""
    turn = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # the table's z is the world's x
    wall = Table(turn=turn)
    box = np.array([0.0, -0.2, -0.3, 0.5, 0.2, 0.3])
    found, _ = patches(wall, box, UP)
    assert len(found) == 1
    sigma, _ = found[0].query(torch.tensor([[-0.005, 0.0, 0.0], [0.1, 0, 0]]).double(), torch.zeros(2, 3))
    assert sigma[0] > 100 and sigma[1] == 0


def test_nothing_is_filled_where_nothing_is_missing_or_nothing_is_beside():
    assert patches(Table(whole=True), BOX, UP)[0] == []
    above = BOX + np.array([0, 0, 0.45, 0, 0, 0.45])
    assert patches(Table(), above, UP)[0] == []
