"""Colour that is the same from all sides: the logits are the first three features (DVGO, Sun
et al., CVPR 2022)."""

import msgspec
import torch


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See decoders."""


def sizes(width: int) -> dict[str, int]:
    """See decoders; scratch holds the features' gradient. They are kept."""
    return {"WIDTH": width, "ROOM": width, "KEPT": width}


def reference(field, sections: dict, features: torch.Tensor, dirs: torch.Tensor, width: int) -> torch.Tensor:
    """See decoders."""
    return features[:, :3]


def bound(field, sections: dict, features: torch.Tensor, width: int) -> float:
    """See decoders."""
    return float(features[:3].max())


# -- compiled ------------------------------------------------------------------------------------------------


def forward(field, cell, d, scratch, memory, at):
    """See decoders."""
    features_forward(field, cell, scratch, memory, at)
    return memory[at], memory[at + 1], memory[at + 2]


def backward(field, cell, d, d_logits, scratch, memory, at, grad):
    """See decoders."""
    for r in range(WIDTH):
        scratch[AT + r] = 0
    for c in range(3):
        scratch[AT + c] = field.params.dtype.type(d_logits[c])
    features_backward(field, cell, scratch, AT, scratch, grad)
