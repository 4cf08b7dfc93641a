"""The `dense` field: a grid of vertices with density and spherical-harmonic colour (Plenoxels, Fridovich-Keil
et al. CVPR 2022; DVGO, Sun et al. CVPR 2022), interpolated before the activation."""

from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.decoders import density_sum, sh
from fusedrf_cli.engine.encodings import grid
from fusedrf_cli.engine.fields.assembled import AssembledField, HarmonicShape, Slot
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class DenseConfig:
    """How fast the vertices of a grid learn."""

    density_rate: float = 60.0
    """A vertex is touched seldom; slower ones leave low density for long."""
    colour_rate: float = 10.0
    """Likewise."""


@dataclass(frozen=True)
class DenseShape(HarmonicShape):
    """What a vertex holds."""

    sh_degree: int = 1

    @property
    def numbers(self) -> int:
        """Numbers of a vertex besides its density."""
        return 3 * self.coefficients

    @property
    def width(self) -> int:
        """Floats of a vertex's row of colour in memory."""
        return -(-self.numbers // 8) * 8


class DenseField(AssembledField):
    """Vertices of a grid over one box."""

    kind = "dense"
    shape_type = DenseShape

    @classmethod
    def slots_of(cls, shape: DenseShape) -> dict[str, Slot]:
        """See AssembledField."""
        config = current(DenseConfig)
        harmonics = {"width": shape.width, "coefficients": shape.coefficients}
        return {
            "density": Slot(grid, {"numbers": 1}, "density", config.density_rate),
            "colour": Slot(grid, {"numbers": shape.numbers}, "colour", config.colour_rate),
            "sigma": Slot(density_sum),
            "rgb": Slot(sh, harmonics),
        }

    def fill_vertices(self, index: np.ndarray, features: np.ndarray, colours: np.ndarray) -> None:
        """See `ResampledBuilder`."""
        sections, index = self.sections(), torch.from_numpy(index)
        sections["density"].view(-1)[index] = torch.from_numpy(features - self.shift).float()
        sections["colour"].view(-1, self.shape.width)[index, : self.shape.numbers] = torch.from_numpy(colours)
