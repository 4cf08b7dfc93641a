"""The `dense` kind: a grid of vertices with density and colour."""

from fusedrf_cli.engine import spaces
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.kinds.box_kind import BoxKind, GridBuilder
from fusedrf_cli.engine.kinds.builder import BuildRequest, DistilledBuilder
from fusedrf_cli.engine.kinds.dense.field import DenseField
from fusedrf_cli.engine.kinds.resampled import ResampledBuilder


class DenseKind(BoxKind):
    """See Kind."""

    name = "dense"
    good_for = "A plain grid: simple to read elsewhere, where megabytes do not matter."
    field = DenseField
    takes = frozenset({"sh_degree"})

    def builder(self, scene: ComposedField, request: BuildRequest) -> DistilledBuilder:
        """See Kind; in unbounded space it learns."""
        bounded = scene.occupancy.space is spaces.bounded
        return (ResampledBuilder if bounded else GridBuilder)(self, scene, request)


KIND = DenseKind()
