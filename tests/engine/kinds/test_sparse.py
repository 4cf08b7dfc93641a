"""The sparse field: answers against a slow loop, no cracks between levels, gradients against finite
differences, pictures against the general renderer, storage."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.encodings.bricks import COARSE, ROW, SIDE
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.computed import Batch
from fusedrf_cli.engine.kernels.reference import sh_basis
from fusedrf_cli.engine.kinds.sparse.bricks import OCTANTS, BrickTree
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice
from fusedrf_cli.engine.rendering.volume import render_rays
from tests.analytic.fields import Slow
from tests.analytic.rays import points_in, rays_at, unit
from tests.bundles import field_kinds
from tests.engine.kinds.sparse_cases import random_sparse, random_tree


def slowly(field: SparseField, point: np.ndarray, direction: np.ndarray):
    """σ and rgb at one point by a loop over all bricks; None where no voxel is active."""
    tree = field.tree
    for b in range(len(tree.level)):
        inside = (point - tree.lo) / (tree.top / 2 ** int(tree.level[b])) - tree.at[b]
        if not ((inside >= 0) & (inside < 1)).all():
            continue
        if not tree.mask[b][tuple((inside * SIDE).astype(int))]:
            return None
        own = mixed(field.fine, field.rows, b, inside)
        logits = own[1:, None]
        if field.coarse:
            more = mixed(field.coarse, field.bands, b, inside)
            logits = np.concatenate([logits, more.reshape(3, -1)], 1)
        basis = sh_basis(field.shape.coefficients, torch.from_numpy(direction[None])).numpy()[0]
        return field.scale * np.log1p(np.exp(own[0])), 1 / (1 + np.exp(-(logits @ basis)))
    return None


def mixed(lattice: VertexLattice, rows: torch.Tensor, brick: int, inside: np.ndarray) -> np.ndarray:
    """Rows interpolated at a point (3,) in [0, 1) of a brick."""
    n = lattice.n
    at = inside * n
    voxel = at.astype(int)
    total = 0.0
    for corner in OCTANTS:
        i, j, k = voxel + corner
        row = lattice.rows[brick, (i * (n + 1) + j) * (n + 1) + k]
        total = total + np.prod(np.where(corner, at - voxel, 1 - at + voxel)) * rows[row].numpy()
    return total


@pytest.mark.parametrize("degree", [0, 2])
def test_answers_are_those_of_a_loop(degree, rng):
    field = random_sparse(degree)
    points = points_in(field.aabb, 150, margin=0.1)
    dirs = unit(rng.normal(size=points.shape))
    sigma, rgb = field.query(torch.from_numpy(points), torch.from_numpy(dirs))
    held = 0
    for i in range(len(points)):
        wanted = slowly(field, points[i], dirs[i])
        held += wanted is not None
        np.testing.assert_allclose(sigma[i], 0 if wanted is None else wanted[0], rtol=1e-9)
        np.testing.assert_allclose(rgb[i], np.zeros(3) if wanted is None else wanted[1], rtol=1e-9)
    assert 20 < held < 140
    assert isinstance(field, RadianceField) and field_kinds()["sparse"] is SparseField


@pytest.mark.parametrize("degree", [0, 2])
def test_levels_join_without_a_crack(degree, rng):
    """Both sides of every face between active voxels of different bricks say the same, whatever the
    levels."""
    tree = random_tree(3)
    tree.mask[:] = True
    bare = SparseField(SparseShape(degree), VertexLattice(tree, SIDE), 4.0)
    torn = bare.with_params(torch.from_numpy(rng.normal(size=bare.size)))
    joined = bare.with_params(torn.params.clone())
    joined.settle()
    side = tree.top / 2.0 ** tree.level[:, None]
    for axis in range(3):
        spots = rng.random((len(side), 6, 3)) * side[:, None]
        spots[..., axis] = 0
        spots = ((tree.lo + tree.at * side)[:, None] + spots).reshape(-1, 3)
        before, behind = spots - 1e-9 * np.eye(3)[axis], spots + 1e-9 * np.eye(3)[axis]
        dirs = torch.from_numpy(unit(np.tile(rng.normal(size=3), (len(spots), 1))))
        across = torch.from_numpy(level_at(tree, before) != level_at(tree, behind))
        jumps = []
        for field in (joined, torn):
            (s0, c0), (s1, c1) = (field.query(torch.from_numpy(x), dirs) for x in (before, behind))
            met = across & (s0 > 0) & (s1 > 0)
            jumps.append(max(float((s0 - s1)[met].abs().max()), float((c0 - c1)[met].abs().max())))
        assert met.sum() > 20 and jumps[0] < 1e-6 < 0.1 < jumps[1]


def level_at(tree, points: np.ndarray) -> np.ndarray:
    """(N,) level of the brick that holds each point, -1 outside of all."""
    found = np.full(len(points), -1)
    for b in range(len(tree.level)):
        inside = (points - tree.lo) / tree.top * 2 ** int(tree.level[b]) - tree.at[b]
        found[((inside >= 0) & (inside < 1)).all(1)] = tree.level[b]
    return found


@pytest.mark.parametrize("degree", [0, 2])
def test_gradients_of_answers_are_finite_differences(degree, rng):
    field = random_sparse(degree)
    points = torch.from_numpy(points_in(field.aabb, 60))
    dirs = torch.from_numpy(unit(rng.normal(size=(60, 3))))
    d_sigma, d_rgb = torch.from_numpy(rng.normal(size=60)), torch.from_numpy(rng.normal(size=(60, 3)))

    def value() -> float:
        sigma, rgb = field.query(points, dirs)
        return float((sigma * d_sigma).sum() + (rgb * d_rgb).sum())

    grads = np.zeros((2, field.size))
    field.query_backward(points, dirs, d_sigma, d_rgb, grads)
    check_differences(field, value, grads.sum(0), rng)


@pytest.mark.parametrize("degree", [0, 2])
def test_gradients_of_pictures_are_finite_differences(degree, rng):
    field = random_sparse(degree)
    rays_o, rays_d = rays_at(field.aabb, 12)
    target, background, jitter = rng.random((12, 4)), rng.random((12, 3)), rng.random(12)

    def value(grads: np.ndarray) -> float:
        loss = np.zeros((len(grads), 3))
        batch = Batch(rays_o, rays_d, jitter, target, background, 0.3, 0.0, 0.02, 0.0)
        field.train_rays(batch, grads, loss)
        assert loss[:, 2].sum() > 100
        return float(loss[:, 0].sum() + 0.3 * loss[:, 1].sum()) / 12

    grads = np.zeros((2, field.size))
    value(grads)
    check_differences(field, lambda: value(np.zeros((2, field.size))), grads.sum(0), rng, rtol=2e-3)


def check_differences(field: SparseField, value, gradient: np.ndarray, rng, rtol: float = 1e-5) -> None:
    """Along random directions of the free numbers, hanging ones following."""
    free = np.zeros(field.size, bool)
    free[: ROW * field.fine.free] = True
    if field.coarse:
        free[field.bands_at : field.bands_at + field.shape.band_width * field.coarse.free] = True
    for _ in range(3):
        along = torch.from_numpy(np.where(free, rng.normal(size=field.size), 0))
        found = []
        for e in (1e-5, -2e-5, 1e-5):
            field.params += e * along
            field.settle()
            found.append(value())
        wanted = (found[0] - found[1]) / 2e-5
        assert wanted == pytest.approx(float(gradient[free] @ along.numpy()[free]), rel=rtol, abs=1e-6)


def test_the_loss_of_rays_is_that_of_their_pictures(rng):
    field = random_sparse()
    rays_o, rays_d = rays_at(field.aabb, 30)
    target, background = rng.random((30, 4)), rng.random((30, 3))
    loss = np.zeros((2, 3))
    grads = np.zeros((2, field.size))
    batch = Batch(rays_o, rays_d, np.full(30, 0.5), target, background, 0.3, 0.0, 0.02, 1e-3)
    field.train_rays(batch, grads, loss)
    found = render_rays(field, rays_o, rays_d, step=0.02, early_stop=1e-3).astype(float)
    error = found[:, :3] + (1 - found[:, 3:4]) * background - target[:, :3]
    assert loss[:, 0].sum() == pytest.approx((error**2).mean(1).sum(), rel=1e-4)
    assert loss[:, 1].sum() == pytest.approx(((found[:, 3] - target[:, 3]) ** 2).sum(), rel=1e-4)


def test_pictures_are_those_of_the_general_renderer():
    """Of one level, where a sample stands for one step, the same samples; of several, nearly."""
    for depth, close in ((0, 2e-3), (2, 0.05)):
        field = random_sparse(2, depth)
        rays_o, rays_d = rays_at(field.aabb, 200)
        step = 0.1 * field.voxel_size
        fast, slow = (render_rays(f, rays_o, rays_d, step=step) for f in (field, Slow(field)))
        np.testing.assert_allclose(fast[:, :4], slow[:, :4], atol=close)
        assert 0.2 < fast[:, 3].mean() < 0.999


def test_what_is_skipped_changes_no_picture():
    """With one occupied cell over everything, the samples of empty nodes alone are skipped."""
    field, whole = random_sparse(), random_sparse()
    whole.occupancy = type(field.occupancy).full(field.aabb)
    rays_o, rays_d = rays_at(field.aabb, 100)
    rays_d[:3] = np.eye(3)
    rays_o[:3] = field.aabb[:3] + 0.5 * field.tree.top - 2 * np.eye(3)
    fast, slow = (render_rays(f, rays_o, rays_d, step=0.011) for f in (field, whole))
    np.testing.assert_allclose(fast, slow, atol=1e-6)


@pytest.mark.parametrize("degree", [0, 2])
def test_stored_and_read_it_is_the_same(degree):
    field = random_sparse(degree, dtype=torch.float32)
    arrays, metadata = field.state()
    again = SparseField.from_state({k: a.copy() for k, a in arrays.items()}, metadata)
    assert torch.equal(again.params, field.params)
    np.testing.assert_array_equal(again.occupancy.occupied, field.occupancy.occupied)
    assert sum(a.size for a in arrays.values() if a.dtype.kind == "f") == field.numbers
    assert ("bands" in arrays) == (degree > 0)


@pytest.mark.parametrize("degree", [0, 2])
def test_a_field_that_was_stored_before_there_were_runs_is_read(degree):
    """Its rows lie in the order in which bricks need them."""
    field = random_sparse(degree, dtype=torch.float32)
    arrays, metadata = field.state()
    old = {name: a for name, a in arrays.items() if not name.endswith(".runs")}
    old |= {"rows": field.rows[: field.fine.free].numpy()}
    old |= {"bands": field.bands[: field.coarse.free].numpy()} if degree else {}
    del metadata["needs"], metadata["phase"]
    assert torch.equal(SparseField.from_state(old, metadata).params, field.params)


def test_what_does_not_fit_is_refused_by_name():
    arrays, metadata = random_sparse(2, dtype=torch.float32).state()
    for name in arrays:
        with pytest.raises(ValueError, match=name):
            SparseField.from_state({k: a for k, a in arrays.items() if k != name}, metadata)
        with pytest.raises(ValueError, match=name):
            SparseField.from_state(arrays | {name: arrays[name][:-1]}, metadata)
    for key, bad in (
        ("counts", [3, 2, 10**9]),
        ("counts", [2048, 2048, 2048]),
        ("counts", [3, 2]),
        ("counts", [3, 2.0, 3]),
        ("top", [0.6, 0.6, 0.0]),
        ("top", [0.6, 0.6, float("inf")]),
        ("top", [0.6, 0.6, "far"]),
        ("top", 0.6),
        ("phase", [0, 1]),
        ("phase", [0, 1, 2]),
        ("scale", -1.0),
        ("sh_degree", 4),
        ("sh_degree", True),
        ("aabb", [0, 0, 0, 1, 1, 1]),
    ):
        with pytest.raises(ValueError, match=key):
            SparseField.from_state(arrays, metadata | {key: bad})


def test_numbers_too_large_for_float32_are_refused():
    arrays, metadata = random_sparse(2, dtype=torch.float32).state()
    with pytest.raises(ValueError, match="rows"):
        SparseField.from_state(arrays | {"rows": arrays["rows"] + np.float32(3e38)}, metadata)


def test_a_step_of_adam_leaves_hanging_vertices_on_their_voxels(rng):
    field = random_sparse(2, dtype=torch.float32)
    optimiser = Adam.of(field)
    points = torch.from_numpy(points_in(field.aabb, 500))
    dirs = torch.from_numpy(unit(rng.normal(size=(500, 3))))
    before = field.params.clone()
    field.query_backward(points, dirs, torch.ones(500), torch.ones(500, 3), optimiser.grads)
    assert optimiser.sound()
    optimiser.step(0.1)
    assert (field.params != before).float().mean() > 0.1
    np.testing.assert_allclose(
        field.rows[field.fine.free :].numpy(),
        field.fine.spread @ field.rows[: field.fine.free].numpy(),
        atol=1e-5,
    )


def test_what_light_reaches():
    """In an even cube it falls with the exponential of the optical depth to the nearest face; what is opaque
    is seen from that face alone, unless a camera may be inside."""
    tree = BrickTree.of(
        [0, 0, 0], 1.0, (2, 2, 2), np.zeros(8, np.uint8), OCTANTS, np.ones((8, 4, 4, 4), bool)
    )
    field = SparseField(SparseShape(0), VertexLattice(tree, SIDE), 1.0)
    dirs = np.concatenate([np.eye(3), -np.eye(3)])
    low, high = (field.fine.positions[field.fine.corners[:, q]] for q in (0, 7))
    for sigma in (0.3, 30.0):
        field.rows[:, 0] = float(np.log(np.expm1(sigma)))
        clearest, facing = field.exposed(low, high, dirs, 10.0, 1e-9)
        away = np.minimum(low, 2 - high).min(1)
        np.testing.assert_allclose(clearest, np.exp(-sigma * away), rtol=0.3 if sigma < 1 else 5)
        outer = (low[:, 0] == 0) & (low[:, 1:] > 0.2).all(1) & (high[:, 1:] < 1.8).all(1)
        if sigma > 1:
            np.testing.assert_allclose(facing[outer], np.tile([1.0, 0, 0], (outer.sum(), 1)), atol=0.1)
    clearest, _ = field.exposed(low, high, dirs, 0.2, 1e-9)  # so near that a camera would be inside
    assert (clearest[away > 0.1] > np.exp(-30 * 0.5)).all()
    clearest, facing = field.exposed(low, high, dirs, 10.0, 0.5)
    assert (clearest[away > 0.1] == 0).all() and (facing[away > 0.1] == 0).all()


def test_bands_lie_on_a_lattice_of_wider_voxels():
    field = random_sparse()
    assert field.coarse.n == COARSE and field.coarse.free < 0.5 * field.fine.free
    assert field.numbers == 4 * field.fine.free + 24 * field.coarse.free
