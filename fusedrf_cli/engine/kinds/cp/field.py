"""The `cp` field: sums of products of three lines (CP decomposition; TensoRF, Chen et al. ECCV 2022, eq. 3)
with spherical-harmonic colour. The smallest of all kinds: its numbers grow with a side, not with a face."""

from dataclasses import dataclass

from fusedrf_cli.engine.decoders import density_sum, sh_basis
from fusedrf_cli.engine.encodings import line
from fusedrf_cli.engine.fields.assembled import AssembledField, Slot

FACTOR_SPREAD = 0.2  # TensoRF's, of lines
BASIS_RATE = 0.05  # TensoRF: 1e-3 for the colour basis where lines learn at 2e-2


@dataclass(frozen=True)
class CPShape:
    """Components of a cp field."""

    density_rank: int = 96
    colour_rank: int = 192
    sh_degree: int = 2

    def __post_init__(self):
        """Refuse what the kernels were not written for: runs of eight components, four SH bands."""
        for name in ("density_rank", "colour_rank"):
            rank = getattr(self, name)
            if type(rank) is not int or not 8 <= rank <= 1024 or rank % 8:
                raise ValueError(f"'{name}' should be a multiple of 8 up to 1024, found {rank}")
        if self.sh_degree not in range(4):
            raise ValueError(f"'sh_degree' should be 0, 1, 2 or 3, found {self.sh_degree}")

    @property
    def coefficients(self) -> int:
        """SH coefficients per channel."""
        return (self.sh_degree + 1) ** 2


class CPField(AssembledField):
    """Three lines per component over one box."""

    kind = "cp"
    shape_type = CPShape

    @classmethod
    def slots_of(cls, shape: CPShape) -> dict[str, Slot]:
        """See AssembledField."""
        basis = {"width": shape.colour_rank, "coefficients": shape.coefficients}
        return {
            "density": Slot(line, {"rank": shape.density_rank}, "density_", spread=FACTOR_SPREAD),
            "colour": Slot(line, {"rank": shape.colour_rank}, "colour_", spread=FACTOR_SPREAD),
            "sigma": Slot(density_sum),
            "rgb": Slot(sh_basis, basis, "colour_", rate=BASIS_RATE),
        }
