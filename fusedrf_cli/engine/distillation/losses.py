"""The 3D losses: how a student's σ and colour at points differ from what a teacher said there."""

from dataclasses import dataclass

import torch

from fusedrf_cli.engine.distillation.optimiser import Adam
from fusedrf_cli.engine.distillation.teacher import TeacherPoints
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class LossConfig:
    """What points count in the 3D losses."""

    opaque: float = 5.0
    """Optical depth of a step beyond which more density cannot be seen."""
    depth_gain: float = 10.0
    """In log1p(gain τ): how much thin floaters count."""
    faint: float = 1e-8
    """Optical depth of a step under which a student that should be denser learns as if it had it."""
    most_lift: float = 1e30
    colour_weight: float = 2.0
    hidden_share: float = 0.3
    """What a point counts that nothing is seen of from this ray: from another one it may be."""


def log_depth(depth: torch.Tensor, target: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Losses (N,) of the student's optical depths (N,) of a step against the wanted ones (N,), and their
    derivatives (N,) by the student's: (log1p(g τ_s) - log1p(g τ_t))², with depths beyond `opaque` taken as
    equal: they look the same.

    Raw σ is unstable for dense teachers, and alpha gives a saturated student no gradient; this does.
    """
    config = current(LossConfig)
    target = target.clamp_max(config.opaque)
    error = torch.log1p(config.depth_gain * depth) - torch.log1p(config.depth_gain * target)
    error[(depth >= config.opaque) & (target >= config.opaque)] = 0
    return error**2, 2 * error * config.depth_gain / (1 + config.depth_gain * depth)


def mostly_seen(transmittance: torch.Tensor) -> torch.Tensor:
    """What points count (N,), by the transmittance (N,) of their rays up to them: by what is seen of a point,
    with a share for all, since what this ray does not show another one may."""
    config = current(LossConfig)
    return config.hidden_share + (1 - config.hidden_share) * transmittance


def point_step(student: RadianceField, points: TeacherPoints, step: float, optimiser: Adam) -> float:
    """Mean loss of points, its gradient added to the optimiser's: the density's at optical depths τ = σ step,
    and the squared length of the colour's error by `colour_weight` times the teacher's alpha, both by
    visibility."""
    config = current(LossConfig)
    sigma, rgb = student.query(points.where, points.dirs)
    tau, target = sigma * step, points.sigma * step
    loss, d_tau = log_depth(tau, target)
    # σ = softplus(f) and its slope vanish together: far below `faint` the gradient would be too small
    lift = torch.where(d_tau < 0, (config.faint / tau).clamp(1, config.most_lift), 1)
    counts = mostly_seen(points.transmittance) / len(points)
    shown = config.colour_weight * counts * (1 - torch.exp(-target))
    off = rgb - points.rgb
    student.query_backward(
        points.where,
        points.dirs,
        counts * d_tau * lift * step,
        2 * shown[:, None] * off,
        optimiser.grads,
    )
    return float((counts * loss).sum() + (shown[:, None] * off**2).sum())
