"""A grid of vertices, corners on the faces of the box, of which only some are held: a number at each of
these, trilinear between them, 0 at all others (Plenoxels, Fridovich-Keil et al., CVPR 2022, sec. 3.1). Two
tables of whole numbers find the row of a vertex, and several vertices may have the same:

    blocks      (X, Y, Z) of each block of SIDE x SIDE x SIDE vertices its place in the other table, or -1
    vertices    (N, SIDE³) of each vertex of such a block its row, or -1

The colour's features at the same vertices are those of sparse_rows.py.
"""

from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import torch
from msgspec import Meta

from fusedrf_cli.engine.fields.box import ParameterBlock, check_whole, largest
from fusedrf_cli.engine.fields.part_options import Rows
from fusedrf_cli.engine.kernels.primitives import accumulate
from fusedrf_cli.engine.kernels.reference import OCTANTS, whole

BITS = 2
SIDE = 1 << BITS


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings."""

    rows: Rows
    blocks: Annotated[int, Meta(ge=1, le=1 << 22)]


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    table: object  # int64, where the blocks begin
    vertices: object  # int64
    start: object  # int64, where the rows begin
    counts: object  # (3,) int64, vertices per axis, corners on the faces of the box


def sizes(rows: int, blocks: int) -> dict[str, int]:
    """See encodings."""
    return {"WIDTH": 1}


def sections(resolution: tuple[int, int, int], rows: int, blocks: int) -> list[ParameterBlock]:
    """See encodings."""
    return [
        ParameterBlock("blocks", tuple(-(-n // SIDE) for n in resolution), rate=0, whole=True),
        ParameterBlock("vertices", (blocks, SIDE**3), rate=0, whole=True),
        ParameterBlock("values", (rows, 1)),
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


def reference(field, sections: dict, unit: torch.Tensor, read: None, rows: int, blocks: int) -> torch.Tensor:
    """See encodings."""
    return blend(sections, sections["values"], field.resolution, unit)


def blend(
    tables: dict, rows: torch.Tensor, resolution: tuple[int, int, int], unit: torch.Tensor
) -> torch.Tensor:
    """(N, R) rows (M, R) of the vertices of a grid that two tables find, interpolated at unit (N, 3)."""
    device = unit.device
    blocks, vertices = (tables[name].to(device).round().long() for name in ("blocks", "vertices"))
    last = whole(resolution, device) - 1
    at = unit.clamp(0, 1) * last
    below = at.detach().long().minimum(last - 1)
    share, total = at - below, rows.new_zeros(len(unit), rows.shape[1])
    for offset in whole(OCTANTS, device):
        weight = torch.where(offset == 1, share, 1 - share).prod(1)
        i, j, k = ((below + offset) % SIDE).unbind(1)
        block = blocks[((below + offset) // SIDE).unbind(1)]
        row = vertices[block.clamp_min(0), (i * SIDE + j) * SIDE + k]
        held = (block >= 0) & (row >= 0)
        total = total + (held * weight)[:, None].to(rows.dtype) * rows[row.clamp_min(0)]
    return total


def bound(sections: dict, read: None, rows: int, blocks: int) -> torch.Tensor:
    """See encodings. Raises ValueError where a table leads to what there is not."""
    check_whole(sections["blocks"], "blocks", blocks)
    check_whole(sections["vertices"], "vertices", rows)
    return largest(sections["values"], kept=1)


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
    """See encodings."""
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
