"""The `sparse` kind: numbers at the vertices of bricks of voxels, which lie where something is."""

from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.sparse.field import SparseField

KIND = Kind(
    name="sparse",
    good_for="Scenes of any sources and any rule, with detail in few places; edits stay local to the bit.",
    field=SparseField,
)
