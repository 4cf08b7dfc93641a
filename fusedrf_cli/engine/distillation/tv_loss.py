"""How smooth a field's planes are kept while photos of an unbounded scene are learnt (total variation:
TensoRF, Chen et al. 2022, section 4.4). Few photos see each far texel, and what they leave open would be
noise, drawn out along the axes."""

from dataclasses import dataclass

import torch

from fusedrf_cli.engine.fields.computed import ComputedField
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class TVLossConfig:
    """How planes are kept smooth."""

    weight: float = 8e-6
    """Against the squared error of a ray; four times that blurs what photos do show."""
    strips: int = 8
    """That planes are cut into: a step smooths one of them, and that by so many times as much."""


def add_tv_gradient(field: ComputedField, gradient: torch.Tensor, weight: float, strip: int) -> None:
    """Add to gradients (P,) those of the roughness of one strip of each of a field's planes, times `strips`.

    Roughness is `weight` times twice the sum of the squared differences between neighbouring texels, of rows
    and of columns, over the number of texels times components, summed over the planes.
    """
    config = current(TVLossConfig)
    for plane, slope in zip(field.planes(field.params), field.planes(gradient), strict=True):
        height = -(-plane.shape[0] // config.strips)
        start, scale = strip * height, 4 * weight * config.strips / plane.numel()
        part = plane[start : start + height]
        across = part[:, 1:] - part[:, :-1]
        slope[start : start + height, 1:].add_(across, alpha=scale)
        slope[start : start + height, :-1].sub_(across, alpha=scale)
        tall = plane[start : start + height + 1]
        down = tall[1:] - tall[:-1]
        slope[start + 1 : start + 1 + len(down)].add_(down, alpha=scale)
        slope[start : start + len(down)].sub_(down, alpha=scale)
