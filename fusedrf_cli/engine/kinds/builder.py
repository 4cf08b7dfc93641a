"""How a kind of field stands for a composed scene: the ways and sizes it can be made in, and how it learns.

Bytes are told by whoever knows files (`StoredSizes`): nothing here does.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.resolution_report import ResolutionReport
from fusedrf_cli.engine.encodings.hash_runs import HashGrid
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import texels
from fusedrf_cli.engine.kinds.distil_config import DistilConfig, mostly_pictures
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.settings import current

if TYPE_CHECKING:
    from fusedrf_cli.engine.kinds.kind import Kind


@dataclass(frozen=True)
class BuilderConfig:
    """How large a student is, and how much it is told."""

    least_texels: int = 16
    """Along the longest axis: no student is coarser."""
    growth: int = 2
    """Of the numbers, from one size to the next."""
    smallest: int = 32
    """Times fewer numbers than the limit allows: where growing begins."""
    shrink: float = 0.98
    """Steps in which a size is looked for that fits."""
    told_numbers: int = 12_000_000
    """Of a student, for which a lesson's rays do."""
    numbers_per_second: int = 1_000_000
    """Four objects after 5, 15, 45 s: best with 6, 12, 25 of 3, 6, 12, 25 million."""
    rays_per_second: int = 40_000
    """That are asked for each second of learning."""
    most_rays: int = 4_800_000
    """That pictures are learnt from."""
    most_told: float = 2.0
    """Four objects in 24 million: 36.4 dB by one lesson, 36.9 by twice the steps, 38.1 by all."""
    patient: float = 150.0
    """Seconds of learning from which it is told more still, in proportion, ..."""
    most_patient: float = 2.0
    """... up to so many times: the same four after five minutes 34.8 dB without, 36.0 with it."""
    most_shown: float = 12.0
    """Times the rays of a lesson of pictures alone, which are rendered quickly, where there is time, ..."""
    most_faster: float = 5.0
    """... and, up to so many, its rate: a chair of `cp` in `dense` 39.8 dB by one lesson, 42.2 by six, 43.3
    by twelve at five times the rate, which with one lesson takes 1 dB."""


EACH = "each"  # in place of a precision: every field of a scene has one of its own
NOTHING = "nothing"  # what a student starts from that takes over no numbers


@dataclass(frozen=True)
class StorageSetting:
    """A way to hold a scene, but for its size."""

    precision: str = "float16"
    """How numbers are stored."""
    ranks: tuple[int, int] | None = None
    """Density and colour components per mode at most; None: as the kind or the sources have them."""
    sh_degree: int | None = None
    """SH degree at most; None: as the kind or the sources have it."""
    hashed: HashGrid | None = None
    """What is finer than the grid, of kinds that can have it."""
    each: tuple[str, ...] = ()
    """Of the distinct fields of a scene, where each has a precision of its own; "": its source's bytes."""

    def precision_of(self, i: int) -> str:
        """Of the i-th distinct field of a scene."""
        return self.each[i] if self.each else self.precision


@dataclass(frozen=True)
class Section:
    """An array of numbers that a field is stored with."""

    name: str
    shape: tuple[int, ...]
    used: np.ndarray | None = None
    """Bool, of the first two axes: where the array may hold numbers other than 0; None: everywhere."""


@dataclass(frozen=True)
class Contents:
    """What a field is stored with, before its numbers are made."""

    sections: Sequence[Section]
    bits: int = 0
    """Of all its masks."""
    parts: int = 1
    """Tensors, say, that its metadata tell of."""
    placements: int = 1
    """Of parts in its frame."""


def numbers_in(sections: Sequence[Section]) -> int:
    """How many numbers are stored."""
    return sum(math.prod(section.shape) for section in sections)


class StoredSizes(Protocol):
    """Bytes of what is stored."""

    def of(self, contents: Contents, precision: str) -> int:
        """At most so many bytes for a field of those contents."""
        ...

    def exactly(self, field: StoredField, precision: str) -> int:
        """The bytes of a field."""
        ...

    def per_number(self, precision: str) -> float:
        """About so many bytes for a number."""
        ...


@dataclass(frozen=True)
class BuildRequest:
    """What is asked of a student; None is left to choose."""

    sizes: StoredSizes
    limit: int
    """Bytes of the file."""
    overhead: int = 0
    """Bytes of the file besides the field."""
    target: float | None = None
    """PSNR in dB to be reached with the fewest bytes."""
    precision: str | None = None
    ranks: tuple[int, int] | None = None
    sh_degree: int | None = None
    source_bytes: tuple[int, ...] = ()
    """In memory, of the distinct sources."""
    stored_bytes: Mapping[int, int] = field(default_factory=dict)
    """Of distinct sources that their files have as they are, by the field's id."""
    unchanged_bytes: int | None = None
    """Of all sources as their files have them, where that is known."""
    seconds: float | None = None
    """Of learning; None: as many as its lesson takes."""
    from_scratch: bool = False
    """Whether to take over no numbers."""
    views: tuple[Camera, ...] = ()
    """In the scene's frame, from where a place that stands in it was photographed, with few pixels each."""


class TooSmall(ValueError):
    """The limit on bytes is under what the coarsest student takes."""

    def __init__(self, smallest: int):
        """smallest: bytes of the file with the coarsest student."""
        super().__init__(f"the coarsest takes {smallest} bytes")
        self.smallest = smallest


@dataclass(frozen=True)
class Suitability:
    """Whether a kind can hold a scene, and how well."""

    score: float | None
    """None: not at all. `auto` takes the highest; a kind of 0 is only taken where it is asked for."""
    why: str
    """One clause, after which a sentence can go on."""


@dataclass(frozen=True)
class Plan:
    """A field on a grid that is to be made."""

    storage: StorageSetting
    box: np.ndarray
    """(6,) float64."""
    resolution: tuple[int, int, int]
    """Texels per axis, corners on the faces of the box."""
    numbers: int
    """In memory."""
    allowed: int
    """Numbers it may have."""
    sections: Sequence[Section]

    @property
    def voxel(self) -> float:
        """Finest texel spacing."""
        return float(((self.box[3:] - self.box[:3]) / (np.asarray(self.resolution) - 1)).min())

    def contents(self, bits: int) -> Contents:
        """What it is stored with, beside so many bits of occupancy."""
        return Contents(self.sections, bits)


@dataclass(frozen=True)
class Candidate:
    """A student that was made without learning."""

    field: StoredField
    bytes: int
    """Of the file."""
    whole: bool
    """Whether more bytes would change nothing."""
    exact: bool = False
    """Whether it shows what the scene does, so that it has nothing to learn."""
    storage: StorageSetting | None = None
    """With the precision of each field; None: as it was asked for."""
    settled: frozenset[int] = frozenset()
    """Those of its fields, by their ids, that answer as their sources do but for their precision."""


@dataclass(frozen=True)
class MemoryEstimate:
    """What a student takes of memory, besides what every fusing does."""

    numbers: int
    """Floats of the result in memory."""
    copies: float = 0.0
    """Of the largest source's numbers, while it is made."""
    making: dict[str, float] = field(default_factory=dict)
    """Bytes while it is made, by what they are for."""
    settled: int = 0
    """Of the numbers, those that are known and do not learn."""
    points: int | None = None
    """Of the teachers that it keeps while it learns; None: to be reckoned from a few rays."""


def finest_within(
    box: np.ndarray, finest: float, numbers: Callable[[tuple[int, int, int]], int], most: int
) -> tuple[int, int, int]:
    """Texels per axis over a box (6,): voxels no finer than `finest`, and no more numbers than `most`, as far
    as `least_texels` allow."""
    longest = int(np.ceil((box[3:] - box[:3]).max() / finest)) + 1
    while longest > current(BuilderConfig).least_texels and numbers(texels(box, longest)) > most:
        longest -= max(1, longest // 100)
    return texels(box, longest)


class DistilledBuilder:
    """One kind's stand for one composed scene: a field over the scene's box that learns from nothing, and
    that under a target grows from few numbers to many.

    A kind that needs no learning to begin with derives `DirectBuilder` instead.
    """

    learnt = True
    """Whether it learns from nothing; else it is made (`DirectBuilder`) and learning only finishes it."""

    def __init__(self, kind: "Kind", scene: ComposedField, request: BuildRequest):
        """scene: what it learns from."""
        self.kind, self.scene, self.request = kind, scene, request

    @property
    def distil_config(self) -> DistilConfig | None:
        """How it learns; None: from rays drawn once for all tries (distillation/finetune.py)."""
        lesson = current(DistilConfig)
        return mostly_pictures(lesson) if self.kind.taught_by_pictures else lesson

    def distil_config_for(self, numbers: int, seconds: float | None = None) -> DistilConfig | None:
        """How a student of so many numbers learns, in so many seconds where they are given: the more numbers
        there are, the more it is told, up to `most_told` times, and where there is time for more than that,
        up to `most_patient` times of this; but no more than there is time to learn from. What only finishes
        on pictures is shown more of them where there is time."""
        config, lesson = current(BuilderConfig), self.distil_config
        if lesson is None:
            return None
        if not self.learnt:
            more = 1.0
            if seconds is not None and not lesson.steps:
                more = min(max(1.0, config.rays_per_second * seconds / lesson.rays), config.most_shown)
            rays, rate = round(more * lesson.rays), min(more, config.most_faster) * lesson.rgb_rate
            return replace(lesson, rays=rays, rgb_rate=rate, time_budget=seconds)
        more = min(max(1.0, numbers / config.told_numbers), config.most_told)
        if seconds is not None:
            more *= min(max(1.0, seconds / config.patient), config.most_patient)
        rays, steps, shown = round(more * lesson.rays), round(more * lesson.steps), lesson.rgb_rays
        if seconds is not None:
            known = int(config.rays_per_second * seconds) + 1
            rays, shown = min(rays, known), min(known, config.most_rays)
        return replace(lesson, rays=rays, rgb_rays=shown, steps=steps, time_budget=seconds)

    def unchanged(self) -> "Candidate | None":
        """The scene itself, where nothing of it is to be changed; None where a student stands for it."""
        return None

    # -- ways and sizes --------------------------------------------------------------------------------------

    def storage_settings(self) -> list[list[StorageSetting]]:
        """The ways that are left to choose from, in groups of one precision, the cheapest first."""
        request = self.request
        choice = self.kind.precisions if request.target is not None else (self.kind.distilled,)
        precisions = (request.precision,) if request.precision else choice
        return [[StorageSetting(p, request.ranks, request.sh_degree)] for p in precisions]

    def plans(self) -> Iterator[Plan]:
        """What to make, one after the other, until one shows enough; without a target the largest alone."""
        config = current(BuilderConfig)
        largest, before = self.largest(), None
        if self.request.target is None:
            yield largest
            return
        for k in range(config.smallest.bit_length() - 1, -1, -1):
            numbers = largest.allowed // config.growth**k
            plan = self.plan(largest.storage, numbers)
            last = plan.storage, plan.resolution
            if last != before and (plan.numbers <= numbers or k == 0):
                before = last
                yield plan

    def largest(self) -> Plan:
        """The largest that the limit allows at the dearest precision, and that there is time to teach where
        nothing but a size is asked for; TooSmall where the limit allows none. What holds a place may begin as
        that place, and has little to be taught."""
        plan, request = self.largest_of(self.storage_settings()[-1][-1], self.request.limit), self.request
        around = any(p.unbounded for p in self.scene.placed)
        if request.seconds is None or request.target is not None or around:
            return plan
        taught = int(current(BuilderConfig).numbers_per_second * request.seconds) + 1
        return plan if plan.allowed <= taught else self.plan(plan.storage, taught)

    def largest_of(self, storage: StorageSetting, limit: int) -> Plan:
        """The largest of a way in a file of so many bytes; TooSmall where there is none."""
        smallest = self.bytes_of_plan(self.plan(storage, 1), storage)
        if smallest > limit:
            raise TooSmall(smallest)
        sizes = self.request.sizes
        bare = self.request.overhead + sizes.of(
            Contents((), self.scene.occupancy.stored_bits(0)), storage.precision
        )
        numbers = max(1, int((limit - bare) / sizes.per_number(storage.precision)))
        # small planes are not coded
        while self.bytes_of_plan(plan := self.plan(storage, numbers), storage) > limit:
            numbers = int(current(BuilderConfig).shrink * numbers)
        return plan

    def plan(self, storage: StorageSetting, numbers: int) -> Plan:
        """The finest student of at most so many numbers."""
        return self.kind.plan(self.scene.aabb, self.scene.voxel_size, storage, numbers)

    def bytes_of_plan(self, plan: Plan, storage: StorageSetting) -> int:
        """At most so many bytes of the file."""
        contents = plan.contents(self.scene.occupancy.stored_bits(numbers_in(plan.sections)))
        return self.request.overhead + self.request.sizes.of(contents, storage.precision)

    # -- beginning -------------------------------------------------------------------------------------------

    def init(
        self, plan: Plan, before: StoredField | None, background: Placed | None, generator: torch.Generator
    ) -> tuple[StoredField, str]:
        """A student before it learns, and what it starts from: a smaller one, the scene's background, or
        nothing. background is placed in the scene's frame; None: not to be taken over."""
        scene = self.scene
        if before is not None:
            return self.kind.grown(before, plan).with_occupancy(scene.occupancy), "a smaller student"
        if background is not None and background.as_it_is:
            field = self.kind.warm_start(background, plan, scene, generator)
            if field is not None:
                return field, f"the weights of '{background.name}'"
        box = scene.occupancy.aabb
        fresh = self.kind.create(replace(plan, box=box), generator, "fused")
        return fresh.with_occupancy(scene.occupancy), NOTHING

    # -- telling ---------------------------------------------------------------------------------------------

    def bytes_of(self, field: StoredField, storage: StorageSetting) -> int:
        """Bytes of the file with a whole field."""
        return self.request.overhead + self.request.sizes.exactly(field, storage.precision)

    def why(self, field: StoredField) -> str:
        """What it is, for the sentence that tells why it was chosen."""
        return f"one {self.kind.name} field over the scene, learnt from it"

    def resolution_reports(self, field: StoredField) -> list[ResolutionReport]:
        """What it holds of the scene's objects."""
        return self.kind.resolution_reports(self.scene, field)

    def needs(self) -> MemoryEstimate:
        """What it takes of memory."""
        return MemoryEstimate(self.largest().numbers)


class DirectBuilder(DistilledBuilder):
    """A student that is made without learning, in many ways and at any size; learning only finishes it."""

    learnt = False
    gain = 8.0
    """dB that finishing adds at most."""
    compares = True
    """Whether, where only a size is given, ways are compared under it; else `plain` is taken."""

    def plain(self) -> StorageSetting:
        """The way that leaves most as it is."""
        request = self.request
        return StorageSetting(request.precision or self.kind.faithful, request.ranks, request.sh_degree)

    def build(self, storage: StorageSetting, limit: int) -> Candidate | None:
        """The student of at most `limit` bytes; None where not even the coarsest is that small."""
        raise NotImplementedError

    def smallest(self) -> int:
        """Bytes of the file with the coarsest student."""
        raise NotImplementedError

    def judged_by(self, error_of: Callable[[StoredField, StoredField, str | None], float]) -> None:
        """Told what says how far a field that was made of a source shows from it, as it is stored in a
        precision or, where that is None, as it is: mean square of colours along rays."""
