"""Density of a weighted sum of features, which are handed on to the colour (K-Planes' explicit decoder,
Fridovich-Keil et al., CVPR 2023, sec. 3.3): σ = scale a(w · features + b + shift), `a` of activations.py.

encodings/trunk_features.py hands the features on. What colour sends back to them waits in scratch for
`backward`, as in trunk.py."""

from typing import NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.decoders import activations
from fusedrf_cli.engine.decoders.activations import activated, activated_slope
from fusedrf_cli.engine.fields.box import ParameterBlock
from fusedrf_cli.engine.fields.part_options import Activation, Limits
from fusedrf_cli.engine.kernels.primitives import accumulate, add_scaled, dot, scatter


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See decoders."""

    activation: Activation = "softplus"
    limits: Limits = activations.LIMITS


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    start: object  # int64, where w begins, and behind it b
    activation: object  # (2,) float, scale (1/length) and shift


def sizes(width: int, **activation) -> dict[str, int | float]:
    """See decoders; scratch holds the features and their gradient, this 0 between samples."""
    return {"WIDTH": width, "ROOM": 2 * width, **activations.sizes(**activation)}


def sections(resolution: tuple, width: int, **activation) -> list[ParameterBlock]:
    """See decoders."""
    return [ParameterBlock("weights", (width + 1,), spread=width**-0.5)]


def arrays(field, starts: np.ndarray, **options) -> Arrays:
    """See decoders."""
    return Arrays(np.int64(starts[0]), field.activation)


def reference(
    field, sections: dict, features: torch.Tensor, width: int, **activation
) -> tuple[torch.Tensor, torch.Tensor]:
    """See decoders."""
    weights = sections["weights"]
    f = features @ weights[:-1] + weights[-1]
    return field.scale * activations.reference(f + field.shift, **activation), features


def bound(field, sections: dict, features: torch.Tensor, **options) -> tuple[float, torch.Tensor]:
    """See decoders."""
    weights = sections["weights"].abs().double()
    return float(features @ weights[:-1] + weights[-1]), features


# -- compiled ------------------------------------------------------------------------------------------------


def outputs_at(field, cell, scratch):
    """Where in scratch the features of a point are, computed anew."""
    features_forward(field, cell, scratch, scratch, AT)
    return kept_at()


def hand_on(field, unit, cell, scratch):
    """Leave the features of a point where `kept_at` says."""
    outputs_at(field, cell, scratch)


def kept_at():
    """Where `outputs_at` has left them."""
    return np.uint64(AT)


def pending_at(scratch):
    """Where in scratch their gradient gathers."""
    return np.uint64(AT + WIDTH)


def forward(field, cell, scratch):
    """See decoders."""
    x, w = outputs_at(field, cell, scratch), np.uint64(field.start)
    f = dot(WIDTH, field.params, w, scratch, x) + field.params[w + np.uint64(WIDTH)]
    return float(field.activation[0] * activated(f + field.activation[1])), float(f)


def backward(field, cell, pre, d_sigma, scratch, grad):
    """See decoders; with what colour sent back to the features."""
    x, d_x, w = outputs_at(field, cell, scratch), pending_at(scratch), np.uint64(field.start)
    slope = activated_slope(pre + field.activation[1])
    d = field.params.dtype.type(d_sigma * field.activation[0] * slope)
    scatter(WIDTH, grad, w, d, scratch, x)
    accumulate(grad, w + np.uint64(WIDTH), d)
    add_scaled(WIDTH, scratch, d_x, d, field.params, w)
    features_backward(field, cell, scratch, AT + WIDTH, scratch, grad)
    for r in range(np.uint64(WIDTH)):
        scratch[d_x + r] = 0
