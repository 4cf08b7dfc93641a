"""When a phase slows down and ends."""

import json

import pytest

from fusedrf_cli.engine.distillation.schedule import Schedule
from fusedrf_cli.engine.kinds.distil_config import DistilConfig

CONFIG = DistilConfig()


def test_a_phase_that_keeps_rising_takes_all_its_time():
    schedule = Schedule(CONFIG)
    for i in range(10):
        schedule.observe(i / 20, 20 + 2 * CONFIG.least_gain * i)
    assert schedule.end == pytest.approx(1)
    assert schedule.factor(0) == schedule.factor(1 - CONFIG.cooling) == 1
    assert schedule.factor(1) == pytest.approx(CONFIG.rate_decay)
    rates = [schedule.factor(0.6 + 0.4 * i / 50) for i in range(51)]
    ratios = [b / a for a, b in zip(rates, rates[1:], strict=False)]
    assert ratios == pytest.approx([ratios[0]] * 50) and ratios[0] < 1


def test_a_plateau_ends_it_sooner():
    """The fall begins with the look that shows it, and is then `cooling` of what is done in all."""
    schedule = Schedule(CONFIG)
    schedule.observe(0.1, 30.0)
    assert 0.1 * CONFIG.patience >= CONFIG.patient_share
    for i in range(CONFIG.patience):
        assert schedule.end == pytest.approx(1)
        schedule.observe(0.2 + 0.1 * i, 30.0 + 0.9 * CONFIG.least_gain)
    at = 0.2 + 0.1 * (CONFIG.patience - 1)
    assert schedule.cooling_from == pytest.approx(at) and schedule.end == pytest.approx(
        at / (1 - CONFIG.cooling)
    )
    assert schedule.factor(at) == 1 and schedule.factor(schedule.end) == pytest.approx(CONFIG.rate_decay)
    schedule.observe(0.45, 50.0)  # what the fall itself brings puts nothing off
    schedule.observe(0.5, 50.0)
    assert schedule.cooling_from == pytest.approx(at)


def test_a_better_look_starts_the_count_anew():
    schedule = Schedule(CONFIG)
    for share, psnr in ((0.1, 30.0), (0.2, 30.0), (0.3, 30.0), (0.35, 31.0), (0.4, 31.0), (0.5, 31.0)):
        schedule.observe(share, psnr)
    assert schedule.end == pytest.approx(1)


def test_many_looks_in_little_time_end_nothing():
    schedule = Schedule(CONFIG)
    for i in range(20):
        schedule.observe(0.1 + 0.009 * i, 30.0)
    assert schedule.end == pytest.approx(1)
    schedule.observe(0.1 + CONFIG.patient_share, 30.0)
    assert schedule.cooling_from == pytest.approx(0.1 + CONFIG.patient_share)


@pytest.mark.parametrize("looks", [0, 1, 5])
def test_a_restored_schedule_goes_on_as_it_would_have(looks):
    schedule, again = Schedule(CONFIG), Schedule(CONFIG)
    for i in range(looks):
        schedule.observe(0.1 * i, 30.0)
    again.restore(json.loads(json.dumps(schedule.state())))
    for one in (schedule, again):
        one.observe(0.55, 30.0)
    assert vars(schedule) == vars(again)
