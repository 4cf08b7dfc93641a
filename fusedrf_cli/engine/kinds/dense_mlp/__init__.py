"""The `dense-mlp` kind: a grid of vertices with features, and a small decoder of colours."""

from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.dense_mlp.field import DenseMLPField


class DenseMLPKind(BoxKind):
    """See Kind."""

    name = "dense-mlp"
    good_for = "A plain grid of features with a small decoder of colours."
    field = DenseMLPField


KIND = DenseMLPKind()
