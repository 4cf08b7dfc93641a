"""What every test of the engine reaches for: the analytic fields and rays of tests/analytic, and small random
VM fields."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.encodings.hash_runs import HashGrid
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape
from tests.analytic.export import SHAPE as THIRTY_TWO  # float32's: few shapes, since each is compiled
from tests.analytic.fields import BOX, AnalyticField, Ball, Gaussian, Slab, Slow, chord_of_box
from tests.analytic.rays import DIRECTIONS_26, points_in, rays_at, unit

SIXTY_FOUR = VMShape(8, 16, 3)  # the shape that float64 kernels are compiled for

__all__ = [
    "BOX",
    "DIRECTIONS_26",
    "SIXTY_FOUR",
    "THIRTY_TWO",
    "AnalyticField",
    "Ball",
    "Gaussian",
    "Slab",
    "Slow",
    "chord_of_box",
    "points_in",
    "random_vm",
    "rays_at",
    "unit",
]


def random_vm(
    shape: VMShape | None = None,
    resolution=(5, 8, 7),
    dtype=torch.float64,
    seed: int = 0,
    aabb=BOX,
    cells: int | None = None,
    scale: float = 3.0,
    shift: float = -1.0,
    hashed: HashGrid | None = None,
) -> VMField:
    """A VM field of random numbers, dense enough to see; `cells` gives it a random occupancy of so many
    cells. Its shape, where none is given, is what loops of its type are compiled for."""
    shape = shape or (SIXTY_FOUR if dtype == torch.float64 else THIRTY_TWO)
    shape = replace(shape, hashed=hashed)
    generator = torch.Generator().manual_seed(seed)
    grid = OccupancyGrid.full(aabb, cells or 1)
    if cells is not None:
        grid = OccupancyGrid(grid.aabb, np.random.default_rng(seed).random(grid.occupied.shape) < 0.3)
    params = torch.randn(VMField.size_of(shape, resolution), generator=generator, dtype=torch.float64) * 0.5
    field = VMField(shape, grid.aabb, resolution, scale, shift, params.to(dtype), grid)
    field.name = "one"
    return field


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator of its own for every test."""
    return np.random.default_rng(7)
