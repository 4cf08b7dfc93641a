"""A grid of vertices: rows of features, trilinear between them (Plenoxels, Fridovich-Keil et al., CVPR 2022;
DVGO, Sun et al., CVPR 2022, eq. 5: interpolated before any activation). Where there are several, rows are
filled up to runs of eight."""

from typing import NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.fields.box import ParameterBlock, largest
from fusedrf_cli.engine.fields.part_options import Numbers
from fusedrf_cli.engine.kernels import reference as torch_reference
from fusedrf_cli.engine.kernels.prefetch import prefetch
from fusedrf_cli.engine.kernels.primitives import accumulate, add_scaled, scatter


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings."""

    numbers: Numbers


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    start: object  # int64, where the rows begin
    counts: object  # (3,) int64, vertices per axis, corners on the faces of the box


def sizes(numbers: int) -> dict[str, int]:
    """See encodings."""
    return {"WIDTH": numbers if numbers == 1 else -(-numbers // 8) * 8}


def sections(resolution: tuple[int, int, int], numbers: int) -> list[ParameterBlock]:
    """See encodings."""
    if numbers == 1:
        return [ParameterBlock("", resolution, (0, 1, 2))]
    return [ParameterBlock("", (*resolution, sizes(numbers)["WIDTH"]), (0, 1, 2), columns=numbers)]


def arrays(field, starts: np.ndarray, numbers: int) -> Arrays:
    """See encodings."""
    return Arrays(np.int64(starts[0]), field.corners[0])


def reference(
    field, sections: dict[str, torch.Tensor], unit: torch.Tensor, read: None, numbers: int
) -> torch.Tensor:
    """See encodings."""
    return torch_reference.trilinear(sections[""].view(*sections[""].shape[:3], -1), unit)


def bound(sections: dict[str, torch.Tensor], read: None, numbers: int) -> torch.Tensor:
    """See encodings."""
    return largest(sections[""].view(*sections[""].shape[:3], -1), kept=1)


# -- compiled ------------------------------------------------------------------------------------------------


def below(u, n):
    """The vertex below a coordinate on an axis of n, and the share of the one above."""
    f = min(max(u, 0.0), 1.0) * (n - 1)
    i = min(int(f), n - 2)
    return i, f - i


def locate(field, unit):
    """See encodings: the number of the lowest vertex of the voxel around a point, and the shares of the upper
    ones."""
    i, u = below(unit[0], field.counts[0])
    j, v = below(unit[1], field.counts[1])
    k, w = below(unit[2], field.counts[2])
    return (i * field.counts[1] + j) * field.counts[2] + k, u, v, w


def corner(field, voxel, q):
    """Where the row of vertex q = 4 a + 2 b + c of a voxel begins, and its weight."""
    first, u, v, w = voxel
    ny, nz = field.counts[1], field.counts[2]
    weight = (u if q & 4 else 1.0 - u) * (v if q & 2 else 1.0 - v) * (w if q & 1 else 1.0 - w)
    vertex = np.uint64(first + ((q >> 2) * ny + ((q >> 1) & 1)) * nz + (q & 1))
    return np.uint64(field.start) + vertex * np.uint64(WIDTH), weight


def summed(field, voxel, scratch):
    """See encodings; of a grid of one number."""
    total = 0.0
    for q in range(8):
        row, weight = corner(field, voxel, q)
        total += weight * field.params[row]
    return total


def summed_backward(field, voxel, d, base, scratch, grad):
    """See encodings."""
    for q in range(8):
        row, weight = corner(field, voxel, q)
        accumulate(grad, row, field.params.dtype.type(weight * d[base]))


def forward(field, voxel, scratch, out, base):
    """See encodings; of a grid of several."""
    start = np.uint64(base)
    for r in range(np.uint64(WIDTH)):
        out[start + r] = 0
    for q in range(8):
        row, weight = corner(field, voxel, q)
        add_scaled(WIDTH, out, start, field.params.dtype.type(weight), field.params, row)


def backward(field, voxel, d, base, scratch, grad):
    """See encodings."""
    for q in range(8):
        row, weight = corner(field, voxel, q)
        scatter(WIDTH, grad, row, field.params.dtype.type(weight), d, np.uint64(base))


def prefetch_at(field, array, voxel):
    """See encodings; of one number, two neighbours share a line most often."""
    for q in range(0, 8, 2 if WIDTH == 1 else 1):
        prefetch(array, corner(field, voxel, q)[0])
