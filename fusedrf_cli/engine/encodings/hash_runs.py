"""A hash grid in the units of space: ROW numbers on the vertices of cubic lattices through the origin of the
coordinates, one for each spacing, summed over these (Müller et al. 2022, "Instant Neural Graphics
Primitives", sec. 3, whose levels lie side by side). RUN vertices along z share a hash and lie side by side,
so that neighbours share a cache line. Where the box changes, numbers stay where they were."""

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.fields.box import ParameterBlock, largest
from fusedrf_cli.engine.kernels.prefetch import prefetch
from fusedrf_cli.engine.kernels.primitives import accumulate
from fusedrf_cli.engine.kernels.reference import OCTANTS, exact, whole

RUN = 4  # rows that lie side by side along z, so that neighbours share a cache line
ROW = 4  # numbers of a row: density, then red, green and blue
PRIMES = 2654435761, 805459861, 3674653429  # that numbers of vertices are multiplied by
EMPTY_FROM = -6.0  # density before activation, shift included, under which none is asked for


@dataclass(frozen=True)
class HashGrid:
    """Where the rows of a field lie in its coordinates: those of a level on the vertices of a cubic
    lattice through the origin."""

    spacings: tuple[float, ...]
    """Of the vertices of each level."""
    rows: int
    """Of each level, a power of two; vertices share them."""
    learns_from: int = field(default=100, compare=False)
    """Texels along a field's longest axis from which it learns; before, it would learn what is coarse."""
    rate: float = field(default=0.5, compare=False)
    """What it learns at, relative to planes and lines; at 1 smooth things come out grainy: a cup after 100 s
    SSIM 0.77, with 0.5 0.79."""

    def __post_init__(self):
        """Refuse what the kernels were not written for."""
        if not self.spacings or not all(0 < h < np.inf for h in self.spacings):
            raise ValueError(f"'spacings' should be finite numbers above 0, found {list(self.spacings)}")
        if self.rows < RUN or self.rows & (self.rows - 1):
            raise ValueError(f"'rows' should be a power of two of at least {RUN}, found {self.rows}")

    @property
    def shape(self) -> tuple[int, int]:
        """Of the array of all rows, level after level."""
        return len(self.spacings) * self.rows, ROW

    @property
    def picture_step(self) -> float:
        """At which pictures sample it: twice its finest spacing."""
        return 2.0 * min(self.spacings)


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    table: object  # int64, where the rows begin, level after level
    rows: object  # int64, of a level; a power of two
    lattice: object  # (levels, 2, 3) float, sides and lower corner of the box in a level's spacings


def sizes(hashed: HashGrid) -> dict[str, int]:
    """See encodings."""
    return {"WIDTH": ROW}


def sections(resolution: tuple[int, int, int], hashed: HashGrid) -> list[ParameterBlock]:
    """See encodings. They learn once texels are fine enough, and begin as 0."""
    learns = max(resolution) >= hashed.learns_from
    return [ParameterBlock("detail", hashed.shape, rate=hashed.rate if learns else 0.0, fades=True)]


def arrays(field, starts: np.ndarray, hashed: HashGrid) -> Arrays:
    """See encodings."""
    low, side = field.box[:3], field.box[3:] - field.box[:3]
    lattice = [np.stack([side, low]) / spacing for spacing in hashed.spacings]
    return Arrays(np.int64(starts[0]), np.int64(hashed.rows), np.asarray(lattice, field.real))


def reference(field, sections: dict, unit: torch.Tensor, read: None, hashed: HashGrid) -> torch.Tensor:
    """See encodings."""
    box, table = exact(field.box, unit.device), sections["detail"]
    at, total = box[:3] + unit.to(box.dtype) * (box[3:] - box[:3]), table.new_zeros(len(unit), ROW)
    for level, spacing in enumerate(hashed.spacings):
        below = torch.floor(at.detach() / spacing)
        share = at / spacing - below
        for offset in whole(OCTANTS, unit.device):
            weight = torch.where(offset == 1, share, 1 - share).prod(1).to(table.dtype)
            row = level * hashed.rows + hashed_row(hashed, below.long() + offset)
            total = total + weight[:, None] * table[row]
    return total


def hashed_row(hashed: HashGrid, vertex: torch.Tensor) -> torch.Tensor:
    """(N,) int64: which row of a level the vertices (N, 3) int64 of its lattice have. Products wrap around at
    64 bits; what is kept of them is the same whether they have a sign."""
    i, j, k = vertex.unbind(1)
    run = k.div(RUN, rounding_mode="floor")
    h = (i * PRIMES[0]) ^ (j * PRIMES[1]) ^ (run * PRIMES[2])
    h = h ^ (h >> 15)
    return (h & (hashed.rows // RUN - 1)) * RUN + k.remainder(RUN)


def bound(sections: dict, read: None, hashed: HashGrid) -> torch.Tensor:
    """See encodings."""
    return len(hashed.spacings) * largest(sections["detail"], kept=1)


# -- compiled ------------------------------------------------------------------------------------------------


def run_at(field, level, i, j, run):
    """Where the rows of the `run`-th RUN vertices along z at (i, j) begin."""
    h = (i * PRIMES[0]) ^ (j * PRIMES[1]) ^ (run * PRIMES[2])  # wraps around at 64 bits
    return field.table + (level * field.rows + ((h ^ (h >> 15)) & (field.rows // RUN - 1)) * RUN) * ROW


def edge(field, level, i, j, k):
    """Where the rows of vertices (i, j, k) and (i, j, k + 1) begin."""
    last = k % RUN == RUN - 1
    low = run_at(field, level, i, j, k // RUN)
    high = run_at(field, level, i, j, k // RUN + 1) if last else low + (k % RUN + 1) * ROW
    return np.uint64(low + k % RUN * ROW), np.uint64(high)


def vertex_below(field, level, unit):
    """The vertex (i, j, k) of a level below a point on all axes, and how far (a, b, c) in [0, 1) of a spacing
    the point is from it."""
    sides, low = field.lattice[level, 0], field.lattice[level, 1]
    real = field.params.dtype.type
    x, y = real(unit[0]) * sides[0] + low[0], real(unit[1]) * sides[1] + low[1]
    z = real(unit[2]) * sides[2] + low[2]
    i, j, k = math.floor(x), math.floor(y), math.floor(z)
    return (int(i), int(j), int(k)), (real(x - i), real(y - j), real(z - k))


def edges_around(field, level, n, below, share):
    """The rows at both ends of the n-th of the four edges along z around a point, and their parts in what is
    interpolated there; below and share as `vertex_below` returns them."""
    one = field.params.dtype.type(1)
    part = share[0] if n >> 1 == 1 else one - share[0]
    part *= share[1] if n & 1 == 1 else one - share[1]
    low, high = edge(field, level, below[0] + (n >> 1), below[1] + (n & 1), below[2])
    return low, high, part * (one - share[2]), part * share[2]


def rows_at(field, unit):
    """The ROW numbers at a point."""
    p = field.params
    zero = p.dtype.type(0)
    first, second, third, fourth = zero, zero, zero, zero
    for level in range(field.lattice.shape[0]):
        below, share = vertex_below(field, level, unit)
        for n in range(4):
            low, high, near, far = edges_around(field, level, n, below, share)
            first += near * p[low] + far * p[high]
            second += near * p[low + np.uint64(1)] + far * p[high + np.uint64(1)]
            third += near * p[low + np.uint64(2)] + far * p[high + np.uint64(2)]
            fourth += near * p[low + np.uint64(3)] + far * p[high + np.uint64(3)]
    return first, second, third, fourth


def scatter_rows(field, unit, first, second, third, fourth, grad):
    """Adjoint of `rows_at`."""
    for level in range(field.lattice.shape[0]):
        below, share = vertex_below(field, level, unit)
        for n in range(4):
            low, high, near, far = edges_around(field, level, n, below, share)
            add_row(grad, low, near * first, near * second, near * third, near * fourth)
            add_row(grad, high, far * first, far * second, far * third, far * fourth)


def add_row(grad, row, first, second, third, fourth):
    """Adds to the ROW numbers of a row, to which others may be adding too."""
    accumulate(grad, row, first)
    accumulate(grad, row + np.uint64(1), second)
    accumulate(grad, row + np.uint64(2), third)
    accumulate(grad, row + np.uint64(3), fourth)


def forward(field, unit, scratch, out, base):
    """See encodings."""
    out[base], out[base + 1], out[base + 2], out[base + 3] = rows_at(field, unit)


def backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    scatter_rows(field, unit, d[base], d[base + 1], d[base + 2], d[base + 3], grad)


def prefetch_at(field, array, unit):
    """See encodings: the rows at the ends of the four edges along z around a point, of each level."""
    for level in range(field.lattice.shape[0]):
        (i, j, k), _ = vertex_below(field, level, unit)
        for di in range(2):
            for dj in range(2):
                low, high = edge(field, level, i + di, j + dj, k)
                prefetch(array, low)
                prefetch(array, high)
