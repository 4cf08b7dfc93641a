"""Which splats reach into which cells of a grid: compiled loops over splats."""

import math

import numpy as np

from fusedrf_cli.engine.kernels.field_free import serial


@serial
def reaches(axes, extent, offset, half, along):
    """Whether an ellipsoid reaches into a box: axes (3, 3) its unit axes in rows, extent (3,) how far it goes
    along them, offset (3,) from its centre to the box's, half (3,) half the box's sides; `along` is how far a
    ray's samples may lie beside it. By its own axes alone, which say yes for some corners too many."""
    for k in range(3):
        apart = abs(axes[k, 0] * offset[0] + axes[k, 1] * offset[1] + axes[k, 2] * offset[2])
        wide = abs(axes[k, 0]) * half[0] + abs(axes[k, 1]) * half[1] + abs(axes[k, 2]) * half[2]
        if apart > extent[k] + wide + along:
            return False
    return True


@serial
def fill_cells(centres, axes, extents, lo, cell, counts, along, room, position, members):
    """Count, or where `members` (M,) has room write, the splats of each cell: position (cells,) gains how
    many there are, or says where the next one goes. centres (N, 3), axes (N, 3, 3) and extents
    (N, 3) of splats; room (4, 3) to compute in."""
    first, last, offset, half = room[0], room[1], room[2], room[3]
    for a in range(3):
        half[a] = 0.5 * cell[a]
    for n in range(centres.shape[0]):
        for a in range(3):
            wide = along
            for k in range(3):
                wide += abs(axes[n, k, a]) * extents[n, k]
            first[a] = max(0.0, math.floor((centres[n, a] - wide - lo[a]) / cell[a]))
            last[a] = min(counts[a] - 1.0, math.floor((centres[n, a] + wide - lo[a]) / cell[a]))
        for i in range(int(first[0]), int(last[0]) + 1):
            offset[0] = lo[0] + (i + 0.5) * cell[0] - centres[n, 0]
            for j in range(int(first[1]), int(last[1]) + 1):
                offset[1] = lo[1] + (j + 0.5) * cell[1] - centres[n, 1]
                for k in range(int(first[2]), int(last[2]) + 1):
                    offset[2] = lo[2] + (k + 0.5) * cell[2] - centres[n, 2]
                    if reaches(axes[n], extents[n], offset, half, along):
                        number = (i * counts[1] + j) * counts[2] + k
                        if members.shape[0] > 0:
                            members[position[number]] = n
                        position[number] += 1


def members_of(
    centres: np.ndarray, axes: np.ndarray, extents: np.ndarray, grid, along: float
) -> tuple[np.ndarray, np.ndarray]:
    """(cells + 1,) int64 where the splats of each cell of an OccupancyGrid begin in (M,) int32, numbers of
    splats; see `fill_cells`."""
    counts = np.array(grid.occupied.shape, np.int64)
    ends = np.zeros(int(counts.prod()) + 1, np.int64)
    given = centres, axes, extents, grid.aabb[:3].copy(), grid.cell, counts, along, np.empty((4, 3))
    fill_cells(*given, ends[1:], np.empty(0, np.int32))
    np.cumsum(ends, out=ends)
    members = np.empty(int(ends[-1]), np.int32)
    if len(members):
        fill_cells(*given, ends[:-1].copy(), members)
    return ends, members
