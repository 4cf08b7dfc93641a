"""Pixels of pictures that are known to show a point: what structure from motion found in them."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.distillation.shuffle import Shuffle
from fusedrf_cli.engine.rendering.cameras import Camera, projected
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class DepthConfig:
    """How pixels with known points are learnt from."""

    until: float = 0.5
    """Share of the run in which density is brought to known points. What photos show in detail, which comes
    later, is truer than points are: held to them throughout, a cup shows 0.3 dB less after 90 s."""
    share: float = 1 / 16
    """Of the rays of a step; with 1/8 or 1/32 the cup shows 0.1 and 0.2 dB less."""
    apart: int = 32
    """Steps between two times that a pixel comes, at least: few would be learnt by heart."""
    weight: float = 0.05
    """Of that loss; with twice that the cup shows 0.2 dB less."""


class KnownPoints(NamedTuple):
    """Which points pictures are known to show."""

    points: np.ndarray
    """(N, 3) float64, in the field's frame."""
    picture: np.ndarray
    """(N,) int64, the picture that shows each; a point may come again with another."""


class DepthPoints:
    """Pixels with a point that they show, in random order."""

    def __init__(
        self,
        cameras: list[Camera],
        known: KnownPoints,
        ignored: np.ndarray | None,
        generator: torch.Generator,
    ):
        """ignored (P,) bool: pixels, counted picture after picture, that must not be drawn."""
        first = np.cumsum([0, *(camera.width * camera.height for camera in cameras)])
        pixels = np.full(len(known.points), -1)
        for i, camera in enumerate(cameras):
            rows = np.flatnonzero(known.picture == i)
            at, _, inside = projected(camera, known.points[rows])
            column, row = at[inside].astype(np.int64).T
            pixels[rows[inside]] = first[i] + row * camera.width + column
        used = pixels >= 0
        if ignored is not None:
            used &= ~ignored[pixels]
        self.pixels = torch.from_numpy(pixels[used])
        self.points = known.points[used]
        self.shuffle = Shuffle(len(self.points), generator)

    def wanted(self, rays: int, share: float) -> int:
        """How many of them a step of so many rays takes after a share of the run."""
        config = current(DepthConfig)
        if share >= config.until:
            return 0
        return min(round(config.share * rays), -(-len(self.points) // config.apart))

    def draw(self, count: int) -> tuple[torch.Tensor, np.ndarray]:
        """Pixels (count,) int64, counted picture after picture, and the points (count, 3) that they show; or
        as many as there are."""
        chosen = self.shuffle.draw(count)
        return self.pixels[chosen], self.points[chosen.numpy()]
