"""A hash grid: LEVELS grids of rows of FEATURES numbers, each finer than the last, side by side; vertices of
a grid that has more of them than rows share these by a hash (Instant-NGP, Müller et al. 2022, sec. 3, eq. 4).

Level l has the vertices 0 to ⌈s⌉ on an axis, s = base growth^l - 1, and a point u of the unit cube lies at
s u + 1/2 between them, as in tiny-cuda-nn, so that its checkpoints can be read. Rows number vertices x first.
"""

from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.encodings.hash_runs import PRIMES
from fusedrf_cli.engine.fields.box import ParameterBlock, largest
from fusedrf_cli.engine.kernels.prefetch import prefetch
from fusedrf_cli.engine.kernels.primitives import accumulate
from fusedrf_cli.engine.kernels.reference import OCTANTS, whole


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    starts: object  # (LEVELS,) int64, where the rows of a level begin
    scales: object  # (LEVELS,) float64, s
    sides: object  # (LEVELS,) int64, vertices per axis
    rows: object  # (LEVELS,) int64, of a level; a power of two where they are shared


def levels_of(levels: int, log2_rows: int, base: int, growth: float) -> tuple[np.ndarray, ...]:
    """(LEVELS,) scales, vertices per axis and rows of each level."""
    scales = base * np.asarray(growth, np.float64) ** np.arange(levels) - 1
    sides = np.ceil(scales).astype(np.int64) + 1
    rows = np.minimum(-(-(sides**3) // 8) * 8, 1 << log2_rows)  # filled up to a multiple of eight
    return scales, sides, rows


def sizes(levels: int, features: int, log2_rows: int, base: int, growth: float) -> dict[str, int]:
    """See encodings."""
    return {"LEVELS": levels, "FEATURES": features, "WIDTH": levels * features}


def sections(resolution: tuple[int, int, int], features: int, **grid: int | float) -> list[ParameterBlock]:
    """See encodings; grid: see `levels_of`, which does not depend on the resolution. Drawn as in the paper
    (sec. 4), but normal."""
    rows = int(levels_of(**grid)[2].sum())
    return [ParameterBlock("rows", (rows, features), spread=1e-4)]


def arrays(field, starts: np.ndarray, features: int, **grid: int | float) -> Arrays:
    """See encodings."""
    scales, sides, rows = levels_of(**grid)
    return Arrays(starts[0] + features * (np.cumsum(rows) - rows), scales, sides, rows)


def reference(
    field, sections: dict, unit: torch.Tensor, read: None, features: int, **grid: int | float
) -> torch.Tensor:
    """See encodings."""
    per_level, first, table = [], 0, sections["rows"]
    for scale, side, rows in zip(*levels_of(**grid), strict=True):
        at = unit * float(scale) + 0.5
        below = at.detach().floor()
        total = table.new_zeros(len(unit), features)
        for offset in whole(OCTANTS, unit.device):
            weight = torch.where(offset == 1, at - below, 1 - (at - below)).prod(1)
            x, y, z = (below.long() + offset).unbind(1)
            number = (z * side + y) * side + x
            if side**3 > rows:
                number = x ^ (y * PRIMES[0]) ^ (z * PRIMES[1])
            total = total + weight[:, None].to(table.dtype) * table[first + number % int(rows)]
        per_level.append(total)
        first += int(rows)
    return torch.cat(per_level, 1)


def bound(sections: dict, read: None, levels: int, features: int, **options) -> torch.Tensor:
    """See encodings."""
    return largest(sections["rows"], kept=1).repeat(levels)


# -- compiled ------------------------------------------------------------------------------------------------


def cell_at(field, level, unit):
    """The vertex (i, j, k) of a level below a point on all axes, and how far (a, b, c) it is from it."""
    s, last = field.scales[level], field.sides[level] - 1
    x, y, z = s * unit[0] + 0.5, s * unit[1] + 0.5, s * unit[2] + 0.5
    i, j, k = max(min(int(x), last), 0), max(min(int(y), last), 0), max(min(int(z), last), 0)
    return (i, j, k), (x - i, y - j, z - k)


def corner(field, level, below, share, q):
    """Where the row of corner q = 4 a + 2 b + c of a cell begins, and its weight."""
    a, b, c = q >> 2, (q >> 1) & 1, q & 1
    weight = (share[0] if a else 1.0 - share[0]) * (share[1] if b else 1.0 - share[1])
    weight *= share[2] if c else 1.0 - share[2]
    i, j, k = below[0] + a, below[1] + b, below[2] + c
    side, rows = field.sides[level], field.rows[level]
    if side * side * side > rows:
        row = (i ^ (j * PRIMES[0]) ^ (k * PRIMES[1])) & (rows - 1)
    else:
        row = ((k * side + j) * side + i) % rows
    return np.uint64(field.starts[level] + row * FEATURES), field.params.dtype.type(weight)


def forward(field, unit, scratch, out, base):
    """See encodings."""
    for level in range(LEVELS):
        start = np.uint64(base + level * FEATURES)
        for f in range(np.uint64(FEATURES)):
            out[start + f] = 0
        below, share = cell_at(field, level, unit)
        for q in range(8):
            row, weight = corner(field, level, below, share, q)
            for f in range(np.uint64(FEATURES)):
                out[start + f] += weight * field.params[row + f]


def backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    for level in range(LEVELS):
        start = np.uint64(base + level * FEATURES)
        below, share = cell_at(field, level, unit)
        for q in range(8):
            row, weight = corner(field, level, below, share, q)
            for f in range(np.uint64(FEATURES)):
                accumulate(grad, row + f, weight * d[start + f])


def prefetch_at(field, array, unit):
    """See encodings: the rows of all corners of all levels."""
    for level in range(LEVELS):
        below, share = cell_at(field, level, unit)
        for q in range(8):
            prefetch(array, corner(field, level, below, share, q)[0])
