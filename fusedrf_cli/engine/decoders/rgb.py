"""Colour that is the same from all sides: rgb_c = sigmoid(features_c) of the first three features (DVGO, Sun
et al., CVPR 2022)."""

import torch

from fusedrf_cli.engine.kernels.parts import sigmoid


def sizes(width: int) -> dict[str, int]:
    """See decoders; scratch holds the features' gradient. They are kept."""
    return {"WIDTH": width, "ROOM": width, "KEPT": width}


def reference(field, sections: dict, features: torch.Tensor, dirs: torch.Tensor, width: int) -> torch.Tensor:
    """See decoders."""
    return features[:, :3].sigmoid()


def bound(field, sections: dict, features: torch.Tensor, width: int) -> float:
    """See decoders."""
    return float(features[:3].max())


# -- compiled ------------------------------------------------------------------------------------------------


def forward(field, cell, d, scratch, memory, at):
    """See decoders."""
    features_forward(field, cell, scratch, memory, at)
    return float(sigmoid(memory[at])), float(sigmoid(memory[at + 1])), float(sigmoid(memory[at + 2]))


def backward(field, cell, d, rgb, d_rgb, scratch, memory, at, grad):
    """See decoders."""
    for r in range(WIDTH):
        scratch[AT + r] = 0
    for c in range(3):
        scratch[AT + c] = field.params.dtype.type(d_rgb[c] * rgb[c] * (1 - rgb[c]))
    features_backward(field, cell, scratch, AT, scratch, grad)
