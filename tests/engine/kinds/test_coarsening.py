"""Sparse fields with wider voxels and fewer degrees: what they hold, how large they are, what they show."""

import numpy as np
import pytest
import torch

from formats.records import FieldRecord, encode_field
from fusedrf_cli.bridge.sizes import BundleSizes
from fusedrf_cli.engine.encodings.bricks import SIDE
from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.kinds.registry import kind
from fusedrf_cli.engine.kinds.sparse.bricks import BrickTree
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice
from tests.analytic.rays import points_in, unit
from tests.engine.kinds.sparse_cases import random_sparse, random_tree

SPARSE = kind("sparse")
AS_IT_IS = StorageSetting()


def reduced(field: SparseField, voxel: float, storage: StorageSetting = AS_IT_IS) -> SparseField:
    """The field by its kind's reduction; the size told is that of a file, and not far above."""
    reduction = SPARSE.reduction(SPARSE.outline(field), voxel, storage)
    made = reduction.make(field)
    for precision in ("float16", "int8"):
        told = BundleSizes().of(reduction.contents, precision)
        have = len(encode_field(FieldRecord("sparse", *made.state()), precision))
        assert have <= told <= 1.2 * have + 4000
    return made


@pytest.mark.parametrize("halvings", [1, 2, 3, 4])
def test_voxels_are_as_wide_as_asked_and_hold_all_that_was_held(halvings):
    tree = random_tree(2)
    coarse = tree.coarser(halvings)
    np.testing.assert_allclose(coarse.unit, tree.unit * 2**halvings)
    level, *inner = np.nonzero(tree.mask)
    side = (tree.top / SIDE)[None] / 2.0 ** tree.level[level, None]
    middles = tree.lo + (tree.at[level] * SIDE + np.stack(inner, 1) + 0.5) * side
    lattice = VertexLattice(coarse, SIDE)
    halves = np.floor((middles - coarse.lo) / coarse.unit).astype(int) * 2 + 1
    brick, _, active = coarse.voxels_at(halves, SIDE, lattice.active)
    assert active.all()
    held = np.zeros(lattice.active.shape, bool)
    held[brick, coarse.voxels_at(halves, SIDE, lattice.active)[1]] = True
    assert (held == lattice.active).all()  # and nothing else
    wide = coarse.top / SIDE / 2.0 ** coarse.level[brick, None]
    np.testing.assert_allclose(wide, np.maximum(side, coarse.unit))


def uniform(counts=(4, 5, 4), degree: int = 1) -> SparseField:
    """A box of one density and one colour that depends on the direction."""
    at = np.argwhere(np.ones(counts, bool))
    whole = np.ones((len(at), SIDE, SIDE, SIDE), bool)
    tree = BrickTree.of([0.5, 0, 0], 1.0, counts, np.zeros(len(at), np.uint8), at, whole)
    field = SparseField(SparseShape(degree), VertexLattice(tree, SIDE), 2.0)
    field.rows[:] = torch.tensor([1.0, 2.0, -1.0, 0.5])
    field.bands[:] = torch.linspace(-0.5, 0.5, field.shape.band_numbers)
    return field


@pytest.mark.parametrize("voxel", [0.3, 0.6])
def test_an_even_box_stays_what_it_is(voxel, rng):
    field = uniform()
    made = reduced(field, voxel)
    assert voxel <= made.voxel_size < 2 * voxel and made.fine.free < 0.5 * field.fine.free
    points = torch.from_numpy(points_in(field.aabb, 200))
    dirs = torch.from_numpy(unit(rng.normal(size=(200, 3))))
    for mine, theirs in zip(made.query(points, dirs), field.query(points, dirs), strict=True):
        torch.testing.assert_close(mine, theirs, atol=5e-3, rtol=5e-2)


def test_what_is_as_wide_as_asked_stays_as_it_is():
    field = random_sparse(2, dtype=torch.float32)
    reduction = SPARSE.reduction(SPARSE.outline(field), 0.99 * field.voxel_size, StorageSetting(sh_degree=3))
    assert reduction.lossless and reduction.make(field) is field
    assert not SPARSE.reduction(SPARSE.outline(field), 1.01 * field.voxel_size, StorageSetting()).lossless


def test_no_voxel_is_wider_than_a_quarter_of_the_box():
    made = reduced(random_sparse(0, 0, torch.float32), 1e6)
    assert max(made.tree.counts) == 2 and made.tree.mask.any()


def test_higher_degrees_that_are_0_are_left_out_without_a_trace(rng):
    field = random_sparse(2, dtype=torch.float32)
    field.bands.view(len(field.bands), 3, 8)[..., 3:] = 0
    made = reduced(field, 0.0, StorageSetting(sh_degree=1))
    points = torch.from_numpy(points_in(field.aabb, 200))
    dirs = torch.from_numpy(unit(rng.normal(size=(200, 3))))
    for mine, theirs in zip(made.query(points, dirs), field.query(points, dirs), strict=True):
        torch.testing.assert_close(mine, theirs, atol=1e-6, rtol=1e-6)
    assert made.numbers < 0.75 * field.numbers
