"""The `dense` field: a grid of vertices with density and spherical-harmonic colour (Plenoxels, Fridovich-Keil
et al. CVPR 2022; DVGO, Sun et al. CVPR 2022), interpolated before the activation."""

from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.fields.box import BoxField, Part, largest
from fusedrf_cli.engine.kinds.dense import bodies, reference

DENSITY_RATE, COLOUR_RATE = 60.0, 10.0  # a vertex is touched seldom; slower ones leave haze for long


@dataclass(frozen=True)
class DenseShape:
    """What a vertex holds."""

    sh_degree: int = 1

    def __post_init__(self):
        """Refuse degrees that the kernels were not written for."""
        if self.sh_degree not in range(4):
            raise ValueError(f"'sh_degree' should be 0, 1, 2 or 3, found {self.sh_degree}")

    @property
    def coefficients(self) -> int:
        """SH coefficients per channel."""
        return (self.sh_degree + 1) ** 2

    @property
    def numbers(self) -> int:
        """Numbers of a vertex besides its density."""
        return 3 * self.coefficients

    @property
    def width(self) -> int:
        """Floats of a vertex's row of colour in memory."""
        return -(-self.numbers // 8) * 8


class DenseField(BoxField):
    """Vertices of a grid over one box."""

    kind = "dense"
    bodies = bodies
    shape_type = DenseShape

    @classmethod
    def parts_of(cls, shape: DenseShape, resolution: tuple[int, int, int]) -> list[Part]:
        """See BoxField."""
        rows = (*resolution, shape.width)
        return [
            Part("density", resolution, (0, 1, 2), DENSITY_RATE),
            Part("colour", rows, (0, 1, 2), COLOUR_RATE, columns=shape.numbers),
        ]

    def kernel_arrays(self, params: object) -> bodies.Arrays:
        """See ComputedField."""
        return bodies.Arrays(params, int(self.starts[1]), *self.corners, self.activation)

    def reference(self, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor):
        """See reference.py."""
        return reference.query(self, params, points, dirs)

    def check_answers(self) -> None:
        """See BoxField."""
        peak = {name: float(largest(view)) for name, view in self.sections().items()}
        self.check_density(peak["density"])
        self.check_logit(3 * self.shape.coefficients * peak["colour"])

    def fill_vertices(self, index: np.ndarray, features: np.ndarray, colours: np.ndarray) -> None:
        """See AskedStudent."""
        sections, index = self.sections(), torch.from_numpy(index)
        sections["density"].view(-1)[index] = torch.from_numpy(features - self.shift).float()
        sections["colour"].view(-1, self.shape.width)[index, : self.shape.numbers] = torch.from_numpy(colours)
