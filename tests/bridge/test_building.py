"""What is written is what was measured, and learning keeps to one command's seconds."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fusedrf_cli.bridge import building
from fusedrf_cli.bridge.budget import Budget
from fusedrf_cli.bridge.fusing import choose
from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.bridge.storage_search import StorageSearch, Trial
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import Composite
from fusedrf_cli.engine.distillation.distill import DistillRun
from fusedrf_cli.engine.distillation.finetune import FinetuneRays
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.kinds.builder import (
    BuilderConfig,
    BuildRequest,
    Candidate,
    DirectBuilder,
    DistilledBuilder,
    StorageSetting,
)
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.kinds.sparse import KIND as SPARSE
from fusedrf_cli.engine.kinds.vm import KIND as VM
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_rays
from fusedrf_cli.progress import NullProgress
from tests.analytic.export import SHAPE, way_of
from tests.bridge.conftest import FIELDS, TinySettings

WAYS = [StorageSetting("int4"), StorageSetting("int8")]
SCENE = ComposedField([Placed("red", FIELDS["red"], np.eye(4))])
SAMPLER = RaySampler([SCENE.occupancy.tight_aabb(0)])


class Restless(DirectBuilder):
    """A student that comes out otherwise each time it is made: a winner that is made again is another one."""

    distil_config = None
    gain = 0.0

    def __init__(self, target: float | None):
        super().__init__(VM, SCENE, BuildRequest(BundleSizes(), 4000, target=target))
        self.count = 0

    def storage_settings(self) -> list[list[StorageSetting]]:
        return [WAYS]

    def build(self, storage: StorageSetting, limit: int) -> Candidate | None:
        self.count += 1
        numbers = torch.full_like(FIELDS["red"].params, float(self.count))
        return Candidate(FIELDS["red"].with_params(numbers), limit, False)

    def bytes_of(self, field, storage: StorageSetting) -> int:
        return 10


def asked(**words) -> SimpleNamespace:
    """The words of a FuseRequest that making a student heeds."""
    usual = {"target_psnr": None, "time_budget": None, "finetune": False, "seed": 0, "from_scratch": True}
    return SimpleNamespace(**usual | words)


def maker_of(monkeypatch, student, psnr, request, together=True) -> building.Maker:
    """A maker whose judge says psnr(field)."""
    monkeypatch.setattr(building, "Evaluator", lambda *words: psnr)
    monkeypatch.setattr(building, "evaluation_views_of", lambda *words: [])
    monkeypatch.setattr(building, "stored", lambda field, precision: field)
    scene = building.FuseScene(None, SCENE, SAMPLER)
    return building.Maker(student, scene, request, "cpu", NullProgress(), together)


@pytest.mark.parametrize("target", [None, 30.0])
def test_the_winner_is_written_as_it_was_measured(monkeypatch, target):
    """Whatever was tried after it, and although it would come out otherwise if it were made again."""
    student, measured = Restless(target), {}

    def psnr(field) -> float:
        mark = float(field.params[0])
        return measured.setdefault(mark, 31.0 - 0.01 * len(measured))

    request = asked(target_psnr=target)
    maker = maker_of(monkeypatch, student, psnr, request)
    choosing = StorageSearch(maker.make, "vm", lambda sentence: None)
    choose(choosing, student, request)
    choosing.neighbours(maker.best.trial)
    assert student.count > 3
    assert measured[float(maker.best.field.params[0])] == maker.best.trial.psnr


def test_of_two_tries_the_better_is_kept():
    def trial(psnr, size):
        return Trial(StorageSetting(), size, size, psnr, psnr, False)

    small, large, poor = trial(31.0, 100), trial(35.0, 300), trial(25.0, 10)
    assert small.better(large, 30.0) and not large.better(small, 30.0)
    assert large.better(small, None) and large.better(small, 34.0)
    assert large.better(poor, 30.0) and not poor.better(small, 30.0) and small.better(poor, 40.0)
    assert poor.better(None, 30.0)


@pytest.mark.parametrize("together", [True, False])
def test_rays_show_the_scene_whether_or_not_its_sources_are_in_memory_at_once(monkeypatch, together):
    teacher = maker_of(monkeypatch, Restless(None), lambda field: 0.0, asked(), together).teacher
    assert isinstance(teacher, Composite) == together and (teacher is SCENE) != together
    rays = SAMPLER.draw(300, torch.Generator().manual_seed(5))
    shown, wanted = (render_rays(field, *rays)[:, :4] for field in (teacher, SCENE))
    assert wanted[:, 3].max() > 0.5 and psnr(shown, wanted) > 50


def test_a_student_that_learns_from_nothing_is_taught_by_the_sources_put_together(monkeypatch):
    taught_by = []

    def run(teacher, *words, **more):
        taught_by.append(teacher)
        raise InterruptedError

    monkeypatch.setattr(building, "DistillRun", run)
    student = DistilledBuilder(VM, SCENE, BuildRequest(BundleSizes(), 10_000_000))
    maker = maker_of(monkeypatch, student, lambda field: 0.0, asked())
    with pytest.raises(InterruptedError):
        next(maker.learn())
    assert taught_by == [maker.teacher] and maker.teacher is not SCENE


# -- seconds -------------------------------------------------------------------------------------------------


def test_a_budget_is_shared_by_all_tries(monkeypatch):
    clock = [0.0]
    monkeypatch.setattr("fusedrf_cli.bridge.budget.working_time", lambda: clock[0])
    budget = Budget(12.0)
    for tries in (3, 2, 1):
        assert budget.part(tries) == pytest.approx(4.0)
        with budget.learning():
            clock[0] += 4.0
    assert budget.over and budget.part() == 0
    assert Budget(None).part(3) is None and not Budget(None).over


def test_all_sizes_together_keep_to_the_budget(run, monkeypatch):
    """A target that is never reached grows the student through all its sizes."""
    learnt, finetune = [], DistillRun.finish

    def noted(one, *words, **more):
        found = finetune(one, *words, **more)
        learnt.append((one.learnt_seconds, one.report.steps))
        return found

    monkeypatch.setattr(DistillRun, "finish", noted)
    words = ("--kind", "vm", "--max-size", "300kB", "--target-psnr", "90", "--time-budget", "3")
    result = run("fuse", "pair.json", "-o", "f.rfpack", *words)
    assert result.exit_code == 7 and len(learnt) >= 3
    longest_step = max(seconds / max(1, sum(steps.values())) for seconds, steps in learnt)
    assert sum(seconds for seconds, _ in learnt) <= 3.0 + 2 * len(learnt) * longest_step + 0.5


@pytest.mark.parametrize("steps, part", [(0, 1.0), (10, DistilConfig.points_part)])
def test_a_phase_without_steps_takes_no_time_from_the_other(steps, part):
    most = VMField.size_of(SHAPE, (16,) * 3)
    student = VM.empty(SCENE, way_of(SHAPE), most, torch.Generator().manual_seed(0), "")
    settings = TinySettings(steps=steps, rgb_steps=10, time_budget=8.0)
    run = DistillRun(SCENE, student, SAMPLER, settings)
    run.phase = "points" if steps else "pictures"
    assert run._share(10, 8.0 * part) == pytest.approx(1.0)
    assert run._share(10, 2.0) == pytest.approx(2.0 / (8.0 * part))


def test_rays_are_learnt_from_no_longer_than_allowed(monkeypatch):
    """By a clock that a step of the optimiser moves on by a second."""
    from fusedrf_cli.engine.distillation import finetune

    clock, steps = [0.0], []
    monkeypatch.setattr(finetune, "working_time", lambda: clock[0])
    step = finetune.Adam.step

    def counted(self, rate):
        clock[0] += 1.0
        steps.append(rate)
        step(self, rate)

    monkeypatch.setattr(finetune.Adam, "step", counted)
    distil_config = FinetuneRays(SCENE, SAMPLER, 0, rays=500)
    field = FIELDS["red"].with_params(FIELDS["red"].params.clone())
    distil_config.teach(field, steps=100, seconds=5.0)
    assert len(steps) == 5 and steps[-1] < 0.3 * steps[0]
    distil_config.teach(field, steps=3)
    assert len(steps) == 8


def test_where_the_time_is_over_a_student_stays_as_it_was_made(monkeypatch):
    student = Restless(None)
    maker = maker_of(monkeypatch, student, lambda field: 20.0, asked(finetune=True, time_budget=1.0))
    monkeypatch.setattr(maker, "finished", lambda field: pytest.fail("learnt"))
    maker.budget.spent = 1.0
    assert maker.make(WAYS[0], 4000, True).psnr == 20.0


def test_a_student_of_more_numbers_is_told_more_up_to_twice_as_much():
    student = DistilledBuilder(VM, SCENE, BuildRequest(BundleSizes(), 10_000_000))
    wanted = {
        1: 1,
        BuilderConfig.told_numbers: 1,
        BuilderConfig.told_numbers * 3 // 2: 1.5,
        BuilderConfig.told_numbers * 9: 2,
    }
    for numbers, times in wanted.items():
        found = student.distil_config_for(numbers)
        assert (found.rays, found.steps) == (
            times * student.distil_config.rays,
            times * student.distil_config.steps,
        )
        assert found.rgb_steps == student.distil_config.rgb_steps
    # and where there is time more still, up to twice as much
    wide = BuilderConfig.told_numbers * 9
    rays = [student.distil_config_for(wide, seconds).rays for seconds in (100.0, 150.0, 225.0, 300.0, 900.0)]
    assert [round(r / student.distil_config_for(wide).rays, 3) for r in rays] == [1, 1, 1.5, 2, 2]
    assert Restless(None).distil_config_for(BuilderConfig.told_numbers * 9) is None


def test_bricks_learn_from_more_rays_the_more_numbers_they_hold():
    """More numbers than rays say anything of learn those rays by heart."""
    student = SPARSE.builder(SCENE, BuildRequest(BundleSizes(), 10_000_000))
    found = [
        student.distil_config_for(n) for n in (1, 3_000_000, 6_000_000, 15_000_000, 21_000_000, 90_000_000)
    ]
    assert found[0] == found[1] == student.distil_config
    assert [distil_config.rays // 150_000 for distil_config in found] == [1, 1, 2, 5, 7, 7]
    assert [distil_config.rgb_steps // 400 for distil_config in found] == [1, 1, 1, 2, 3, 4]
    assert all(a.rgb_samples <= b.rgb_samples for a, b in itertools.pairwise(found))
    assert student.distil_config_for(1, 5.0).time_budget == 5.0


def test_one_learnt_tensor_keeps_eight_bits_where_nothing_else_is_asked_for():
    for asked, kept in ((None, "int8"), ("float16", "float16"), ("int4", "int4")):
        request = BuildRequest(BundleSizes(), 10_000_000, precision=asked)
        assert [
            [storage.precision for storage in group]
            for group in DistilledBuilder(VM, SCENE, request).storage_settings()
        ] == [[kept]]


def test_a_short_time_teaches_fewer_numbers_unless_a_quality_is_asked_for():
    def most(**words) -> int:
        return DistilledBuilder(VM, SCENE, BuildRequest(BundleSizes(), 10_000_000, **words)).largest().allowed

    assert most(seconds=0.1) == int(0.1 * BuilderConfig.numbers_per_second) + 1 < most()
    assert most(seconds=1e6) == most() and most(seconds=0.1, target=40.0) == most(target=40.0)
