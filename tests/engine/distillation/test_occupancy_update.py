"""Haze that is left out of a field's cells: what goes is thin wherever it is looked for, what rays show stays
the same, and fog that they show stays."""

import numpy as np
import torch

from fusedrf_cli.engine.distillation.occupancy_update import (
    OccupancyUpdateConfig,
    occupancy_of,
    prune_low_density,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.volume import render_rays
from tests.engine.conftest import BOX, THIRTY_TWO, rays_at


def ball(cells: int = 24):
    """A ball of matter in a box of 49 texels an axis, under a grid that is occupied around it."""
    field = VMField.create(THIRTY_TWO, BOX, (49,) * 3, torch.Generator().manual_seed(0))
    sections = field.sections()
    for name in sections:
        if name.startswith("density"):
            sections[name].zero_()
    at = torch.linspace(-1, 1, 49)
    square = (at[:, None] ** 2 + at**2).float()
    sections["density_plane_0"][..., 0] = 30 - 80 * square
    sections["density_line_0"][:, 0] = 1
    sections["density_plane_0"][..., 1] = 1
    sections["density_line_0"][:, 1] = -80 * at**2
    return field.with_occupancy(occupancy_of(field, BOX, cells))


def fog(depth: float):
    """Fog of an optical depth across each of 32 x 32 x 32 cells, all occupied."""
    field = ball().with_occupancy(OccupancyGrid.full(BOX, 32))
    sigma = depth / field.occupancy.cell.min()
    sections = field.sections()
    sections["density_plane_0"].zero_()
    sections["density_plane_0"][..., 0] = float(np.log(np.expm1(sigma / field.scale))) - field.shift
    return field


def deepest(field, cells: np.ndarray) -> np.ndarray:
    """(N,) the optical depth across each of cells (N, 3) at the densest of 500 random points of it."""
    grid, points = field.occupancy, np.random.default_rng(1).random((500, 3))
    return field.peaks(grid.aabb[:3], grid.cell, cells, points) * grid.cell.min()


def test_the_room_around_matter_goes_and_rays_show_the_same():
    field = ball()
    rays = rays_at(BOX, 3000, 3)
    kept = prune_low_density(field, *rays)
    gone = field.occupancy.occupied & ~kept.occupied
    assert 0.1 < gone.sum() / field.occupancy.occupied.sum() < 0.9
    assert (
        deepest(field, np.argwhere(gone)).max() < 4 * OccupancyUpdateConfig.empty_below
    )  # between probes it grows steeply
    assert deepest(field, np.argwhere(kept.occupied)).min() > OccupancyUpdateConfig.empty_below
    apart = render_rays(field.with_occupancy(kept), *rays) - render_rays(field, *rays)
    assert np.square(apart[:, :4]).mean() < OccupancyUpdateConfig.same


def test_fog_that_rays_show_stays():
    """0.008 across each of 32 cells is a quarter of what a ray shows; a thousandth of that is nothing."""
    field, rays = fog(0.8 * OccupancyUpdateConfig.empty_below), rays_at(BOX, 3000, 5)
    seen = render_rays(field, *rays)[:, 3].max()
    assert (
        deepest(field, np.argwhere(field.occupancy.occupied)).max() < OccupancyUpdateConfig.empty_below
        and seen > 0.15
    )
    assert prune_low_density(field, *rays).occupied.all()


def test_thick_haze_goes_where_rays_should_not_show_it_and_stays_where_they_should():
    """Fog of 0.03 across each cell, three times what counts as empty, beside matter a hundred times as
    dense: as what a student failed to learn, and as what its teacher shows."""
    field, dense = fog(3 * OccupancyUpdateConfig.empty_below), fog(300 * OccupancyUpdateConfig.empty_below)
    plane, solid = (f.sections()["density_plane_0"] for f in (field, dense))
    plane[: len(plane) // 2] = solid[: len(plane) // 2]
    rays, grid = rays_at(BOX, 3000, 7), field.occupancy
    matter = grid.marked(deepest(field, np.argwhere(grid.occupied)).reshape(grid.occupied.shape) > 1)
    shown, alone = (render_rays(f, *rays)[:, :4] for f in (field, field.with_occupancy(matter)))
    assert 0.4 < matter.occupied.mean() < 0.6 and np.square(shown - alone).mean() > 1e-3
    assert prune_low_density(field, *rays).occupied.all()
    assert prune_low_density(field, *rays, truth=shown).occupied.all()
    kept = prune_low_density(field, *rays, truth=alone)
    assert 0.4 < kept.occupied.mean() < 0.6
    found = render_rays(field.with_occupancy(kept), *rays)[:, :4]
    assert np.square(found - alone).mean() < 1e-4


def test_where_all_is_haze_nothing_goes():
    field, rays = fog(1e-6), rays_at(BOX, 300, 5)
    assert prune_low_density(field, *rays).occupied.all()
