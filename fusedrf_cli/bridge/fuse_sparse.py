"""A scene to bricks: resampled under a size, or in the smallest way that shows enough, and learnt further."""

import time
from dataclasses import replace

import numpy as np
import torch

from formats.records import BYTES_PER_NUMBER, FieldRecord, as_stored, encode_field
from fusedrf_cli.bridge.choose import Choosing, Tried, Way
from fusedrf_cli.bridge.fusing import Asked, Fused
from fusedrf_cli.bridge.memory import judged, learning, ownership, result, teaching
from fusedrf_cli.bridge.sizes import HEADER
from fusedrf_cli.bridge.train import check_size
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.detail import Detail, extent, opacity_off
from fusedrf_cli.engine.composition.resample import TooFewNumbers, resampled
from fusedrf_cli.engine.distillation.distill import DistillReport, DistillRun, Recipe
from fusedrf_cli.engine.distillation.judging import Judge
from fusedrf_cli.engine.distillation.settings import DistillSettings
from fusedrf_cli.engine.kinds.sparse.bodies import SIDE
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape

POINTS = 3_000_000  # that are kept of the teacher's answers, about
PADDED = 1.6  # floats in memory for each number that is stored: rows are padded, hanging vertices too
WHOLE_BELOW = 0.8  # of the numbers allowed: less are taken where no object needs more
PER_NUMBER_FILLED = 130  # bytes, as seen: keys, places, indices and least squares of a vertex
BYTES_PER_BRICK = 10  # masks and nodes
VERTICES_PER_BRICK = 25  # at least, in scenes of surfaces
FINISH = DistillSettings(rays=150_000, steps=0, rgb_steps=400)  # what was asked needs no learning from points
RECIPE = Recipe(rgb_rate=0.015)
CHEAP_FIRST = ("int8", "float16")
FAITHFUL = "int8"  # measured: not 0.01 dB less than float16, in half the bytes
DEGREE = 1  # measured at 5 million numbers: 35.7 dB, where a second degree leaves room for 34.0
BANDS = (0, 1, 2)
LEAST_BYTES = 20_000  # told where nothing fits: a few hundred vertices and what tells where they are
GAIN = 8.0  # dB that learning may add at most


class SparseMaker:
    """Makes, stores and measures sparse fields of one scene."""

    def __init__(self, composed: ComposedField, asked: Asked, place: str, progress):
        self.composed, self.asked, self.place, self.progress = composed, asked, place, progress
        self.settings = replace(FINISH, seed=asked.seed, time_budget=asked.time_budget)
        self.judge = Judge(composed, FINISH.views, FINISH.view_size, asked.seed)
        self.last: tuple[Tried, SparseField, DistillReport | None] | None = None

    def try_way(self, way: Way, limit: int, finished: bool) -> Tried | None:
        """Bricks of at most `limit` bytes; None where not even the widest voxels fit."""
        numbers = numbers_within(limit - self.asked.overhead, way.precision)
        try:
            field = resampled(self.composed, SparseShape(way.sh_degree), numbers).to(self.place)
        except TooFewNumbers:
            return None
        size = self.asked.overhead + file_bytes(field, way.precision)
        if size > limit:
            return None
        before = psnr = self.judge(stored_sparse(field, way.precision))
        did = None
        if finished and self.asked.rgb:
            kept = field.params.clone()
            did = self.learn(field)
            psnr = self.judge(stored_sparse(field, way.precision))
            learnt_size = self.asked.overhead + file_bytes(field, way.precision)
            if psnr > before and learnt_size <= limit:
                size = learnt_size
            else:
                field.params.copy_(kept)
                psnr = before
        whole = field.numbers < WHOLE_BELOW * numbers
        tried = Tried(way, limit, size, psnr, before, whole)
        self.last = tried, field, did
        return tried

    def learn(self, field: SparseField) -> DistillReport:
        """Teach the field, in place, from points and rays of the scene."""
        composed = self.composed
        # in an order that does not depend on the nodes', so that equal scenes draw equal rays
        boxes = [composed.occupancy.tight_aabb(0), *sorted((p.aabb for p in composed.placed), key=list)]
        run = DistillRun(composed, field, boxes, self.settings, True, RECIPE, self.judge)
        tell = self.progress
        return run.finish(lambda name: tell.phase(name, 1.0), lambda s, f: tell.advance(s, **f))[1]

    def field_of(self, tried: Tried) -> tuple[SparseField, DistillReport | None]:
        """The field of an earlier try and what its learning did; made again where another was tried since."""
        if self.last is None or self.last[0] != tried:
            self.try_way(tried.way, tried.limit, True)
        return self.last[1:]


def stored_sparse(field: SparseField, precision: str) -> SparseField:
    """The field as it will come back from a bundle of that precision."""
    back = field.with_params(field.params.clone())
    held = {"rows": (back.rows, back.fine)} | ({"bands": (back.bands, back.coarse)} if back.coarse else {})
    for name, (view, lattice) in held.items():
        free = view[: lattice.free]
        free.copy_(torch.from_numpy(as_stored(free.cpu().numpy(), precision, name)))
    back.settle()
    return back


def file_bytes(field: SparseField, precision: str) -> int:
    """Bytes of the field in a bundle."""
    return len(encode_field(FieldRecord(field.kind, *field.state()), precision))


def numbers_within(limit: int, precision: str) -> int:
    """How many numbers a file of so many bytes holds beside its bricks' masks."""
    each = BYTES_PER_NUMBER[precision] + BYTES_PER_BRICK / (4 * VERTICES_PER_BRICK)
    return max(0, int((limit - HEADER) / each))


def ways(asked: Asked) -> list[list[Way]]:
    """The ways that are left to choose from, in groups of one precision, the cheapest first."""
    precisions = [asked.precision] if asked.precision else CHEAP_FIRST
    bands = BANDS if asked.sh_degree is None else [asked.sh_degree]
    return [[Way(p, None, b) for b in bands] for p in precisions]


def fuse_sparse(composed: ComposedField, asked: Asked, place: str, progress) -> Fused:
    """The scene as a sparse field, in the way that was asked for or found.

    UsageProblem where not even the widest voxels fit the limit.
    """
    started, seconds = time.monotonic(), {}
    progress.phase("measuring", None)
    maker = SparseMaker(composed, asked, place, progress)
    choosing = Choosing(maker.try_way, "sparse", progress.note)
    seconds["measuring the scene"] = time.monotonic() - started
    progress.phase("bricks", None)
    chosen = choose(maker, choosing, asked)
    field, did = maker.field_of(chosen)
    seconds["bricks"] = time.monotonic() - started - seconds["measuring the scene"]
    neighbours = choosing.neighbours(chosen) if asked.target is not None else {}
    figures = {
        "psnr": {
            "before_rgb": chosen.before,
            "after_rgb": chosen.psnr if chosen.psnr > chosen.before else None,
            "stored": chosen.psnr,
            "views": FINISH.views,
        },
        "seconds": seconds | (did.seconds if did is not None else {}),
        "chosen": {
            "levels": levels(field),
            "sh_degree": field.shape.sh_degree,
            "vertices": field.fine.free,
            "precision": chosen.way.precision,
            "flags": chosen.way.flags("sparse", chosen.limit),
            "why": f"voxels as wide as each object needs where that fits, under {chosen.limit} bytes",
            **neighbours,
        },
    }
    return Fused(field, chosen.way.precision, figures, details(composed, field), "a larger --max-size")


def choose(maker: SparseMaker, choosing: Choosing, asked: Asked) -> Tried:
    """The way to store the scene."""
    found = None
    if asked.target is not None:
        found = choosing.smallest_reaching(ways(asked), asked.target, asked.limit, GAIN if asked.rgb else 0.0)
    if found is None:
        degree = DEGREE if asked.sh_degree is None else asked.sh_degree
        found = choosing.make(Way(asked.precision or FAITHFUL, None, degree), asked.limit, True)
    if found is None:
        check_size(LEAST_BYTES, min(asked.limit, LEAST_BYTES - 1))
    return found


def levels(field: SparseField) -> list[dict]:
    """For the report: the voxel and the bricks of every level."""
    level, depth = field.tree.level, field.tree.depth
    return [
        {"voxel": float(field.voxel_size * 2 ** (depth - n)), "bricks": int(np.count_nonzero(level == n))}
        for n in range(depth + 1)
    ]


def held_voxels(composed: ComposedField, field: SparseField) -> list[float]:
    """The side of the voxels that hold most of each placed object."""
    tree, found = field.tree, []
    for p in composed.placed:
        centres = p.field.occupancy.centres() @ p.object_to_world[:3, :3].T + p.object_to_world[:3, 3]
        halves = 2 * np.floor((centres - tree.lo) / tree.unit).astype(np.int64) + 1
        inside = ((halves > 0) & (halves < 2 * (field.aabb[3:] - tree.lo) / tree.unit)).all(1)
        brick = tree.voxels_at(halves[inside], SIDE, field.fine.active)[0]
        level = tree.level[brick[brick >= 0]].astype(np.int64)
        depth = np.median(level) if len(level) else 0
        found.append(float(field.voxel_size * 2.0 ** (tree.depth - depth)))
    return found


def details(composed: ComposedField, field: SparseField) -> list[Detail]:
    """What bricks hold of placed objects."""
    voxels = held_voxels(composed, field)
    return [
        Detail(p.name, p.condition, opacity_off(p.condition), p.voxel_size, v, extent(p) / v)
        for p, v in zip(composed.placed, voxels, strict=True)
    ]


def sparse_memory(composed: ComposedField, asked: Asked) -> list[tuple[float, dict[str, float]]]:
    """The stages of resampling a scene to bricks: asking, measuring, learning."""
    numbers = numbers_within(asked.limit, asked.precision or FAITHFUL)
    grids = ownership(composed.aabb) | judged()
    filling = {"vertices while they are found and filled": PER_NUMBER_FILLED * numbers}
    return [
        (0.0, filling | grids),
        (0.0, result(int(PADDED * numbers)) | grids),
        (0.0, learning(int(PADDED * numbers), torch.get_num_threads()) | teaching(FINISH, POINTS) | grids),
    ]
