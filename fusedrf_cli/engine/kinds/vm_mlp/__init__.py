"""The `vm-mlp` kind: the vector-matrix decomposition with a small network for colour."""

from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.vm_mlp.field import VMMLPField

KIND = Kind(
    name="vm-mlp",
    good_for="Glossy objects, whose colour changes with the view faster than spherical harmonics can.",
    field=VMMLPField,
)
