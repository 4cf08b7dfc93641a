"""Fitting a field to pictures of a ball: quality, sameness, and the parts of the loop."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.distillation.depth_points import KnownPoints
from fusedrf_cli.engine.distillation.fit import FitRun, fit, occupancy_of
from fusedrf_cli.engine.distillation.ray_dataset import Pictures, RayDataset
from fusedrf_cli.engine.encodings.hash_runs import HashGrid
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, texels
from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.kinds.hash.field import HashConfig
from fusedrf_cli.engine.rendering.cameras import Camera, look_at, orbit, scattered
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image, render_rays
from fusedrf_cli.engine.settings import using
from tests.analytic.export import way_of
from tests.engine.conftest import BOX, THIRTY_TWO, Ball, random_vm

SETTINGS = TrainConfig(storage=way_of(THIRTY_TWO), longest=32, steps=200, samples=1 << 13)


def pictures(cameras) -> np.ndarray:
    """(n, H, W, 4) uint8 straight alpha pictures of a coloured ball."""
    ball = Ball(density=40.0, radius=0.7)
    views = [render_image(ball, camera, step=0.02) for camera in cameras]
    alpha = np.stack([v.opacity for v in views])[..., None]
    rgb = np.stack([v.rgb for v in views]) / np.maximum(alpha, 1e-6)
    return np.round(255 * np.clip(np.concatenate([rgb, alpha], -1), 0, 1)).astype(np.uint8)


@pytest.fixture(scope="module")
def capture():
    cameras = orbit(BOX, 5, 24, 24) + orbit(BOX, 3, 24, 24, elevation=-0.5)
    return cameras, pictures(cameras)


def test_a_ball_is_learnt(capture):
    """Eight pictures of 24 x 24 give views never seen at 24 dB, and the box is cut down to the ball."""
    told = []
    field = fit(*capture, BOX, SETTINGS, lambda share, figures: told.append((share, figures["psnr"])), "ball")
    unseen = scattered(BOX, 4, 24, 24, seed=3)
    white = pictures(unseen) / 255
    white = white[..., :3] * white[..., 3:] + 1 - white[..., 3:]
    seen = np.stack([render_image(field, camera).over((1, 1, 1)) for camera in unseen])
    assert psnr(seen, white) > 24
    assert field.name == "ball" and max(field.resolution) == 32
    assert np.prod(field.aabb[3:] - field.aabb[:3]) < 0.8 * np.prod(BOX[3:] - BOX[:3])
    assert 0.02 < field.occupancy.occupied.mean() < 0.9
    shares, quality = zip(*told, strict=True)
    assert list(shares) == sorted(shares) and quality[-1] > quality[0] + 5


def known_of(cameras: list[Camera], each: int = 30) -> KnownPoints:
    """Points of the ball's front, as each camera sees them."""
    points, rng = [], np.random.default_rng(0)
    for camera in cameras:
        aside = rng.normal(size=(each, 3))
        front = camera.camera_to_world[:3, 3] / np.linalg.norm(camera.camera_to_world[:3, 3]) + 0.3 * aside
        points.append(0.7 * front / np.linalg.norm(front, axis=1, keepdims=True))
    return KnownPoints(np.concatenate(points), np.repeat(np.arange(len(cameras)), each))


def test_known_points_bring_matter_to_where_it_is():
    """Four pictures from nearly one place hardly tell how far away a ball is: along rays that nothing was
    told of, the light of most ends half as far from where it should."""
    cameras = orbit(BOX, 60, 24, 24)[:4]
    images, off = pictures(cameras), []
    rays_o, rays_d = orbit(BOX, 60, 24, 24)[5].rays()
    true = render_rays(Ball(density=40.0, radius=0.7), rays_o, rays_d, step=0.02)
    met = true[:, 3] > 0.9
    for known in (None, known_of(cameras, 600)):
        field = FitRun.start(cameras, images, BOX, SETTINGS, known=known).finish()
        seen = render_rays(field, rays_o, rays_d, step=0.02)
        off.append(np.median(np.abs(seen[met, 4] / seen[met, 3] - true[met, 4] / true[met, 3])))
    assert off[1] < 0.6 * off[0]


def test_a_run_that_knows_points_goes_on_as_if_nothing_had_happened(capture):
    cameras, images = capture
    settings = replace(SETTINGS, steps=30)

    def begun() -> FitRun:
        return FitRun.start(cameras, images, BOX, settings, known=known_of(cameras))

    def taken(run: FitRun, steps: int) -> FitRun:
        for _ in range(steps):
            run.step(run.share())
        return run

    whole, half = taken(begun(), 8), taken(begun(), 4)
    arrays, state = half.checkpoint()
    again = begun()
    again.restore({name: array.copy() for name, array in arrays.items()}, json.loads(json.dumps(state)))
    assert torch.equal(taken(again, 4).field.params, whole.field.params)


def test_points_are_known_of_a_part_of_the_rays_in_the_first_half(capture):
    cameras, images = capture
    run = FitRun.start(cameras, images, BOX, SETTINGS, known=known_of(cameras, 400))
    run.rays = 1600
    rays_o, rays_d, pixels, _, depths = run.draw(0.2)
    assert len(rays_o) == len(rays_d) == len(pixels) == 1600 and len(depths) == 100
    surface = rays_o[:100] + depths[:, None] * rays_d[:100]
    assert np.linalg.norm(surface, axis=1) == pytest.approx(np.full(100, 0.7), abs=0.15)  # 1.5 pixels
    assert len(run.draw(0.6)[4]) == 0
    few = FitRun.start(cameras, images, BOX, SETTINGS, known=known_of(cameras, 40))
    few.rays = 1600
    assert len(few.draw(0.2)[4]) == 10  # 320 of them, each once in 32 steps


def test_the_rate_holds_and_then_falls_by_equal_factors():
    assert SETTINGS.decay(0) == SETTINGS.decay(SETTINGS.falls_from) == 1 and SETTINGS.decay(
        1
    ) == pytest.approx(SETTINGS.fall)
    late = [
        SETTINGS.decay(SETTINGS.falls_from + part * (1 - SETTINGS.falls_from))
        for part in (0.0, 0.25, 0.5, 0.75, 1.0)
    ]
    assert np.diff(np.log(late)) == pytest.approx([np.log(SETTINGS.fall) / 4] * 4)


@pytest.mark.parametrize("unbounded, factor", [(False, SETTINGS.fine_samples), (True, 1)])
def test_steps_take_more_samples_at_full_resolution_of_a_box(capture, unbounded, factor):
    """Rays of eight samples each are as many as make up what a step is to take."""
    run = FitRun.start(*capture, BOX, replace(SETTINGS, samples=1 << 14, unbounded=unbounded))

    def steered() -> int:
        for _ in range(200):
            run.learn(np.array([1.0, 0.0, 8.0 * 100]), 100, 1.0)
        return run.rays

    coarse = steered()
    assert coarse == pytest.approx((1 << 14) / 8 * (SETTINGS.unbounded_samples if unbounded else 1), rel=0.01)
    run.stages.clear()
    assert steered() == pytest.approx(factor * coarse, rel=0.01)


def test_a_detail_fades_where_photos_say_little_of_it(capture):
    """By the square of its numbers for each pixel, up to a most; a field without one by nothing, ever."""
    cameras, images = capture

    def faded(count: int, rows: int) -> float:
        storage = replace(SETTINGS.storage, hashed=HashGrid((0.1,), rows, learns_from=2) if rows else None)
        settings = replace(SETTINGS, storage=storage, unbounded=True)
        return FitRun.start(cameras[:count], images[:count], BOX, settings).faded

    assert faded(8, 1 << 10) == pytest.approx(SETTINGS.fade * (4 * 1024 / (8 * 24 * 24)) ** 2)
    assert faded(4, 1 << 10) == pytest.approx(4 * faded(8, 1 << 10))
    assert faded(1, 1 << 16) == SETTINGS.most_faded and faded(1, 0) == 0


@pytest.mark.slow
def test_a_hash_grid_ends_with_the_rows_that_say_most(capture):
    """What goes while it learns is made up for: views are as good as with all rows."""
    settings = replace(SETTINGS, kind="hash", storage=StorageSetting())
    unseen = scattered(BOX, 4, 24, 24, seed=3)
    white = pictures(unseen) / 255
    white = white[..., :3] * white[..., 3:] + 1 - white[..., 3:]
    shown, held = [], []
    for kept in (0.6, 1.0):
        with using(HashConfig(kept=kept)):
            field = fit(*capture, BOX, settings)
        seen = np.stack([render_image(field, camera).over((1, 1, 1)) for camera in unseen])
        shown.append(psnr(seen, white))
        held.append(float((field.sections()["density_rows"] != 0).any(1).double().mean()))
    assert 0.3 < held[0] <= 0.6 < held[1] and shown[0] > shown[1] - 0.5


def test_the_same_seed_gives_the_same_bits(capture):
    def numbers(seed):
        return fit(
            *capture,
            BOX,
            TrainConfig(storage=way_of(THIRTY_TWO), longest=24, steps=25, samples=1 << 12, seed=seed),
        ).params

    first, again, other = numbers(1), numbers(1), numbers(2)
    assert torch.equal(first, again)
    assert first.shape != other.shape or not torch.equal(first, other)


def test_every_pixel_comes_once_an_epoch(capture):
    cameras, images = capture
    numbered = images.copy()
    numbered.reshape(-1, 4)[:, 0] = np.arange(images[..., 0].size) % 251
    numbered.reshape(-1, 4)[:, 1] = np.arange(images[..., 0].size) // 251
    dataset = RayDataset(cameras, numbered, torch.Generator().manual_seed(0))
    size = images[..., 0].size
    drawn = [dataset.draw(size // 4) for _ in range(4)]
    found = np.concatenate([np.rint(pixels.numpy()[:, :2] * 255) for _, _, pixels, _ in drawn]) @ [1, 251]
    assert np.array_equal(np.sort(found), np.arange(size))
    everything = [camera.rays() for camera in cameras]
    for column in range(2):
        rays = np.concatenate([part[column] for part in drawn])
        wanted = np.concatenate([rays_of[column] for rays_of in everything])
        np.testing.assert_allclose(rays, wanted[found.astype(int)], atol=1e-6)


def test_more_rays_than_pixels_are_as_many_as_there_are(capture):
    cameras, images = capture
    dataset = RayDataset(cameras[:1], images[:1], torch.Generator().manual_seed(0))
    rays_o, rays_d, pixels, _ = dataset.draw(5000)
    assert rays_o.shape == rays_d.shape == (576, 3) and pixels.shape == (576, 4)
    np.testing.assert_allclose(rays_o, np.tile(cameras[0].camera_to_world[:3, 3], (576, 1)))


def test_pictures_of_several_sizes_and_pixels_that_are_ignored():
    """Every pixel that is not ignored comes once, with its own colour and its own camera's ray."""
    sizes = ((5, 4), (3, 7), (5, 4))
    cameras = [
        Camera(look_at(np.array([2.0 + i, 1, 1]), np.zeros(3), np.array([0.0, 0, 1])), 9, 8, w / 2, 2, w, h)
        for i, (w, h) in enumerate(sizes)
    ]
    count = sum(w * h for w, h in sizes)
    pixels = np.repeat(np.arange(count, dtype=np.uint8)[:, None], 4, 1)
    ignored = np.random.default_rng(0).random(count) < 0.4
    dataset = RayDataset(cameras, Pictures(pixels, ignored), torch.Generator().manual_seed(0))
    rays_o, rays_d, drawn, pictures = dataset.draw(1000)
    found = np.rint(drawn.numpy()[:, 0] * 255).astype(int)
    assert np.array_equal(np.sort(found), np.flatnonzero(~ignored))
    wanted_o, wanted_d = (np.concatenate(part) for part in zip(*[c.rays() for c in cameras], strict=True))
    np.testing.assert_allclose(rays_o, wanted_o[found])
    np.testing.assert_allclose(rays_d, wanted_d[found], atol=1e-6)
    assert np.array_equal(pictures, np.repeat(np.arange(3), [w * h for w, h in sizes])[found])


def test_texels_are_near_cubic_but_for_flat_boxes():
    assert texels(np.array([0.0, 0, 0, 1, 2, 4]), 64) == (16, 32, 64)
    assert texels(np.array([0.0, 0, 0, 1e-3, 2, 4]), 64) == (12, 32, 64)


def test_occupancy_finds_matter_and_forgets_nothing_known_empty():
    """All of a dense field is occupied; where the grid already said empty it stays so."""
    field = random_vm(THIRTY_TWO, dtype=torch.float32, scale=100.0)
    assert occupancy_of(field, cells=8).occupied.all()
    left = np.zeros((8, 8, 8), bool)
    left[:3] = True
    again = occupancy_of(field.with_occupancy(OccupancyGrid(BOX, left)), cells=8)
    assert not again.occupied[-2:].any() and again.occupied[:2].all()
    assert not occupancy_of(random_vm(THIRTY_TWO, dtype=torch.float32, scale=1e-6), cells=8).occupied.any()
