"""The `cp` kind: sums of products of three lines."""

from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.cp.field import CPField


class CPKind(BoxKind):
    """See Kind."""

    name = "cp"
    good_for = "Single objects in a few hundred kilobytes; more work per sample than vm."
    field = CPField
    takes = frozenset({"ranks", "sh_degree"})


KIND = CPKind()
