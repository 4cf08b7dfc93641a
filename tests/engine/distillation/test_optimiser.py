"""Which parameters learn at which rate."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.kinds.vm.field import VMConfig
from tests.engine.conftest import THIRTY_TWO, random_vm
from tests.engine.kinds.cases import random_detail


def test_groups_cover_all_and_part_at_the_bases():
    field = random_vm(THIRTY_TWO, dtype=torch.float32)
    groups = field.groups()
    assert groups[0].low == 0 and groups[-1].high == field.params.numel()
    assert all(a.high == b.low for a, b in zip(groups, groups[1:], strict=False))
    assert all(group.low % 16 == 0 == group.high % 16 for group in groups)
    assert [group.rate for group in groups] == [1.0, VMConfig.basis_rate]


def test_first_step_moves_factors_by_the_rate_and_bases_by_its_share():
    """Adam's first step is rate times the sign of the gradient."""
    field = random_vm(THIRTY_TWO, dtype=torch.float32)
    before = field.params.clone()
    optimiser = Adam(field, 2)
    optimiser.grads[0], optimiser.grads[1] = 0.1, 0.2
    optimiser.step(0.5)
    moved = (before - field.params).numpy()
    basis = field.starts[12]
    np.testing.assert_allclose(moved[:basis], 0.5, rtol=1e-4)
    np.testing.assert_allclose(moved[basis:], 0.5 * VMConfig.basis_rate, rtol=1e-3, atol=1e-6)
    assert (optimiser.grads == 0).all()


@pytest.mark.parametrize("before", [0.9, 0.0])
def test_a_saved_run_without_momentum_goes_on_whether_or_not_it_had_some_before(before):
    """The second moment is taken up, the first left where none is kept."""
    field = random_vm(THIRTY_TWO, dtype=torch.float32)
    earlier, later = Adam(field, 1, before), Adam(field, 1, 0.0)
    earlier.grads[:] = 0.1
    earlier.step(0.5)
    later.restore(earlier.state(), earlier.steps)
    assert later.steps == 1 and torch.equal(later.moments[1], earlier.moments[1])
    assert later.state().keys() == {"moment2"} and later.moments[1].any()


def test_rest_without_gradients():
    field = random_vm(THIRTY_TWO, dtype=torch.float32)
    before = field.params.clone()
    Adam(field, 2).step(0.5)
    assert torch.equal(before, field.params)


def test_only_a_hash_grid_fades():
    field = random_detail(dtype=torch.float32)
    assert len(fading := [group for group in field.groups() if group.fades]) == 1
    before, optimiser = field.params.clone(), Adam.of(field)
    optimiser.fade(0.25)
    optimiser.fade(0.25)
    detail = field.sections()["density_detail"]
    assert fading[0].high - fading[0].low >= detail.numel() and detail.any()
    expected = before.clone()
    expected[fading[0].low : fading[0].high] *= 0.75**2
    torch.testing.assert_close(field.params, expected, rtol=1e-6, atol=0)
