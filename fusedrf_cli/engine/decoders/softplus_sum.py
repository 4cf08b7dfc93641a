"""Density as TensoRF's (Chen et al., ECCV 2022, eq. 6): σ = scale softplus(Σ_r features_r + shift)."""

from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.fields.box import Part
from fusedrf_cli.engine.kernels import reference as torch_reference
from fusedrf_cli.engine.kernels.parts import sigmoid, softplus


class Arrays(NamedTuple):
    """What the functions read."""

    activation: object  # (2,) float, scale (1/length) and shift


def sizes() -> dict[str, int]:
    """See decoders; scratch holds the gradient of the sum."""
    return {"ROOM": 1}


def sections(resolution: tuple[int, int, int]) -> list[Part]:
    """None: nothing is learnt."""
    return []


def arrays(field, starts: np.ndarray) -> Arrays:
    """See decoders."""
    return Arrays(field.activation)


def reference(field, sections: dict, features: torch.Tensor) -> tuple[torch.Tensor, None]:
    """See decoders."""
    return torch_reference.density(features.sum(1), field.scale, field.shift), None


def bound(field, sections: dict, features: torch.Tensor) -> tuple[float, None]:
    """See decoders."""
    return float(features.sum()), None


# -- compiled ------------------------------------------------------------------------------------------------


def forward(field, unit, scratch):
    """See decoders."""
    f = features_summed(field, unit, scratch)
    return float(field.activation[0] * softplus(f + field.activation[1])), float(f)


def backward(field, unit, pre, d_sigma, scratch, grad):
    """See decoders."""
    scratch[AT] = d_sigma * field.activation[0] * sigmoid(pre + field.activation[1])
    if scratch[AT] != 0:
        features_summed_backward(field, unit, scratch, AT, scratch, grad)
