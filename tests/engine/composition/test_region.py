"""Cutting a region out of a field, and a field that exists only inside one."""

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.region import ClippedField
from fusedrf_cli.engine.kinds.vm.blocks import blocks_of
from fusedrf_cli.engine.kinds.vm.editing import cleared, region_of
from fusedrf_cli.engine.kinds.vm.field import Block, VMField
from fusedrf_cli.engine.rendering.volume import render_rays
from tests.analytic.rays import affine
from tests.engine.conftest import BOX, THIRTY_TWO, Gaussian, chord_of_box, points_in, random_vm, rays_at, unit

HOLE = np.array([-0.2, -0.35, 0.1, 0.5, 0.2, 0.6])


@pytest.fixture(autouse=True)
def coarse_ownership(monkeypatch):
    monkeypatch.setattr("fusedrf_cli.engine.kinds.vm.field.OWNERSHIP_CELLS", 32)


def field_of(cells: int = 9):
    return random_vm(THIRTY_TWO, dtype=torch.float32, cells=cells)


def inside(points, box):
    return ((points >= box[:3]) & (points <= box[3:])).all(1)


def test_a_region_is_whole_cells_around_the_box():
    field = field_of()
    region, cell = region_of(field, HOLE), field.occupancy.cell
    assert (region[:3] <= HOLE[:3]).all() and (region[3:] >= HOLE[3:]).all()
    assert (HOLE[:3] - region[:3] < cell + 1e-9).all() and (region[3:] - HOLE[3:] < cell + 1e-9).all()
    steps = (region - np.tile(BOX[:3], 2)) / np.tile(cell, 2)
    np.testing.assert_allclose(steps, np.rint(steps), atol=1e-9)


def test_a_region_stays_in_the_field():
    np.testing.assert_allclose(region_of(field_of(), BOX * 2), BOX)


@pytest.mark.parametrize("moved", [False, True])
def test_cleared_is_empty_inside_and_bit_equal_outside(moved):
    """Also where the distilled tensor is but the first, moved block of several."""
    field = field_of()
    if moved:
        lone = random_vm(THIRTY_TWO, dtype=torch.float32, cells=5, seed=3)
        field = blocks_of(
            [Placed("a", field, affine(1, (0.3, 0, 0))), Placed("b", lone, affine(0.5, (4, 0, 0)))]
        )
    region = region_of(field, HOLE)
    hollow = cleared(field, HOLE)
    points = np.concatenate([points_in(field.aabb, 20000), points_in(region, 4000)])
    dirs = torch.from_numpy(unit(points_in(BOX, len(points), 8)))
    before, after = (f.query(torch.from_numpy(points), dirs) for f in (field, hollow))
    within = torch.from_numpy(inside(points, region))
    assert before[0][within].any() and not after[0][within].any()
    assert before[0][~within].any()
    assert torch.equal(before[0][~within], after[0][~within])
    seen = ~within & (before[0] > 0)
    assert torch.equal(before[1][seen], after[1][seen])
    assert torch.equal(field.params, hollow.params)


def test_around_a_turned_tensor_all_cells_of_the_box_are_emptied_and_all_of_those_lie_in_the_region():
    alone = field_of()
    turn = affine(1, (0.1, 0.2, 0))
    turn[:3, :3] = Rotation.from_euler("xyz", [0.4, -0.3, 0.7]).as_matrix()
    field = VMField.assembled(alone.shape, alone.tensors, (Block(0, turn, "fused"),), alone.params)
    region, hollow = region_of(field, HOLE), cleared(field, HOLE)
    points = np.concatenate([points_in(field.aabb, 20000), points_in(HOLE, 4000)])
    dirs = torch.from_numpy(unit(points_in(BOX, len(points), 8)))
    before, after = (f.query(torch.from_numpy(points), dirs)[0].numpy() for f in (field, hollow))
    within = inside(points, HOLE)
    assert before[within].any() and not after[within].any()
    changed = before != after
    assert changed.any() and inside(points[changed], region).all()


def test_a_field_that_was_cleared_is_the_only_one_changed():
    field = field_of()
    occupied = field.occupancy.occupied.copy()
    cleared(field, HOLE)
    assert np.array_equal(field.occupancy.occupied, occupied)


def test_a_clipped_field_is_empty_outside_its_box():
    fog = Gaussian(width=0.5)
    clipped = ClippedField(fog, HOLE)
    points = points_in(BOX, 4000)
    dirs = torch.from_numpy(unit(points_in(BOX, 4000, 8)))
    sigma, rgb = clipped.query(torch.from_numpy(points), dirs)
    wanted, colour = fog.query(torch.from_numpy(points), dirs)
    within = torch.from_numpy(inside(points, HOLE))
    assert within.any() and torch.equal(sigma[within], wanted[within]) and not sigma[~within].any()
    assert torch.equal(rgb[within], colour[within])
    assert np.array_equal(clipped.aabb, HOLE) and clipped.voxel_size == fog.voxel_size


def test_a_clipped_field_renders_only_its_box():
    """Rays that miss the box see nothing; the others see something."""
    clipped = ClippedField(Gaussian(width=0.5), HOLE)
    rays_o, rays_d = rays_at(BOX, 200)
    chord = chord_of_box(HOLE[:3], HOLE[3:], rays_o, rays_d)
    opacity = render_rays(clipped, rays_o, rays_d)[:, 3]
    assert (opacity[chord == 0] == 0).all() and (opacity[chord > 0.1] > 0.01).all()
    assert (chord == 0).sum() > 20 and (chord > 0.1).sum() > 20


def test_a_clipped_field_forgets_no_occupied_cell():
    field = field_of()
    clipped = ClippedField(field, HOLE)
    points = points_in(HOLE, 5000)
    sigma, _ = field.query(torch.from_numpy(points), torch.from_numpy(unit(points_in(BOX, 5000))))
    held = clipped.occupancy.contains(points)
    assert held[sigma.numpy() > 0].all() and (sigma > 0).any()
