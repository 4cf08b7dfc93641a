"""Distilling a coloured ball into a small student."""

import contextlib
import json
from dataclasses import replace
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.distillation import distill as module
from fusedrf_cli.engine.distillation.distill import DistillRun, distill
from fusedrf_cli.engine.distillation.evaluation import scattered_evaluator
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.distillation.schedule import Schedule
from fusedrf_cli.engine.distillation.student import pruned
from fusedrf_cli.engine.distillation.teacher import TeacherConfig
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, OccupancyGrid, texels
from fusedrf_cli.engine.kinds.builder import finest_within
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.kinds.vm import KIND as VM
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.volume import RenderConfig
from tests.analytic.export import way_of
from tests.analytic.rays import affine, turn
from tests.engine.conftest import BOX, THIRTY_TWO, Ball, points_in, random_vm, unit

TEACHER = Ball(density=40.0, radius=0.7).occupy(16)
SAMPLER = RaySampler([TEACHER.occupancy.tight_aabb(0)])
SETTINGS = DistilConfig(
    rays=4000, steps=60, points_per_step=1 << 13, rgb_steps=30, rgb_samples=1 << 13, views=2, view_size=32
)
numbers = partial(VMField.size_of, THIRTY_TWO)
NUMBERS = numbers(texels(BOX, 32))
WAY = way_of(THIRTY_TWO)


@pytest.fixture(autouse=True)
def small_steps(in_force):
    """Coarse grids: seconds, not minutes."""
    in_force(OccupancyConfig(scene_cells=24))


def taught(settings: DistilConfig, rgb: bool = True):
    student = VM.empty(TEACHER, WAY, NUMBERS, torch.Generator().manual_seed(settings.seed), "ball")
    return DistillRun(TEACHER, student, SAMPLER, settings, rgb).finish()


def test_a_ball_is_learnt():
    """60 steps give 22 dB on views of its own, where an untrained student has less than 15."""
    told = []
    student = VM.empty(TEACHER, WAY, NUMBERS, torch.Generator().manual_seed(0), "ball")
    evaluator = scattered_evaluator(TEACHER, 3, 32, 77)
    before = evaluator(student)
    student, report = distill(
        TEACHER,
        student,
        SAMPLER,
        SETTINGS,
        True,
        told.append,
        lambda s, f: told.append(s),
    )
    assert before < 15 and evaluator(student) > 22
    assert max(student.resolution) == 32 and student.name == "ball"
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
    monkeypatch.setattr(module, "scattered_evaluator", lambda *_: lambda student: next(verdicts))
    student, report = taught(brief)
    plain, _ = taught(brief, rgb=False)
    assert report.rgb_kept is kept and report.psnr_after_rgb == after and report.psnr_before_rgb == 20
    assert torch.equal(student.params, plain.params) is not kept


def test_a_harmful_rgb_phase_is_not_kept():
    """At a rate of 3 the pictures spoil what the points taught; the student is the one of before."""
    brief = replace(SETTINGS, rays=2000, rgb_steps=10, rgb_rate=3.0)
    student, report = taught(brief)
    plain, before = taught(brief, rgb=False)
    assert report.psnr_after_rgb < report.psnr_before_rgb - 3 and report.rgb_kept is False
    assert report.psnr_before_rgb == before.psnr_before_rgb and torch.equal(student.params, plain.params)


def test_bad_steps_are_skipped_and_told(monkeypatch):
    """Every 15th answer of the loss is infinite: of the 90 steps of both phases four in the points are."""
    point_step, calls = module.point_step, []

    def infinite_at_times(*words):
        calls.append(0)
        return point_step(*words) * (float("inf") if len(calls) % 15 == 0 else 1)

    monkeypatch.setattr(module, "point_step", infinite_at_times)
    student, report = taught(SETTINGS)
    assert report.numeric == {"skipped_steps": 4, "roll_backs": 0} and report.psnr_before_rgb > 19
    assert torch.isfinite(student.params).all()


def test_a_teacher_of_nan_is_an_error(monkeypatch):
    def spoilt(teacher, *words, **more):
        dataset = ask(teacher, *words, **more)
        dataset.points.sigma[:] = float("nan")
        return dataset

    ask = module.query_teacher
    monkeypatch.setattr(module, "query_teacher", spoilt)
    with pytest.raises(FloatingPointError, match="44 steps were not finite, after 3 returns"):
        taught(replace(SETTINGS, rays=100), rgb=False)


def test_a_student_that_holds_nothing_yet_keeps_its_cells(monkeypatch):
    """After one step all is thin haze, which is kept; and where a search finds nothing at all, no cell may be
    given up, or nothing could be learnt any more."""
    student, report = taught(replace(SETTINGS, rays=1000, steps=1), rgb=False)
    assert not report.found_nothing
    np.testing.assert_array_equal(student.occupancy.occupied, TEACHER.occupancy.occupied)
    nothing = OccupancyGrid(TEACHER.aabb, np.zeros_like(TEACHER.occupancy.occupied))
    monkeypatch.setattr(module, "pruned", lambda student: nothing)
    student, report = taught(replace(SETTINGS, rays=1000, steps=1), rgb=False)
    assert report.found_nothing
    np.testing.assert_array_equal(student.occupancy.occupied, TEACHER.occupancy.occupied)


SLOW_AT = [
    pytest.param(at, coarse, marks=pytest.mark.slow) for at in (0, 6, 7, 20, 30) for coarse in (16, 64)
]


@pytest.mark.parametrize("at, coarse_from", [(3, 16), (3, 64), (20, 64), (25, 16), *SLOW_AT])
def test_a_restored_run_goes_on_to_the_same_bits(monkeypatch, at, coarse_from):
    """Stopped before the first step, in the points (20 steps, of which the first six may be coarse), in the
    pictures (10) and after the last; the schedule looks every fourth step."""
    brief = replace(SETTINGS, rays=1000, steps=20, rgb_steps=10, coarse_from=coarse_from, look_every=4)
    straight, told = taught(brief)

    class Stop(Exception):
        pass

    @contextlib.contextmanager
    def uninterrupted():
        if left and not left.pop():
            raise Stop
        yield

    left = [0] + [1] * at
    run = a_run(brief)
    with pytest.raises(Stop):
        run.finish(uninterrupted=uninterrupted)
    arrays, state = run.checkpoint()
    arrays = {name: np.array(values) for name, values in arrays.items()}
    again = a_run(brief)
    again.restore(arrays, json.loads(json.dumps(state)))
    student, report = again.finish()
    assert torch.equal(student.params, straight.params)
    assert np.array_equal(student.occupancy.occupied, straight.occupancy.occupied)
    assert report.psnr_after_rgb == told.psnr_after_rgb and report.rgb_kept == told.rgb_kept
    assert report.steps == told.steps
    assert [point[1:] for point in report.curve] == [point[1:] for point in told.curve]
    seconds = [point[0] for point in report.curve]
    assert seconds == sorted(seconds)


def test_a_phase_ends_on_a_plateau(monkeypatch):
    """With a look every other step and a gain that no look can bring, the third one is the last at full rate,
    and two thirds of its steps more follow."""
    brief = replace(SETTINGS, rays=1000, look_every=2, least_gain=1e3, patient_share=0.0)
    report = taught(brief, rgb=False)[1]
    assert report.steps["points"] < 20 and len(report.curve) == report.steps["points"] // 2


def test_the_curve_rises_and_is_of_rays_of_its_own(monkeypatch):
    report = taught(replace(SETTINGS, look_every=10))[1]
    seconds, steps, values = zip(*report.curve, strict=True)
    assert steps == tuple(range(10, 91, 10)) and values[5] > values[0] + 3
    assert list(seconds) == sorted(seconds) and report.steps == {"points": 60, "pictures": 30}


def test_pictures_alone_go_on_from_the_student_that_is_there():
    """Without steps on points a student keeps what it knows, and its resolution, until the pictures."""
    known = taught(SETTINGS, rgb=False)[0]
    start = known.params.clone()
    settings = replace(SETTINGS, steps=0, rgb_steps=0, coarse_from=16)
    run = DistillRun(TEACHER, known, SAMPLER, settings)
    student, report = run.finish()
    assert torch.equal(student.params, start) and report.psnr_before_rgb == report.psnr_after_rgb > 20


def test_half_the_resolution_first_ends_at_all_of_it(monkeypatch):
    """What comes out has the resolution that was asked, and is no worse."""
    straight, told = taught(SETTINGS, rgb=False)
    student, report = taught(replace(SETTINGS, coarse_from=16), rgb=False)
    assert student.resolution == straight.resolution
    assert student.params.shape == straight.params.shape
    assert report.psnr_before_rgb > told.psnr_before_rgb - 0.5


def test_the_coarse_student_learns_too(monkeypatch):
    brief = replace(SETTINGS, rays=2000, steps=60, coarse_from=16, look_every=1)
    curve = [psnr for _, _, psnr in taught(brief, rgb=False)[1].curve]
    assert curve[16] > curve[0] + 3  # of the 18 steps that are made at half the resolution


def a_run(settings: DistilConfig) -> module.DistillRun:
    student = VM.empty(TEACHER, WAY, NUMBERS, torch.Generator().manual_seed(settings.seed), "ball")
    return module.DistillRun(TEACHER, student, SAMPLER, settings)


def test_pictures_are_learnt_from_more_rays_than_points(in_force):
    """As many as there is time for, but for the first ones, and after an interrupt as many as before."""
    in_force(RenderConfig(rays_at_once=500), TeacherConfig(rendered_at_once=500))
    brief = replace(SETTINGS, rays=2000, rgb_rays=5000, steps=4, rgb_steps=3)
    run = a_run(brief)
    run.finish()
    assert run.rays == (2000, 5000) and run.shuffle.count == 5000
    hurried = a_run(replace(brief, time_budget=0.2, asking=0.0))
    hurried.finish()
    assert hurried.rays == (500, 1000)
    arrays, state = hurried.checkpoint()
    again = a_run(replace(brief, time_budget=30.0))
    again.restore(arrays, state)
    points, shown = again._ask()
    assert (len(points.rays_o), len(shown.rays_o)) == again.rays == (500, 1000)


def test_without_rgb_nothing_is_said_of_it():
    report = taught(replace(SETTINGS, rays=500, steps=2), rgb=False)[1]
    assert report.rgb_kept is None and report.psnr_after_rgb is None and "pictures" not in report.seconds


@pytest.mark.parametrize("scale", [1.0, 0.5])
def test_a_student_starts_as_the_upright_background(scale):
    """Moved and scaled by `scale`, its tensor answers as the placed field does."""
    matrix = affine(scale, (0.4, 0.1, -0.2))
    source = random_vm(THIRTY_TWO, (20, 21, 22), torch.float32)
    source = replace_voxels(source)
    teacher = ComposedField([Placed("ground", source, matrix)])
    plan = VM.plan(teacher.aabb, teacher.voxel_size, WAY, 10**7)
    student = VM.warm_start(teacher.placed[0], plan, teacher, torch.Generator().manual_seed(0))
    inner = teacher.aabb + 0.1 * np.array([1, 1, 1, -1, -1, -1])
    points, dirs = torch.from_numpy(points_in(inner, 2000)), torch.from_numpy(unit(points_in(BOX, 2000)))
    (sigma, rgb), (wanted, colour) = student.query(points, dirs), teacher.query(points, dirs)
    assert (sigma - wanted).abs().mean() < 0.15 * wanted.mean()  # resampling and the waking noise
    assert (rgb - colour).abs().mean() < 0.05


def replace_voxels(field):
    """The smooth field of a few texels, on more of them."""
    coarse = random_vm(THIRTY_TWO, (4, 4, 4), field.params.dtype)
    return coarse.resampled(BOX, field.resolution)


@pytest.mark.parametrize("linear", [turn(20), np.diag([1.0, 1, 2]), -1.0])
def test_a_turned_background_cannot_be_taken_over(linear):
    placed = Placed("ground", random_vm(THIRTY_TWO, dtype=torch.float32), affine(linear))
    ball = Placed("ball", TEACHER, np.eye(4))
    for one in (placed, ball):
        scene = ComposedField([one])
        plan = VM.plan(scene.aabb, scene.voxel_size, WAY, NUMBERS)
        assert VM.warm_start(one, plan, scene, torch.Generator()) is None


def test_resolution_is_the_teachers_or_what_fits():
    assert finest_within(BOX, 0.1, numbers, 10**9) == texels(BOX, 23)
    tight = numbers(texels(BOX, 40))
    found = finest_within(BOX, 1e-3, numbers, tight)
    assert 0.9 * tight < numbers(found) <= tight


def test_pruned_drops_empty_cells_only():
    dense = random_vm(THIRTY_TWO, dtype=torch.float32, cells=8, scale=100.0)
    assert np.array_equal(pruned(dense).occupied, dense.occupancy.occupied)
    assert not pruned(random_vm(THIRTY_TWO, dtype=torch.float32, cells=8, scale=1e-6)).occupied.any()


def test_points_have_three_quarters_of_the_seconds_at_most_and_pictures_the_rest():
    """Points have all where nothing else is learnt."""

    def share(phase: str, rgb: bool = True, points_seconds: float = 6.0, **words) -> float:
        config = DistilConfig(time_budget=8.0, **words)
        schedule = Schedule(config)
        run = SimpleNamespace(
            config=config, rgb=rgb, phase=phase, steps=200, points_seconds=points_seconds, schedule=schedule
        )
        return DistillRun._share(run, config.steps if phase == "points" else config.rgb_steps, 3.0)

    assert share("points") == pytest.approx(3 / 6) and share("pictures") == pytest.approx(3 / 2)
    assert share("points", rgb=False) == pytest.approx(3 / 8)
    assert share("pictures", steps=0, points_seconds=0.0) == pytest.approx(3 / 8)
    assert share("pictures", points_seconds=2.0) == pytest.approx(3 / 6)
    assert share("pictures", points_seconds=9.0) == Schedule(DistilConfig()).end
    assert share("points", steps=250) == pytest.approx(3 / 6)
    assert share("points", steps=250, enough_steps=True) == pytest.approx(200 / 250)
    assert share("points", steps=800, enough_steps=True) == pytest.approx(3 / 6)
    assert share("points", rgb=False, steps=250, enough_steps=True) == pytest.approx(3 / 8)
