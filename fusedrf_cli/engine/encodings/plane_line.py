"""Planes times lines: 3 RANK features P_r(a, b) L_r(c), mode after mode: plane xy and line z, plane xz and
line y, plane yz and line x (vector-matrix decomposition; TensoRF, Chen et al., ECCV 2022, eq. 5)."""

from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.fields.box import Part, largest
from fusedrf_cli.engine.kernels import reference as torch_reference
from fusedrf_cli.engine.kernels.planes import mode_backward, mode_forward, mode_sum
from fusedrf_cli.engine.kernels.prefetch import prefetch_plane

MODES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))  # plane axes a, b and line axis c of each mode


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    starts: object  # (6,) int64, where the three planes and the three lines begin, as rows of RANK
    texels: object  # (3,) int64, per axis, corners on the faces of the box


def sizes(rank: int) -> dict[str, int]:
    """See encodings; scratch holds the gradients of a plane's and of a line's components."""
    return {"RANK": rank, "WIDTH": 3 * rank, "ROOM": 2 * rank}


def sections(resolution: tuple[int, int, int], rank: int) -> list[Part]:
    """See encodings."""
    n = resolution
    planes = [Part(f"plane_{m}", (n[a], n[b], rank), (a, b)) for m, (a, b, _) in enumerate(MODES)]
    return [*planes, *(Part(f"line_{m}", (n[c], rank), (c,)) for m, (_, _, c) in enumerate(MODES))]


def arrays(field, starts: np.ndarray, rank: int) -> Arrays:
    """See encodings."""
    return Arrays(starts, field.corners[0])


def reference(sections: dict[str, torch.Tensor], unit: torch.Tensor, read: None, rank: int) -> torch.Tensor:
    """See encodings."""
    products = []
    for m, (a, b, c) in enumerate(MODES):
        plane = torch_reference.bilinear(sections[f"plane_{m}"], unit[:, a], unit[:, b])
        products.append(plane * torch_reference.linear(sections[f"line_{m}"], unit[:, c]))
    return torch.cat(products, 1)


def bound(sections: dict[str, torch.Tensor], read: None, rank: int) -> torch.Tensor:
    """See encodings."""
    peak = {name: largest(view, kept=1) for name, view in sections.items()}
    return torch.cat([peak[f"plane_{m}"] * peak[f"line_{m}"] for m in range(3)])


# -- compiled ------------------------------------------------------------------------------------------------


def rounded(field, unit):
    """A point in the numbers' type."""
    real = field.params.dtype.type
    return real(unit[0]), real(unit[1]), real(unit[2])


def summed(field, unit, scratch):
    """See encodings."""
    (u, v, w), p, s = rounded(field, unit), field.params, field.starts
    x, y, z = field.texels[0], field.texels[1], field.texels[2]
    return (
        mode_sum(RANK, p, s[0], s[3], (x, y, z), (u, v, w))
        + mode_sum(RANK, p, s[1], s[4], (x, z, y), (u, w, v))
        + mode_sum(RANK, p, s[2], s[5], (y, z, x), (v, w, u))
    )


def forward(field, unit, scratch, out, base):
    """See encodings."""
    (u, v, w), p, s = rounded(field, unit), field.params, field.starts
    x, y, z = field.texels[0], field.texels[1], field.texels[2]
    mode_forward(RANK, p, s[0], s[3], (x, y, z), (u, v, w), out, base)
    mode_forward(RANK, p, s[1], s[4], (x, z, y), (u, w, v), out, base + RANK)
    mode_forward(RANK, p, s[2], s[5], (y, z, x), (v, w, u), out, base + 2 * RANK)


def backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    (u, v, w), p, s = rounded(field, unit), field.params, field.starts
    x, y, z = field.texels[0], field.texels[1], field.texels[2]
    mode_backward(RANK, p, s[0], s[3], (x, y, z), (u, v, w), d, base, 1, scratch, AT, grad)
    mode_backward(RANK, p, s[1], s[4], (x, z, y), (u, w, v), d, base + RANK, 1, scratch, AT, grad)
    mode_backward(RANK, p, s[2], s[5], (y, z, x), (v, w, u), d, base + 2 * RANK, 1, scratch, AT, grad)


def summed_backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    (u, v, w), p, s = rounded(field, unit), field.params, field.starts
    x, y, z = field.texels[0], field.texels[1], field.texels[2]
    mode_backward(RANK, p, s[0], s[3], (x, y, z), (u, v, w), d, base, 0, scratch, AT, grad)
    mode_backward(RANK, p, s[1], s[4], (x, z, y), (u, w, v), d, base, 0, scratch, AT, grad)
    mode_backward(RANK, p, s[2], s[5], (y, z, x), (v, w, u), d, base, 0, scratch, AT, grad)


def prefetch_at(field, array, unit):
    """See encodings: the texels of the planes. A random point misses the cache a dozen times; asked for
    early, the misses overlap."""
    u, v, w = unit
    x, y, z = field.texels[0], field.texels[1], field.texels[2]
    prefetch_plane(RANK, array, field.starts[0], x, y, u, v)
    prefetch_plane(RANK, array, field.starts[1], x, z, u, w)
    prefetch_plane(RANK, array, field.starts[2], y, z, v, w)
