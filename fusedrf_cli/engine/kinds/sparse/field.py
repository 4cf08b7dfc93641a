"""The `sparse` field: numbers only at the vertices of bricks of voxels, which lie where something is and are
as fine as it needs there.

Rows hold the density feature and the colour of degree 0; what changes with the view lies in bands, on a
lattice of voxels twice as wide. σ = scale softplus(f) and rgb = sigmoid(Σ_k Y_k c_k), interpolated before the
activation.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType

import numpy as np
import torch

from fusedrf_cli.engine.decoders import density_sum, sh
from fusedrf_cli.engine.encodings import bricks
from fusedrf_cli.engine.encodings.bricks import ROW, SIDE, active_at
from fusedrf_cli.engine.fields import large_pages
from fusedrf_cli.engine.fields.assembled import Assembled, HarmonicShape, Slot
from fusedrf_cli.engine.fields.base import FieldMemory, SamplingConfig, check_samples
from fusedrf_cli.engine.fields.box import MAX_ANSWER
from fusedrf_cli.engine.fields.computed import (
    PER_CELL,
    PER_CELL_MADE,
    Reads,
    StoredAs,
    exact,
    runs_of,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels.light import Exposure, Light
from fusedrf_cli.engine.kernels.primitives import LINE
from fusedrf_cli.engine.kernels.reference import exact as exact_tensor
from fusedrf_cli.engine.kinds.sparse import training
from fusedrf_cli.engine.kinds.sparse.bricks import BrickLimits, BrickTree, check_counts, table_entries
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded, name_of, space_named


@dataclass(frozen=True)
class BricksConfig:
    """Bytes in memory of a field of bricks, and how fine its occupancy is."""

    per_brick: int = 1200
    """Bytes in memory beside the numbers: rows of its vertices, its place, masks and tables."""
    per_brick_made: int = 5000
    """More while they are found."""
    per_brick_joined: int = 20_000
    """More while hanging vertices are found, where there are several levels."""
    per_top_cell: int = 10
    """Its table's place and depth."""
    per_node: int = 60
    """Of a node while the tree is walked: its code and place, and those of its children."""
    occupancy_cells: int = 192
    """Along the longest axis, at most, unless there are more top cells."""


@dataclass(frozen=True)
class SparseShape(HarmonicShape):
    """What a vertex holds."""

    sh_degree: int = 2

    @property
    def band_numbers(self) -> int:
        """Numbers of a row of bands."""
        return 3 * (self.coefficients - 1)

    @property
    def colour(self) -> dict[str, int]:
        """What the colour's encoding is called with."""
        return {"numbers": 3 * self.coefficients}

    @property
    def band_width(self) -> int:
        """Floats of a row of bands in memory."""
        return bricks.sizes(**self.colour)["BANDS"]


class SparseField(Assembled):
    """Vertices of bricks; immutable but for `params`, which optimisers update in place (`settle`
    afterwards)."""

    kind = "sparse"
    shift = 0.0  # of the density feature

    def __init__(
        self,
        shape: SparseShape,
        fine: VertexLattice,
        scale: float,
        params: torch.Tensor | None = None,
        space: ModuleType = bounded,
    ):
        """params (P,) float; None: zeros. The bricks lie in the coordinates of the space; ValueError where
        rays are curved in it, since loops leave bricks along straight lines."""
        if getattr(space, "CURVED", False):
            raise ValueError(f"bricks cannot lie in space {name_of(space)!r}, in which rays are curved")
        self.shape, self.fine, self.scale, self.lies_in = shape, fine, float(scale), space
        self.coarse = fine.wider if shape.sh_degree else None
        self.params = large_pages.zeros(self.size) if params is None else params

    def with_occupancy(self, occupancy: OccupancyGrid) -> "SparseField":
        """The same numbers without the voxels that lie in empty cells alone; itself where that would leave
        none."""
        lattice = training.occupied_voxels(self.fine, occupancy.contains)
        return self if lattice is None else self.on(lattice, occupancy.space)

    def reaching(self, contains: Callable[[np.ndarray], np.ndarray]) -> "SparseField | None":
        """The same numbers of the voxels that reach where `contains` says so of points (N, 3) of the
        coordinates of the space; None where there is none."""
        lattice = training.occupied_voxels(self.fine, contains)
        return None if lattice is None else self.on(lattice, self.lies_in)

    def with_voxels(self, holds: Callable[[np.ndarray], np.ndarray]) -> "SparseField | None":
        """The same numbers of the voxels of whose corners (N, 3), in the coordinates of the space, `holds`
        says (N,) that they are kept; None where there is none."""
        lattice = training.wholly_inside(self.fine, holds)
        return None if lattice is None else self.on(lattice, self.lies_in)

    def on(self, lattice: VertexLattice, space: ModuleType) -> "SparseField":
        """The same numbers on a part of its voxels, in the coordinates of a space."""
        other = SparseField(self.shape, lattice, self.scale, None, space).to(self.params.device)
        other.rows[:] = self.rows[self.fine.find(other.fine.keys)[0]]
        if other.coarse:
            other.bands[:] = self.bands[self.coarse.find(other.coarse.keys)[0]]
        other.settle()
        return other

    def resampled(self, aabb: np.ndarray, resolution: tuple[int, int, int]) -> "SparseField":
        """A field of one level on another box (6,), in whole bricks with at least that many vertices per
        axis, where this one's cells are occupied. Raises ValueError for a field of several levels."""
        training.check_one_level(self)
        lattice = training.whole_lattice(np.asarray(aabb, np.float64), resolution)
        return training.transferred(
            self, training.occupied_voxels(lattice, self.occupancy.contains) or lattice
        )

    def stored(self, as_stored: StoredAs) -> "SparseField":
        """See ComputedField; where the bricks are stays as it is, and need not be found again."""
        back = self.with_params(self.params.clone())
        for name, (view, lattice) in back._held().items():
            order, runs = lattice.stored_order
            view[order] = torch.from_numpy(as_stored(view[order].cpu().numpy(), name, runs)).to(view)
        back.settle()
        return back

    # -- reading ---------------------------------------------------------------------------------------------

    @property
    def tree(self) -> BrickTree:
        """Where the bricks are."""
        return self.fine.tree

    @property
    def resolution(self) -> tuple[int, int, int] | None:
        """Vertices per axis where all bricks are of one level; else None."""
        return None if self.tree.depth else tuple(SIDE * int(n) + 1 for n in self.tree.counts)

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
        return self._wide_bands[:, : self.shape.band_numbers]

    @property
    def _wide_bands(self) -> torch.Tensor:
        """(W, band_width) the same with what fills up their rows, which is 0."""
        count = len(self.coarse.vertices)
        return self.params[self.bands_at : self.bands_at + count * self.shape.band_width].view(count, -1)

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
        return cells_of(self.tree, self.lies_in)

    @cached_property
    def slots(self) -> dict[str, Slot]:
        """See Assembled."""
        colour = bricks.sizes(**self.shape.colour)["WIDTH"]
        harmonics = {"width": colour, "coefficients": self.shape.coefficients, "apart": True}
        return {
            "density": Slot(bricks, {"numbers": 1}),
            "colour": Slot(bricks, self.shape.colour),
            "sigma": Slot(density_sum),
            "rgb": Slot(sh, harmonics),
        }

    @property
    def activation(self) -> np.ndarray:
        """(2,) scale and shift, as kernels read them."""
        return np.asarray([self.scale, self.shift])

    @property
    def cube(self) -> tuple[np.ndarray, np.ndarray]:
        """See Assembled: the first top cell."""
        return self.tree.lo, self.tree.top

    @property
    def vertex_rows(self) -> tuple[np.ndarray, np.ndarray]:
        """(N, 125) and (N, 27) int32, rows of each brick's vertices, and of those of its bands."""
        return self.fine.rows, self.coarse.rows if self.coarse else np.zeros((0, 0), np.int32)

    def slot_starts(self) -> dict[str, np.ndarray]:
        """See Assembled: of the rows and of the bands."""
        both = np.array([0, self.bands_at])
        return {"density": both, "colour": both, "sigma": both[:0], "rgb": both[:0]}

    def slot_sections(self) -> dict[str, dict]:
        """See Assembled."""
        bands = {"bands": (self.coarse, self._wide_bands)} if self.coarse else {}
        colour = bands | {"rows": (self.fine, self.rows)}
        return {"density": {"rows": (self.fine, self.rows[:, :1])}, "colour": colour, "sigma": {}, "rgb": {}}

    def located(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """See Assembled: in top cells, where a voxel is active."""
        lo, side = (exact_tensor(corner, points.device) for corner in self.cube)
        unit = (points - lo) / side
        return unit, active_at(self.tree, unit)

    def exposed(
        self, low: np.ndarray, high: np.ndarray, directions: np.ndarray, far: float, blocked: float
    ) -> tuple[np.ndarray, np.ndarray]:
        """How much light reaches cubes of corners low and high (K, 3) along the clearest of the directions
        (D, 3), (K,), from `far` away or from outside the box, and the mean direction along which each is seen
        (K, 3), of length 1 where from one side alone. Light of less than `blocked` counts as none."""
        middles, sides = exact((low + high) / 2), (high - low).min(1)
        light = Light(middles, sides, exact(directions), float(far), float(blocked), self.voxel_size)
        exposure = Exposure(np.zeros(len(low)), np.zeros((len(low), 3)))
        self.loops.each("expose_cube", self.arrays, self.grid, light, len(low), exposure)
        return exposure.clearest, exposure.facing

    # -- learning --------------------------------------------------------------------------------------------

    def settle(self) -> None:
        """Make the hanging rows follow from the free ones, after these have changed."""
        for lattice, base, width in self._lattices():
            if lattice.spread.shape[0]:
                *edges, target = lattice.spreading
                self.device_loops.sums_of_rows(self.arrays.params, base, width, *edges, target, False)

    def dependent(self) -> list[tuple[int, int]]:
        """(low, high) of the runs of `params` that `settle` makes follow from the others: hanging rows."""
        return [
            (base + width * lattice.free, base + width * len(lattice.vertices))
            for lattice, base, width in self._lattices()
        ]

    def collect(self, grads: np.ndarray) -> None:
        """Hand the gradients of hanging rows on to what they hang on; their own no longer count."""
        for lattice, base, width in self._lattices():
            if lattice.spread.shape[0]:
                *edges, target = lattice.gathering
                for row in grads:
                    self.device_loops.sums_of_rows(row, base, width, *edges, target, True)

    def _lattices(self) -> list[tuple[VertexLattice, int, int]]:
        """Each lattice, where its rows begin in params, and how wide they are."""
        fine = [(self.fine, 0, ROW)]
        return fine + ([(self.coarse, self.bands_at, self.shape.band_width)] if self.coarse else [])

    # -- storing ---------------------------------------------------------------------------------------------

    def _held(self) -> dict[str, tuple[torch.Tensor, VertexLattice]]:
        """What is stored of each lattice: the view whose free rows these are."""
        bands = {"bands": (self.bands, self.coarse)} if self.coarse else {}
        return {"rows": (self.rows, self.fine)} | bands

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """Arrays and metadata for a bundle: the tree, from which all indices follow, and the free rows run by
        run (`VertexLattice.stored_order`), each in blocks of codes of its own, so that an edit elsewhere
        changes no number of it."""
        nodes, masks = self.tree.packed()
        arrays = {"nodes": nodes, "masks": masks}
        for name, (view, lattice) in self._held().items():
            order, runs = lattice.stored_order
            arrays |= {name: view[order].detach().cpu().numpy(), runs_of(name): runs}
        metadata = {
            "aabb": self.aabb.tolist(),
            "counts": list(self.tree.counts),
            "top": self.tree.top.tolist(),
            "phase": list(self.tree.phase),
            "scale": self.scale,
            "sh_degree": self.shape.sh_degree,
            "needs": ["runs"],
            **({} if self.lies_in is bounded else {"space": name_of(self.lies_in)}),
        }
        return arrays, metadata

    @classmethod
    def needs(cls, metadata: dict, shapes: Mapping[str, tuple[int, ...]], array: Reads) -> FieldMemory:
        """See `Kind.field_memory`; with the tables that follow from the tree."""
        config = current(BricksConfig)
        (bricks,), counts = shapes["masks"], metadata["counts"]
        top, bricks = math.prod(counts), bricks // 8
        entries, depth = table_entries(array("nodes"), top)
        numbers = sum(math.prod(shapes[name]) for name in ("rows", "bands") if name in shapes)
        cells = config.occupancy_cells**3 if max(counts) < config.occupancy_cells else top
        resident = config.per_brick * bricks + 4 * (numbers + entries) + PER_CELL * cells
        resident += config.per_top_cell * top
        making = (config.per_brick_made + (config.per_brick_joined if depth else 0)) * bricks
        return FieldMemory(
            resident, making + PER_CELL_MADE * cells + config.per_node * 4 * shapes["nodes"][0]
        )

    @classmethod
    def stored_occupancy(cls, metadata: dict, arrays: Mapping[str, np.ndarray]) -> OccupancyGrid:
        """See Kind."""
        return cells_of(stored_tree(arrays, metadata), space_named(metadata.get("space", "bounded")))

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], metadata: dict) -> "SparseField":
        """Inverse of `state`. Every number is checked before it can size an array or index one."""
        tree = stored_tree(arrays, metadata)
        shape = SparseShape(whole(metadata["sh_degree"], "sh_degree", 0, 3))
        space = space_named(metadata.get("space", "bounded"))
        field = cls(shape, VertexLattice(tree, SIDE), positive(metadata["scale"], "scale"), space=space)
        in_runs = "runs" in metadata.get("needs", [])
        for name, (view, lattice) in field._held().items():
            stored = arrays.get(name)
            expected = (lattice.free, view.shape[1])
            if stored is None or stored.shape != expected:
                have = "nothing" if stored is None else list(stored.shape)
                raise ValueError(f"array '{name}' should have shape {list(expected)}, found {have}")
            # a logit has at most 64 terms, each a coefficient times at most 3
            if not float(np.abs(stored).max(initial=0)) * max(field.scale, 64.0) <= MAX_ANSWER:
                raise ValueError(f"array '{name}' holds numbers whose answers would be beyond {MAX_ANSWER:g}")
            order, runs = lattice.stored_order if in_runs else (slice(lattice.free), None)
            if in_runs and not np.array_equal(arrays.get(runs_of(name)), runs):
                raise ValueError(f"array '{runs_of(name)}' should hold the runs of its tree's vertices")
            view[order] = torch.from_numpy(np.ascontiguousarray(stored, np.float32))
        field.settle()
        return field


def cells_of(tree: BrickTree, space: ModuleType) -> OccupancyGrid:
    """The cells of a space that the active voxels of a tree reach."""
    return replace(tree.occupancy(current(BricksConfig).occupancy_cells), space=space)


def stored_tree(arrays: Mapping[str, np.ndarray], metadata: dict) -> BrickTree:
    """The tree of a stored field. Raises ValueError naming what does not fit."""
    limits = current(BrickLimits)
    config = current(SamplingConfig)
    counts = metadata["counts"]
    if not isinstance(counts, list) or len(counts) != 3:
        raise ValueError(f"counts should be three whole numbers, found {counts}")
    counts = tuple(whole(n, "counts", 1, limits.top_cells) for n in counts)
    check_counts(counts)
    if not isinstance(metadata["top"], list) or len(metadata["top"]) != 3:
        raise ValueError(f"top should be three numbers, found {metadata['top']}")
    top = np.array([positive(side, "top") for side in metadata["top"]])
    aabb = np.asarray(metadata["aabb"], np.float64)
    if aabb.shape != (6,) or not np.isfinite(aabb).all():
        raise ValueError("aabb should be six finite numbers")
    if not np.allclose(aabb[3:] - aabb[:3], top * counts, rtol=1e-6):
        raise ValueError("aabb should be as many top cells wide as counts says")
    nodes, masks = (arrays.get(name) for name in ("nodes", "masks"))
    for name, stored in (("nodes", nodes), ("masks", masks)):
        if stored is None or stored.dtype != np.uint8 or stored.ndim != 1:
            raise ValueError(f"array '{name}' should be bytes in one dimension")
    if len(masks) > 8 * limits.bricks:
        raise ValueError(f"there should be at most {limits.bricks} bricks, found {len(masks) // 8}")
    tree = BrickTree.unpacked(aabb[:3], top, counts, nodes, masks)
    phase = metadata.get("phase", [0, 0, 0])
    if not isinstance(phase, list) or len(phase) != 3:
        raise ValueError(f"phase should be three numbers, found {phase}")
    tree = replace(tree, phase=tuple(whole(n, "phase", 0, 1) for n in phase))
    if not tree.mask.any():
        raise ValueError("array 'masks' should have an active voxel")
    check_samples(bounded.most_samples(tree.aabb, tree.unit.min()), "its bricks", config.most_of_bricks)
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
