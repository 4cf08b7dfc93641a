"""The `sparse` kind: numbers at the vertices of bricks of voxels, which lie where something is."""

from fusedrf_cli.engine.kinds.sparse.builder import SparseKind

KIND = SparseKind()
