"""A grid of vertices, corners on the faces of the box, of which only some are held: rows of features, trilinear
between them, 0 at all others (Plenoxels, Fridovich-Keil et al., CVPR 2022, sec. 3.1). Two tables of whole
numbers find the row of a vertex, and several vertices may have the same:

    blocks      (X, Y, Z) of each block of SIDE x SIDE x SIDE vertices its place in the other table, or -1
    vertices    (N, SIDE³) of each vertex of such a block its row, or -1
"""

from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import torch
from msgspec import Meta

from fusedrf_cli.engine.fields.box import ParameterBlock, check_whole, largest
from fusedrf_cli.engine.fields.part_options import Numbers, Rows
from fusedrf_cli.engine.kernels.primitives import accumulate, add_scaled, scatter
from fusedrf_cli.engine.kernels.reference import OCTANTS, whole

BITS = 2
SIDE = 1 << BITS


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings."""

    numbers: Numbers
    rows: Rows
    blocks: Annotated[int, Meta(ge=1, le=1 << 22)]


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    table: object  # int64, where the blocks begin
    vertices: object  # int64
    start: object  # int64, where the rows begin
    counts: object  # (3,) int64, vertices per axis, corners on the faces of the box


def sizes(numbers: int, rows: int, blocks: int) -> dict[str, int]:
    """See encodings."""
    return {"WIDTH": numbers if numbers == 1 else -(-numbers // 8) * 8}


def sections(
    resolution: tuple[int, int, int], numbers: int, rows: int, blocks: int
) -> list[ParameterBlock]:
    """See encodings."""
    width = sizes(numbers, rows, blocks)["WIDTH"]
    return [
        ParameterBlock("blocks", tuple(-(-n // SIDE) for n in resolution), rate=0, whole=True),
        ParameterBlock("vertices", (blocks, SIDE**3), rate=0, whole=True),
        ParameterBlock("rows", (rows, width), columns=numbers),
    ]


def tables_of(
    resolution: tuple[int, int, int], vertices: tuple[np.ndarray, ...], rows: np.ndarray
) -> dict[str, np.ndarray]:
    """The sections `blocks` and `vertices` of vertices (three (V,) int64) that have rows (V,)."""
    counts = tuple(-(-n // SIDE) for n in resolution)
    block = np.ravel_multi_index(tuple(i // SIDE for i in vertices), counts)
    place = np.ravel_multi_index(tuple(i % SIDE for i in vertices), (SIDE,) * 3)
    held, at = np.unique(block, return_inverse=True)
    blocks, found = np.full(counts, -1, np.int32), np.full((max(len(held), 1), SIDE**3), -1, np.int32)
    blocks.reshape(-1)[held] = np.arange(len(held))
    found[at, place] = rows
    return {"blocks": blocks, "vertices": found}


def arrays(field, starts: np.ndarray, **options) -> Arrays:
    """See encodings."""
    return Arrays(*starts[:3], field.corners[0])


def reference(
    field, sections: dict, unit: torch.Tensor, read: None, numbers: int, rows: int, blocks: int
) -> torch.Tensor:
    """See encodings."""
    counts, device = whole(field.resolution, unit.device), unit.device
    at = unit.clamp(0, 1) * (counts - 1)
    below = at.detach().long().minimum(counts - 2)
    share, total = at - below, unit.new_zeros(len(unit), sections["rows"].shape[1])
    for offset in whole(OCTANTS, device):
        weight = torch.where(offset == 1, share, 1 - share).prod(1)
        vertex = below + offset
        block = sections["blocks"][(vertex // SIDE).unbind(1)].long()
        inner = vertex % SIDE
        place = (inner[:, 0] * SIDE + inner[:, 1]) * SIDE + inner[:, 2]
        row = sections["vertices"][block.clamp_min(0), place].long()
        held = ((block >= 0) & (row >= 0)).to(total.dtype)
        total = total + (held * weight)[:, None] * sections["rows"][row.clamp_min(0)]
    return total


def bound(sections: dict, read: None, numbers: int, rows: int, blocks: int) -> torch.Tensor:
    """See encodings. Raises ValueError where a table leads to what there is not."""
    check_whole(sections["blocks"], "blocks", blocks)
    check_whole(sections["vertices"], "vertices", rows)
    return largest(sections["rows"], kept=1)


# -- compiled ------------------------------------------------------------------------------------------------


def below(u, n):
    """The vertex below a coordinate on an axis of n, and the share of the one above."""
    f = min(max(u, 0.0), 1.0) * (n - 1)
    i = min(int(f), n - 2)
    return i, f - i


def row_of(field, i, j, k):
    """The row of a vertex, or -1."""
    ny, nz = (field.counts[1] + SIDE - 1) >> BITS, (field.counts[2] + SIDE - 1) >> BITS
    at = field.table + ((i >> BITS) * ny + (j >> BITS)) * nz + (k >> BITS)
    block = int(field.params[np.uint64(at)])
    if block < 0:
        return -1
    place = (((i & (SIDE - 1)) << BITS) + (j & (SIDE - 1)) << BITS) + (k & (SIDE - 1))
    return int(field.params[np.uint64(field.vertices + (block << 3 * BITS) + place)])


def locate(field, unit):
    """See encodings: the rows of the vertices 4 a + 2 b + c of the voxel around a point, and the shares of
    the upper ones."""
    i, u = below(unit[0], field.counts[0])
    j, v = below(unit[1], field.counts[1])
    k, w = below(unit[2], field.counts[2])
    rows = (
        row_of(field, i, j, k), row_of(field, i, j, k + 1), row_of(field, i, j + 1, k),
        row_of(field, i, j + 1, k + 1), row_of(field, i + 1, j, k), row_of(field, i + 1, j, k + 1),
        row_of(field, i + 1, j + 1, k), row_of(field, i + 1, j + 1, k + 1),
    )  # fmt: skip
    return rows, (u, v, w)


def weight_of(shares, q):
    """The weight of vertex q of a voxel."""
    u, v, w = shares
    return (u if q & 4 else 1.0 - u) * (v if q & 2 else 1.0 - v) * (w if q & 1 else 1.0 - w)


def summed(field, voxel, scratch):
    """See encodings; of a grid of one number."""
    total = 0.0
    for q in range(8):
        row = voxel[0][q]
        if row >= 0:
            total += weight_of(voxel[1], q) * field.params[np.uint64(field.start + row)]
    return total


def summed_backward(field, voxel, d, base, scratch, grad):
    """See encodings."""
    for q in range(8):
        row = voxel[0][q]
        if row >= 0:
            sent = field.params.dtype.type(weight_of(voxel[1], q) * d[base])
            accumulate(grad, np.uint64(field.start + row), sent)


def forward(field, voxel, scratch, out, base):
    """See encodings; of a grid of several."""
    start = np.uint64(base)
    for r in range(np.uint64(WIDTH)):
        out[start + r] = 0
    for q in range(8):
        row = voxel[0][q]
        if row >= 0:
            weight = field.params.dtype.type(weight_of(voxel[1], q))
            add_scaled(WIDTH, out, start, weight, field.params, np.uint64(field.start + row * WIDTH))


def backward(field, voxel, d, base, scratch, grad):
    """See encodings."""
    for q in range(8):
        row = voxel[0][q]
        if row >= 0:
            weight = field.params.dtype.type(weight_of(voxel[1], q))
            scatter(WIDTH, grad, np.uint64(field.start + row * WIDTH), weight, d, np.uint64(base))
