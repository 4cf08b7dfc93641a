"""Views that a fit has not seen: how near a field comes to their photos, and how near one comes without."""

from collections.abc import Iterator

import numpy as np
import torch

from formats.capture_frame import scene_frame
from formats.views import Capture, View
from fusedrf_cli.bridge.pictures import camera_of, likeness, over_white, truth_of
from fusedrf_cli.engine.distillation.ray_dataset import Pictures
from fusedrf_cli.engine.rendering.metrics import colour_corrected, psnr
from fusedrf_cli.engine.rendering.volume import render_image

WITHOUT_FIELD = {
    "mean_colour": "the mean colour of the training photos",
    "nearest_photo": "a copy of the nearest training photo",
}


def measure(field, capture: Capture, pictures: Pictures, origin: np.ndarray, training_psnr: float) -> dict:
    """How near a field, whose frame lies at `origin` (4, 4), comes to the held-out photos over white, in the
    pixels that their masks keep; `pictures` are those of the views that it was learnt from.

    All figures are means over the photos, PSNR in dB. `colour_corrected_psnr` is that after the affine map of
    colours that suits each photo best, which the photo itself tells: it bounds what exposure costs.
    `psnr_gap` is the training rays' PSNR less the held-out one. `baseline_psnr` has what two pictures reach
    that need no field: the mean colour of the training photos, and a copy of the nearest of them.
    """
    rows, mean = [], mean_colour(capture, pictures)
    for view in capture.test:
        truth, mask = truth_of(view)
        if not mask.any():
            continue
        shot = render_image(field, camera_of(view), origin=origin).over()
        corrected = colour_corrected(shot[mask], truth[mask])
        copy = nearest_photo(view, capture, pictures)
        rows.append(
            likeness(shot, truth, mask)
            | {
                "colour_corrected_psnr": psnr(corrected, truth[mask]),
                "mean_colour": psnr(np.broadcast_to(mean, truth.shape)[mask], truth[mask]),
                "nearest_photo": psnr(copy[mask], truth[mask]),
            }
        )
    names = ("psnr", "colour_corrected_psnr", "ssim", *WITHOUT_FIELD)
    figures = {name: float(np.mean([row[name] for row in rows])) if rows else np.nan for name in names}
    baselines = {name: figures.pop(name) for name in WITHOUT_FIELD}
    gap = {"psnr_gap": training_psnr - figures["psnr"], "views": len(rows)}
    return figures | gap | {"baseline_psnr": baselines}


def warn_of_holdout(output: str, measured: dict, progress) -> None:
    """Say that a field of photos is broken, or that exposure varies, where `measure` shows it."""
    reached, corrected = measured["psnr"], measured["colour_corrected_psnr"]
    without, how = max((figure, name) for name, figure in measured["baseline_psnr"].items())
    if reached <= without:
        progress.warn(
            f"{output}: the field is broken: it shows held-out photos at {reached:.1f} dB, no better than "
            f"{WITHOUT_FIELD[how]} ({without:.1f} dB). Likely causes are poses that are wrong or in another "
            "convention, photos and cameras mixed up, changing exposure, things that move, or too few steps"
        )
    if corrected - reached > 1.5 and corrected > without:  # dB; the same exposure gains less
        progress.warn(
            f"{output}: exposure or white balance varies between photos: with the colours of each held-out "
            f"photo corrected the field reaches {corrected:.1f} dB, where it reaches {reached:.1f} dB without"
        )


# -- what needs no field -------------------------------------------------------------------------------------


def mean_colour(capture: Capture, pictures: Pictures) -> np.ndarray:
    """(3,) the mean over white of all training photos' pixels, but for those that masks exclude."""
    total, count = np.zeros(3), 0
    for pixels, mask in photos_of(capture, pictures):
        values = over_white(pixels[mask])
        total += values.sum(0, dtype=np.float64)
        count += len(values)
    return total / max(count, 1)


def photos_of(capture: Capture, pictures: Pictures) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """(H, W, 4) uint8 and (H, W) bool, which pixels masks keep, of each training photo."""
    first = 0
    for view in capture.train:
        part = slice(first, first + view.width * view.height)
        shape, first = (view.height, view.width), part.stop
        pixels = pictures.pixels[part]
        mask = np.ones(len(pixels), bool) if pictures.ignored is None else ~pictures.ignored[part]
        if capture.opaque:  # only a mask can have made a pixel transparent
            mask = mask & (pixels[:, 3] > 0)
        yield pixels.reshape(*shape, 4), mask.reshape(shape)


def nearest_photo(view: View, capture: Capture, pictures: Pictures) -> np.ndarray:
    """(H, W, 3) the photo over white of the training camera that is nearest to a view's, at the size of the
    view."""
    number = nearest(view, capture)
    before = sum(other.width * other.height for other in capture.train[:number])
    chosen = capture.train[number]
    pixels = pictures.pixels[before : before + chosen.width * chosen.height]
    copy = over_white(pixels.reshape(chosen.height, chosen.width, 4))
    if (chosen.width, chosen.height) == (view.width, view.height):
        return copy
    planes = torch.from_numpy(copy).permute(2, 0, 1)[None]
    size = (view.height, view.width)
    resized = torch.nn.functional.interpolate(planes, size, mode="bilinear", antialias=True)
    return resized[0].permute(1, 2, 0).numpy()


def nearest(view: View, capture: Capture) -> int:
    """Which training camera is nearest to a view's by where it stands, in distances between cameras and
    focus, and by where it looks."""
    poses = np.array([other.camera_to_world for other in (*capture.train, view)])
    frame = capture.frame or scene_frame(poses)
    stands = np.concatenate([poses[:, :3, 3] / frame.distance, -poses[:, :3, 2]], 1)
    return int(np.linalg.norm(stands[:-1] - stands[-1], axis=1).argmin())
