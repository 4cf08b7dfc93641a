"""The `vm-mlp` kind: the vector-matrix decomposition with a small network for colour."""

from fusedrf_cli.engine.kinds.vm_mlp.builder import VMMLPKind

KIND = VMMLPKind()
