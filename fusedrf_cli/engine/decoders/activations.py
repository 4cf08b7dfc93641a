"""What makes a density of a number: σ = scale a(f + shift), `a` one of NAMES by the constant ACTIVATION.

softplus   log(1 + e^x)            TensoRF (Chen et al., ECCV 2022), Mip-NeRF
exp        e^x, x at most 15       Instant-NGP (Müller et al. 2022), whose gradient goes on beyond
relu       max(0, x)               NeRF (Mildenhall et al., ECCV 2020), Plenoxels
"""

import math

import torch

from fusedrf_cli.engine.kernels.primitives import sigmoid, softplus

NAMES = "softplus", "exp", "relu"
LARGEST = 15.0  # of what is exponentiated


def reference(name: str, x: torch.Tensor) -> torch.Tensor:
    """a(x) in plain torch."""
    if name == "relu":
        return x.relu()
    return x.clamp_max(LARGEST).exp() if name == "exp" else torch.nn.functional.softplus(x, threshold=40)


def activated(x):
    """a(x)."""
    if ACTIVATION == 0:
        return softplus(x)
    return math.exp(min(x, LARGEST)) if ACTIVATION == 1 else max(x, 0.0)


def activated_slope(x):
    """a'(x)."""
    if ACTIVATION == 0:
        return sigmoid(x)
    return math.exp(min(x, LARGEST)) if ACTIVATION == 1 else (1.0 if x > 0.0 else 0.0)
