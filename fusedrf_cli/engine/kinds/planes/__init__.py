"""The `planes` kind: K-Planes."""

from fusedrf_cli.engine import spaces
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.builder import Suitability
from fusedrf_cli.engine.kinds.planes.field import PlanesField


class PlanesKind(BoxKind):
    """See Kind."""

    name = "planes"
    good_for = "Whole scenes in a few megabytes, as products of planes (K-Planes); in more vm shows more."
    field = PlanesField
    taught_by_pictures = True
    distilled = "int8"  # decision 053: half the features in twice the numbers show no less
    few = 5_000_000
    """Bytes up to which it shows more of a scene than any other kind of field (decision 056)."""

    def suits(self, scene: ComposedField, limit: int | None = None) -> Suitability:
        """See Kind."""
        if limit is None or limit > self.few or scene.occupancy.space is not spaces.bounded:
            return super().suits(scene, limit)
        return Suitability(1.5, "products of planes show the most of a scene in so few bytes")


KIND = PlanesKind()
