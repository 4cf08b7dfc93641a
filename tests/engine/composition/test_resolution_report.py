"""What a fused field says of its objects: voxels, and the price of a stretch."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.resolution_report import opacity_off, resolution_at_voxel
from fusedrf_cli.engine.kinds import registry
from tests.analytic.export import vm_field
from tests.analytic.fields import Box, Tint
from tests.analytic.rays import affine
from tests.engine.kinds.sparse_cases import random_sparse

BLOCK = vm_field(Box(40.0, 0.5, tint=Tint.of(0.5, 0.2, 0.1)))


@pytest.mark.parametrize("condition", [1.1, 2.0, 4.0, 9.0])
def test_what_a_stretch_costs_is_the_largest_gap_of_two_exponentials(condition):
    """Between the extremes of density: sup over τ of exp(-τ) - exp(-κτ)."""
    tau = np.linspace(0, 20, 200_001)
    gap = (np.exp(-tau) - np.exp(-tau * condition)).max()
    assert opacity_off(condition) == pytest.approx(gap, rel=1e-6)
    assert opacity_off(1.0) == 0


def test_voxels_across_are_of_the_fused_field():
    placed = [Placed("big", BLOCK, np.eye(4)), Placed("flat", BLOCK, affine((0.2, 0.2, 0.1), (2, 0, 0)))]
    big, flat = resolution_at_voxel(placed, 0.25)
    assert (big.voxels_across, flat.voxels_across) == (pytest.approx(4), pytest.approx(0.8))
    assert flat.stretch == pytest.approx(2) and flat.opacity_off > 0.1
    scene = ComposedField(placed)  # nodes as they are: their own voxels, and no price of a stretch
    big, flat = registry.kind("blocks").resolution_reports(scene, scene)
    assert flat.held_voxel == flat.own_voxel == placed[1].voxel_size and flat.opacity_off == 0
    assert (big.voxels_across, flat.stretch) == (pytest.approx(1 / BLOCK.voxel_size), pytest.approx(2))


def test_objects_in_a_group_are_told_of_one_by_one():
    """They, and not the group, are what a bundle names afterwards."""
    inner = [Placed(name, BLOCK, affine((0.3, 0.2, 0.1), (x, 0, 0))) for name, x in (("a", -1), ("b", 1))]
    group = ComposedField(inner, "add", origin=np.zeros(3))
    scene = ComposedField([Placed("g", BLOCK, np.eye(4)), Placed("both", group, np.eye(4))])
    fields = {"vm": BLOCK, "sparse": random_sparse(0, 0, torch.float32)}
    for kind, field in fields.items():
        reports = registry.kind(kind).resolution_reports(scene, field)
        assert [report.name for report in reports] == ["g", "a", "b"]
        assert reports[1].own_voxel == pytest.approx(0.1 * BLOCK.voxel_size) and reports[1].stretch > 2
