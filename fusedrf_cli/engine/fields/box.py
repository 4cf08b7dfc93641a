"""Fields over one box whose numbers lie on texels along its axes."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from functools import cached_property

import numpy as np
import torch

from fusedrf_cli.engine.fields import large_pages
from fusedrf_cli.engine.fields.base import FieldMemory, check_samples, sampling_step
from fusedrf_cli.engine.fields.cell_bits import few_cells, packed_bits, unpack_bits
from fusedrf_cli.engine.fields.computed import (
    PER_CELL,
    PER_CELL_MADE,
    ComputedField,
    Group,
    Reads,
    runs_of,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.fields.stored_rows import StoredRows, StoredRowsConfig, folded, unfolded
from fusedrf_cli.engine.kernels.primitives import LINE
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded, name_of, space_named

MAX_TEXELS = 8192  # per axis, in a stored field
MAX_ANSWER = 1e25  # of a density or a logit: finite in float32 also after a placement's largest stretch
DENSITY_SHIFT = -8.0  # softplus(-8) * 75 * sqrt(3) = 4 % opacity along the diagonal of an untrained box
DENSITY_SCALE_PER_EXTENT = 75.0


@dataclass(frozen=True)
class ParameterBlock:
    """A stretch of a field's numbers."""

    name: str
    shape: tuple[int, ...]
    """In memory."""
    axes: tuple[int, ...] = ()
    """Axes of the box (0 x, 1 y, 2 z) that its leading dimensions run along, texel by texel."""
    rate: float = 1.0
    """What it learns at, relative to the optimiser's rate; at 0 it does not."""
    spread: float = 0.0
    """Standard deviation of an untrained field's numbers."""
    columns: int | None = None
    """Of a row of numbers, how many are stored; the others fill it up to whole runs and are 0. None: all."""
    fades: bool = False
    """See Group."""
    whole: bool = False
    """Whether they are whole numbers, by which others are found: files have them as such."""

    @property
    def on_vertices(self) -> bool:
        """Whether it has a number, or a row of them, for each vertex of the grid."""
        return self.axes == (0, 1, 2)


def aligned(part: ParameterBlock) -> int:
    """Floats of a part, up to whole cache lines."""
    return -(-math.prod(part.shape) // LINE) * LINE


class BoxField(ComputedField):
    """A field over one box; σ = scale softplus(feature + shift), scale in 1/length.

    Of a part with numbers for each vertex of the grid those of *used* vertices alone are learnt and stored,
    which touch a voxel that an occupied cell reaches into: no answer depends on the others.

    A kind sets `kind`, `device_module` and `shape_type`, a frozen dataclass of whole numbers that refuses
    what its kernels were not written for, and defines `parts_of`, `kernel_arrays`, `reference` and
    `check_answers`.
    """

    shape_type: type
    hashed_part: str | None = None
    """The part, if any, that is the rows of a hash grid: files may hold those alone that are not 0."""
    name = ""
    """Of the object that it is, where its kind's files say so."""

    def __init__(
        self,
        shape: object,
        box: np.ndarray,
        resolution: tuple[int, int, int],
        scale: float,
        shift: float = DENSITY_SHIFT,
        params: torch.Tensor | None = None,
        occupancy: OccupancyGrid | None = None,
    ):
        """box (6,) float64; resolution: texels per axis, corners on the faces, at least 2; params None:
        zeros; occupancy None: full."""
        self.shape, self.box, self.resolution = shape, np.asarray(box, np.float64), tuple(resolution)
        self.scale, self.shift = float(scale), float(shift)
        self.params = large_pages.zeros(self.size) if params is None else params
        self.occupancy = OccupancyGrid.full(self.box) if occupancy is None else occupancy

    # -- for kinds to define -----------------------------------------------------------------------------

    @classmethod
    def parts_of(cls, shape: object, resolution: tuple[int, int, int]) -> list[ParameterBlock]:
        """The parts of `params`, in order."""
        raise NotImplementedError

    def check_answers(self) -> None:
        """Raise ValueError where finite numbers could make an answer beyond MAX_ANSWER, whose difference from
        another could be NaN."""
        raise NotImplementedError

    # -- making ------------------------------------------------------------------------------------------

    @classmethod
    def create(
        cls, shape: object, box: np.ndarray, resolution: tuple[int, int, int], generator: torch.Generator
    ) -> "BoxField":
        """An untrained field: parts N(0, spread²), nearly transparent."""
        box = np.asarray(box, np.float64)
        field = cls(shape, box, resolution, DENSITY_SCALE_PER_EXTENT / float((box[3:] - box[:3]).mean()))
        for part, view in zip(field.parts, field.sections().values(), strict=True):
            if part.spread:
                view.copy_(part.spread * torch.randn(part.shape, generator=generator))
        return field

    def resampled(self, box: np.ndarray, resolution: tuple[int, int, int]) -> "BoxField":
        """The field on another box (6,) and resolution: interpolated along each axis, outside the old box
        0."""
        if self.params.device.type != "cpu":
            return self.to("cpu").resampled(box, resolution).to(self.params.device)
        new = type(self)(self.shape, box, resolution, self.scale, self.shift, occupancy=self.occupancy)
        new.params, new.name = new.params.to(self.params.dtype), self.name
        for part, old, target in zip(
            self.parts, self.sections().values(), new.sections().values(), strict=True
        ):
            for dimension, axis in enumerate(part.axes):
                at = unit_texels(new.box, self.box, axis, target.shape[dimension])
                old = interpolate_axis(old, dimension, at)
            target.copy_(old)
        return new

    # -- reading -----------------------------------------------------------------------------------------

    @cached_property
    def parts(self) -> list[ParameterBlock]:
        """The parts of `params`, in order."""
        return self.parts_of(self.shape, self.resolution)

    @cached_property
    def starts(self) -> np.ndarray:
        """(parts + 1,) int64: where each part begins in `params`, on a cache line, and the end."""
        return np.cumsum([0, *map(aligned, self.parts)], dtype=np.int64)

    @property
    def size(self) -> int:
        """Floats of `params`."""
        return int(self.starts[-1])

    @classmethod
    def size_of(cls, shape: object, resolution: tuple[int, int, int]) -> int:
        """Floats of the `params` of a field."""
        return sum(map(aligned, cls.parts_of(shape, resolution)))

    def sections(self) -> dict[str, torch.Tensor]:
        """Views of the parts of `params` by name."""
        return {
            part.name: self.params[int(start) : int(start) + int(np.prod(part.shape))].view(part.shape)
            for part, start in zip(self.parts, self.starts, strict=False)
        }

    @property
    def voxel_size(self) -> float:
        """Finest spacing of texels, in the field's frame."""
        return float(((self.box[3:] - self.box[:3]) / (np.asarray(self.resolution) - 1)).min())

    @property
    def activation(self) -> np.ndarray:
        """(2,) scale and shift, as kernels read them."""
        return np.asarray([self.scale, self.shift], self.real)

    @property
    def corners(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Texels per axis (3,) int64, lower corner (3,) and sides (3,) of the box, as kernels read them."""
        return np.asarray(self.resolution, np.int64), self.box[:3].copy(), self.box[3:] - self.box[:3]

    @property
    def held(self) -> StoredRows | None:
        """Which rows of its hash grid a file holds; None: it has none, or all."""
        rows = self.sections().get(self.hashed_part)
        return None if rows is None else StoredRows.of(rows.detach().cpu().numpy())

    @property
    def used(self) -> np.ndarray:
        """(nx, ny, nz) bool: the vertices of voxels that an occupied cell reaches into."""
        return used_vertices(self.occupancy, self.box, self.resolution)

    # -- learning ----------------------------------------------------------------------------------------

    def with_occupancy(self, occupancy: OccupancyGrid) -> "BoxField":
        """See ComputedField."""
        return super().with_occupancy(occupancy)._afresh("reached")

    @cached_property
    def reached(self) -> list[np.ndarray | None]:
        """For each part, where the cache lines begin whose numbers learn; None: all."""
        vertices = np.flatnonzero(self.used) if any(part.on_vertices for part in self.parts) else None
        lines = [
            lines_of(vertices, math.prod(part.shape[3:])) if part.on_vertices else self.lines_learnt(part)
            for part in self.parts
        ]
        return [own if own is None else start + own for own, start in zip(lines, self.starts, strict=False)]

    def lines_learnt(self, part: ParameterBlock) -> np.ndarray | None:
        """The same of a part that is not on vertices, counted from where it begins."""
        return None

    def groups(self) -> list[Group]:
        """See ComputedField: of a part each, or of neighbours that are learnt alike."""
        groups: list[Group] = []
        for part, low, high, lines in zip(
            self.parts, self.starts, self.starts[1:], self.reached, strict=False
        ):
            last, alike = groups[-1] if groups else None, (part.rate, part.fades)
            whole = last is not None and last.lines is None and lines is None and last.high == low
            if whole and (last.rate, last.fades) == alike:
                groups[-1] = replace(last, high=int(high))
            elif part.rate:
                groups.append(Group(int(low), int(high), part.rate, lines, part.fades))
        return groups

    # -- storing -----------------------------------------------------------------------------------------

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """Arrays and metadata for a bundle: the parts, and occupancy as packed bits."""
        arrays = {}
        for part, view in zip(self.parts, self.sections().values(), strict=True):
            name, packed = self.stored_name(part.name), self.pack(part, view.detach().cpu()).numpy()
            arrays |= folded(name, packed) if part.name == self.hashed_part else {name: packed}
        held = self.hashed_part is not None and runs_of(self.stored_name(self.hashed_part)) in arrays
        few = 0 if held else few_cells(sum(array.size for array in arrays.values()))
        arrays |= packed_bits("occupancy", self.occupancy.occupied, few)
        needs = ["held", "runs"] if held else [] if "occupancy" in arrays else ["held"]
        metadata = ({"needs": needs} if needs else {}) | {
            "aabb": self.box.tolist(),
            "resolution": list(self.resolution),
            "scale": self.scale,
            "shift": self.shift,
            "cells": {
                "aabb": self.occupancy.aabb.tolist(),
                "counts": list(self.occupancy.occupied.shape),
                **({} if self.space is bounded else {"space": name_of(self.space)}),
            },
            "shape": asdict(self.shape),
        }
        return arrays, metadata

    @classmethod
    def stored_name(cls, name: str) -> str:
        """The name in files of the array of a part."""
        return name

    def stored_shape(self, part: ParameterBlock, used: int | None = None) -> tuple[int, ...]:
        """Shape under which a part is stored; of vertices, the used ones in order. used: how many these are,
        where that is known."""
        if part.on_vertices and used is None:
            used = int(np.count_nonzero(self.used))
        shape = (used, *part.shape[3:]) if part.on_vertices else part.shape
        return shape if part.columns is None else (*shape[:-1], part.columns)

    def pack(self, part: ParameterBlock, values: torch.Tensor) -> torch.Tensor:
        """A part as it is stored."""
        values = values.int() if part.whole else values
        values = values if part.columns is None else values[..., : part.columns]
        return values[torch.from_numpy(self.used)] if part.on_vertices else values

    def unpack(self, part: ParameterBlock, stored: torch.Tensor, values: torch.Tensor) -> None:
        """Inverse of `pack`, into a part that is 0, as what is not stored stays."""
        if part.name == self.hashed_part:  # rows of 0 take no memory
            rows = stored.any(1)
            values[rows] = stored[rows]
        elif part.on_vertices:
            rows = values.view(math.prod(self.resolution), -1)
            width = math.prod(stored.shape[1:])
            used = torch.from_numpy(np.flatnonzero(self.used))
            rows[:, :width].index_copy_(0, used, stored.view(-1, width))
        else:
            values[..., : stored.shape[-1]] = stored

    @classmethod
    def needs(cls, metadata: dict, shapes: Mapping[str, tuple[int, ...]], array: Reads) -> FieldMemory:
        """See `Kind.field_memory`."""
        parts = cls.parts_of(cls.shape_type(**metadata["shape"]), tuple(metadata["resolution"]))
        numbers = sum(map(aligned, parts))
        counts, texels = metadata["cells"]["counts"], metadata["resolution"]
        making, unwritten = PER_CELL_MADE * math.prod(counts), 0
        for part in parts:
            if part.on_vertices:  # used_vertices axis by axis, and the used ones' places
                halves, used = [math.prod([*texels[:n], *counts[n:]]) for n in range(4)], shapes[part.name][0]
                # 7 bytes of a vertex, or of a cell, while the used ones are found; of these each may be
                # alone in a large page.
                making = max(making, 7 * max(halves), math.prod(texels) + 8 * used)
                unwritten += max(0, 4 * math.prod(part.shape) - used * (2 << 20))
        return FieldMemory(4 * numbers + PER_CELL * math.prod(counts), making, unwritten)

    @classmethod
    def stored_occupancy(cls, metadata: dict, arrays: Mapping[str, np.ndarray]) -> OccupancyGrid:
        """See Kind."""
        return cls.stored_cells(metadata["cells"], arrays)

    @classmethod
    def stored_cells(cls, cells: dict, arrays: Mapping[str, np.ndarray]) -> OccupancyGrid:
        """The occupancy grid that metadata tell of and one of the arrays holds. Raises as `from_state`."""
        counts = list(whole_numbers(cells["counts"], 1, "cells"))
        return OccupancyGrid(
            checked_box(cells["aabb"], "cells"),
            unpack_bits(arrays, cls.stored_name("occupancy"), counts),
            space_named(cells.get("space", "bounded")),
        )

    @classmethod
    def from_state(cls, arrays: dict[str, np.ndarray], metadata: dict) -> "BoxField":
        """Inverse of `state`. Every number is checked before it can size an array or index one. Raises
        ValueError, KeyError or TypeError for what does not fit."""
        shape = cls.shape_type(**metadata["shape"])
        resolution = whole_numbers(metadata["resolution"], 2, "resolution")
        box, scale, shift = metadata["aabb"], float(metadata["scale"]), float(metadata["shift"])
        if not (0 < scale < np.inf and np.isfinite(shift)):
            raise ValueError(f"scale should be positive and shift finite, found {scale} and {shift}")
        grid = cls.stored_cells(metadata["cells"], arrays)
        bare = cls(shape, checked_box(box, "aabb"), resolution, scale, shift, torch.zeros(0), grid)
        check_samples(grid.space.most_samples(grid.aabb, sampling_step(bare)), "the field")
        arrays = bare.with_all_rows(arrays)
        for part in bare.parts:  # before `params` takes memory
            name, expected = cls.stored_name(part.name), bare.stored_shape(part)
            array = arrays.get(name)
            if array is None or array.shape != expected:
                have = "nothing" if array is None else list(array.shape)
                raise ValueError(f"array '{name}' should have shape {list(expected)}, found {have}")
        field = cls(shape, bare.box, resolution, scale, shift, occupancy=grid)
        for part, view in zip(field.parts, field.sections().values(), strict=True):
            stored = torch.from_numpy(np.ascontiguousarray(arrays[cls.stored_name(part.name)], np.float32))
            field.unpack(part, stored, view)
        field.check_answers()
        return field

    def with_all_rows(self, arrays: Mapping[str, np.ndarray]) -> Mapping[str, np.ndarray]:
        """A file's arrays with all rows of the hash grid, of which they may have few. Raises ValueError where
        these do not fit, or the field has more numbers than are read."""
        part = next((part for part in self.parts if part.name == self.hashed_part), None)
        if part is None:
            return arrays
        most = current(StoredRowsConfig).max_numbers
        if self.size > most:
            raise ValueError(f"it has {self.size:,} numbers, but at most {most:,} are read")
        name = self.stored_name(part.name)
        rows = unfolded(name, part.shape, arrays)
        return arrays if rows is None else {**arrays, name: rows}

    def check_density(self, largest: float) -> None:
        """Raise ValueError where a density feature of that size gives an answer beyond MAX_ANSWER."""
        density = self.scale * (largest + abs(self.shift) + 1)
        if not density <= MAX_ANSWER:
            arrays = f"arrays '{self.stored_name('density')}*'"
            said = f"the density would reach {density:.3g} by {arrays}"
            raise ValueError(f"{said}, expected at most {MAX_ANSWER:g}")

    def check_logit(self, largest: float) -> None:
        """Raise ValueError where a colour's logit could be beyond MAX_ANSWER."""
        if not largest <= MAX_ANSWER:
            arrays = f"arrays '{self.stored_name('colour')}*'"
            said = f"a colour's logit would reach {largest:.3g} by {arrays}"
            raise ValueError(f"{said}, expected at most {MAX_ANSWER:g}")


def largest(values: torch.Tensor, kept: int = 0) -> torch.Tensor:
    """The largest magnitudes, float64, over all dimensions but the last `kept`; no copy is made."""
    dims = tuple(range(values.dim() - kept))
    return torch.maximum(values.amax(dims), -values.amin(dims)).double()


def check_whole(values: torch.Tensor, name: str, count: int) -> None:
    """Raise ValueError unless values of that name are whole numbers from -1 to below `count`."""
    low, high = float(values.amin()), float(values.amax())
    if not (low >= -1 and high < count and torch.equal(values, values.round())):
        found = f"found {low:g} to {high:g}"
        raise ValueError(f"'{name}' should be whole numbers from -1 to {count - 1}, {found}")


def lines_of(rows: np.ndarray, width: int) -> np.ndarray:
    """(L,) where the cache lines begin that hold any number of some rows (N,) of a table so wide."""
    numbers = rows[:, None] * width + np.unique([*range(0, width, LINE), width - 1])
    return np.unique(numbers // LINE) * LINE


def used_vertices(occupancy: OccupancyGrid, box: np.ndarray, resolution: tuple[int, int, int]) -> np.ndarray:
    """(nx, ny, nz) bool: vertices of a grid over a box (6,) within a voxel of an occupied cell."""
    spans = []
    for axis in range(3):
        at = np.linspace(box[axis], box[axis + 3], resolution[axis])
        voxel = (box[axis + 3] - box[axis]) / (resolution[axis] - 1)
        cells = occupancy.occupied.shape[axis]
        between_cells = (np.stack([at - voxel, at + voxel]) - occupancy.aabb[axis]) / occupancy.cell[axis]
        low, high = np.floor(between_cells[0]).astype(int), np.floor(between_cells[1]).astype(int)
        spans.append((np.clip(low, 0, cells), np.clip(high + 1, 0, cells)))
    used = occupancy.occupied
    for axis, (low, high) in enumerate(spans):  # the box of cells around a vertex is a product of three runs
        shape = list(used.shape)
        shape[axis] += 1
        total = np.zeros(shape, np.int16)  # MAX_TEXELS of them at most
        np.cumsum(used, axis, out=total[(slice(None),) * axis + (slice(1, None),)])
        used = total.take(high, axis) > total.take(low, axis)
    return used


def checked_box(values: list, what: str) -> np.ndarray:
    """A stored box (6,) as float64; ValueError where it is none."""
    box = np.asarray(values, np.float64)
    if box.shape != (6,) or not np.isfinite(box).all() or (box[:3] >= box[3:]).any():
        raise ValueError(f"{what} should be three minima below three maxima, found {values}")
    return box


def whole_numbers(values: list, least: int, what: str) -> tuple[int, int, int]:
    """Three whole numbers from `least` to MAX_TEXELS; ValueError for anything else."""
    if len(values) != 3 or any(type(n) is not int or not least <= n <= MAX_TEXELS for n in values):
        raise ValueError(f"{what} should be three whole numbers from {least} to {MAX_TEXELS}, found {values}")
    return tuple(values)


def unit_texels(box: np.ndarray, old_box: np.ndarray, axis: int, count: int) -> torch.Tensor:
    """(count,) float64 positions of a box's texels on one axis, in unit coordinates of another box."""
    at = torch.linspace(float(box[axis]), float(box[axis + 3]), count, dtype=torch.float64)
    return (at - old_box[axis]) / (old_box[axis + 3] - old_box[axis])


def interpolate_axis(values: torch.Tensor, axis: int, unit: torch.Tensor) -> torch.Tensor:
    """Linear interpolation of values along one axis at unit coordinates, corners aligned; 0 outside [0,
    1]. On a texel, up to a rounding, it is that texel's own to the bit."""
    n = values.shape[axis]
    position = unit * (n - 1)
    rounded = position.round()
    position = torch.where((position - rounded).abs() < 1e-9, rounded, position)
    lower = position.floor().clamp(0, n - 2).long()
    fraction = (position - lower).to(values.dtype)
    inside = ((unit >= -1e-9) & (unit <= 1 + 1e-9)).to(values.dtype)
    shape = [-1 if a == axis else 1 for a in range(values.dim())]
    fraction, inside = fraction.view(shape), inside.view(shape)
    return inside * (
        (1 - fraction) * values.index_select(axis, lower) + fraction * values.index_select(axis, lower + 1)
    )
