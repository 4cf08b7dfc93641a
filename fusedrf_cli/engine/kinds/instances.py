"""Instances: every source of a scene stays a field of its own, in its own axes and of its own kind; as it is
where that fits, else with coarser texels, fewer components or SH bands. What that costs each of them learns
again from rays of its source."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import product

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.resolution_report import ResolutionReport, extent
from fusedrf_cli.engine.fields.base import RadianceField, StoredField
from fusedrf_cli.engine.fields.occupancy import squeezed
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import (
    BuildRequest,
    Candidate,
    DirectBuilder,
    MemoryEstimate,
    StorageSetting,
    Suitability,
    TooSmall,
)
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.reduction import Reduction
from fusedrf_cli.engine.kinds.sweeps import Sweep, SweepPoint, shrinking
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class InstancesConfig:
    """How sources are made smaller, and which ways a chart tries."""

    ranks: tuple[tuple[int, int] | None, ...] = ((8, 16), (8, 24), None)
    """That are compared where none are asked for. Fewer density components cost least and fewer colour
    components most (docs/how-fusing-works.md)."""
    copies: float = 8.5
    """Of a source while it is made smaller: sections in float64 before and after, most of them."""
    finer: float = 1 / 8
    """Of the finest voxel: with a stretched instance a common voxel may lie under it."""
    tolerance: float = 1 + 1e-4
    """To which a common voxel is found."""
    ladder_ranks: tuple[tuple[int, int] | None, ...] = (None, (8, 24), (8, 16))
    ladder_precisions: tuple[str, ...] = ("int8", "float16", "int4")
    ladder_finished: tuple[str, ...] = ("int8", "int4")
    """What was finished at 16 bits is surpassed by twice the numbers at 8."""


class InstancesKind(Kind):
    """A way of fusing whose fields are of any kinds."""

    name = registry.INSTANCES
    good_for = "Scenes of any fields and rule: they stay nodes with their own numbers, fewer where asked."
    trains = False
    beside_background = False  # which is one of the instances
    takes = frozenset({"ranks", "sh_degree"})
    precisions = ("int4", "int8", "float16")

    def suits(self, scene: ComposedField) -> Suitability:
        """Nothing is nearer to a scene, in far less time (decision 024)."""
        return Suitability(2.0, "every source stays a field of its own, in its own axes")

    def builder(self, scene: ComposedField, request: BuildRequest) -> "InstancesBuilder":
        """Instances of a scene."""
        return InstancesBuilder(self, scene, request)

    def describe(self, field: ComposedField) -> dict:
        """What each field says of itself."""
        fields = [opened(one) for one in distinct_fields(field)]
        return {"fields": [{"kind": one.kind, **registry.kind(one.kind).describe(one)} for one in fields]}

    def resolution_reports(self, scene: ComposedField, field: ComposedField) -> list[ResolutionReport]:
        """Instance by instance; a stretch of density is kept."""
        return [
            ResolutionReport(p.name, p.condition, 0.0, p.voxel_size, q.voxel_size, extent(p) / q.voxel_size)
            for p, q in zip(scene.leaves(), field.leaves(), strict=True)
        ]

    def sweeps(self, least_psnr: float) -> dict[str, list[Sweep]]:
        """What is only made smaller, and what is finished."""
        config = current(InstancesConfig)
        plain = [
            SweepPoint(p, r, finetune=False)
            for r, p in product(config.ladder_ranks, config.ladder_precisions)
        ]
        finished = [SweepPoint(p, r) for r, p in product(config.ladder_ranks, config.ladder_finished)]
        groups = {self.name: plain, f"{self.name}, finished": finished}
        return {name: [shrinking(point, least_psnr) for point in rungs] for name, rungs in groups.items()}


class InstancesBuilder(DirectBuilder):
    """The fields of a scene, made smaller by one common voxel until they fit."""

    distil_config = None
    gain = 5.0  # dB, the most that was seen

    def __init__(self, kind: InstancesKind, scene: ComposedField, request: BuildRequest):
        super().__init__(kind, scene, request)
        self.fields = distinct_fields(scene)
        self.placed = [[p for p in scene.leaves() if p.field is field] for field in self.fields]
        self.kinds = [registry.kind(field.kind) for field in self.fields]
        # once, since a source that memory does not hold is read again whenever it is opened
        pairs = zip(self.kinds, self.fields, strict=True)
        self.outlines = [kind.outline(opened(field)) for kind, field in pairs]
        self._exactly: dict[tuple[int, str], int] = {}

    def storage_settings(self) -> list[list[StorageSetting]]:
        """By precision, and ranks, where any of the fields has such."""
        request = self.request
        precisions = (request.precision,) if request.precision else self.kind.precisions
        ranked = any("ranks" in kind.reduces for kind in self.kinds)
        if request.ranks or not ranked:
            ranks = (request.ranks,)
        else:
            ranks = current(InstancesConfig).ranks
        return [[StorageSetting(p, r, request.sh_degree) for r in ranks] for p in precisions]

    def unchanged(self) -> Candidate | None:
        """See `DistilledBuilder`: with the bytes of the sources."""
        request, size = self.request, self.bytes_as_they_are
        if request.precision or request.ranks or request.sh_degree is not None or request.target is not None:
            return None
        return Candidate(self.scene, size, True, True) if size is not None and size <= request.limit else None

    def build(self, storage: StorageSetting, limit: int) -> Candidate | None:
        """The fields, as far as the limit and the way need it with fewer numbers. One whose own bytes are no
        more than those of its numbers in the way's precision keeps them."""
        reductions, size = self.fitting(storage, limit)
        if size > limit:
            return None
        lossless = all(one.lossless for one in reductions)
        if lossless and storage == StorageSetting(self.kind.faithful) and self.fits_as_it_is(limit):
            return Candidate(self.scene, self.bytes_as_they_are, True, True)
        by_field = {id(f): i for i, f in enumerate(self.fields)}

        def smaller(field: RadianceField) -> RadianceField:
            i = by_field[id(field)]
            if self.keeps_bytes(i, reductions[i], storage):
                return field
            return reductions[i].make(opened(field).to("cpu"))

        try:
            return Candidate(self.scene.with_fields(smaller), size, lossless, lossless)
        except TooSmall:
            return None

    def fits_as_it_is(self, limit: int) -> bool:
        """Whether the fields with their own bytes are no larger than a limit."""
        size = None if self.request.precision else self.bytes_as_they_are
        return size is not None and size <= limit

    @cached_property
    def bytes_as_they_are(self) -> int | None:
        """Of the file with the fields' own bytes; None: not all are known."""
        size = self.request.unchanged_bytes
        return None if size is None else self.request.overhead + size

    # -- bytes -----------------------------------------------------------------------------------------------

    def keeps_bytes(self, i: int, reduction: Reduction, storage: StorageSetting) -> bool:
        """Whether the i-th field stays as its source has it."""
        own = self.request.stored_bytes.get(id(self.fields[i]))
        free = reduction.lossless and self.request.precision is None and own is not None
        return free and own <= self.bytes_at(i, reduction, storage)

    def bytes_at(self, i: int, reduction: Reduction, storage: StorageSetting) -> int:
        """At most so many bytes for the numbers of the i-th field in a way's precision."""
        if reduction.contents is not None:
            return self.request.sizes.of(reduction.contents, storage.precision)
        key = i, storage.precision
        if key not in self._exactly:
            self._exactly[key] = self.request.sizes.exactly(
                opened(self.fields[i]).to("cpu"), storage.precision
            )
        return self._exactly[key]

    def bytes_with(self, reductions: Sequence[Reduction], storage: StorageSetting) -> int:
        """At most so many bytes of the file."""
        total = self.request.overhead
        for i, one in enumerate(reductions):
            kept = self.keeps_bytes(i, one, storage)
            total += self.request.stored_bytes[id(self.fields[i])] if kept else self.bytes_at(i, one, storage)
        return total

    def bytes_of(self, field: ComposedField, storage: StorageSetting) -> int:
        """See `DistilledBuilder`."""
        total = self.request.overhead
        for source, one in zip(self.fields, distinct_fields(field), strict=True):
            if one is source:
                total += self.request.stored_bytes[id(source)]
            else:
                kind = registry.kind(one.kind)
                reduction = kind.reduction(kind.outline(one), 0.0, StorageSetting(storage.precision))
                sizes, contents = self.request.sizes, reduction.contents
                known = contents is not None
                total += (
                    sizes.of(contents, storage.precision) if known else sizes.exactly(one, storage.precision)
                )
        return total

    def fitting(self, storage: StorageSetting, limit: int) -> tuple[list[Reduction], int]:
        """The fields at their own resolution, or at that of the finest common voxel, in the scene's frame, at
        which they fit in so many bytes, as far as that goes; and how many they take."""

        config = current(InstancesConfig)

        def at_voxel(voxel: float) -> tuple[list[Reduction], int]:
            fields = [
                kind.reduction(outline, voxel / stretch, storage)
                for kind, outline, stretch in zip(self.kinds, self.outlines, self.stretches, strict=True)
            ]
            return fields, self.bytes_with(fields, storage)

        best = at_voxel(0.0)
        if best[1] <= limit:
            return best
        fine = config.finer * min(p.voxel_size for own in self.placed for p in own)
        pairs = zip(self.outlines, self.stretches, strict=True)
        coarse = max(float((o.aabb[3:] - o.aabb[:3]).max()) * stretch for o, stretch in pairs)
        best = at_voxel(coarse)
        while coarse > config.tolerance * fine and best[1] <= limit:
            middle = (fine * coarse) ** 0.5
            fields = at_voxel(middle)
            if fields[1] <= limit:
                best, coarse = fields, middle
            else:
                fine = middle
        return best

    @cached_property
    def stretches(self) -> list[float]:
        """For each field the most by which an instance of it is larger than itself."""
        return [max(1 / squeezed(p.world_to_object) for p in own) for own in self.placed]

    def smallest(self) -> int:
        """See `DirectBuilder`."""
        return min(self.fitting(storage, 1)[1] for group in self.storage_settings() for storage in group)

    # -- telling ---------------------------------------------------------------------------------------------

    def why(self, field: ComposedField) -> str:
        """How many nodes over how many fields."""
        return f"{len(field.leaves())} nodes over {len(self.fields)} fields, each in its own axes"

    def needs(self) -> MemoryEstimate:
        """The sources' numbers as far as the limit lets them."""
        request, per_number = self.request, self.request.sizes.per_number
        own = sum(request.source_bytes) // 4  # bytes
        cheapest = request.precision or self.kind.precisions[0]
        return MemoryEstimate(
            min(own, int(request.limit / per_number(cheapest))), current(InstancesConfig).copies
        )


def distinct_fields(scene: ComposedField) -> list[StoredField]:
    """The fields that a scene places, each once."""
    return list({id(p.field): p.field for p in scene.leaves()}.values())


KIND = InstancesKind()
