"""Cascades of cells against a look-up of each point."""

import numpy as np
import pytest

from formats.errors import FormatError
from fusedrf_cli.bridge.importing.cells import cascades_of, cells_of_bits

from .hash_oracle import occupied


def bits_of(bound: float, side: int, share: float) -> np.ndarray:
    """Cells (C, S³) of which a share is occupied."""
    return np.random.default_rng(1).random((cascades_of(bound), side**3)) < share


@pytest.mark.parametrize("bound", [0.6, 1, 1.5, 2, 3, 4, 8, 16, 64])
def test_each_point_has_the_cell_of_its_cascade(bound):
    bits = bits_of(bound, 16, 0.4)
    grids, rng = cells_of_bits(bits.reshape(-1), bound), np.random.default_rng(2)
    sizes = 2.0 ** rng.uniform(-3, np.log2(bound) + 0.1, (4000, 1))
    points = sizes * rng.uniform(-1, 1, (4000, 3))
    held = np.stack([grid.contains(points) for grid in grids])
    np.testing.assert_array_equal(held.any(0), occupied(points, bits, bound))
    assert held.sum(0).max() == 1
    assert all(grid.occupied.size <= 8 * 16**3 * 27 for grid in grids)


@pytest.mark.parametrize("count", [8**3 + 8, 2 * 9**3, 8**3])
def test_bits_that_are_no_cubes_are_refused(count):
    with pytest.raises(FormatError, match="as a bound of 2 asks for"):
        cells_of_bits(np.ones(count, bool), 2.0)
