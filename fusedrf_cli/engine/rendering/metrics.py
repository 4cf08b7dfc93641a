"""Image quality against a reference: PSNR and SSIM of pictures in [0, 1]."""

import numpy as np

SSIM_WINDOW = 11  # pixels a side
PSNR_CAP = 100.0  # dB, what two equal pictures are given


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of two arrays in [0, 1]: -10 log10 of the mean squared difference, at
    most PSNR_CAP."""
    mse = float(np.mean((np.asarray(a, np.float64) - b) ** 2))
    return PSNR_CAP if mse == 0 else min(PSNR_CAP, float(-10 * np.log10(mse)))


def ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Structural similarity (Wang et al. 2004) of two (H, W, 3) pictures, Gaussian window of sigma 1.5; NaN
    when under 11 pixels."""
    from skimage.metrics import structural_similarity

    if min(a.shape[:2]) < SSIM_WINDOW:
        return float("nan")
    return float(
        structural_similarity(
            a,
            b,
            data_range=1.0,
            channel_axis=2,
            gaussian_weights=True,
            sigma=1.5,
            use_sample_covariance=False,
        )
    )
