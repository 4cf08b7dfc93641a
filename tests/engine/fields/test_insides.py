"""The insides of cells: their bits against plain arrays of parts, and pictures with them against those
without."""

import numpy as np
import pytest
import torch
from scipy.ndimage import binary_dilation

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields.insides import (
    FULL,
    SIDE,
    WORTH_LOOKING,
    grown,
    insides_of,
    places,
    with_insides,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels.plain import mark_parts
from fusedrf_cli.engine.kinds.vm.blocks import blocks_of
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.kinds.vm.insides import looked_into
from fusedrf_cli.engine.rendering.cameras import framing_camera
from fusedrf_cli.engine.rendering.volume import render_image
from fusedrf_cli.engine.spaces import unbounded
from tests.engine.conftest import BOX, THIRTY_TWO, points_in, rays_at
from tests.engine.kernels.test_cpu import march, stepping

ORDER = (SIDE * places(1)).astype(int)  # (64, 3) of the part that each bit stands for


def parts_of(bits: np.ndarray) -> np.ndarray:
    """(4 X, 4 Y, 4 Z) bool of bits (X, Y, Z)."""
    found = np.zeros(np.array(bits.shape) * SIDE, bool)
    for bit, (i, j, m) in enumerate(ORDER):
        found[i::SIDE, j::SIDE, m::SIDE] = bits >> np.uint64(bit) & np.uint64(1) != 0
    return found


def random_bits(rng, shape, share: float) -> np.ndarray:
    parts = rng.random((*shape, 64)) < share
    return (parts * (np.uint64(1) << np.arange(64, dtype=np.uint64))).sum(-1, dtype=np.uint64)


@pytest.mark.parametrize("seed", range(5))
def test_bits_grow_as_parts_do(seed):
    """Along one axis after the other, so that diagonals are reached, where cells are occupied."""
    rng = np.random.default_rng(seed)
    shape = tuple(rng.integers(1, 6, 3))
    bits, occupied = random_bits(rng, shape, 0.02), rng.random(shape) < 0.8
    found = grown(OccupancyGrid(BOX, occupied), np.argwhere(bits >= 0), bits.ravel())
    wide = np.repeat(np.repeat(np.repeat(occupied, SIDE, 0), SIDE, 1), SIDE, 2)
    assert np.array_equal(parts_of(found), binary_dilation(parts_of(bits), np.ones((3, 3, 3))) & wide)


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
    full = with_insides(grid, np.where(occupied, FULL, 0).astype(np.uint64))
    some, every = (march(arrays, rays_o, rays_d, grid.unit) for arrays in (known, full))
    assert sum(map(len, some)) < 0.6 * sum(map(len, every))
    same = [np.isin(found, wanted) for found, wanted in zip(some, every, strict=True)]
    assert np.concatenate(same).mean() > 0.5  # but the first ones in matter, which end where those do


@pytest.mark.parametrize("level", [0, 1, 2])
def test_marked_parts_are_those_that_placed_ones_reach(level):
    """Corners of the parts, eighths or cells that hold matter, one by one."""
    rng = np.random.default_rng(level)
    bits, found = random_bits(rng, (3, 4, 5), 0.05), np.zeros((6, 5, 4), np.uint64)
    bits[1, 2, 3] = ~np.uint64(0)
    to_parts = np.concatenate([rng.normal(size=(3, 3)), rng.uniform(8, 12, (3, 1))], 1)
    corners = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0], [0.0, 1.0], indexing="ij"), -1).reshape(-1, 3)
    n = 2**level
    whole = np.argwhere(np.ones((n + 1,) * 3)) / n  # the same places
    mark_parts(bits, level, to_parts, corners, whole, found)
    shape = (3, n, SIDE // n, 4, n, SIDE // n, 5, n, SIDE // n)
    held = parts_of(bits).reshape(shape).any((2, 5, 8)).reshape(3 * n, 4 * n, 5 * n)
    at = (np.argwhere(held)[:, None] + corners).reshape(-1, 3) / n
    index = np.floor(at @ to_parts[:, :3].T + to_parts[:, 3]).astype(int)
    wanted = np.zeros(np.array(found.shape) * SIDE, bool)
    wanted[tuple(np.clip(index, 0, np.array(wanted.shape) - 1).T)] = True
    assert np.array_equal(parts_of(found), wanted)


def ball(cells: int = 24):
    """A ball of matter in a box of 49 texels an axis, under a grid that is occupied all over."""
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
    return field.with_occupancy(OccupancyGrid.full(BOX, cells))


def shown(field, camera) -> np.ndarray:
    return render_image(field, camera).over((1.0, 1.0, 1.0))


def decibels(one: np.ndarray, other: np.ndarray) -> float:
    return -10 * np.log10(np.square(one - other).mean() + 1e-20)


def test_pictures_stay_and_take_fewer_samples():
    field = ball()
    assert 0.02 < parts_of(insides_of(field)).mean() < 0.25  # a ball of radius 0.6 in a box of 2: 0.11
    scale = np.diag([0.4, 0.3, 0.5, 1.0])
    placed = [Placed(str(i), field, shift(x) @ scale) for i, x in enumerate([-0.5, 0.3, 0.6])]
    scene = blocks_of(placed)
    camera = framing_camera(scene.occupancy.tight_aabb(), 0.9, 0.45, 60, 60)
    plain = shown(scene, camera)
    assert decibels(shown(looked_into(scene), camera), plain) > 60 and plain.min() < 0.9
    assert parts_of(looked_into(scene).grid.inner).mean() < 0.5 * scene.occupancy.occupied.mean()


def shift(x: float) -> np.ndarray:
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def test_what_stands_in_a_place_is_looked_into_where_many_rays_are_shown():
    place = VMField.create(unbounded.WHOLE, (12,) * 3, THIRTY_TWO, torch.Generator().manual_seed(0))
    place = place.with_occupancy(OccupancyGrid.full(unbounded.WHOLE, 16, unbounded))
    small = np.diag([0.2, 0.2, 0.2, 1.0])
    scene = blocks_of([Placed("place", place, np.eye(4)), Placed("thing", ball(), small)])
    assert scene.for_pictures(WORTH_LOOKING - 1) is scene
    assert scene.for_pictures(WORTH_LOOKING).grid.inner.any()
    in_a_box = blocks_of([Placed("one", ball(), small), Placed("other", ball(), shift(1.0))])
    for field in (place, ball(), in_a_box):
        assert field.for_pictures(WORTH_LOOKING) is field


def test_places_lie_in_their_parts():
    for per in (1, 2, 3):
        found = places(per).reshape(64, per**3, 3)
        assert np.array_equal(np.floor(SIDE * found), np.broadcast_to(ORDER[:, None], found.shape))
        assert len(np.unique(np.round(found.reshape(-1, 3), 6), axis=0)) == 64 * per**3


def test_of_fog_nothing_is_left_out():
    """Fog of which no part holds much, but a line of cells does."""
    field = ball()
    sections = field.sections(0)
    sections["density_plane_0"][..., 0] = 0
    sections["density_line_0"][:, 1] = 10 + np.log(5e-2 / (2 * field.tensors[0].scale))
    bits = insides_of(field)
    assert bits is None or parts_of(bits).all()
    camera = framing_camera(BOX, 0.9, 0.45, 20, 20)
    scene = blocks_of([Placed("one", field, shift(-1.0)), Placed("other", field, shift(1.0))])
    assert np.array_equal(shown(looked_into(scene), camera), shown(scene, camera))
