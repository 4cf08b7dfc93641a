"""Kinds whose fields lie over one box, on texels along its axes (engine/fields/box.py)."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np
import torch

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.box import BoxField, used_vertices
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.builder import (
    BuildRequest,
    Contents,
    DistilledBuilder,
    Plan,
    Section,
    StorageSetting,
    finest_within,
    numbers_in,
)
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.reduction import Reduction, coarser
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class BoxKindConfig:
    """How large a field on one grid gets."""

    counted: int = 3
    """Times the used vertices are counted to find how many fit."""
    most_held: int = 60_000_000
    """Numbers in memory: with what learning adds, some 1.5 GB."""


class BoxKind(Kind):
    """A kind of BoxField: says `name`, `good_for`, `field` and `takes`; the rest follows from the field's
    parts."""

    field: type[BoxField]

    @property
    def reduces(self) -> frozenset[str]:
        """See Kind; ranks are of too different a use from kind to kind to have one bound."""
        return self.takes & {"sh_degree"}

    @property
    def on_vertices(self) -> bool:
        """See Kind."""
        return any(part.on_vertices for part in self.field.parts_of(self.usual, (2, 2, 2)))

    @property
    def usual(self) -> object:
        """The field's shape where nothing is asked."""
        return self.field.shape_type()

    @property
    def usual_ranks(self) -> tuple[int, int] | None:
        """See Kind."""
        return (self.usual.density_rank, self.usual.colour_rank) if "ranks" in self.takes else None

    def shape(self, storage: StorageSetting) -> object:
        """The field's shape for a way; what the way leaves open is as usual."""
        options = {"sh_degree": storage.sh_degree}
        if storage.ranks is not None:
            options |= dict(zip(("density_rank", "colour_rank"), storage.ranks, strict=True))
        names = {field.name for field in fields(self.field.shape_type)}
        heeded = {name: value for name, value in options.items() if name in names and value is not None}
        return replace(self.usual, **heeded)

    def shape_at(self, storage: StorageSetting, resolution: tuple[int, int, int]) -> object:
        """The field's shape for a way at a resolution, by which some are larger."""
        return self.shape(storage)

    def sections(self, storage: StorageSetting, resolution: tuple[int, int, int]) -> Sequence[Section]:
        """See Kind."""
        parts = self.field.parts_of(self.shape_at(storage, resolution), resolution)
        return [Section(part.name, (*part.shape[:-1], part.columns or part.shape[-1])) for part in parts]

    def numbers(self, storage: StorageSetting, resolution: tuple[int, int, int]) -> int:
        """See Kind; with what fills rows and cache lines up."""
        return self.field.size_of(self.shape_at(storage, resolution), resolution)

    def builder(self, scene: ComposedField, request: BuildRequest) -> DistilledBuilder:
        """See Kind."""
        return (GridBuilder if self.on_vertices else DistilledBuilder)(self, scene, request)

    def reduction(self, outline: BoxField, voxel: float, storage: StorageSetting) -> Reduction:
        """See Kind: fewer texels, and SH bands where the kind has them."""
        box, resolution = outline.box, coarser(outline.box, outline.resolution, voxel)
        same, shape, unit = resolution == outline.resolution, outline.shape, (outline.scale, outline.shift)
        if storage.sh_degree is not None and "sh_degree" in self.reduces:
            shape = replace(shape, sh_degree=min(shape.sh_degree, storage.sh_degree))
        bare = type(outline)(shape, box, resolution, *unit, outline.params, outline.occupancy)
        on_vertices = any(part.on_vertices for part in bare.parts)
        used = int(np.count_nonzero(bare.used)) if on_vertices else 0
        sections = [Section(part.name, bare.stored_shape(part, used)) for part in bare.parts]

        def make(field: BoxField) -> BoxField:
            small = field if same else field.resampled(box, resolution)
            return small if shape == field.shape else self.with_bands(small, shape)

        lossless = same and shape == outline.shape
        cells = outline.occupancy.stored_bits(numbers_in(sections))
        return Reduction(Contents(sections, cells), make, lossless)

    def with_bands(self, field: BoxField, shape: object) -> BoxField:
        """A field with the first of its SH bands, as many as another shape has: a colour basis (3, bands,
        rank) has them apart, rows of vertices side by side for each channel."""
        unit = field.scale, field.shift
        small = type(field)(shape, field.box, field.resolution, *unit, occupancy=field.occupancy)
        own, fewer = field.shape.coefficients, shape.coefficients
        for old, new in zip(field.sections().values(), small.sections().values(), strict=True):
            if old.shape == new.shape:
                new.copy_(old)
            elif old.dim() == 3:
                new.copy_(old[:, :fewer])
            else:
                rows = old[..., : 3 * own].unflatten(-1, (3, own))[..., :fewer]
                new[..., : 3 * fewer] = rows.flatten(-2)
        return small

    def create(self, plan: Plan, generator: torch.Generator, name: str = "") -> BoxField:
        """See Kind."""
        shape = self.shape_at(plan.storage, plan.resolution)
        field = self.field.create(shape, plan.box, plan.resolution, generator)
        field.name = name
        return field


class GridBuilder(DistilledBuilder):
    """A student with numbers for each vertex of a grid, of which those in occupied cells of the scene alone
    are stored."""

    finer = 1.0
    """Times the scene's finest voxel: a student's own is no finer."""

    @property
    def cells(self) -> OccupancyGrid:
        """Those that it has numbers in."""
        return self.scene.occupancy

    def plan(self, storage: StorageSetting, numbers: int) -> Plan:
        """See `DistilledBuilder`; `numbers` counts what is stored."""
        config = current(BoxKindConfig)
        box, kind, cells = self.scene.aabb, self.kind, self.cells
        share = min(1.0, float(cells.occupied.mean()))

        def wanted(resolution: tuple[int, int, int]) -> float:
            stored = share * sum(np.prod(section.shape) for section in kind.sections(storage, resolution))
            return max(stored, kind.numbers(storage, resolution) * numbers / config.most_held)

        for _ in range(config.counted):  # coarser grids have more vertices just beyond the cells
            resolution = finest_within(box, self.finer * self.scene.voxel_size, wanted, numbers)
            used = np.count_nonzero(used_vertices(cells, box, resolution))
            share = used / np.prod(resolution)
        plan = kind.plan_at(box, resolution, storage, numbers)
        sections = [
            Section(s.name, (used, *s.shape[3:])) if s.shape[:3] == resolution else s for s in plan.sections
        ]
        return replace(plan, sections=sections)
