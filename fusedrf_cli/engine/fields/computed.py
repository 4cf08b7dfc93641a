"""What all kinds of field share whose answers compiled loops compute from one flat vector of numbers."""

import math
from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine import kernels
from fusedrf_cli.engine.fields.base import FieldMemory
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels import GridArrays
from fusedrf_cli.engine.kernels.instances import Slots
from fusedrf_cli.engine.kernels.learning import QueryGradients
from fusedrf_cli.engine.kernels.loops import (
    RAYS_PER_TASK,
    Cells,
    PointBatch,
    PointValues,
    VoteRays,
    WeightRays,
)
from fusedrf_cli.engine.kernels.primitives import FARTHEST

StoredAs = Callable[[np.ndarray, str, np.ndarray | None], np.ndarray]
"""The numbers that an array (V, C) comes back with from a bundle: of the array, its name and the lengths of
the runs of its rows, or None."""


Reads = Callable[[str], np.ndarray]
"""A stored array by its name."""
PER_CELL = 2
"""Bytes of a cell of an occupancy grid: whether it is occupied, and how far it is from one that is."""
PER_CELL_MADE = 12
"""More while those distances are found."""


def runs_of(name: str) -> str:
    """The name of the array (R,) that holds the lengths of an array's runs of rows."""
    return f"{name}.runs"


NONE_KNOWN = np.empty(0)
AS_IT_IS = np.empty((0, 3, 3))


class Batch(NamedTuple):
    """Rays, what they should show, and how they are sampled."""

    rays_o: np.ndarray  # (n, 3) float64, in the field's frame
    rays_d: np.ndarray  # (n, 3) float64, unit length
    jitter: np.ndarray  # (n,) float64 in [0, 1), shift of a ray's samples in steps
    target: np.ndarray  # (n, 4) float, rgb over the background, and the captured alpha
    background: np.ndarray  # (n, 3) float
    opacity_weight: float
    near: float
    step: float
    early_stop: float
    distortion: float = 0.0  # weight of the loss by which a ray's density draws together
    light: float = 0.0  # weight under which a sample is followed back by chance alone; 0: every one is
    depth_weight: float = 0.0  # weight of the loss by which density comes to known depths
    depths: np.ndarray = NONE_KNOWN  # (m,) float64, how far away what the first m rays show is, if known
    # (n, 3, 3) float64, gains and offsets that make a ray's colour that of its photo, and weights; or none
    exposure: np.ndarray = AS_IT_IS


@dataclass(frozen=True)
class Group:
    """A stretch of a field's numbers that learn at one rate."""

    low: int
    high: int
    rate: float = 1.0
    """Relative to the optimiser's."""
    lines: np.ndarray | None = None
    """(L,) int64, where the cache lines begin in which a sample can reach any number; None: all of them."""
    fades: bool = False
    """Whether its numbers go back towards 0 where little speaks for them (Adam.fade)."""


class ComputedField:
    """A field that the loops of kernels/loops.py compute.

    A kind sets `kind` and `device_module`, its module of scalar functions; a field of it has `params` (P,),
    whose length is a multiple of LINE, `occupancy`, and `kernel_arrays`. Immutable but for `params`, which
    optimisers update in place (`settle` afterwards).
    """

    kind: str
    device_module: ModuleType
    params: torch.Tensor
    occupancy: OccupancyGrid

    resolution: tuple[int, int, int] | None = None
    """Texels per axis of a field on one grid over its box; None: it has none, and cells are not its to give
    up."""
    over_texels = True
    """Of a field that has `resampled`, whether all that depends on the point lies on texels, which that takes
    to another box."""

    # -- for kinds to define -----------------------------------------------------------------------------

    def kernel_arrays(self, params: object) -> NamedTuple:
        """The kind's Arrays, on the host, over `params` as the loops take them."""
        raise NotImplementedError

    def groups(self) -> list[Group]:
        """Parts of `params` that learn at rates of their own, in order, each of whole cache lines."""
        return [Group(0, self.params.numel())]

    def planes(self, numbers: torch.Tensor) -> list[torch.Tensor]:
        """Views of numbers (P,), the field's own or their gradients, as planes (A, B, components) of which
        neighbours lie side by side in space; most kinds have none."""
        return []

    def settle(self) -> None:
        """Make those numbers follow that depend on others, after these have changed."""

    def collect(self, grads: np.ndarray) -> None:
        """Hand on the gradients, rows (parts, P), of numbers that follow from others."""

    def dependent(self) -> list[tuple[int, int]]:
        """(low, high) of the runs of `params` that `settle` makes follow from the others."""
        return []

    def reference(
        self, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) and rgb (N, 3) with numbers params (P,) at points (N, 3) of the space's coordinates, σ per
        unit of them, in plain torch: on any device, and differentiable in all three. Raises ValueError where
        the kind has no reference."""
        raise ValueError(
            f"fields of kind '{self.kind}' have no reference in torch: they are computed on 'cpu' and 'cuda' "
            "only, and cannot be differentiated in points or directions; convert them to another kind"
        )

    def answers(
        self, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) per length of the frame and rgb (N, 3) at points (N, 3) of it, by `reference`."""
        at = self.space.contract(points)
        sigma, rgb = self.reference(params, at, dirs)
        return sigma * self.space.density_rates(at, dirs.to(at)).to(sigma.dtype), rgb

    # -- the same field otherwise ------------------------------------------------------------------------

    def with_params(self, params: torch.Tensor) -> "ComputedField":
        """The same field with other numbers."""
        other = copy(self)
        other.params = params
        return other._afresh("arrays", "grid", "loops")

    def with_occupancy(self, occupancy: OccupancyGrid) -> "ComputedField":
        """The same numbers under another occupancy grid, sampled evenly at the field's own step."""
        other = copy(self)
        other.occupancy = occupancy.marked(occupancy.occupied)
        return other._afresh("arrays", "grid")

    def to(self, device: str | torch.device) -> "ComputedField":
        """The same field with its numbers on a device: there it is asked, rendered and trained."""
        if self.params.device == torch.device(device):
            return self
        return self.with_params(self.params.to(device))

    def stored(self, as_stored: StoredAs) -> "ComputedField":
        """The field as it comes back from a bundle that keeps as_stored(array, name, runs) of each array of
        numbers; runs (R,) are those of its rows, or None."""
        arrays, metadata = self.state()
        stored_arrays = {
            name: as_stored(array, name, arrays.get(runs_of(name))) if array.dtype.kind == "f" else array
            for name, array in arrays.items()
        }
        return type(self).from_state(stored_arrays, metadata).to(self.params.device)

    def _afresh(self, *names: str) -> "ComputedField":
        """Itself without what was computed from things that have changed."""
        for name in names:
            self.__dict__.pop(name, None)
        return self

    # -- what the loops read -----------------------------------------------------------------------------

    @property
    def aabb(self) -> np.ndarray:
        """(6,) float64 box in the coordinates of the field's space."""
        return self.occupancy.aabb

    @property
    def space(self) -> ModuleType:
        """That its numbers and its cells lie in; its points and directions are those of its frame."""
        return self.occupancy.space

    @classmethod
    def needs(cls, metadata: dict, shapes: Mapping[str, tuple[int, ...]], array: Reads) -> FieldMemory:
        """See `Kind.field_memory`."""
        return FieldMemory(4 * sum(math.prod(shape) for shape in shapes.values()), 0)

    @classmethod
    def stored_occupancy(cls, metadata: dict, arrays: Mapping[str, np.ndarray]) -> OccupancyGrid | None:
        """See Kind."""
        return None

    @property
    def device_loops(self) -> ModuleType:
        """The module of loops of the device that the numbers lie on."""
        return kernels.device_loops(self.params.device.type)

    @property
    def gradient_rows(self) -> int:
        """How many rows loops add gradients to: one for each thread of the CPU; a GPU's threads share one."""
        return torch.get_num_threads() if self.params.device.type == "cpu" else 1

    @cached_property
    def loops(self) -> kernels.cpu.Loops:
        """The loops for fields of these sizes, on the device that the numbers lie on."""
        sizes = self.device_module.sizes(self)
        return self.device_loops.loops_for(self.device_module, tuple(sorted(sizes.items())), self.space)

    @cached_property
    def arrays(self) -> NamedTuple:
        """What kernels read; `params` is shared, not copied."""
        loops = self.device_loops
        return loops.on_device(self.kernel_arrays(loops.shared(self.params)))

    @cached_property
    def grid(self) -> GridArrays:
        """The occupancy's arrays."""
        return self.device_loops.on_device(self.occupancy.arrays)

    @property
    def real(self) -> np.dtype:
        """The type of the field's numbers."""
        return np.dtype(str(self.params.dtype).removeprefix("torch."))

    # -- answering ---------------------------------------------------------------------------------------

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) per unit of length and rgb (N, 3) at points (N, 3), seen along unit dirs (N, 3); 0 where the
        field is empty. Not differentiable."""
        if self.device_loops is None:
            with torch.no_grad():
                device = self.params.device
                values = self.answers(self.params, points.to(device), dirs.to(device))
                return tuple(answer.cpu() for answer in values)
        query = PointBatch(exact(points), exact(dirs), bool(with_colour))
        values = PointValues(np.empty(len(points), self.real), np.empty((len(points), 3), self.real))
        self.loops.each("query_point", self.arrays, self.grid, query, len(points), values)
        return torch.from_numpy(values.sigma), torch.from_numpy(values.rgb)

    def render_rays(
        self,
        rays_o: np.ndarray,
        rays_d: np.ndarray,
        reach: np.ndarray,
        step: float,
        early_stop: float,
        out: np.ndarray,
    ) -> None:
        """March, shade and composite in one pass, each ray from and to its distances reach (N, 2): the fast
        path of `render_rays` in volume.py, with the same columns in out (N, 5)."""
        count = len(out)
        each, reach = np.arange(count), np.minimum(exact(reach), FARTHEST)
        first, (begin, end) = np.zeros(count, np.int64), np.ascontiguousarray(reach.T)
        slots = Slots(
            exact(rays_o), exact(rays_d), reach, each, each, first, begin, end, np.eye(4)[None, :3],
            np.ones((1, 4)), np.zeros(2, np.int64), np.empty((0, 13)), float(step), float(early_stop), out,
        )  # fmt: skip
        out[:] = 0
        self.each("show_ray", slots, count, out, RAYS_PER_TASK)

    def each(self, item: str, query: NamedTuple, count: int, out: object, per_task: int) -> None:
        """An item of work for each i < count, which fills `out`; see Loops.each."""
        self.loops.each(item, self.arrays, self.grid, query, count, out, per_task)

    def peaks(self, lo: np.ndarray, cell: np.ndarray, cells: np.ndarray, offsets: np.ndarray) -> np.ndarray:
        """(N,) largest σ over offsets (K, 3) in each of `cells` (N, 3) int64 of a grid with corner lo (3,)
        and cells of size cell (3,)."""
        out = np.zeros(len(cells), self.real)
        at_once = 1 << 18  # between which an interrupt is heard
        for start in range(0, len(cells), at_once):
            part = slice(start, start + at_once)
            part_cells = np.ascontiguousarray(cells[part], np.int64)
            query = Cells(exact(lo), exact(cell), part_cells, exact(offsets))
            self.loops.each("peak_of_cell", self.arrays, self.grid, query, len(part_cells), out[part])
        return out

    def weights_in_cells(
        self, rays_o: np.ndarray, rays_d: np.ndarray, jitter: np.ndarray, near: float, step: float
    ) -> np.ndarray:
        """(X, Y, Z) for each cell of the occupancy the largest weight (NeRF, eq. 3) that a sample in it has
        on any of rays (N, 3)."""
        query = WeightRays(exact(rays_o), exact(rays_d), exact(jitter), float(near), float(step), 1e-3)
        parts = self.gradient_rows
        most = np.zeros((parts, self.occupancy.occupied.size), np.float32)
        out = most, np.zeros((parts, 3))
        self.loops.sweep("weigh_ray", self.arrays, self.grid, query, len(rays_o), 1, out)
        return most.max(0).reshape(self.occupancy.occupied.shape)

    def votes(
        self,
        rays_o: np.ndarray,
        rays_d: np.ndarray,
        jitter: np.ndarray,
        inside: np.ndarray,
        step: float,
        cells: OccupancyGrid,
    ) -> np.ndarray:
        """(2, X, Y, Z) for each cell of a grid in the field's space, occupied or not, the sum of the weights
        (NeRF, eq. 3) that samples in it have on those of rays (N, 3) that are not `inside` (N,), and on those
        that are."""
        counts = np.array(cells.occupied.shape, np.int64)
        query = VoteRays(
            exact(rays_o), exact(rays_d), exact(jitter), np.ascontiguousarray(inside, np.uint8), float(step),
            1e-3, exact(cells.aabb[:3]), exact(cells.cell), counts,
        )  # fmt: skip
        parts = self.gradient_rows
        sums = np.zeros((parts, 2 * cells.occupied.size), np.float32)
        out = sums, np.zeros((parts, 3))
        self.loops.sweep("vote_ray", self.arrays, self.grid, query, len(rays_o), 1, out)
        return np.moveaxis(sums.sum(0).reshape(*counts, 2), -1, 0)

    # -- learning ----------------------------------------------------------------------------------------

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
        d_sigma, d_rgb = as_array(d_sigma, self.real), as_array(d_rgb, self.real)
        sent = QueryGradients(exact(points), exact(dirs), d_sigma, d_rgb)
        out = grads, np.zeros((len(grads), 3))
        self.loops.sweep("query_point_backward", self.arrays, self.grid, sent, len(points), 1, out)
        self.collect(grads)

    def train_rays(self, batch: Batch, grads: np.ndarray, loss: np.ndarray) -> None:
        """One pass over rays: render, compare, and add the gradient of the loss to the rows of grads (parts,
        P).

        The loss of a batch is the mean over its rays of mean_c (C_c + (1 - A) background_c - target_c)² +
        opacity_weight (A - target_3)² + distortion (Σ_ij w_i w_j |s_i - s_j| + ⅓ Σ_i w_i² δ_i), with A the
        opacity, w the weights, s = t / (1 + t) and δ the lengths of the samples in s (Mip-NeRF 360, eq. 15).
        A ray of known depth D has a term more, depth_weight (Σ_i w_i a(t_i) + 1 - A), the light that ends
        elsewhere or nowhere: a is 0 where |t / D - 1| is up to DEPTH_TOLERANCE and 1 from twice that on. It
        is ours, after the losses along lidar's lines of sight of Urban Radiance Fields (Rematas et al. 2022).
        With batch.exposure, what is compared is gain_c (C_c + (1 - A) background_c) + offset_c, only
        one-sided where a photo's range ends (kernels/primitives.py, `within_range`), and the squares are
        weighted. loss (parts, 3) gains the sums over rays of the colour term, not weighted, where no depth is
        known, of the opacity term and of the samples taken. With batch.light above 0 the gradient is an
        estimate, whose mean over jitters is that of the loss (learning.py, `stochastic_backprop`).
        """
        count = len(batch.rays_o)
        most = self.space.most_samples(self.aabb, batch.step)
        batch = Batch(
            exact(batch.rays_o), exact(batch.rays_d), exact(batch.jitter), as_array(batch.target, self.real),
            as_array(batch.background, self.real), *map(float, batch[5:-2]), exact(batch.depths),
            exact(batch.exposure),
        )  # fmt: skip
        self.loops.sweep("train_ray", self.arrays, self.grid, batch, count, most, (grads, loss))
        self.collect(grads)


def exact(values: np.ndarray | torch.Tensor) -> np.ndarray:
    """Numbers as the loops take places and directions: float64, one row after the other."""
    return as_array(values, np.float64)


def as_array(values: np.ndarray | torch.Tensor, kind: np.dtype) -> np.ndarray:
    """A tensor or an array as an array of a type, one row after the other; not copied where it is one."""
    values = values.detach().cpu().numpy() if isinstance(values, torch.Tensor) else values
    return np.ascontiguousarray(values, kind)
