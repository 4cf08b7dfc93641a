"""The `splats` kind: 3D Gaussian splatting's Gaussians, as they are imported."""

from fusedrf_cli.engine.kinds.imported_kind import ImportedKind
from fusedrf_cli.engine.kinds.splats.field import ARRAYS, SplatsField


class SplatsKind(ImportedKind):
    """See Kind."""

    name = "splats"
    good_for = "What `fusedrf import` makes of a splat file: its own Gaussians, nothing learnt."
    field = SplatsField

    def on_one_grid(self, field: SplatsField) -> SplatsField:
        """See Kind: cells are cut, and splats stay whole."""
        return field

    def trimmed(self, field: SplatsField) -> SplatsField:
        """See Kind."""
        held = field.held
        if held.all() or not held.any():
            return field
        kept = (getattr(field, name)[held] for name in ARRAYS)
        return SplatsField(*kept, field.occupancy, field.cells)

    def describe(self, field: SplatsField) -> dict:
        """See Kind."""
        return {"splats": len(field.centres), "sh_degree": round(field.coefficients**0.5) - 1}


KIND = SplatsKind()
