"""Planes times lines, and where their sum says that there may be density a hash grid in the units of space
(hash_runs.py): the first number of its rows is a feature more, the other three are added to the colour's
logits. Products of planes and lines over all of a captured place cannot tell leaves and stones apart; rows
cost time and memory only where some surface uses them.

A cell is the point and whether its rows were asked, which `summed` finds out. What the rows said last waits
in scratch for the colour, and what this sends back waits there for the density's way back."""

from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.encodings import hash_runs, plane_line
from fusedrf_cli.engine.encodings.hash_runs import EMPTY_FROM, HashGrid, rows_at, scatter_rows
from fusedrf_cli.engine.encodings.hash_runs import prefetch_at as prefetch_rows
from fusedrf_cli.engine.encodings.plane_line import prefetch_at as prefetch_planes
from fusedrf_cli.engine.encodings.plane_line import summed as planes_summed
from fusedrf_cli.engine.encodings.plane_line import summed_backward as planes_backward
from fusedrf_cli.engine.fields.box import ParameterBlock


class Arrays(NamedTuple):
    """See plane_line.py and hash_runs.py."""

    starts: object
    texels: object
    table: object
    rows: object
    lattice: object
    shift: object  # float, of the density


def sizes(rank: int, hashed: HashGrid) -> dict[str, int]:
    """See encodings; behind what plane_line.py needs, scratch holds whether rows were asked, of which point
    (1 and three coordinates) the last logits are, these, and the gradient of logits."""
    at = plane_line.sizes(rank)["ROOM"]
    places = {"ASKED": at, "POINT": at + 1, "LOGITS": at + 5, "D_LOGITS": at + 8, "ROOM": at + 11}
    return {"RANK": rank, "WIDTH": 3 * rank + 1} | places


def sections(resolution: tuple[int, int, int], rank: int, hashed: HashGrid) -> list[ParameterBlock]:
    """See encodings."""
    return [*plane_line.sections(resolution, rank), *hash_runs.sections(resolution, hashed)]


def arrays(field, starts: np.ndarray, rank: int, hashed: HashGrid) -> Arrays:
    """See encodings."""
    own, rows = plane_line.arrays(field, starts[:6], rank), hash_runs.arrays(field, starts[6:], hashed)
    return Arrays(*own, *rows, field.activation[1])


def said(field, sections: dict, unit: torch.Tensor, rank: int, hashed: HashGrid) -> tuple[torch.Tensor, ...]:
    """(N, 3 rank) the products, and (N, ROW) what the rows add, 0 where they are not asked."""
    products = plane_line.reference(field, sections, unit, None, rank)
    asked = products.detach().sum(1) + field.shift > EMPTY_FROM
    rows = hash_runs.reference(field, sections, unit, None, hashed)
    return products, torch.where(asked[:, None], rows, 0)


def reference(
    field, sections: dict, unit: torch.Tensor, read: None, rank: int, hashed: HashGrid
) -> torch.Tensor:
    """See encodings."""
    products, rows = said(field, sections, unit, rank, hashed)
    return torch.cat([products, rows[:, :1]], 1)


def logits_reference(field, sections: dict, unit: torch.Tensor, rank: int, hashed: HashGrid) -> torch.Tensor:
    """See encodings."""
    return said(field, sections, unit, rank, hashed)[1][:, 1:]


def bound(sections: dict, read: None, rank: int, hashed: HashGrid) -> torch.Tensor:
    """See encodings."""
    return torch.cat([plane_line.bound(sections, None, rank), hash_runs.bound(sections, None, hashed)[:1]])


def logits_bound(sections: dict, rank: int, hashed: HashGrid) -> float:
    """See encodings."""
    return float(hash_runs.bound(sections, None, hashed)[1:].max())


# -- compiled ------------------------------------------------------------------------------------------------


def locate(field, unit):
    """See encodings."""
    return unpack_cell(field, 0, unit)


def located(field, cell, scratch):
    """See encodings."""
    return cell[0], cell[1], cell[2], int(scratch[AT + ASKED])


def pack_cell(cell):
    """See encodings: whether rows were asked."""
    return cell[3]


def unpack_cell(field, packed, unit):
    """See encodings."""
    real = field.params.dtype.type
    return real(unit[0]), real(unit[1]), real(unit[2]), packed


def summed(field, cell, scratch):
    """See encodings."""
    f = planes_summed(field, (cell[0], cell[1], cell[2]), scratch)
    scratch[AT + ASKED] = 0
    if f + field.shift > EMPTY_FROM:
        f += rows_queried(field, cell, scratch)
        scratch[AT + ASKED] = 1
    return f


def rows_queried(field, cell, scratch):
    """What the rows at a point add to the density; what they add to the logits is left in scratch."""
    at = np.uint64(AT + POINT)
    total, red, green, blue = rows_at(field, (cell[0], cell[1], cell[2]))
    scratch[at], scratch[at + np.uint64(1)] = 1, cell[0]
    scratch[at + np.uint64(2)], scratch[at + np.uint64(3)] = cell[1], cell[2]
    scratch[at + np.uint64(4)], scratch[at + np.uint64(5)], scratch[at + np.uint64(6)] = red, green, blue
    return total


def logits(field, cell, scratch):
    """See encodings; most often of the point whose density was asked last."""
    at = np.uint64(AT + POINT)
    if cell[3] != 0:
        known = scratch[at] != 0 and scratch[at + np.uint64(1)] == cell[0]
        if not (known and scratch[at + np.uint64(2)] == cell[1] and scratch[at + np.uint64(3)] == cell[2]):
            rows_queried(field, cell, scratch)
        return scratch[at + np.uint64(4)], scratch[at + np.uint64(5)], scratch[at + np.uint64(6)]
    zero = scratch.dtype.type(0)
    return zero, zero, zero


def logits_backward(field, cell, d_logits, scratch):
    """See encodings."""
    for c in range(3):
        scratch[AT + D_LOGITS + c] = d_logits[c]


def summed_backward(field, cell, d, base, scratch, grad):
    """See encodings."""
    unit, at = (cell[0], cell[1], cell[2]), np.uint64(AT + D_LOGITS)
    planes_backward(field, unit, d, base, scratch, grad)
    if cell[3] != 0:
        red, green, blue = scratch[at], scratch[at + np.uint64(1)], scratch[at + np.uint64(2)]
        scatter_rows(field, unit, d[base], red, green, blue, grad)
    scratch[at], scratch[at + np.uint64(1)], scratch[at + np.uint64(2)] = 0, 0, 0


def prefetch_at(field, array, cell):
    """See encodings: the planes, and the rows where those of the sample before were asked."""
    unit = cell[0], cell[1], cell[2]
    prefetch_planes(field, array, unit)
    if cell[3] != 0:
        prefetch_rows(field, array, unit)
