"""Bad steps change nothing; too many of them bring the last good numbers back."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.nan_guard import NanGuard, NanGuardConfig
from fusedrf_cli.engine.distillation.optimiser import Adam
from tests.engine.conftest import THIRTY_TWO, random_vm

FINE, BAD = np.array([1.0, 2.0, 3.0]), np.array([1.0, np.nan, 3.0])


@pytest.fixture
def parts():
    """A field, its optimiser and their guard."""
    field = random_vm(THIRTY_TWO, dtype=torch.float32)
    optimiser = Adam(field, 2)
    return field, optimiser, NanGuard(optimiser.numbers)


@pytest.mark.parametrize("loss", [np.nan, np.inf, -np.inf])
def test_a_bad_loss_is_no_step(parts, loss):
    _, optimiser, nan_guard = parts
    nan_guard.keep()
    optimiser.grads[:] = 1
    assert not nan_guard.accepts(np.array([loss, 0, 0]), optimiser)
    assert not optimiser.grads.any() and nan_guard.figures() == {"skipped_steps": 1, "roll_backs": 0}


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e30])
def test_a_bad_gradient_of_the_basis_is_no_step(parts, value):
    """1e30 is finite, but its square in the second moment would not be."""
    field, optimiser, nan_guard = parts
    nan_guard.keep()
    optimiser.grads[1, int(field.starts[12]) + 5] = value
    assert not nan_guard.accepts(FINE, optimiser)


def test_fine_steps_are_accepted_and_not_told(parts):
    _, optimiser, nan_guard = parts
    for _ in range(3 * NanGuardConfig.kept_every):
        nan_guard.keep()
        optimiser.grads[:, ::1000] = 1e-3
        assert nan_guard.accepts(FINE, optimiser)
    assert nan_guard.figures() == {} and nan_guard.rate == 1


def test_a_poisoned_factor_shows_in_the_basis():
    """An infinite colour factor: the loss may stay finite, the next step is refused all the same."""
    from fusedrf_cli.engine.fields.computed import Batch
    from tests.engine.conftest import BOX, rays_at

    field = random_vm(THIRTY_TWO, dtype=torch.float32)
    field.sections()["colour_line_1"][:, 3] = float("inf")
    optimiser = Adam(field, 2)
    rays = rays_at(BOX, 64)
    zeros = np.zeros((64, 4), np.float32)
    batch = Batch(*rays, np.zeros(64), zeros, zeros[:, :3].copy(), 0.1, 0.0, 0.1, 1e-3)
    sums = np.zeros((2, 3))
    field.train_rays(batch, optimiser.grads, sums)
    assert not np.isfinite(optimiser.grads).all()
    assert not (np.isfinite(sums).all() and optimiser.sound())


def test_more_than_ten_in_a_hundred_go_back(parts):
    """To the copy of before, moments and all, at a third of the rate."""
    field, optimiser, nan_guard = parts
    nan_guard.keep()
    good = field.params.clone()
    field.params += 1
    optimiser.moment1 += 1
    for i in range(NanGuardConfig.allowed + 1):
        assert nan_guard.roll_backs == 0, i
        nan_guard.keep()
        nan_guard.accepts(BAD, optimiser)
    assert nan_guard.roll_backs == 1 and nan_guard.rate == pytest.approx(1 / 3)
    assert torch.equal(field.params, good) and not optimiser.moment1.any()


def test_ten_in_a_hundred_are_borne_for_ever(parts):
    _, optimiser, nan_guard = parts
    for i in range(5 * NanGuardConfig.window):
        nan_guard.keep()
        nan_guard.accepts(BAD if i % NanGuardConfig.window < NanGuardConfig.allowed else FINE, optimiser)
    assert nan_guard.roll_backs == 0 and nan_guard.skipped == 5 * NanGuardConfig.allowed


def test_the_fourth_time_is_the_last(parts):
    _, optimiser, nan_guard = parts
    nan_guard.keep()
    for _ in range((NanGuardConfig.most_roll_backs + 1) * (NanGuardConfig.allowed + 1) - 1):
        nan_guard.accepts(BAD, optimiser)
    assert nan_guard.roll_backs == NanGuardConfig.most_roll_backs and nan_guard.rate == pytest.approx(1 / 27)
    with pytest.raises(FloatingPointError, match="44 steps were not finite"):
        nan_guard.accepts(BAD, optimiser)


def test_poisoned_numbers_are_found_when_a_copy_is_due(parts):
    """One NaN among all numbers is gone after KEPT_EVERY steps, though no loss told of it."""
    field, optimiser, nan_guard = parts
    nan_guard.keep()
    good = field.params.clone()
    field.params[7] = float("nan")
    for _ in range(NanGuardConfig.kept_every):
        nan_guard.keep()
        nan_guard.accepts(FINE, optimiser)
    assert nan_guard.roll_backs == 1 and torch.equal(field.params, good)


def test_nothing_good_to_go_back_to(parts):
    field, _, nan_guard = parts
    field.params[7] = float("inf")
    with pytest.raises(FloatingPointError):
        nan_guard.keep()


def test_a_restored_guard_counts_on(parts):
    _, optimiser, nan_guard = parts
    nan_guard.keep()
    for _ in range(NanGuardConfig.allowed):
        nan_guard.accepts(BAD, optimiser)
    other = NanGuard(nan_guard.numbers)
    other.restore(nan_guard.state())
    other.keep()
    other.accepts(BAD, optimiser)
    assert other.figures() == {"skipped_steps": NanGuardConfig.allowed + 1, "roll_backs": 1}
