"""Kinds whose fields lie over one box, on texels along its axes (engine/fields/box.py)."""

from collections.abc import Sequence
from dataclasses import fields, replace

import torch

from fusedrf_cli.engine.fields.box import BoxField
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.student import Plan, Section, Way


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
        return [Section(part.name, part.shape) for part in parts]

    def create(self, plan: Plan, generator: torch.Generator, name: str = "") -> BoxField:
        """See Kind."""
        return self.field.create(self.shape(plan.way), plan.box, plan.resolution, generator)
