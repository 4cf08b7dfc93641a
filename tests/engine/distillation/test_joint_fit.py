"""Fits that share a decoder, on pictures of two balls."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation import fit as fit_module
from fusedrf_cli.engine.distillation import joint_fit
from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.distillation.fit import FitRun
from fusedrf_cli.engine.distillation.joint_fit import JointFit
from fusedrf_cli.engine.rendering.cameras import orbit
from fusedrf_cli.engine.rendering.volume import render_image
from tests.engine.conftest import BOX, Ball

SETTINGS = TrainConfig(kind="dense-mlp", longest=12, steps=40, samples=1 << 11, steps_to_show=4, calm_after=1)
CAMERAS = orbit(BOX, 4, 12, 12)


def begun(radius: float = 0.7, **more) -> FitRun:
    """A run over pictures of a ball."""
    views = [render_image(Ball(density=40.0, radius=radius), camera, step=0.05) for camera in CAMERAS]
    alpha = np.stack([v.opacity for v in views])[..., None]
    rgb = np.stack([v.rgb for v in views]) / np.maximum(alpha, 1e-6)
    images = np.round(255 * np.clip(np.concatenate([rgb, alpha], -1), 0, 1)).astype(np.uint8)
    return FitRun.start(CAMERAS, images, BOX, replace(SETTINGS, **more))


def alike(fields) -> bool:
    """Whether the decoders of fields are the same to the bit."""
    decoders = [
        torch.cat([view.flatten() for name, view in field.sections().items() if name.startswith("decoder.")])
        for field in fields
    ]
    return all(torch.equal(decoders[0], other) for other in decoders[1:])


def same(fields, others) -> bool:
    """Whether fields would be stored as others."""
    states = ([field.state()[0] for field in those] for those in (fields, others))
    return all(
        a.keys() == b.keys() and all(np.array_equal(a[name], b[name]) for name in a)
        for a, b in zip(*states, strict=True)
    )


def test_one_run_learns_what_it_learns_without():
    (joint,) = JointFit([begun()]).finish()
    assert torch.equal(joint.params, begun().finish().params)


def test_all_decoders_are_one_after_every_turn():
    run, other = begun(), begun(0.4, seed=1)
    assert not alike([run.field, other.field])
    joint, turns = JointFit([run, other]), []
    step = joint.turn

    def turn(run):
        assert alike(run.field for run in joint.runs)
        before = other.field.sections()["decoder.out.weight"].clone()
        step(run)
        turns.append(joint.runs.index(run))
        assert not torch.equal(before, other.field.sections()["decoder.out.weight"])

    joint.turn = turn
    fields = joint.finish()
    assert alike(fields) and [run.steps for run in joint.runs] == [40, 40] and turns == 40 * [0, 1]
    assert all(field.shape.shared and field.occupancy.occupied.mean() < 1 for field in fields)
    assert not torch.equal(fields[0].params[:999], fields[1].params[:999])


def test_runs_of_unlike_lengths_end_together():
    joint, turns = JointFit([begun(steps=10), begun(0.4), begun(0.5, steps=20)]), []
    while (run := joint.next()) is not None:
        turns.append(joint.runs.index(run))
        joint.turn(run)
    assert [turns.count(i) for i in range(3)] == [10, 40, 20]
    assert all([turns[:7].count(i), turns[-7:].count(i)] == [n, n] for i, n in enumerate((1, 4, 2)))


def test_a_time_budget_is_each_ones_own(monkeypatch):
    """A clock that only steps move: the second run's take three times as long."""
    now, step = [0.0], FitRun.step
    monkeypatch.setattr(fit_module, "working_time", lambda: now[0])
    monkeypatch.setattr(joint_fit, "working_time", lambda: now[0])
    runs = [begun(time_budget=12.0), begun(0.4, time_budget=12.0)]

    def timed(self, share):
        step(self, share)
        now[0] += 1.0 if self is runs[0] else 3.0

    monkeypatch.setattr(FitRun, "step", timed)
    now[0] = 100.0  # reading photos takes time that is nobody's
    JointFit(runs).finish()
    assert now[0] == 124.0 and [run.steps for run in runs] == [12, 4]


def test_a_run_that_shows_enough_goes_on_until_all_do(monkeypatch):
    runs = [begun(), begun(0.4)]
    monkeypatch.setattr(FitRun, "reached", lambda self: self.steps >= (5 if self is runs[0] else 15))
    JointFit(runs).finish()
    assert [run.steps for run in runs] == [15, 15]


@pytest.mark.parametrize("turns", [1, 31])
def test_runs_go_on_as_if_nothing_had_happened(turns):
    def both() -> JointFit:
        return JointFit([begun(), begun(0.4)])

    whole, half, again = both(), both(), both()
    for _ in range(turns):
        half.turn(half.next())
    arrays, state = half.checkpoint()
    again.restore({name: array.copy() for name, array in arrays.items()}, json.loads(json.dumps(state)))
    assert same(whole.finish(), again.finish())
    with pytest.raises(ValueError, match="2 runs, expected 1"):
        JointFit([begun()]).restore(arrays, state)


def test_what_is_held_while_a_run_is_refreshed_is_of_all(monkeypatch):
    """What a process that has to be ended in a long refresh saves goes on to the same numbers."""

    class Ended(Exception):
        """Nothing that a fit catches."""

    def both() -> JointFit:
        return JointFit([begun(), begun(0.4)])

    whole, cut = both().finish(), both()
    refresh, calls = FitRun.refresh, []

    def ended(self, share):
        calls.append(share)
        if len(calls) == 4:
            raise Ended
        refresh(self, share)

    with monkeypatch.context() as patch, pytest.raises(Ended):
        patch.setattr(FitRun, "refresh", ended)
        cut.finish()
    assert both().held is None
    arrays, state = cut.held
    again = both()
    again.restore(arrays, json.loads(json.dumps(state)))
    assert same(whole, again.finish())
