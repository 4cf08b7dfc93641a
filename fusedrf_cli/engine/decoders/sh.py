"""Colour whose features are the coefficients of spherical harmonics (Plenoxels, Fridovich-Keil et al., CVPR
2022): logit_c = Σ_k Y_k(d) features[c, k]. Where they stand `apart`, the first features are those of degree
1 and more, channel by channel, and the last three those of degree 0."""

import msgspec
import torch

from fusedrf_cli.engine.fields.part_options import Coefficients
from fusedrf_cli.engine.kernels import reference as torch_reference
from fusedrf_cli.engine.kernels.primitives import sh_basis


class Options(msgspec.Struct, forbid_unknown_fields=True):
    """See decoders."""

    coefficients: Coefficients
    apart: bool = False


def sizes(width: int, coefficients: int, apart: bool = False) -> dict[str, int]:
    """See decoders; scratch holds the features or their gradient, and Y. Nothing is kept: Y and the gradient
    of a logit say what is sent back. Of channel c, features[FIRST + c FIRST_STEP] is of degree 0, and the
    others begin at REST + c REST_STEP."""
    return {
        "WIDTH": width, "COEFFICIENTS": coefficients, "ROOM": width + 16,
        "FIRST": width - 3 if apart else 0, "FIRST_STEP": 1 if apart else coefficients,
        "REST": 0 if apart else 1, "REST_STEP": coefficients - 1 if apart else coefficients,
    }  # fmt: skip


def reference(
    field, sections: dict, features: torch.Tensor, dirs: torch.Tensor, width: int, coefficients: int,
    apart: bool = False,
) -> torch.Tensor:  # fmt: skip
    """See decoders."""
    harmonics = torch_reference.sh_basis(coefficients, dirs).to(features.dtype)
    if apart:
        rest = features[:, : 3 * (coefficients - 1)].view(len(features), 3, coefficients - 1)
        features = torch.cat([features[:, -3:, None], rest], 2)
    else:
        features = features[:, : 3 * coefficients].view(-1, 3, coefficients)
    return (features * harmonics[:, None]).sum(2)


def bound(field, sections: dict, features: torch.Tensor, **options) -> float:
    """See decoders; no |Y_k| is above 1."""
    return float(features.sum())


# -- compiled ------------------------------------------------------------------------------------------------


def ray_setup(field, d, scratch):
    """Y of the direction."""
    sh_basis(COEFFICIENTS, d, scratch, AT + WIDTH)


def logit(scratch, c):
    """Σ_k Y_k features[c, k] of the features in scratch."""
    y, total = AT + WIDTH, 0.0
    total += scratch[y] * scratch[AT + FIRST + c * FIRST_STEP]
    for k in range(COEFFICIENTS - 1):
        total += scratch[y + 1 + k] * scratch[AT + REST + c * REST_STEP + k]
    return total


def forward(field, cell, d, scratch, memory, at):
    """See decoders."""
    features_forward(field, cell, scratch, scratch, AT)
    return logit(scratch, 0), logit(scratch, 1), logit(scratch, 2)


def backward(field, cell, d, d_logits, scratch, memory, at, grad):
    """See decoders."""
    y, real = AT + WIDTH, field.params.dtype.type
    for r in range(WIDTH):
        scratch[AT + r] = 0
    for c in range(3):
        scratch[AT + FIRST + c * FIRST_STEP] = real(d_logits[c] * scratch[y])
        for k in range(COEFFICIENTS - 1):
            scratch[AT + REST + c * REST_STEP + k] = real(d_logits[c] * scratch[y + 1 + k])
    features_backward(field, cell, scratch, AT, scratch, grad)
