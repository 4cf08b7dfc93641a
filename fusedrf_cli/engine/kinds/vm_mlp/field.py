"""The `vm-mlp` field: planes times lines, and colour by a network on features and view (TensoRF, Chen et al.,
ECCV 2022, with MLP_Fea shading; decoders/mlp.py).

In files it is a `vm` field, whose colour basis (3, K, 3 rank), read as a matrix (3 K, 3 rank), makes the
network's features, and the network's layers beside it.
"""

from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.decoders import density_sum, mlp
from fusedrf_cli.engine.encodings import plane_line
from fusedrf_cli.engine.fields.assembled import RankedShape, Slot
from fusedrf_cli.engine.kinds.vm.field import VMConfig, VMField, box_metadata
from fusedrf_cli.engine.settings import current

FEATURE_DEGREE = 2  # the degree whose SH basis has 3 * 9 = 27 rows, TensoRF's number of features
MAX_WIDTH = 256  # of a stored field
LAYERS = 3  # of the network, the last included


@dataclass(frozen=True)
class VMMLPShape(RankedShape):
    """Ranks; the degree stands for the number of features."""

    sh_degree: int = FEATURE_DEGREE
    width: int = 64
    """Outputs of the network's hidden layers."""
    hashed = None

    def __post_init__(self):
        """Refuse what the kernels were not written for."""
        super().__post_init__()
        if type(self.width) is not int or not 0 < self.width <= MAX_WIDTH:
            raise ValueError(f"'width' should be 1 to {MAX_WIDTH}, found {self.width}")

    @property
    def features(self) -> int:
        """That the matrix makes."""
        return 3 * self.coefficients


class VMMLPField(VMField):
    """Planes and lines, and a colour network."""

    kind = "vm-mlp"
    shape_type = VMMLPShape

    @classmethod
    def slots_of(cls, shape: VMMLPShape) -> dict[str, Slot]:
        """See AssembledField."""
        network = {"width": 3 * shape.colour_rank, "rows": shape.features, "hidden": shape.width}
        return {
            "density": Slot(plane_line, {"rank": shape.density_rank}, "density_"),
            "colour": Slot(plane_line, {"rank": shape.colour_rank}, "colour_"),
            "sigma": Slot(density_sum),
            "rgb": Slot(mlp, network, "network.", current(VMConfig).basis_rate),
        }

    @classmethod
    def create(
        cls, shape: VMMLPShape, box: np.ndarray, resolution: tuple[int, int, int], generator: torch.Generator
    ) -> "VMMLPField":
        """See VMField; layers are uniform as linear ones."""
        field = super().create(shape, box, resolution, generator)
        for name, weight in untrained(shape.features, shape.width, generator).items():
            field.weights[name].copy_(weight)
        return field

    @property
    def basis(self) -> torch.Tensor:
        """(features, 3 rank) view of the matrix that makes features of products."""
        return self.sections()["network.basis"]

    @property
    def weights(self) -> dict[str, torch.Tensor]:
        """Views of the network's numbers by name: `<layer>.weight` (out, in) and `<layer>.bias` (out,)."""
        views, sections = {}, self.sections()
        for name, shape in weight_shapes(self.shape.features, self.shape.width).items():
            layer = sections[f"network.layer_{name[0]}"]
            views[name] = layer[: shape[1], : shape[0]].T if len(shape) == 2 else layer[-1, : shape[0]]
        return views

    # -- storing ---------------------------------------------------------------------------------------------

    def numbers(self) -> dict[str, np.ndarray]:
        """See VMField: with the network's weights."""
        arrays = super().numbers()
        own = {name: arrays.pop(name) for name in [*arrays] if "network." in name}
        basis = own[self.stored_name("network.basis")]
        arrays[self.stored_name("colour_basis")] = basis.reshape(3, self.shape.coefficients, -1)
        for name, view in self.weights.items():
            arrays[f"network.{name}"] = np.ascontiguousarray(view.detach().cpu().numpy())
        return arrays

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], metadata: dict) -> "VMMLPField":
        """Inverse of `state`; the network's width is that of its first bias."""
        bias = arrays.get("network.0.bias")
        if bias is None or bias.ndim != 1 or not 0 < len(bias) <= MAX_WIDTH:
            raise ValueError(f"array 'network.0.bias' is no vector of at most {MAX_WIDTH} numbers")
        if "hashed" in box_metadata(cls.kind, metadata)["shape"]:
            raise ValueError("a vm-mlp field has no hash grid")
        metadata = metadata | {"shape": metadata["shape"] | {"width": len(bias)}}
        shape, basis = VMMLPShape(**metadata["shape"]), cls.stored_name("colour_basis")
        expected = {basis: (3, shape.coefficients, 3 * shape.colour_rank)}
        expected |= {f"network.{n}": s for n, s in weight_shapes(shape.features, shape.width).items()}
        for name, size in expected.items():
            if name not in arrays or arrays[name].shape != size:
                have = list(arrays[name].shape) if name in arrays else "nothing"
                raise ValueError(f"array '{name}' should have shape {list(size)}, found {have}")
        own = {cls.stored_name("network.basis"): arrays[basis].reshape(shape.features, -1)}
        layers = mlp.layer_shapes(3 * shape.colour_rank, shape.features, shape.width)
        for i, (inputs, outputs) in enumerate(layers):
            layer = own[cls.stored_name(f"network.layer_{i}")] = np.zeros((inputs + 1, outputs), np.float32)
            weight, given = arrays[f"network.{i}.weight"], arrays[f"network.{i}.bias"]
            layer[: weight.shape[1], : len(weight)], layer[-1, : len(given)] = weight.T, given
        return super().from_state(arrays | own, metadata)


def weight_shapes(features: int, width: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a network's weights, (out, in), and biases, (out,)."""
    sizes = (5 * (features + 3), width, width, 3)
    shapes = {}
    for i in range(LAYERS):
        shapes[f"{i}.weight"], shapes[f"{i}.bias"] = (sizes[i + 1], sizes[i]), (sizes[i + 1],)
    return shapes


def untrained(features: int, width: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Weights uniform as a linear layer's, the last bias 0."""
    weights = {}
    for name, shape in weight_shapes(features, width).items():
        bound = (shape[1] if len(shape) == 2 else weights[f"{name[0]}.weight"].shape[1]) ** -0.5
        weights[name] = torch.empty(shape).uniform_(-bound, bound, generator=generator)
    weights[f"{LAYERS - 1}.bias"].zero_()
    return weights
