"""Kinds whose fields lie over one box, on texels along its axes (engine/fields/box.py)."""

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np
import torch

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.box import BoxField
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.student import Plan, Section, Student, StudentRequest, Way, finest_within

BEYOND_CELLS = 1.3  # vertices that are used over those inside occupied cells: some lie just beyond
MOST_HELD = 60_000_000  # numbers in memory: with what learning adds, some 1.5 GB


class BoxKind(Kind):
    """A kind of BoxField: says `name`, `good_for`, `field` and `takes`; the rest follows from the field's
    parts."""

    field: type[BoxField]

    def shape(self, way: Way) -> object:
        """The field's shape for a way; what the way leaves open is the shape's own default."""
        asked = {"sh_degree": way.sh_degree}
        if way.ranks is not None:
            asked |= dict(zip(("density_rank", "colour_rank"), way.ranks, strict=True))
        known = {field.name for field in fields(self.field.shape_type)}
        heeded = {name: value for name, value in asked.items() if name in known and value is not None}
        return replace(self.field.shape_type(), **heeded)

    def sections(self, way: Way, resolution: tuple[int, int, int]) -> Sequence[Section]:
        """See Kind."""
        parts = self.field.parts_of(self.shape(way), resolution)
        return [Section(part.name, (*part.shape[:-1], part.columns or part.shape[-1])) for part in parts]

    def student(self, scene: ComposedField, request: StudentRequest) -> Student:
        """See Kind."""
        parts = self.field.parts_of(self.shape(Way()), (2, 2, 2))
        on_vertices = any(part.on_vertices for part in parts)
        return (GridStudent if on_vertices else Student)(self, scene, request)

    def create(self, plan: Plan, generator: torch.Generator, name: str = "") -> BoxField:
        """See Kind."""
        return self.field.create(self.shape(plan.way), plan.box, plan.resolution, generator)


class GridStudent(Student):
    """A student with numbers for each vertex of a grid, of which those in occupied cells of the scene alone
    are stored."""

    def plan(self, way: Way, numbers: int) -> Plan:
        """See Student; `numbers` counts what is stored."""
        box, kind = self.scene.aabb, self.kind
        share = min(1.0, BEYOND_CELLS * float(self.scene.occupancy.occupied.mean()))

        def wanted(resolution: tuple[int, int, int]) -> float:
            held = kind.numbers(way, resolution)
            return max(share * held, held * numbers / MOST_HELD)

        resolution = finest_within(box, self.scene.voxel_size, wanted, numbers)
        whole = kind.plan_at(box, resolution, way, numbers)
        vertices = int(share * np.prod(resolution))
        sections = [
            Section(s.name, (vertices, *s.shape[3:])) if s.shape[:3] == resolution else s
            for s in whole.sections
        ]
        return replace(whole, sections=sections)
