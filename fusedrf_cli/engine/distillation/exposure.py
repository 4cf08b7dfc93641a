"""What each photo makes of the colours of an unbounded scene: a camera that sets its exposure and white
balance anew for each photo, or many cameras, would otherwise be learnt as low density and as colours that
depend on the view.

A photo shows gain * colour + offset in each channel, of what is rendered (ComputedField.train_rays), and
counts by a weight. Maps are (n, 3, 3) float64: of each photo the gains, the offsets, and the weights of its
squared errors. Colours are as the mean photo shows them; of photos by many people, as a bright one does.
"""

from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.distillation.poses import Poses
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.kernels.primitives import CLIPPED
from fusedrf_cli.engine.rendering.volume import render_rays
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class ExposureConfig:
    """How what photos make of colours is found."""

    at: tuple[float, ...] = (0.25, 0.28, 0.31, 0.34, 0.38, 0.43, 0.48, 0.54, 0.6, 0.67, 0.74, 0.82, 0.9)
    """Shares of a run: sooner, what a photo shows would pass for its exposure."""
    rays: int = 40_000
    """From which maps are found, of all photos."""
    rays_of_each: tuple[int, int] = (100, 400)
    """Of each photo, at least and at most."""
    opaque: float = 0.5
    """Opacity of a ray that shows the field, and not what lies behind it."""
    few: int = 48
    """Rays that tell too little."""
    same: float = 0.022
    """Root mean square of the gains' logarithms under which photos count as equally exposed."""
    sure: float = 2
    """Standard errors that are taken from each of those before."""
    apart: float = 0.15
    """Median of how far, in logarithms, a photo's mean colour is from that of the photo taken nearest to it,
    from which photos are many people's: of five captures of one camera each it was 0.02 at most."""
    beside: float = 0.7
    """Distance, in the root mean square of the photos' from their middle, and turn, in radians, of such
    two."""
    bright: float = 0.9
    """Share of photos by many people that are darker than the colours that are learnt. Those of the mean
    photo would have half the contrast, which counts a quarter against what keeps density together."""
    gains: tuple[float, float] = (1 / 16, 16.0)
    offsets: tuple[float, float] = (-0.3, 0.3)
    wary: float = 0.01
    """Weight of an offset's square against a mean squared error: blurred colours hardly tell it from a
    gain."""
    fair: float = 3.0
    """Times a photo's median error, at which a pixel counts half: something stood in front of the scene."""
    least_error: float = 1e-3
    rounds: int = 4
    least_weight: float = 0.01
    """Of a photo that maps do not explain, against one that they do."""


def rays_of_each(photos: int) -> int:
    """How many rays of each photo maps are found from."""
    config = current(ExposureConfig)
    return int(np.clip(config.rays // photos, *config.rays_of_each))


def matched(photos: torch.Tensor, poses: Poses) -> np.ndarray | None:
    """Maps of photos by many people, of which m colours each are known, (n, m, 3) in [0, 1] and not finite
    where they do not count: those by which mean and deviation of all are alike. None where photos that were
    taken side by side are alike as they are."""
    config = current(ExposureConfig)
    known, values = torch.isfinite(photos), torch.nan_to_num(photos.double())
    count = known.sum(1).clamp(min=1)
    mean = values.sum(1) / count
    deviation = (torch.where(known, (values - mean[:, None]) ** 2, 0.0).sum(1) / count).sqrt().numpy()
    mean = mean.numpy()
    logs = np.log(mean + 0.01)
    first, second = side_by_side(poses)
    if len(first) < len(mean) / 2 or np.median(abs(logs[first] - logs[second])) < config.apart:
        return None
    gain = np.clip(deviation / np.median(deviation, 0), *config.gains)
    offset = np.clip(mean - gain * np.median(mean, 0), *config.offsets)
    bright = np.stack([gain / np.quantile(gain, config.bright, axis=0), np.zeros_like(gain)], 1)
    maps = gauged(gain, offset, bright)
    return weighed(maps, maps[:, 0])


def side_by_side(poses: Poses) -> tuple[np.ndarray, np.ndarray]:
    """(m,) and (m,) photos, and of each the one that was taken nearest to it, looking the same way; without
    those that have none beside them."""
    position = poses.position - poses.position.mean(0)
    size = np.sqrt((position**2).sum(1).mean())
    stands = np.concatenate([position / max(size, 1e-12), -poses.rotation[:, :, 2]], 1)
    pairs = []
    for i, stand in enumerate(stands):
        away = np.linalg.norm(stands - stand, axis=1)
        away[i] = np.inf
        if away.min() < current(ExposureConfig).beside:
            pairs.append((i, away.argmin()))
    first, second = np.array(pairs, np.int64).reshape(-1, 2).T
    return first, second


def measured(
    field: RadianceField,
    rays: tuple[np.ndarray, np.ndarray],
    photos: torch.Tensor,
    near: float,
    before: np.ndarray | None,
) -> np.ndarray | None:
    """Maps of photos by what a field shows, in the least squares; None where none were known `before` and the
    photos do not surely differ.

    rays: origins and directions (n * m, 3) in the field's frame, m of each photo in order; photos (n, m, 3)
    their colours in [0, 1], not finite where they do not count. A photo of which too few rays show the field
    has the identity.
    """
    config = current(ExposureConfig)
    n, m, _ = photos.shape
    rendered = torch.from_numpy(render_rays(field, *rays, near=near)).reshape(n, m, 5).double()
    shown = rendered[..., :3] / rendered[..., 3:4].clamp(min=config.opaque)
    truth = torch.where(rendered[..., 3:4] > config.opaque, photos.double(), torch.nan)
    if before is None and not differ(shown, truth):
        return None
    return fitted(shown, truth, before)


def differ(shown: torch.Tensor, truth: torch.Tensor) -> bool:
    """Whether photos (n, m, 3), nan where they do not count, are surely brighter and darker, one than the
    other, than the colours that a field shows for them: by their gains of least squares, of which `sure`
    standard errors do not count (the positive part of James and Stein's estimate)."""
    config = current(ExposureConfig)
    counts = torch.isfinite(truth) & (truth < CLIPPED)
    product, square = (torch.where(counts, shown * other, 0.0).sum(1) for other in (truth, shown))
    number = counts.sum(1)
    known = (number >= config.few) & (square > 0) & (product > 0)
    gains = torch.where(known, product / square, torch.nan)
    missed = torch.where(counts, (truth - gains[:, None] * shown) ** 2, 0.0).sum(1)
    error = torch.nan_to_num((missed / number / square).sqrt() / gains)
    logs = torch.log(gains)
    logs = torch.nan_to_num(logs - logs.nanmean(0))
    logs = logs * (1 - (config.sure * error / logs.abs().clamp(min=1e-12)) ** 2).clamp(min=0)
    return float((logs - logs.mean(0)).square().mean().sqrt()) > config.same


def fitted(shown: torch.Tensor, truth: torch.Tensor, before: np.ndarray | None = None) -> np.ndarray:
    """Maps of photos (n, m, 3), nan where they do not count, that show `shown`, from those `before` on.

    Least squares, some times over: each time, pixels that are far off (`fair`, Cauchy's weights) count less.
    Those at an end of a photo's range count from the second time on, where they are not beyond it.
    """
    config = current(ExposureConfig)
    counts = torch.isfinite(truth)
    truth = torch.nan_to_num(truth)
    start = identity(len(truth)) if before is None else before
    gain, offset = (torch.from_numpy(start[:, k])[:, None] for k in (0, 1))
    bright, dark = truth >= CLIPPED, truth <= 0
    error = truth - gain * shown - offset
    used = counts & ~bright & ~dark
    for _ in range(config.rounds):
        known = used.sum(1, keepdim=True) >= config.few
        usual = torch.where(used, error.abs(), torch.nan).nanmedian(1, keepdim=True).values
        weight = used / (1 + (error / (config.fair * usual + config.least_error)) ** 2)
        weight = weight / weight.sum(1, keepdim=True)
        square, mean = (weight * shown**2).sum(1, keepdim=True), (weight * shown).sum(1, keepdim=True)
        product, level = (weight * shown * truth).sum(1, keepdim=True), (weight * truth).sum(1, keepdim=True)
        steep = (product * (1 + config.wary) - mean * level) / (square * (1 + config.wary) - mean**2)
        gain = torch.where(known, steep.clamp(*config.gains), gain)
        offset = torch.where(
            known, ((level - gain * mean) / (1 + config.wary)).clamp(*config.offsets), offset
        )
        error = truth - gain * shown - offset
        used = counts & ~(bright & (error < 0)) & ~(dark & (error > 0))
    missed = (torch.where(used, error**2, 0.0).sum(1) / used.sum(1).clamp(min=1)).sqrt()
    return weighed(gauged(gain[:, 0].numpy(), offset[:, 0].numpy(), start), missed.numpy())


def identity(n: int) -> np.ndarray:
    """Maps of n photos that show the colours as they are."""
    return np.repeat([[[1.0] * 3, [0.0] * 3, [1.0] * 3]], n, 0)


def gauged(gain: np.ndarray, offset: np.ndarray, like: np.ndarray) -> np.ndarray:
    """(n, 2, 3) the same gains and offsets (n, 3) of other colours: those for which the gains' geometric mean
    and the offsets' mean are those of maps (n, .., 3)."""
    gain = gain * np.exp((np.log(like[:, 0]) - np.log(gain)).mean(0))
    return np.stack([gain, offset + gain * (like[:, 1] - offset).mean(0) / gain.mean(0)], 1)


def weighed(maps: np.ndarray, missed: np.ndarray) -> np.ndarray:
    """Maps (n, 2, 3) with weights, of photos that are off by root mean squares (n, 3): an error counts as the
    colour of the field that it is due to, and less in a photo that is off by more of that than the median."""
    off = missed / maps[:, 0]
    fair = np.median(off, 0) / np.maximum(off, 1e-9)
    weight = np.clip(fair**2, current(ExposureConfig).least_weight, 1) / maps[:, 0] ** 2
    return np.concatenate([maps, weight[:, None]], 1)


def undone(maps: np.ndarray, photos: torch.Tensor) -> torch.Tensor:
    """The colours of the field that photos (n, m, 3) show by their maps."""
    gain, offset = (torch.from_numpy(maps[:, k])[:, None].to(photos.dtype) for k in (0, 1))
    return (photos - offset) / gain
