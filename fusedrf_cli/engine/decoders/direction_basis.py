"""Colour by a learnt basis of directions: logit_c = Σ_r features_r B[c, r](d). B is what a small network
makes of the direction: LAYERS rectified layers of HIDDEN outputs and one of 3 WIDTH (K-Planes' explicit decoder,
Fridovich-Keil et al., CVPR 2023, sec. 3.3). It is computed once per ray."""

from typing import NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.fields.box import ParameterBlock
from fusedrf_cli.engine.fields.part_options import Layers, Width
from fusedrf_cli.engine.kernels.primitives import add_scaled, dense, dense_backward, dot, rectify

INPUTS = 3
"""Of the network: the direction itself."""


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See decoders."""

    hidden: Width
    layers: Layers = 1


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    layers: object  # (LAYERS + 1,) int64, where a layer's (inputs, outputs) begin, and behind them its bias


def layer_shapes(width: int, hidden: int, layers: int = 1) -> list[tuple[int, int]]:
    """(inputs, outputs) of each layer."""
    return [(INPUTS, hidden), *[(hidden, hidden)] * (layers - 1), (hidden, 3 * width)]


def sizes(width: int, hidden: int, layers: int = 1) -> dict[str, int]:
    """See decoders; scratch holds B, its gradient, this 0 between rays, that of the features, the direction,
    what the layers made of it, and the gradients of two layers. Features are kept."""
    rooms = {
        "BASIS": 3 * width, "D_BASIS": 3 * width, "D_FEATURES": width, "DIRECTION": 8, "H": layers * hidden,
        "D_H": hidden, "D_BEFORE": hidden,
    }  # fmt: skip
    starts = np.cumsum([0, *rooms.values()]).tolist()
    return {
        "WIDTH": width, "HIDDEN": hidden, "LAYERS": layers, "OUTPUTS": 3 * width,
        **dict(zip(rooms, starts, strict=False)), "ROOM": starts[-1], "KEPT": width,
    }  # fmt: skip


def sections(resolution: tuple, width: int, hidden: int, layers: int = 1) -> list[ParameterBlock]:
    """See decoders; a layer's bias is the last row of its array."""
    shapes = enumerate(layer_shapes(width, hidden, layers))
    return [ParameterBlock(f"layer_{i}", (n + 1, m), rate=1 / 3, spread=n**-0.5) for i, (n, m) in shapes]


def arrays(field, starts: np.ndarray, **options) -> Arrays:
    """See decoders."""
    return Arrays(starts)


def reference(
    field, sections: dict, features: torch.Tensor, dirs: torch.Tensor, width: int, layers: int = 1, **options
) -> torch.Tensor:
    """See decoders."""
    made = dirs.to(features.dtype)
    for i in range(layers + 1):
        made = made @ sections[f"layer_{i}"][:-1] + sections[f"layer_{i}"][-1]
        made = made.relu() if i < layers else made
    return (made.view(-1, 3, width) * features[:, None]).sum(2)


def bound(field, sections: dict, features: torch.Tensor, width: int, layers: int = 1, **options) -> float:
    """See decoders; no part of a direction is above 1."""
    most = torch.ones(INPUTS, dtype=torch.float64)
    for i in range(layers + 1):
        layer = sections[f"layer_{i}"].abs().double()
        most = most @ layer[:-1] + layer[-1]
    return float((most.view(3, width) * features).sum(1).max())


# -- compiled ------------------------------------------------------------------------------------------------


def ray_setup(field, d, scratch):
    """B of the direction into scratch[AT + BASIS:], channel by channel."""
    x, h, params = np.uint64(AT + DIRECTION), np.uint64(AT + H), field.params
    scratch[x], scratch[x + np.uint64(1)], scratch[x + np.uint64(2)] = d
    dense(INPUTS, HIDDEN, params, np.uint64(field.layers[0]), scratch, x, scratch, h)
    rectify(HIDDEN, scratch, h)
    for layer in range(1, LAYERS):
        below, h = h, h + np.uint64(HIDDEN)
        dense(HIDDEN, HIDDEN, params, np.uint64(field.layers[layer]), scratch, below, scratch, h)
        rectify(HIDDEN, scratch, h)
    last = np.uint64(field.layers[LAYERS])
    dense(HIDDEN, OUTPUTS, params, last, scratch, h, scratch, np.uint64(AT + BASIS))


def ray_backward(field, d, scratch, grad):
    """Adjoint of `ray_setup`; clears the gradient."""
    params, d_basis, h = field.params, np.uint64(AT + D_BASIS), np.uint64(AT + H + (LAYERS - 1) * HIDDEN)
    d_h, d_before, last = np.uint64(AT + D_H), np.uint64(AT + D_BEFORE), np.uint64(field.layers[LAYERS])
    dense_backward(HIDDEN, OUTPUTS, params, last, scratch, h, True, scratch, d_basis, scratch, d_h, grad)
    for back in range(1, LAYERS):
        layer, h = np.uint64(field.layers[LAYERS - back]), h - np.uint64(HIDDEN)
        dense_backward(HIDDEN, HIDDEN, params, layer, scratch, h, True, scratch, d_h, scratch, d_before, grad)
        d_h, d_before = d_before, d_h
    x, first = np.uint64(AT + DIRECTION), np.uint64(field.layers[0])
    dense_backward(INPUTS, HIDDEN, params, first, scratch, x, False, scratch, d_h, scratch, d_before, grad)
    for r in range(np.uint64(OUTPUTS)):
        scratch[d_basis + r] = 0


def forward(field, cell, d, scratch, memory, at):
    """See decoders; the features are kept."""
    features_forward(field, cell, scratch, memory, at)
    f = np.uint64(at)
    r = dot(WIDTH, scratch, np.uint64(AT + BASIS), memory, f)
    g = dot(WIDTH, scratch, np.uint64(AT + BASIS + WIDTH), memory, f)
    b = dot(WIDTH, scratch, np.uint64(AT + BASIS + 2 * WIDTH), memory, f)
    return r, g, b


def backward(field, cell, d, d_logits, scratch, memory, at, grad):
    """See decoders."""
    d_features, basis, d_basis = np.uint64(AT + D_FEATURES), np.uint64(AT + BASIS), np.uint64(AT + D_BASIS)
    for r in range(np.uint64(WIDTH)):
        scratch[d_features + r] = 0
    for c in range(3):
        d_logit = scratch.dtype.type(d_logits[0] if c == 0 else (d_logits[1] if c == 1 else d_logits[2]))
        row = np.uint64(c * WIDTH)
        add_scaled(WIDTH, scratch, d_features, d_logit, scratch, basis + row)
        add_scaled(WIDTH, scratch, d_basis + row, d_logit, memory, np.uint64(at))
    features_backward(field, cell, scratch, AT + D_FEATURES, scratch, grad)
