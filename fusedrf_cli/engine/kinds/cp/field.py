"""The `cp` field: sums of products of three lines (CP decomposition; TensoRF, Chen et al. ECCV 2022, eq. 3)
with spherical-harmonic colour. The smallest of all kinds: its numbers grow with a side, not with a face."""

from dataclasses import dataclass

import torch

from fusedrf_cli.engine.fields.box import BoxField, Part, largest
from fusedrf_cli.engine.kinds.cp import bodies, reference

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


class CPField(BoxField):
    """Three lines per component over one box."""

    kind = "cp"
    bodies = bodies
    shape_type = CPShape

    @classmethod
    def parts_of(cls, shape: CPShape, resolution: tuple[int, int, int]) -> list[Part]:
        """See BoxField."""
        lines = [
            Part(f"{what}_line_{axis}", (resolution[axis], rank), (axis,), spread=FACTOR_SPREAD)
            for what, rank in (("density", shape.density_rank), ("colour", shape.colour_rank))
            for axis in range(3)
        ]
        basis = 3, shape.coefficients, shape.colour_rank
        return [*lines, Part("colour_basis", basis, rate=BASIS_RATE, spread=shape.colour_rank**-0.5)]

    def kernel_arrays(self, params: object) -> bodies.Arrays:
        """See ComputedField."""
        return bodies.Arrays(params, self.starts[:-1], *self.corners, self.activation)

    def reference(self, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor):
        """See reference.py."""
        return reference.query(self, params, points, dirs)

    def check_answers(self) -> None:
        """See BoxField."""
        peak = {name: largest(view, kept=1) for name, view in self.sections().items()}
        density, colour = (
            peak[f"{what}_line_0"] * peak[f"{what}_line_1"] * peak[f"{what}_line_2"]
            for what in ("density", "colour")
        )
        self.check_density(float(density.sum()))
        self.check_logit(self.shape.coefficients * float((colour * peak["colour_basis"]).sum()))
