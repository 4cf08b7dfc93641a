"""Which cells are an object's: what of other matter came along goes by its colour."""

import numpy as np
import pytest

from fusedrf_cli.engine.selection.cells import CellGrid, Selection
from tests.analytic.fields import AnalyticField

GREEN, RED, GREENISH = (0.1, 0.8, 0.1), (0.8, 0.1, 0.1), (0.15, 0.75, 0.15)


class LegOnTable(AnalyticField):
    """A leg |x|, |y| < 0.2 down to z = 0, where a table of another colour begins."""

    voxel_size = 2 / 40

    def __init__(self, table):
        super().__init__(aabb=np.array([-1.0, -1, -1, 1, 1, 1]), cells=40)
        self.table = table

    def sigma(self, points):
        x, y, z = points.T
        return 100.0 * (leg(points) | ((z < 0) & (z > -0.5)) & (np.abs(x) < 0.9) & (np.abs(y) < 0.9))

    def colour(self, points, dirs):
        return np.where(leg(points)[:, None], GREEN, self.table)


def leg(points):
    """(N,) bool: whether points lie in it."""
    return (np.abs(points[:, :2]) < 0.2).all(1) & (points[:, 2] > 0) & (points[:, 2] < 0.9)


@pytest.mark.parametrize("table", [RED, GREENISH])
def test_what_the_object_touches_is_told_by_its_colour(table):
    """A layer of the table below the leg is given back where it looks unlike the leg, and nothing else."""
    field = LegOnTable(table)
    lattice = CellGrid.over(field, field.aabb, 40)
    own = leg(lattice.points)
    below = (np.abs(lattice.points[:, :2]) < 0.25).all(1) & (np.abs(lattice.points[:, 2] + 0.025) < 0.01)
    assert below.sum() == 100 and own.sum() == 8 * 8 * 18
    left = Selection(lattice, own | below).without_foreign().chosen
    assert np.array_equal(left, own if table == RED else own | below)


def test_an_object_that_stands_free_stays_as_it_is():
    field = LegOnTable(RED)
    lattice = CellGrid.over(field, np.array([-1.0, -1, 0.2, 1, 1, 1]), 40)
    chosen = leg(lattice.points)
    assert chosen.any() and np.array_equal(Selection(lattice, chosen).without_foreign().chosen, chosen)
