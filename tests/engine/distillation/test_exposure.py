"""Photos of different exposure: the gains that are found, and what is learnt under them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.exposure import CLIPPED, FEW, gains_of, spread
from fusedrf_cli.engine.distillation.fit import FINE_SAMPLES, FitRun
from fusedrf_cli.engine.distillation.pixels import Pictures, RayPool
from fusedrf_cli.engine.rendering.cameras import look_at, orbit
from fusedrf_cli.engine.rendering.metrics import psnr
from fusedrf_cli.engine.rendering.volume import render_image, render_rays
from tests.engine.conftest import BOX, Ball
from tests.engine.distillation.test_fit import SETTINGS

# Long enough for photos not to differ because the field is not done, and without colours that depend on the
# view, by which a dozen photos could all be as they are.
LONG = replace(SETTINGS, steps=800, way=replace(SETTINGS.way, sh_degree=0))
BALL = Ball(density=40.0, radius=0.7, tint=lambda points, dirs: 0.45 + 0.3 * np.sin(5 * points))


def gauged(gains: np.ndarray) -> np.ndarray:
    return gains / np.exp(np.log(gains).mean(0))


def looks(n: int, m: int, seed: int = 0):
    """m rays at the middle of the ball from each of n places, and what they show (n, m, 3)."""
    g = np.random.default_rng(seed)
    o = g.normal(size=(n, 1, 3))
    o = 3 * o / np.linalg.norm(o, axis=2, keepdims=True) + np.zeros((1, m, 1))
    d = BALL.centre + 0.25 * g.uniform(-1, 1, (n, m, 3)) - o
    rays = o.reshape(-1, 3), (d / np.linalg.norm(d, axis=2, keepdims=True)).reshape(-1, 3)
    found = render_rays(BALL, *rays)
    return rays, torch.from_numpy(found[:, :3] / found[:, 3:4]).reshape(n, m, 3)


def test_gains_are_those_that_the_colours_were_multiplied_by():
    rays, truth = looks(6, 200)
    gains = np.exp(np.random.default_rng(1).normal(0, 0.15, (6, 3)))
    found = gains_of(BALL, rays, 0.6 * truth * torch.from_numpy(gains)[:, None].float(), 0.0)
    np.testing.assert_allclose(found, gauged(gains), rtol=1e-5)
    np.testing.assert_allclose(np.log(found).mean(0), 0, atol=1e-12)
    assert spread(found) == pytest.approx(np.log(gauged(gains)).std(), rel=0.05)


def test_pixels_that_tell_nothing_do_not_count():
    """Ignored ones are nan, clipped ones would have been brighter; a photo with too few others has 1."""
    rays, truth = looks(3, 200)
    photos = (0.6 * truth).clone()
    photos[0] *= 1.2
    photos[0, ::3], photos[1, ::5] = torch.nan, CLIPPED + 0.01
    photos[2, FEW - 1 :] = torch.nan
    found = gains_of(BALL, rays, photos, 0.0)
    np.testing.assert_allclose(found, [[1.2**0.5] * 3, [1.2**-0.5] * 3, [1] * 3], rtol=1e-5)


def test_rays_that_show_what_lies_behind_do_not_count():
    rays, truth = looks(2, 200)
    photos = 0.6 * truth.clone()
    photos[1] *= 1.3
    away = rays[0], rays[1].copy()
    away[1][::2] *= -1
    photos.reshape(-1, 3)[::2] = 0.9
    np.testing.assert_allclose(gains_of(BALL, away, photos, 0.0)[1] ** 2, [1.3] * 3, rtol=1e-5)


def test_photos_of_the_pool_are_sampled_each_alike():
    """Rays and colours are those of the photos' own pixels; ignored and transparent ones are nan."""
    cameras = [*orbit(BOX, 2, 6, 4), *orbit(BOX, 1, 5, 5)]
    g = np.random.default_rng(0)
    pixels = np.concatenate([g.integers(0, 256, (24 * 2 + 25, 3)), np.full((73, 1), 255)], 1).astype(np.uint8)
    ignored = g.random(73) < 0.2
    pixels[:5, 3] = 254
    pool = RayPool(cameras, Pictures(pixels, ignored), torch.Generator())
    pool.gains[1] = torch.tensor([2.0, 1.0, 0.5])
    o, d, colours = pool.sample(50, torch.Generator().manual_seed(1))
    rays = [camera.rays() for camera in cameras]
    first = [0, 24, 48, 73]
    for i, gains in enumerate(pool.gains.numpy()):
        own = slice(first[i], first[i + 1])
        for k in range(50):
            at = np.flatnonzero(np.abs(rays[i][1] - d[i * 50 + k]).max(1) < 1e-6)
            assert len(at) == 1 and np.allclose(rays[i][0][at[0]], o[i * 50 + k])
            if ignored[own][at[0]] or pixels[own][at[0], 3] < 255:
                assert colours[i, k].isnan().all()
            else:
                np.testing.assert_allclose(colours[i, k], pixels[own][at[0], :3] / 255 / gains, rtol=1e-6)


def pictures(cameras) -> np.ndarray:
    """(n, H, W, 4) uint8 straight alpha pictures of a matt ball."""
    views = [render_image(BALL, camera, step=0.02) for camera in cameras]
    alpha = np.stack([v.opacity for v in views])[..., None]
    rgb = np.stack([v.rgb for v in views]) / np.maximum(alpha, 1e-6)
    return np.round(255 * np.clip(np.concatenate([rgb, alpha], -1), 0, 1)).astype(np.uint8)


def abreast(count: int, seed: int):
    """Cameras that see the ball from one side, and so show the same of it."""
    g = np.random.default_rng(seed)
    at = 3 * np.concatenate([np.ones((count, 1)), g.uniform(-0.4, 0.4, (count, 2))], 1)
    like = orbit(BOX, 1, 32, 32)[0]
    return [replace(like, camera_to_world=look_at(p, np.zeros(3), np.array([0.0, 0, 1]))) for p in at]


@pytest.fixture(scope="module")
def drifting():
    """Cameras before a ball, its pictures, and those as photos of drifting exposure and white balance."""
    cameras = abreast(24, 0)
    images = pictures(cameras)
    images[..., :3] = np.rint(images[..., :3] * 0.7)
    k = np.arange(len(cameras))[:, None] + np.array([0, 0.5, 1])
    gains = np.exp(0.5 * np.sin(2 * np.pi * k / 5))
    photos = images.copy()
    photos[..., :3] = np.rint(np.clip(images[..., :3] * gains[:, None, None], 0, 255))
    return cameras, images, photos, gauged(gains)


def run(cameras, photos, exposure: bool) -> FitRun:
    """A fit in a box, with as many samples at full resolution as a place, which alone has exposure, takes."""
    settings = replace(LONG, samples=LONG.samples // FINE_SAMPLES, exposure=exposure)
    fitting = FitRun.start(cameras, photos, BOX, settings)
    fitting.finish()
    return fitting


@pytest.mark.slow
def test_what_is_learnt_from_drifting_photos_is_neutral(drifting):
    """Gains are found that are nearer to the true ones than none, and of what unseen views lose by the drift
    most is regained."""
    cameras, images, photos, gains = drifting
    unseen = abreast(4, 1)
    truth = pictures(unseen) / 255
    wanted = 0.7 * truth[..., :3] * truth[..., 3:] + 1 - truth[..., 3:]
    reached = []
    for learnt, exposure in ((images, False), (photos, False), (photos, True)):
        fitting = run(cameras, learnt, exposure)
        seen = np.stack([render_image(fitting.field, c).over((1, 1, 1)) for c in unseen])
        reached.append(psnr(seen, wanted))
    assert spread(fitting.pool.gains.numpy() / gains) < 0.95 * spread(gains)
    even, drifted, mended = reached
    assert even - drifted > 1 and mended - drifted > 0.5 * (even - drifted)


def test_photos_that_do_not_differ_stay_as_they_are():
    cameras = abreast(12, 0)
    same = run(cameras, pictures(cameras), True)
    assert (same.pool.gains == 1).all()


def test_a_run_is_taken_up_with_its_gains(drifting):
    """Saved half way and taken up again it ends with the same bits."""
    cameras, _, photos, _ = drifting
    settings = replace(LONG, exposure=True, steps=300)
    whole = FitRun.start(cameras, photos, BOX, settings)
    whole.finish()
    assert (whole.pool.gains != 1).any()
    half = FitRun.start(cameras, photos, BOX, settings)
    while half.steps < settings.steps // 3:
        share = half.share()
        half.refresh(share)
        half.step(share)
    arrays, state = half.checkpoint()
    again = FitRun.start(cameras, photos, BOX, settings)
    again.restore({name: np.array(value) for name, value in arrays.items()}, state)
    again.finish()
    assert torch.equal(again.pool.gains, whole.pool.gains) and spread(whole.pool.gains.numpy()) > 0.05
    assert torch.equal(again.field.params, whole.field.params)
