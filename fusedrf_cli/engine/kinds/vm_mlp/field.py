"""The `vm-mlp` field: colour by a shallow network over a VM tensor's features and view (TensoRF's MLP_Fea).

The factors are a `VMField` of one block, used for density, occupancy, resampling and storage. Its colour
basis (3, 9, 3 rank), read as the (27, 3 rank) matrix B, makes the features f = B (P ∘ L); SH is not used.
"""

from dataclasses import replace
from types import ModuleType

import numpy as np
import torch

from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels import GridArrays
from fusedrf_cli.engine.kinds.vm.bodies import Arrays as VMArrays
from fusedrf_cli.engine.kinds.vm.field import MAX_ANSWER, Block, VMField, VMShape, VMTensor

FEATURE_DEGREE = 2  # the degree whose SH basis has 3 * 9 = 27 rows, TensoRF's number of features
WIDTH = 64
# Shaded in whole runs of 512 rows, at most 12 of them, a point has the same colour in any company: products
# of a few rows round otherwise, and so do sines and sigmoids where a piece that torch hands to a thread (one
# per 32,768 numbers, here six at most) does not end on a whole vector.
ROWS_PADDED = 512
POINTS_AT_ONCE = 12 * ROWS_PADDED


class ColourNetwork(torch.nn.Module):
    """x = [f, d] -> [x, sin x, sin 2x, cos x, cos 2x] -> width -> width -> 3, ReLU, sigmoid at the end.

    TensoRF's inputs, in blocks as wide as x, where TensoRF interleaves frequencies and keeps f and d
    apart: an importer permutes the columns of the first layer.
    """

    def __init__(self, features: int, width: int = WIDTH, generator: torch.Generator | None = None):
        """Weights uniform as a linear layer's, the last bias 0."""
        super().__init__()
        inputs = (features + 3) * 5
        sizes = ((inputs, width), (width, width), (width, 3))
        self.layers = torch.nn.ModuleList(torch.nn.utils.skip_init(torch.nn.Linear, a, b) for a, b in sizes)
        with torch.no_grad():
            for layer in self.layers:
                bound = layer.in_features**-0.5
                layer.weight.uniform_(-bound, bound, generator=generator)
                layer.bias.uniform_(-bound, bound, generator=generator)
            self.layers[-1].bias.zero_()

    def forward(self, features: torch.Tensor, dirs: torch.Tensor) -> torch.Tensor:
        """rgb (N, 3) in [0, 1] from features (N, F) and unit directions (N, 3) of the object's frame."""
        first, second, last = self.layers
        x = Encoding.apply(torch.cat([features, dirs], 1))
        return torch.sigmoid(last(torch.relu_(second(torch.relu_(first(x))))))


class Encoding(torch.autograd.Function):
    """(N, 5 D) blocks x, sin x, sin 2x, cos x, cos 2x of x (N, D), by one sine and one cosine for each x."""

    @staticmethod
    def forward(ctx, x):
        sin, cos = x.sin(), x.cos()
        out = torch.cat([x, sin, 2 * sin * cos, cos, 1 - 2 * sin * sin], 1)
        ctx.save_for_backward(out)
        return out

    @staticmethod
    def backward(ctx, d_out):
        (out,) = ctx.saved_tensors
        _, sin, sin2, cos, cos2 = out.chunk(5, 1)
        d_x, d_sin, d_sin2, d_cos, d_cos2 = d_out.chunk(5, 1)
        return (
            torch.addcmul(d_x, d_sin, cos)
            .addcmul_(d_cos, sin, value=-1)
            .addcmul_(d_sin2, cos2, value=2)
            .addcmul_(d_cos2, sin2, value=-2)
        )


class VMMLPField:
    """One VM tensor and a colour network; immutable but for the factors' `params` and the network's weights.

    It has no `render_rays`: shading is batched matrix products, which the renderer's general path feeds well.
    """

    kind = "vm-mlp"

    def __init__(self, factors: VMField, network: ColourNetwork):
        if len(factors.blocks) != 1:
            raise ValueError(f"a vm-mlp field has one block, found {len(factors.blocks)}")
        self.factors, self.network = factors, network

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
        return cls(factors, ColourNetwork(3 * shape.coefficients, width, generator))

    def with_occupancy(self, occupancy: OccupancyGrid) -> "VMMLPField":
        """The same numbers under another occupancy grid."""
        return VMMLPField(self.factors.with_occupancy(occupancy), self.network)

    def resampled(self, aabb: np.ndarray, resolution: tuple[int, int, int]) -> "VMMLPField":
        """The field on another box and resolution, with the same network."""
        return VMMLPField(self.factors.resampled(aabb, resolution), self.network)

    # -- reading: the factors' -------------------------------------------------------------------------------

    @property
    def shape(self) -> VMShape:
        """Ranks; the degree stands for the number of features."""
        return self.factors.shape

    @property
    def tensors(self) -> tuple[VMTensor, ...]:
        """The one tensor."""
        return self.factors.tensors

    @property
    def blocks(self) -> tuple[Block, ...]:
        """The one block."""
        return self.factors.blocks

    @property
    def params(self) -> torch.Tensor:
        """(P,) factors and colour basis; the network's weights are not among them."""
        return self.factors.params

    @property
    def occupancy(self) -> OccupancyGrid:
        """The factors' grid."""
        return self.factors.occupancy

    @property
    def aabb(self) -> np.ndarray:
        """(6,) float64 box in the field's frame."""
        return self.factors.aabb

    @property
    def voxel_size(self) -> float:
        """Finest texel spacing, in the field's frame."""
        return self.factors.voxel_size

    @property
    def layout(self) -> np.ndarray:
        """(1, 13) int64 offsets of the sections in params."""
        return self.factors.layout

    def parameter_groups(self) -> list[tuple[int, int, bool]]:
        """(low, high, whether it is a colour basis) of every group of `params`, in order."""
        return self.factors.parameter_groups()

    @property
    def kernel_shape(self) -> tuple[tuple[int, ...], ...]:
        """Ranks as the kernels take them."""
        return self.factors.kernel_shape

    @property
    def arrays(self) -> VMArrays:
        """What kernels read; `params` is shared, not copied."""
        return self.factors.arrays

    @property
    def grid(self) -> GridArrays:
        """The occupancy's arrays."""
        return self.factors.grid

    @property
    def basis(self) -> torch.Tensor:
        """(27, 3 rank) view of the matrix that makes features of products."""
        return self.factors.sections(0)["colour_basis"].flatten(0, 1)

    @property
    def loops(self) -> ModuleType:
        """The compiled loops of the factors' device."""
        return self.factors.loops

    def to(self, device: str | torch.device) -> "VMMLPField":
        """The field itself on the CPU. Raises ValueError for any other device."""
        if torch.device(device).type != "cpu":
            raise ValueError(f"a vm-mlp field is computed on the CPU only, found device '{device}'")
        return self

    # -- answering -------------------------------------------------------------------------------------------

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) and rgb (N, 3) at points (N, 3) along unit dirs (N, 3); 0 in empty cells. No gradient."""
        sigma, rgb = self.factors.query(points, dirs, with_colour=False)
        if with_colour:
            with torch.no_grad():
                for some in torch.nonzero(sigma > 0)[:, 0].split(POINTS_AT_ONCE):
                    some = torch.cat([some, some[-1:].expand(-len(some) % ROWS_PADDED)])
                    products = autograd.features(self, self.params, points[some])
                    rgb[some] = self.shade(products, dirs[some], self.basis)
        return sigma, rgb

    def shade(self, products: torch.Tensor, dirs: torch.Tensor, basis: torch.Tensor) -> torch.Tensor:
        """rgb (N, 3) from colour products (N, 3 rank) and unit dirs (N, 3), field's frame; differentiable."""
        to_object = torch.from_numpy(self.arrays.to_object[0])
        local = torch.nn.functional.normalize(dirs.double() @ to_object.T, dim=1).to(products.dtype)
        return self.network(products @ basis.T, local)

    # -- storing ---------------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """The factors' arrays and metadata, and the network's weights."""
        arrays, metadata = self.factors.state()
        weights = {name: values.detach().numpy() for name, values in named_weights(self.network)}
        return arrays | weights, metadata

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], metadata: dict) -> "VMMLPField":
        """Inverse of `state`; the network's width is that of its first bias."""
        factors = VMField.from_state(arrays, metadata)
        width = arrays.get("network.0.bias")
        if width is None or width.ndim != 1:
            raise ValueError("array 'network.0.bias' is missing or not a vector")
        network = ColourNetwork(3 * factors.shape.coefficients, len(width))
        with torch.no_grad():
            for name, values in named_weights(network):
                found = arrays.get(name)
                if found is None or found.shape != tuple(values.shape):
                    have = "nothing" if found is None else list(found.shape)
                    raise ValueError(f"array '{name}' should have shape {list(values.shape)}, found {have}")
                values.copy_(torch.from_numpy(np.ascontiguousarray(found, np.float32)))
        check_network(network)
        return cls(factors, network)


def check_network(network: ColourNetwork) -> None:
    """Raise ValueError where inputs of size 1 could grow past float32 on their way through the network: the
    product of its layers' largest row sums bounds them."""
    largest = 1.0
    for layer in network.layers:
        rows = layer.weight.detach().double().abs().sum(1) * largest + layer.bias.detach().double().abs()
        largest = float(rows.max())
    if not largest <= MAX_ANSWER:
        raise ValueError(
            f"arrays 'network.*' multiply to {largest:.3g}, which should be at most {MAX_ANSWER:g}"
        )


def named_weights(network: ColourNetwork) -> list[tuple[str, torch.nn.Parameter]]:
    """The network's weights by name: `network.<layer>.weight` (out, in) and `.bias` (out,)."""
    return [
        (f"network.{name.removeprefix('layers.')}", values) for name, values in network.named_parameters()
    ]
