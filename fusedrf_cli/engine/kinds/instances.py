"""Instances: every source of a scene stays a field of its own, in its own axes and of its own kind; as it is
where that fits, else with coarser texels, fewer components or SH bands. What that costs each of them learns
again from rays of its source."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.resolution_report import ResolutionReport, extent
from fusedrf_cli.engine.fields.base import RadianceField, StoredField
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.allocation import FieldShares, allocated
from fusedrf_cli.engine.kinds.builder import (
    EACH,
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

    copies: float = 8.5
    """Of a source while it is made smaller: sections in float64 before and after, most of them."""
    resampled: float = 1.3
    """Of all numbers of a grid, those of empty cells too, while it is resampled."""
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

    def suits(self, scene: ComposedField, limit: int | None = None) -> Suitability:
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
    """The fields of a scene, each made smaller by what costs least, until they fit."""

    distil_config = None
    gain = 5.0  # dB, the most that was seen
    compares = False  # bytes are shared out among the fields: that is the one way

    def __init__(self, kind: InstancesKind, scene: ComposedField, request: BuildRequest):
        super().__init__(kind, scene, request)
        self.fields = distinct_fields(scene)
        self.kinds = [registry.kind(field.kind) for field in self.fields]
        self.outlines, self.largest_grid = [], 0
        for kind, field in zip(self.kinds, self.fields, strict=True):
            own = opened(field)  # once: what memory does not hold is read again whenever it is opened
            self.outlines.append(kind.outline(own))
            self.largest_grid = max(self.largest_grid, own.params.numel())
        self._exactly: dict[tuple[int, str], int] = {}
        self._shares: dict[StorageSetting, list[FieldShares]] = {}

    def plain(self) -> StorageSetting:
        """See `DirectBuilder`: where no precision is asked for, each field has one of its own."""
        request = self.request
        return StorageSetting(request.precision or EACH, request.ranks, request.sh_degree)

    def storage_settings(self) -> list[list[StorageSetting]]:
        """One."""
        return [[self.plain()]]

    def unchanged(self) -> Candidate | None:
        """See `DistilledBuilder`: with the bytes of the sources."""
        request, size = self.request, self.bytes_as_they_are
        if request.precision or request.ranks or request.sh_degree is not None or request.target is not None:
            return None
        if size is None or size > request.limit:
            return None
        storage = replace(self.plain(), each=("",) * len(self.fields))
        return Candidate(self.scene, size, True, True, storage)

    def build(self, storage: StorageSetting, limit: int) -> Candidate | None:
        """The fields, each with its share of the bytes."""
        fields = self.shares(storage)
        shares = allocated(fields, limit - self.request.overhead)
        pairs = list(zip(fields, shares, strict=True))
        size = self.request.overhead + sum(field.bytes(share) for field, share in pairs)
        if size > limit:
            return None
        lossless = all(field.reduction(share).lossless for field, share in pairs)
        whole = lossless and all(share == field.whole for field, share in pairs)
        by_field, settled = {id(f): i for i, f in enumerate(self.fields)}, set()

        def smaller(field: RadianceField) -> RadianceField:
            own, share = pairs[by_field[id(field)]]
            if share.precision is None:
                return field
            reduction = own.reduction(share)
            made = reduction.make(opened(field).to("cpu"))
            if reduction.lossless:  # a field of its own, since what is stored anew is not its source
                made = made.with_params(made.params)
                settled.add(id(made))
            return made

        try:
            scene = self.scene.with_fields(smaller)
        except TooSmall:
            return None
        precisions = tuple(share.precision or "" for share in shares)
        return Candidate(scene, size, whole, lossless, replace(storage, each=precisions), frozenset(settled))

    @cached_property
    def bytes_as_they_are(self) -> int | None:
        """Of the file with the fields' own bytes; None: not all are known."""
        size = self.request.unchanged_bytes
        return None if size is None else self.request.overhead + size

    # -- bytes -----------------------------------------------------------------------------------------------

    def shares(self, storage: StorageSetting) -> list[FieldShares]:
        """What the fields take, and what they lose by it, in a way; made once."""
        if storage not in self._shares:
            self._shares[storage] = [self.shares_of(i, storage) for i in range(len(self.fields))]
        return self._shares[storage]

    def shares_of(self, i: int, storage: StorageSetting) -> FieldShares:
        """Of the i-th field."""
        kind, outline, field = self.kinds[i], self.outlines[i], self.fields[i]
        own = self.request.stored_bytes.get(id(field))
        ladder = [storage.precision] if storage.precision != EACH else list(reversed(self.kind.precisions))
        if own is not None and storage.precision == EACH and kind.reduction(outline, 0.0, storage).lossless:
            ladder = [None, *ladder]

        def bytes_at(reduction: Reduction, precision: str | None) -> int:
            if precision is not None:
                return self.bytes_at(i, reduction, precision)
            return own if reduction.lossless else 1 << 62  # numbers that are made anew are stored anew

        def error_of(reduction: Reduction, precision: str | None) -> float:
            if reduction.lossless and precision is None:
                return 0.0
            made = reduction.make(opened(field).to("cpu"))
            return self.error_of(field, made, precision)

        ranked = storage.ranks is None and "ranks" in kind.reduces
        return FieldShares(
            lambda voxel, how: kind.reduction(outline, voxel, how),
            bytes_at, error_of, float(outline.voxel_size), storage, ladder, ranked,
        )  # fmt: skip

    def judged_by(self, error_of: Callable[[StoredField, StoredField, str | None], float]) -> None:
        """See `DirectBuilder`."""
        self.error_of = error_of

    def bytes_at(self, i: int, reduction: Reduction, precision: str) -> int:
        """At most so many bytes for the numbers of the i-th field in a precision."""
        if reduction.contents is not None:
            return self.request.sizes.of(reduction.contents, precision)
        key = i, precision
        if key not in self._exactly:
            self._exactly[key] = self.request.sizes.exactly(opened(self.fields[i]).to("cpu"), precision)
        return self._exactly[key]

    def bytes_of(self, field: ComposedField, storage: StorageSetting) -> int:
        """See `DistilledBuilder`."""
        total = self.request.overhead
        for i, (source, one) in enumerate(zip(self.fields, distinct_fields(field), strict=True)):
            if one is source:
                total += self.request.stored_bytes[id(source)]
            else:
                kind, precision = registry.kind(one.kind), storage.precision_of(i)
                reduction = kind.reduction(kind.outline(one), 0.0, StorageSetting(precision))
                sizes, contents = self.request.sizes, reduction.contents
                known = contents is not None
                total += sizes.of(contents, precision) if known else sizes.exactly(one, precision)
        return total

    def smallest(self) -> int:
        """See `DirectBuilder`."""
        return self.request.overhead + sum(field.smallest() for field in self.shares(self.plain()))

    # -- telling ---------------------------------------------------------------------------------------------

    def why(self, field: ComposedField) -> str:
        """How many nodes over how many fields."""
        return f"{len(field.leaves())} nodes over {len(self.fields)} fields, each in its own axes"

    def needs(self) -> MemoryEstimate:
        """The sources' numbers as far as the limit lets them; a grid that is resampled uses all its pages."""
        request, per_number = self.request, self.request.sizes.per_number
        own = sum(request.source_bytes) // 4  # bytes
        cheapest = request.precision or self.kind.precisions[0]
        config = current(InstancesConfig)
        return MemoryEstimate(
            min(own, int(request.limit / per_number(cheapest))),
            config.copies,
            {"a grid while it is resampled": config.resampled * 4 * self.largest_grid},
        )


def distinct_fields(scene: ComposedField) -> list[StoredField]:
    """The fields that a scene places, each once."""
    return list({id(p.field): p.field for p in scene.leaves()}.values())


KIND = InstancesKind()
