"""Adam on the lines that samples can reach is Adam."""

import numpy as np
import torch

from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.dense.field import DenseField, DenseShape
from tests.engine.conftest import BOX, points_in, unit


def half_empty() -> DenseField:
    """A dense field of which only a corner is occupied."""
    field = DenseField.create(DenseShape(0), BOX, (20, 21, 22), torch.Generator().manual_seed(0))
    grid = OccupancyGrid.full(BOX, 8)
    grid.occupied[3:] = False
    field.params.copy_(torch.randn(len(field.params), generator=torch.Generator().manual_seed(1)))
    return field.with_occupancy(grid)


def test_no_gradient_lies_outside_the_lines_and_a_step_moves_what_adam_would():
    field, generator = half_empty(), torch.Generator().manual_seed(2)
    dirs = torch.from_numpy(unit(np.random.default_rng(0).normal(size=(4000, 3))))
    optimiser = Adam.of(field)
    field.query_backward(
        torch.from_numpy(points_in(BOX, 4000)), dirs, torch.randn(4000, generator=generator),
        torch.randn(4000, 3, generator=generator), optimiser.grads,
    )  # fmt: skip
    gradient, before = optimiser.gradient.sum(0), field.params.clone()
    reached = torch.zeros(len(before), dtype=torch.bool)
    for group in field.groups():
        reached[torch.from_numpy(group.lines[:, None] + np.arange(16)).flatten()] = True
    assert 0.1 < reached.float().mean() < 0.7
    assert (gradient[reached] != 0).sum() > 1000 and not gradient[~reached].any()
    optimiser.step(0.1)
    rate = torch.zeros(len(before))
    for group in field.groups():
        rate[group.low : group.high] = 0.1 * group.rate
    wanted = before - torch.where(gradient != 0, rate * gradient.sign(), 0)  # Adam's first step
    torch.testing.assert_close(field.params, wanted, rtol=1e-4, atol=1e-5)
    assert not optimiser.gradient.any()
