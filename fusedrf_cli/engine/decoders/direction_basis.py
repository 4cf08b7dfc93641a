"""Colour by a learnt basis of directions: logit_c = Σ_r features_r B[c, r](d) (K-Planes' explicit decoder,
Fridovich-Keil et al., CVPR 2023, sec. 3.3), or, where channels have their `own` features, so many each,
logit_c = Σ_r features[c, r] B[r](d) (svox2). B is what a small network makes of the input [d, sin d, sin 2d,
.., cos d, ..]: LAYERS rectified layers of HIDDEN outputs, and one that may be `squashed` by 1 / (1 + e^-x).
It is computed once per ray."""

from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.decoders.mlp import encode
from fusedrf_cli.engine.fields.box import ParameterBlock
from fusedrf_cli.engine.fields.part_options import Frequencies, Layers, Width
from fusedrf_cli.engine.kernels.networks import network, network_backward
from fusedrf_cli.engine.kernels.primitives import add_scaled, dot, sigmoid


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See decoders."""

    hidden: Width
    layers: Layers = 1
    own: Annotated[int, msgspec.Meta(ge=0, le=64)] = 0
    frequencies: Frequencies = 0
    squashed: bool = False


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    layers: object  # (LAYERS + 1,) int64, where a layer's (inputs, outputs) begin, and behind them its bias


def basis_sizes(width: int, own: int) -> tuple[dict[str, int], dict[str, int]]:
    """The constants that `forward` and `backward` ask for, and numbers of scratch by what is there: B, its
    gradient, this 0 between rays, and that of the features. B is filled up to a run of eight."""
    if 3 * own > width:
        raise ValueError(f"three channels with {own} features of their own each need more than {width}")
    outputs = -(-own // 8) * 8 if own else 3 * width
    rooms = {"BASIS": outputs, "D_BASIS": outputs, "D_FEATURES": width}
    return {"WIDTH": width, "OWN": own, "OUTPUTS": outputs, "KEPT": width}, rooms


def layer_shapes(
    width: int, hidden: int, layers: int = 1, own: int = 0, frequencies: int = 0, squashed: bool = False
) -> list[tuple[int, int]]:
    """(inputs, outputs) of each layer."""
    outputs = basis_sizes(width, own)[0]["OUTPUTS"]
    return [(3 + 6 * frequencies, hidden), *[(hidden, hidden)] * (layers - 1), (hidden, outputs)]


def sizes(
    width: int, hidden: int, layers: int = 1, own: int = 0, frequencies: int = 0, squashed: bool = False
) -> dict[str, int]:
    """See decoders; scratch holds what `basis_sizes` says, the input, what the layers made of it, and the
    gradients of two layers and of the input. Features are kept."""
    constants, rooms = basis_sizes(width, own)
    inputs = 3 + 6 * frequencies
    wide = -(-inputs // 8) * 8
    rooms |= {"INPUT": wide, "H": layers * hidden, "D_H": hidden, "D_BEFORE": hidden, "D_INPUT": wide}
    starts = np.cumsum([0, *rooms.values()]).tolist()
    return constants | {
        "HIDDEN": hidden, "LAYERS": layers, "INPUTS": inputs, "CORE": 3, "FREQUENCIES": frequencies,
        "SQUASHED": int(squashed), **dict(zip(rooms, starts, strict=False)), "ROOM": starts[-1],
    }  # fmt: skip


def sections(resolution: tuple, **options) -> list[ParameterBlock]:
    """See decoders; a layer's bias is the last row of its array."""
    shapes = enumerate(layer_shapes(**options))
    return [ParameterBlock(f"layer_{i}", (n + 1, m), rate=1 / 3, spread=n**-0.5) for i, (n, m) in shapes]


def arrays(field, starts: np.ndarray, **options) -> Arrays:
    """See decoders."""
    return Arrays(starts)


def reference(
    field, sections: dict, features: torch.Tensor, dirs: torch.Tensor, width: int, layers: int = 1,
    own: int = 0, frequencies: int = 0, squashed: bool = False, **options,
) -> torch.Tensor:  # fmt: skip
    """See decoders."""
    waves = [wave(2.0**level * dirs) for wave in (torch.sin, torch.cos) for level in range(frequencies)]
    made = torch.cat([dirs, *waves], 1).to(features.dtype)
    for i in range(layers + 1):
        made = made @ sections[f"layer_{i}"][:-1] + sections[f"layer_{i}"][-1]
        made = made.relu() if i < layers else made
    return logits_of(made.sigmoid() if squashed else made, features, own)


def logits_of(basis: torch.Tensor, features: torch.Tensor, own: int) -> torch.Tensor:
    """(N, 3) of B (N, OUTPUTS) and features (N, WIDTH)."""
    if own:
        return (basis[:, None, :own] * features[:, : 3 * own].view(-1, 3, own)).sum(2)
    return (basis.view(len(basis), 3, -1) * features[:, None]).sum(2)


def bound(
    field, sections: dict, features: torch.Tensor, layers: int = 1, own: int = 0, squashed: bool = False,
    **options,
) -> float:  # fmt: skip
    """See decoders; no part of the input is above 1."""
    most = sections["layer_0"].new_ones(len(sections["layer_0"]) - 1).double()
    for i in range(layers + 1):
        layer = sections[f"layer_{i}"].abs().double()
        most = most @ layer[:-1] + layer[-1]
    most = torch.ones_like(most) if squashed else most
    return float(logits_of(most[None], features[None], own).max())


# -- compiled ------------------------------------------------------------------------------------------------


def ray_setup(field, d, scratch):
    """B of the direction into scratch[AT + BASIS:], channel by channel."""
    x, basis = np.uint64(AT + INPUT), np.uint64(AT + BASIS)
    scratch[x], scratch[x + np.uint64(1)], scratch[x + np.uint64(2)] = d
    encode(scratch, x)
    h = np.uint64(AT + H)
    network(INPUTS, HIDDEN, LAYERS, 0, OUTPUTS, field.params, field.layers, scratch, x, h, basis)
    if SQUASHED:
        for r in range(np.uint64(OUTPUTS)):
            scratch[basis + r] = sigmoid(scratch[basis + r])


def ray_backward(field, d, scratch, grad):
    """Adjoint of `ray_setup`; clears the gradient."""
    d_basis = np.uint64(AT + D_BASIS)
    if SQUASHED:
        for r in range(np.uint64(OUTPUTS)):
            made = scratch[np.uint64(AT + BASIS) + r]
            scratch[d_basis + r] *= made * (1 - made)
    network_backward(
        INPUTS, HIDDEN, LAYERS, 0, OUTPUTS, field.params, field.layers, scratch, np.uint64(AT + INPUT),
        np.uint64(AT + H), scratch, d_basis, np.uint64(AT + D_H), np.uint64(AT + D_BEFORE),
        np.uint64(AT + D_INPUT), grad,
    )  # fmt: skip
    for r in range(np.uint64(OUTPUTS)):
        scratch[d_basis + r] = 0


def forward(field, cell, d, scratch, memory, at):
    """See decoders; the features are kept."""
    features_forward(field, cell, scratch, memory, at)
    return logit(scratch, memory, at, 0), logit(scratch, memory, at, 1), logit(scratch, memory, at, 2)


def logit(scratch, memory, at, c):
    """That of channel c, of the features in memory[at:]."""
    if OWN:
        return dot(OWN, scratch, np.uint64(AT + BASIS), memory, np.uint64(at + c * OWN))
    return dot(WIDTH, scratch, np.uint64(AT + BASIS + c * WIDTH), memory, np.uint64(at))


def backward(field, cell, d, d_logits, scratch, memory, at, grad):
    """See decoders."""
    d_features, basis, d_basis = np.uint64(AT + D_FEATURES), np.uint64(AT + BASIS), np.uint64(AT + D_BASIS)
    for r in range(np.uint64(WIDTH)):
        scratch[d_features + r] = 0
    for c in range(3):
        d_logit = scratch.dtype.type(d_logits[0] if c == 0 else (d_logits[1] if c == 1 else d_logits[2]))
        if OWN:
            row = np.uint64(c * OWN)
            for r in range(np.uint64(OWN)):
                scratch[d_features + row + r] = d_logit * scratch[basis + r]
                scratch[d_basis + r] += d_logit * memory[np.uint64(at) + row + r]
        else:
            row = np.uint64(c * WIDTH)
            add_scaled(WIDTH, scratch, d_features, d_logit, scratch, basis + row)
            add_scaled(WIDTH, scratch, d_basis + row, d_logit, memory, np.uint64(at))
    features_backward(field, cell, scratch, AT + D_FEATURES, scratch, grad)
