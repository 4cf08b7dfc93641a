"""What a fused field says of its objects: voxels, the price of a stretch, and what a crowded cell hides."""

import numpy as np
import pytest

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.detail import details_at_voxel, opacity_off
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig
from fusedrf_cli.engine.kinds.vm.blocks import blocks_of
from fusedrf_cli.engine.kinds.vm.details import block_details, lost_shares
from tests.analytic.export import vm_field
from tests.analytic.fields import Box, Tint
from tests.analytic.rays import affine

BLOCK = vm_field(Box(40.0, 0.5, tint=Tint.of(0.5, 0.2, 0.1)))


@pytest.mark.parametrize("condition", [1.1, 2.0, 4.0, 9.0])
def test_what_a_stretch_costs_is_the_largest_gap_of_two_exponentials(condition):
    """Between the extremes of density: sup over τ of exp(-τ) - exp(-κτ)."""
    tau = np.linspace(0, 20, 200_001)
    gap = (np.exp(-tau) - np.exp(-tau * condition)).max()
    assert opacity_off(condition) == pytest.approx(gap, rel=1e-6)
    assert opacity_off(1.0) == 0


def test_voxels_across_are_of_the_fused_field(in_force):
    in_force(OccupancyConfig(scene_cells=24))
    placed = [Placed("big", BLOCK, np.eye(4)), Placed("flat", BLOCK, affine((0.2, 0.2, 0.1), (2, 0, 0)))]
    big, flat = details_at_voxel(placed, 0.25)
    assert (big.voxels_across, flat.voxels_across) == (pytest.approx(4), pytest.approx(0.8))
    assert flat.stretch == pytest.approx(2) and flat.opacity_off > 0.1
    big, flat = block_details(placed, blocks_of(placed))
    assert big.voxels_across == pytest.approx(15) and flat.voxels_across == pytest.approx(30)
    assert big.held_voxel == pytest.approx(big.own_voxel) and flat.opacity_off == 0


def test_the_third_of_three_in_a_cell_is_lost_and_told(in_force):
    """Three slivers side by side in one cell of a grid over a wide scene."""
    in_force(OccupancyConfig(scene_cells=8))
    spots = ((0.0, 0, 0), (0.03, 0, 0), (0.06, 0, 0), (9.0, 9, 0))
    placed = [Placed(f"n{i}", BLOCK, affine(0.02, at)) for i, at in enumerate(spots)]
    shares = lost_shares(blocks_of(placed))
    assert sorted(shares[:3])[-1] == 1 and sorted(shares[:3])[:2] == [0, 0] and shares[3] == 0
