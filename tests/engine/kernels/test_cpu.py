"""The compiled loops against the readable reference: values, gradients, marching, and the optimiser's
step."""

from types import SimpleNamespace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.fields.computed import Batch
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels import GridArrays, cpu, field_free, loops, reference
from fusedrf_cli.engine.kernels.loops import PointBatch, PointValues
from fusedrf_cli.engine.kernels.primitives import CLIPPED, LINE
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape
from fusedrf_cli.engine.rendering.volume import reach_of
from fusedrf_cli.engine.spaces import bounded
from tests.engine.conftest import (
    BOX,
    DIRECTIONS_26,
    SIXTY_FOUR,
    THIRTY_TWO,
    chord_of_box,
    points_in,
    random_vm,
    rays_at,
    unit,
)

MARCH = cpu.loops_for(None, (), bounded).march


def query(field: VMField, points: np.ndarray, dirs: np.ndarray, **options) -> tuple[np.ndarray, np.ndarray]:
    return tuple(a.numpy() for a in field.query(torch.from_numpy(points), torch.from_numpy(dirs), **options))


def expected(field: VMField, points: np.ndarray, dirs: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return tuple(
        a.numpy() for a in field.reference(field.params, torch.from_numpy(points), torch.from_numpy(dirs))
    )


# -- query ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("resolution", [(5, 8, 7), (2, 2, 2), (3, 17, 2)])
@pytest.mark.parametrize(
    "shape, dtype, error",
    [
        (SIXTY_FOUR, torch.float64, 1e-12),
        (THIRTY_TWO, torch.float32, 1e-5),
        (VMShape(8, 24, 0), torch.float32, 1e-5),
    ],
)
def test_query_is_the_reference(shape, dtype, error, resolution):
    field = random_vm(shape, resolution, dtype, cells=3)
    points = points_in(BOX, 500, margin=0.1)
    dirs = unit(np.random.default_rng(1).normal(size=(500, 3)))
    sigma, rgb = query(field, points, dirs)
    sigma_wanted, rgb_wanted = expected(field.with_params(field.params.double()), points, dirs)
    assert 0.1 < (sigma_wanted > 0).mean() < 0.5
    np.testing.assert_allclose(sigma, sigma_wanted, rtol=0, atol=error * sigma_wanted.max())
    np.testing.assert_allclose(rgb, rgb_wanted, rtol=0, atol=error * 3)


@pytest.mark.parametrize("count", [0, 1])
def test_query_of_few_points(count):
    field = random_vm()
    points, dirs = points_in(BOX, count), DIRECTIONS_26[:count]
    sigma, rgb = query(field, points, dirs)
    assert sigma.shape == (count,) and rgb.shape == (count, 3)
    np.testing.assert_allclose(sigma, expected(field, points, dirs)[0], rtol=1e-12)


@pytest.mark.parametrize("threads", [1, 2, 3, 7])
@pytest.mark.parametrize("count", [1, 20, 97])
def test_tasks_dealt_to_threads_are_all_done(count, threads):
    """Whatever the number of threads, of tasks and of items in the last one: each item once, none beyond."""
    field = random_vm(dtype=torch.float32)
    points, dirs = points_in(BOX, count), unit(np.random.default_rng(1).normal(size=(count, 3)))
    found = PointValues(np.full(count + 1, np.nan, np.float32), np.full((count + 1, 3), np.nan, np.float32))
    asked, run = PointBatch(points, dirs, True), field.loops._over("each", "query_point")
    run(field.arrays, field.grid, asked, count, 10, threads, found)
    sigma, rgb = query(field, points, dirs)
    assert np.array_equal(found.sigma[:count], sigma) and np.array_equal(found.rgb[:count], rgb)
    assert np.isnan(found.sigma[count]) and np.isnan(found.rgb[count]).all()


def test_box_is_half_open():
    field = random_vm()
    centre = (BOX[:3] + BOX[3:]) / 2
    lower, upper = np.tile(centre, (3, 1)), np.tile(centre, (3, 1))
    lower[range(3), range(3)], upper[range(3), range(3)] = BOX[:3], BOX[3:]
    beneath, below = np.minimum(upper, BOX[3:] - 1e-9), np.maximum(lower, BOX[:3])
    below[range(3), range(3)] -= 1e-9
    sigma, rgb = query(field, np.concatenate([lower, beneath, upper, below]), DIRECTIONS_26[:12].copy())
    assert (sigma[:6] > 0).all() and (rgb[:6] > 0).all()
    assert (sigma[6:] == 0).all() and (rgb[6:] == 0).all()


def test_query_on_texels_reads_them():
    """At a texel the feature is the plain sum over ranks and modes, without interpolation."""
    field = random_vm(resolution=(4, 3, 5))
    s, voxel = field.sections(), (BOX[3:] - BOX[:3]) / (np.array(field.resolution) - 1)
    index = np.array([(1, 1, 2), (0, 0, 0), (2, 1, 3)])
    points = BOX[:3] + index * voxel + 1e-13
    sigma, _ = query(field, points, DIRECTIONS_26[:3].copy(), with_colour=False)
    for (i, j, k), found in zip(index, sigma, strict=True):
        feature = (s["density_plane_0"][i, j] * s["density_line_0"][k]).sum()
        feature += (s["density_plane_1"][i, k] * s["density_line_1"][j]).sum()
        feature += (s["density_plane_2"][j, k] * s["density_line_2"][i]).sum()
        assert found == pytest.approx(field.scale * np.log1p(np.exp(float(feature) + field.shift)), rel=1e-9)


def test_extreme_densities_are_finite():
    field = random_vm(scale=1.0, shift=0.0)
    for factor in (30.0, -30.0):
        sections = field.sections()
        for name, view in sections.items():
            view.fill_(1.0 if "line" in name else factor)
        sigma, rgb = query(field, points_in(BOX, 50), unit(points_in(BOX, 50)))
        assert np.isfinite(sigma).all() and np.isfinite(rgb).all()
        wanted = 3 * 8 * factor if factor > 0 else 0.0
        np.testing.assert_allclose(sigma, wanted, rtol=1e-12, atol=1e-300)


# -- gradients -----------------------------------------------------------------------------------------------


def backward(field, points, dirs, d_sigma, d_rgb, parts: int = 3) -> np.ndarray:
    grads = np.zeros((parts, field.params.numel()), field.arrays.params.dtype)
    field.query_backward(*map(torch.from_numpy, (points, dirs, d_sigma, d_rgb)), grads)
    return grads.sum(0)


def test_query_backward_is_autograd():
    field = random_vm(cells=4)
    points, dirs = points_in(BOX, 80, margin=0.05), unit(np.random.default_rng(1).normal(size=(80, 3)))
    rng = np.random.default_rng(2)
    d_sigma, d_rgb = rng.normal(size=80), rng.normal(size=(80, 3))
    found = backward(field, points, dirs, d_sigma, d_rgb)
    params = field.params.clone().requires_grad_()
    outputs = field.reference(params, torch.from_numpy(points), torch.from_numpy(dirs))
    torch.autograd.backward(outputs, (torch.from_numpy(d_sigma), torch.from_numpy(d_rgb)))
    np.testing.assert_allclose(found, params.grad.numpy(), rtol=1e-10, atol=1e-12)


def test_query_backward_of_no_and_one_point():
    field = random_vm()
    for count in (0, 1):
        points, dirs = points_in(BOX, count), DIRECTIONS_26[:count].copy()
        grads = backward(field, points, dirs, np.ones(count), np.ones((count, 3)))
        assert (grads != 0).any() == bool(count)


def train(
    field, rays_o, rays_d, step, early_stop=0.0, near=0.0, parts=2, opacity_weight=0.3, seed=0, **more
):  # fmt: skip
    """train_rays with random targets, backgrounds and jitter: (target, background, jitter, gradients (P,),
    loss (3,))."""
    n, rng = len(rays_o), np.random.default_rng(seed)
    real = field.arrays.params.dtype
    target, background = rng.random((n, 4)).astype(real), rng.random((n, 3)).astype(real)
    jitter = rng.random(n)
    grads, loss = np.zeros((parts, field.params.numel()), real), np.zeros((parts, 3))
    batch = Batch(rays_o, rays_d, jitter, target, background, opacity_weight, near, step, early_stop, **more)
    field.train_rays(batch, grads, loss)
    return target, background, jitter, grads.sum(0), loss.sum(0)


def reference_loss(
    field, rays_o, rays_d, step, target, background, jitter, early_stop=0.0, opacity_weight=0.3
):
    """The loss that train_rays differentiates: (total, sums of the colour and the opacity term), by the
    reference."""
    out = reference.render_rays(
        field, torch.from_numpy(rays_o), torch.from_numpy(rays_d), 0.0, step, early_stop,
        torch.from_numpy(jitter), (loops.COLOUR_FROM, None),
    )  # fmt: skip
    target, background = torch.from_numpy(target), torch.from_numpy(background)
    shown = out[:, :3] + (1 - out[:, 3:4]) * background
    colour = ((shown - target[:, :3]) ** 2).mean(1).sum()
    opacity = ((out[:, 3] - target[:, 3]) ** 2).sum()
    return (colour + opacity_weight * opacity) / len(rays_o), float(colour.detach()), float(opacity.detach())


@pytest.mark.parametrize("early_stop, scale", [(0.0, 3.0), (1e-2, 20.0)])
def test_train_rays_is_autograd(early_stop, scale):
    field = random_vm(cells=5, scale=scale)
    rays_o, rays_d = rays_at(BOX, 30)
    target, background, jitter, grads, loss = train(field, rays_o, rays_d, 0.05, early_stop)
    params = field.params.clone().requires_grad_()
    same = field.with_params(params)
    total, colour, opacity = reference_loss(
        same, rays_o, rays_d, 0.05, target, background, jitter, early_stop
    )
    total.backward()
    np.testing.assert_allclose(loss[:2], [colour, opacity], rtol=1e-10)
    # The reference takes the derivative of 1 - exp, the kernel of its logarithm; both see every sample the
    # same.
    np.testing.assert_allclose(grads, params.grad.numpy(), rtol=1e-7, atol=1e-11)


def test_train_rays_of_photos_of_their_own_exposure_is_autograd():
    """Gains, offsets and weights of each ray; colours that a photo cannot show are as far off as it can tell;
    the sum of errors is that of the photos."""
    field = random_vm(cells=5)
    rays_o, rays_d = rays_at(BOX, 60)
    rng = np.random.default_rng(4)
    exposure = rng.uniform([[0.3], [-0.3], [0.2]], [[2.0], [0.3], [3.0]], (60, 3, 3))
    target, background, jitter, grads, loss = train(field, rays_o, rays_d, 0.05, exposure=exposure)
    params = field.params.clone().requires_grad_()
    out = reference.render_rays(
        field.with_params(params), torch.from_numpy(rays_o), torch.from_numpy(rays_d), 0.0, 0.05, 0.0,
        torch.from_numpy(jitter), (loops.COLOUR_FROM, None),
    )  # fmt: skip
    gain, offset, weight = torch.from_numpy(exposure).unbind(1)
    wanted, behind = torch.from_numpy(target), torch.from_numpy(background)
    shown = gain * (out[:, :3] + (1 - out[:, 3:4]) * behind) + offset
    truth = wanted[:, :3]
    square = torch.where((truth >= CLIPPED) & (shown > truth), 0.0, shown - truth) ** 2
    assert (square == 0).any()
    opacity = ((out[:, 3] - wanted[:, 3]) ** 2).sum()
    (((weight * square).mean(1).sum() + 0.3 * opacity) / 60).backward()
    sums = [float(part.detach()) for part in (square.mean(1).sum(), opacity)]
    np.testing.assert_allclose(loss[:2], sums, rtol=1e-10)
    np.testing.assert_allclose(grads, params.grad.numpy(), rtol=1e-7, atol=1e-11)


@pytest.mark.parametrize("scale", [3.0, 20.0])
def test_light_samples_that_are_followed_by_chance_send_back_the_gradient_in_the_mean(scale):
    """Over chances that fill [0, 1) evenly, which are the last digits of the jitter; none by itself does."""
    field, count, chances = random_vm(cells=5, scale=scale), 8, 500
    rays = [np.repeat(part, chances, axis=0) for part in rays_at(BOX, count)]
    rng = np.random.default_rng(5)
    target, background = (np.repeat(rng.random((count, n)), chances, axis=0) for n in (4, 3))
    whole = np.repeat(rng.integers(1 << 20, size=count), chances)
    jitter = (whole + np.tile((np.arange(chances) + 0.5) / chances, count)) / (1 << 20)

    def gradient(light: float, which: slice = slice(None)) -> tuple[np.ndarray, np.ndarray]:
        grads, loss = np.zeros((2, field.params.numel())), np.zeros((2, 3))
        taken = [part[which] for part in (*rays, jitter, target, background)]
        field.train_rays(Batch(*taken, 0.3, 0.0, 0.05, 0.0, 0.01, light), grads, loss)
        return grads.sum(0), loss.sum(0)

    (wanted, loss), (found, same) = gradient(0.0), gradient(0.1)
    np.testing.assert_allclose(same, loss, rtol=1e-12)
    most = np.abs(wanted).max()
    assert np.abs(found - wanted).max() < 0.004 * most
    alone = [gradient(light, slice(None, None, chances))[0] for light in (0.0, 0.1)]
    assert np.abs(alone[1] - alone[0]).max() > 0.05 * np.abs(alone[0]).max()


def test_train_rays_of_float32_is_close_to_float64():
    field = random_vm(THIRTY_TWO, dtype=torch.float32, cells=5)
    rays_o, rays_d = rays_at(BOX, 30)
    target, background, jitter, grads, _ = train(field, rays_o, rays_d, 0.05)
    params = field.params.double().requires_grad_()
    target, background = target.astype(float), background.astype(float)
    total, *_ = reference_loss(field.with_params(params), rays_o, rays_d, 0.05, target, background, jitter)
    total.backward()
    np.testing.assert_allclose(grads, params.grad.numpy(), rtol=0, atol=2e-5 * float(params.grad.abs().max()))


def test_rays_that_meet_nothing_teach_nothing():
    field = random_vm()
    rays_o, rays_d = rays_at(BOX, 5)
    target, background, _, grads, loss = train(field, rays_o, -rays_d, 0.05)
    assert (grads == 0).all() and loss[2] == 0
    assert loss[0] == pytest.approx(((background - target[:, :3]) ** 2).mean(1).sum())
    assert loss[1] == pytest.approx((target[:, 3] ** 2).sum())


def test_parts_only_split_the_work():
    field = random_vm()
    rays_o, rays_d = rays_at(BOX, 11)
    *_, one, loss = train(field, rays_o, rays_d, 0.05, parts=1)
    *_, many, losses = train(field, rays_o, rays_d, 0.05, parts=16)
    np.testing.assert_allclose(one, many, rtol=1e-9, atol=1e-14)
    np.testing.assert_allclose(loss, losses, rtol=1e-12)


# -- rendering -----------------------------------------------------------------------------------------------


def render(field, rays_o, rays_d, near=0.0, far=np.inf, step=0.05, early_stop=0.0, grid=None) -> np.ndarray:
    out = np.full((len(rays_o), 5), np.nan)
    if grid is not None:
        field.grid = grid
    field.render_rays(rays_o, rays_d, reach_of(len(rays_o), near, far), step, early_stop, out)
    return out


@pytest.mark.parametrize("cells", [None, 5])
@pytest.mark.parametrize("early_stop", [0.0, 0.05])
def test_render_is_the_reference(cells, early_stop):
    field = random_vm(cells=cells)
    rays_o, rays_d = rays_at(BOX, 60)
    rays_o[:10] = points_in(BOX, 10)  # from inside
    rays_d[10:36], rays_o[10:36] = DIRECTIONS_26, points_in(BOX, 26, 3)
    rays_d[36:40] *= -1  # and some that miss
    found = render(field, rays_o, rays_d, early_stop=early_stop)
    rays = torch.from_numpy(rays_o), torch.from_numpy(rays_d)
    cuts = dict(early_stop=early_stop, lending=(loops.COLOUR_FROM, loops.SHARED_COLOUR_FROM))
    wanted = reference.render_rays(field, *rays, 0.0, 0.05, **cuts).numpy()
    assert (wanted[36:40] == 0).all() and (wanted[:36, 3] > 0.01).mean() > 0.3
    np.testing.assert_allclose(found, wanted, rtol=1e-9, atol=1e-12)


def test_near_cuts_what_lies_before():
    field = random_vm()
    rays_o, rays_d = rays_at(BOX, 20)
    later = render(field, rays_o + 3.1 * rays_d, rays_d)
    cut = render(field, rays_o, rays_d, near=3.1)
    np.testing.assert_allclose(cut[:, :4], later[:, :4], rtol=1e-6, atol=1e-9)


# -- marching ------------------------------------------------------------------------------------------------


def march(grid: GridArrays, rays_o, rays_d, step, near=0.0, jitter=0.5, wave=1000) -> list[np.ndarray]:
    """Every ray's sample distances, gathered in waves."""
    n = len(rays_o)
    start, alive, reach = np.zeros(n, np.int64), np.ones(n, bool), reach_of(n, near, np.inf)
    found = [[] for _ in range(n)]
    while (start >= 0).any():
        ts, counts = np.zeros((n, wave)), np.zeros(n, np.int64)
        MARCH(
            grid, rays_o, rays_d, reach, np.full(n, jitter), step, start, alive, ts, np.zeros_like(ts), counts
        )
        for i in range(n):
            found[i].append(ts[i, : counts[i]])
    return [np.concatenate(parts) for parts in found]


def stepping(grid: GridArrays, skip: int) -> GridArrays:
    """The grid with leaps of at most so many cells; with 0 every cell counts as occupied."""
    return GridArrays(np.minimum(grid.skip, skip), grid.lo, grid.hi, grid.cell)


def random_grid(rng, share=0.08) -> OccupancyGrid:
    shape = rng.integers(2, 14, 3)
    cell, lo = rng.choice([0.1, 0.05, 1 / 3, 0.25]), rng.choice([-1, 0, 0.1, -0.7], 3)
    return OccupancyGrid(np.concatenate([lo, lo + shape * cell]), rng.random(shape) < share)


def cells_of(grid: OccupancyGrid, points: np.ndarray) -> np.ndarray:
    """(N, 3) real-valued cell coordinates."""
    return (points - grid.aabb[:3]) / grid.cell


@pytest.mark.parametrize("seed", range(20))
def test_march_visits_the_lattice_samples_of_occupied_cells(seed):
    rng = np.random.default_rng(seed)
    grid = random_grid(rng)
    rays_o, rays_d = rays_at(grid.aabb, 30, seed)
    rays_o[:8] = points_in(grid.aabb, 8, seed)
    step = 0.31 * grid.cell.min()
    leaping, all_samples = (
        march(grid.arrays, rays_o, rays_d, step),
        march(stepping(grid.arrays, 0), rays_o, rays_d, step),
    )
    chords = chord_of_box(grid.aabb[:3], grid.aabb[3:], rays_o, rays_d)
    for o, d, found, ts, chord in zip(rays_o, rays_d, leaping, all_samples, chords, strict=True):
        assert len(ts) in (round(chord / step), int(chord / step), int(chord / step) + 1)
        np.testing.assert_allclose(np.diff(ts), step, rtol=1e-6)
        index = np.clip(cells_of(grid, o + ts[:, None] * d).astype(int), 0, np.array(grid.occupied.shape) - 1)
        assert np.array_equal(found, ts[grid.occupied[tuple(index.T)]])


@pytest.mark.parametrize("seed", range(20))
def test_leaps_skip_no_sample_on_a_face(seed):
    """Axis-parallel rays whose samples fall on faces of cells, where rounding decides: leaps and single cells
    agree to the bit."""
    rng = np.random.default_rng(seed)
    grid = random_grid(rng)
    n, cell = 64, grid.cell
    rays_d = np.repeat(DIRECTIONS_26[np.abs(DIRECTIONS_26).max(1) == 1], n, 0)
    start = rng.integers(0, grid.occupied.shape, (len(rays_d), 3)) + rng.choice(
        [0.0, 0.25, 0.5], (len(rays_d), 3)
    )
    rays_o = grid.aabb[:3] + start * cell - rays_d * cell * rng.integers(0, 20, (len(rays_d), 1))
    for parts in (2, 3, 4, 10):
        for jitter in (0.0, 0.5):
            leaping, creeping = (
                march(stepping(grid.arrays, most), rays_o, rays_d, cell.min() / parts, jitter=jitter)
                for most in (255, 1)
            )
            assert all(np.array_equal(a, b) for a, b in zip(leaping, creeping, strict=True))


def test_directions_from_points_on_faces():
    """Half open like the cells: from the lower face inward rays see the box, along it too; along the upper
    face nothing."""
    grid = OccupancyGrid.full(np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]), 4)
    for axis in range(3):
        for side in (0.0, 1.0):
            origin = np.full((26, 3), 0.4)
            origin[:, axis] = side
            wanted = chord_of_box(np.zeros(3), np.ones(3), origin, DIRECTIONS_26)
            found = march(grid.arrays, origin, DIRECTIONS_26, 1e-3, wave=3000)
            np.testing.assert_allclose([len(ts) * 1e-3 for ts in found], wanted, atol=1.01e-3)
            assert all((ts > 0).all() for ts in found)


@pytest.mark.parametrize("wave", [1, 7, 32])
def test_waves_of_any_length_take_the_same_samples(wave):
    grid = random_grid(np.random.default_rng(3), share=0.3)
    rays_o, rays_d = rays_at(grid.aabb, 20)
    step = 0.3 * grid.cell.min()
    whole, pieces = (
        march(grid.arrays, rays_o, rays_d, step),
        march(grid.arrays, rays_o, rays_d, step, wave=wave),
    )
    for a, b in zip(whole, pieces, strict=True):
        assert np.array_equal(a, b) and len(np.unique(a)) == len(a)


def test_dead_rays_rest():
    grid = OccupancyGrid.full(BOX)
    rays_o, rays_d = rays_at(BOX, 4)
    places, counts, start = np.zeros((2, 4, 5)), np.ones(4, np.int64), np.zeros(4, np.int64)
    alive, reach = np.array([True, False, True, False]), reach_of(4, 0.0, np.inf)
    MARCH(grid.arrays, rays_o, rays_d, reach, np.full(4, 0.5), 0.1, start, alive, *places, counts)
    assert counts.tolist() == [5, 0, 5, 0] and start.tolist() == [5, 0, 5, 0]


@pytest.mark.parametrize("occupied", [False, True])
def test_an_empty_and_a_full_grid(occupied):
    grid = OccupancyGrid(BOX, np.full((3, 4, 5), occupied))
    rays_o, rays_d = rays_at(BOX, 10)
    counts = [len(ts) for ts in march(grid.arrays, rays_o, rays_d, 0.05)]
    chords = chord_of_box(BOX[:3], BOX[3:], rays_o, rays_d)
    np.testing.assert_allclose(counts, occupied * chords / 0.05, atol=1)


def test_skipping_leaves_every_bit_of_the_image():
    field = random_vm(cells=9)
    rays_o, rays_d = rays_at(BOX, 200)
    rays_d[:26], rays_o[:26] = DIRECTIONS_26, points_in(BOX, 26) - 2 * DIRECTIONS_26
    whole = render(field, rays_o, rays_d, step=0.03)
    creeping = render(field, rays_o, rays_d, step=0.03, grid=stepping(field.grid, 1))
    assert (whole == creeping).all() and whole[:, 3].max() > 0.5


# -- peaks of cells ----------------------------------------------------------------------------------------


def test_peaks_are_the_largest_of_the_probes():
    field = random_vm(cells=6)
    grid = OccupancyGrid.full(BOX, 5)
    cells, offsets = np.argwhere(grid.occupied), np.array([[0.25, 0.25, 0.25], [0.75, 0.5, 0.1]])
    out = field.peaks(BOX[:3], grid.cell, cells, offsets)
    whole, dirs = field.with_occupancy(grid), np.tile([0.0, 0.0, 1.0], (len(cells), 1))
    wanted = [expected(whole, BOX[:3] + (cells + offset) * grid.cell, dirs)[0] for offset in offsets]
    np.testing.assert_allclose(out, np.max(wanted, 0), rtol=1e-6)


# -- Adam ----------------------------------------------------------------------------------------------------


def adam(params, gradients, rate=0.1, beta1=0.9, beta2=0.99, eps=1e-8, parts=3) -> SimpleNamespace:
    """Steps of the kernel, each gradient split into parts at random."""
    size = len(params)
    run = SimpleNamespace(
        params=params.copy(),
        moment1=np.zeros(size if beta1 else 0, np.float32),
        moment2=np.zeros(size, np.float32),
    )
    run.grads = np.zeros((parts, size), np.float32)
    rng = np.random.default_rng(0)
    f = np.float32
    for step, gradient in enumerate(gradients, 1):
        share = rng.dirichlet(np.ones(parts), size).T
        run.grads[:] = share * gradient
        cpu.adam(
            run.params, run.grads, run.moment1, run.moment2, f(rate), 0, size, f(beta1), f(beta2), f(eps),
            f(1 / (1 - beta1**step)), f(1 / (1 - beta2**step)),
        )  # fmt: skip
        assert (run.grads == 0).all()
    return run


@pytest.mark.parametrize("beta1", [0.9, 0.0])
def test_adam_is_torchs_where_every_entry_is_touched(rng, beta1):
    start = rng.normal(size=160).astype(np.float32)
    gradients = rng.normal(size=(25, 160)) * 10.0 ** rng.integers(-6, 3, 160)
    found = adam(start, gradients, beta1=beta1)
    parameter = torch.from_numpy(start.astype(float)).requires_grad_()
    optimiser = torch.optim.Adam([parameter], lr=0.1, betas=(beta1, 0.99), eps=1e-8)
    for gradient in gradients:
        parameter.grad = torch.from_numpy(gradient)
        optimiser.step()
    np.testing.assert_allclose(found.params, parameter.detach().numpy(), rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("beta1", [0.9, 0.0])
def test_adam_leaves_untouched_entries_alone(rng, beta1):
    """No gradient, no change: neither entry nor moments, in a line of its own or beside touched ones."""
    start = rng.normal(size=64).astype(np.float32)
    first, second = rng.normal(size=64) + 5, np.zeros(64)
    second[40] = 2.0
    before, after = adam(start, [first], beta1=beta1), adam(start, [first, second], beta1=beta1)
    same = np.arange(64) != 40
    for name in ("params", *["moment1"] * (beta1 > 0), "moment2"):
        assert (getattr(before, name)[same] == getattr(after, name)[same]).all()
        assert getattr(before, name)[40] != getattr(after, name)[40]


def test_adam_of_a_slice_stays_in_it(rng):
    size, f = 96, np.float32
    params, grads = np.zeros(size, np.float32), np.ones((2, size), np.float32)
    moment1, moment2 = np.zeros(size, np.float32), np.zeros(size, np.float32)
    cpu.adam(params, grads, moment1, moment2, f(0.5), 32, 64, f(0.9), f(0.99), f(1e-15), f(10), f(100))
    inside = (np.arange(size) >= 32) & (np.arange(size) < 64)
    np.testing.assert_allclose(params, np.where(inside, -0.5, 0), rtol=1e-5)
    assert (grads[:, inside] == 0).all() and (grads[:, ~inside] == 1).all()


@pytest.mark.parametrize("listed", [False, True])
def test_adam_takes_the_touched_lines_of_many_tasks_and_no_others(rng, listed):
    """By the formula in float64, of all lines or of a list of them; what is not listed keeps its gradient."""
    lines, f = 3 * field_free.LINES_PER_TASK + 5, np.float32
    size = lines * LINE
    sent = rng.random((2, lines, LINE)) * (rng.random((2, lines, 1)) < 0.15)
    sent[rng.random(sent.shape) < 0.3] = 0
    asked = rng.random(lines) < (0.6 if listed else 1.1)
    params, moment1, moment2 = (rng.random(size).astype(f) + f(0.5) for _ in range(3))
    grads = sent.reshape(2, size).astype(f)
    gradient = (grads[0] + grads[1]).astype(float)
    moved = np.repeat(asked, LINE) & (gradient != 0)
    m, v = 0.9 * moment1 + 0.1 * gradient, 0.99 * moment2 + 0.01 * gradient**2
    wanted = np.where(moved, params - 0.5 * 10 * m / (np.sqrt(100 * v) + 1e-15), params)
    rest = f(0.9), f(0.99), f(1e-15), f(10), f(100)
    kept = np.where(np.repeat(asked, LINE), 0, grads)
    moments = np.where(moved, m, moment1), np.where(moved, v, moment2)
    if listed:
        starts = LINE * np.flatnonzero(asked)
        cpu.adam_lines(params, grads, moment1, moment2, f(0.5), starts, *rest)
    else:
        cpu.adam(params, grads, moment1, moment2, f(0.5), 0, size, *rest)
    np.testing.assert_allclose(params, wanted, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose((moment1, moment2), moments, rtol=1e-5)
    assert (params[~moved] == wanted[~moved].astype(f)).all() and (grads == kept).all()
    assert 0.1 < moved.mean() < 0.3
