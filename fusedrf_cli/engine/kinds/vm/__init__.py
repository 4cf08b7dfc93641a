"""The `vm` kind: TensoRF's vector-matrix decomposition with spherical-harmonic colour."""

from fusedrf_cli.engine.kinds.vm.builder import VMKind

KIND = VMKind()
