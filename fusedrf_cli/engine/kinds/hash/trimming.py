"""Hash grids without the rows that nothing asks, or that say least."""

from functools import partial

import torch

from fusedrf_cli.engine.encodings.hash_grid import row_of
from fusedrf_cli.engine.fields.stored_rows import RUN
from fusedrf_cli.engine.kinds.asked_rows import Lattice, asked_rows
from fusedrf_cli.engine.kinds.hash.field import ROWS, HashField


def rows_used(field: HashField) -> int:
    """How many rows, the first ones, the levels have that are not left out."""
    return sum(level["rows"] for level in field.used_levels)


def without_unused(field: HashField) -> HashField:
    """The same field with 0 in all rows of levels that its texels leave out."""
    trimmed = field.with_params(field.params.clone())
    trimmed.sections()[ROWS][rows_used(field) :] = 0
    return trimmed


def with_fewer_rows(field: HashField, count: int) -> HashField:
    """The field with so many of its rows, by RUN neighbours those of the largest sum of squares. The others
    are 0, and stay so when it learns. (A bear with half of its rows: 34 dB of itself, without its finest
    levels 22.)"""
    few = without_unused(field)
    runs = few.sections()[ROWS].view(-1, RUN * few.shape.features)
    left_out = torch.ones(len(runs), dtype=torch.bool, device=runs.device)
    left_out[runs.square().sum(1).topk(count // RUN).indices] = False
    runs[left_out] = 0
    few.few_rows = True
    return few


def without_unasked(field: HashField) -> HashField:
    """The same field with 0 in all rows that no occupied cell asks: it answers the same there, and a file has
    the other rows alone."""
    if field.params.device.type != "cpu":
        return without_unasked(field.to("cpu")).to(field.params.device)
    trimmed, (low, sides), cells = without_unused(field), field.cube, field.occupancy
    corners = (cells.aabb.reshape(2, 3) - low) / sides
    levels = []
    for level in field.used_levels:  # whose vertices are whole numbers
        box = (level["scale"] * corners + level["offset"]).ravel()
        levels.append(Lattice(box, 1.0, level["rows"], partial(row_of, level)))
    asked = asked_rows(levels, [cells.occupied])
    trimmed.sections()[ROWS][: len(asked)][torch.from_numpy(~asked)] = 0
    return trimmed
