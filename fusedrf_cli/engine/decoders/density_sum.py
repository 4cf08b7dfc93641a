"""Density of the sum of features (TensoRF, Chen et al., ECCV 2022, eq. 6): σ = scale a(Σ_r features_r +
shift), `a` of activations.py."""

from typing import NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.decoders import activations
from fusedrf_cli.engine.decoders.activations import activated, activated_slope
from fusedrf_cli.engine.fields.part_options import Activation, Limits


class Arrays(NamedTuple):
    """What the functions read."""

    activation: object  # (2,) float, scale (1/length) and shift


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See decoders."""

    activation: Activation = "softplus"
    limits: Limits = activations.LIMITS


def sizes(**activation) -> dict[str, int | float]:
    """See decoders; scratch holds the gradient of the sum."""
    return activations.sizes(**activation) | {"ROOM": 1}


def arrays(field, starts: np.ndarray, **activation) -> Arrays:
    """See decoders."""
    return Arrays(field.activation)


def reference(field, sections: dict, features: torch.Tensor, **activation) -> tuple[torch.Tensor, None]:
    """See decoders."""
    return field.scale * activations.reference(features.sum(1) + field.shift, **activation), None


def bound(field, sections: dict, features: torch.Tensor, **activation) -> tuple[float, None]:
    """See decoders."""
    return float(features.sum()), None


# -- compiled ------------------------------------------------------------------------------------------------


def forward(field, cell, scratch):
    """See decoders."""
    f = features_summed(field, cell, scratch)
    return float(field.activation[0] * activated(f + field.activation[1])), float(f)


def backward(field, cell, pre, d_sigma, scratch, grad):
    """See decoders."""
    scratch[AT] = d_sigma * field.activation[0] * activated_slope(pre + field.activation[1])
    features_summed_backward(field, cell, scratch, AT, scratch, grad)
