"""The 3D losses: how a student's σ and colour at points differ from what a teacher said there."""

from collections.abc import Callable

import torch

from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.distillation.teacher import Points
from fusedrf_cli.engine.fields.base import RadianceField

OPAQUE = 5.0  # optical depth of a step beyond which more density cannot be seen
DEPTH_GAIN = 10.0  # in log1p(gain τ): how much thin fog counts
FAINT = 1e-8  # optical depth of a step under which a student that should be denser learns as if it had it
MOST_LIFT = 1e30
COLOUR_WEIGHT = 2.0
HIDDEN_SHARE = 0.3  # what a point counts that nothing is seen of from this ray: from another one it may be

DensityLoss = Callable[[torch.Tensor, torch.Tensor], tuple[torch.Tensor, torch.Tensor]]
"""Losses (N,) of the student's optical depths (N,) of a step against the wanted ones (N,), and their
derivatives (N,) by the student's."""
Visibility = Callable[[torch.Tensor], torch.Tensor]
"""What points count (N,), by the transmittance (N,) of their rays up to them."""


def log_depth(depth: torch.Tensor, wanted: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(log1p(g τ_s) - log1p(g τ_t))², with depths beyond OPAQUE taken as equal: they look the same.

    Raw σ is unstable for dense teachers, and alpha gives a saturated student no gradient; this does.
    """
    wanted = wanted.clamp_max(OPAQUE)
    error = torch.log1p(DEPTH_GAIN * depth) - torch.log1p(DEPTH_GAIN * wanted)
    error[(depth >= OPAQUE) & (wanted >= OPAQUE)] = 0
    return error**2, 2 * error * DEPTH_GAIN / (1 + DEPTH_GAIN * depth)


def mostly_seen(transmittance: torch.Tensor) -> torch.Tensor:
    """By what is seen of a point, with a share for all: what this ray does not show another one may."""
    return HIDDEN_SHARE + (1 - HIDDEN_SHARE) * transmittance


def point_step(
    student: RadianceField,
    points: Points,
    step: float,
    optimiser: Adam,
    density_loss: DensityLoss = log_depth,
    visibility: Visibility = mostly_seen,
) -> float:
    """Mean loss of points, its gradient added to the optimiser's: the density's at optical depths τ = σ step,
    and the squared length of the colour's error by COLOUR_WEIGHT times the teacher's alpha, both by
    visibility."""
    sigma, rgb = student.query(points.where, points.dirs)
    tau, wanted = sigma * step, points.sigma * step
    loss, d_tau = density_loss(tau, wanted)
    # σ = softplus(f) and its slope vanish together: far below FAINT the gradient would be too small a number
    lift = torch.where(d_tau < 0, (FAINT / tau).clamp(1, MOST_LIFT), 1)
    counts = visibility(points.transmittance) / len(points)
    shown = COLOUR_WEIGHT * counts * (1 - torch.exp(-wanted))
    off = rgb - points.rgb
    student.query_backward(
        points.where,
        points.dirs,
        counts * d_tau * lift * step,
        2 * shown[:, None] * off,
        optimiser.grads,
    )
    return float((counts * loss).sum() + (shown[:, None] * off**2).sum())
