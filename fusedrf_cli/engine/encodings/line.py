"""Lines: RANK features X_r(x) Y_r(y) Z_r(z), each factor linear between texels on an axis (CP decomposition;
TensoRF, Chen et al., ECCV 2022, eq. 3)."""

from typing import NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.fields.box import ParameterBlock, largest
from fusedrf_cli.engine.fields.part_options import Rank
from fusedrf_cli.engine.kernels import reference as torch_reference
from fusedrf_cli.engine.kernels.primitives import linear, scatter, texel


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings."""

    rank: Rank


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    starts: object  # (3,) int64, where the lines of x, y and z begin, as rows of RANK
    texels: object  # (3,) int64, per axis, corners on the faces of the box


def sizes(rank: int) -> dict[str, int]:
    """See encodings; scratch holds the gradients of the three factors."""
    return {"RANK": rank, "WIDTH": rank, "ROOM": 3 * rank}


def sections(resolution: tuple[int, int, int], rank: int) -> list[ParameterBlock]:
    """See encodings; drawn as TensoRF's lines."""
    return [
        ParameterBlock(f"line_{axis}", (resolution[axis], rank), (axis,), spread=0.2) for axis in range(3)
    ]


def arrays(field, starts: np.ndarray, rank: int) -> Arrays:
    """See encodings."""
    return Arrays(starts, field.corners[0])


def reference(
    field, sections: dict[str, torch.Tensor], unit: torch.Tensor, read: None, rank: int
) -> torch.Tensor:
    """See encodings."""
    x, y, z = (torch_reference.linear(sections[f"line_{axis}"], unit[:, axis]) for axis in range(3))
    return x * y * z


def bound(sections: dict[str, torch.Tensor], read: None, rank: int) -> torch.Tensor:
    """See encodings."""
    x, y, z = (largest(sections[f"line_{axis}"], kept=1) for axis in range(3))
    return x * y * z


# -- compiled ------------------------------------------------------------------------------------------------


def texels_around(field, axis, u):
    """Where the rows of the texels below and above a coordinate begin, and the share of the upper."""
    i, share = texel(field.params, field.params.dtype.type(u), field.texels[axis])
    lower = np.uint64(field.starts[axis] + i * RANK)
    return lower, lower + np.uint64(RANK), share


def lines_at(field, unit):
    """`texels_around` on each axis."""
    return (
        texels_around(field, 0, unit[0]),
        texels_around(field, 1, unit[1]),
        texels_around(field, 2, unit[2]),
    )


def factor(params, line, r):
    """Component r of a line."""
    return linear(params, line[0], line[1], line[2], r)


def summed(field, unit, scratch):
    """See encodings."""
    x, y, z = lines_at(field, unit)
    p = field.params
    total = p.dtype.type(0)
    for r in range(np.uint64(RANK)):
        total += factor(p, x, r) * factor(p, y, r) * factor(p, z, r)
    return total


def forward(field, unit, scratch, out, base):
    """See encodings."""
    x, y, z = lines_at(field, unit)
    p, start = field.params, np.uint64(base)
    for r in range(np.uint64(RANK)):
        out[start + r] = factor(p, x, r) * factor(p, y, r) * factor(p, z, r)


def factors_backward(field, unit, d, base, stride, scratch, grad):
    """Adjoint of the features for d[base + r stride]."""
    x, y, z = lines_at(field, unit)
    p, start, room = field.params, np.uint64(base), np.uint64(AT)
    for r in range(np.uint64(RANK)):
        sent = d[start + r * np.uint64(stride)]
        a, b, c = factor(p, x, r), factor(p, y, r), factor(p, z, r)
        scratch[room + r] = sent * b * c
        scratch[room + np.uint64(RANK) + r] = sent * a * c
        scratch[room + np.uint64(2 * RANK) + r] = sent * a * b
    line_backward(field, x, scratch, room, grad)
    line_backward(field, y, scratch, room + np.uint64(RANK), grad)
    line_backward(field, z, scratch, room + np.uint64(2 * RANK), grad)


def line_backward(field, line, scratch, at, grad):
    """Adjoint of `factor` for all components: scratch[at:] is their gradient."""
    scatter(RANK, grad, line[0], field.params.dtype.type(1) - line[2], scratch, at)
    scatter(RANK, grad, line[1], line[2], scratch, at)


def backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    factors_backward(field, unit, d, base, 1, scratch, grad)


def summed_backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    factors_backward(field, unit, d, base, 0, scratch, grad)
