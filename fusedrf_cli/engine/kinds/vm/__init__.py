"""The `vm` kind: TensoRF's vector-matrix decomposition with spherical-harmonic colour."""

from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.vm.field import VMField

KIND = Kind(
    name="vm",
    good_for="Objects and scenes in their own axes: small, smooth, quick to train.",
    field=VMField,
)
