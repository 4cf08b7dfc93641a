"""The `cp` kind: sums of products of three lines."""

from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.cp.field import CPField


class CPKind(BoxKind):
    """See Kind."""

    name = "cp"
    good_for = "Objects and small scenes in up to a megabyte; in more planes and vm show more."
    field = CPField
    takes = frozenset({"ranks", "sh_degree"})


KIND = CPKind()
