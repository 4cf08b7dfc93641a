"""The insides of cells: their bits against plain arrays of parts, and pictures with them against those
without."""

from copy import copy

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.distillation.matter import occupancy_of
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.fields.insides import SIDE, WORTH_TELLING, with_insides
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels.parts import bit_of
from fusedrf_cli.engine.kernels.plain import mark_parts
from fusedrf_cli.engine.kinds.vm.blocks import blocks_of
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.kinds.vm.insides import with_known_insides
from fusedrf_cli.engine.rendering.cameras import framing_camera
from fusedrf_cli.engine.rendering.volume import render_image, render_rays
from fusedrf_cli.engine.spaces import unbounded
from tests.engine.conftest import BOX, THIRTY_TWO, points_in, rays_at
from tests.engine.kernels.test_cpu import march, stepping

ORDER = np.array(sorted(np.ndindex(4, 4, 4), key=lambda part: bit_of.py_func(*part)))
"""(64, 3) the part that each bit stands for."""
TURNED = np.array([[0.4, -0.3, 0, 0], [0.3, 0.4, 0, 0], [0, 0, 0.5, 0], [0, 0, 0, 1.0]])


def parts_of(bits: np.ndarray) -> np.ndarray:
    """(4 X, 4 Y, 4 Z) bool of bits (X, Y, Z)."""
    found = np.zeros(np.array(bits.shape) * SIDE, bool)
    for bit, (i, j, m) in enumerate(ORDER):
        found[i::SIDE, j::SIDE, m::SIDE] = bits >> np.uint64(bit) & np.uint64(1) != 0
    return found


def random_bits(rng, shape, share: float) -> np.ndarray:
    parts = rng.random((*shape, 64)) < share
    return (parts * (np.uint64(1) << np.arange(64, dtype=np.uint64))).sum(-1, dtype=np.uint64)


@pytest.mark.parametrize("seed", range(10))
def test_march_visits_the_lattice_samples_in_matter(seed):
    rng = np.random.default_rng(seed)
    shape = rng.integers(2, 8, 3)
    lo, cell = rng.choice([-1, 0, 0.1, -0.7], 3), rng.choice([0.1, 1 / 3, 0.25])
    bits = random_bits(rng, shape, 0.1) * (rng.random(shape) < 0.3)
    grid = OccupancyGrid(np.concatenate([lo, lo + shape * cell]), bits != 0)
    rays_o, rays_d = rays_at(grid.aabb, 30, seed)
    rays_o[:8] = points_in(grid.aabb, 8, seed)
    step, parts = 0.11 * cell, parts_of(bits)
    some = march(with_insides(grid, bits), rays_o, rays_d, step)
    for o, d, found, ts in zip(
        rays_o, rays_d, some, march(stepping(grid.arrays, 0), rays_o, rays_d, step), strict=True
    ):
        at = (o + ts[:, None] * d - grid.aabb[:3]) / cell * SIDE
        index = np.clip(at.astype(int), 0, np.array(parts.shape) - 1)
        assert np.array_equal(found, ts[parts[tuple(index.T)]])


@pytest.mark.parametrize("seed", range(10))
def test_strided_samples_in_matter_end_where_those_in_full_cells_do(seed):
    rng = np.random.default_rng(seed)
    shape, cell = (6, 5, 7), 0.25
    aabb = np.concatenate([np.zeros(3), np.array(shape) * cell])
    occupied, stride = rng.random(shape) < 0.6, rng.choice([8, 20], shape).astype(np.uint16)
    grid = OccupancyGrid(aabb, occupied, stride=stride, unit=0.01 / 8)
    bits = np.where(occupied, random_bits(rng, shape, 0.3), 0).astype(np.uint64)
    rays_o, rays_d = rays_at(grid.aabb, 30, seed)
    known = with_insides(grid, bits)._replace(skip=grid.skip)
    full = with_insides(grid, np.where(occupied, ~np.uint64(0), np.uint64(0)))
    some, every = (march(arrays, rays_o, rays_d, grid.unit) for arrays in (known, full))
    assert sum(map(len, some)) < 0.6 * sum(map(len, every))
    same = [np.isin(found, wanted) for found, wanted in zip(some, every, strict=True)]
    assert np.concatenate(same).mean() > 0.5  # but the first ones in matter, which end where those do


@pytest.mark.parametrize("seed", range(5))
def test_marked_parts_are_those_that_boxes_around_cells_reach(seed):
    """In a slow loop; and whatever place there is in an occupied cell, its part is one of them."""
    rng = np.random.default_rng(seed)
    occupied, found = rng.random((3, 4, 5)) < 0.2, np.zeros((6, 5, 4), np.uint64)
    middles = np.concatenate([rng.normal(size=(3, 3)), rng.uniform(8, 12, (3, 1))], 1)
    reach = abs(middles[:, :3]).sum(1) / 2
    mark_parts(occupied, middles, reach, found)
    wanted, most = np.zeros(np.array(found.shape) * SIDE, bool), np.array(found.shape) * SIDE - 1
    for cell in np.argwhere(occupied):
        at = middles[:, :3] @ (cell + 0.5) + middles[:, 3]
        low, high = (np.clip(np.floor(at + sign * reach).astype(int), 0, most) for sign in (-1, 1))
        wanted[tuple(slice(a, b + 1) for a, b in zip(low, high, strict=True))] = True
        places = (cell + rng.random((100, 3))) @ middles[:, :3].T + middles[:, 3]
        assert wanted[tuple(np.clip(np.floor(places).astype(int), 0, most).T)].all()
    assert np.array_equal(parts_of(found), wanted)


def ball(cells: int = 24):
    """A ball of matter in a box of 49 texels an axis, under a grid that is occupied around it."""
    field = VMField.create(BOX, (49,) * 3, THIRTY_TWO, torch.Generator().manual_seed(0))
    sections = field.sections(0)
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


def shown(field, camera) -> np.ndarray:
    return render_image(field, camera).over((1.0, 1.0, 1.0))


def decibels(one: np.ndarray, other: np.ndarray) -> float:
    return -10 * np.log10(np.square(one - other).mean() + 1e-20)


def of_two_boxes(cells: int):
    """Two balls under grids that are occupied around them alone, the smaller one turned, far apart."""
    field = ball(cells)
    return blocks_of([Placed("one", field, shift(-6.0)), Placed("other", field, shift(6.0) @ TURNED)])


def test_pictures_stay_and_take_fewer_samples():
    """To the bit, where every sample stands for one step: what is left out is empty."""
    scene = of_two_boxes(24)
    known = with_known_insides(scene)
    assert parts_of(known.grid.inner).mean() < 0.7 * scene.occupancy.occupied.mean()
    rays_o, rays_d = rays_at(scene.occupancy.tight_aabb(), 400, 1)
    step = scene.occupancy.unit or sampling_step(scene)
    plain = render_rays(without_strides(scene), rays_o, rays_d, step=step)
    assert plain[:, 3].max() > 0.5
    assert np.array_equal(render_rays(without_strides(known), rays_o, rays_d, step=step), plain)
    camera = framing_camera(scene.occupancy.tight_aabb(), 0.9, 0.45, 60, 60)
    assert decibels(shown(known, camera), shown(scene, camera)) > 65


def without_strides(field: VMField) -> VMField:
    """A field under its grid, each of whose samples stands for one step."""
    other = copy(field)
    other.__dict__["grid"] = stepping(field.grid, 0)
    return other


def shift(x: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def test_what_stands_in_a_place_is_told_apart_from_it():
    """Where pictures are large enough to be worth it, and there are several blocks."""
    place = VMField.create(unbounded.WHOLE, (200,) * 3, THIRTY_TWO, torch.Generator().manual_seed(0))
    place = place.with_occupancy(OccupancyGrid.full(unbounded.WHOLE, 16, unbounded))
    small = np.diag([0.2, 0.2, 0.2, 1.0])
    scene = blocks_of([Placed("place", place, np.eye(4)), Placed("thing", ball(), small)])
    assert scene.for_pictures(WORTH_TELLING - 1) is scene
    known = scene.for_pictures(WORTH_TELLING)
    assert known.grid.inner.any() and known.grid.coarse.any()
    camera = framing_camera(np.array([-0.5, -0.5, -0.5, 0.5, 0.5, 0.5]), 0.9, 0.45, 40, 40)
    assert decibels(shown(known, camera), shown(scene, camera)) > 50
    for field in (place, ball()):
        assert field.for_pictures(WORTH_TELLING) is field
