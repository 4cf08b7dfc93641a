"""Distilling a coloured ball into a small student."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.distillation import distill as module
from fusedrf_cli.engine.distillation.distill import (
    DistillSettings,
    Judge,
    distill,
    empty_student,
    pruned,
    resolution_for,
    shares,
    student_from,
)
from fusedrf_cli.engine.distillation.fit import texels
from tests.analytic.rays import affine, turn
from tests.engine.conftest import BOX, THIRTY_TWO, Ball, points_in, random_vm, unit

TEACHER = Ball(density=40.0, radius=0.7).occupy(16)
SETTINGS = DistillSettings(
    shape=THIRTY_TWO, max_numbers=THIRTY_TWO.size(texels(BOX, 32)), rays=4000, steps=60, rgb_steps=30,
    rgb_samples=1 << 13,
    views=2, view_size=32,
)  # fmt: skip


@pytest.fixture(autouse=True)
def small_steps(monkeypatch):
    """Fewer points per step, and coarse grids: seconds, not minutes."""
    monkeypatch.setattr(module, "POINTS_PER_STEP", 1 << 13)
    monkeypatch.setattr("fusedrf_cli.engine.composition.composed.OCCUPANCY_CELLS", 24)


def taught(settings: DistillSettings, rgb: bool = True):
    student = empty_student(TEACHER, settings, torch.Generator().manual_seed(settings.seed), "ball")
    return distill(TEACHER, student, [TEACHER.occupancy.tight_aabb(0)], settings, rgb)


def test_a_ball_is_learnt():
    """60 steps give 22 dB on views of its own, where an untrained student has less than 15."""
    told = []
    student = empty_student(TEACHER, SETTINGS, torch.Generator().manual_seed(0), "ball")
    judge = Judge(TEACHER, 3, 32, 77)
    before = judge(student)
    student, report = distill(
        TEACHER,
        student,
        [TEACHER.occupancy.tight_aabb(0)],
        SETTINGS,
        True,
        told.append,
        lambda s, f: told.append(s),
    )
    assert before < 15 and judge(student) > 22
    assert max(student.tensors[0].resolution) == 32 and student.blocks[0].name == "ball"
    assert report.psnr_before_rgb > 20 and set(report.seconds) == {"teachers", "points", "pictures"}
    assert [t for t in told if isinstance(t, str)] == ["asking the teachers", "points", "pictures"]
    assert 0.02 < student.occupancy.occupied.mean() < TEACHER.occupancy.occupied.mean() + 1e-9


def test_the_same_seed_gives_the_same_bits():
    brief = replace(SETTINGS, rays=1000, steps=8, rgb_steps=5)
    first, again, other = (taught(replace(brief, seed=s))[0] for s in (1, 1, 2))
    assert torch.equal(first.params, again.params)
    assert np.array_equal(first.occupancy.occupied, again.occupancy.occupied)
    assert not torch.equal(first.params, other.params)


@pytest.mark.parametrize("after, kept", [(21.0, True), (20.0, False), (19.0, False)])
def test_the_rgb_phase_is_kept_only_if_better(monkeypatch, after, kept):
    brief = replace(SETTINGS, rays=1000, steps=40, rgb_steps=5)
    verdicts = iter([20.0, after, 20.0])
    monkeypatch.setattr(module, "Judge", lambda *_: lambda student: next(verdicts))
    student, report = taught(brief)
    plain, _ = taught(brief, rgb=False)
    assert report.rgb_kept is kept and report.psnr_after_rgb == after and report.psnr_before_rgb == 20
    assert torch.equal(student.params, plain.params) is not kept


def test_without_rgb_nothing_is_said_of_it():
    report = taught(replace(SETTINGS, rays=500, steps=2), rgb=False)[1]
    assert report.rgb_kept is None and report.psnr_after_rgb is None and "pictures" not in report.seconds


def test_numbers_that_are_not_finite_are_an_error(monkeypatch):
    def spoil(student, *_):
        student.params[0] = float("nan")

    monkeypatch.setattr(module, "fit_points", spoil)
    monkeypatch.setattr(module, "Judge", lambda *_: lambda student: 0.0)
    with pytest.raises(FloatingPointError, match="not finite"):
        taught(replace(SETTINGS, rays=100), rgb=False)


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_student_starts_as_the_upright_background(scale):
    """Moved and scaled by `scale`, its tensor answers as the placed field does."""
    matrix = affine(scale, (0.4, 0.1, -0.2))
    source = random_vm(THIRTY_TWO, (20, 21, 22), torch.float32)
    source = replace_voxels(source)
    teacher = ComposedField([Placed("ground", source, matrix)])
    settings = replace(SETTINGS, max_numbers=10**7)
    student = student_from(teacher.placed[0], teacher, settings, torch.Generator().manual_seed(0))
    inner = teacher.aabb + 0.1 * np.array([1, 1, 1, -1, -1, -1])
    points, dirs = torch.from_numpy(points_in(inner, 2000)), torch.from_numpy(unit(points_in(BOX, 2000)))
    (sigma, rgb), (wanted, colour) = student.query(points, dirs), teacher.query(points, dirs)
    assert (sigma - wanted).abs().mean() < 0.15 * wanted.mean()  # resampling and the waking noise
    assert (rgb - colour).abs().mean() < 0.05


def replace_voxels(field):
    """The smooth field of a few texels, on more of them."""
    coarse = random_vm(THIRTY_TWO, (4, 4, 4), field.params.dtype)
    return coarse.resampled(BOX, field.tensors[0].resolution)


@pytest.mark.parametrize("linear", [turn(20), np.diag([1.0, 1, 2]), -1.0])
def test_a_turned_background_cannot_be_taken_over(linear):
    placed = Placed("ground", random_vm(THIRTY_TWO, dtype=torch.float32), affine(linear))
    assert student_from(placed, ComposedField([placed]), SETTINGS, torch.Generator()) is None
    ball = Placed("ball", TEACHER, np.eye(4))
    assert student_from(ball, ComposedField([ball]), SETTINGS, torch.Generator()) is None


def test_resolution_is_the_teachers_or_what_fits():
    assert resolution_for(BOX, 0.1, THIRTY_TWO, 10**9) == texels(BOX, 23)
    tight = THIRTY_TWO.size(texels(BOX, 40))
    found = resolution_for(BOX, 1e-3, THIRTY_TWO, tight)
    assert 0.9 * tight < THIRTY_TWO.size(found) <= tight


def test_shares_follow_the_steps_or_the_clock():
    assert list(shares(4, None)) == [0, 0.25, 0.5, 0.75]
    by_clock = list(shares(1, 0.05))
    assert len(by_clock) > 1 and by_clock == sorted(by_clock) and by_clock[-1] < 1


def test_pruned_drops_empty_cells_only():
    dense = random_vm(THIRTY_TWO, dtype=torch.float32, cells=8, scale=100.0)
    assert np.array_equal(pruned(dense).occupied, dense.occupancy.occupied)
    assert not pruned(random_vm(THIRTY_TWO, dtype=torch.float32, cells=8, scale=1e-6)).occupied.any()
