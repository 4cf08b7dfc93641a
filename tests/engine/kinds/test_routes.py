"""Rays through the blocks that they meet: which those are, against a slow walk, and what is seen by them,
against all blocks together."""

from copy import copy
from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.fields.insides import WORTH_TELLING
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels.loops import Rays
from fusedrf_cli.engine.kernels.routing import NOWHERE, first_two
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.vm import field as vm_field
from fusedrf_cli.engine.kinds.vm.blocks import blocks_of
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.kinds.vm.routes import (
    alone_until,
    by_number,
    met_blocks,
    own_steps,
    show_behind,
    show_second,
    twin,
)
from fusedrf_cli.engine.rendering.cameras import framing_camera, tile_order
from fusedrf_cli.engine.rendering.volume import render_rays, seen_from
from fusedrf_cli.engine.spaces import unbounded
from tests.engine.conftest import THIRTY_TWO, rays_at, unit
from tests.engine.fields.test_insides import TURNED, ball, shift

STRETCHED = np.array([[1.6, 0.2, 0, 0.3], [0, 0.7, 0, 0.1], [0, 0.3, 0.5, -0.2], [0, 0, 0, 1.0]])


def placed_grids(rng) -> tuple[list[np.ndarray], list[OccupancyGrid]]:
    """Three grids of a few occupied cells, and (3, 4) how the frame comes to the unit cube of each."""
    grids, to_unit = [], []
    for _ in range(3):
        shape = rng.integers(1, 7, 3)
        grids.append(OccupancyGrid(np.array([0, 0, 0, 1, 1, 1.0]), rng.random(shape) < 0.3))
        matrix = np.eye(4)
        matrix[:3, :3] += 0.5 * rng.normal(size=(3, 3))
        matrix[:3, 3] = 0.5 + 0.5 * rng.normal(size=3)
        to_unit.append(matrix[:3])
    return to_unit, grids


def inside(matrix: np.ndarray, grid: OccupancyGrid, points: np.ndarray) -> np.ndarray:
    """(N,) bool, which points (N, 3) of the frame lie in an occupied cell."""
    at = points @ matrix[:, :3].T + matrix[:, 3]
    index = np.floor(at * grid.occupied.shape).astype(int)
    held = ((at >= 0) & (at < 1)).all(1)
    held[held] = grid.occupied[tuple(index[held].T)]
    return held


CORNERS = np.stack(np.meshgrid(*[[0, 1]] * 3), -1).reshape(-1, 3)  # of a unit cube


def ball_around(matrix: np.ndarray, bounded: bool = True) -> np.ndarray:
    """(4,) the smallest ball around what a matrix (3, 4) takes to the unit cube."""
    if not bounded:
        return np.array([0, 0, 0, np.inf])
    corners = np.linalg.solve(matrix[:, :3], (CORNERS - matrix[:, 3]).T).T
    middle = corners.mean(0)
    return np.array([*middle, np.linalg.norm(corners - middle, axis=1).max() * (1 + 1e-6)])


def found_by_kernel(
    rays_o, rays_d, to_unit, grids, bounded=(True, True, True), threads: int = 2, everywhere: bool = True
):
    """`first_two` of some placed grids."""
    sizes = np.cumsum([0, *[grid.occupied.size for grid in grids]])
    at = np.array([[start, *grid.occupied.shape] for start, grid in zip(sizes, grids, strict=False)])
    apart = np.concatenate([grid.skip.ravel() for grid in grids])
    first, second = np.empty(len(rays_o), np.int16), np.empty(len(rays_o))
    balls = np.stack([ball_around(*one) for one in zip(to_unit, bounded, strict=False)])
    whole = rays_o, rays_d, np.stack(to_unit), apart, at, balls
    first_two(*whole, everywhere, threads, first, second)
    return first, second


@pytest.mark.parametrize("seed", range(6))
def test_the_first_two_are_those_of_a_slow_walk(seed):
    """Where a grid's matter begins lies in it, and nothing of it before, at a thousand places on the way."""
    rng = np.random.default_rng(seed)
    to_unit, grids = placed_grids(rng)
    rays_o, rays_d = rays_at(np.array([-1, -1, -1, 1, 1, 1.0]), 200, seed)
    rays_d[:3] = np.eye(3)
    ends = np.linspace(0, 8, 1001)
    begins = np.full((len(grids), len(rays_o)), NOWHERE)
    for b, (matrix, grid) in enumerate(zip(to_unit, grids, strict=True)):
        own, nothing = found_by_kernel(rays_o, rays_d, [matrix], [grid], (True,))
        assert (nothing == NOWHERE).all()
        one, begins[b] = found_by_kernel(rays_o, rays_d, [matrix] * 2, [grid] * 2, (False, True))
        assert (one == 0).all() and np.array_equal(begins[b] < NOWHERE, own == 0)
        for o, d, begin in zip(rays_o, rays_d, begins[b], strict=True):
            held = inside(matrix, grid, o + ends[:, None] * d)
            assert not held[ends < begin - 1e-4].any()
            near = o + (begin + np.array([1e-7, 1e-5])[:, None]) * d
            assert begin == NOWHERE or inside(matrix, grid, near).any() or held[ends >= begin][:1].any()
    assert 0.05 < (begins < NOWHERE).mean() < 0.9
    first, second = found_by_kernel(rays_o, rays_d, to_unit, grids)
    inorder = np.sort(begins, axis=0)
    assert np.array_equal(second, inorder[1])
    assert np.array_equal(first, np.where(inorder[0] < NOWHERE, begins.argmin(0), -1))
    far, far_second = found_by_kernel(rays_o - 1e9 * rays_d, rays_d, to_unit, grids)
    assert (far == first).mean() > 0.95 and (far_second[far == first] > 1e9).all()
    for threads in (1, 3, 5):
        again = found_by_kernel(rays_o, rays_d, to_unit, grids, threads=threads)
        assert np.array_equal(again[0], first) and np.array_equal(again[1], second)


@pytest.mark.parametrize("seed", range(3))
def test_a_place_is_met_where_the_core_has_matter_or_ends(seed):
    """By a thousand places on the way, of a grid over all of space."""
    rng = np.random.default_rng(seed)
    matrix = np.hstack([np.eye(3) / 4, np.full((3, 1), 0.5)])
    grid = OccupancyGrid(np.array([0, 0, 0, 1, 1, 1.0]), rng.random((9, 12, 10)) < 0.04)
    rays_o = rng.uniform(-1.2, 1.2, (300, 3))
    rays_d = unit(rng.normal(size=(300, 3)))
    one, begins = found_by_kernel(rays_o, rays_d, [matrix] * 2, [grid] * 2, (False, False), everywhere=False)
    ends = np.linspace(0, 4, 4001)
    for o, d, begin in zip(rays_o, rays_d, begins, strict=True):
        points = o + ends[:, None] * d
        held = inside(matrix, grid, points) | (abs(points) > 1).any(1)
        just = o + (begin + 1e-6) * d[None]
        assert abs(ends[held.argmax()] - begin) < 2e-3 or inside(matrix, grid, just)[0]
        assert not held[ends < begin - 1e-6].any()
    assert (one == 0).all() and 0.1 < (begins == 0).mean() < 0.6 and np.ptp(begins) > 1


def test_tiles_ask_all_balls_that_a_ray_comes_into():
    """Rays in the order of a picture and the same in disorder, many small balls before and around them."""
    rng = np.random.default_rng(2)
    grids = [OccupancyGrid(np.array([0, 0, 0, 1, 1, 1.0]), np.ones((1, 1, 1), bool))] * 40
    middles, sides = rng.normal(size=(40, 3)) * 3, rng.uniform(0.1, 1, 40)
    to_unit = [np.hstack([np.eye(3) / a, 0.5 - m[:, None] / a]) for m, a in zip(middles, sides, strict=True)]
    camera = framing_camera(np.array([-3, -3, -3, 3, 3, 3.0]), 0.9, 0.6, 64, 64)
    for rays_o, rays_d in (camera.rays(order=tile_order(64, 64)), rays_at(np.full(6, 0.0), 4096, 3)):
        rays_o = np.ascontiguousarray(rays_o + 0.05 * rng.normal(size=(1, 3)))
        mixed = rng.permutation(len(rays_o))
        whole = [True] * 40
        first, second = found_by_kernel(rays_o, rays_d, to_unit, grids, whole)
        again = found_by_kernel(rays_o[mixed], np.ascontiguousarray(rays_d[mixed]), to_unit, grids, whole)
        assert np.array_equal(first[mixed], again[0]) and np.array_equal(second[mixed], again[1])
        assert 0.1 < (first >= 0).mean() < 0.99 and len(set(first.tolist())) > 10


def test_some_rays_are_shown_in_other_frames_and_put_behind_what_there_is():
    rng = np.random.default_rng(4)
    rays_o, rays_d = rays_at(np.array([-1, -1, -1, 1, 1, 1.0]), 5000, 2)
    begin, end = rng.random(5000), 2 + rng.random(5000)
    chosen = rng.permutation(5000)[:4321]
    parts = [(STRETCHED, chosen[:3000]), (np.eye(4), chosen[3000:4000]), (shift(0.5), chosen[4000:])]
    before = rng.random((5000, 5)).astype(np.float32)
    behind = rng.random((4321, 5)).astype(np.float32)
    seen = []

    def show(rays, found):
        seen.append(rays)
        found[:] = behind

    out = before.copy()
    show_behind(show, Rays(rays_o, rays_d, None, 0.1, 0.0), parts, begin, end, out)
    own = [seen_from(matrix, rays_o[some], rays_d[some]) for matrix, some in parts]
    lengths = np.concatenate([np.broadcast_to(found[2], len(found[0])) for found in own])
    np.testing.assert_allclose(seen[0].rays_o, np.concatenate([found[0] for found in own]), atol=1e-12)
    np.testing.assert_allclose(seen[0].rays_d, np.concatenate([found[1] for found in own]), atol=1e-12)
    reach = np.stack([begin[chosen] * lengths, end[chosen] * lengths], 1)
    np.testing.assert_allclose(seen[0].reach, reach, atol=1e-12)
    behind[:, 4] /= lengths
    wanted = before.copy()
    wanted[chosen] += (1 - before[chosen, 3:4]) * behind
    np.testing.assert_allclose(out, wanted, atol=1e-6)


def test_only_copies_of_one_object_in_one_colour_are_twins():
    """A row of the same ball, of which two are tinted, is seen as each of them is alone."""
    kind = registry.kind("vm")
    red, blue = kind.tinted(ball(), (1.0, 0.3, 0.2)), kind.tinted(ball(), (0.2, 0.3, 1.0))
    row = [ball(), red, ball(), blue, red]
    field = blocks_of([Placed(str(i), one, shift(2.5 * (i - 2))) for i, one in enumerate(row)])
    kinds = [twin(field, b) for b in range(5)]
    shown = field.for_pictures(WORTH_TELLING)
    colours = []
    for i, b in enumerate(kinds):
        rays_o = np.array([[2.5 * (i - 2), 0.0, -4.0]]) + np.linspace(-0.3, 0.3, 50)[:, None]
        rays_d = np.tile([0.0, 0, 1], (50, 1))
        together, found = (render_rays(one, rays_o, rays_d) for one in (field, shown))
        assert abs(found - together)[:, :4].max() < 0.02
        colours.append(found[:, :3].mean(0))
        alone = kinds.index(b)
        np.testing.assert_allclose(colours[i], colours[alone], atol=2e-3)
    assert kinds[0] == kinds[2] == 0 and kinds[1] == kinds[4] and len(set(kinds)) == 3
    assert min(abs(colours[0] - colours[1]).max(), abs(colours[1] - colours[3]).max()) > 0.1


def test_places_are_told_by_the_number_there():
    numbers = np.random.default_rng(0).integers(-1, 250, 3000).astype(np.int16)
    told = dict(by_number(numbers))
    assert sorted(told) == sorted({*numbers.tolist()} - {-1})
    assert all(np.array_equal(places, np.flatnonzero(numbers == n)) for n, places in told.items())
    assert not list(by_number(np.full(5, -1, np.int16))) and not list(by_number(numbers[:0]))


def place(texels: int = 24) -> VMField:
    """Fog that fills all of space."""
    field = VMField.create(unbounded.WHOLE, (texels,) * 3, THIRTY_TWO, torch.Generator().manual_seed(0))
    return field.with_occupancy(OccupancyGrid.full(unbounded.WHOLE, 24, unbounded))


def airy(texels: int = 96) -> VMField:
    """Fog in one cell of twelve."""
    field = place(texels)
    grid = field.occupancy
    some = np.random.default_rng(1).random(grid.occupied.shape) < 1 / 12
    field.tensors = (replace(field.tensors[0], shift=-3.0),)
    return field.with_occupancy(grid.marked(some))


def scenes() -> dict[str, VMField]:
    """Fields of several blocks."""
    one, red = ball(), registry.kind("vm").tinted(ball(), (1.0, 0.3, 0.2))
    small = np.diag([0.3, 0.3, 0.3, 1.0])
    return {
        "apart": blocks_of([Placed("one", one, shift(-2.0)), Placed("other", one, shift(2.0) @ TURNED)]),
        "into each other": blocks_of(
            [Placed("one", one, STRETCHED), Placed("two", red, shift(0.5)), Placed("three", one, TURNED)]
        ),
        "in a place": blocks_of([Placed("place", place(), np.eye(4)), Placed("red", red, small @ TURNED)]),
        "in an airy place": blocks_of(
            [
                Placed("place", airy(), np.eye(4)),
                Placed("one", one, small @ TURNED),
                Placed("red", red, small),
            ]
        ),
    }


def test_balls_hold_the_matter_of_their_blocks_and_no_more_than_its_box_asks():
    for field in scenes().values():
        for block, (*middle, radius) in zip(field.blocks, field.balls, strict=True):
            tensor = field.tensors[block.tensor]
            assert np.isinf(radius) == (tensor.space is unbounded)
            if np.isinf(radius):
                continue
            grid = tensor.occupancy
            at = grid.aabb[:3] + (np.argwhere(grid.occupied)[:, None] + CORNERS) * grid.cell
            at = at.reshape(-1, 3) @ block.object_to_field[:3, :3].T + block.object_to_field[:3, 3]
            assert np.linalg.norm(at - middle, axis=1).max() <= radius
            apart = [np.linalg.norm(at - corner, axis=1).max() for corner in at[:: len(at) // 50]]
            assert max(apart) > radius


MIDDLES = {"apart": [[-2.0, 0, 0], [2, 0, 0]]}


def looks(name: str, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Rays from 3 away towards places around the objects of a scene."""
    rng, spread = np.random.default_rng(seed), 0.12 if "place" in name else 0.4
    middles, d = rng.choice(MIDDLES.get(name, [[0.0, 0, 0]]), count), unit(rng.normal(size=(count, 3)))
    return middles + spread * rng.uniform(-1, 1, (count, 3)) - 3 * d, d


def together_and_by_routes(field: VMField, rays_o, rays_d, **how) -> tuple[np.ndarray, np.ndarray]:
    shown = field.for_pictures(WORTH_TELLING)
    assert shown.by_routes and not field.by_routes
    return render_rays(field, rays_o, rays_d, **how), render_rays(shown, rays_o, rays_d, **how)


@pytest.mark.parametrize("name", ["apart", "into each other", "in a place", "in an airy place"])
@pytest.mark.parametrize("how", [{}, {"near": 2.9, "far": 3.2}], ids=["all", "near and far"])
def test_routes_show_what_all_blocks_do(name, how):
    """Samples lie elsewhere, so the denser they are, the more alike is what is seen."""
    field = scenes()[name]
    rays_o, rays_d = looks(name, 200, 3)
    fine = sampling_step(field) / 16
    one, other = together_and_by_routes(field, rays_o, rays_d, step=fine, early_stop=0.0, **how)
    apart = abs(one - other)
    assert 0.1 < (one[:, 3] > 0.5).mean() and one[:, 3].max() > 0.9
    assert apart[:, :4].max() < 0.03 and apart[:, :4].mean() < 2e-3
    far_fog = "place" in name and not how
    most = 0.1 if "airy" in name else 0.03  # fog of another opacity is as much farther, or nearer, times 3
    assert far_fog or (apart[:, 4].max() < most and apart[:, 4].mean() < 5e-3)
    one, other = together_and_by_routes(field, rays_o, rays_d, **how)
    assert abs(one - other)[:, :4].mean() < 0.01


def test_rays_past_the_objects_in_a_place_are_those_of_the_place():
    field = scenes()["in a place"]
    rays_o, rays_d = rays_at(np.array([-0.3, -0.3, -0.3, 0.3, 0.3, 0.3]), 400, 5)
    shown = field.for_pictures(WORTH_TELLING)
    alone = render_rays(place(), rays_o, rays_d)
    found = render_rays(shown, rays_o, rays_d)
    same = (found == alone).all(1)
    assert 0.3 < same.mean() < 0.98
    empty = render_rays(
        blocks_of([Placed("one", ball(), np.diag([0.3, 0.3, 0.3, 1.0]) @ TURNED)]), rays_o, rays_d
    )
    assert (empty[same, 3] < 1e-3).all()  # and what is not the place's comes from the object's cells


def test_a_place_is_asked_by_its_own_step_before_an_object_too(monkeypatch):
    """Where an object's cells are, but no matter of it, the place shows what it shows alone: a sample of its
    own is held for all of the object's, which are many times as dense."""
    monkeypatch.setattr(vm_field, "OWNERSHIP_CELLS", 8)  # no smaller than the place's voxels
    noisy, clear = place(), registry.kind("vm").tinted(ball(), (1.0, 0.3, 0.2))  # as compiled for others
    for name, plane in noisy.sections(0).items():
        plane *= 100 if name.startswith("density_plane") else 1
    clear.tensors = (replace(clear.tensors[0], shift=-80.0),)
    field = blocks_of([Placed("place", noisy, np.eye(4)), Placed("one", clear, np.diag([0.3, 0.3, 0.3, 1]))])
    assert sampling_step(noisy) > 8 * sampling_step(field)
    rays_o, rays_d = looks("in a place", 200, 11)
    whole = {"near": 2.3, "far": 2.3 + 8 * sampling_step(noisy), "early_stop": 0.0}  # samples, in the core
    by_routes = copy(field)
    by_routes.by_routes = True
    alone, found, handed_on = (render_rays(one, rays_o, rays_d, **whole) for one in (noisy, field, by_routes))
    assert alone[:, 3].std() > 0.1
    assert abs(found - alone)[:, 3].max() < 1e-2 and abs(handed_on - alone)[:, 3].max() < 1e-2


def test_a_place_hands_a_ray_on_between_two_of_its_samples():
    """In the core, which half of the rays have yet to enter, and at its end where the object is beyond."""
    field = scenes()["in a place"]
    step = sampling_step(field) / 2
    rays_o, rays_d = looks("in a place", 400, 13)
    near = np.where(np.arange(400) % 2, 2.2, 0.5)
    rays = Rays(rays_o, rays_d, np.stack([near, np.full(400, np.inf)], 1), step, 0.0)
    first, second = met_blocks(field, rays)
    steps = own_steps(field, step)
    until = alone_until(field, rays, first, second, steps)
    meets = second < NOWHERE
    assert (first == 0).all() and 0.2 < meets.mean() < 0.9 and steps[0] > 4 * step
    assert (until[~meets] == NOWHERE).all()
    faces = np.sort((np.array([-1.0, 1])[:, None, None] - rays_o) / rays_d, axis=0)
    enters, leaves = faces[0].max(1), faces[1].min(1)
    begin = np.maximum(enters, near)
    assert (begin[meets] > near[meets] + 0.3).mean() > 0.3 and (begin == near)[meets].mean() > 0.3
    before = (until - begin)[meets] / steps[0]
    assert abs(before - before.round()).max() < 1e-6 and (before > 0.5).mean() > 0.9
    rest = np.maximum(second, near)[meets] - until[meets]
    assert (rest >= -1e-9).all() and (rest < steps[0] + 1e-9).all()
    beyond, before_it = np.full(400, 9.0), np.full(400, 0.6)  # of the core
    until = alone_until(field, rays, first, beyond, steps)
    np.testing.assert_allclose(until, leaves, rtol=1e-9)
    until = alone_until(field, rays, first, before_it, steps)
    assert np.array_equal(until[near < 1], near[near < 1])


@pytest.mark.parametrize(("name", "many"), [("apart", 0.3), ("in a place", 0.0), ("in an airy place", 0.1)])
def test_a_second_block_is_followed_alone_where_no_other_has_matter(name, many):
    """Up to where another's begins, seen from there."""
    field = scenes()[name]
    rays_o, rays_d = looks(name, 400, 17)
    if name == "apart":  # along both
        rays_o = np.array([-6.0, 0, 0]) + np.random.default_rng(1).uniform(-0.4, 0.4, (400, 3))
        rays_d = np.tile([1.0, 0, 0], (400, 1))
    rays = Rays(rays_o, rays_d, np.tile([2.2, np.inf], (400, 1)), sampling_step(field), 0.0)
    first, second = met_blocks(field, rays)
    steps = own_steps(field, rays.step)
    until = alone_until(field, rays, first, second, steps)
    before, left, far = until.copy(), np.flatnonzero(until < NOWHERE), np.full(400, np.inf)
    out = np.zeros((400, 5), np.float32)
    show_second(field, rays, left, until, far, steps, out)
    moved = until > before
    assert moved.mean() > many if many else not moved.any()
    assert (out[~moved] == 0).all() and (out[:, 3] > 0.5).mean() >= 0.5 * many
    if name != "in an airy place":
        assert (until[moved] == NOWHERE).all()
        return
    o, d, until, before = rays_o[moved], rays_d[moved], until[moved], before[moved]
    assert (until < NOWHERE).all()
    at, before_it = (o + (until + by)[:, None] * d for by in (1e-6, -1e-3))
    place_there = field.tensors[0].occupancy.contains
    other = np.any([inside_block(field, b, at) for b in (1, 2)], axis=0)
    assert (place_there(at) | other | (abs(at) > 1 - 1e-5).any(1)).all()
    assert not (place_there(before_it) & (until - before > 2e-3)).any()


def inside_block(field: VMField, b: int, points: np.ndarray) -> np.ndarray:
    """(N,) bool, which points (N, 3) of the field lie in an occupied cell of a block."""
    matrix = np.linalg.inv(field.blocks[b].object_to_field)
    return field.tensors[field.blocks[b].tensor].occupancy.contains(points @ matrix[:3, :3].T + matrix[:3, 3])


def test_a_ray_does_not_depend_on_its_company():
    for name, field in scenes().items():
        shown = field.for_pictures(WORTH_TELLING)
        rays_o, rays_d = looks(name, 101, 7)
        whole = render_rays(shown, rays_o, rays_d)
        halves = [render_rays(shown, rays_o[part], rays_d[part]) for part in (slice(0, 37), slice(37, 101))]
        assert np.array_equal(whole, np.concatenate(halves))


def test_rays_of_many_blocks_ask_all_together(monkeypatch):
    field = scenes()["into each other"]
    for most, by_routes in ((3, True), (2, False)):
        monkeypatch.setattr(vm_field, "BY_ROUTES", most)
        assert field.for_pictures(WORTH_TELLING).by_routes is by_routes


def test_numbers_that_change_are_seen_by_routes():
    """A field with other numbers does not show those that it was made from."""
    shown = scenes()["apart"].for_pictures(WORTH_TELLING)
    rays_o, rays_d = looks("apart", 100, 9)
    before = render_rays(shown, rays_o, rays_d)
    other = shown.with_params(torch.zeros_like(shown.params))
    assert abs(render_rays(other, rays_o, rays_d) - before).max() > 0.3
    assert np.array_equal(render_rays(copy(shown), rays_o, rays_d), before)
    assert render_rays(shown, rays_o, -rays_d).max() == 0
