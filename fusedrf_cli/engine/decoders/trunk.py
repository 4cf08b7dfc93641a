"""Density by a network whose outputs are the features of the colour as well (NeRF, Mildenhall et al., ECCV
2020; Instant-NGP, Müller et al. 2022, sec. 5.4): h = max(0, W features + b), outputs = V h + c and
σ = scale a(outputs_0 + shift), `a` of activations.py.

encodings/trunk_features.py hands the outputs on. What colour sends back to them waits in scratch for
`backward`, which is called after that of every colour."""

from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.decoders import activations
from fusedrf_cli.engine.decoders.activations import activated, activated_slope
from fusedrf_cli.engine.fields.box import ParameterBlock
from fusedrf_cli.engine.kernels.primitives import dense, dense_backward, rectify


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    hidden: object  # int64, where W (WIDTH, HIDDEN) begins, and behind it b
    out: object  # int64, where V (HIDDEN, OUTPUTS) begins, and behind it c
    activation: object  # (2,) float, scale (1/length) and shift


def sizes(width: int, hidden: int, outputs: int, activation: str = "softplus") -> dict[str, int]:
    """See decoders; scratch holds features, h, outputs, and the gradients of each, those of the outputs 0
    between samples."""
    half = width + hidden + outputs
    return {
        "WIDTH": width, "HIDDEN": hidden, "OUTPUTS": outputs, "H": width, "OUT": width + hidden, "D_X": half,
        "D_H": half + width, "D_OUT": half + width + hidden, "ROOM": 2 * half,
        "ACTIVATION": activations.NAMES.index(activation),
    }  # fmt: skip


def sections(
    resolution: tuple, width: int, hidden: int, outputs: int, activation: str = "softplus"
) -> list[ParameterBlock]:
    """See decoders; each layer's (inputs, outputs), and its bias."""
    return [
        ParameterBlock("hidden.weight", (width, hidden), spread=(2 / width) ** 0.5),
        ParameterBlock("hidden.bias", (hidden,)),
        ParameterBlock("out.weight", (hidden, outputs), spread=hidden**-0.5),
        ParameterBlock("out.bias", (outputs,)),
    ]


def arrays(field, starts: np.ndarray, **options) -> Arrays:
    """See decoders."""
    return Arrays(np.int64(starts[0]), np.int64(starts[2]), field.activation)


def reference(
    field, sections: dict, features: torch.Tensor, activation: str = "softplus", **options
) -> tuple[torch.Tensor, torch.Tensor]:
    """See decoders."""
    h = (features @ sections["hidden.weight"] + sections["hidden.bias"]).relu()
    outputs = h @ sections["out.weight"] + sections["out.bias"]
    return field.scale * activations.reference(activation, outputs[:, 0] + field.shift), outputs


def bound(field, sections: dict, features: torch.Tensor, **options) -> tuple[float, torch.Tensor]:
    """See decoders."""
    most = features
    for layer in ("hidden", "out"):
        weight, bias = (sections[f"{layer}.{part}"].abs().double() for part in ("weight", "bias"))
        most = most @ weight + bias
    return float(most[0]), most


# -- compiled ------------------------------------------------------------------------------------------------


def outputs_at(field, cell, scratch):
    """Where in scratch all outputs at a point are, computed anew."""
    x, h, out = np.uint64(AT), np.uint64(AT + H), np.uint64(AT + OUT)
    features_forward(field, cell, scratch, scratch, AT)
    dense(WIDTH, HIDDEN, field.params, np.uint64(field.hidden), scratch, x, scratch, h)
    rectify(HIDDEN, scratch, h)
    dense(HIDDEN, OUTPUTS, field.params, np.uint64(field.out), scratch, h, scratch, out)
    return out


def pending_at(scratch):
    """Where in scratch the gradient of the outputs gathers."""
    return np.uint64(AT + D_OUT)


def forward(field, cell, scratch):
    """See decoders."""
    f = scratch[outputs_at(field, cell, scratch)]
    return float(field.activation[0] * activated(f + field.activation[1])), float(f)


def backward(field, cell, pre, d_sigma, scratch, grad):
    """See decoders; with what colour sent back to the outputs."""
    outputs_at(field, cell, scratch)
    x, h, params = np.uint64(AT), np.uint64(AT + H), field.params
    d_x, d_h, d_out = np.uint64(AT + D_X), np.uint64(AT + D_H), pending_at(scratch)
    scratch[d_out] += d_sigma * field.activation[0] * activated_slope(pre + field.activation[1])
    hidden, out = np.uint64(field.hidden), np.uint64(field.out)
    dense_backward(HIDDEN, OUTPUTS, params, out, scratch, h, True, scratch, d_out, scratch, d_h, grad)
    dense_backward(WIDTH, HIDDEN, params, hidden, scratch, x, False, scratch, d_h, scratch, d_x, grad)
    features_backward(field, cell, scratch, AT + D_X, scratch, grad)
    for r in range(np.uint64(OUTPUTS)):
        scratch[d_out + r] = 0
