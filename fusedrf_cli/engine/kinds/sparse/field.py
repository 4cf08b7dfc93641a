"""The `sparse` field: numbers only at the vertices of bricks of voxels, which lie where something is and are
as fine as it needs there.

Rows hold the density feature and the colour of degree 0; what changes with the view lies in bands, on a
lattice of voxels twice as wide. σ = scale softplus(f) and rgb = sigmoid(Σ_k Y_k c_k), interpolated before the
activation.
"""

from dataclasses import dataclass
from functools import cached_property
from types import ModuleType

import numpy as np
import torch

from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels import GridArrays
from fusedrf_cli.engine.kernels.sparse_bodies import ROW, SIDE, SparseArrays
from fusedrf_cli.engine.kinds.sparse import reference
from fusedrf_cli.engine.kinds.sparse.bricks import MAX_BRICKS, MAX_TOP_CELLS, BrickTree, Lattice, check_counts

COARSE = 2  # voxels of the bands' lattice along a brick's side
PER_BRICK = 1200  # bytes in memory beside the numbers: rows of its vertices, its place, masks and tables
LINE = 16  # floats: the bands begin on a cache line, and a row of them is a whole number of half ones
MAX_ANSWER = 1e30  # of a density or a logit: finite in float32 also after a placement's largest stretch
MAX_TERMS = 64.0  # of a logit, each a coefficient times at most 3
OCCUPANCY_CELLS = 192  # along the longest axis, at most, unless there are more top cells
"""Bits of a mask: voxel (i, j, k) is bit (i * 4 + j) * 4 + k."""


@dataclass(frozen=True)
class SparseShape:
    """What a vertex holds."""

    sh_degree: int = 2

    def __post_init__(self):
        """Refuse degrees that the kernels were not written for."""
        if self.sh_degree not in range(4):
            raise ValueError(f"'sh_degree' should be 0, 1, 2 or 3, found {self.sh_degree}")

    @property
    def coefficients(self) -> int:
        """SH coefficients per channel."""
        return (self.sh_degree + 1) ** 2

    @property
    def band_numbers(self) -> int:
        """Numbers of a row of bands."""
        return 3 * (self.coefficients - 1)

    @property
    def band_width(self) -> int:
        """Floats of a row of bands in memory."""
        return -(-self.band_numbers // 8) * 8


class SparseField:
    """Vertices of bricks; immutable but for `params`, which optimisers update in place (`settle`
    afterwards)."""

    kind = "sparse"

    def __init__(self, shape: SparseShape, fine: Lattice, scale: float, params: torch.Tensor | None = None):
        """params (P,) float; None: zeros."""
        self.shape, self.fine, self.scale = shape, fine, float(scale)
        self.coarse = Lattice(fine.tree, COARSE) if shape.sh_degree else None
        self.params = torch.zeros(self.size) if params is None else params

    def with_params(self, params: torch.Tensor) -> "SparseField":
        """The same vertices with other numbers."""
        other = object.__new__(SparseField)
        other.shape, other.fine, other.scale, other.coarse = self.shape, self.fine, self.scale, self.coarse
        other.params = params
        return other

    def to(self, device: str | torch.device) -> "SparseField":
        """The same field with its numbers on a device: there it is asked, rendered and trained."""
        return (
            self if self.params.device == torch.device(device) else self.with_params(self.params.to(device))
        )

    def moved(self, origin: np.ndarray) -> "SparseField":
        """The same field in a frame whose origin is at `origin` (3,) of its own."""
        other = self.with_params(self.params)
        other.fine = self.fine.moved(origin)
        other.coarse = self.coarse.moved(origin) if self.coarse else None
        return other

    # -- reading ---------------------------------------------------------------------------------------------

    @property
    def tree(self) -> BrickTree:
        """Where the bricks are."""
        return self.fine.tree

    @property
    def bands_at(self) -> int:
        """Where the bands begin in params."""
        return -(-ROW * len(self.fine.vertices) // LINE) * LINE

    @property
    def size(self) -> int:
        """Floats of params, whole cache lines."""
        bands = self.shape.band_width * len(self.coarse.vertices) if self.coarse else 0
        return self.bands_at + -(-bands // LINE) * LINE

    @property
    def numbers(self) -> int:
        """Numbers that are stored: those of the free vertices."""
        return ROW * self.fine.free + (self.shape.band_numbers * self.coarse.free if self.coarse else 0)

    @property
    def rows(self) -> torch.Tensor:
        """(V, 4) view of the vertices' numbers: density feature, colours of degree 0."""
        return self.params[: ROW * len(self.fine.vertices)].view(-1, ROW)

    @property
    def bands(self) -> torch.Tensor:
        """(W, band_numbers) view of the coefficients of degree 1 and more, channel by channel."""
        if self.coarse is None:
            return self.params.new_zeros(0, 0)
        count = len(self.coarse.vertices)
        wide = self.params[self.bands_at : self.bands_at + count * self.shape.band_width].view(count, -1)
        return wide[:, : self.shape.band_numbers]

    @property
    def aabb(self) -> np.ndarray:
        """(6,) float64 box in the field's frame."""
        return self.tree.aabb

    @property
    def voxel_size(self) -> float:
        """Shortest side of the finest voxel."""
        return float(self.tree.unit.min())

    @cached_property
    def occupancy(self) -> OccupancyGrid:
        """Cells that active voxels reach."""
        return self.tree.occupancy(OCCUPANCY_CELLS)

    @property
    def kernel_shape(self) -> tuple[tuple[int, ...], tuple[int, ...]]:
        """Widths and SH coefficients as tuples whose lengths the compiler sees (sparse_bodies.py)."""
        return (0,) * self.shape.band_width, (0,) * self.shape.coefficients

    @cached_property
    def arrays(self) -> SparseArrays:
        """What kernels read; `params` is shared, not copied."""
        tree = self.tree
        offset, depth, table = tree.tables
        weights = np.uint64(1) << np.arange(SIDE**3, dtype=np.uint64)
        mask = (tree.mask.reshape(-1, SIDE**3) * weights).sum(1, dtype=np.uint64)
        arrays = SparseArrays(
            self.loops.shared(self.params),
            self.bands_at,
            self.scale,
            tree.lo,
            tree.top,
            offset,
            depth,
            table,
            tree.level,
            mask,
            self.fine.rows,
            self.coarse.rows if self.coarse else np.zeros((0, 0), np.int32),
            COARSE,
            tree.depth,
        )
        return self.loops.on_device(arrays)

    @property
    def loops(self) -> ModuleType:
        """The compiled loops of the device that the numbers lie on."""
        return kernels.sparse_loops(self.params.device.type)

    @cached_property
    def grid(self) -> GridArrays:
        """The occupancy's arrays."""
        return self.loops.on_device(self.occupancy.arrays)

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) and rgb (N, 3) at points (N, 3) along unit dirs (N, 3); 0 where no voxel is active. Not
        differentiable."""
        sigma = np.empty(len(points), self.arrays.params.dtype)
        rgb = np.empty((len(points), 3), self.arrays.params.dtype)
        self.loops.query(
            *self.kernel_shape, self.arrays, points.numpy(), dirs.numpy(), with_colour, sigma, rgb
        )
        return torch.from_numpy(sigma), torch.from_numpy(rgb)

    def render_rays(
        self,
        rays_o: np.ndarray,
        rays_d: np.ndarray,
        near: float,
        step: float,
        early_stop: float,
        out: np.ndarray,
    ) -> None:
        """March, shade and composite in one pass: the fast path of `render_rays` in volume.py, with the same
        columns in out (N, 5)."""
        read = *self.kernel_shape, self.arrays, self.grid
        self.loops.render(*read, rays_o, rays_d, near, step, early_stop, out)

    def exposed(
        self, low: np.ndarray, high: np.ndarray, directions: np.ndarray, far: float, blocked: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """How much light reaches cubes of corners low and high (K, 3) along the clearest of the directions
        (D, 3), (K,), from `far` away or from outside the box, and the mean direction along which each is seen
        (K, 3), of length 1 where from one side alone. Light of less than `blocked` counts as none."""
        clearest, facing = np.zeros(len(low)), np.zeros((len(low), 3))
        sides = (high - low).min(1)
        self.loops.expose(self.arrays, (low + high) / 2, sides, directions, far, blocked, clearest, facing)
        return clearest, facing

    def reference(
        self, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """As `query` with other numbers params (P,), in plain torch; see sparse/reference.py."""
        return reference.query(self, params, points, dirs)

    # -- learning --------------------------------------------------------------------------------------------

    def query_backward(
        self,
        points: torch.Tensor,
        dirs: torch.Tensor,
        d_sigma: torch.Tensor,
        d_rgb: torch.Tensor,
        grads: np.ndarray,
    ) -> None:
        """Adjoint of `query`: add to the rows of grads (parts, P) what the derivatives d_sigma (N,) and d_rgb
        (N, 3) of a loss send back to `params`."""
        back = points.numpy(), dirs.numpy(), d_sigma.numpy(), d_rgb.numpy()
        self.loops.query_backward(*self.kernel_shape, self.arrays, *back, grads)
        self._collect(grads)

    def train_rays(
        self,
        rays_o: np.ndarray,
        rays_d: np.ndarray,
        jitter: np.ndarray,
        step: float,
        early_stop: float,
        target: np.ndarray,
        background: np.ndarray,
        opacity_weight: float,
        grads: np.ndarray,
        loss: np.ndarray,
        near: float = 0.0,
    ) -> None:
        """Render rays (N, 3), compare with target (N, 4), add the gradient to the rows of grads (parts, P)
        and the losses and samples to those of loss (parts, 3); see cpu.train_rays for the loss."""
        slots = int(np.linalg.norm(self.aabb[3:] - self.aabb[:3]) / step) + 2
        self.loops.train_rays(
            *self.kernel_shape, self.arrays, self.grid, rays_o, rays_d, near, jitter, step, early_stop,
            target, background, opacity_weight, slots, grads, loss,
        )  # fmt: skip
        self._collect(grads)

    def parameter_groups(self) -> list[tuple[int, int, bool]]:
        """(low, high, whether it is a colour basis) of every group of `params`, in order."""
        return [(0, self.params.numel(), False)]

    def settle(self) -> None:
        """Make the hanging rows follow from the free ones, after these have changed."""
        for lattice, base, width in self._lattices():
            if lattice.spread.shape[0]:
                *edges, target = lattice.spreading
                self.loops.sums_of_rows(self.arrays.params, base, width, *edges, target, False)

    def dependent(self) -> list[tuple[int, int]]:
        """(low, high) of the runs of `params` that `settle` makes follow from the others: hanging rows."""
        return [
            (base + width * lattice.free, base + width * len(lattice.vertices))
            for lattice, base, width in self._lattices()
        ]

    def _collect(self, grads: np.ndarray) -> None:
        """Hand the gradients of hanging rows on to what they hang on; their own no longer count."""
        for lattice, base, width in self._lattices():
            if lattice.spread.shape[0]:
                *edges, target = lattice.gathering
                for row in grads:
                    self.loops.sums_of_rows(row, base, width, *edges, target, True)

    def _lattices(self) -> list[tuple[Lattice, int, int]]:
        """Each lattice, where its rows begin in params, and how wide they are."""
        fine = [(self.fine, 0, ROW)]
        return fine + ([(self.coarse, self.bands_at, self.shape.band_width)] if self.coarse else [])

    # -- storing ---------------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """Arrays and metadata for a bundle: the free rows, brick by brick, and the tree; all indices
        follow."""
        nodes, masks = self.tree.packed()
        arrays = {"rows": self.rows[: self.fine.free].detach().cpu().numpy(), "nodes": nodes, "masks": masks}
        if self.coarse:
            arrays["bands"] = self.bands[: self.coarse.free].detach().cpu().numpy()
        metadata = {
            "aabb": self.aabb.tolist(),
            "counts": list(self.tree.counts),
            "top": self.tree.top.tolist(),
            "scale": self.scale,
            "sh_degree": self.shape.sh_degree,
        }
        return arrays, metadata

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], metadata: dict) -> "SparseField":
        """Inverse of `state`. Every number is checked before it can size an array or index one."""
        tree = stored_tree(arrays, metadata)
        shape = SparseShape(whole(metadata["sh_degree"], "sh_degree", 0, 3))
        field = cls(shape, Lattice(tree, SIDE), positive(metadata["scale"], "scale"))
        held = {"rows": (field.rows, field.fine)} | (
            {"bands": (field.bands, field.coarse)} if field.coarse else {}
        )
        for name, (view, lattice) in held.items():
            found = arrays.get(name)
            expected = (lattice.free, view.shape[1])
            if found is None or found.shape != expected:
                have = "nothing" if found is None else list(found.shape)
                raise ValueError(f"array '{name}' should have shape {list(expected)}, found {have}")
            if not float(np.abs(found).max(initial=0)) * max(field.scale, MAX_TERMS) <= MAX_ANSWER:
                raise ValueError(f"array '{name}' holds numbers whose answers would be beyond {MAX_ANSWER:g}")
            view[: lattice.free] = torch.from_numpy(np.ascontiguousarray(found, np.float32))
        field.settle()
        return field


def stored_tree(arrays: dict[str, np.ndarray], metadata: dict) -> BrickTree:
    """The tree of a stored field. Raises ValueError naming what does not fit."""
    counts = metadata["counts"]
    if not isinstance(counts, list) or len(counts) != 3:
        raise ValueError(f"counts should be three whole numbers, found {counts}")
    counts = tuple(whole(n, "counts", 1, MAX_TOP_CELLS) for n in counts)
    check_counts(counts)
    if not isinstance(metadata["top"], list) or len(metadata["top"]) != 3:
        raise ValueError(f"top should be three numbers, found {metadata['top']}")
    top = np.array([positive(side, "top") for side in metadata["top"]])
    aabb = np.asarray(metadata["aabb"], np.float64)
    if aabb.shape != (6,) or not np.isfinite(aabb).all():
        raise ValueError("aabb should be six finite numbers")
    if not np.allclose(aabb[3:] - aabb[:3], top * counts, rtol=1e-6):
        raise ValueError("aabb should be as many top cells wide as counts says")
    for name in ("nodes", "masks"):
        found = arrays.get(name)
        if found is None or found.dtype != np.uint8 or found.ndim != 1:
            raise ValueError(f"array '{name}' should be bytes in one dimension")
    if len(arrays["masks"]) > 8 * MAX_BRICKS:
        raise ValueError(f"there should be at most {MAX_BRICKS} bricks, found {len(arrays['masks']) // 8}")
    tree = BrickTree.unpacked(aabb[:3], top, counts, arrays["nodes"], arrays["masks"])
    if not tree.mask.any():
        raise ValueError("array 'masks' should have an active voxel")
    tree.tables  # noqa: B018  (made now, so that what is too large is refused here)
    return tree


def whole(value: object, what: str, least: int, most: int) -> int:
    """A whole number between two others, both among them; ValueError."""
    if type(value) is not int or not least <= value <= most:
        raise ValueError(f"{what} should be a whole number from {least} to {most}, found {value!r}")
    return value


def positive(value: object, what: str) -> float:
    """A finite number above 0; ValueError."""
    if type(value) not in (int, float) or not 1e-12 <= value <= 1e12:
        raise ValueError(f"{what} should be a number from 1e-12 to 1e12, found {value!r}")
    return float(value)
