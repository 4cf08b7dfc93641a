"""`fuse --kind sparse`: a scene resampled to bricks, and finished by learning."""

import time
from dataclasses import asdict, replace

import numpy as np

from fusedrf_cli.bridge.train import BYTES_PER_NUMBER, warn_of_numbers
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.detail import tensor_details
from fusedrf_cli.engine.composition.resample import resampled
from fusedrf_cli.engine.distillation.distill import DistillRun, DistillSettings, Judge, Recipe
from fusedrf_cli.engine.fields.sparse import SparseField, SparseShape

BYTES_PER_BRICK = 10  # masks and nodes
VERTICES_PER_BRICK = 25  # at least, in scenes of surfaces
FINISH = DistillSettings(rays=150_000, steps=0, rgb_steps=400)  # what was asked needs no learning from points
RECIPE = Recipe(rgb_rate=0.015)


def fuse_sparse(
    composed: ComposedField, limit: int, precision: str, settings: DistillSettings, rgb: bool, place: str, progress
) -> tuple[SparseField, dict]:
    """The scene as a sparse field of at most `limit` bytes, learnt further where that makes it better."""
    progress.phase("bricks", None)
    started = time.monotonic()
    shape = SparseShape(settings.shape.sh_degree)
    each = BYTES_PER_NUMBER[precision] + BYTES_PER_BRICK / (4 * VERTICES_PER_BRICK)
    field = resampled(composed, shape, int(limit / each)).to(place)
    seconds = {"bricks": time.monotonic() - started}
    if rgb:
        boxes = [composed.occupancy.tight_aabb(0), *sorted((p.aabb for p in composed.placed), key=list)]
        finish = replace(FINISH, seed=settings.seed, time_budget=settings.time_budget)
        run = DistillRun(composed, field, boxes, finish, recipe=RECIPE)
        field, did = run.finish(lambda name: progress.phase(name, 1.0), lambda s, f: progress.advance(s, **f))
        found = {"before_rgb": did.psnr_before_rgb, "after_rgb": did.psnr_after_rgb, "rgb_kept": did.rgb_kept}
        seconds |= did.seconds
        warn_of_numbers(did.numeric, progress)
    else:
        progress.phase("measuring", None)
        judge = Judge(composed, settings.views, settings.view_size, settings.seed)
        found = {"before_rgb": judge(field), "after_rgb": None}
        seconds["measuring"] = time.monotonic() - started - seconds["bricks"]
    level = field.tree.level
    levels = [
        {"voxel": float(field.voxel_size * 2 ** (field.tree.depth - n)), "bricks": int(np.count_nonzero(level == n))}
        for n in range(field.tree.depth + 1)
    ]
    details = tensor_details(composed.placed, field.voxel_size)
    return field, {
        "psnr": found | {"views": settings.views},
        "seconds": seconds,
        "chosen": {
            "levels": levels,
            "sh_degree": shape.sh_degree,
            "vertices": field.fine.free,
            "why": f"voxels as wide as each object needs where that fits, under {limit} bytes",
        },
        "objects": [asdict(d) for d in details],
    }
