"""How much brighter one photo is than another where both show the same: a camera that sets its exposure and
white balance anew for each photo would otherwise be learnt as haze and as colours that depend on the view."""

import numpy as np
import torch

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.rendering.volume import render_rays

RAYS = 400
"""Of a photo, from which its gains are measured."""
CLIPPED = 0.97
"""A photo's colour from which on more light would not have shown."""
OPAQUE = 0.5
"""Opacity of a ray that shows the field, and not what lies behind it."""
FEW = 48
"""Rays that tell too little."""
MEASURED_AT = (0.25, 0.28, 0.31, 0.34, 0.38, 0.43, 0.5, 0.6)
"""Shares of a run: sooner, what a photo shows would pass for its exposure."""
OVERSHOT = 2
"""Power to which gains are taken, since the field follows the photos between two measurements."""
SAME = 0.022
"""Root mean square of the gains' logarithms under which photos count as equally exposed."""
SURE = 2
"""Standard errors under which a gain does not count until photos are known to differ."""


def gains_of(
    field: RadianceField,
    rays: tuple[np.ndarray, np.ndarray],
    photos: torch.Tensor,
    near: float,
    sure: float = 0.0,
) -> np.ndarray:
    """(n, 3) float64: by what each photo's colours are to be divided so that they are those of the field, in
    the least squares; their geometric mean over the photos is 1 in each channel.

    rays: origins and directions (n * m, 3) in the field's frame, m of each photo in order; photos (n, m, 3)
    their colours in [0, 1], not finite where they do not count. A photo with fewer than FEW rays that show
    the field has the gains 1, as have those whose logarithms are less than `sure` standard errors; larger
    ones are drawn towards 1 (the positive part of James and Stein's estimate).
    """
    n, m, _ = photos.shape
    found = torch.from_numpy(render_rays(field, *rays, near=near)).reshape(n, m, 5).double()
    opacity, truth = found[..., 3:4], photos.double()
    shown = found[..., :3] / opacity.clamp(min=OPAQUE)
    counts = (opacity > OPAQUE) & torch.isfinite(truth) & (truth < CLIPPED)
    product = torch.where(counts, shown * truth, 0.0).sum(1)
    square = torch.where(counts, shown * shown, 0.0).sum(1)
    number = counts.sum(1)
    known = (number >= FEW) & (square > 0) & (product > 0)
    gains = torch.where(known, product / square, torch.nan)
    missed = torch.where(counts, (truth - gains[:, None] * shown) ** 2, 0.0).sum(1)
    error = (missed / number / square).sqrt() / gains
    logs = torch.log(gains)
    logs = torch.nan_to_num(logs - logs.nanmean(0))
    logs = logs * (1 - (sure * torch.nan_to_num(error) / logs.abs().clamp(min=1e-12)) ** 2).clamp(min=0)
    return (logs - logs.mean(0)).exp().numpy()


def spread(gains: np.ndarray) -> float:
    """Root mean square of the logarithms of gains (n, 3)."""
    return float(np.sqrt(np.mean(np.log(gains) ** 2)))
