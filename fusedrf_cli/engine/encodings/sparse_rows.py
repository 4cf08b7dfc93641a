"""Rows of features at the vertices that the density's `sparse_grid` holds, trilinear between them."""

from typing import NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.encodings.sparse_grid import blend, weight_of
from fusedrf_cli.engine.fields.box import ParameterBlock, largest
from fusedrf_cli.engine.fields.part_options import Numbers
from fusedrf_cli.engine.kernels.primitives import add_scaled, scatter


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings; there are as many `rows` as the grid has."""

    numbers: Numbers


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    start: object  # int64, where the rows begin


def sizes(numbers: int, rows: int) -> dict[str, int]:
    """See encodings."""
    return {"WIDTH": -(-numbers // 8) * 8}


def sections(resolution: tuple[int, int, int], numbers: int, rows: int) -> list[ParameterBlock]:
    """See encodings."""
    return [ParameterBlock("values", (rows, sizes(numbers, rows)["WIDTH"]), columns=numbers)]


def arrays(field, starts: np.ndarray, **options) -> Arrays:
    """See encodings."""
    return Arrays(np.int64(starts[0]))


def reference(
    field, sections: dict, unit: torch.Tensor, read: None, numbers: int, rows: int
) -> torch.Tensor:  # fmt: skip
    """See encodings."""
    return blend(field.slot_sections()["density"], sections["values"], field.resolution, unit)


def bound(sections: dict, read: None, **options) -> torch.Tensor:
    """See encodings."""
    return largest(sections["values"], kept=1)


# -- compiled ------------------------------------------------------------------------------------------------

locate = None


def forward(field, voxel, scratch, out, base):
    """See encodings."""
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
