"""Unbounded space: its map, its rays, and what a field in it shows, against closed forms."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import as_composite
from fusedrf_cli.engine.distillation.camera_visibility import shown_cells
from fusedrf_cli.engine.fields.computed import Batch
from fusedrf_cli.engine.fields.differentiable import query
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, OccupancyGrid
from fusedrf_cli.engine.kernels.learning import DEPTH_TOLERANCE
from fusedrf_cli.engine.kernels.specialise import specialised
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.kinds.vm.field import VMField
from fusedrf_cli.engine.rendering.cameras import Camera, look_at
from fusedrf_cli.engine.rendering.volume import march_rays, reach_of, render_rays
from fusedrf_cli.engine.spaces import bounded, space_named, unbounded
from fusedrf_cli.engine.spaces.unbounded import FAR, PIECES, WHOLE
from tests.analytic.export import vm_field as exported
from tests.analytic.export import way_of
from tests.analytic.fields import Gaussian
from tests.analytic.rays import affine, unit

from ..conftest import SIXTY_FOUR, random_vm

WAY = way_of(SIXTY_FOUR)  # of places too, so that blocks of them and of objects need no loops of their own
GRID = OccupancyGrid.full(WHOLE, space=unbounded)
SPACE = specialised(None, {}, unbounded)[1]


def rays(count: int):
    """Rays of all kinds: from near and far, along axes and diagonals, through edges and corners."""
    rng = np.random.default_rng(0)
    for i in range(count):
        o, d = rng.normal(size=3) * 10 ** rng.uniform(-1, 1.5), rng.normal(size=3)
        if i % 5 == 0:
            d[rng.integers(3)] = 0
        if i % 7 == 0:
            o, d = np.round(o), np.round(2 * d)
        if d.any():
            yield o, d / np.linalg.norm(d)


def pieces(o, d, near=0.0, far=np.inf):
    """The pieces of a ray that hold anything, in order."""
    found = [SPACE["piece"](k, GRID.arrays, tuple(o), tuple(d), near, far) for k in range(PIECES)]
    return [piece for piece in found if piece[3] > piece[2]]


def mapped(x: np.ndarray) -> np.ndarray:
    """The map of a point as it is written in the paper."""
    size = np.abs(x)
    if size.max() <= 1:
        return x
    out = x / size.max()
    axis = int(size.argmax())
    out[axis] = (2 - 1 / size[axis]) * np.sign(x[axis])
    return out


def test_pieces_are_straight_and_follow_each_other_out_to_the_end():
    for o, d in rays(1500):
        end, found = 0.0, pieces(o, d)
        assert len(found) <= 5
        for q, way, u0, u1, course in found:
            start = SPACE["distance"](course, u0)
            assert start == pytest.approx(end, rel=1e-9, abs=1e-9)
            for share in (0.01, 0.3, 0.77, 0.99):
                u = u0 + share * (u1 - u0)
                x = o + SPACE["distance"](course, u) * d
                assert np.array(q) + u * np.array(way) == pytest.approx(mapped(x), abs=1e-9)
            end = SPACE["distance"](course, u1)
        if found:
            assert np.abs(o + end * d).max() == pytest.approx(FAR, rel=1e-6)


def test_pieces_between_two_distances_are_what_lies_between_them():
    for o, d in rays(500):
        whole = [(SPACE["distance"](c, u0), SPACE["distance"](c, u1)) for _, _, u0, u1, c in pieces(o, d)]
        for near, far in ((0.3, 2.0), (0.0, 0.7), (1.1, 40.0), (3.0, 3.0)):
            part = pieces(o, d, near, far)
            found = [(SPACE["distance"](c, u0), SPACE["distance"](c, u1)) for _, _, u0, u1, c in part]
            wanted = [(max(a, near), min(b, far)) for a, b in whole if min(b, far) > max(a, near) + 1e-9]
            found = [(a, b) for a, b in found if b > a + 1e-9]
            assert np.ravel(found) == pytest.approx(np.ravel(wanted), rel=1e-7, abs=1e-9)


@pytest.mark.parametrize("share", [0.3, 1e-4])
def test_a_span_is_a_difference_of_distances(share):
    for o, d in rays(300):
        for _, _, u0, u1, course in pieces(o, d):
            u, e = (u0 + u1) / 2, share * (u1 - u0)
            moved = SPACE["distance"](course, u + e / 2) - SPACE["distance"](course, u - e / 2)
            assert SPACE["span"](course, u, e) == pytest.approx(moved, rel=1e-6, abs=1e-8)


def test_a_length_and_its_distance_are_inverses_and_an_interval_is_a_span():
    for names, pieces_of in ((SPACE, pieces), (specialised(None, {}, bounded)[1], in_box)):
        for o, d in rays(300):
            for _, _, u0, u1, course in pieces_of(o, d):
                for u in u0 + (u1 - u0) * np.array([1e-6, 0.3, 0.98]):
                    t = names["distance"](course, u)
                    assert names["length_at"](course, t) == pytest.approx(u, rel=1e-7, abs=1e-9)
                    low, high = names["interval"](course, u, 0.1)
                    assert high - low == pytest.approx(names["span"](course, u, 0.1), rel=1e-6, abs=1e-9)
                    assert low <= t * (1 + 1e-9) and t <= high * (1 + 1e-9)


def in_box(o, d) -> list[tuple]:
    """The piece of a ray in a box, where it meets that."""
    grid = OccupancyGrid.full(np.array([-1.0, -2, -1, 1, 1, 1]))
    found = specialised(None, {}, bounded)[1]["piece"](0, grid.arrays, tuple(o), tuple(d), 0.0, np.inf)
    return [found] if found[3] > found[2] else []


@pytest.mark.parametrize("step", [0.31, 0.01])
def test_spans_of_the_samples_of_a_piece_make_up_all_of_it(step):
    for o, d in rays(300):
        for _, _, u0, u1, course in pieces(o, d):
            samples = np.arange(u0 + step / 2, u1, step)
            if len(samples):
                spans = [SPACE["span"](course, float(u), step) for u in samples]
                length = SPACE["distance"](course, u1) - SPACE["distance"](course, u0)
                assert sum(spans) == pytest.approx(length, rel=1e-9)


@pytest.mark.parametrize("voxel", [0.5, 4 / 335, 1 / 90, 1e-3])
def test_pictures_go_through_a_slab_by_whole_steps(voxel):
    step = unbounded.picture_step(voxel)
    assert (1 / step) % 1 == pytest.approx(0, abs=1e-9)
    assert 0.9 * voxel / (1 + 0.9 * voxel) < step < 0.9 * voxel * (1 + 1e-9)


@pytest.mark.parametrize("radius", [0.5, 1.0, 10.0, 100.0, 900.0])
def test_the_map_has_an_inverse_in_every_form(radius):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(200, 3))
    points *= radius / np.abs(points).max(1, keepdims=True)
    inside = np.array([mapped(x) for x in points])
    assert np.array([SPACE["point"](tuple(x)) for x in points]) == pytest.approx(inside)
    assert unbounded.contract(torch.from_numpy(points)).numpy() == pytest.approx(inside)
    assert np.array([SPACE["frame_point"](tuple(y)) for y in inside]) == pytest.approx(points, rel=1e-9)
    assert unbounded.inv_contract(torch.from_numpy(inside)).numpy() == pytest.approx(points, rel=1e-9)


def even(sigma: float, resolution: int = 64) -> VMField:
    """A field whose numbers say one density everywhere, in float64, grey: sigma / n² per length."""
    plan = registry.kind("vm").plan_at(WHOLE, (resolution,) * 3, WAY)
    field = registry.kind("vm").create(plan, torch.Generator().manual_seed(0)).with_occupancy(GRID)
    field.shift = float(np.log(np.expm1(sigma / field.scale)))
    return field.with_params(torch.zeros_like(field.params, dtype=torch.float64))


@pytest.mark.parametrize("cells", [115, 127, 128])
def test_fog_is_as_thick_as_its_formula_says(cells):
    """Fog, thinner by n² far out, that ends at n = 2.5, 32 or FAR: with τ the integral of σ / n(t)² along a
    ray that leaves the core by its +x face, the opacity is 1 - exp(-τ), and the depth the mean of t by
    exp(-τ) dτ."""
    sigma, shown = 0.6, np.zeros((128,) * 3, bool)
    shown[:cells] = True
    o, d = np.array([0.1, 0.2, -0.3]), np.array([1.0, 0.3, -0.2])
    d /= np.linalg.norm(d)
    field = even(sigma).with_occupancy(OccupancyGrid(WHOLE, shown, unbounded))
    out = render_rays(field, o[None], d[None], step=1e-3, early_stop=0.0)[0]
    edge = min(cells / 32 - 2, 2 - 1 / FAR)
    y = np.linspace(o[0], edge, 400_001)  # of the mapped x: dτ = σ dy / d_x in the core and outside
    x = np.where(y < 1, y, 1 / (2 - np.maximum(y, 1)))
    depth = sigma * (y - y[0]) / d[0]
    assert out[3] == pytest.approx(-np.expm1(-depth[-1]), abs=1e-3)
    t = (x - o[0]) / d[0]
    assert out[4] == pytest.approx(np.trapezoid(t * np.exp(-depth), depth), rel=0.02)


def random_field(seed: int = 0, box: np.ndarray = WHOLE, share: float = 0.7) -> VMField:
    """A small random field over all of space or a box (6,) of its coordinates, in float64, of which a share
    of the cells is occupied."""
    generator = torch.Generator().manual_seed(seed)
    kind = registry.kind("vm")
    field = kind.create(kind.plan_at(box, (9, 9, 9), WAY), generator)
    occupied = np.random.default_rng(seed).random((8, 8, 8)) < share
    numbers = torch.randn(len(field.params), generator=generator, dtype=torch.float64)
    field = field.with_occupancy(OccupancyGrid(box, occupied, unbounded)).with_params(0.5 * numbers)
    field.shift = -4.0  # dense enough to see
    return field


@pytest.mark.parametrize("share", [0.7, 0.03])  # of cells; the one pass jumps over the others
def test_waves_and_the_one_pass_show_the_same(share):
    field = random_field(share=share)
    field.basis.mul_(0.5)  # for colours as far apart as those of trained fields
    o = np.array([o for o, _ in rays(200)])
    d = np.array([d for _, d in rays(200)])
    out = np.zeros((len(o), 5), np.float32)
    march_rays(field, o, d, reach_of(len(o), 0.0, np.inf), 0.02, 1e-3, out)
    whole = render_rays(field, o, d, step=0.02)
    assert whole[:, 3].max() > 0.3
    # up to LENT_FROM of the light is shown in another sample's colour
    assert out[:, :3] == pytest.approx(whole[:, :3], abs=5e-3)
    assert out[:, 3] == pytest.approx(whole[:, 3], abs=2e-3)
    assert out[:, 4] == pytest.approx(whole[:, 4], rel=2e-2, abs=1e-3)


def test_gradients_reach_numbers_far_out():
    """The gradient of a training step against differences, for rays that end in every slab."""
    field = random_field()
    rng = np.random.default_rng(3)
    d = rng.normal(size=(12, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, jitter = rng.normal(size=(12, 3)), rng.random(12)
    target, behind = rng.random((12, 4)), rng.random((12, 3))
    batch = Batch(o, d, jitter, target, behind, 0.1, 0.0, 0.05, 0.0)

    def loss(params: torch.Tensor) -> float:
        sums = np.zeros((1, 3))
        field.with_params(params).train_rays(batch, np.zeros((1, len(params))), sums)
        return float(sums[0, 0] + 0.1 * sums[0, 1]) / 12

    grads = np.zeros((1, len(field.params)))
    field.train_rays(batch, grads, np.zeros((1, 3)))
    moved = np.argsort(-abs(grads[0]))[:200:20]
    for at in moved:
        step = torch.zeros_like(field.params)
        step[at] = 1e-5
        slope = (loss(field.params + step) - loss(field.params - step)) / 2e-5
        # colours of weights below the loops' threshold are left out: a jump where one passes it
        assert grads[0, at] == pytest.approx(slope, rel=2e-2, abs=1e-6)


def weights_along(field: VMField, o: np.ndarray, d: np.ndarray, jitter: np.ndarray, step: float):
    """(t, weights, lengths) of all samples of each ray, by the rule of volume rendering as it is written."""
    ts, spans, counts = *np.zeros((2, len(o), 4000)), np.zeros(len(o), np.int64)
    start, alive = np.zeros(len(o), np.int64), np.ones(len(o), bool)
    reach = reach_of(len(o), 0, np.inf)
    SPACE["march"](field.occupancy.arrays, o, d, reach, jitter, step, start, alive, ts, spans, counts)
    assert (start < 0).all()
    for i in range(len(o)):
        t, lengths = ts[i, : counts[i]], spans[i, : counts[i]]
        points = torch.from_numpy(o[i] + t[:, None] * d[i])
        sigma, _ = field.query(points, torch.from_numpy(np.tile(d[i], (len(t), 1))), False)
        depth = sigma.numpy() * lengths
        yield t, np.exp(-(np.cumsum(depth) - depth)) * -np.expm1(-depth), lengths


def distortion(field: VMField, *rays) -> float:
    """The mean over rays of Σ_ij w_i w_j |s_i - s_j| + ⅓ Σ_i w_i² δ_i, as it is written (Mip-NeRF 360, eq.
    15)."""
    found = []
    for t, weights, lengths in weights_along(field, *rays):
        s = t / (1 + t)
        own = (weights**2 * lengths * (1 - s) ** 2).sum() / 3
        found.append((weights[:, None] * weights * abs(s[:, None] - s)).sum() + own)
    return np.mean(found)


def depth_error(field: VMField, depths: np.ndarray, *rays) -> float:
    """The sum over the first rays, whose depths are known, of the light that ends elsewhere or nowhere, over
    the number of all rays."""
    found = 0.0
    for depth, (t, weights, _) in zip(depths, weights_along(field, *rays), strict=False):
        away = abs(t / depth - 1)
        far = np.interp(away, [0, DEPTH_TOLERANCE, 2 * DEPTH_TOLERANCE], [0, 0, 1])
        found += (weights * far).sum() + 1 - weights.sum()
    return found / len(rays[0])


def some_rays(count: int, seed: int) -> tuple:
    """Origins, directions and jitter of rays all over the core, and the length of a step."""
    rng = np.random.default_rng(seed)
    d = rng.normal(size=(count, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return rng.normal(size=(count, 3)), d, rng.random(count), 0.05


@pytest.mark.parametrize("term", ["distortion", "depths"])
def test_a_loss_of_weights_sends_back_its_own_gradient(term):
    field, rays = random_field(4), some_rays(6, 5)
    o, d, jitter, step = rays
    # where light ends anyway, and where it does not; the last two rays show what nobody knows
    ends = [(t * weights).sum() / weights.sum() for t, weights, _ in weights_along(field, *rays)]
    depths = np.array(ends[:4]) * [1, 1.3, 1, 0.5]
    weight = 0.7
    with_it = (weight,) if term == "distortion" else (0.0, 0.0, weight, depths)
    gradients = []
    for extra in ((), with_it):
        batch = Batch(o, d, jitter, np.zeros((6, 4)), np.zeros((6, 3)), 0.0, 0.0, step, -1.0, *extra)
        grads = np.zeros((1, len(field.params)))
        field.train_rays(batch, grads, np.zeros((1, 3)))
        gradients.append(grads[0])
    found = (gradients[1] - gradients[0]) / weight

    def wanted(params: torch.Tensor) -> float:
        moved = field.with_params(params)
        return distortion(moved, *rays) if term == "distortion" else depth_error(moved, depths, *rays)

    for at in np.argsort(-abs(found))[:40:8]:
        change = torch.zeros_like(field.params)
        change[at] = 1e-5
        slope = (wanted(field.params + change) - wanted(field.params - change)) / 2e-5
        assert found[at] == pytest.approx(slope, rel=1e-5, abs=1e-10)


def test_rays_of_known_depth_do_not_count_for_the_error_of_colours():
    field, (o, d, jitter, step) = random_field(4), some_rays(6, 5)
    target = np.random.default_rng(1).random((6, 4))

    def error(part: slice, *extra) -> np.ndarray:
        loss = np.zeros((1, 3))
        asked = o[part], d[part], jitter[part], target[part], np.zeros((6, 3))[part]
        batch = Batch(*asked, 0.1, 0.0, step, -1.0, *extra)
        field.train_rays(batch, np.zeros((1, len(field.params))), loss)
        return loss[0]

    known = error(slice(0, 6), 0.0, 0.0, 0.05, np.ones(2))
    assert known[0] == pytest.approx(error(slice(2, 6))[0])
    assert known[1:] == pytest.approx(error(slice(0, 6))[1:])


def test_the_largest_weight_of_each_cell():
    """Against the weights of every sample of every ray, cell by cell."""
    field = random_field(6)
    rng = np.random.default_rng(7)
    d = rng.normal(size=(20, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    o, jitter, grid = rng.normal(size=(20, 3)), rng.random(20), field.occupancy
    wanted = np.zeros(grid.occupied.shape)
    ts, spans, counts = *np.zeros((2, 20, 4000)), np.zeros(20, np.int64)
    start = np.zeros(20, np.int64)
    reach, alive = reach_of(20, 0.1, np.inf), np.ones(20, bool)
    SPACE["march"](grid.arrays, o, d, reach, jitter, 0.05, start, alive, ts, spans, counts)
    for i in range(20):
        trans = 1.0
        for t, length in zip(ts[i, : counts[i]], spans[i, : counts[i]], strict=True):
            if trans <= 1e-3:
                break
            x = o[i] + t * d[i]
            sigma, _ = field.query(torch.from_numpy(x[None]), torch.from_numpy(d[i : i + 1]), False)
            weight = trans * -np.expm1(-float(sigma) * length)
            trans -= weight
            cell = tuple(np.clip(((mapped(x) - WHOLE[:3]) / grid.cell).astype(int), 0, 7))
            wanted[cell] = max(wanted[cell], weight)
    assert wanted.max() > 0.1
    assert field.weights_in_cells(o, d, jitter, 0.1, 0.05) == pytest.approx(wanted, abs=1e-5)


def test_cells_that_no_camera_sees_are_left_out():
    pose = look_at(np.array([2.5, 0, 0]), np.zeros(3), np.array([0.0, 0, 1]))
    camera = Camera(pose, 50, 50, 25, 25, 50, 50)
    grid = shown_cells([camera], 0.8, [0.8])
    seen = np.array([[0.0, 0, 0], [-50.0, 3, 2], [1.5, 0.2, 0]])  # the focus, behind it, before it
    unseen = np.array([[5.0, 0, 0], [0.0, 0, 40], [2.45, 0, 0], [-1.0, 5, 0]])
    assert grid.contains(np.array([mapped(x) for x in seen])).all()
    assert not grid.contains(np.array([mapped(x) for x in unseen])).any()


def test_what_lies_before_all_that_a_photo_shows_is_empty():
    """Two cameras that face each other: each would show what is right before the other. A cell of the core is
    0.06 wide."""
    poses = [look_at(np.array([x, 0, 0]), np.zeros(3), np.array([0.0, 0, 1])) for x in (0.9, -0.9)]
    cameras = [Camera(pose, 50, 50, 25, 25, 50, 50) for pose in poses]
    without, grid = (shown_cells(cameras, 0.05, clear) for clear in ([0.0, 0.0], [0.8, 0.0]))
    at = np.stack(np.meshgrid(*[np.linspace(-0.99, 0.99, 45)] * 3, indexing="ij"), -1).reshape(-1, 3)
    lost = without.contains(at) & ~grid.contains(at)
    depth = 0.9 - at[:, 0]
    across = abs(at[:, 1:]).max(1)
    away = np.linalg.norm(at - [0.9, 0, 0], axis=1)
    half = 0.5 * 0.0625  # of a cell: its middle is in the picture
    assert lost.any() and (away[lost] < 0.8).all()
    assert (across[lost] < 0.5 * (depth[lost] + half) + half).all()
    sure = (away < 0.8 - 0.11) & (depth > half) & (across < 0.5 * (depth - half) - half)
    assert sure.sum() > 50 and not grid.contains(at[sure]).any()


@pytest.mark.parametrize("fisheye", (False, True))
def test_around_a_camera_is_nothing(fisheye):
    """Nor behind it, where other cameras would show it."""
    poses = [look_at(np.array(x), np.zeros(3), np.array([0.0, 0, 1])) for x in ([0.4, 0.2, 0], [1.8, 0.2, 0])]
    cameras = [Camera(pose, 20, 20, 25, 25, 50, 50, fisheye=fisheye) for pose in poses]
    grid = shown_cells(cameras, 0.3, [0.0, 0.0])
    away = np.random.default_rng(0).normal(size=(200, 3))
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    assert not grid.contains(np.array([0.4, 0.2, 0]) + 0.18 * away).any()  # 0.3 less a cell's diagonal
    assert grid.contains(np.array([0.4, 0.2, 0]) + 0.36 * away).all()


def test_a_field_over_a_part_of_space_is_empty_elsewhere():
    """Photos that look one way are learnt in a box of the coordinates: the compiled answers are the
    reference's."""
    box = np.array([-2.0, -1.0, -2.0, 1.5, 2.0, 1.0])
    part = random_field(3, box)
    rng = np.random.default_rng(2)
    points = torch.from_numpy(rng.normal(size=(400, 3)) * np.exp(rng.normal(size=(400, 1))))
    dirs = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(400, 3))), dim=1)
    sigma, rgb = part.query(points, dirs)
    same, told = part.answers(part.params, points, dirs)
    at = np.array([mapped(x) for x in points.numpy()])
    assert not sigma[~((at >= box[:3]) & (at <= box[3:])).all(1)].any() and (sigma > 0).sum() > 100
    assert same.numpy() == pytest.approx(sigma.numpy(), rel=1e-6, abs=1e-9)
    assert told.numpy() == pytest.approx(rgb.numpy(), abs=1e-6)


def test_a_place_is_sampled_alike_whatever_stands_in_it(in_force):
    """Past objects with voxels of two sizes it shows the same, sample for sample: between two lattices noise
    of sampling would differ."""
    in_force(OccupancyConfig(scene_cells=8))  # no smaller than the place's voxels
    place, thing = random_field(1), random_vm(dtype=torch.float64, cells=4)
    d = unit(np.random.default_rng(0).normal(size=(200, 3)))
    o = np.array([-0.3, -0.2, 0.1]) + 0.3 * d
    pictures = []
    for size in (0.3, 0.06):
        small = Placed("thing", thing, affine(np.eye(3) * size, (0.9, 0.8, 0.9)))
        scene = ComposedField([Placed("place", place, np.eye(4)), small])
        pictures.append([render_rays(field, o, d) for field in (scene, as_composite(scene))])
    for one, other in zip(*pictures, strict=True):
        assert (abs(one - other).max(1) < 1e-6).mean() > 0.6
        assert (one[:, 3] > 0.3).mean() > 0.5


def test_only_what_is_near_an_object_is_sampled_as_finely_as_it(in_force):
    """By the naive composition, which shows about what a finer step everywhere does."""
    in_force(OccupancyConfig(scene_cells=24))
    place, thing = random_field(1), random_vm(dtype=torch.float64, cells=4)
    small = Placed("thing", thing, affine(np.eye(3) * 0.1, (0.2, 0.1, 0)))
    scene = ComposedField([Placed("place", place, np.eye(4)), small])
    grid = scene.occupancy
    strides = grid.stride[grid.occupied]
    assert strides.max() > 5 * strides.min() and (strides < 2 * strides.min()).mean() < 0.1
    d = unit(np.random.default_rng(0).normal(size=(64, 3)))
    o = np.array([0.2, 0.1, 0]) - 0.5 * d
    shown, fine = render_rays(scene, o, d)[:, :4], render_rays(scene, o, d, step=grid.unit / 2)[:, :4]
    assert abs(shown - fine).mean() < 1e-3


@pytest.mark.parametrize("scale", [0.2, 0.08])
def test_no_sample_of_a_coarse_place_steps_over_a_fine_object(scale):
    """In thin fog with voxels of fifteen cells: a picture is the one with a sample at every step."""
    fog = even(0.002, 12)
    gaussian = Gaussian(60.0, (0, 0, 0), aabb=0.9 * np.array([-1.0, -1, -1, 1, 1, 1]))
    ball = exported(gaussian, shape=SIXTY_FOUR, dtype=torch.float64)
    matrix = affine(scale, (0.31, 0.17, 0.05))
    scene = ComposedField([Placed("fog", fog, np.eye(4)), Placed("ball", ball, matrix)])
    rng = np.random.default_rng(0)
    d = unit(rng.normal(size=(300, 3)))
    o = matrix[:3, 3] + 0.4 * scale * rng.normal(size=(300, 3)) - 1.2 * d
    assert scene.occupancy.stride.max() > 1
    every = ComposedField(scene.placed)
    every.__dict__["occupancy"] = replace(scene.occupancy, stride=None)
    wanted = render_rays(every, o, d)
    assert wanted[:, 3].max() > 0.9
    assert render_rays(scene, o, d)[:, :4] == pytest.approx(wanted[:, :4], abs=0.01)
    alone = [ComposedField([one], origin=np.zeros(3)) for one in scene.placed]
    passed = [1 - render_rays(as_composite(field), o, d)[:, 3] for field in alone]
    found = render_rays(as_composite(scene), o, d)[:, 3]  # each by its own step, so what alone they let pass
    assert found == pytest.approx(1 - passed[0] * passed[1], abs=0.01)


def test_gradients_in_points_cross_no_border_wrongly():
    """In each region, far from its borders: differences of the compiled answer against the reference's
    gradient."""
    field = random_field().with_occupancy(GRID)
    points = torch.tensor([[0.3, 0.2, -0.4], [7.0, 2.0, -3.0], [-2.0, 90.0, 30.0], [4.0, -5.0, -700.0]])
    points = points.double().requires_grad_()
    dirs = torch.nn.functional.normalize(torch.ones(4, 3, dtype=torch.float64), dim=1)
    sigma, rgb = query(field, points, dirs)
    (found,) = torch.autograd.grad((sigma.sum() + rgb.sum()), points)
    for i in range(4):
        for axis in range(3):
            step = torch.zeros(4, 3, dtype=torch.float64)
            step[i, axis] = 1e-5 * float(points[i].detach().abs().max())
            answers = [field.query(points.detach() + s, dirs) for s in (step, -step)]
            slope = sum(float(a.sum() - b.sum()) for a, b in zip(*answers, strict=True))
            assert found[i, axis] == pytest.approx(slope / (2 * float(step[i, axis])), rel=1e-4, abs=1e-9)


every_kind = pytest.mark.parametrize("kind", [n for n in registry.names() if registry.kind(n).trains])
AFAR = torch.tensor([[30.0, -4.0, 2.0], [0.3, 0.2, -0.1], [1.5, 8.0, -900.0]]).double()
UP = torch.tensor([[0.0, 0.0, 1.0]]).double().expand(3, 3)


def stored_and_read(kind: str):
    """A field of all of space as a bundle gives it back."""
    made = registry.kind(kind)
    field = made.create(made.untrained(WHOLE, 16, StorageSetting()), torch.Generator().manual_seed(0))
    field = field.with_occupancy(OccupancyGrid.full(WHOLE, 4, unbounded))
    return type(field).from_state(*field.state())


@every_kind
def test_every_kind_keeps_its_space(kind):
    made, back = registry.kind(kind), stored_and_read(kind)
    assert back.space is unbounded and back.occupancy.space is unbounded
    assert made.grown(back, made.untrained(WHOLE, 20, StorageSetting())).space is unbounded
    assert (back.answers(back.params, AFAR, UP)[0] > 0).all()


@pytest.mark.slow
@every_kind
def test_the_loops_of_every_kind_know_the_space(kind):
    field = stored_and_read(kind)
    wanted = field.answers(field.params.double(), AFAR, UP)
    for found, other in zip(field.query(AFAR, UP.contiguous()), wanted, strict=True):
        torch.testing.assert_close(found.double(), other.double(), rtol=1e-3, atol=1e-4)


def test_a_space_of_another_name_is_refused():
    with pytest.raises(ValueError, match="space should be one of bounded, unbounded, .*, found 'round'"):
        space_named("round")
