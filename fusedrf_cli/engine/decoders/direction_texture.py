"""Colour by a basis of directions that is learnt as a texture (svox2, Fridovich-Keil et al., CVPR 2022):
logit_c = Σ_r features[c, r] B[r](d) of `own` features of each channel. B are the rectified rows of a cube of
`side`³ vertices around the directions, trilinear between them. It is computed once per ray."""

from typing import Annotated, NamedTuple

import msgspec
import numpy as np
import torch

from fusedrf_cli.engine.decoders.direction_basis import (  # noqa: F401
    backward,
    basis_sizes,
    forward,
    logits_of,
)
from fusedrf_cli.engine.fields.box import ParameterBlock, largest
from fusedrf_cli.engine.kernels.primitives import add_scaled, scatter
from fusedrf_cli.engine.kernels.reference import trilinear


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See decoders."""

    own: Annotated[int, msgspec.Meta(ge=1, le=64)]
    side: Annotated[int, msgspec.Meta(ge=2, le=256)]


class Arrays(NamedTuple):
    """What the functions read beside `params`."""

    start: object  # int64, where the texture begins


def sizes(width: int, own: int, side: int) -> dict[str, int]:
    """See decoders and `basis_sizes`."""
    constants, rooms = basis_sizes(width, own)
    starts = np.cumsum([0, *rooms.values()]).tolist()
    return constants | {"SIDE": side, **dict(zip(rooms, starts, strict=False)), "ROOM": starts[-1]}


def sections(resolution: tuple, width: int, own: int, side: int) -> list[ParameterBlock]:
    """See decoders."""
    outputs = sizes(width, own, side)["OUTPUTS"]
    return [ParameterBlock("texture", (side, side, side, outputs), rate=1 / 3, spread=0.3, columns=own)]


def arrays(field, starts: np.ndarray, **options) -> Arrays:
    """See decoders."""
    return Arrays(np.int64(starts[0]))


def reference(
    field, sections: dict, features: torch.Tensor, dirs: torch.Tensor, width: int, own: int, side: int
) -> torch.Tensor:
    """See decoders."""
    return logits_of(trilinear(sections["texture"], (dirs + 1) / 2).relu().to(features.dtype), features, own)


def bound(field, sections: dict, features: torch.Tensor, width: int, own: int, side: int) -> float:
    """See decoders."""
    return float(logits_of(largest(sections["texture"], kept=1)[None], features[None], own).max())


# -- compiled ------------------------------------------------------------------------------------------------


def below(x):
    """The vertex of the cube below a coordinate from -1 to 1, and the share of the one above."""
    f = min(max(0.5 * x + 0.5, 0.0), 1.0) * (SIDE - 1)
    i = min(int(f), SIDE - 2)
    return i, f - i


def corner(field, d, q):
    """Where row q = 4 a + 2 b + c around a direction begins, and its weight."""
    a, b, c = q >> 2, (q >> 1) & 1, q & 1
    (i, u), (j, v), (k, w) = below(d[0]), below(d[1]), below(d[2])
    weight = (u if a else 1.0 - u) * (v if b else 1.0 - v) * (w if c else 1.0 - w)
    row = np.uint64(field.start + (((i + a) * SIDE + j + b) * SIDE + k + c) * OUTPUTS)
    return row, field.params.dtype.type(weight)


def ray_setup(field, d, scratch):
    """B of the direction into scratch[AT + BASIS:]."""
    basis = np.uint64(AT + BASIS)
    for r in range(np.uint64(OUTPUTS)):
        scratch[basis + r] = 0
    for q in range(8):
        row, weight = corner(field, d, q)
        add_scaled(OUTPUTS, scratch, basis, weight, field.params, row)
    for r in range(np.uint64(OUTPUTS)):
        scratch[basis + r] = max(scratch[basis + r], 0)


def ray_backward(field, d, scratch, grad):
    """Adjoint of `ray_setup`; clears the gradient."""
    basis, d_basis = np.uint64(AT + BASIS), np.uint64(AT + D_BASIS)
    for r in range(np.uint64(OUTPUTS)):
        if scratch[basis + r] <= 0:
            scratch[d_basis + r] = 0
    for q in range(8):
        row, weight = corner(field, d, q)
        scatter(OUTPUTS, grad, row, weight, scratch, d_basis)
    for r in range(np.uint64(OUTPUTS)):
        scratch[d_basis + r] = 0
