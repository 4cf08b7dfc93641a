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
from fusedrf_cli.engine.kernels.lanes import LANES, network_lanes
from fusedrf_cli.engine.kernels.networks import network, network_backward
from fusedrf_cli.engine.kernels.primitives import LINE


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
    two layers and of the outputs, these 0 between samples. skip 0: none. From LANE_AT on it holds how many
    lanes are in use, where they are, their features, two layers and outputs (kernels/lanes.py)."""
    rooms = {
        "X": width, "H": layers * hidden, "OUT": outputs, "D_H": hidden, "D_BEFORE": hidden,
        "D_OUT": outputs, "D_X": width * (2 if skip else 1),
    }  # fmt: skip
    lanes = {"LANE_KEY": LINE, "LANE_X": 6 * LANES, "LANE_H": width * LANES, "LANE_OUT": 2 * hidden * LANES}
    starts, lane_starts = (np.cumsum([0, *counts.values()]).tolist() for counts in (rooms, lanes))
    return {
        **dict(zip(lanes, lane_starts[1:], strict=True)), "LANES": LANES,
        "LANE_ROOM": lane_starts[-1] + outputs * LANES,
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


def hand_on(field, unit, cell, scratch):
    """Leave all outputs at a point where `kept_at` says: those of a lane, if one knows them."""
    lane = lane_of(unit, scratch)
    if lane >= 0:
        of_lane(field, lane, scratch)
    else:
        outputs_at(field, cell, scratch)


def kept_at():
    """Where `outputs_at` has left them."""
    return np.uint64(AT + OUT)


def pending_at(scratch):
    """Where in scratch the gradient of the outputs gathers."""
    return np.uint64(AT + D_OUT)


def forward(field, cell, scratch):
    """See decoders."""
    outputs_at(field, cell, scratch)
    return density_of(field, scratch)


def key_of(u, scratch):
    """A coordinate as two numbers of scratch's type, which tell neighbours of float64 apart."""
    high = scratch.dtype.type(u)
    return high, scratch.dtype.type(u - high)


def lane_of(unit, scratch):
    """The lane of these coordinates, or -1."""
    if scratch.shape[0] <= LANE_AT:
        return -1
    u, v, w = key_of(unit[0], scratch), key_of(unit[1], scratch), key_of(unit[2], scratch)
    for lane in range(np.uint64(scratch[LANE_AT])):
        at = np.uint64(LANE_AT + LANE_KEY) + np.uint64(6) * lane
        if scratch[at] == u[0] and scratch[at + np.uint64(2)] == v[0] and scratch[at + np.uint64(4)] == w[0]:
            if scratch[at + np.uint64(1)] == u[1] and scratch[at + np.uint64(3)] == v[1]:
                if scratch[at + np.uint64(5)] == w[1]:
                    return np.int64(lane)
    return -1


def enter_lane(field, cell, unit, lane, scratch):
    """The features of a cell into a lane."""
    features_forward(field, cell, scratch, scratch, AT + X)
    at, to = np.uint64(LANE_AT + LANE_KEY + 6 * lane), np.uint64(LANE_AT + LANE_X + lane)
    scratch[at], scratch[at + np.uint64(1)] = key_of(unit[0], scratch)
    scratch[at + np.uint64(2)], scratch[at + np.uint64(3)] = key_of(unit[1], scratch)
    scratch[at + np.uint64(4)], scratch[at + np.uint64(5)] = key_of(unit[2], scratch)
    for r in range(np.uint64(WIDTH)):
        scratch[to + r * np.uint64(LANES)] = scratch[np.uint64(AT + X) + r]


def fill_lanes(field, count, scratch):
    """The outputs in all lanes, of which so many are in use."""
    scratch[LANE_AT] = count
    if count > 0:
        network_lanes(
            WIDTH, HIDDEN, LAYERS, SKIP, OUTPUTS, field.params, field.layers, scratch,
            np.uint64(LANE_AT + LANE_X), np.uint64(LANE_AT + LANE_H), np.uint64(LANE_AT + LANE_OUT),
        )  # fmt: skip


def of_lane(field, lane, scratch):
    """`forward` by what is in a lane, whose outputs are handed on."""
    out, at = kept_at(), np.uint64(LANE_AT + LANE_OUT + lane)
    for r in range(np.uint64(OUTPUTS)):
        scratch[out + r] = scratch[at + r * np.uint64(LANES)]
    return density_of(field, scratch)


def density_of(field, scratch):
    """σ, and what `backward` needs of it, by the outputs that are kept."""
    f = scratch[kept_at()]
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
