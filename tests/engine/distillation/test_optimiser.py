"""Which parameters learn at which rate."""

import numpy as np
import torch

from fusedrf_cli.engine.distillation.optimiser import BASIS_RATE_RATIO, Adam
from tests.engine.conftest import THIRTY_TWO, random_vm


def test_groups_cover_all_and_part_at_the_bases():
    field = random_vm(THIRTY_TWO, dtype=torch.float32)
    groups = field.parameter_groups()
    assert groups[0][0] == 0 and groups[-1][1] == field.params.numel()
    assert all(a[1] == b[0] for a, b in zip(groups, groups[1:], strict=False))
    assert all(low % 16 == 0 == high % 16 for low, high, _ in groups)


def test_first_step_moves_factors_by_the_rate_and_bases_by_its_share():
    """Adam's first step is rate times the sign of the gradient."""
    field = random_vm(THIRTY_TWO, dtype=torch.float32)
    before = field.params.clone()
    optimiser = Adam(field, 2)
    optimiser.grads[0], optimiser.grads[1] = 0.1, 0.2
    optimiser.step(0.5)
    moved = (before - field.params).numpy()
    basis = field.layout[0, 12]
    np.testing.assert_allclose(moved[:basis], 0.5, rtol=1e-4)
    np.testing.assert_allclose(moved[basis:], 0.5 * BASIS_RATE_RATIO, rtol=1e-3, atol=1e-6)
    assert (optimiser.grads == 0).all()


def test_rest_without_gradients():
    field = random_vm(THIRTY_TWO, dtype=torch.float32)
    before = field.params.clone()
    Adam(field, 2).step(0.5)
    assert torch.equal(before, field.params)
