"""What the report of `fuse` says of what was made."""

import time

from fusedrf_cli.bridge.background import Background
from fusedrf_cli.bridge.building import BestTrial, FuseScene, Maker, Result
from fusedrf_cli.bridge.storage_search import StorageSearch, flags
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.kinds.builder import DistilledBuilder
from fusedrf_cli.engine.kinds.instances import distinct_fields
from fusedrf_cli.errors import QualityNotReached
from fusedrf_cli.requests import FuseRequest


def fused_entry(
    request: FuseRequest, kind: str, composition: str, best: BestTrial, builder: DistilledBuilder
) -> dict:
    """What a bundle's history tells of a fuse."""
    settings = {"seed": request.seed, "max_size": builder.request.limit, "rgb": request.finetune}
    settings |= {"from_scratch": request.from_scratch}
    named = {"event": "fused", "kind": kind, "composition": composition}
    return named | {"settings": settings, "psnr": reached_by(best, builder)}


def reached_by(best: BestTrial, builder: DistilledBuilder) -> dict:
    """The dB that a choice reached on the views that it was chosen by."""
    trial, did = best.trial, best.did
    learnt = did is not None and builder.learnt
    after = did.psnr_after_rgb if learnt else trial.psnr if trial.psnr > trial.before else None
    psnr = {"before_rgb": trial.before, "after_rgb": after}
    return psnr | ({"rgb_kept": did.rgb_kept} if learnt else {}) | {"stored": trial.psnr}


def figures_of(best: BestTrial, maker: Maker, choosing: StorageSearch, seconds: dict[str, float]) -> dict:
    """What the report says of a choice."""
    trial, did, builder, request = best.trial, best.did, maker.builder, maker.request
    learnt = did is not None and builder.learnt
    count = len(choosing.trials)
    started = time.monotonic()
    neighbours = {}
    if builder.learnt and count > 1:
        neighbours = {"next_smaller": choosing.trials[-2].report(builder.kind.name)}
    elif not builder.learnt and (count > 1 or request.target_psnr is not None) and not maker.budget.over:
        neighbours = choosing.neighbours(trial)
        seconds["neighbours"] = time.monotonic() - started
    figures = {
        "psnr": reached_by(best, builder) | maker.evaluate(best),
        "seconds": seconds | (did.seconds if did is not None else {}),
    }
    if learnt:
        figures["steps"] = did.steps
        figures["curve"] = [dict(zip(("seconds", "steps", "psnr"), p, strict=True)) for p in did.curve]
    chosen = chosen_of(best, builder, maker.scene, count, neighbours, maker.background)
    return figures | chosen | (did.numeric if did is not None else {})


def chosen_of(
    best: BestTrial,
    builder: DistilledBuilder,
    scene: FuseScene,
    count: int,
    neighbours: dict,
    background: Background | None = None,
) -> dict:
    """What the report says of what was chosen, of so many choices, and of how many nodes it is."""
    field, trial = best.field, best.trial
    nodes = len(field.leaves()) if isinstance(field, ComposedField) else 1
    fields = len(distinct_fields(field)) if isinstance(field, ComposedField) else 1
    own = field if background is None else field.placed[1].field
    return {
        "nodes": nodes,
        "fields": fields,
        "chosen": {
            **builder.kind.describe(own),
            **precisions(best),
            "flags": flags(builder.kind.name, trial.storage, trial.limit),
            "why": why(best, own, builder, count, background),
            **({"start": best.start} if best.start else {}),
            "voxel": float(own.voxel_size),
            "finest_teacher_voxel": float(scene.composed.voxel_size),
            **neighbours,
        },
    }


def precisions(best: BestTrial) -> dict:
    """How the numbers of what was chosen are stored: of all, or of every field."""
    each = [precision or "as it is" for precision in best.storage.each]
    if not each:
        return {"precision": best.storage.precision}
    return {"precision": each[0]} if len(set(each)) == 1 else {"precisions": each}


def why(
    best: BestTrial,
    field: Result,
    builder: DistilledBuilder,
    count: int,
    background: Background | None = None,
) -> str:
    """One sentence on the choice of a field."""
    what, target = builder.why(field), builder.request.target
    if background is not None:
        name, kind = background.placed.name, builder.kind.name
        what = f"'{name}' as it is, and one {kind} field for all that stands in it"
    if target is not None and best.trial.psnr >= target:
        return f"{what}: the smallest that reaches {target:g} dB, of {count} choices tried"
    if count > 1:
        return f"{what}: the best under {builder.request.limit} bytes, of {count} choices tried"
    if best.trial.exact:
        return f"{what}, as the sources have them"
    return f"{what}, under {builder.request.limit} bytes"


def check_target(report: dict, target_psnr: float | None, output: str) -> None:
    """QualityNotReached, after the output was written, where a target was given and missed."""
    reached = report["psnr"]["stored"]
    if target_psnr is not None and reached < target_psnr:
        raise QualityNotReached(
            f"{output}: reached {reached:.2f} dB where --target-psnr asked for {target_psnr:g}; give more "
            "--max-size or --time-budget",
            report=report,
        )
