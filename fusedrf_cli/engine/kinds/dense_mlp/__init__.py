"""The `dense-mlp` kind: a grid of vertices with features, and a small decoder of colours."""

from dataclasses import replace

from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.dense_mlp.field import DenseMLPField


class DenseMLPKind(BoxKind):
    """See Kind."""

    name = "dense-mlp"
    good_for = "A plain grid of features with a small decoder of colours."
    field = DenseMLPField
    shared_part = "decoder"

    def sharing(self, field: DenseMLPField) -> DenseMLPField:
        """See Kind."""
        shape = replace(field.shape, shared=True)
        same = field.box, field.resolution, field.scale, field.shift, field.params, field.occupancy
        return DenseMLPField(shape, *same)


KIND = DenseMLPKind()
