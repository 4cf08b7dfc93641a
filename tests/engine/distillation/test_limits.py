"""A fit that may hold matter in some cells only, on pictures that say nothing of the others."""

import numpy as np
import pytest

from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.distillation.fit import FitRun
from fusedrf_cli.engine.distillation.ray_dataset import Pictures
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.rendering.cameras import orbit
from tests.analytic.export import way_of

from ..conftest import THIRTY_TWO

BOX = np.array([-1.0, -1, -1, 1, 1, 1])


def ball(cells: int, radius: float = 0.5, box=BOX) -> OccupancyGrid:
    """Cells that a ball reaches into, by their middles."""
    grid = OccupancyGrid.full(box, cells)
    away = np.linalg.norm(grid.centres(), axis=1).reshape(grid.occupied.shape)
    return grid.marked(away < radius)


@pytest.mark.parametrize("cells", [9, 40, 100])
def test_limits_keep_what_is_reached_and_little_else(cells):
    """Against random points: every point of the limits stays, and what stays is at most a cell from them."""
    limits, grid = ball(40), OccupancyGrid.full(np.array([-1.2, -1, -1, 0.9, 1, 1]), cells)
    found = grid.limited(limits)
    spots = np.random.default_rng(0).uniform(-1, 0.9, (20000, 3))
    assert found.contains(spots[limits.contains(spots)]).all()
    far = np.linalg.norm(spots, axis=1) > 0.5 + np.linalg.norm(limits.cell) / 2 + np.linalg.norm(found.cell)
    assert not found.contains(spots[far]).any() and far.any()


def test_limits_take_only_away(rng):
    grid = ball(20, 0.9).marked(rng.random((20, 20, 20)) < 0.5)
    found = grid.limited(ball(10)).occupied
    assert not (found & ~grid.occupied).any() and 0 < found.sum() < grid.occupied.sum()
    apart = ball(20).marked(np.zeros((20, 20, 20), bool))
    apart.occupied[0, 0, 0] = True
    assert apart.limited(ball(20)) is apart


def test_a_fit_stays_inside():
    """Grey pixels through the ball alone, which any opaque box would explain: no cell farther than one of the
    coarsest from the ball is ever occupied."""
    cameras = orbit(np.array([-0.5, -0.5, -0.5, 0.5, 0.5, 0.5]), 6, 16, 16)
    pixels = np.full((6 * 256, 4), 255, np.uint8)
    pixels[:, :3] = 90
    rays = [camera.rays() for camera in cameras]
    away = np.concatenate([np.linalg.norm(np.cross(o, d), axis=1) for o, d in rays])
    settings = TrainConfig(storage=way_of(THIRTY_TWO), longest=24, steps=60, samples=1 << 12)
    limits = ball(32)
    field = FitRun.start(cameras, Pictures(pixels, away > 0.5), BOX, settings, limits=limits).finish()
    middles = field.occupancy.centres()
    reach = 0.5 + np.linalg.norm(limits.cell) / 2 + np.linalg.norm(field.occupancy.cell)
    assert len(middles) and np.linalg.norm(middles, axis=1).max() < reach
