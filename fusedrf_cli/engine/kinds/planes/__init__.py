"""The `planes` kind: K-Planes."""

from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.planes.field import PlanesField


class PlanesKind(BoxKind):
    """See Kind."""

    name = "planes"
    good_for = "Products of planes, as K-Planes holds what stands still; vm shows more in as many bytes."
    field = PlanesField
    taught_by_pictures = True
    distilled = "int8"  # decision 053: half the features in twice the numbers show no less


KIND = PlanesKind()
