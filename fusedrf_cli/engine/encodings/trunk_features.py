"""What a trunk (decoders/trunk.py) hands on to the colour: all of its outputs, the density's included. It
locates nothing: the cell of the density's encoding serves it."""

from typing import NamedTuple

import numpy as np
import torch

from fusedrf_cli.engine.fields.box import Part


class Arrays(NamedTuple):
    """Nothing is read beside the trunk's outputs."""


def sizes(outputs: int) -> dict[str, int]:
    """See encodings."""
    return {"WIDTH": outputs, "ROOM": 0}


def sections(resolution: tuple[int, int, int], outputs: int) -> list[Part]:
    """None: nothing is learnt."""
    return []


def arrays(field, starts: np.ndarray, outputs: int) -> Arrays:
    """See encodings."""
    return Arrays()


def reference(sections: dict, unit: torch.Tensor, read: torch.Tensor, outputs: int) -> torch.Tensor:
    """See encodings."""
    return read


def bound(sections: dict, read: torch.Tensor, outputs: int) -> torch.Tensor:
    """See encodings."""
    return read


# -- compiled ------------------------------------------------------------------------------------------------


def forward(field, cell, scratch, out, base):
    """See encodings."""
    start, source = np.uint64(base), features_outputs_at(field, cell, scratch)
    for r in range(np.uint64(WIDTH)):
        out[start + r] = scratch[source + r]


def backward(field, cell, d, base, scratch, grad):
    """See encodings; the trunk sends it on."""
    start, pending = np.uint64(base), features_pending_at(scratch)
    for r in range(np.uint64(WIDTH)):
        scratch[pending + r] += d[start + r]


def prefetch_at(field, array, cell):
    """Nothing: the trunk's own encoding is asked for."""
