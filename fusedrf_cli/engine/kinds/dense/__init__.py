"""The `dense` kind: a grid of vertices with density and colour."""

from fusedrf_cli.engine.kinds.boxes import BoxKind
from fusedrf_cli.engine.kinds.dense.field import DenseField


class DenseKind(BoxKind):
    """See Kind."""

    name = "dense"
    good_for = "A plain grid: simple to read elsewhere, where megabytes do not matter."
    field = DenseField
    takes = frozenset({"sh_degree"})


KIND = DenseKind()
