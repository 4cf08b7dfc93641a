"""The `dense` kind: a grid of vertices with density and colour."""

from fusedrf_cli.engine import spaces
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.kinds.asked import AskedStudent
from fusedrf_cli.engine.kinds.boxes import BoxKind, GridStudent
from fusedrf_cli.engine.kinds.dense.field import DenseField
from fusedrf_cli.engine.kinds.student import Student, StudentRequest


class DenseKind(BoxKind):
    """See Kind."""

    name = "dense"
    good_for = "A plain grid: simple to read elsewhere, where megabytes do not matter."
    field = DenseField
    takes = frozenset({"sh_degree"})

    def student(self, scene: ComposedField, request: StudentRequest) -> Student:
        """See Kind; in unbounded space it learns."""
        bounded = scene.occupancy.space is spaces.bounded
        return (AskedStudent if bounded else GridStudent)(self, scene, request)


KIND = DenseKind()
