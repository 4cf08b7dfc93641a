"""Image quality against a reference: PSNR and SSIM of pictures in [0, 1]."""

import numpy as np

SSIM_WINDOW = 11  # pixels a side
PSNR_CAP = 100.0  # dB, what two equal pictures are given


def psnr(a: np.ndarray, b: np.ndarray) -> float:
    """Peak signal-to-noise ratio in dB of two arrays in [0, 1]: -10 log10 of the mean squared difference, at
    most PSNR_CAP."""
    return psnr_of_mse(float(np.mean((np.asarray(a, np.float64) - b) ** 2)))


def psnr_of_mse(mse: float) -> float:
    """PSNR in dB of a mean squared difference."""
    return PSNR_CAP if mse == 0 else min(PSNR_CAP, float(-10 * np.log10(mse)))


def colour_corrected(picture: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """Pixels (N, 3) after the affine map of colours, 3 x 4, that takes them nearest to `truth` (N, 3) by
    least squares; in [0, 1]."""
    known = np.concatenate([picture, np.ones((len(picture), 1))], 1, dtype=np.float64)
    matrix = np.linalg.lstsq(known, truth.astype(np.float64), rcond=None)[0]
    return np.clip(known @ matrix, 0, 1)


def ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Structural similarity (Wang et al. 2004) of two (H, W, 3) pictures, Gaussian window of sigma 1.5, mean
    over the whole windows, or over those around the pixels that are `mask`, (H, W) bool; NaN where there is
    none, as under 11 pixels."""
    from skimage.metrics import structural_similarity

    if min(a.shape[:2]) < SSIM_WINDOW:
        return float("nan")
    _, similarity = structural_similarity(
        a,
        b,
        data_range=1.0,
        channel_axis=2,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
        full=True,
    )
    valid = (slice(SSIM_WINDOW // 2, -(SSIM_WINDOW // 2)),) * 2
    similarity = similarity[valid] if mask is None else similarity[valid][mask[valid]]
    return float(similarity.mean(dtype=np.float64)) if similarity.size else float("nan")
