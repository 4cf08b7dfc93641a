"""Photos of a capture as the engine and its measures take them: cameras, and pictures over white."""

import numpy as np

from formats.photos import load_ignored, load_images
from formats.views import View
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.rendering.metrics import psnr, ssim


def camera_of(view: View) -> Camera:
    """A capture's view as the engine's camera."""
    return Camera(
        view.camera_to_world,
        view.fl_x,
        view.fl_y,
        view.cx,
        view.cy,
        view.width,
        view.height,
        tuple(view.distortion),
        view.name,
        view.fisheye,
    )


def over_white(images: np.ndarray) -> np.ndarray:
    """(..., 4) uint8 straight alpha to (..., 3) float32 over white."""
    values = images.astype(np.float32) / 255
    return values[..., :3] * values[..., 3:] + 1 - values[..., 3:]


def truth_of(view: View) -> tuple[np.ndarray, np.ndarray]:
    """A view's photo, (H, W, 3) float32 over white, and the pixels that its mask keeps, (H, W) bool."""
    photo, ignored = over_white(load_images([view]))[0], load_ignored(view)
    return photo, np.ones(photo.shape[:2], bool) if ignored is None else ~ignored


def likeness(shot: np.ndarray, truth: np.ndarray, mask: np.ndarray) -> dict[str, float]:
    """PSNR in dB and SSIM of a picture (H, W, 3) in the pixels that are kept, (H, W) bool, of which there is
    at least one."""
    same = np.where(mask[..., None], shot, truth)  # windows that reach over the edge see no difference
    return {"psnr": psnr(shot[mask], truth[mask]), "ssim": ssim(same, truth, mask)}
