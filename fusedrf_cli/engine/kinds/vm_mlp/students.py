"""A vm-mlp field as a student: one tensor and its network over a scene's box, learnt from nothing."""

from collections.abc import Sequence
from dataclasses import replace

import torch

from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.student import Plan, Section, Way
from fusedrf_cli.engine.kinds.vm.field import VMShape
from fusedrf_cli.engine.kinds.vm.students import shape_of
from fusedrf_cli.engine.kinds.vm_mlp.field import FEATURE_DEGREE, WIDTH, VMMLPField


class VMMLPKind(Kind):
    """TensoRF with a small network."""

    name = "vm-mlp"
    good_for = "Glossy objects, whose colour changes with the view faster than spherical harmonics can."
    field = VMMLPField
    takes = frozenset({"ranks"})

    def sections(self, way: Way, resolution: tuple[int, int, int]) -> Sequence[Section]:
        """Those of the tensor, and the network's weights and biases."""
        shape = features_of(way)
        sizes = ((5 * (3 * shape.coefficients + 3), WIDTH), (WIDTH, WIDTH), (WIDTH, 3))
        network = [(f"network.{i}.weight", (b, a)) for i, (a, b) in enumerate(sizes)]
        network += [(f"network.{i}.bias", (b,)) for i, (_, b) in enumerate(sizes)]
        return [Section(*named) for named in [*shape.sections(resolution), *network]]

    def create(self, plan: Plan, generator: torch.Generator, name: str = "") -> VMMLPField:
        """One tensor and a network."""
        return VMMLPField.create(plan.box, plan.resolution, features_of(plan.way), generator, name)

    def describe(self, field: VMMLPField) -> dict:
        """Texels per axis, and ranks."""
        ranks = [field.shape.density_rank, field.shape.colour_rank]
        return super().describe(field) | {"ranks": ranks}


def features_of(way: Way) -> VMShape:
    """The tensor's shape in a way: its degree stands for the number of features."""
    return replace(shape_of(way), sh_degree=FEATURE_DEGREE)
