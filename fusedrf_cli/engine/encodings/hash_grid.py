"""A hash grid: levels of rows of FEATURES numbers, each finer than the last, side by side; vertices of a grid
that has more of them than rows share these by a hash (Instant-NGP, Müller et al. 2022, sec. 3, eq. 4).

A point u of the unit cube lies at s u + o between the vertices of a level, which `side` numbers on an axis; x
goes first. `levels_of` gives those of tiny-cuda-nn. Other systems take other scales, sides and offsets, or
hash where a grid has no more vertices than rows. A grid that `grows` leaves out levels finer than half a
texel: as a field learns, from coarse texels to fine ones, they come in one after the other.
"""

from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import torch
from msgspec import Meta

from fusedrf_cli.engine.encodings.hash_runs import PRIMES
from fusedrf_cli.engine.fields.box import ParameterBlock, largest
from fusedrf_cli.engine.kernels.prefetch import prefetch
from fusedrf_cli.engine.kernels.primitives import accumulate, scatter_4
from fusedrf_cli.engine.kernels.reference import OCTANTS, whole

FINER = 2  # vertices on a texel of the finest level of a grid that grows


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
    grows: bool = False


class Arrays(NamedTuple):
    """What the functions read beside `params`, of L levels."""

    starts: object  # (L,) int64, where the rows of a level begin
    scales: object  # (L,) float64, s
    offsets: object  # (L,) float64, o
    sides: object  # (L,) int64
    rows: object  # (L,) int64, of a level
    hashed: object  # (L,) bool
    used: object  # int64, how many of the levels are not left out


def levels_of(levels: int, log2_rows: int, base: int, growth: float) -> list[dict]:
    """Levels as tiny-cuda-nn makes them: s = base growth^l - 1, ⌈s⌉ + 1 vertices on an axis."""
    made = []
    for level in range(levels):
        scale = base * growth**level - 1
        side = int(np.ceil(scale)) + 1
        rows = min(-(-(side**3) // 8) * 8, 1 << log2_rows)  # filled up to a multiple of eight
        made.append({"scale": scale, "side": side, "rows": rows, "hashed": side**3 > rows, "offset": 0.5})
    return made


def used_of(resolution: tuple[int, int, int], levels: list[dict], grows: bool) -> int:
    """How many levels, of which the coarser come first, are not left out."""
    finest = FINER * max(resolution)
    return max(1, sum(level["scale"] <= finest for level in levels)) if grows else len(levels)


def sizes(features: int, levels: list[dict], grows: bool = False) -> dict[str, int]:
    """See encodings."""
    return {"FEATURES": features, "WIDTH": -(-len(levels) * features // 8) * 8}


def sections(
    resolution: tuple[int, int, int], features: int, levels: list[dict], grows: bool = False
) -> list[ParameterBlock]:
    """See encodings. Drawn as in the paper (sec. 4), but normal."""
    rows = sum(level["rows"] for level in levels)
    return [ParameterBlock("rows", (rows, features), spread=1e-4, fades=True)]


def arrays(field, starts: np.ndarray, features: int, levels: list[dict], grows: bool = False) -> Arrays:
    """See encodings."""
    columns = {name: np.array([level[name] for level in levels]) for name in levels[0]}
    first = np.cumsum(columns["rows"]) - columns["rows"]
    return Arrays(
        starts[0] + features * first, columns["scale"].astype(np.float64),
        columns["offset"].astype(np.float64), columns["side"], columns["rows"], columns["hashed"],
        np.int64(used_of(field.resolution, levels, grows)),
    )  # fmt: skip


def reference(
    field, sections: dict, unit: torch.Tensor, read: None, features: int, levels: list[dict],
    grows: bool = False,
) -> torch.Tensor:  # fmt: skip
    """See encodings."""
    per_level, first, table = [], 0, sections["rows"]
    for level in levels[: used_of(field.resolution, levels, grows)]:
        at = unit * float(level["scale"]) + level["offset"]
        below = at.detach().floor()
        total = table.new_zeros(len(unit), features)
        for offset in whole(OCTANTS, unit.device):
            weight = torch.where(offset == 1, at - below, 1 - (at - below)).prod(1)
            row = first + row_of(level, below.long() + offset)
            total = total + weight[:, None].to(table.dtype) * table[row]
        per_level.append(total)
        first += level["rows"]
    filled = table.new_zeros(len(unit), sizes(features, levels)["WIDTH"] - len(per_level) * features)
    return torch.cat([*per_level, filled], 1)


def row_of(level: dict, vertex: torch.Tensor) -> torch.Tensor:
    """(N,) int64: which row of a level its vertices (N, 3) int64 have."""
    x, y, z = vertex.unbind(1)
    number = (z * level["side"] + y) * level["side"] + x
    if level["hashed"]:
        number = x ^ (y * PRIMES[0]) ^ (z * PRIMES[1])
    return number % level["rows"]


def bound(sections: dict, read: None, features: int, levels: list[dict], grows: bool = False) -> torch.Tensor:
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


def corner_rows(field, level, below):
    """Where the rows of a cell's corners begin, corner q = 4 a + 2 b + c."""
    i, j, k = below
    start, rows = field.starts[level], field.rows[level]
    if field.hashed[level]:
        last, near, far = rows - 1, j * PRIMES[0], (j + 1) * PRIMES[0]
        low, high = k * PRIMES[1], (k + 1) * PRIMES[1]
        found = (
            (i ^ near ^ low) & last, (i ^ near ^ high) & last, (i ^ far ^ low) & last,
            (i ^ far ^ high) & last, ((i + 1) ^ near ^ low) & last, ((i + 1) ^ near ^ high) & last,
            ((i + 1) ^ far ^ low) & last, ((i + 1) ^ far ^ high) & last,
        )  # fmt: skip
    else:
        side = field.sides[level]
        n, up = (k * side + j) * side + i, side * side
        found = (
            numbered(n, rows), numbered(n + up, rows), numbered(n + side, rows),
            numbered(n + side + up, rows), numbered(n + 1, rows), numbered(n + 1 + up, rows),
            numbered(n + 1 + side, rows), numbered(n + 1 + side + up, rows),
        )  # fmt: skip
    return (
        np.uint64(start + found[0] * FEATURES), np.uint64(start + found[1] * FEATURES),
        np.uint64(start + found[2] * FEATURES), np.uint64(start + found[3] * FEATURES),
        np.uint64(start + found[4] * FEATURES), np.uint64(start + found[5] * FEATURES),
        np.uint64(start + found[6] * FEATURES), np.uint64(start + found[7] * FEATURES),
    )  # fmt: skip


def numbered(n, rows):
    """n % rows, which takes long, and n is seldom beyond."""
    return n if n < rows else n % rows


def corner_weights(field, share):
    """The weights of a cell's corners at a point, as `corner_rows` has them."""
    real = field.params.dtype.type
    a, b, c = real(share[0]), real(share[1]), real(share[2])
    one = real(1)
    low, lowered, raised, high = (one - a) * (one - b), (one - a) * b, a * (one - b), a * b
    return (
        low * (one - c), low * c, lowered * (one - c), lowered * c, raised * (one - c), raised * c,
        high * (one - c), high * c,
    )  # fmt: skip


def forward(field, unit, scratch, out, base):
    """See encodings."""
    p = field.params
    for level in range(field.used):
        start = np.uint64(base + level * FEATURES)
        below, share = cell_at(field, level, unit)
        rows, weights = corner_rows(field, level, below), corner_weights(field, share)
        if FEATURES == 4:
            mixed_4(out, start, weights, p, rows)
        else:
            for f in range(np.uint64(FEATURES)):
                out[start + f] = 0
            for q in range(8):
                for f in range(np.uint64(FEATURES)):
                    out[start + f] += weights[q] * p[rows[q] + f]
    for r in range(field.used * FEATURES, WIDTH):
        out[base + r] = 0


def mixed_4(out, o, weights, values, rows):
    """out[o : o + 4] = Σ_q weights[q] values[rows[q] : rows[q] + 4], all loads before all stores (kernels/
    primitives.py, `add_scaled_8`)."""
    zero = out.dtype.type(0)
    first, second, third, fourth = zero, zero, zero, zero
    for q in range(8):
        weight, row = weights[q], rows[q]
        first += weight * values[row]
        second += weight * values[row + np.uint64(1)]
        third += weight * values[row + np.uint64(2)]
        fourth += weight * values[row + np.uint64(3)]
    out[o], out[o + np.uint64(1)] = first, second
    out[o + np.uint64(2)], out[o + np.uint64(3)] = third, fourth


def backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    for level in range(field.used):
        start = np.uint64(base + level * FEATURES)
        below, share = cell_at(field, level, unit)
        rows, weights = corner_rows(field, level, below), corner_weights(field, share)
        for q in range(8):
            if FEATURES == 4:
                scatter_4(grad, rows[q], weights[q], d, start)
            else:
                for f in range(np.uint64(FEATURES)):
                    accumulate(grad, rows[q] + f, weights[q] * d[start + f])


def prefetch_at(field, array, unit):
    """See encodings: the rows of all corners of all levels."""
    for level in range(field.used):
        below, share = cell_at(field, level, unit)
        rows = corner_rows(field, level, below)
        for q in range(8):
            prefetch(array, rows[q])
