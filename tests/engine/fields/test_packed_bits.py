"""Grids of cells as files have them: all bits, or bricks where many cells are alike."""

import numpy as np
import pytest

from fusedrf_cli.engine.fields.cell_bits import few_cells, most_bits, packed_bits, unpack_bits
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid


def ball(shape, radius: float = 0.4) -> np.ndarray:
    """The cells of a ball."""
    at = np.stack(np.meshgrid(*[(np.arange(n) + 0.5) / n - 0.5 for n in shape], indexing="ij"))
    return (at**2).sum(0) < radius**2


@pytest.mark.parametrize("shape", [(40, 40, 40), (41, 38, 43), (64, 3, 50)])
@pytest.mark.parametrize("grid", [ball, np.ones, lambda shape: np.zeros(shape, bool)])
def test_cells_come_back_from_bricks(shape, grid):
    cells = grid(shape).astype(bool)
    arrays = packed_bits("cells", cells, few=0)
    assert set(arrays) == {"cells.bricks", "cells.mixed"} or shape[1] == 3
    assert np.array_equal(unpack_bits(arrays, "cells", list(shape)), cells)
    assert sum(a.nbytes for a in arrays.values()) <= cells.size / 8 + 1


def test_few_cells_and_scattered_ones_are_their_bits():
    scattered = np.random.default_rng(0).random((40, 40, 40)) < 0.5
    for cells, few in ((ball((20,) * 3), 1 << 22), (scattered, 0)):
        arrays = packed_bits("cells", cells, few)
        assert np.array_equal(arrays["cells"], np.packbits(cells)) and len(arrays) == 1


@pytest.mark.parametrize("numbers", [0, 100_000, 200_000])
def test_bits_are_bounded_for_all_grids_of_fewer_cells(numbers):
    """A student begins with the cells of its scene and gives some up, here up to nearly all of them."""
    rng, whole = np.random.default_rng(0), ball((41, 38, 43))
    bound = OccupancyGrid(np.array([0.0, 0, 0, 1, 1, 1]), whole).stored_bits(numbers)
    assert bound == whole.size if whole.size <= numbers / 2 else bound == most_bits(whole) < whole.size
    for share in (0, 0.001, 0.05, 0.5, 0.98, 1):
        cells = whole & (rng.random(whole.shape) < share)
        arrays = packed_bits("cells", cells, few_cells(numbers))
        assert sum(a.nbytes for a in arrays.values()) <= -(-bound // 8)


HOSTILE = {
    "too few marks": ({"cells.bricks": lambda a: a[:-1]}, (40,) * 3, "should be 250 bytes"),
    "other marks": ({"cells.bricks": np.zeros_like}, (40,) * 3, "should have 0 rows"),
    "no bits": ({"cells.mixed": lambda a: None}, (40,) * 3, "should have .* rows"),
    "bits of another type": ({"cells.mixed": lambda a: a.astype(np.int32)}, (40,) * 3, "should have .* rows"),
    "too many cells": ({}, (8192,) * 3, "at most 67,108,864 are read"),
    "another grid": ({}, (40, 40, 48), "should be 300 bytes"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_bricks_that_fit_no_grid_are_refused(name):
    changes, shape, said = HOSTILE[name]
    arrays = packed_bits("cells", ball((40,) * 3), few=0)
    arrays |= {key: change(arrays[key]) for key, change in changes.items()}
    with pytest.raises(ValueError, match=said):
        unpack_bits(arrays, "cells", list(shape))
