"""Resampling: exact where it can be, no finer than needed, within its numbers, and what is left out does not
show."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.encodings.bricks import SIDE
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.field_sampling import colours, even_directions
from fusedrf_cli.engine.kinds.sparse.bricks import MAX_LEVEL, BrickTree, key_positions, node_keys
from fusedrf_cli.engine.kinds.sparse.field import SparseShape
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice
from fusedrf_cli.engine.kinds.sparse.resample import (
    at_vertices,
    frame_of,
    leaves,
    one_of_eight,
    resampled,
    voxels_wanted,
)
from fusedrf_cli.engine.rendering.cameras import scattered
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image
from tests.analytic.fields import Ball, Box, Gaussian, Tint
from tests.analytic.rays import unit
from tests.bridge.test_unbounded import fine_walls

RED = Tint.of(0.8, 0.2, 0.1)


def ball(density=60.0, voxel=0.05, tint=RED, **options) -> Ball:
    """A ball of radius 0.6 with an even density and its own voxel."""
    field = Ball(density, tint=tint, **options).occupy(24)
    field.voxel_size = voxel
    return field


def placed(field, scale: float = 1.0, at=(0.0, 0.0, 0.0), turned: float = 0.0) -> Placed:
    """A field scaled, turned about z and moved."""
    c, s = np.cos(turned), np.sin(turned)
    matrix = np.eye(4)
    matrix[:3, :3] = scale * np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    matrix[:3, 3] = at
    return Placed("one", field, matrix)


def likeness(field, teacher, size: int = 48) -> float:
    """PSNR over white of four views."""
    cameras = scattered(teacher.occupancy.tight_aabb(0), 4, size, size, seed=3)
    shots = [np.stack([render_image(f, c).over((1, 1, 1)) for c in cameras]) for f in (field, teacher)]
    return psnr(*shots)


def test_a_ball_looks_like_itself_and_more_so_with_more_numbers():
    teacher = ball(voxel=0.04)
    found = [likeness(resampled(teacher, SparseShape(0), n), teacher) for n in (4_000, 60_000)]
    assert found[1] > 30 and found[1] > found[0] + 2


def test_the_numbers_are_kept_to():
    teacher = ComposedField([placed(ball()), placed(ball(), 0.3, (1.2, 0, 0))])
    for most in (5_000, 20_000):
        field = resampled(teacher, SparseShape(1), most)
        assert 0.4 * most < field.numbers <= most
    field = resampled(teacher, SparseShape(1), 20_000, 50.0)
    assert 0.4 * 20_000 < field.numbers + 50 * len(field.tree.level) <= 20_000
    with pytest.raises(ValueError, match="more than 50 numbers"):
        resampled(teacher, SparseShape(0), 50)


def test_each_object_has_the_voxel_that_it_needs():
    """At a twentieth of the size, a twentieth of the voxel, if numbers allow."""
    teacher = ComposedField([placed(ball()), placed(ball(), 0.05, (1.0, 0, 0))])
    field = resampled(teacher, SparseShape(0), 10**6)
    small = teacher.placed[1].object_to_world @ np.append(ball().centre, 1)
    side = field.tree.top[0] / 2.0**field.tree.level
    middle = field.tree.lo + (field.tree.at + 0.5) * side[:, None]
    near = np.abs(middle - small[:3]).max(1) < 0.05
    voxel = side / 4
    assert near.any() and (~near).any()
    assert (voxel[near] <= 0.0025 * 2**0.51).all() and np.median(voxel[~near]) > 0.02


def test_a_turned_teacher_of_degree_two_loses_no_colour(rng):
    bands = rng.normal(size=(3, 5)) * 0.4
    tint = Tint((0.2, -0.3, 0.1), rng.normal(size=(3, 3)) * 0.3, bands=bands)
    teacher = ComposedField([placed(ball(tint=tint), turned=0.7)])
    points = np.zeros((4, 3)) + teacher.placed[0].object_to_world[:3, :3] @ ball().centre
    points = points + teacher.placed[0].object_to_world[:3, 3] + rng.uniform(-0.2, 0.2, (4, 3))
    found = colours(teacher, points, np.zeros((4, 3)), 2)
    dirs = unit(rng.normal(size=(4, 3)))
    from fusedrf_cli.engine.kernels.reference import sh_basis

    basis = sh_basis(9, torch.from_numpy(dirs)).numpy()
    rgb = 1 / (1 + np.exp(-np.einsum("nck,nk->nc", found, basis)))
    wanted = teacher.query(torch.from_numpy(points), torch.from_numpy(dirs))[1].numpy()
    np.testing.assert_allclose(rgb, wanted, atol=1e-3)


def test_what_nobody_sees_is_not_held_and_not_missed():
    """The inside of a solid ball: few bricks reach it, and no picture tells."""
    teacher = ball(density=400.0, voxel=0.02)
    field = resampled(teacher, SparseShape(0), 10**6)
    middle = torch.from_numpy(teacher.centre[None])
    assert field.query(middle, torch.eye(3, dtype=torch.float64)[:1], False)[0] == 0
    assert likeness(field, teacher) > 30


def test_thin_fog_is_not_thought_empty():
    teacher = Gaussian(density=0.4, tint=RED)
    teacher.voxel_size = 0.05
    field = resampled(teacher, SparseShape(0), 10**6)
    through = [
        render_image(f, scattered(teacher.aabb, 1, 24, 24, seed=1)[0]).opacity for f in (field, teacher)
    ]
    assert through[1].max() > 0.05 and np.abs(through[0] - through[1]).max() < 0.01


def test_an_edge_of_colour_does_not_grey():
    """Samples before the surface show the surface's colour, not that of emptiness."""
    teacher = ball(density=400.0, voxel=0.05)
    field = resampled(teacher, SparseShape(0), 10**6)
    shot = render_image(field, scattered(teacher.aabb, 1, 40, 40, seed=1)[0])
    seen = shot.opacity > 0.5
    found = shot.rgb[seen] / shot.opacity[seen][:, None]
    np.testing.assert_allclose(found, np.tile([0.8, 0.2, 0.1], (len(found), 1)), atol=8e-3)


def test_a_scene_that_shows_nothing_is_refused():
    with pytest.raises(ValueError, match="nothing"):
        resampled(ball(density=1e-12), SparseShape(0), 1000)


def test_a_stretched_teacher_is_told_between_its_axes():
    teacher = ComposedField([Placed("one", ball(), np.diag([1.0, 1.0, 2.0, 1.0]))])
    assert likeness(resampled(teacher, SparseShape(0), 200_000), teacher) > 24


def test_leaves_hold_every_wanted_brick_once(rng):
    """Every wanted brick is covered, by leaves of its level or finer, and no leaf lies in another."""
    wanted = [np.unique(node_keys(rng.integers(0, 3 << level, (6, 3)))) for level in range(3)]
    level, at = leaves(wanted)
    covered = np.zeros((12, 12, 12), int)
    for n, place in zip(level, at, strict=True):
        low, side = place << (2 - n), 1 << (2 - n)
        covered[tuple(slice(a, a + side) for a in low)] += 1
    assert covered.max() == 1
    for n, keys in enumerate(wanted):
        for place in key_positions(keys):
            low, side = place << (2 - n), 1 << (2 - n)
            assert covered[tuple(slice(a, a + side) for a in low)].all()
    assert all(np.isin(wanted[2], node_keys(at[level == 2])))


def test_levels_stay_within_what_a_tree_can_be():
    tiny = ComposedField([placed(ball(), 1e-3), placed(ball(), 3.0)])
    _, top, counts, levels = frame_of(tiny, 1e-6)
    assert max(levels) <= MAX_LEVEL and np.prod(counts) <= 1 << 20 and (top > 0).all()


def test_what_stands_in_a_place_gives_way_less_than_the_place():
    """By half in logarithms, and neither is finer than its own; without a place all keep their order."""
    thing, room = placed(ball(), 0.01), Placed("room", fine_walls(), np.eye(4))
    own = thing.voxel_size, room.voxel_size
    for order in ([thing, room], [room, thing]):
        wanted = dict(zip([p.name for p in order], voxels_wanted(ComposedField(order), 9.0), strict=True))
        np.testing.assert_allclose([wanted[thing.name], wanted["room"]], [3 * own[0], 9 * own[1]])
    np.testing.assert_allclose(voxels_wanted(ComposedField([thing, room]), 0.2), own)
    alone = ComposedField([thing, placed(ball(), 1.0)])
    small, large = voxels_wanted(alone, 4.0)
    assert large == pytest.approx(4 * alone.placed[1].voxel_size) and small > 4 * own[0]


def test_one_voxel_of_eight_touches_every_vertex():
    """Once, but for those on the far faces of the box, where no voxel of even places begins."""
    at = np.argwhere(np.ones((2, 2, 2), bool))
    masks = np.ones((8, SIDE, SIDE, SIDE), bool)
    lattice = VertexLattice(BrickTree.of(np.zeros(3), 1.0, (2, 2, 2), np.zeros(8, np.uint8), at, masks), SIDE)
    chosen = one_of_eight(lattice)
    assert chosen.sum() * 8 == len(chosen) == (2 * SIDE) ** 3
    touched = np.bincount(lattice.corners[chosen].ravel(), minlength=len(lattice.vertices))
    inner = (lattice.vertices < 2 * SIDE).all(1)
    assert (touched[inner] == 1).all()


def test_directions_are_even():
    dirs = even_directions(32)
    np.testing.assert_allclose(np.linalg.norm(dirs, axis=1), 1)
    assert np.abs(dirs.mean(0)).max() < 0.02 and np.abs(dirs.T @ dirs / 32 - np.eye(3) / 3).max() < 0.02


def test_an_occupancy_of_few_wide_cells_is_searched_too():
    teacher = ball()
    teacher.occupancy = OccupancyGrid.full(teacher.aabb, 2)
    assert likeness(resampled(teacher, SparseShape(0), 60_000), ball()) > 28


@pytest.mark.slow
def test_an_object_at_a_twentieth_of_the_scene_keeps_its_detail():
    """Seen close from above the ground, whose inside nobody sees, against the composed scene."""
    ground = Box(80.0, (1.2, 1.2, 0.1), tint=None)
    ground.voxel_size = 0.03
    marble = placed(ball(density=150.0, voxel=0.012, tint=None), 0.05, (0.2, 0.1, 0.125))
    teacher = ComposedField([placed(ground), marble])
    field = resampled(teacher, SparseShape(1), 2_500_000)
    cameras = scattered(marble.aabb, 16, 96, 96, seed=2)
    cameras = [c for c in cameras if c.camera_to_world[2, 3] > 0.12][:4]
    shots = [
        np.stack([render_image(f, c, origin=teacher.origin).over((1, 1, 1)) for c in cameras])
        for f in (field, teacher)
    ]
    assert psnr(*shots) > 33


def test_what_voxels_are_worth_is_summed_at_their_corners(rng):
    corners = rng.integers(0, 9, (40, 8))
    values = rng.normal(size=(40, 3))
    wanted = np.zeros((9, 3))
    for own, value in zip(corners, values, strict=True):
        for vertex in own:
            wanted[vertex] += value
    np.testing.assert_allclose(at_vertices(corners, values, 9), wanted)
