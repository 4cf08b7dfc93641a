"""Quality figures against values worked out by hand."""

import numpy as np
import pytest

from fusedrf_cli.engine.rendering.metrics import PSNR_CAP, colour_corrected, psnr, ssim


def test_psnr_by_hand():
    a = np.zeros((4, 5, 3))
    assert psnr(a, a + 0.1) == pytest.approx(20.0)  # mse 0.01
    assert psnr(a, a + 1) == pytest.approx(0.0)
    half = a.copy()
    half[:2] = 0.1  # mse 0.005
    assert psnr(half, a) == pytest.approx(10 * np.log10(200)) == psnr(a, half)
    assert psnr(a, a) == PSNR_CAP == psnr(a, a + 1e-9)


def test_psnr_of_float32_is_summed_in_float64():
    a = np.zeros(1 << 20, np.float32)
    assert psnr(a, a + np.float32(0.01)) == pytest.approx(40.0, abs=1e-5)


def test_ssim_of_flat_pictures_is_the_luminance_term():
    """With no variance SSIM is (2 m n + c) / (m² + n² + c), c = 0.01²."""
    a, b = np.full((16, 12, 3), 0.4), np.full((16, 12, 3), 0.6)
    assert ssim(a, b) == pytest.approx((2 * 0.24 + 1e-4) / (0.16 + 0.36 + 1e-4), rel=1e-9)
    assert ssim(a.astype(np.float32), b.astype(np.float32)) == pytest.approx(ssim(a, b), rel=1e-4)


def test_ssim_of_noise():
    rng = np.random.default_rng(0)
    a = rng.random((24, 24, 3))
    assert ssim(a, a) == pytest.approx(1.0)
    slight, heavy = (np.clip(a + s * rng.normal(size=a.shape), 0, 1) for s in (0.02, 0.3))
    assert ssim(a, slight) > 0.95 > 0.7 > ssim(a, heavy)


@pytest.mark.parametrize("shape", [(10, 40, 3), (40, 10, 3), (1, 1, 3)])
def test_ssim_needs_its_window(shape):
    assert np.isnan(ssim(np.zeros(shape), np.zeros(shape)))
    assert ssim(np.zeros((11, 11, 3)), np.zeros((11, 11, 3))) == pytest.approx(1.0)


def test_ssim_of_the_pixels_that_are_kept():
    """Where all are it is the plain one; what lies more than a window away from them changes nothing."""
    rng = np.random.default_rng(1)
    a, b = rng.random((2, 40, 30, 3))
    assert ssim(a, b, np.ones((40, 30), bool)) == pytest.approx(ssim(a, b), rel=1e-12)
    kept = np.zeros((40, 30), bool)
    kept[:12] = True
    other = b.copy()
    other[12 + 5 :] = 0.5
    assert ssim(a, b, kept) == ssim(a, other, kept) != ssim(a, other)
    assert np.isnan(ssim(a, b, np.zeros((40, 30), bool)))


def test_a_colour_correction_undoes_any_affine_map():
    rng = np.random.default_rng(2)
    picture = rng.random((500, 3)) * 0.5
    matrix, shift = np.eye(3) + 0.1 * rng.normal(size=(3, 3)), np.array([0.2, 0.1, 0.15])
    truth = picture @ matrix + shift
    assert 0 < truth.min() and truth.max() < 1 and psnr(picture, truth) < 20
    np.testing.assert_allclose(colour_corrected(picture, truth), truth, atol=1e-12)


def test_a_colour_correction_of_one_colour_is_the_mean():
    truth = np.random.default_rng(3).random((50, 3))
    found = colour_corrected(np.full((50, 3), 0.3), truth)
    np.testing.assert_allclose(found, np.broadcast_to(truth.mean(0), (50, 3)), atol=1e-12)
