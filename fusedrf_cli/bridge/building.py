"""Makes, stores and measures a kind's students of one scene, and keeps the best of them as it is."""

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass, replace

import numpy as np
import torch

from fusedrf_cli.bridge.background import Background
from fusedrf_cli.bridge.budget import Budget
from fusedrf_cli.bridge.evaluation_views import evaluation_views_of, unbounded_views
from fusedrf_cli.bridge.field_bundle import stored
from fusedrf_cli.bridge.runtime import Saved, checkpoint_mismatch, resumable, take_up
from fusedrf_cli.bridge.scene import LoadedScene, background_of
from fusedrf_cli.bridge.storage_search import SearchConfig, Trial
from fusedrf_cli.bridge.training import warn_of_nonfinite
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import as_composite
from fusedrf_cli.engine.distillation.distill import DistillReport, DistillRun
from fusedrf_cli.engine.distillation.evaluation import Evaluator, EvaluatorConfig
from fusedrf_cli.engine.distillation.finetune import FinetuneRays
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.fields.base import RadianceField, StoredField
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.builder import (
    NOTHING,
    DirectBuilder,
    DistilledBuilder,
    Plan,
    StorageSetting,
)
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.kinds.instances import distinct_fields
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.volume import render_rays
from fusedrf_cli.engine.settings import current
from fusedrf_cli.requests import FuseRequest


@dataclass(frozen=True)
class BuildingConfig:
    """How students are made, and when they are saved."""

    views: int = 8
    """That a student is judged by where what is learnt does not say so."""
    rate_in_place: float = 0.02
    """Of a student that begins as a place and has only to learn what stands in it: 3 dB."""
    glance: int = 8192
    """Rays by which what a source may lose is compared."""
    worth_saving: float = 10.0
    """Seconds of learning, from which on a student is saved before it is measured."""
    tries: int = 6
    """That a search for a target makes, about."""


@dataclass(frozen=True)
class FuseScene:
    """What is to be fused."""

    loaded: LoadedScene
    composed: ComposedField
    sampler: RaySampler
    views: tuple[Camera, ...] = ()
    """Of `unbounded_views`."""

    @classmethod
    def of(cls, loaded: LoadedScene) -> "FuseScene":
        """A loaded scene."""
        composed = loaded.composed()
        views = unbounded_views(loaded, composed)
        return cls(loaded, composed, RaySampler.of(composed, views), views)

    def background(self) -> Placed:
        """The background in the composed scene's frame, its numbers on the CPU."""
        background = background_of(self.loaded).placed.moved(self.composed.origin)
        return replace(background, field=opened(background.field).to("cpu"))


Result = StoredField | ComposedField
"""What is fused: one field, or a scene of fields that are nodes, in the composed scene's frame."""


def with_fields(result: Result, change: Callable[[StoredField], StoredField]) -> Result:
    """What is fused, of other fields: what `change` makes of each."""
    return result.with_fields(change) if isinstance(result, ComposedField) else change(result)


@dataclass(frozen=True)
class BestTrial:
    """A try, its field with the very numbers that were measured, and what its learning did."""

    trial: Trial
    field: Result
    did: DistillReport | None = None
    start: str | None = None
    """What it started from."""
    own_storage: StorageSetting | None = None
    """With the precision of each of its fields; None: as it was asked for."""

    @property
    def storage(self) -> StorageSetting:
        """How it is stored."""
        return self.own_storage or self.trial.storage


def same_texels(field: StoredField, other: StoredField) -> bool:
    """Whether a field has texels where another has them, so that all of that one's detail is in it."""
    return field.voxel_size == other.voxel_size and np.array_equal(field.aabb, other.aabb)


class Maker:
    """Makes the students of one scene."""

    def __init__(
        self,
        builder: DistilledBuilder,
        scene: FuseScene,
        request: FuseRequest,
        device: str,
        progress,
        together: bool = True,
        background: Background | None = None,
    ):
        """together: whether memory holds all sources at once, and they are answered by compiled loops.
        background: that stays beside what the student makes."""
        self.builder, self.scene, self.request, self.background = builder, scene, request, background
        self.device, self.progress = device, progress
        self.budget = Budget(request.time_budget)
        distil_config = builder.distil_config or current(DistilConfig)
        compares = request.target_psnr is not None and builder.distil_config is None
        self.views = current(BuildingConfig).views if compares else distil_config.views
        size = distil_config.view_size, distil_config.view_size
        seed = current(EvaluatorConfig).judged_seed, 3, request.seed
        self.answered = as_composite if together else lambda scene: scene
        self.sources = {id(leaf.field) for leaf in scene.composed.leaves()}
        truth = self.teacher = self.answered(scene.composed)
        self.evaluation_views = evaluation_views_of(scene.loaded, truth, self.views, size, seed)
        self.sampler = scene.sampler
        if builder.scene is not scene.composed:
            self.teacher = self.answered(builder.scene)
            self.sampler = RaySampler.of(builder.scene, scene.views)
        self.evaluator = Evaluator(truth, [view.camera for view in self.evaluation_views], truth.origin)
        self.best: BestTrial | None = None
        self.finished_tries = 0
        self.lessons: dict[tuple[int, int], FinetuneRays] = {}
        self.saved: Saved | None = None
        """What an interrupted run left, until it is taken up."""
        self.glances: dict[int, FinetuneRays] = {}
        if not builder.learnt:
            builder.judged_by(self.error_of)

    def measured(self, field: Result, storage: StorageSetting) -> float:
        """PSNR (dB) of what is fused as it will be read back."""
        return self.evaluator(self.read_back(field, storage))

    def read_back(self, field: Result, storage: StorageSetting) -> RadianceField:
        """What is fused as its bundle will be drawn: with numbers as they are stored, but for fields that
        keep the bytes of their sources."""
        kept = self.background and self.background.placed.field
        fields = distinct_fields(field) if isinstance(field, ComposedField) else [field]
        precisions = {id(one): storage.precision_of(i) for i, one in enumerate(fields)}

        def back(one: StoredField) -> StoredField:
            if id(one) in self.sources:
                return one
            precision = self.background.precision if one is kept else precisions[id(one)]
            return stored(one, precision).to(self.device)

        changed = with_fields(field, back)
        return self.answered(changed) if isinstance(changed, ComposedField) else changed

    def on_device(self, field: Result, device: str) -> Result:
        """What is fused with its numbers on a device, but for the sources."""
        return with_fields(field, lambda one: one if id(one) in self.sources else one.to(device))

    def whole(self, field: StoredField) -> Result:
        """What is fused, where the student made a field of it, in the composed scene's frame."""
        return field if self.background is None else self.background.with_learnt(field)

    def evaluate(self, best: BestTrial) -> dict:
        """What the report says of the views of a try as it will be read back: how many there are, the PSNR of
        what the scene covers of them, and the object that is shown worst in a view of its own."""
        evaluation = self.evaluator.evaluate(self.read_back(best.field, best.storage))
        report = {
            "views": len(self.evaluation_views),
            "covered": evaluation.covered,
            "covered_share": evaluation.share,
        }
        objects = [
            (v, view.of) for v, view in zip(evaluation.views, self.evaluation_views, strict=True) if view.of
        ]
        if not objects:
            return report
        worst, name = min(objects)
        return report | {"worst_object": {"name": name, "psnr": worst}}

    def psnr_of_whole(self, field: StoredField) -> float:
        """PSNR (dB) of what a field is fused to, in float32."""
        full = self.whole(field)
        return self.evaluator(self.answered(full) if isinstance(full, ComposedField) else full)

    def offer(self, trial: BestTrial) -> None:
        """Keep a finished try where it is the best so far: what was measured is what will be written."""
        if trial.trial.better(self.best and self.best.trial, self.request.target_psnr):
            self.best = trial

    # -- students that are made ------------------------------------------------------------------------------

    def make(self, storage: StorageSetting, limit: int, finished: bool) -> Trial | None:
        """A student of at most `limit` bytes, finished on rays where that helps; None where not even the
        coarsest is so small."""
        builder: DirectBuilder = self.builder
        candidate = builder.build(storage, limit)
        if candidate is None:
            return None
        field, size, did = self.on_device(candidate.field, self.device), candidate.bytes, None
        own = candidate.storage or storage
        before = psnr = self.measured(self.whole(field), own)
        if finished and not candidate.exact and self.request.finetune and not self.budget.over:
            learnt, did = self.finished(field, candidate.settled)
            learnt_psnr, learnt_size = (
                self.measured(self.whole(learnt), own),
                builder.bytes_of(learnt, own),
            )
            if learnt_psnr > before and learnt_size <= limit:
                field, psnr, size = learnt, learnt_psnr, learnt_size
        trial = Trial(storage, limit, size, psnr, before, candidate.whole, candidate.exact)
        if finished or candidate.exact:
            start = self.background and self.background.start
            self.offer(BestTrial(trial, self.on_device(self.whole(field), "cpu"), did, start, own))
        return trial

    def finished(
        self, field: Result, settled: frozenset[int] = frozenset()
    ) -> tuple[Result, DistillReport | None]:
        """What was made after it learnt from rays of the scene; what is given stays as it is. settled: see
        `Candidate`."""
        seconds = self.budget.part(self.tries_to_come())
        self.finished_tries += 1
        if isinstance(field, ComposedField):
            return self.finetuned(field, seconds, settled), None
        learnt = field.with_params(field.params.clone())
        distil_config = self.builder.distil_config_for(field.params.numel(), seconds)
        settings = replace(distil_config, seed=self.request.seed)
        run = DistillRun(self.teacher, learnt, self.sampler, settings, True, evaluator=self.psnr_of_whole)
        with self.saving(run) as uninterrupted:
            student, did = run.finish(*self.telling(), uninterrupted)
        self.budget.spent += run.learnt_seconds
        warn_of_nonfinite(did.numeric, self.progress)
        return student, did

    @property
    def tries_once(self) -> bool:
        """Whether one student learns and no other."""
        return self.request.target_psnr is None and not self.builder.compares

    def saving(self, run: DistillRun):
        """What steps of a run go through, which is saved where it is the only one of its command: of others
        that came before the numbers would have to be saved as well."""
        if not self.tries_once or self.finished_tries > 1:
            return nullcontext(nullcontext)
        made_with = {"kind": self.builder.kind.name, "limit": self.request_limit}
        return self.resumed(run, made_with, self.sampler.boxes)

    def resumed(self, run: DistillRun, made_with: dict, boxes: list[np.ndarray]):
        """`resumable` for a run, which goes on from what was saved; with other words that would be something
        else."""
        made_with |= {
            "numbers": run.student.params.numel() if run.refined is None else run.refined.params.numel(),
            "rgb": self.request.finetune,
            "seed": self.request.seed,
            "boxes": [box.tolist() for box in boxes],
        }
        saved, self.saved = self.saved, None
        if saved is not None:
            if any(saved[1].get(word) != value for word, value in made_with.items()):
                raise checkpoint_mismatch(self.request.output)
            take_up(run, saved, self.request.output)

        def checkpoint() -> Saved:
            arrays, state = run.checkpoint()
            return arrays, state | made_with

        def held() -> Saved | None:
            return run.held and (run.held[0], run.held[1] | made_with)

        def learnt() -> bool:
            return run.learnt_seconds > current(BuildingConfig).worth_saving

        return resumable(self.request.output, checkpoint, held, self.progress, learnt)

    def tries_to_come(self) -> int:
        """How many tries the seconds that are left have to do for, about."""
        search = current(SearchConfig)
        config = current(BuildingConfig)
        if self.request.target_psnr is not None:
            return max(2, config.tries - self.finished_tries)  # how many a search takes is not known
        return max(1, (search.finalists if self.builder.compares else 1) - self.finished_tries)

    def finetuned(
        self, scene: ComposedField, seconds: float | None, settled: frozenset[int]
    ) -> ComposedField:
        """A scene of smaller fields, each of which learnt from rays of its own source, but for those that
        have nothing to learn."""
        pairs = zip(distinct_fields(self.scene.composed), distinct_fields(scene), strict=True)
        changed = [(source, one) for source, one in pairs if one is not source and id(one) not in settled]
        learnt = {}
        for source, one in changed:
            rays = self.rays_of(source, len(changed))
            learnt[id(one)] = own = one.with_params(one.params.clone())
            with self.budget.learning():
                rays.teach(own, seconds=None if seconds is None else seconds / len(changed))
        return scene.with_fields(lambda one: learnt.get(id(one), one))

    def rays_of(self, source: StoredField, count: int) -> FinetuneRays:
        """What there is to learn from of a source, one of so many; drawn once."""
        if (id(source), count) not in self.lessons:
            sampler = self.sampler_of(source)
            rays = FinetuneRays(opened(source), sampler, self.request.seed, share=1 / count)
            self.lessons[id(source), count] = rays
        return self.lessons[id(source), count]

    def sampler_of(self, source: StoredField) -> RaySampler:
        """Of rays around a source alone, in its own frame."""
        leaf = next(p for p in self.scene.composed.leaves() if p.field is source)
        alone = ComposedField([Placed(leaf.name, source, np.eye(4))], origin=np.zeros(3))
        views = [view.seen_from(leaf.object_to_world) for view in self.scene.views if leaf.unbounded]
        return RaySampler.of(alone, views)

    def error_of(self, source: StoredField, made: StoredField, precision: str | None) -> float:
        """See `DirectBuilder.judged_by`; over white."""
        if id(source) not in self.glances:
            rays = current(BuildingConfig).glance
            glance = FinetuneRays(opened(source), self.sampler_of(source), self.request.seed, rays)
            self.glances[id(source)] = glance
        glance = self.glances[id(source)]
        back = (made if precision is None else stored(made, precision)).to(self.device)
        off = render_rays(back, glance.rays_o, glance.rays_d)[:, :4] - glance.shown
        return float(np.square(off[:, :3] - off[:, 3:]).mean())

    # -- students that learn from nothing --------------------------------------------------------------------

    def learn(self) -> Iterator[Trial]:
        """Students of growing size, each from what the one before has learnt, in every precision."""
        before: StoredField | None = None
        storage_settings = [storage for group in self.builder.storage_settings() for storage in group]
        plans = list(self.builder.plans())
        for i, plan in enumerate(plans):
            if before is not None and self.budget.over:
                return
            begun, start, changes = self.init(plan, before)
            grown = self.saved is not None and self.saved[1].get("numbers") != begun.params.numel()
            if grown and len(plans) > 1:
                continue  # the run that was interrupted had grown further
            field, did = self.taught(begun.to(self.device), start, changes, len(plans) - i)
            before = field.to("cpu")
            full = self.whole(before)
            for storage in storage_settings:
                size = self.builder.bytes_of_plan(plan, storage)
                limit = self.request_limit if plan is plans[-1] and storage == storage_settings[-1] else size
                psnr = self.measured(full, storage)
                trial = Trial(storage, limit, size, psnr, did.psnr_before_rgb, False)
                self.offer(BestTrial(trial, full, did, start))
                yield trial
        if before is None:
            raise checkpoint_mismatch(self.request.output)

    @property
    def request_limit(self) -> int:
        """Bytes of the file that were allowed."""
        return self.builder.request.limit

    def init(self, plan: Plan, before: StoredField | None) -> tuple[StoredField, str, dict]:
        """A student before it learns, what it starts from, and what that changes of how it learns."""
        config = current(BuildingConfig)
        generator = torch.Generator().manual_seed(self.request.seed)
        warm = before is None and self.builder.kind.warm_starts and not self.request.from_scratch
        if self.background is not None:
            field, start = self.builder.init(plan, before, None, generator)
            return field, start if before is not None else self.background.start, {}
        background = self.scene.background() if warm else None
        field, start = self.builder.init(plan, before, background, generator)
        if warm and start == NOTHING:
            self.progress.warn(
                f"'{background.name}' is of another kind, turned, stretched or tinted, so the student starts "
                "from nothing"
            )
        warm_start = warm and start != NOTHING and same_texels(field, background.field)
        return field, start, {"coarse_from": None, "rate": config.rate_in_place} if warm_start else {}

    def taught(
        self, field: StoredField, start: str, changes: dict, tries: int
    ) -> tuple[StoredField, DistillReport]:
        """A student that has learnt; an interrupt saves a checkpoint."""
        request, seconds = self.request, self.budget.part(tries)
        config = self.builder.distil_config_for(field.params.numel(), seconds)
        config = replace(config, seed=request.seed, **changes)
        run = DistillRun(
            self.teacher, field, self.sampler, config, request.finetune, evaluator=self.psnr_of_whole
        )
        # one that grows to a target goes on from whatever it started from
        made_with = {"kind": self.builder.kind.name, "start": start if request.target_psnr is None else None}
        with self.resumed(run, made_with, self.sampler.boxes) as uninterrupted:
            student, did = run.finish(*self.telling(), uninterrupted)
        self.budget.spent += run.learnt_seconds
        warn_of_nonfinite(did.numeric, self.progress)
        if did.found_nothing:
            self.progress.warn(
                "the student has no density yet; no cell was given up. Give it more --time-budget"
            )
        return student, did

    def telling(self):
        """What a run tells of its phases and of how far it is."""
        return (
            lambda name: self.progress.phase(name, 1.0),
            lambda share, figures: self.progress.advance(share, **figures),
        )
