"""The `mlp` kind: NeRF's network."""

from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.mlp.field import MLPField


class MLPKind(BoxKind):
    """See Kind."""

    name = "mlp"
    good_for = "The fewest bytes, as NeRF has them; slow, and cp shows far more in twice as many."
    field = MLPField


KIND = MLPKind()
