"""The `vm-mlp` field: colour by a shallow network over a VM tensor's features and view (TensoRF's MLP_Fea).

The factors are a `VMField` of one block, used for density, occupancy, resampling and storage. Its colour
basis (3, 9, 3 rank), read as the (27, 3 rank) matrix B, makes the features f = B (P ∘ L); SH is not used.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch

from fusedrf_cli.engine.fields.base import FieldNeeds
from fusedrf_cli.engine.fields.computed import ComputedField, Group, Reads
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.vm.field import MAX_ANSWER, VMField, VMShape, VMTensor, aligned
from fusedrf_cli.engine.kinds.vm_mlp import bodies, reference

FEATURE_DEGREE = 2  # the degree whose SH basis has 3 * 9 = 27 rows, TensoRF's number of features
WIDTH = 64
MAX_WIDTH = 256  # of a stored field
LAYERS = 3
NETWORK_RATE = 0.05  # TensoRF: 1e-3 where factors learn at 2e-2


class VMMLPField(ComputedField):
    """One VM tensor and a colour network: x = [f, d] -> [x, sin x, sin 2x, cos x, cos 2x] -> width -> width
    -> 3, ReLU, sigmoid at the end, with d the unit direction in the object's frame.

    The inputs are TensoRF's, in blocks as wide as x, where TensoRF interleaves frequencies and keeps f and d
    apart: an importer permutes the columns of the first layer. `params` are the factors' and behind them the
    network's, each layer transposed and filled up to whole runs of 8 (bodies.py).
    """

    kind, bodies = "vm-mlp", bodies

    def __init__(self, factors: VMField, weights: dict[str, torch.Tensor]):
        """weights are the network's by name: `<layer>.weight` (out, in) and `<layer>.bias` (out,)."""
        if len(factors.blocks) != 1:
            raise ValueError(f"a vm-mlp field has one block, found {len(factors.blocks)}")
        if factors.tensors[0].hashed:
            raise ValueError("a vm-mlp field has no hashed detail")
        self.width, self.factors = len(weights["0.bias"]), factors
        packed = factors.params.new_zeros(self.network_size)
        self._place(torch.cat([factors.params, packed]))
        for name, view in self.weights.items():
            view.copy_(weights[name])

    def _place(self, params: torch.Tensor) -> None:
        """Take other numbers, of which the factors hold a view."""
        self.params = params
        self.factors = self.factors.with_params(params[: self.factors.params.numel()])

    # -- making ----------------------------------------------------------------------------------------------

    @classmethod
    def create(
        cls,
        aabb: np.ndarray,
        resolution: tuple[int, int, int],
        shape: VMShape,
        generator: torch.Generator,
        name: str = "",
        width: int = WIDTH,
    ) -> "VMMLPField":
        """An untrained field of the shape's ranks; its SH degree is not used."""
        shape = replace(shape, sh_degree=FEATURE_DEGREE)
        factors = VMField.create(aabb, resolution, shape, generator, name)
        return cls(factors, untrained(3 * shape.coefficients, width, generator))

    def with_params(self, params: torch.Tensor) -> "VMMLPField":
        """The same field with other numbers."""
        other = super().with_params(params)
        other._place(params)
        return other

    def with_occupancy(self, occupancy: OccupancyGrid) -> "VMMLPField":
        """The same numbers under another occupancy grid."""
        other = super().with_params(self.params)
        other.factors = self.factors.with_occupancy(occupancy)
        return other

    def resampled(self, aabb: np.ndarray, resolution: tuple[int, int, int]) -> "VMMLPField":
        """The field on another box and resolution, with the same network."""
        return VMMLPField(self.factors.resampled(aabb, resolution), self.weights)

    # -- reading ---------------------------------------------------------------------------------------------

    @property
    def resolution(self) -> tuple[int, int, int]:
        """Texels per axis."""
        return self.factors.resolution

    def planes(self, numbers: torch.Tensor) -> list[torch.Tensor]:
        """See ComputedField: the factors'."""
        return self.factors.planes(numbers[: self.factors.params.numel()])

    @property
    def shape(self) -> VMShape:
        """Ranks; the degree stands for the number of features."""
        return self.factors.shape

    @property
    def tensors(self) -> tuple[VMTensor, ...]:
        """The one tensor."""
        return self.factors.tensors

    @property
    def blocks(self) -> tuple:
        """The one block."""
        return self.factors.blocks

    @property
    def occupancy(self) -> OccupancyGrid:
        """The factors' grid."""
        return self.factors.occupancy

    @property
    def voxel_size(self) -> float:
        """Finest texel spacing, in the field's frame."""
        return self.factors.voxel_size

    @property
    def layout(self) -> np.ndarray:
        """(1, 13) int64 offsets of the factors' sections in params."""
        return self.factors.layout

    @property
    def basis(self) -> torch.Tensor:
        """(27, 3 rank) view of the matrix that makes features of products."""
        return self.factors.sections(0)["colour_basis"].flatten(0, 1)

    @property
    def wide(self) -> int:
        """Outputs of a layer in memory."""
        return -(-self.width // 8) * 8

    @property
    def layers(self) -> list[tuple[int, int, int, int]]:
        """(inputs, outputs, and both as they lie in memory) of every layer."""
        inputs = 5 * (3 * self.shape.coefficients + 3)
        return [
            (inputs, self.width, inputs, self.wide),
            (self.width, self.width, self.wide, self.wide),
            (self.width, 3, self.wide, bodies.OUTPUTS),
        ]

    @property
    def network_size(self) -> int:
        """Floats of the network in memory."""
        return aligned(sum((rows + 1) * columns for _, _, rows, columns in self.layers))

    @property
    def weights(self) -> dict[str, torch.Tensor]:
        """Views of the network's numbers by name: `<layer>.weight` (out, in) and `<layer>.bias` (out,)."""
        found, start = {}, self.params.numel() - self.network_size
        for i, (inputs, outputs, rows, columns) in enumerate(self.layers):
            both = self.params[start : start + (rows + 1) * columns].view(rows + 1, columns)
            found[f"{i}.weight"], found[f"{i}.bias"] = both[:inputs, :outputs].T, both[rows, :outputs]
            start += both.numel()
        return found

    def kernel_arrays(self, params: object) -> bodies.Arrays:
        """See ComputedField."""
        factors = self.factors.kernel_arrays(params)
        return bodies.Arrays(*factors, self.factors.params.numel())

    def reference(
        self, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See ComputedField and vm_mlp/reference.py."""
        return reference.query(self, params, points, dirs)

    def groups(self) -> list[Group]:
        """The factors' groups, and the network."""
        start = self.factors.params.numel()
        return [*self.factors.groups(), Group(start, self.params.numel(), NETWORK_RATE)]

    # -- storing ---------------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """The factors' arrays and metadata, and the network's weights."""
        arrays, metadata = self.factors.state()
        weights = {f"network.{name}": view.detach().cpu() for name, view in self.weights.items()}
        return arrays | {name: np.ascontiguousarray(w.numpy()) for name, w in weights.items()}, metadata

    @classmethod
    def needs(cls, metadata: dict, shapes: Mapping[str, tuple[int, ...]], array: Reads) -> FieldNeeds:
        """See Kind.field_needs; the factors' numbers are copied once."""
        factors = VMField.needs(metadata, shapes, array)
        return FieldNeeds(factors.held, factors.held + factors.reading)

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], metadata: dict) -> "VMMLPField":
        """Inverse of `state`; the network's width is that of its first bias."""
        factors = VMField.from_state(arrays, metadata)
        width = arrays.get("network.0.bias")
        if width is None or width.ndim != 1 or len(width) > MAX_WIDTH:
            raise ValueError(f"array 'network.0.bias' is no vector of at most {MAX_WIDTH} numbers")
        weights = {}
        for name, shape in weight_shapes(3 * factors.shape.coefficients, len(width)).items():
            found = arrays.get(f"network.{name}")
            if found is None or found.shape != shape:
                have = "nothing" if found is None else list(found.shape)
                raise ValueError(f"array 'network.{name}' should have shape {list(shape)}, found {have}")
            weights[name] = torch.from_numpy(np.ascontiguousarray(found, np.float32))
        check_network(weights)
        return cls(factors, weights)


def weight_shapes(features: int, width: int) -> dict[str, tuple[int, ...]]:
    """Names and shapes of a network's weights, (out, in), and biases, (out,)."""
    sizes = (5 * (features + 3), width, width, 3)
    shapes = {}
    for i in range(LAYERS):
        shapes[f"{i}.weight"], shapes[f"{i}.bias"] = (sizes[i + 1], sizes[i]), (sizes[i + 1],)
    return shapes


def untrained(features: int, width: int, generator: torch.Generator) -> dict[str, torch.Tensor]:
    """Weights uniform as a linear layer's, the last bias 0."""
    found = {}
    for name, shape in weight_shapes(features, width).items():
        bound = (shape[1] if len(shape) == 2 else found[f"{name[0]}.weight"].shape[1]) ** -0.5
        found[name] = torch.empty(shape).uniform_(-bound, bound, generator=generator)
    found[f"{LAYERS - 1}.bias"].zero_()
    return found


def check_network(weights: dict[str, torch.Tensor]) -> None:
    """Raise ValueError where inputs of size 1 could grow past float32 on their way through the network: the
    product of its layers' largest row sums bounds them."""
    largest = 1.0
    for i in range(LAYERS):
        weight, bias = weights[f"{i}.weight"].double(), weights[f"{i}.bias"].double()
        largest = float((weight.abs().sum(1) * largest + bias.abs()).max())
    if not largest <= MAX_ANSWER:
        raise ValueError(
            f"arrays 'network.*' multiply to {largest:.3g}, which should be at most {MAX_ANSWER:g}"
        )
