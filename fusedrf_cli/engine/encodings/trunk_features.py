"""What a trunk (decoders/trunk.py) hands on to the colour: all of its outputs, the density's included."""

import msgspec
import numpy as np
import torch


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See encodings."""


def sizes(outputs: int) -> dict[str, int]:
    """See encodings."""
    return {"WIDTH": outputs}


def reference(field, sections: dict, unit: torch.Tensor, read: torch.Tensor, outputs: int) -> torch.Tensor:
    """See encodings."""
    return read


def bound(sections: dict, read: torch.Tensor, outputs: int) -> torch.Tensor:
    """See encodings."""
    return read


locate = None  # the cell of the density's encoding serves
READS_SCRATCH = True  # kernels/assembled.py: it is told whether sigma has just handed them on


# -- compiled ------------------------------------------------------------------------------------------------


def forward(field, cell, scratch, out, base):
    """See encodings."""
    start, source = np.uint64(base), features_kept_at()
    if cell[2] == 0:
        features_hand_on(field, cell[0], cell[1], scratch)
    for r in range(np.uint64(WIDTH)):
        out[start + r] = scratch[source + r]


def backward(field, cell, d, base, scratch, grad):
    """See encodings; the trunk sends it on."""
    start, pending = np.uint64(base), features_pending_at(scratch)
    for r in range(np.uint64(WIDTH)):
        scratch[pending + r] += d[start + r]
