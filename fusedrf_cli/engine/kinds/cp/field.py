"""The `cp` field: sums of products of three lines (CP decomposition; TensoRF, Chen et al. ECCV 2022, eq. 3)
with spherical-harmonic colour. The smallest of all kinds: its numbers grow with a side, not with a face."""

from dataclasses import dataclass

from fusedrf_cli.engine.decoders import density_sum, sh_basis
from fusedrf_cli.engine.encodings import line
from fusedrf_cli.engine.fields.assembled import AssembledField, RankedShape, Slot


@dataclass(frozen=True)
class CPShape(RankedShape):
    """Components of a cp field."""

    density_rank: int = 96
    colour_rank: int = 192


class CPField(AssembledField):
    """Three lines per component over one box."""

    kind = "cp"
    shape_type = CPShape

    @classmethod
    def slots_of(cls, shape: CPShape) -> dict[str, Slot]:
        """See AssembledField."""
        basis = {"width": shape.colour_rank, "coefficients": shape.coefficients}
        return {
            "density": Slot(line, {"rank": shape.density_rank}, "density_"),
            "colour": Slot(line, {"rank": shape.colour_rank}, "colour_"),
            "sigma": Slot(density_sum),
            # TensoRF: 1e-3 for the colour basis where lines learn at 2e-2
            "rgb": Slot(sh_basis, basis, "colour_", rate=0.05),
        }
