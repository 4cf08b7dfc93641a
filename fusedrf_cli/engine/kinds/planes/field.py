"""The `planes` field: products of three planes, of several resolutions, of which the density is a weighted
sum, and a small network of them and the direction that makes the colour (K-Planes, Fridovich-Keil et al.,
CVPR 2023, sec. 3)."""

from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.decoders import density_linear, sh_mlp
from fusedrf_cli.engine.encodings import planes, trunk_features
from fusedrf_cli.engine.fields.assembled import AssembledField, Slot, check_counts
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class PlanesConfig:
    """How such a field begins and learns."""

    first: tuple[float, float] = (0.1, 0.5)
    """Between which an untrained field's factors lie, as K-Planes begins: all products have one sign."""
    network_rate: float = 0.1
    """Relative to the optimiser's."""


@dataclass(frozen=True)
class PlanesShape:
    """Resolutions, each half of the one before, features of each, and the width of the colour network's
    hidden layer."""

    levels: int = 3
    features: int = 16
    hidden: int = 32

    def __post_init__(self):
        """Refuse what the kernels were not written for."""
        check_counts(self, {"levels": (1, 16, 1), "features": (8, 256, 8), "hidden": (8, 256, 8)})


class PlanesField(AssembledField):
    """Planes over one box."""

    kind = "planes"
    shape_type = PlanesShape

    @classmethod
    def slots_of(cls, shape: PlanesShape) -> dict[str, Slot]:
        """See AssembledField."""
        width, rate = shape.levels * shape.features, current(PlanesConfig).network_rate
        products = {"features": shape.features, "scales": shape.levels}
        return {
            "density": Slot(planes, products, "density_"),
            "colour": Slot(trunk_features, {"outputs": width}),
            "sigma": Slot(density_linear, {"width": width}, "sigma_"),
            "rgb": Slot(sh_mlp, {"width": width, "hidden": shape.hidden}, "rgb_", rate),
        }

    @classmethod
    def create(
        cls, shape: PlanesShape, box: np.ndarray, resolution: tuple[int, int, int], generator: torch.Generator
    ) -> "PlanesField":
        """See BoxField."""
        field, (low, high) = super().create(shape, box, resolution, generator), current(PlanesConfig).first
        for name, view in field.sections().items():
            if "plane" in name:
                view.uniform_(low, high, generator=generator)
        return field
