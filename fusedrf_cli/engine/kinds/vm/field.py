"""The `vm` field: vector-matrix decomposed grids (TensoRF, Chen et al. ECCV 2022) with spherical-harmonic
colour.

A VM field is one or more VM *tensors*, each in its own object frame, and *blocks* that place them in the
field's frame. With one block it is TensoRF's. With several, an ownership grid says per cell which block is
asked (two where they meet; the denser wins), so that a query costs the same however many there are, and an
edit appends or drops a block and leaves the rest as it is.
"""

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from types import ModuleType

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import WHITE
from fusedrf_cli.engine.encodings.plane_line import MODES
from fusedrf_cli.engine.fields import pages
from fusedrf_cli.engine.fields.base import FieldNeeds, SamplingConfig, check_samples, sampling_step
from fusedrf_cli.engine.fields.box import (
    DENSITY_SCALE_PER_EXTENT,
    DENSITY_SHIFT,
    MAX_ANSWER,
    interpolate_axis,
    largest,
    unit_texels,
    whole_numbers,
)
from fusedrf_cli.engine.fields.computed import (
    FEW_CELLS,
    PER_CELL,
    PER_CELL_MADE,
    ComputedField,
    Group,
    Reads,
    StoredAs,
    packed_bits,
    runs_of,
    unpack_bits,
)
from fusedrf_cli.engine.fields.hashed import MAX_LEVELS, MAX_ROWS, MAX_VERTEX, Hashed, Held
from fusedrf_cli.engine.fields.occupancy import (
    PROBES,
    OccupancyConfig,
    OccupancyGrid,
    placed_cells,
    squeezed,
    transformed_aabb,
    unbounded_cells,
)
from fusedrf_cli.engine.fields.pace import Pace
from fusedrf_cli.engine.kernels.parts import LINE
from fusedrf_cli.engine.kinds.vm import bodies, reference
from fusedrf_cli.engine.kinds.vm.bodies import NO_BLOCK
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded, name_of, space_named, unbounded

ROUNDING = 1e-6  # share of a ball's radius by which it is larger
CELLS_PER_NUMBER = 4  # of a tensor, from which on its cells are stored in bricks where these are smaller
PER_OWNED_CELL = 8  # bytes of a cell of several blocks: owners, distances, strides
PER_OWNED_CELL_MADE = 16  # more while they are found
PER_PLACED_CELL = 110  # of a tensor's cell while it is placed in the field
NO_OWNERS = (np.zeros((0, 0, 0), np.uint8),) * 2
MOST_MARKED = 1 << 26
"""Occupied cells of all blocks together from which on several are marked as one: 32 times 128³ of them."""
MOST_PROBED = 1 << 32
"""Probes times ranks of the cells in which more than two blocks meet, from which on neighbours share them."""
TOUCHING = 1e-6  # of a block's peak: its rank in a cell where no probe meets its matter
MAX_RANK = 1024  # of a stored field
BASIS_RATE = 0.15  # of the factors'; at a third of it, as in TensoRF, a fox after a minute shows 0.5 dB less
DETAIL_RATE = 0.5  # at 1 smooth things come out grainy: a cup after 100 s SSIM 0.77, with 0.5 0.79
DETAIL_STEP = 2.0
"""Of the finest spacing of its vertices, at which pictures sample a detail."""
MAX_NUMBERS = 2 << 30  # of a field that is read: of a detail a file may hold few rows
DETAIL_FROM = 100  # texels from which a detail learns; before, it would learn what is coarse


@dataclass(frozen=True)
class VMTensor:
    """Shape and units of one VM tensor; its numbers lie in the field's flat parameter vector."""

    resolution: tuple[int, int, int]
    """Texels per axis, corners on the faces of the box; at least 2."""
    aabb: np.ndarray
    """(6,) float64, in the object's frame."""
    scale: float
    """σ_object = scale * softplus(feature + shift), in 1/length of the object's frame."""
    shift: float = DENSITY_SHIFT
    occupied: np.ndarray | None = None
    """(X, Y, Z) bool cells of the box that hold matter; None: all. What the tensor says elsewhere was never
    learnt."""
    space: ModuleType = bounded
    """That the box lies in (engine/spaces)."""
    hashed: Hashed | None = None
    """What is finer than the texels."""
    held: tuple[int, int] | None = None
    """How many of its rows are not 0, where few are, and how many blocks of them (`Held`) have any."""

    def sections(self, shape: "VMShape") -> list[tuple[str, tuple[int, ...]]]:
        """Names and shapes of its sections, in the order of bodies.py."""
        detail = [("detail", self.hashed.shape)] if self.hashed else []
        return shape.sections(self.resolution) + detail

    def size(self, shape: "VMShape") -> int:
        """Its floats in the flat vector."""
        return sum(aligned(int(np.prod(section))) for _, section in self.sections(shape))

    @cached_property
    def occupancy(self) -> OccupancyGrid:
        """The occupancy grid in the object's frame, which says how closely pictures sample it."""
        full = OccupancyGrid.full(self.aabb, space=self.space)
        occupied = full.occupied if self.occupied is None else self.occupied
        return replace(full, occupied=occupied, unit=self.step)

    @property
    def apart(self) -> np.ndarray:
        """(X, Y, Z) uint8, how many cells a cell of its occupancy grid is from the nearest with matter."""
        return self.occupancy.skip

    @property
    def voxel_size(self) -> np.ndarray:
        """(3,) spacing of texels in the object's frame."""
        return (self.aabb[3:] - self.aabb[:3]) / (np.asarray(self.resolution) - 1)

    @property
    def step(self) -> float:
        """At which pictures sample it."""
        step = self.space.picture_step(float(self.voxel_size.min()))
        return min(step, DETAIL_STEP * min(self.hashed.spacings)) if self.hashed else step


@dataclass(frozen=True)
class Block:
    """A VM tensor placed in the field's frame."""

    tensor: int
    object_to_field: np.ndarray
    """(4, 4) float64 affine; columns act on points."""
    name: str
    """The node of the scene graph it stands for."""
    tint: tuple[float, float, float] = WHITE
    """That its colours are multiplied by."""


@dataclass(frozen=True)
class VMShape:
    """What all tensors of one field share."""

    density_rank: int = 16
    """Components per mode of the density."""
    colour_rank: int = 24
    """Components per mode of the colour features."""
    sh_degree: int = 2

    def __post_init__(self):
        """Refuse what the kernels were not written for: they work on runs of eight components and on four SH
        bands."""
        for name in ("density_rank", "colour_rank"):
            rank = getattr(self, name)
            if type(rank) is not int or not 8 <= rank <= MAX_RANK or rank % 8:
                raise ValueError(f"'{name}' should be a multiple of 8 up to {MAX_RANK}, found {rank}")
        if self.sh_degree not in range(4):
            raise ValueError(f"'sh_degree' should be 0, 1, 2 or 3, found {self.sh_degree}")

    @property
    def coefficients(self) -> int:
        """SH coefficients per channel."""
        return (self.sh_degree + 1) ** 2

    def sections(self, resolution: tuple[int, int, int]) -> list[tuple[str, tuple[int, ...]]]:
        """Names and shapes of a tensor's 13 sections, in the order of bodies.py."""
        n = resolution
        named = []
        for what, rank in (("density", self.density_rank), ("colour", self.colour_rank)):
            named += [(f"{what}_plane_{m}", (n[a], n[b], rank)) for m, (a, b, _) in enumerate(MODES)]
            named += [(f"{what}_line_{m}", (n[c], rank)) for m, (_, _, c) in enumerate(MODES)]
        return [*named, ("colour_basis", (3, self.coefficients, 3 * self.colour_rank))]

    def size(self, resolution: tuple[int, int, int]) -> int:
        """Floats of a tensor in the flat vector."""
        return sum(aligned(int(np.prod(shape))) for _, shape in self.sections(resolution))


def aligned(count: int) -> int:
    """Count rounded up to whole cache lines."""
    return -(-count // LINE) * LINE


class VMField(ComputedField):
    """One or more placed VM tensors; see the module's docstring. Immutable but for `params`, which optimisers
    update in place."""

    kind, bodies = "vm", bodies

    def __init__(
        self,
        shape: VMShape,
        tensors: tuple[VMTensor, ...],
        blocks: tuple[Block, ...],
        params: torch.Tensor,
        occupancy: OccupancyGrid,
        owners: tuple[np.ndarray, np.ndarray] | None = None,
    ):
        """params (P,) float; owners are two (X, Y, Z) uint8 grids on the occupancy's cells, needed with more
        than one block."""
        if len(blocks) > 1 and owners is None:
            raise ValueError("a vm field of several blocks needs its ownership grids")
        self.shape, self.tensors, self.blocks, self.params = shape, tensors, blocks, params
        self.occupancy, self.owners = occupancy, owners

    # -- making ----------------------------------------------------------------------------------------------

    @classmethod
    def create(
        cls,
        aabb: np.ndarray,
        resolution: tuple[int, int, int],
        shape: VMShape,
        generator: torch.Generator,
        name: str = "",
        hashed: Hashed | None = None,
    ) -> "VMField":
        """An untrained field: factors N(0, 0.1²) as TensoRF's, colour basis uniform as a linear layer's, no
        detail yet."""
        aabb = np.asarray(aabb, np.float64)
        scale = DENSITY_SCALE_PER_EXTENT / float((aabb[3:] - aabb[:3]).mean())
        tensor = VMTensor(resolution, aabb, scale, hashed=hashed)
        params = 0.1 * torch.randn(tensor.size(shape), generator=generator)
        field = cls(shape, (tensor,), (Block(0, np.eye(4), name),), params, OccupancyGrid.full(aabb))
        bound = (3 * shape.colour_rank) ** -0.5
        sections = field.sections(0)
        sections["colour_basis"].uniform_(-bound, bound, generator=generator)
        if hashed:
            sections["detail"].zero_()
        return field

    def with_occupancy(self, occupancy: OccupancyGrid) -> "VMField":
        """The same numbers of a one-block field under another occupancy grid of its box."""
        tensor = replace(self.tensors[0], occupied=occupancy.occupied, space=occupancy.space)
        return VMField(self.shape, (tensor,), self.blocks, self.params, tensor.occupancy)

    @classmethod
    def assembled(
        cls, shape: VMShape, tensors: tuple[VMTensor, ...], blocks: tuple[Block, ...], params: torch.Tensor
    ) -> "VMField":
        """A field whose occupancy and ownership follow from its blocks: each cell is owned by the one or two
        densest there, and sampled as the finest there needs."""
        config = current(OccupancyConfig)
        if len(blocks) == 1 and np.array_equal(blocks[0].object_to_field, np.eye(4)):
            return cls(shape, tensors, blocks, params, tensors[blocks[0].tensor].occupancy)
        grids = [(tensors[b.tensor].occupancy, b.object_to_field) for b in blocks]
        if any(grid.space is unbounded for grid, _ in grids):
            marks = unbounded_cells(marked_as(grids), config.scene_cells)
            space, aabb = unbounded, unbounded.WHOLE
        else:
            boxes = np.stack([transformed_aabb(grid.tight_aabb(0), matrix) for grid, matrix in grids])
            space, (aabb, marks) = bounded, placed_cells(boxes, marked_as(grids), config.scene_cells)
        steps = [tensors[b.tensor].step for b in blocks]
        pace = Pace(OccupancyGrid.full(aabb, config.scene_cells, space))
        first, second, count = claimed_cells(pace.kept(marks, grids, steps))
        occupancy = pace.grid(count > 0)
        unsettled = cls(shape, tensors, blocks, params, occupancy, owners=(first, second))
        settle_crowded(unsettled, np.argwhere(count > 2), first, second)
        return unsettled._afresh("arrays")

    def resampled(self, aabb: np.ndarray, resolution: tuple[int, int, int]) -> "VMField":
        """A one-block field on another box and resolution: planes and lines are interpolated, outside the old
        box they are 0; the detail, which lies in the tensor's coordinates, stays."""
        if self.params.device.type != "cpu":
            return self.to("cpu").resampled(aabb, resolution).to(self.params.device)
        (tensor,), (block,) = self.tensors, self.blocks
        aabb = np.asarray(aabb, np.float64)
        resized = replace(tensor, resolution=resolution, aabb=aabb)
        params = pages.zeros(resized.size(self.shape), self.params.dtype)
        occupancy = replace(self.occupancy, unit=resized.step)
        new = VMField(self.shape, (resized,), (block,), params, occupancy)
        at = [unit_texels(aabb, tensor.aabb, axis, resolution[axis]) for axis in range(3)]
        old, target = self.sections(0), new.sections(0)
        for what in ("density", "colour"):
            for m, (a, b, c) in enumerate(MODES):
                target[f"{what}_plane_{m}"].copy_(
                    interpolate_axis(interpolate_axis(old[f"{what}_plane_{m}"], 0, at[a]), 1, at[b])
                )
                target[f"{what}_line_{m}"].copy_(interpolate_axis(old[f"{what}_line_{m}"], 0, at[c]))
        for name in old.keys() & {"colour_basis", "detail"}:
            target[name].copy_(old[name])
        return new

    def stored(self, as_stored: StoredAs) -> "VMField":
        """See ComputedField; which block is asked where stays as it is, and need not be found again."""
        back = self.with_params(pages.zeros(len(self.params), self.params.dtype, self.params.device))
        for t in range(len(self.tensors)):
            target = back.sections(t)
            for name, view in self.sections(t).items():
                numbers = view.detach().cpu().numpy()
                held = Held.of(numbers) if name == "detail" else None
                if held is None:
                    target[name].copy_(torch.from_numpy(as_stored(numbers, name, None)))
                    continue
                found = torch.from_numpy(as_stored(numbers[held.rows], name, held.lengths))
                target[name][torch.from_numpy(held.rows)] = found.to(view)
        return back

    # -- reading ---------------------------------------------------------------------------------------------

    @property
    def resolution(self) -> tuple[int, int, int] | None:
        """Texels per axis of the one tensor; None where there are several blocks."""
        return self.tensors[0].resolution if len(self.blocks) == 1 else None

    @property
    def voxel_size(self) -> float:
        """Finest texel spacing of any block, in the field's frame."""
        return min(self.voxel_sizes())

    def voxel_sizes(self) -> list[float]:
        """Finest texel spacing of every block, in the field's frame."""
        finest = [self.tensors[b.tensor].voxel_size.min() for b in self.blocks]
        return [
            float(size) * squeezed(b.object_to_field) for size, b in zip(finest, self.blocks, strict=True)
        ]

    def sections(self, tensor: int) -> dict[str, torch.Tensor]:
        """Views of the parameters of one tensor, by name."""
        sections, found = self.tensors[tensor].sections(self.shape), {}
        for offset, (name, shape) in zip(self.layout[tensor], sections, strict=False):
            found[name] = self.params[int(offset) : int(offset) + int(np.prod(shape))].view(shape)
        return found

    def planes(self, numbers: torch.Tensor) -> list[torch.Tensor]:
        """See ComputedField: three of density and three of colour, of each tensor."""
        found = []
        for t in range(len(self.tensors)):
            own = self.with_params(numbers).sections(t)
            found += [section for name, section in own.items() if "_plane_" in name]
        return found

    @cached_property
    def layout(self) -> np.ndarray:
        """(T, 14) int64 offsets of the sections in params; that of a detail which a tensor has not is its
        end."""
        rows, start = [], 0
        for tensor in self.tensors:
            sizes = [aligned(int(np.prod(shape))) for _, shape in tensor.sections(self.shape)]
            offsets = start + np.cumsum([0, *sizes])
            rows.append(offsets[:14])
            start = int(offsets[-1])
        return np.asarray(rows, np.int64)

    def kernel_arrays(self, params: object) -> bodies.Arrays:
        """See ComputedField."""
        boxes = [self.tensors[block.tensor].aabb for block in self.blocks]
        first, second = self.owners if self.owners is not None else NO_OWNERS
        owners = first + np.uint16(256) * second
        return bodies.Arrays(
            params,
            self.layout,
            np.asarray([t.resolution for t in self.tensors], np.int64),
            self.to_unit,
            np.stack([np.linalg.inv(block.object_to_field)[:3, :3] for block in self.blocks]),
            np.asarray([b.tensor for b in self.blocks], np.int64),
            np.asarray([[t.scale, t.shift] for t in self.tensors], self.real),
            owners,
            *(self.apart if self.owners is not None else apart_arrays(())),
            self.cell_sizes(),
            np.asarray(self.crossings, np.uint8),
            np.stack([np.concatenate([box[:3], 1 / (box[3:] - box[:3])]) for box in boxes]),
            *detail_arrays(self.tensors, self.real),
        )

    @property
    def to_unit(self) -> np.ndarray:
        """(B, 3, 4) `to_unit` of bodies.py."""
        found = []
        for block, steps in zip(self.blocks, self.crossings, strict=True):
            box, to_cube = self.tensors[block.tensor].aabb, np.eye(4)
            if steps != 2:  # there the box is of coordinates, see `part`
                to_cube[:3, :3] = np.diag(1.0 / (box[3:] - box[:3]))
                to_cube[:3, 3] = -to_cube[:3, :3] @ box[:3]
            found.append((to_cube @ np.linalg.inv(block.object_to_field))[:3])
        return np.stack(found)

    @cached_property
    def apart(self) -> tuple[np.ndarray, np.ndarray]:
        """`apart` and `apart_at` of bodies.py."""
        return apart_arrays(self.tensors)

    @cached_property
    def alone(self) -> tuple["VMField", ...]:
        """Each block as a field of its own, in its object's frame, over the same numbers."""
        found = []
        for block in self.blocks:
            tensor, start = self.tensors[block.tensor], int(self.layout[block.tensor, 0])
            numbers = self.params[start : start + tensor.size(self.shape)]
            own = Block(0, np.eye(4), block.name, block.tint)
            found.append(VMField(self.shape, (tensor,), (own,), numbers, tensor.occupancy))
        return tuple(found)

    def _afresh(self, *names: str) -> "VMField":
        """See ComputedField."""
        return super()._afresh("alone", *names)

    @cached_property
    def crossings(self) -> list[int]:
        """For each block how a point in the coordinates of the field's space comes to its tensor: 0, by an
        affine map; 1, by way of the field's frame; 2, and from there into an unbounded space of its own."""
        found = []
        for block in self.blocks:
            own = self.tensors[block.tensor].space
            if own is self.space and (own is bounded or np.array_equal(block.object_to_field, np.eye(4))):
                found.append(0)
            else:
                found.append(1 if own is bounded else 2)
        return found

    def cell_sizes(self) -> np.ndarray:
        """`cell` of bodies.py: the smallest side of a cell of each block's tensor, as placed and in steps."""
        found = []
        for block in self.blocks:
            tensor = self.tensors[block.tensor]
            side = float(tensor.occupancy.cell.min())
            found.append([side * squeezed(block.object_to_field), side / tensor.step])
        return np.asarray(found)

    def reference(
        self, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See ComputedField and vm/reference.py."""
        return reference.query(self, params, points, dirs)

    def groups(self) -> list[Group]:
        """Each tensor's factors, its colour basis, and its detail once the texels are fine enough."""
        ends = [*self.layout[1:, 0], self.params.numel()]
        groups = []
        for tensor, row, end in zip(self.tensors, self.layout.tolist(), ends, strict=True):
            groups += [Group(row[0], row[12]), Group(row[12], row[13], BASIS_RATE)]
            if tensor.hashed and max(tensor.resolution) >= DETAIL_FROM:
                groups.append(Group(row[13], int(end), DETAIL_RATE, fades=True))
        return groups

    # -- storing ---------------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """Arrays and metadata for a bundle; the tensors' occupancies are stored as packed bits, ownership
        follows from them. Of a detail that few cells can ask the rows other than 0 are stored."""
        arrays = {
            f"tensor_{t}.{name}": view.detach().cpu().numpy()
            for t in range(len(self.tensors))
            for name, view in self.sections(t).items()
        }
        needs = {"hashed"} if any(t.hashed for t in self.tensors) else set()
        grids = [t.occupancy.occupied for t in self.tensors]
        for t, grid in enumerate(grids):
            detail = f"tensor_{t}.detail"
            held = Held.of(arrays[detail]) if detail in arrays else None
            if held is not None:
                needs |= {"held", "runs"}
                arrays |= {detail: arrays[detail][held.rows], runs_of(detail): held.lengths}
                arrays |= {f"{detail}_{name}": bits for name, bits in held.state().items()}
            few = min(FEW_CELLS, CELLS_PER_NUMBER * self.tensors[t].size(self.shape))
            cells = packed_bits(f"tensor_{t}.occupancy", grid, few if held is None else 0)
            needs |= {"held"} if len(cells) > 1 else set()
            arrays |= cells
        metadata = ({"needs": sorted(needs)} if needs else {}) | {
            "aabb": self.aabb.tolist(),
            "shape": {
                "density_rank": self.shape.density_rank,
                "colour_rank": self.shape.colour_rank,
                "sh_degree": self.shape.sh_degree,
            },
            "tensors": [
                {
                    "resolution": list(t.resolution),
                    "aabb": t.aabb.tolist(),
                    "scale": t.scale,
                    "shift": t.shift,
                    "occupancy": list(g.shape),
                    **({} if t.space is bounded else {"space": name_of(t.space)}),
                    **({} if t.hashed is None else {"hashed": stored_hashed(t.hashed)}),
                }
                for t, g in zip(self.tensors, grids, strict=True)
            ],
            "blocks": [
                {"tensor": b.tensor, "object_to_field": b.object_to_field.tolist(), "name": b.name}
                | ({} if b.tint == WHITE else {"tint": list(b.tint)})
                for b in self.blocks
            ],
        }
        return arrays, metadata

    @classmethod
    def needs(cls, metadata: dict, shapes: Mapping[str, tuple[int, ...]], array: Reads) -> FieldNeeds:
        """See Kind.field_needs; of several blocks with the grids that say which is asked where."""
        config = current(OccupancyConfig)
        numbers = sum(aligned(math.prod(s)) for name, s in shapes.items() if not name.endswith(".occupancy"))
        cells = [math.prod(tensor["occupancy"]) for tensor in metadata["tensors"]]
        held, made = 4 * numbers + PER_CELL * sum(cells), PER_CELL_MADE * max(cells)
        if len(metadata["blocks"]) > 1:
            held += PER_OWNED_CELL * config.scene_cells**3
            made = PER_PLACED_CELL * max(cells) + PER_OWNED_CELL_MADE * config.scene_cells**3
        return FieldNeeds(held, made)

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], metadata: dict) -> "VMField":
        """Inverse of `state`. Every number is checked before it can size an array or index one."""
        config = current(SamplingConfig)
        shape = VMShape(**metadata["shape"])
        tensors = tuple(stored_tensor(i, t, arrays, shape) for i, t in enumerate(metadata["tensors"]))
        blocks = tuple(stored_block(i, b, len(tensors)) for i, b in enumerate(metadata["blocks"]))
        if not 1 <= len(blocks) <= NO_BLOCK:
            raise ValueError(f"there should be 1 to {NO_BLOCK} blocks, found {len(blocks)}")
        numbers = sum(t.size(shape) for t in tensors)
        if numbers > MAX_NUMBERS:
            raise ValueError(f"its tensors have {numbers:,} numbers, but at most {MAX_NUMBERS:,} are read")
        params = pages.zeros(numbers)
        unplaced = cls(shape, tensors, blocks, params, tensors[0].occupancy, NO_OWNERS)
        for t in range(len(tensors)):
            for name, view in unplaced.sections(t).items():
                numbers = torch.from_numpy(np.ascontiguousarray(arrays[f"tensor_{t}.{name}"], np.float32))
                held = held_of(t, tensors[t], arrays) if name == "detail" else None
                if held is None:
                    view.copy_(numbers)
                else:
                    view[torch.from_numpy(held.rows)] = numbers
            check_answers(t, tensors[t], unplaced.sections(t))
        field = cls.assembled(shape, tensors, blocks, params)
        check_samples(
            field.occupancy.most_samples(sampling_step(field)), "its blocks", config.most_of_several
        )
        return field


def stored_tensor(i: int, stored: dict, arrays: dict[str, np.ndarray], shape: VMShape) -> VMTensor:
    """The i-th tensor as metadata tell it. Raises ValueError naming what does not fit."""
    resolution = whole_numbers(stored["resolution"], 2, f"tensor {i}: resolution")
    aabb = np.asarray(stored["aabb"], np.float64)
    if aabb.shape != (6,) or not np.isfinite(aabb).all() or (aabb[:3] >= aabb[3:]).any():
        raise ValueError(f"tensor {i}: aabb should be three minima below three maxima, found {aabb.tolist()}")
    scale, shift = float(stored["scale"]), float(stored["shift"])
    if not (0 < scale < np.inf and np.isfinite(shift)):
        raise ValueError(f"tensor {i}: scale should be positive and shift finite, found {scale} and {shift}")
    cells = whole_numbers(stored["occupancy"], 1, f"tensor {i}: occupancy")
    occupied = unpack_bits(arrays, f"tensor_{i}.occupancy", list(cells))
    space = space_named(stored.get("space", "bounded"))
    hashed = hashed_of(i, stored["hashed"], aabb) if "hashed" in stored else None
    tensor = VMTensor(resolution, aabb, scale, shift, occupied, space, hashed)
    check_samples(space.most_samples(aabb, tensor.step), f"tensor {i}")
    held = held_of(i, tensor, arrays) if hashed else None
    for name, expected in tensor.sections(shape):
        found = arrays.get(f"tensor_{i}.{name}")
        if name == "detail" and held is not None:
            expected = held.count, expected[1]
        if found is None or found.shape != expected:
            have = "nothing" if found is None else list(found.shape)
            raise ValueError(f"array 'tensor_{i}.{name}' should have shape {list(expected)}, found {have}")
    return tensor if held is None else replace(tensor, held=(held.count, len(held.masks)))


def held_of(i: int, tensor: VMTensor, arrays: dict[str, np.ndarray]) -> Held | None:
    """Which rows of its detail are stored of the i-th tensor; None: all. Raises ValueError naming what does
    not fit."""
    blocks, runs = (arrays.get(f"tensor_{i}.detail_{name}") for name in ("blocks", "held"))
    if blocks is None or runs is None:
        return None
    try:
        held = Held.from_state(blocks, runs, tensor.hashed.shape[0])
    except ValueError as error:
        raise ValueError(f"tensor {i}: {error}") from None
    lengths = arrays.get(f"tensor_{i}.{runs_of('detail')}")
    if lengths is None or not np.array_equal(lengths, held.lengths):
        raise ValueError(f"tensor {i}: the runs of its detail are not those of its blocks")
    return held


def stored_hashed(hashed: Hashed) -> dict:
    """A hashed detail for metadata."""
    return {"spacings": list(hashed.spacings), "rows": hashed.rows}


def hashed_of(i: int, stored: dict, aabb: np.ndarray) -> Hashed:
    """Inverse of `stored_hashed`, of the i-th tensor, whose box is aabb (6,). Raises ValueError naming what
    does not fit."""
    spacings, rows = stored["spacings"], stored["rows"]
    if type(rows) is not int or not 0 < rows <= MAX_ROWS or not 1 <= len(spacings) <= MAX_LEVELS:
        raise ValueError(
            f"tensor {i}: a hashed detail has 1 to {MAX_LEVELS} levels of at most {MAX_ROWS} rows, found "
            f"{len(spacings)} of {rows}"
        )
    try:
        hashed = Hashed(tuple(float(h) for h in spacings), rows)
    except ValueError as error:
        raise ValueError(f"tensor {i}: {error}") from None
    if not np.abs(aabb).max() <= MAX_VERTEX * min(hashed.spacings):
        raise ValueError(
            f"tensor {i}: the vertices of a hashed detail should be numbered up to {MAX_VERTEX}, but its box "
            f"reaches to {np.abs(aabb).max():g} and its 'spacings' are {list(hashed.spacings)}"
        )
    return hashed


def check_answers(i: int, tensor: VMTensor, sections: dict[str, torch.Tensor]) -> None:
    """Raise ValueError where finite numbers could multiply to an infinite density or logit, and their
    difference be NaN."""
    peak = {name: largest(view, kept=1) for name, view in sections.items()}
    products = {
        what: torch.stack([peak[f"{what}_plane_{m}"] * peak[f"{what}_line_{m}"] for m in range(3)])
        for what in ("density", "colour")
    }
    density = tensor.scale * (float(products["density"].sum()) + abs(tensor.shift) + 1)
    coefficients = sections["colour_basis"].shape[1]
    logit = coefficients * float((products["colour"].flatten() * peak["colour_basis"]).sum())
    if "detail" in peak:
        density += tensor.scale * len(tensor.hashed.spacings) * float(peak["detail"][0])
        logit += len(tensor.hashed.spacings) * float(peak["detail"][1:].max())
    for what, most in (("density", density), ("colour", logit)):
        if not most <= MAX_ANSWER:
            raise ValueError(
                f"arrays 'tensor_{i}.{what}_*' multiply to {most:.3g}, expected at most {MAX_ANSWER:g}"
            )


def stored_block(i: int, stored: dict, tensors: int) -> Block:
    """The i-th block as metadata tell it. Raises ValueError naming what does not fit."""
    if type(stored["tensor"]) is not int or not 0 <= stored["tensor"] < tensors:
        raise ValueError(f"block {i}: tensor should be 0 to {tensors - 1}, found {stored['tensor']}")
    matrix = np.asarray(stored["object_to_field"], np.float64)
    if matrix.shape != (4, 4) or not np.isfinite(matrix).all() or not (matrix[3] == [0, 0, 0, 1]).all():
        raise ValueError(f"block {i}: object_to_field should be a finite affine of four rows of four")
    sizes = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if sizes[-1] <= 1e-6 * sizes[0]:
        raise ValueError(f"block {i}: object_to_field is singular")
    tint = tuple(float(share) for share in stored.get("tint", WHITE))
    if len(tint) != 3 or not all(0 <= share <= 1 for share in tint):
        raise ValueError(f"block {i}: tint should be three numbers from 0 to 1, found {stored['tint']}")
    return Block(stored["tensor"], matrix, str(stored["name"]), tint)


def apart_arrays(tensors: tuple[VMTensor, ...]) -> tuple[np.ndarray, np.ndarray]:
    """`apart` and `apart_at` of bodies.py."""
    shapes = [t.apart.shape for t in tensors]
    offsets = np.cumsum([0, *[int(np.prod(s)) for s in shapes]])[:-1]
    at = np.asarray([[o, *s] for o, s in zip(offsets, shapes, strict=True)], np.int64).reshape(-1, 4)
    return np.concatenate([np.zeros(0, np.uint8), *[t.apart.ravel() for t in tensors]]), at


def detail_arrays(tensors: tuple[VMTensor, ...], real: np.dtype) -> tuple[np.ndarray, np.ndarray]:
    """`rows` and `lattice` of bodies.py."""
    levels = max(len(t.hashed.spacings) if t.hashed else 0 for t in tensors)
    rows, lattice = np.zeros((len(tensors), 2), np.int64), np.zeros((len(tensors), levels, 2, 3), real)
    for i, tensor in enumerate(tensors):
        if tensor.hashed:
            rows[i] = tensor.hashed.rows, len(tensor.hashed.spacings)
            for level, spacing in enumerate(tensor.hashed.spacings):
                lattice[i, level] = np.stack([tensor.aabb[3:] - tensor.aabb[:3], tensor.aabb[:3]]) / spacing
    return rows, lattice


def marked_as(grids: list[tuple[OccupancyGrid, np.ndarray]]) -> list[tuple[OccupancyGrid, np.ndarray]]:
    """Placed grids as their cells are marked: as they are, or so many halved that they have MOST_MARKED."""
    while sum(int(grid.occupied.sum()) for grid, _ in grids) > MOST_MARKED:
        halved = {id(grid): grid.halved() for grid, _ in grids}
        grids = [(halved[id(grid)], matrix) for grid, matrix in grids]
    return grids


def claimed_cells(marks: Iterable[np.ndarray]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Three (X, Y, Z) uint8 grids: the lowest and second lowest block with matter in a cell, and how many
    have."""
    first = second = count = None
    for b, mark in enumerate(marks):
        if first is None:
            first, second = (np.full(mark.shape, NO_BLOCK, np.uint8) for _ in range(2))
            count = np.zeros(mark.shape, np.uint8)
        second[mark & (first != NO_BLOCK) & (second == NO_BLOCK)] = b
        first[mark & (first == NO_BLOCK)] = b
        count += mark
    return first, second, count


def settle_crowded(field: VMField, crowded: np.ndarray, first: np.ndarray, second: np.ndarray) -> None:
    """Give the cells (N, 3) in which more than two blocks have matter to the two densest. Where that would
    take more than MOST_PROBED, neighbours are asked as one."""
    if not len(crowded):
        return
    grid, cells, each, side = field.occupancy, crowded, slice(None), 1
    cost = len(field.blocks) * len(PROBES) * field.shape.density_rank
    while len(cells) * cost > MOST_PROBED and side < current(OccupancyConfig).scene_cells:
        side *= 2
        numbers = np.ravel_multi_index(tuple((crowded // side).T), grid.occupied.shape)
        numbers, each = np.unique(numbers, return_inverse=True)
        cells = np.stack(np.unravel_index(numbers, grid.occupied.shape), 1)
    best = np.full((2, len(cells)), -1.0, np.float32)
    densest = np.full((2, len(cells)), NO_BLOCK, np.uint8)
    for b in range(len(field.blocks)):
        peak = field.peaks(grid.aabb[:3], side * grid.cell, cells, PROBES, b)
        # A probe misses matter that barely reaches into a cell: such blocks come last, by their peak
        # elsewhere.
        peak = np.where(peak > 0, peak, TOUCHING * peak.max())
        leads, follows = peak > best[0], peak > best[1]
        best[1], densest[1] = (
            np.where(leads, held[0], np.where(follows, new, held[1]))
            for held, new in ((best, peak), (densest, np.uint8(b)))
        )
        best[0], densest[0] = np.where(leads, peak, best[0]), np.where(leads, np.uint8(b), densest[0])
    first[tuple(crowded.T)], second[tuple(crowded.T)] = np.sort(densest, axis=0)[:, each]
