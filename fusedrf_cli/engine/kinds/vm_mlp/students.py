"""A vm-mlp field as a student: one tensor and its network over a scene's box, learnt from nothing."""

from collections.abc import Sequence

import torch

from fusedrf_cli.engine.kinds.boxes import BoxKind
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.student import Plan, Section, Way
from fusedrf_cli.engine.kinds.vm_mlp.field import VMMLPField, VMMLPShape, weight_shapes


class VMMLPKind(Kind):
    """TensoRF with a small network."""

    name = "vm-mlp"
    good_for = "Glossy objects, whose colour changes with the view faster than spherical harmonics can."
    field = VMMLPField
    takes = frozenset({"ranks"})
    reduces, reduction = frozenset(), BoxKind.reduction

    def sections(self, way: Way, resolution: tuple[int, int, int]) -> Sequence[Section]:
        """Those of the tensor, and the network's weights and biases."""
        shape = shape_in(way)
        network = weight_shapes(shape.features, shape.width).items()
        network = [(f"network.{name}", size) for name, size in network]
        return [Section(*named) for named in [*shape.sections(resolution), *network]]

    def create(self, plan: Plan, generator: torch.Generator, name: str = "") -> VMMLPField:
        """One tensor and a network."""
        field = VMMLPField.create(shape_in(plan.way), plan.box, plan.resolution, generator)
        field.name = name
        return field

    def describe(self, field: VMMLPField) -> dict:
        """Texels per axis, and ranks."""
        ranks = [field.shape.density_rank, field.shape.colour_rank]
        return super().describe(field) | {"ranks": ranks}


def shape_in(way: Way) -> VMMLPShape:
    """The shape of a field in a way, VMMLPShape's where that leaves a choice."""
    return VMMLPShape(*way.ranks) if way.ranks else VMMLPShape()
