"""What a `dense` field answers, in plain torch; notation as in bodies.py."""

import torch

from fusedrf_cli.engine.kernels.reference import cell_at, density, exact, sh_basis, trilinear


def query(
    field, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) and rgb (N, 3) of a dense field with numbers params (P,) at points (N, 3) along unit dirs (N,
    3); empty cells answer 0. Differentiable in params, points and dirs."""
    sigma, rows = interpolated(field, params, points)
    count = field.shape.coefficients
    shown = sh_basis(count, exact(dirs, params.device)).to(params.dtype)
    logits = (rows[:, : 3 * count].view(-1, 3, count) * shown[:, None]).sum(2)
    return sigma, torch.where((sigma > 0)[:, None], logits.sigmoid(), 0)


def interpolated(field, params: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,), 0 in empty cells, and rows (N, WIDTH) at points (N, 3)."""
    sections, kind = field.with_params(params).sections(), params.dtype
    points, box = exact(points, params.device), exact(field.box, params.device)
    unit = ((points - box[:3]) / (box[3:] - box[:3])).to(kind)
    feature = trilinear(sections["density"][..., None], unit)[:, 0]
    _, occupied = cell_at(field.occupancy, points)
    sigma = torch.where(occupied, density(feature, field.scale, field.shift), 0)
    return sigma, trilinear(sections["colour"], unit)
