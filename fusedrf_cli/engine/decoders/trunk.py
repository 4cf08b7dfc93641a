"""Density by a network whose outputs are the features of the colour as well (NeRF, Mildenhall et al., ECCV
2020; Instant-NGP, Müller et al. 2022, sec. 5.4): LAYERS rectified layers of HIDDEN outputs, then
outputs = V h + c and σ = scale a(outputs_0 + shift), `a` of activations.py. The layer SKIP, where there is
one, reads the features again beside what the layer before it made (NeRF, fig. 7).

encodings/trunk_features.py hands the outputs on. What colour sends back to them waits in scratch for
`backward`, which is called after that of every colour."""

from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.decoders import activations
from fusedrf_cli.engine.decoders.activations import activated, activated_slope
from fusedrf_cli.engine.fields.box import ParameterBlock
from fusedrf_cli.engine.fields.part_options import Activation, Layers, Limits, Width
from fusedrf_cli.engine.kernels.networks import network, network_backward


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See decoders."""

    hidden: Width
    outputs: Width
    layers: Layers = 1
    skip: Annotated[int, msgspec.Meta(ge=0, le=15)] = 0
    activation: Activation = "softplus"
    limits: Limits = activations.LIMITS

    def __post_init__(self):
        """The first layer reads the features, and there is no other to skip to than the rest."""
        if self.skip >= self.layers:
            raise ValueError(f"'skip' should be a layer behind the first, found {self.skip} of {self.layers}")


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    layers: object  # int64, where each layer begins, as kernels/networks.py has them
    activation: object  # (2,) float, scale (1/length) and shift


def sizes(
    width: int, hidden: int, outputs: int, layers: int = 1, skip: int = 0, **activation
) -> dict[str, int | float]:
    """See decoders; scratch holds features, what the layers made, outputs, and the gradients of features, of
    two layers and of the outputs, these 0 between samples. skip 0: none."""
    rooms = {
        "X": width, "H": layers * hidden, "OUT": outputs, "D_H": hidden, "D_BEFORE": hidden,
        "D_OUT": outputs, "D_X": width * (2 if skip else 1),
    }  # fmt: skip
    starts = np.cumsum([0, *rooms.values()]).tolist()
    return {
        "WIDTH": width, "HIDDEN": hidden, "OUTPUTS": outputs, "LAYERS": layers, "SKIP": skip,
        **dict(zip(rooms, starts, strict=False)), "ROOM": starts[-1], **activations.sizes(**activation),
    }  # fmt: skip


def sections(
    resolution: tuple, width: int, hidden: int, outputs: int, layers: int = 1, skip: int = 0, **activation
) -> list[ParameterBlock]:
    """See decoders; (inputs, outputs) of each layer, whose bias is the last row of its array."""
    shapes = [(width, hidden), *[(hidden, hidden)] * (layers - 1), (hidden, outputs)]
    blocks = [
        ParameterBlock(f"layer_{i}", (n + 1, m), spread=((2 if i < layers else 1) / n) ** 0.5)
        for i, (n, m) in enumerate(shapes)
    ]
    again = [ParameterBlock("again", (width, hidden), spread=(2 / width) ** 0.5)] if skip else []
    return blocks + again


def arrays(field, starts: np.ndarray, **options) -> Arrays:
    """See decoders."""
    return Arrays(starts, field.activation)


def reference(
    field, sections: dict, features: torch.Tensor, width: int, hidden: int, outputs: int, layers: int = 1,
    skip: int = 0, **activation,
) -> tuple[torch.Tensor, torch.Tensor]:  # fmt: skip
    """See decoders."""
    h = features
    for i in range(layers + 1):
        h = h @ sections[f"layer_{i}"][:-1] + sections[f"layer_{i}"][-1]
        if skip and i == skip:
            h = h + features @ sections["again"]
        h = h.relu() if i < layers else h
    return field.scale * activations.reference(h[:, 0] + field.shift, **activation), h


def bound(
    field, sections: dict, features: torch.Tensor, layers: int = 1, skip: int = 0, **options
) -> tuple[float, torch.Tensor]:
    """See decoders."""
    most = features
    for i in range(layers + 1):
        layer = sections[f"layer_{i}"].abs().double()
        most = most @ layer[:-1] + layer[-1]
        if skip and i == skip:
            most = most + features @ sections["again"].abs().double()
    return float(most[0]), most


# -- compiled ------------------------------------------------------------------------------------------------


def outputs_at(field, cell, scratch):
    """Where in scratch all outputs at a point are, computed anew."""
    x, out = np.uint64(AT + X), kept_at()
    features_forward(field, cell, scratch, scratch, AT + X)
    network(
        WIDTH, HIDDEN, LAYERS, SKIP, OUTPUTS, field.params, field.layers, scratch, x, np.uint64(AT + H), out
    )
    return out


def kept_at():
    """Where `outputs_at` has left them."""
    return np.uint64(AT + OUT)


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
    d_out = pending_at(scratch)
    scratch[d_out] += d_sigma * field.activation[0] * activated_slope(pre + field.activation[1])
    network_backward(
        WIDTH, HIDDEN, LAYERS, SKIP, OUTPUTS, field.params, field.layers, scratch, np.uint64(AT + X),
        np.uint64(AT + H), scratch, d_out, np.uint64(AT + D_H), np.uint64(AT + D_BEFORE), np.uint64(AT + D_X),
        grad,
    )  # fmt: skip
    features_backward(field, cell, scratch, AT + D_X, scratch, grad)
    for r in range(np.uint64(OUTPUTS)):
        scratch[d_out + r] = 0
