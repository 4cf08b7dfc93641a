"""A hash grid: levels of rows of FEATURES numbers, each finer than the last, side by side; vertices of a grid
that has more of them than rows share these by a hash (Instant-NGP, Müller et al. 2022, sec. 3, eq. 4).

A point u of the unit cube lies at s u + o between the vertices of a level, which `side` numbers on an axis; x
goes first. `levels_of` gives those of tiny-cuda-nn. Other systems take other scales, sides and offsets, or
hash where a grid has no more vertices than rows.
"""

from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import torch
from msgspec import Meta

from fusedrf_cli.engine.encodings.hash_runs import PRIMES
from fusedrf_cli.engine.fields.box import ParameterBlock, largest
from fusedrf_cli.engine.kernels.prefetch import prefetch
from fusedrf_cli.engine.kernels.primitives import accumulate
from fusedrf_cli.engine.kernels.reference import OCTANTS, whole


class Level(msgspec.Struct, forbid_unknown_fields=True):
    """A grid. Rows that are shared are a power of two."""

    scale: Annotated[float, Meta(ge=0, le=1 << 20)]
    side: Annotated[int, Meta(ge=1, le=1 << 20)]
    rows: Annotated[int, Meta(ge=1, le=1 << 26)]
    hashed: bool
    offset: Annotated[float, Meta(ge=0, le=1)] = 0.5

    def __post_init__(self):
        """Rows are found by a hash's lowest bits, or are numbered."""
        if self.hashed and self.rows & (self.rows - 1):
            raise ValueError(f"rows that are hashed should be a power of two, found {self.rows}")


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings."""

    features: Annotated[int, Meta(ge=1, le=16)]
    levels: Annotated[list[Level], Meta(min_length=1, max_length=32)]


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    starts: object  # (LEVELS,) int64, where the rows of a level begin
    scales: object  # (LEVELS,) float64, s
    offsets: object  # (LEVELS,) float64, o
    sides: object  # (LEVELS,) int64
    rows: object  # (LEVELS,) int64, of a level
    hashed: object  # (LEVELS,) bool


def levels_of(levels: int, log2_rows: int, base: int, growth: float) -> list[dict]:
    """Levels as tiny-cuda-nn makes them: s = base growth^l - 1, ⌈s⌉ + 1 vertices on an axis."""
    made = []
    for level in range(levels):
        scale = base * growth**level - 1
        side = int(np.ceil(scale)) + 1
        rows = min(-(-(side**3) // 8) * 8, 1 << log2_rows)  # filled up to a multiple of eight
        made.append({"scale": scale, "side": side, "rows": rows, "hashed": side**3 > rows, "offset": 0.5})
    return made


def sizes(features: int, levels: list[dict]) -> dict[str, int]:
    """See encodings."""
    return {"LEVELS": len(levels), "FEATURES": features, "WIDTH": -(-len(levels) * features // 8) * 8}


def sections(resolution: tuple[int, int, int], features: int, levels: list[dict]) -> list[ParameterBlock]:
    """See encodings. Drawn as in the paper (sec. 4), but normal."""
    rows = sum(level["rows"] for level in levels)
    return [ParameterBlock("rows", (rows, features), spread=1e-4)]


def arrays(field, starts: np.ndarray, features: int, levels: list[dict]) -> Arrays:
    """See encodings."""
    columns = {name: np.array([level[name] for level in levels]) for name in levels[0]}
    first = np.cumsum(columns["rows"]) - columns["rows"]
    return Arrays(
        starts[0] + features * first, columns["scale"].astype(np.float64),
        columns["offset"].astype(np.float64), columns["side"], columns["rows"], columns["hashed"],
    )  # fmt: skip


def reference(
    field, sections: dict, unit: torch.Tensor, read: None, features: int, levels: list[dict]
) -> torch.Tensor:
    """See encodings."""
    per_level, first, table = [], 0, sections["rows"]
    for level in levels:
        at = unit * float(level["scale"]) + level["offset"]
        below = at.detach().floor()
        total = table.new_zeros(len(unit), features)
        for offset in whole(OCTANTS, unit.device):
            weight = torch.where(offset == 1, at - below, 1 - (at - below)).prod(1)
            x, y, z = (below.long() + offset).unbind(1)
            number = (z * level["side"] + y) * level["side"] + x
            if level["hashed"]:
                number = x ^ (y * PRIMES[0]) ^ (z * PRIMES[1])
            total = total + weight[:, None].to(table.dtype) * table[first + number % level["rows"]]
        per_level.append(total)
        first += level["rows"]
    filled = table.new_zeros(len(unit), sizes(features, levels)["WIDTH"] - len(levels) * features)
    return torch.cat([*per_level, filled], 1)


def bound(sections: dict, read: None, features: int, levels: list[dict]) -> torch.Tensor:
    """See encodings."""
    width = sizes(features, levels)["WIDTH"]
    return largest(sections["rows"], kept=1).repeat(-(-width // features))[:width]


# -- compiled ------------------------------------------------------------------------------------------------


def cell_at(field, level, unit):
    """The vertex (i, j, k) of a level below a point on all axes, and how far (a, b, c) it is from it."""
    s, o, last = field.scales[level], field.offsets[level], field.sides[level] - 1
    x, y, z = s * unit[0] + o, s * unit[1] + o, s * unit[2] + o
    i, j, k = max(min(int(x), last), 0), max(min(int(y), last), 0), max(min(int(z), last), 0)
    return (i, j, k), (x - i, y - j, z - k)


def corner(field, level, below, share, q):
    """Where the row of corner q = 4 a + 2 b + c of a cell begins, and its weight."""
    a, b, c = q >> 2, (q >> 1) & 1, q & 1
    weight = (share[0] if a else 1.0 - share[0]) * (share[1] if b else 1.0 - share[1])
    weight *= share[2] if c else 1.0 - share[2]
    i, j, k = below[0] + a, below[1] + b, below[2] + c
    side, rows = field.sides[level], field.rows[level]
    if field.hashed[level]:
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
    for r in range(LEVELS * FEATURES, WIDTH):
        out[base + r] = 0


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
