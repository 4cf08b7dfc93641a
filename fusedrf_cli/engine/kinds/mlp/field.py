"""The `mlp` field: a network of the point's sines and cosines, and one of colour (NeRF, Mildenhall et al.,
ECCV 2020), of fewer and narrower layers."""

from dataclasses import dataclass

from fusedrf_cli.engine.decoders import sh_mlp, trunk
from fusedrf_cli.engine.encodings import frequencies, trunk_features
from fusedrf_cli.engine.fields.assembled import AssembledField, Slot, check_counts
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class MLPConfig:
    """How such a field learns."""

    rate: float = 0.1
    """Of all layers, relative to the optimiser's."""


@dataclass(frozen=True)
class MLPShape:
    """Frequencies of the point, layers of the density's network and their width, of which `skip` reads the
    point again, and the width of the colour's hidden layer."""

    count: int = 8
    hidden: int = 64
    layers: int = 4
    skip: int = 2
    colour: int = 32

    def __post_init__(self):
        """Refuse what the kernels were not written for."""
        check_counts(
            self,
            {"count": (1, 24, 1), "hidden": (8, 512, 8), "layers": (1, 16, 1), "colour": (8, 256, 8)},
        )
        check_counts(self, {"skip": (0, self.layers - 1, 1)})


class MLPField(AssembledField):
    """A network over one box."""

    kind = "mlp"
    shape_type = MLPShape
    over_texels = False

    @classmethod
    def slots_of(cls, shape: MLPShape) -> dict[str, Slot]:
        """See AssembledField."""
        rate, width = current(MLPConfig).rate, frequencies.sizes(shape.count)["WIDTH"]
        density = {
            "width": width, "hidden": shape.hidden, "outputs": shape.hidden, "layers": shape.layers,
            "skip": shape.skip,
        }  # fmt: skip
        return {
            "density": Slot(frequencies, {"count": shape.count}),
            "colour": Slot(trunk_features, {"outputs": shape.hidden}),
            "sigma": Slot(trunk, density, "sigma_", rate),
            "rgb": Slot(sh_mlp, {"width": shape.hidden, "hidden": shape.colour}, "rgb_", rate),
        }
