"""A scene to blocks: as they are where they fit, else in the way that shows most under a size, or in the
smallest that shows enough.
"""

import time
from collections.abc import Sequence

import torch

from formats.records import BYTES_PER_NUMBER
from fusedrf_cli.bridge.choose import Choosing, Tried, Way
from fusedrf_cli.bridge.fusing import Asked, Fused, make_room
from fusedrf_cli.bridge.memory import (
    FLOAT,
    RESAMPLING,
    TRUNCATING,
    Memory,
    judged,
    learning,
    lesson,
    ownership,
    result,
)
from fusedrf_cli.bridge.scene import LoadedScene, stored
from fusedrf_cli.bridge.sizes import vm_bytes
from fusedrf_cli.bridge.train import check_size
from fusedrf_cli.engine.composition.blocks import blocks_of
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.detail import block_details
from fusedrf_cli.engine.composition.trimming import without_unread
from fusedrf_cli.engine.distillation.finish import RAYS, RayLesson
from fusedrf_cli.engine.distillation.judging import Judge
from fusedrf_cli.engine.distillation.settings import DistillSettings
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kernels import working_time
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape, VMTensor

# Fewer density components cost least and fewer colour components most (docs/how-fusing-works.md).
RANKS = ((8, 16), (8, 24), None)
CHEAP_FIRST = ("int4", "int8", "float16")
UNREDUCED = VMShape(1024, 1024, 3)
FINISHING_GAIN = 5.0  # dB, the most that was seen
PRECISE = "float16"
VIEWS_TO_CHOOSE_BY = 8


def ways(asked: Asked) -> list[list[Way]]:
    """The ways that are left to choose from, in groups of one precision, the cheapest first."""
    precisions = [asked.precision] if asked.precision else CHEAP_FIRST
    ranks = [asked.ranks] if asked.ranks else RANKS
    return [[Way(p, r, asked.sh_degree) for r in ranks] for p in precisions]


def plain_way(asked: Asked) -> Way:
    """The way that leaves most as it is."""
    return Way(asked.precision or PRECISE, asked.ranks, asked.sh_degree)


class BlocksMaker:
    """Makes, stores and measures the blocks of one scene."""

    def __init__(self, composed: ComposedField, asked: Asked, whole_in_memory: bool, place: str):
        self.composed, self.asked, self.place = composed, asked, place
        views = VIEWS_TO_CHOOSE_BY if asked.target is not None else DistillSettings.views
        self.judge = Judge(composed, views, DistillSettings.view_size, asked.seed)
        self.views, self.whole_in_memory, self._lesson = views, whole_in_memory, None
        self.started = working_time()
        # once, since a source that memory does not hold is read again whenever it is opened
        self.blocks = sum(len(opened(p.field).blocks) for p in composed.placed)
        self.last: tuple[Tried, VMField] | None = None

    def try_way(self, way: Way, limit: int, finished: bool) -> Tried | None:
        """Blocks of at most `limit` bytes; None where not even the coarsest are that small."""
        field, bytes_, whole = self.make(way, limit)
        if bytes_ > limit:
            return None
        before = psnr = self.measured(field, way)
        if finished and self.learns() and not (whole and way.ranks is None):
            learnt = field.with_params(field.params.clone())
            self.lesson().teach(learnt)
            psnr = self.measured(learnt, way)
            field, psnr = (learnt, psnr) if psnr > before else (field, before)
        tried = Tried(way, limit, bytes_, psnr, before, whole)
        self.last = tried, field
        return tried

    def learns(self) -> bool:
        """Whether finishing was asked for and there is time left for it."""
        budget = self.asked.time_budget
        return self.asked.rgb and (budget is None or working_time() - self.started < budget)

    def field_of(self, tried: Tried) -> VMField:
        """The field of an earlier try; made again where another was tried since."""
        if self.last is None or self.last[0] != tried:
            self.try_way(tried.way, tried.limit, True)
        return self.last[1]

    def make(self, way: Way, limit: int) -> tuple[VMField, int, bool]:
        """Blocks before learning, their bytes, and whether they keep their own resolution."""
        ranks = self.shape_of(way)
        sizes = []

        def fits(shape: VMShape, tensors: list[VMTensor]) -> bool:
            sizes.append(self.bytes_of(shape, tensors, way))
            return sizes[-1] <= limit

        field = blocks_of(self.composed.placed, fits, ranks)
        whole = sizes[0] <= limit  # the first that is asked is their own resolution
        bytes_ = self.bytes_of(field.shape, field.tensors, way)
        return field if whole and way == Way(PRECISE) else without_unread(field), bytes_, whole

    def bytes_of(self, shape: VMShape, tensors: Sequence[VMTensor], way: Way) -> int:
        """Bytes of the file with blocks over such tensors."""
        return self.asked.overhead + vm_bytes(shape, tensors, self.blocks, way.precision)

    def shape_of(self, way: Way) -> VMShape | None:
        """The most ranks and bands that a way keeps, None for all."""
        if way.ranks is None and way.sh_degree is None:
            return None
        ranks = way.ranks or (UNREDUCED.density_rank, UNREDUCED.colour_rank)
        return VMShape(*ranks, UNREDUCED.sh_degree if way.sh_degree is None else way.sh_degree)

    def measured(self, field: VMField, way: Way) -> float:
        """PSNR (dB) of the field as it will be read back."""
        return self.judge(stored(field, way.precision).to(self.place))

    def lesson(self) -> RayLesson:
        """What there is to learn from: the blocks as they are, which render fast, or the composed scene where
        memory does not hold them."""
        if self._lesson is None:
            composed = self.composed
            teacher = blocks_of(composed.placed) if self.whole_in_memory else composed
            # in an order that does not depend on the nodes', so that equal scenes draw equal rays
            boxes = [composed.occupancy.tight_aabb(0), *sorted((p.aabb for p in composed.placed), key=list)]
            self._lesson = RayLesson(teacher, boxes, self.asked.seed)
        return self._lesson


def fuse_blocks(composed: ComposedField, asked: Asked, whole_in_memory: bool, place: str, progress) -> Fused:
    """The scene as blocks, in the way that was asked for or found.

    UsageProblem where not even the coarsest blocks fit the limit.
    """
    started, seconds = time.monotonic(), {}

    def lap(name: str) -> None:
        seconds[name] = time.monotonic() - started - sum(seconds.values())

    maker = BlocksMaker(composed, asked, whole_in_memory, place)
    choosing = Choosing(maker.try_way, "blocks", progress.note)
    lap("measuring the scene")
    progress.phase("blocks", None)
    chosen = choose(maker, choosing, asked, progress)
    field = maker.field_of(chosen)
    lap("blocks")
    neighbours = choosing.neighbours(chosen) if len(choosing.tried) > 1 else {}
    lap("neighbours")
    figures = {
        "psnr": {
            "before_rgb": chosen.before,
            "after_rgb": chosen.psnr if chosen.psnr > chosen.before else None,
            "stored": chosen.psnr,
            "views": maker.views,
        },
        "seconds": seconds,
        "chosen": {
            "resolution": [list(t.resolution) for t in field.tensors],
            "ranks": [field.shape.density_rank, field.shape.colour_rank],
            "sh_degree": field.shape.sh_degree,
            "precision": chosen.way.precision,
            "flags": chosen.way.flags("blocks", chosen.limit),
            "why": why(composed, field, chosen, asked, len(choosing.tried)),
            **neighbours,
        },
    }
    details = block_details(composed.placed, field)
    return Fused(field, chosen.way.precision, figures, details, "a larger --max-size")


def choose(maker: BlocksMaker, choosing: Choosing, asked: Asked, progress) -> Tried:
    """The way to store the blocks."""
    if asked.target is None:
        way = plain_way(asked)
        plain = maker.try_way(way, asked.limit, way.ranks is not None)
        if plain is not None and plain.whole:
            return plain
    groups = ways(asked)
    progress.phase("choosing", None)
    found = None
    if asked.target is not None:
        gain = FINISHING_GAIN if asked.rgb else 0.0
        found = choosing.smallest_reaching(groups, asked.target, asked.limit, gain)
    if found is None:
        found = choosing.best_within([way for group in groups for way in group], asked.limit)
    if found is None:
        cheapest = min((way for group in groups for way in group), key=lambda way: maker.make(way, 1)[1])
        check_size(maker.make(cheapest, 1)[1], asked.limit)
    return found


def why(composed: ComposedField, field: VMField, chosen: Tried, asked: Asked, tried: int) -> str:
    """One sentence on the choice."""
    own = len({id(p.field) for p in composed.placed})
    blocks = f"{len(field.blocks)} blocks over {own} fields, each in its object's own axes"
    if asked.target is not None and chosen.psnr >= asked.target:
        return f"{blocks}: the smallest that reaches {asked.target:g} dB, of {tried} choices tried"
    if tried:
        return f"{blocks}: the best under {asked.limit} bytes, of {tried} choices tried"
    return f"{blocks}, as the sources have them"


def blocks_memory(budget: Memory, loaded: LoadedScene, composed: ComposedField, asked: Asked) -> bool:
    """Make room for compiling a scene to blocks: putting together, measuring, learning. Whether all sources
    together may be in memory as a teacher."""
    own = sum(loaded.sizes) // FLOAT
    grids = ownership(composed.aabb)
    chosen = asked.target is not None or own * BYTES_PER_NUMBER[asked.precision or PRECISE] > asked.limit
    cheapest = asked.precision or (CHEAP_FIRST[0] if chosen else PRECISE)
    numbers = min(own, int(asked.limit / BYTES_PER_NUMBER[cheapest]))
    copies = TRUNCATING if chosen else RESAMPLING
    threads = torch.get_num_threads()
    learnt = learning(numbers, threads) | lesson(RAYS) | grids if asked.rgb else {}
    make_room(
        budget,
        loaded,
        (copies, result(numbers, measured=False) | grids),
        (0.0, result(numbers) | grids | judged()),
        (0.0, learnt),
    )
    return budget.room(learnt) > sum(loaded.sizes) + FLOAT * own
