"""Occupancy grids: the skip distance against a search of all cells, boxes, growth, and grids placed in
another."""

import time
from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.fields import occupancy
from fusedrf_cli.engine.fields.occupancy import (
    OccupancyGrid,
    cell_counts,
    harmless_depth,
    mapped,
    marked_cells,
    overlapped,
    placed_cells,
    transformed_aabb,
)
from fusedrf_cli.engine.fields.step_size_grid import StepSizeGrid
from fusedrf_cli.engine.spaces import contracted_linf, unbounded
from tests.engine.conftest import BOX, points_in

UNIT = np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize("shape", [(1, 1, 1), (1, 9, 2), (6, 5, 7)])
@pytest.mark.parametrize("share", [0.02, 0.3])
def test_skip_is_the_chebyshev_distance(shape, share):
    occupied = np.random.default_rng(1).random(shape) < share
    occupied[0, 0, 0] = True
    cells, matter = np.argwhere(np.ones(shape)), np.argwhere(occupied)
    wanted = np.abs(cells[:, None] - matter).max(2).min(1).reshape(shape)
    grid = OccupancyGrid(BOX, occupied)
    assert grid.skip.dtype == np.uint8 and np.array_equal(grid.skip, wanted)


def test_skip_of_empty_full_and_long_grids():
    assert (OccupancyGrid(BOX, np.zeros((2, 3, 4), bool)).skip == 255).all()
    assert (OccupancyGrid(BOX, np.ones((2, 3, 4), bool)).skip == 0).all()
    long = np.zeros((600, 1, 1), bool)
    long[0] = True
    assert np.array_equal(OccupancyGrid(BOX, long).skip[:, 0, 0], np.minimum(np.arange(600), 255))


def test_cell_counts_are_near_cubic():
    assert cell_counts([0, 0, 0, 1, 2, 4], 8) == (2, 4, 8)
    assert cell_counts([0, 0, 0, 1e-6, 1, 1], 16) == (1, 16, 16)
    assert cell_counts([-1, -1, -1, 1, 1, 1], 3) == (3, 3, 3)


def test_tight_box():
    occupied = np.zeros((4, 4, 4), bool)
    occupied[1, 2, 3] = True
    grid = OccupancyGrid(UNIT, occupied)
    np.testing.assert_allclose(grid.tight_aabb(0), [0.25, 0.5, 0.75, 0.5, 0.75, 1])
    np.testing.assert_allclose(grid.tight_aabb(1), [0, 0.25, 0.5, 0.75, 1, 1])
    assert np.array_equal(OccupancyGrid(UNIT, np.zeros((2, 2, 2), bool)).tight_aabb(), UNIT)


def test_dilation_reaches_diagonals():
    occupied = np.zeros((5, 5, 5), bool)
    occupied[2, 2, 2] = True
    grid = OccupancyGrid(UNIT, occupied)
    assert grid.dilated().occupied.sum() == 27 and grid.dilated(2).occupied.all()


def test_contains_is_half_open_and_skip_zero():
    grid = OccupancyGrid(BOX, np.random.default_rng(2).random((4, 3, 5)) < 0.5)
    points = points_in(BOX, 500, margin=0.3)
    index = np.floor((points - BOX[:3]) / grid.cell).astype(int)
    wanted = [
        all(0 <= i < n for i, n in zip(at, (4, 3, 5), strict=True)) and bool(grid.skip[tuple(at)] == 0)
        for at in index
    ]
    assert np.array_equal(grid.contains(points), wanted)
    full = OccupancyGrid.full(UNIT, 4)
    assert full.contains(np.array([[0.0, 0, 0], [1, 0.5, 0.5], [0.5, 1, 0.5]])).tolist() == [
        True,
        False,
        False,
    ]
    assert full.contains(np.zeros((0, 3))).shape == (0,)


def test_centres_are_contained():
    grid = OccupancyGrid(BOX, np.random.default_rng(3).random((4, 3, 5)) < 0.4)
    centres = grid.centres()
    assert len(centres) == grid.occupied.sum() and grid.contains(centres).all()
    assert not OccupancyGrid(BOX, ~grid.occupied).contains(centres).any()


@pytest.mark.parametrize("scale", [0.05, 1.0, 6.0])
def test_placed_grids_cover_their_matter(scale):
    """Every point of a placed occupied cell lies in a marked cell, however small, turned or sheared it is."""
    rng = np.random.default_rng(4)
    one, two = (OccupancyGrid(BOX, rng.random((5, 6, 4)) < 0.1) for _ in range(2))
    matrix = np.array([[0.6, -0.8, 0, 3], [0.8, 0.6, 0.4, 0], [0, 0, -1, 0.5], [0, 0, 0, 1]])
    matrix[:3, :3] *= scale
    placed = [(one, np.eye(4)), (two, matrix)]
    boxes = np.stack([transformed_aabb(grid.tight_aabb(0), placing) for grid, placing in placed])
    aabb, marks = placed_cells(boxes, placed, 40)
    marks = list(marks)
    for own, mark, placing in ((one, marks[0], np.eye(4)), (two, marks[1], matrix)):
        points = points_in(BOX, 5000)
        points = points[own.contains(points)] @ placing[:3, :3].T + placing[:3, 3]
        assert len(points) > 100 and OccupancyGrid(aabb, mark).contains(points).all()
    assert (marks[0] | marks[1]).mean() < 0.8


def test_one_large_cell_reaches_what_many_small_ones_do():
    """And in no more time than a pack may take to be read, though it is sampled two million times."""
    box, matrix = np.array([0.0, 0, 0, 1, 1, 1]), np.eye(4)
    matrix[:3, 3] = 0.25
    wide = np.array([0.0, 0, 0, 1.5, 1.5, 1.5])
    began = time.process_time()
    one, many = (marked_cells(OccupancyGrid.full(box, cells), matrix, wide, 160) for cells in (1, 16))
    assert time.process_time() - began < 20
    np.testing.assert_array_equal(one, many)


def test_what_is_left_out_adds_up_to_little_along_every_line():
    """Fog of 1e-3 per cell along 40 cells is 0.04 in all, so it stays; noise of 1e-5 goes; so does a lone
    cell under the limit."""
    depth = np.zeros((40, 5, 5))
    depth[:, 2, 2] = 1e-3
    depth[:, 0, 0] = 1e-5
    assert 1e-5 <= harmless_depth(depth, 0.01, 5e-3) < 1e-3
    depth[:, 2, 2] = 0
    depth[3, 3, 3] = 4e-3
    assert harmless_depth(depth, 0.01, 5e-3) == 0.01
    assert harmless_depth(np.full((400, 1, 1), 1e-3), 0.01, 0.0) < 1e-3


@pytest.mark.parametrize("longest", [3, 7, 10])
def test_cells_of_another_size_that_share_a_volume(longest):
    """Against every pair of cells, in whole numbers."""
    occupied = np.random.default_rng(4).random((7, 7, 7)) < 0.1
    wanted = np.zeros((longest,) * 3, bool)
    for cell in np.argwhere(occupied):
        low, high = cell * longest, (cell + 1) * longest  # in 1 / (7 longest) of the box
        for index in np.ndindex(wanted.shape):
            wanted[index] |= ((low < 7 * np.add(index, 1)) & (7 * np.array(index) < high)).all()
    assert np.array_equal(overlapped(OccupancyGrid(unbounded.WHOLE, occupied, unbounded), longest), wanted)
    # a part of space that is cut out on faces of cells shares what its cells share
    box = np.array([-2, -2 + 4 / 7, -2, 2 - 8 / 7, 2, 2])
    part = OccupancyGrid(unbounded.WHOLE, occupied, unbounded).within(box)
    kept = np.zeros_like(occupied)
    kept[:5, 1:, :] = occupied[:5, 1:, :]
    again = overlapped(OccupancyGrid(unbounded.WHOLE, kept, unbounded), longest)
    assert np.array_equal(part.occupied, kept[:5, 1:, :])
    assert np.array_equal(overlapped(part, longest), again)


def test_steps_in_a_place_are_parts_of_its_own():
    """Cells of a finer field and of the place: the place is sampled at its own step, what is finer at no more
    than its own, and at least an eighth less."""
    grid = OccupancyGrid.full(BOX, 8, unbounded)
    fine = np.zeros(grid.occupied.shape, bool)
    fine[:4] = True
    for ratio in (1.0, 1.4, 3.3, 20.0):
        pace = StepSizeGrid(grid)
        steps = 0.15 / ratio, 0.15
        assert len(list(pace.kept([fine, ~fine], [(grid, np.eye(4))] * 2, steps))) == 2
        found = pace.grid(fine | ~fine)
        if ratio == 1:
            assert found.stride is None
            continue
        spacing = found.stride * found.unit
        assert spacing[~fine] == pytest.approx(steps[1])
        assert (spacing[fine] <= steps[0] + 1e-6).all()
        assert (spacing[fine] > steps[0] * 7 / 8).all()


@pytest.mark.parametrize("scale", [0.3, 30.0])
def test_cells_that_a_placed_grid_reaches_are_found_from_either_side(monkeypatch, scale):
    """By its points, and, where these are too many, by the corners of the cells: none is missed."""
    rng = np.random.default_rng(5)
    grid = OccupancyGrid(BOX, rng.random((3, 4, 2)) < 0.4)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * np.linalg.qr(rng.normal(size=(3, 3)))[0]
    matrix[:3, 3] = 0.7 * scale
    inside = (
        grid.centres().repeat(4000, 0) + rng.uniform(-0.5, 0.5, (4000 * grid.occupied.sum(), 3)) * grid.cell
    )
    there = mapped(inside @ matrix[:3, :3].T + matrix[:3, 3], unbounded)
    for most in (occupancy.MOST_POINTS, 0):
        monkeypatch.setattr(occupancy, "MOST_POINTS", most)
        found = OccupancyGrid(
            unbounded.WHOLE, marked_cells(grid, matrix, unbounded.WHOLE, 16, unbounded), unbounded
        )
        assert found.contains(there).all() and not found.occupied.all()


@pytest.mark.parametrize("space", [unbounded, contracted_linf])
def test_far_away_a_place_beside_the_middle_is_as_fine_as_one_in_it(space):
    """There both spaces are drawn together alike, but for the distance of their middles: a cell in which n
    goes from 13 to 1,000 is not as fine as what a bounded field of the same step needs in it."""
    whole = OccupancyGrid.full(unbounded.WHOLE, 27, unbounded)
    pace, aside = StepSizeGrid(whole), np.eye(4)
    aside[0, 3] = 3
    needed = pace.needed(whole.occupied, OccupancyGrid.full(unbounded.WHOLE, 1, space), aside, 0.05)
    n = unbounded.inv_contract(torch.from_numpy(whole.centres())).abs().max(1)[0].numpy()
    assert (needed[n > 20] > 0.05 * (1 - 4 / 20) ** 2).all() and needed.min() < 0.05 / 9
    solid = pace.needed(whole.occupied, OccupancyGrid.full(BOX), aside, 0.05)
    assert solid[n > 20].max() < 0.05 / 20**2


def test_samples_of_a_place_are_counted_by_its_regions():
    """Cells close together stand far out on one side alone, so that a ray's other pieces take few samples."""
    grid = OccupancyGrid.full(unbounded.WHOLE, 32, unbounded)
    stride = np.full(grid.occupied.shape, 200, np.uint16)
    fine = replace(grid, stride=stride.copy(), unit=1e-4)
    fine.stride[-1, 8:24, 8:24] = 1
    even = replace(grid, stride=stride, unit=1e-4)
    apart = 2 * np.sqrt(3) / 1e-4  # through the layer, along it
    assert 0.99 * apart <= fine.most_samples(1.0) - even.most_samples(1.0) <= apart
