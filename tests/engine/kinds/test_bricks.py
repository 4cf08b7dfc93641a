"""Trees of bricks and the lattices over them: packing, indices against slow loops, vertices that hang."""

from dataclasses import replace

import numpy as np
import pytest

from fusedrf_cli.engine.encodings.bricks import SIDE
from fusedrf_cli.engine.kinds.sparse.bricks import (
    MAX_LEVEL,
    BrickTree,
    children,
    key_positions,
    morton,
    node_keys,
)
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice
from tests.engine.kinds.sparse_cases import random_tree


def test_keys_keep_places_and_their_order(rng):
    places = rng.integers(0, 1 << 21, (200, 3))
    np.testing.assert_array_equal(key_positions(node_keys(places)), places)
    order = np.lexsort((places[:, 2], places[:, 1], places[:, 0]))
    np.testing.assert_array_equal(np.argsort(node_keys(places)), order)


def test_a_morton_code_is_the_bits_of_three_numbers_in_turn(rng):
    places = rng.integers(0, 1 << 21, (50, 3))
    for place, code in zip(places, morton(places), strict=True):
        digits = zip(*(f"{n:021b}" for n in place), strict=True)
        assert f"{code:063b}" == "".join("".join(three) for three in digits)


@pytest.mark.parametrize("n", [4, 2])
def test_rows_are_stored_in_runs_of_eight_top_cells(n):
    """Every row once, those of a run in the same two top cells per axis, and no two runs in the same."""
    lattice = VertexLattice(replace(random_tree(2), phase=(1, 0, 1)), n)
    order, runs = lattice.stored_order
    np.testing.assert_array_equal(np.sort(order), np.arange(lattice.free))
    cells = lattice.vertices[order] // (SIDE << lattice.tree.depth)
    pairs = (cells + [1, 0, 1]) // 2
    each = [np.unique(part, axis=0) for part in np.split(pairs, np.cumsum(runs)[:-1])]
    assert all(len(found) == 1 for found in each)
    assert len(np.unique(np.concatenate(each), axis=0)) == len(runs) == len(np.unique(pairs, axis=0))


def grown(tree: BrickTree, cells: np.ndarray) -> BrickTree:
    """The same bricks in a box that reaches so many top cells (3,) further down."""
    at = tree.at + (cells << tree.level[:, None].astype(np.int64))
    lo, counts, phase = tree.lo - cells * tree.top, cells + tree.counts, (tree.phase - cells) % 2
    return BrickTree.of(lo, tree.top, counts, tree.level, at, tree.mask, phase)


def test_runs_stay_what_they_are_when_the_box_grows():
    """By one top cell, which moves every other one to the other place of its pair, and by two."""
    tree = random_tree(2)
    lattice = VertexLattice(tree, SIDE)
    order, runs = lattice.stored_order
    held = {frozenset(keys) for keys in np.split(order, np.cumsum(runs)[:-1])}
    for cells in ([1, 0, 2], [2, 1, 1], [3, 3, 0]):
        order, runs = VertexLattice(grown(tree, np.array(cells)), SIDE).stored_order
        assert {frozenset(keys) for keys in np.split(order, np.cumsum(runs)[:-1])} == held


@pytest.mark.parametrize("depth", [0, 1, 3])
def test_packed_and_unpacked_it_is_the_same(depth):
    tree = random_tree(depth)
    again = BrickTree.unpacked(tree.lo, tree.top, tree.counts, *tree.packed())
    for name in ("level", "at", "mask"):
        np.testing.assert_array_equal(getattr(again, name), getattr(tree, name))
    assert again.depth == depth


def test_bricks_of_any_order_make_the_same_tree(rng):
    tree = random_tree(2)
    order = rng.permutation(len(tree.level))
    again = BrickTree.of(tree.lo, tree.top, tree.counts, tree.level[order], tree.at[order], tree.mask[order])
    np.testing.assert_array_equal(again.at, tree.at)


@pytest.mark.parametrize("what", ["nodes", "masks"])
def test_bytes_that_are_no_tree_are_refused(what):
    tree = random_tree(2)
    nodes, masks = tree.packed()
    for bad in (
        nodes[:-1],
        np.append(nodes, 0).astype(np.uint8),
        np.full_like(nodes, 255),
        np.full_like(nodes, 170),
    ):
        with pytest.raises(ValueError, match="nodes"):
            BrickTree.unpacked(tree.lo, tree.top, tree.counts, bad, masks)
    with pytest.raises(ValueError, match="masks"):
        BrickTree.unpacked(tree.lo, tree.top, tree.counts, nodes, masks[:-8])


@pytest.mark.parametrize("n", [4, 2])
def test_points_find_their_voxel(n, rng):
    """Against a loop over all bricks."""
    tree = random_tree(2)
    lattice = VertexLattice(tree, n)
    halves = 2 * rng.integers(-2, (np.array(tree.counts) * SIDE << tree.depth) + 2, (300, 3)) + 1
    brick, voxel, active = tree.voxels_at(halves, n, lattice.active)
    for point, b, v, a in zip(halves, brick, voxel, active, strict=True):
        side = 2 * (SIDE << (tree.depth - tree.level.astype(int)))
        inside = (tree.at * side[:, None] <= point).all(1) & (point < (tree.at + 1) * side[:, None]).all(1)
        held = np.flatnonzero(inside)
        assert len(held) <= 1 and b == (held[0] if len(held) else -1)
        if len(held):
            i, j, k = (point - tree.at[b] * side[b]) * n // side[b]
            assert v == (i * n + j) * n + k and a == lattice.active[b, v]
    assert (brick >= 0).any() and (brick < 0).any()


@pytest.mark.parametrize("n", [4, 2])
def test_every_place_is_one_vertex(n):
    """Free and hanging rows are different places; corners of active voxels have one, in ascending order of
    need."""
    tree = random_tree(2)
    lattice = VertexLattice(tree, n)
    assert len(np.unique(node_keys(lattice.vertices))) == len(lattice.vertices)
    assert (lattice.corners >= 0).all()
    free = lattice.rows[lattice.rows >= 0]
    free = free[free < lattice.free]
    first = np.unique(free, return_index=True)[1]
    assert (np.diff(first) > 0).all() and len(first) == lattice.free


@pytest.mark.parametrize("n", [4, 2])
def test_hanging_rows_are_averages_of_free_ones(n):
    """Weights are positive, sum to 1, and keep linear functions of the place."""
    lattice = VertexLattice(random_tree(3), n)
    spread = lattice.spread
    assert spread.shape[0] > 10 and spread.data.min() > 0
    np.testing.assert_allclose(spread.sum(1), 1)
    vertices = lattice.vertices.astype(float)
    np.testing.assert_allclose(spread @ vertices[: lattice.free], vertices[lattice.free :], atol=1e-9)


@pytest.mark.parametrize("longest", [1, 8, 16, 64])
def test_the_occupancy_is_the_cells_of_active_voxels(longest):
    """Voxel by voxel, of every level, in top cells, their halves and their quarters."""
    tree = random_tree(2)
    grid = tree.occupancy(longest)
    expected = np.zeros_like(grid.occupied)
    for level, at, mask in zip(tree.level, tree.at, tree.mask, strict=True):
        middles = (at * SIDE + np.argwhere(mask) + 0.5) * tree.top / (SIDE << level)
        expected[tuple(np.floor(middles / grid.cell).astype(int).T)] = True
    np.testing.assert_array_equal(grid.occupied, expected)


def test_the_occupancy_covers_every_active_voxel(rng):
    tree = random_tree(2)
    grid = tree.occupancy(64)
    brick, i, j, k = np.nonzero(tree.mask)
    side = tree.top / (SIDE << tree.level[brick].astype(int))[:, None]
    middle = tree.lo + (tree.at[brick] * SIDE + np.stack([i, j, k], 1) + 0.5) * side
    for offset in rng.uniform(-0.499, 0.499, (4, 3)):
        assert grid.contains(middle + offset * side).all()
    assert not grid.occupied.all()


def test_children_fill_their_parent():
    kids = children(np.array([[1, 2, 3]]))
    assert len(np.unique(node_keys(kids))) == 8
    np.testing.assert_array_equal(kids >> 1, np.tile([1, 2, 3], (8, 1)))


def test_tables_that_a_few_bytes_would_make_huge_are_refused():
    """One finest brick in each of many top cells: two million entries for each."""
    at = np.argwhere(np.ones((4, 4, 4), bool)) << MAX_LEVEL
    tree = BrickTree.of(
        np.zeros(3), 1.0, (4, 4, 4), np.full(64, MAX_LEVEL, np.uint8), at, np.ones((64, 4, 4, 4), bool)
    )
    assert len(tree.packed()[0]) < 2000
    with pytest.raises(ValueError, match="entries"):
        tree.tables  # noqa: B018


def test_too_many_top_cells_are_refused_before_they_are_made():
    with pytest.raises(ValueError, match="nodes"):
        BrickTree.unpacked(np.zeros(3), 1.0, (2048, 1024, 2), np.zeros(10, np.uint8), np.zeros(0, np.uint8))
