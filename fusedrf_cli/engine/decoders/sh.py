"""Colour whose features are the coefficients of spherical harmonics (Plenoxels, Fridovich-Keil et al., CVPR
2022): logit_c = Σ_k Y_k(d) features[c, k]."""

import torch

from fusedrf_cli.engine.kernels import reference as torch_reference
from fusedrf_cli.engine.kernels.parts import sh_basis


def sizes(width: int, coefficients: int) -> dict[str, int]:
    """See decoders; scratch holds the features or their gradient, and Y. Nothing is kept: Y and the gradient
    of a logit say what is sent back."""
    return {"WIDTH": width, "COEFFICIENTS": coefficients, "ROOM": width + 16}


def reference(
    field, sections: dict, features: torch.Tensor, dirs: torch.Tensor, width: int, coefficients: int
) -> torch.Tensor:
    """See decoders."""
    harmonics = torch_reference.sh_basis(coefficients, dirs).to(features.dtype)
    return (features[:, : 3 * coefficients].view(-1, 3, coefficients) * harmonics[:, None]).sum(2)


def bound(field, sections: dict, features: torch.Tensor, width: int, coefficients: int) -> float:
    """See decoders; no |Y_k| is above 1."""
    return float(features[: 3 * coefficients].sum())


# -- compiled ------------------------------------------------------------------------------------------------


def ray_setup(field, d, scratch):
    """Y of the direction."""
    sh_basis(COEFFICIENTS, d, scratch, AT + WIDTH)


def logit(scratch, c):
    """Σ_k Y_k features[c, k] of the features in scratch."""
    total = 0.0
    for k in range(COEFFICIENTS):
        total += scratch[AT + WIDTH + k] * scratch[AT + c * COEFFICIENTS + k]
    return total


def forward(field, cell, d, scratch, memory, at):
    """See decoders."""
    features_forward(field, cell, scratch, scratch, AT)
    return logit(scratch, 0), logit(scratch, 1), logit(scratch, 2)


def backward(field, cell, d, d_logits, scratch, memory, at, grad):
    """See decoders."""
    for r in range(3 * COEFFICIENTS, WIDTH):
        scratch[AT + r] = 0
    for c in range(3):
        for k in range(COEFFICIENTS):
            scratch[AT + c * COEFFICIENTS + k] = field.params.dtype.type(
                d_logits[c] * scratch[AT + WIDTH + k]
            )
    features_backward(field, cell, scratch, AT, scratch, grad)
