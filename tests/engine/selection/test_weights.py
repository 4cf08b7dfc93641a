"""Where the light of rays comes from: scenes against single fields' compiled votes, and against asking every
sample."""

import numpy as np
import pytest

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import as_composite
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, OccupancyGrid
from fusedrf_cli.engine.selection.weights import Tally, cell_weights, march
from tests.analytic.export import exported
from tests.analytic.fields import Gaussian, Tint
from tests.analytic.rays import affine, rays_at, turn
from tests.engine.spaces.test_unbounded import random_field

BOX = np.array([-1.0, -1, -1, 1, 1, 1])


@pytest.fixture(autouse=True)
def coarse_occupancy(in_force):
    in_force(OccupancyConfig(scene_cells=24))


def blob(kind, density=20.0):
    return exported(Gaussian(density, tint=Tint.of(0.9, 0.2, 0.1)), kind, (25, 25, 25))


def of_rays(field, cells, count=400, seed=3):
    """(2, X, Y, Z) of rays that look at the middle, every third one inside."""
    rays_o, rays_d = rays_at(BOX, count, seed)
    half, inside = np.full(len(rays_o), 0.5), np.arange(len(rays_o)) % 3 == 0
    return cell_weights(field, rays_o, rays_d, half, inside, cells), (rays_o, rays_d, half, inside)


@pytest.mark.parametrize("kind", ["vm", "sparse"])
def test_a_scene_of_one_field_weighs_as_that_field(kind):
    field, cells = blob(kind), OccupancyGrid.full(BOX, 9)
    alone, _ = of_rays(field, cells)
    scene = as_composite(ComposedField([Placed("a", field, np.eye(4))], origin=np.zeros(3)))
    composed, _ = of_rays(scene, cells)
    np.testing.assert_allclose(composed, alone, atol=2e-4)
    assert (alone.sum((1, 2, 3)) > 10).all()


@pytest.mark.parametrize("rule", ["max", "add"])
@pytest.mark.parametrize("pair", ["bounded", "unbounded"])
def test_a_scene_of_two_kinds_weighs_as_its_samples(rule, pair):
    """Those of the naive composition, in cells far wider than they lie apart."""
    first = random_field(0) if pair == "unbounded" else blob("vm")
    first = first.with_params(first.params.float())
    placed = [
        Placed("a", first, np.eye(4)),
        Placed("b", blob("sparse", 30.0), affine(0.5 * turn(40), (0.3, 0.1, -0.2))),
    ]
    naive = ComposedField(placed, rule)
    cells = OccupancyGrid.full(naive.aabb, 4, naive.occupancy.space)
    found, (rays_o, rays_d, half, inside) = of_rays(as_composite(naive), cells)
    tally = Tally(cells)
    march(naive, rays_o, rays_d, half, inside, tally)
    assert found.sum() > 20
    np.testing.assert_allclose(found.sum((1, 2, 3)), tally.sums.sum((1, 2, 3)), rtol=0.03)
    least = 0.06 if pair == "bounded" else 0.15  # steps of the far half are wide
    assert np.abs(found - tally.sums).sum() < least * tally.sums.sum()
