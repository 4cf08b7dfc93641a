"""Vertices of bricks of voxels: rows of numbers, trilinear between them, only where something is and as fine
as it is there (voxels as in Plenoxels, Fridovich-Keil et al., CVPR 2022, over an octree as in PlenOctrees, Yu
et al., ICCV 2021).

    brick        4 x 4 x 4 voxels, a leaf of a tree whose roots are the *top cells* of the field's box; a
                 brick of level l is 2^-l top cells wide
    unit         a point in top cells from the lower corner of the box: in place of the box's unit cube
    rows         (V, ROW) numbers, a row per vertex of the bricks' voxels: of the density, and of degree 0 of
                 the three colours
    bands        (W, BANDS) numbers of the colour: the coefficients of degree 1 and more, channel by channel,
                 one row per vertex of a lattice of COARSE voxels a side and brick
    cell         (brick or -1, its level or that of the empty node, first vertex of the voxel or -1 where it
                 is not active, and the shares u, v, w of the upper vertices)
Of one number they are the density's features, of more the colour's: the bands and, behind them, a row, whose
last three are of degree 0 (decoders/sh.py, `apart`).

In a brick of level l one step in 2^(finest - l), counted from the ray's first, is a sample, and stands for as
many: which they are does not depend on what was skipped before.
"""

import math
from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.kernels.primitives import (
    FACE_TOLERANCE,
    accumulate,
    add_scaled,
    exit_distance,
    scatter,
    scatter_4,
)
from fusedrf_cli.engine.kernels.reference import OCTANTS, exact, whole

SIDE = 4  # voxels of a brick along an axis
COARSE = 2  # voxels of the bands' lattice along a brick's side
ROW = 4  # numbers of a vertex: density feature, three colours


class Arrays(NamedTuple):
    """What the functions read beside `params` (N bricks)."""

    start: object  # int64, where the rows begin
    bands: object  # int64, where the bands begin
    offset: object  # (X, Y, Z) int64, where a top cell's table begins, or -1
    depth: object  # (X, Y, Z) uint8, the level of its finest brick: the table has 2^depth entries a side
    table: object  # (E,) int32, the brick that holds an entry's cube, or -1 - level of the empty node
    level: object  # (N,) uint8
    mask: object  # (N,) uint64, bit (i * 4 + j) * 4 + k of an active voxel
    rows: object  # (N, 125) int32, the rows of a brick's vertices
    band_rows: object  # (N, (COARSE + 1)^3) int32
    finest: object  # int, the level of the finest brick


def sizes(numbers: int) -> dict[str, int]:
    """See encodings."""
    bands = -(-max(numbers - 3, 0) // 8) * 8
    return {"BANDS": bands, "WIDTH": 1 if numbers == 1 else bands + ROW}


def arrays(field, starts: np.ndarray, numbers: int) -> Arrays:
    """See encodings; `starts` are those of the rows and of the bands."""
    tree = field.tree
    return Arrays(*starts, *tree.tables, tree.level, tree.bits, *field.vertex_rows, tree.depth)


def reference(field, sections: dict, unit: torch.Tensor, read: None, numbers: int) -> torch.Tensor:
    """See encodings; a section is a lattice of vertices (kinds/sparse/lattice.py) and its rows (V, R). Which
    voxel a point lies in is a constant; where none is active, what is answered means nothing."""
    return torch.cat([blend(lattice, settled(lattice, rows), unit) for lattice, rows in sections.values()], 1)


def settled(lattice, rows: torch.Tensor) -> torch.Tensor:
    """The rows (V, R) of a lattice's vertices, those of hanging ones summed anew from the free ones."""
    spread = lattice.spread.tocoo()
    if not spread.shape[0]:
        return rows
    free, (target, source) = rows[: lattice.free], (whole(i, rows.device) for i in (spread.row, spread.col))
    weight = exact(spread.data, rows.device).to(rows.dtype)[:, None]
    hanging = rows.new_zeros(spread.shape[0], rows.shape[1])
    return torch.cat([free, hanging.index_add(0, target, weight * free[source])])


def blend(lattice, rows: torch.Tensor, unit: torch.Tensor) -> torch.Tensor:
    """(N, R) rows (V, R) of a lattice's vertices, interpolated at points (N, 3)."""
    n, device = lattice.n, unit.device
    brick = brick_of(lattice.tree, unit).clamp_min(0)
    voxel, share = voxel_of(lattice.tree, n, brick, unit)
    octants = whole(OCTANTS, device)
    vertex = voxel[:, None] + octants
    vertex = (vertex[..., 0] * (n + 1) + vertex[..., 1]) * (n + 1) + vertex[..., 2]
    row = whole(lattice.rows, device)[brick[:, None], vertex]
    weight = torch.where(octants == 1, share[:, None], 1 - share[:, None]).prod(2)
    return (weight.to(rows.dtype)[..., None] * rows[row]).sum(1)


def brick_of(tree, unit: torch.Tensor) -> torch.Tensor:
    """(N,) int64 brick that holds each point (N, 3), or -1."""
    device = unit.device
    offset, depth, table = (whole(a, device) for a in tree.tables)
    last = torch.tensor(tree.counts, device=device) - 1
    at, cell = unit.detach(), unit.detach().floor().long()
    inside = ((cell >= 0) & (cell <= last)).all(1)
    cell = cell.clamp_min(0).minimum(last)
    start, side = offset[cell.unbind(1)], 1 << depth[cell.unbind(1)]
    inside = inside & (start >= 0)
    a, b, c = ((at - cell) * side[:, None]).long().clamp_min(0).minimum(side[:, None] - 1).unbind(1)
    entry = torch.where(inside, start + (a * side + b) * side + c, 0)
    return torch.where(inside, table[entry], -1).clamp_min(-1)


def voxel_of(tree, n: int, brick: torch.Tensor, unit: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The voxel (N, 3) int64 of a brick's n along each axis that points (N, 3) lie in, and the shares (N, 3)
    of its upper corners."""
    at = unit * (1 << whole(tree.level, unit.device)[brick][:, None])
    at = (at - at.detach().floor()) * n
    voxel = at.detach().long().clamp(0, n - 1)
    return voxel, at - voxel


def active_at(tree, unit: torch.Tensor) -> torch.Tensor:
    """(N,) bool, whether the voxel around each point (N, 3) is an active one."""
    brick = brick_of(tree, unit)
    voxel, _ = voxel_of(tree, SIDE, brick.clamp_min(0), unit)
    return (brick >= 0) & torch.from_numpy(tree.mask).to(unit.device)[(brick.clamp_min(0), *voxel.unbind(1))]


# -- compiled: where a point lies ----------------------------------------------------------------------------


def brick_at(field, unit):
    """(brick, its level) that holds a point; (-1, level of the empty node around it) where there is none.

    Outside the box the answer is an empty node of level 0.
    """
    u, v, w = unit
    nx, ny, nz = field.offset.shape
    i, j, m = int(math.floor(u)), int(math.floor(v)), int(math.floor(w))
    if i < 0 or j < 0 or m < 0 or i >= nx or j >= ny or m >= nz:
        return -1, 0
    offset = field.offset[np.uint64(i), np.uint64(j), np.uint64(m)]
    if offset < 0:
        return -1, 0
    n = 1 << int(field.depth[np.uint64(i), np.uint64(j), np.uint64(m)])
    a, b, c = min(int((u - i) * n), n - 1), min(int((v - j) * n), n - 1), min(int((w - m) * n), n - 1)
    brick = int(field.table[np.uint64(offset + (a * n + b) * n + c)])
    if brick < 0:
        return -1, -1 - brick
    return brick, int(field.level[np.uint64(brick)])


def along_brick(u, level):
    """Voxel of a brick's SIDE along an axis that a coordinate lies in, and the share inside it."""
    u = u * (1 << level)
    f = (u - math.floor(u)) * SIDE
    i = min(int(f), SIDE - 1)
    return i, f - i


def in_brick(field, brick, level, unit):
    """The cell of a point in a brick."""
    i, u = along_brick(unit[0], level)
    j, v = along_brick(unit[1], level)
    m, w = along_brick(unit[2], level)
    bit = np.uint64((i * SIDE + j) * SIDE + m)
    if (field.mask[np.uint64(brick)] >> bit) & np.uint64(1) == np.uint64(0):
        return brick, level, -1, 0.0, 0.0, 0.0
    return brick, level, (i * (SIDE + 1) + j) * (SIDE + 1) + m, u, v, w


def locate(field, unit):
    """See encodings."""
    brick, level = brick_at(field, unit)
    if brick < 0:
        return brick, level, -1, 0.0, 0.0, 0.0
    return in_brick(field, brick, level, unit)


def steps_at(field, cell, unit, index):
    """See encodings: only multiples of a brick's steps are sampled."""
    if cell[2] < 0:
        return 0
    n_steps = 1 << (field.finest - cell[1])
    return n_steps if index & (n_steps - 1) == 0 else 0


def is_inside(field, grid, p):
    """See encodings: voxels are found without the grid."""
    return True


def pack_cell(cell):
    """See encodings: the brick."""
    return cell[0]


def unpack_cell(field, packed, unit):
    """See encodings; rounding may put the point beside the brick, or into a voxel that is not active."""
    return in_brick(field, packed, int(field.level[np.uint64(packed)]), unit)


def node_exit(field, level, p, direction):
    """Distance from a point to where a ray leaves the node of a level around it."""
    n = 1.0 / (1 << level)
    a, b, c = n * field.side[0], n * field.side[1], n * field.side[2]
    i = math.floor((p[0] - field.lo[0]) / a)
    j = math.floor((p[1] - field.lo[1]) / b)
    m = math.floor((p[2] - field.lo[2]) / c)
    return min(
        exit_distance(p[0], direction[0], field.lo[0], a, i, 1),
        min(
            exit_distance(p[1], direction[1], field.lo[1], b, j, 1),
            exit_distance(p[2], direction[2], field.lo[2], c, m, 1),
        ),
    )


def next_index(field, cell, n_steps, strides, index, p, direction, t_local, t_begin, step):
    """See encodings: in a brick the next number that is a multiple of its steps, or the first beyond it; else
    the first beyond the empty node."""
    brick, level = cell[0], cell[1]
    stride = 1 << (field.finest - level)
    if brick >= 0 and stride == 1:
        return index + 1
    away = node_exit(field, level, p, direction)
    beyond = max(index + 1, int(math.ceil((t_local + away - t_begin) / step - FACE_TOLERANCE)))
    return min((index | (stride - 1)) + 1, beyond) if brick >= 0 else beyond


# -- compiled: what is there ---------------------------------------------------------------------------------


def corner(first, q, n):
    """Vertex q = 4 a + 2 b + c of the voxel whose first vertex is given, in a brick of n voxels a side."""
    return np.uint64(first + ((q >> 2) * (n + 1) + ((q >> 1) & 1)) * (n + 1) + (q & 1))


def corner_weight(q, u, v, w):
    """Its weight."""
    return (u if q & 4 else 1.0 - u) * (v if q & 2 else 1.0 - v) * (w if q & 1 else 1.0 - w)


def row_of(field, brick, vertex):
    """Where the row of a vertex of a brick begins."""
    return np.uint64(field.start + ROW * field.rows[np.uint64(brick), np.uint64(vertex)])


def row_at(field, cell, q):
    """Where the row of vertex q of a voxel begins, and its weight."""
    return row_of(field, cell[0], corner(cell[2], q, SIDE)), corner_weight(q, cell[3], cell[4], cell[5])


def band_at(field, cell, q):
    """Where the row of bands of vertex q of the wider voxel around a voxel begins, and its weight."""
    brick, _, first, u, v, w = cell
    i, j, m = first // (SIDE + 1) ** 2, first // (SIDE + 1) % (SIDE + 1), first % (SIDE + 1)
    ratio = SIDE // COARSE
    wide = ((i // ratio) * (COARSE + 1) + j // ratio) * (COARSE + 1) + m // ratio
    u, v, w = (i % ratio + u) / ratio, (j % ratio + v) / ratio, (m % ratio + w) / ratio
    row = field.band_rows[np.uint64(brick), corner(wide, q, COARSE)]
    return np.uint64(field.bands + BANDS * row), field.params.dtype.type(corner_weight(q, u, v, w))


def lerp(low, high, share):
    """Of two numbers, so much of the way from the first."""
    return low + share * (high - low)


def edge_at(field, cell, vertex):
    """The density feature on the edge of a voxel, along z, that begins at a vertex."""
    low, high = row_of(field, cell[0], vertex), row_of(field, cell[0], vertex + 1)
    return lerp(field.params[low], field.params[high], cell[5])


def summed(field, cell, scratch):
    """See encodings; of the density. Edge by edge: of eight products the compiler makes vectors by gathering,
    which takes a tenth longer."""
    first, n = cell[2], SIDE + 1
    low = lerp(edge_at(field, cell, first), edge_at(field, cell, first + n), cell[4])
    first += n * n
    high = lerp(edge_at(field, cell, first), edge_at(field, cell, first + n), cell[4])
    return lerp(low, high, cell[3])


def summed_backward(field, cell, d, base, scratch, grad):
    """See encodings."""
    if cell[2] >= 0:
        d_feature, real = d[base], field.params.dtype.type
        for q in range(8):
            row, weight = row_at(field, cell, q)
            accumulate(grad, row, real(weight) * d_feature)


def forward(field, cell, scratch, out, base):
    """See encodings; of the colour. Without an active voxel all features are 0."""
    start, last, params = np.uint64(base), np.uint64(base + BANDS), field.params
    real = params.dtype.type
    f, r, g, b = real(0), real(0), real(0), real(0)
    for i in range(np.uint64(BANDS)):
        out[start + i] = 0
    if cell[2] >= 0:
        for q in range(8):
            row, weight = row_at(field, cell, q)
            share = real(weight)
            f += share * params[row]
            r += share * params[row + np.uint64(1)]
            g += share * params[row + np.uint64(2)]
            b += share * params[row + np.uint64(3)]
        if BANDS > 0:
            for q in range(8):
                row, share = band_at(field, cell, q)
                add_scaled(BANDS, out, start, share, params, row)
    out[last], out[last + np.uint64(1)], out[last + np.uint64(2)], out[last + np.uint64(3)] = f, r, g, b


def backward(field, cell, d, base, scratch, grad):
    """See encodings."""
    if cell[2] >= 0:
        for q in range(8):
            row, weight = row_at(field, cell, q)
            scatter_4(grad, row, field.params.dtype.type(weight), d, np.uint64(base + BANDS))
        if BANDS > 0:
            for q in range(8):
                row, share = band_at(field, cell, q)
                scatter(BANDS, grad, row, share, d, np.uint64(base))
