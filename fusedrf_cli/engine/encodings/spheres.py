"""Concentric spheres around all else, of which each is an equirectangular map of rows of numbers: the
background of a scene of Plenoxels (Fridovich-Keil et al., CVPR 2022, sec. 3.4; after NeRF++, Zhang et al.
2020). With y the point in the coordinates of `contracted_l2`, n = |y| and LAYERS spheres it lies at

    WIDE (1/2 + atan2(y_x, y_z) / 2π),  HIGH (1/2 - asin(y_y / n) / π),  LAYERS (n - 1) - 1/2

linear between rows along all three; the map goes on round both of its borders, and the last of the three
stays between the first sphere and the last. A table says which column of rows, LAYERS side by side, stands in
a direction, or -1: 0.
"""

import math
from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import torch
from msgspec import Meta

from fusedrf_cli.engine.fields.box import ParameterBlock, check_whole, largest
from fusedrf_cli.engine.fields.part_options import Numbers, Rows
from fusedrf_cli.engine.kernels.primitives import accumulate
from fusedrf_cli.engine.kernels.reference import OCTANTS, whole

Side = Annotated[int, Meta(ge=1, le=1 << 14)]


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings."""

    numbers: Numbers
    wide: Side
    high: Side
    layers: Annotated[int, Meta(ge=1, le=4096)]
    columns: Rows


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    table: object  # int64, where the numbers of the columns begin
    start: object  # int64, where the rows begin


def sizes(numbers: int, wide: int, high: int, layers: int, columns: int) -> dict[str, int]:
    """See encodings."""
    return {"WIDTH": numbers, "WIDE": wide, "HIGH": high, "LAYERS": layers}


def sections(resolution: tuple, numbers: int, wide: int, high: int, layers: int, columns: int) -> list:
    """See encodings."""
    return [
        ParameterBlock("columns", (wide, high), rate=0, whole=True),
        ParameterBlock("values", (columns * layers, numbers)),
    ]


def arrays(field, starts: np.ndarray, **options) -> Arrays:
    """See encodings."""
    return Arrays(*starts[:2])


def reference(
    field, sections: dict, unit: torch.Tensor, read: None, numbers: int, wide: int, high: int, layers: int,
    columns: int,
) -> torch.Tensor:  # fmt: skip
    """See encodings."""
    box = torch.as_tensor(field.box).to(unit)
    y = box[:3] + unit * (box[3:] - box[:3])
    n = y.norm(dim=1).clamp_min(1e-9)
    at = torch.stack(
        [
            wide * (0.5 + torch.atan2(y[:, 0], y[:, 2]) / (2 * math.pi)),
            high * (0.5 - torch.asin((y[:, 1] / n).clamp(-1, 1)) / math.pi),
            (layers * (n - 1) - 0.5).clamp(0, layers - 1),
        ],
        1,
    )
    lower = at.detach().long()
    lower[:, 2].clamp_(max=max(layers - 2, 0))
    share, total = at - lower, unit.new_zeros(len(unit), numbers)
    for offset in whole(OCTANTS, unit.device):
        weight = torch.where(offset == 1, share, 1 - share).prod(1)
        i, j, k = (lower + offset).unbind(1)
        column = sections["columns"][i % wide, j % high].round().long()
        rows = sections["values"][column.clamp_min(0) * layers + k.clamp_max(layers - 1)]
        total = total + (weight * (column >= 0))[:, None].to(rows.dtype) * rows
    return total


def bound(sections: dict, read: None, columns: int, **options) -> torch.Tensor:
    """See encodings. Raises ValueError where the table leads to what there is not."""
    check_whole(sections["columns"], "columns", columns)
    return largest(sections["values"], kept=1)


# -- compiled ------------------------------------------------------------------------------------------------


def place_at(field, unit):
    """The lowest of the eight rows around a point, on each axis, and the shares of the upper ones."""
    x = field.lo[0] + unit[0] * field.side[0]
    y = field.lo[1] + unit[1] * field.side[1]
    z = field.lo[2] + unit[2] * field.side[2]
    n = max(math.sqrt(x * x + y * y + z * z), 1e-9)
    u = WIDE * (0.5 + math.atan2(x, z) / (2.0 * math.pi))
    v = HIGH * (0.5 - math.asin(min(max(y / n, -1.0), 1.0)) / math.pi)
    w = min(max(LAYERS * (n - 1.0) - 0.5, 0.0), LAYERS - 1.0)
    i, j, k = int(u), int(v), min(int(w), max(LAYERS - 2, 0))
    return (i, j, k), (u - i, v - j, w - k)


def corner(field, place, q):
    """Where row q = 4 a + 2 b + c around a point begins, or -1, and its weight."""
    a, b, c = q >> 2, (q >> 1) & 1, q & 1
    (i, j, k), (u, v, w) = place
    weight = (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if c else 1.0 - w)
    column = int(field.params[np.uint64(field.table + ((i + a) % WIDE) * HIGH + (j + b) % HIGH)])
    row = field.start + (column * LAYERS + min(k + c, LAYERS - 1)) * WIDTH if column >= 0 else -1
    return row, field.params.dtype.type(weight)


def summed(field, unit, scratch):
    """See encodings; of one number."""
    total, place = 0.0, place_at(field, unit)
    for q in range(8):
        row, weight = corner(field, place, q)
        if row >= 0:
            total += weight * field.params[np.uint64(row)]
    return total


def summed_backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    backward(field, unit, d, base, scratch, grad)


def forward(field, unit, scratch, out, base):
    """See encodings."""
    place = place_at(field, unit)
    for r in range(WIDTH):
        out[base + r] = 0
    for q in range(8):
        row, weight = corner(field, place, q)
        if row >= 0:
            for r in range(WIDTH):
                out[base + r] += weight * field.params[np.uint64(row + r)]


def backward(field, unit, d, base, scratch, grad):
    """See encodings."""
    place = place_at(field, unit)
    for q in range(8):
        row, weight = corner(field, place, q)
        if row >= 0:
            for r in range(WIDTH):
                accumulate(grad, np.uint64(row + r), weight * d[base + r])
