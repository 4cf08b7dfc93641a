"""Photos of different exposure: the gains that are found, and what is learnt under them."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.distillation.exposure import (
    ExposureConfig,
    fitted,
    gauged,
    identity,
    matched,
    measured,
    undone,
)
from fusedrf_cli.engine.distillation.fit import FitRun
from fusedrf_cli.engine.distillation.poses import poses_of
from fusedrf_cli.engine.distillation.ray_dataset import Pictures, RayDataset
from fusedrf_cli.engine.rendering.cameras import look_at, orbit
from fusedrf_cli.engine.rendering.metrics import colour_corrected, psnr
from fusedrf_cli.engine.rendering.volume import render_image, render_rays
from tests.engine.conftest import BOX, Ball
from tests.engine.distillation.test_fit import SETTINGS

# Long enough for photos not to differ because the field is not done, and without colours that depend on the
# view, by which a dozen photos could all be as they are.
LONG = replace(SETTINGS, steps=800, storage=replace(SETTINGS.storage, sh_degree=0))
BALL = Ball(density=40.0, radius=0.7, tint=lambda points, dirs: 0.45 + 0.3 * np.sin(5 * points))


def looks(n: int, m: int, seed: int = 0):
    """m rays at the middle of the ball from each of n places, and what they show (n, m, 3)."""
    g = np.random.default_rng(seed)
    o = g.normal(size=(n, 1, 3))
    o = 3 * o / np.linalg.norm(o, axis=2, keepdims=True) + np.zeros((1, m, 1))
    d = BALL.centre + 0.25 * g.uniform(-1, 1, (n, m, 3)) - o
    rays = o.reshape(-1, 3), (d / np.linalg.norm(d, axis=2, keepdims=True)).reshape(-1, 3)
    found = render_rays(BALL, *rays)
    return rays, torch.from_numpy(found[:, :3] / found[:, 3:4]).reshape(n, m, 3)


def as_photos(truth: torch.Tensor, gain: np.ndarray, offset: np.ndarray) -> torch.Tensor:
    """(n, m, 3) what photos by gains and offsets (n, 3) show of colours, cut off where photos are."""
    shown = truth.double() * torch.from_numpy(gain)[:, None] + torch.from_numpy(offset)[:, None]
    return shown.clamp(0, 1)


def somebodys(n: int, seed: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Gains and offsets of n photos."""
    random = np.random.default_rng(seed)
    return np.exp(random.normal(0, 0.4, (n, 3))), random.uniform(-0.05, 0.1, (n, 3))


def test_maps_are_those_that_photos_were_made_by():
    """But for what an offset's weight takes from it; whatever the colours that the field has come to."""
    rays, truth = looks(8, 400)
    gain, offset = somebodys(8)
    photos, wanted = as_photos(truth, gain, offset), gauged(gain, offset, identity(len(gain)))
    for maps in (measured(BALL, rays, photos, 0.0, None), fitted(0.5 * truth.double() + 0.05, photos)):
        np.testing.assert_allclose(maps[:, 0], wanted[:, 0], rtol=0.15)
        np.testing.assert_allclose(np.log(maps[:, 0]).mean(0), 0, atol=1e-12)
        np.testing.assert_allclose(maps[:, 1].mean(0), 0, atol=1e-12)
    np.testing.assert_allclose(measured(BALL, rays, photos, 0.0, None)[:, 1], wanted[:, 1], atol=0.06)


def test_another_gauge_of_the_colours_shows_the_same():
    gain, offset = somebodys(6)
    maps = gauged(gain, offset, identity(len(gain)))
    scale, shift = gain / maps[:, 0], None
    np.testing.assert_allclose(scale, scale[:1].repeat(6, 0))
    shift = (offset - maps[:, 1]) / maps[:, 0]  # the other colours are scale * colour + shift
    np.testing.assert_allclose(shift, shift[:1].repeat(6, 0), atol=1e-12)


def test_pixels_that_tell_nothing_do_not_count():
    """Ignored ones are nan, clipped ones tell a bound, something in front is far off; a photo with too few
    others is as it is."""
    rays, truth = looks(4, 400)
    truth = truth.double() / truth.max()
    gain, offset = np.array([[1.2] * 3, [0.6] * 3, [1.0] * 3, [0.7] * 3]), np.zeros((4, 3))
    photos = as_photos(truth, gain, offset)
    assert (photos[0] == 1).double().mean() > 0.2
    photos[1, ::3] = torch.nan
    photos[2, ExposureConfig.few - 1 :] = torch.nan
    photos[3, ::7] = 0.0
    maps = fitted(truth, photos)
    np.testing.assert_allclose(maps[:2, 0] / maps[2, 0], gain[:2], rtol=0.06)
    np.testing.assert_allclose(maps[3, 0] / maps[2, 0], gain[3], rtol=0.06)


def test_rays_that_show_what_lies_behind_do_not_count():
    rays, truth = looks(2, 200)
    photos = 0.6 * truth.double()
    photos[1] *= 1.3
    away = rays[0], rays[1].copy()
    away[1][::2] *= -1
    photos.reshape(-1, 3)[::2] = 0.9
    maps = measured(BALL, away, photos, 0.0, None)
    np.testing.assert_allclose(maps[1, 0] / maps[0, 0], [1.3] * 3, rtol=1e-2)


def test_what_is_off_by_more_than_others_counts_less():
    """A photo in grey among colours, and one of little light, which is off by as little."""
    _, truth = looks(6, 300)
    photos = truth.double() + torch.from_numpy(np.random.default_rng(2).normal(0, 0.01, truth.shape))
    photos[0] *= 0.2
    photos[1] = photos[1].mean(-1, keepdim=True)
    maps = fitted(truth.double(), photos)
    counts = maps[:, 2] * maps[:, 0] ** 2  # of an error in the field's colours
    assert (counts[0] > 0.3).all() and (counts[1] < 0.1).all() and (counts <= 1).all()


def test_photos_side_by_side_tell_whether_they_are_many_peoples():
    """Alike are neighbours, however much photos from elsewhere differ; matched, all are alike."""
    cameras = orbit(BOX, 16, 8, 8)
    colours = torch.from_numpy(np.random.default_rng(0).uniform(0.1, 0.6, (1, 50, 3)))
    turn = torch.linspace(0, 2 * np.pi, 17)[:16].double()
    slow = colours * torch.exp(0.4 * torch.sin(turn))[:, None, None]
    assert matched(slow, poses_of(cameras)) is None
    gain, offset = somebodys(16)
    photos = as_photos(colours, gain, offset)
    photos[0, ::3] = torch.nan
    maps = matched(photos, poses_of(cameras))
    alike = undone(maps, photos)
    np.testing.assert_allclose(alike[1:].mean(1), alike[1:2].mean(1).expand(15, 3), atol=1e-9)
    np.testing.assert_allclose(alike[1:].std(1), alike[1:2].std(1).expand(15, 3), atol=1e-9)


def test_photos_of_the_pool_are_sampled_each_alike():
    """Rays and colours are those of the photos' own pixels; ignored and transparent ones are nan."""
    cameras = [*orbit(BOX, 2, 6, 4), *orbit(BOX, 1, 5, 5)]
    g = np.random.default_rng(0)
    pixels = np.concatenate([g.integers(0, 256, (24 * 2 + 25, 3)), np.full((73, 1), 255)], 1).astype(np.uint8)
    ignored = g.random(73) < 0.2
    pixels[:5, 3] = 254
    dataset = RayDataset(cameras, Pictures(pixels, ignored), torch.Generator())
    o, d, colours = dataset.sample(50, torch.Generator().manual_seed(1))
    rays = [camera.rays() for camera in cameras]
    first = [0, 24, 48, 73]
    for i in range(3):
        own = slice(first[i], first[i + 1])
        for k in range(50):
            at = np.flatnonzero(np.abs(rays[i][1] - d[i * 50 + k]).max(1) < 1e-6)
            assert len(at) == 1 and np.allclose(rays[i][0][at[0]], o[i * 50 + k])
            if ignored[own][at[0]] or pixels[own][at[0], 3] < 255:
                assert colours[i, k].isnan().all()
            else:
                np.testing.assert_allclose(colours[i, k], pixels[own][at[0], :3] / 255, rtol=1e-6)


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
    return cameras, images, photos, gains / np.exp(np.log(gains).mean(0))


def spread(gains: np.ndarray) -> float:
    """Root mean square of the logarithms of gains."""
    return float(np.sqrt((np.log(gains) ** 2).mean()))


def run(cameras, photos, exposure: bool, steps: int = LONG.steps) -> FitRun:
    """A fit in a box, with as many samples at full resolution as a place, which alone has exposure, takes."""
    settings = replace(LONG, samples=LONG.samples // LONG.fine_samples, exposure=exposure, steps=steps)
    fitting = FitRun.start(cameras, photos, BOX, settings)
    fitting.finish()
    return fitting


@pytest.mark.slow
def test_what_is_learnt_from_drifting_photos_is_neutral(drifting):
    """Gains are found that are nearly the true ones, and of what unseen views lose by the drift most is
    regained; the colours that are learnt are those of a bright photo."""
    cameras, images, photos, gains = drifting
    unseen = abreast(4, 1)
    truth = pictures(unseen) / 255
    ball = truth[..., 3] == 1
    wanted = 0.7 * truth[ball][:, :3]
    reached = []
    for learnt, exposure in ((images, False), (photos, False), (photos, True)):
        fitting = run(cameras, learnt, exposure)
        seen = np.stack([render_image(fitting.field, c).over((1, 1, 1)) for c in unseen])
        reached.append(psnr(colour_corrected(seen[ball], wanted), wanted))
    ratio = fitting.maps[:, 0] / gains
    assert spread(ratio / np.exp(np.log(ratio).mean(0))) < 0.2 * spread(gains)
    assert np.exp(np.log(ratio).mean()) < 0.8
    even, drifted, mended = reached
    assert even - drifted > 1 and mended - drifted > 0.5 * (even - drifted)


def test_photos_that_do_not_differ_stay_as_they_are():
    cameras = abreast(12, 0)
    photos = pictures(cameras)
    same, without = (run(cameras, photos, exposure, steps=300) for exposure in (True, False))
    assert same.maps is None
    assert torch.equal(same.field.params, without.field.params)


def test_a_run_is_taken_up_with_its_gains(drifting):
    """Saved half way and taken up again it ends with the same bits."""
    cameras, _, photos, _ = drifting
    settings = replace(LONG, exposure=True, steps=150)
    whole = FitRun.start(cameras, photos, BOX, settings)
    whole.finish()
    assert spread(whole.maps[:, 0]) > 0.05
    half = FitRun.start(cameras, photos, BOX, settings)
    while half.steps < settings.steps // 3:
        share = half.share()
        half.refresh(share)
        half.step(share)
    arrays, state = half.checkpoint()
    again = FitRun.start(cameras, photos, BOX, settings)
    again.restore({name: np.array(value) for name, value in arrays.items()}, state)
    again.finish()
    assert np.array_equal(again.maps, whole.maps)
    assert torch.equal(again.field.params, whole.field.params)
