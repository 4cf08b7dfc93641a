"""What makes a density of a number: σ = scale a(f + shift), `a` one of NAMES by the constant ACTIVATION; and
what makes a colour of one, one of COLOURS by the constant COLOUR_ACTIVATION.

softplus   log(1 + e^x)            TensoRF (Chen et al., ECCV 2022), Mip-NeRF
exp        e^x, x in `limits`      Instant-NGP (Müller et al. 2022), whose gradient goes on beyond
relu       max(0, x)               NeRF (Mildenhall et al., ECCV 2020), Plenoxels

sigmoid    1 / (1 + e^-x)          NeRF
relu       max(0, x + 1/2)         Plenoxels (Fridovich-Keil et al., CVPR 2022), 3D Gaussian splatting
none       x                       TensoRF's RGB shading
exp        e^x, |x| at most 10     Instant-NGP's scenes of high dynamic range
"""

import math

import torch

from fusedrf_cli.engine.kernels.primitives import sigmoid, softplus

NAMES = "softplus", "exp", "relu"
COLOURS = "sigmoid", "relu", "none", "exp"
LIMITS = -80.0, 15.0
"""Of what is exponentiated, where nothing else is said."""


def sizes(activation: str = "softplus", limits: tuple[float, float] = LIMITS) -> dict[str, int | float]:
    """The constants of a decoder of density."""
    return {
        "ACTIVATION": NAMES.index(activation), "LOWEST": float(limits[0]), "HIGHEST": float(limits[1])
    }  # fmt: skip


def reference(
    x: torch.Tensor, activation: str = "softplus", limits: tuple[float, float] = LIMITS
) -> torch.Tensor:
    """a(x) of a density in plain torch."""
    if activation == "relu":
        return x.relu()
    if activation == "exp":
        return (x + (x.clamp(*limits) - x).detach()).exp()
    return torch.nn.functional.softplus(x, threshold=40)


def colour_reference(name: str, x: torch.Tensor) -> torch.Tensor:
    """The same of a colour."""
    if name == "sigmoid":
        return x.sigmoid()
    if name == "exp":
        return x.clamp(-10, 10).exp()
    return (x + 0.5).relu() if name == "relu" else x


def activated(x):
    """a(x)."""
    if ACTIVATION == 0:
        return softplus(x)
    return math.exp(min(max(x, LOWEST), HIGHEST)) if ACTIVATION == 1 else max(x, 0.0)


def activated_slope(x):
    """a'(x)."""
    if ACTIVATION == 0:
        return sigmoid(x)
    return math.exp(min(max(x, LOWEST), HIGHEST)) if ACTIVATION == 1 else (1.0 if x > 0.0 else 0.0)
