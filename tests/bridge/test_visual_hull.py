"""The visual hull of a ball whose masks are known in closed form."""

from dataclasses import fields, replace

import numpy as np
import pytest

from formats.images import write_png
from formats.views import Capture, View
from fusedrf_cli.bridge.pictures import camera_of
from fusedrf_cli.bridge.scene_bounds import scene_bounds_of
from fusedrf_cli.bridge.visual_hull import VisualHullConfig, projected, tight_grid, visual_hull
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, placed_box
from fusedrf_cli.requests import TrainRequest
from tests.formats.test_captures import looking_at

CENTRE, RADIUS = np.array([0.2, -0.1, 0.3]), 0.5
BOX = np.concatenate([CENTRE - 1, CENTRE + 1])
SIDE = 64
COARSE = VisualHullConfig(coarse=12, fine=24)
BENT = (-0.2, 0.05, 0.0, 0.01, -0.01)
FISHEYE = (0.05, -0.01, 0.0, 0.0)


@pytest.fixture(autouse=True)
def coarse(in_force):
    in_force(COARSE)


def views_of(folder, count=16, distortion=(0.0,) * 5, fisheye=False, aside=0.0) -> list[View]:
    """Cameras at 4 from the ball, in two rings, looking `aside` of its centre; masks keep where a ray meets
    it."""
    made = []
    for i in range(count):
        turn, high = 2 * np.pi * i / count, 2.0 if i % 2 else -1.0
        eye = CENTRE + [np.sqrt(16 - high**2) * np.cos(turn), np.sqrt(16 - high**2) * np.sin(turn), high]
        pose = np.array(looking_at(eye, CENTRE + [0, 0, aside]))
        mask = folder / f"{i}.png"
        one = View(str(i), pose, 130, 120, 31, 33, SIDE, SIDE, distortion, fisheye, mask_path=mask)
        rays_o, rays_d = camera_of(one).rays()
        near = np.linalg.norm(np.cross(CENTRE - rays_o, rays_d), axis=1) < RADIUS
        levels = np.where(near, 255, 0).astype(np.uint8).reshape(SIDE, SIDE, 1)
        write_png(mask, np.repeat(levels, 3, 2))
        made.append(one)
    return made


def away(grid) -> np.ndarray:
    """Distance of every cell's middle from the ball's, in the grid's shape."""
    middles = grid.marked(np.ones(grid.occupied.shape, bool)).centres()
    return np.linalg.norm(middles - CENTRE, axis=1).reshape(grid.occupied.shape)


def holds_the_ball(grid) -> bool:
    """Whether every point of the ball is in an occupied cell."""
    spots = np.random.default_rng(0).normal(size=(5000, 3))
    share = 0.97 * np.cbrt(np.random.default_rng(1).random((5000, 1)))
    return grid.contains(CENTRE + RADIUS * share * spots / np.linalg.norm(spots, axis=1)[:, None]).all()


@pytest.mark.parametrize(
    "lens", [{}, {"distortion": BENT}, {"distortion": FISHEYE, "fisheye": True}, {"aside": 0.6}]
)
def test_the_hull_of_a_ball(tmp_path, lens):
    """It holds the ball, and little else. In the last case every picture cuts the ball off."""
    grid = visual_hull(views_of(tmp_path, **lens), BOX)
    assert holds_the_ball(grid)
    ball = 4 / 3 * np.pi * RADIUS**3
    assert grid.occupied.sum() * grid.cell.prod() < (4 if "aside" in lens else 2) * ball
    if "aside" not in lens:
        assert (away(grid)[grid.occupied] < 1.5 * RADIUS).all()
        assert (np.ptp(grid.aabb.reshape(2, 3), axis=0) < 1.5).all()


def test_pixels_of_a_lens_are_where_its_rays_go(tmp_path):
    """`projected` against the engine's rays, which invert the same lens by Newton steps."""
    for lens in ({"distortion": BENT}, {"distortion": FISHEYE, "fisheye": True}):
        (one, *_) = views_of(tmp_path, 1, **lens)
        rays_o, rays_d = camera_of(one).rays()
        pixels, distance, inside = projected(one, rays_o + 3 * rays_d)
        rows, columns = np.divmod(np.arange(SIDE * SIDE), SIDE)
        np.testing.assert_allclose(pixels, np.stack([columns, rows], 1) + 0.5, atol=1e-6)
        along = 3.0 if one.fisheye else -3 * (rays_d @ one.camera_to_world[:3, 2])
        np.testing.assert_allclose(distance, along)
        assert inside.all() and not projected(one, rays_o - 3 * rays_d)[2].any()


def test_a_wrong_mask_takes_nothing_away(tmp_path):
    views = views_of(tmp_path)
    right = visual_hull(views, BOX)
    write_png(views[3].mask_path, np.full((SIDE, SIDE, 3), 0, np.uint8))  # says nothing
    levels = np.zeros((SIDE, SIDE, 3), np.uint8)
    levels[:4, :4] = 255
    write_png(views[5].mask_path, levels)  # excludes the ball
    wrong = visual_hull(views, BOX)
    volume, before = (grid.occupied.sum() * grid.cell.prod() for grid in (wrong, right))
    assert holds_the_ball(wrong) and volume < 1.5 * before


def test_large_masks_are_looked_at_in_part(tmp_path, in_force):
    """Every third row and column: the hull holds the ball still, and is not much larger."""
    views = views_of(tmp_path)
    whole = visual_hull(views, BOX)
    in_force(replace(COARSE, pixels=SIDE // 3))
    part = visual_hull(views, BOX)
    volume, before = (grid.occupied.sum() * grid.cell.prod() for grid in (part, whole))
    assert holds_the_ball(part) and volume < 1.5 * before


def test_masks_that_agree_on_nothing_keep_all(tmp_path):
    views = [replace(one, mask_path=tmp_path / f"{i}.png") for i, one in enumerate(views_of(tmp_path, 6))]
    for i, one in enumerate(views):
        levels = np.zeros((SIDE, SIDE, 3), np.uint8)
        levels[(0 if i % 2 else 60) :][:4, (0 if i % 3 else 60) :][:, :4] = 255
        write_png(one.mask_path, levels)
    found = visual_hull(views, BOX)
    assert found.occupied.all()
    np.testing.assert_allclose(found.aabb, BOX)


def test_cropping_keeps_the_cells_where_they_are():
    grid = OccupancyGrid.full(BOX, 24)
    grid = grid.marked(away(grid) < RADIUS)
    small = tight_grid(grid)
    assert small.occupied.sum() == grid.occupied.sum() and small.occupied.size < grid.occupied.size / 2
    np.testing.assert_allclose(small.centres(), grid.centres())
    np.testing.assert_allclose(small.cell, grid.cell)


def test_the_hull_of_an_object_far_away_is_that_of_the_same_at_the_origin(tmp_path):
    """Its cells lie in a frame of their own, and in the world where they lay before it was moved."""
    views, unit, at = views_of(tmp_path), 2.0**20, np.array([2.0**42, -(2.0**40), 0.0])
    moved = [replace(view, camera_to_world=view.camera_to_world.copy()) for view in views]
    for view in moved:
        view.camera_to_world[:3, 3] = unit * view.camera_to_world[:3, 3] + at
    words = {field.name: None for field in fields(TrainRequest)}
    found = []
    for chosen, box in ((views, BOX), (moved, unit * BOX + np.tile(at, 2))):
        capture = Capture(tmp_path, "transforms", tuple(chosen), (), box, True, object_aabb=box)
        found.append(scene_bounds_of(TrainRequest(**words), capture, True))
    here, there = found
    assert np.array_equal(here.origin, np.eye(4)) and holds_the_ball(here.cells)
    assert np.array_equal(here.cells.occupied, there.cells.occupied)
    box = placed_box(there.box, there.origin)
    np.testing.assert_allclose((box - np.tile(at, 2)) / unit, here.box, atol=1e-9)
    assert np.abs(there.box).max() < 2
