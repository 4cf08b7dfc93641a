"""A vm-mlp field as a student: one over a scene's box, learnt from nothing."""

from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.vm_mlp.field import VMMLPField


class VMMLPKind(BoxKind):
    """TensoRF with a small network."""

    name = "vm-mlp"
    good_for = "Glossy objects, whose colour changes with the view faster than spherical harmonics can."
    field = VMMLPField
    takes = frozenset({"ranks"})

    def describe(self, field: VMMLPField) -> dict:
        """Texels per axis, and ranks."""
        return super().describe(field) | {"ranks": [field.shape.density_rank, field.shape.colour_rank]}
