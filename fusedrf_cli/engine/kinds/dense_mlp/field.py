"""The `dense-mlp` field: a grid of vertices with density and features, and a small decoder of colours, its
own or one that it shares with other fields (Control-NeRF, Lazova et al., WACV 2023)."""

import math
from dataclasses import dataclass

from fusedrf_cli.engine.decoders import density_sum, sh_mlp
from fusedrf_cli.engine.encodings import grid
from fusedrf_cli.engine.fields.assembled import Slot, check_counts
from fusedrf_cli.engine.kinds.dense.field import DenseConfig, DenseField
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class DenseMLPConfig:
    """How features and their network begin and learn."""

    decoder_rate: float = 0.05
    """1e-3 where features learn at 2e-2, as other networks of the kind."""
    feature_spread: float = 0.1
    """Features that were all alike would never come apart."""


@dataclass(frozen=True)
class DenseMLPShape:
    """What a vertex holds, and how wide the decoder is."""

    width: int = 16
    """Features of a vertex."""
    hidden: int = 32
    """Numbers between the decoder's layers."""
    shared: bool = False
    """Whether the decoder is other fields' as well, and so learns no further."""

    def __post_init__(self):
        """Refuse what the kernels were not written for: runs of eight numbers."""
        check_counts(self, {"width": (8, 64, 8), "hidden": (8, 128, 8)})

    @property
    def sh_degree(self) -> int:
        """Of the spherical harmonics that features have room for."""
        return min(3, math.isqrt(self.width // 3) - 1)

    @property
    def numbers(self) -> int:
        """Of their coefficients."""
        return 3 * (self.sh_degree + 1) ** 2


class DenseMLPField(DenseField):
    """Vertices of a grid over one box, and a decoder."""

    kind = "dense-mlp"
    shape_type = DenseMLPShape

    @classmethod
    def slots_of(cls, shape: DenseMLPShape) -> dict[str, Slot]:
        """See AssembledField."""
        densemlp = current(DenseMLPConfig)
        config = current(DenseConfig)
        layers = {"width": shape.width, "hidden": shape.hidden}
        return {
            "density": Slot(grid, {"numbers": 1}, "density", config.density_rate),
            "colour": Slot(
                grid, {"numbers": shape.width}, "colour", config.colour_rate, densemlp.feature_spread
            ),
            "sigma": Slot(density_sum),
            "rgb": Slot(sh_mlp, layers, "decoder.", 0.0 if shape.shared else densemlp.decoder_rate),
        }

    def state(self):
        """See BoxField; the decoder is a part that fields may have in common."""
        arrays, metadata = super().state()
        return arrays, metadata | {"shared": ["decoder"]}
