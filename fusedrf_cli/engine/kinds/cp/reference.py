"""What a `cp` field answers, in plain torch; notation as in bodies.py."""

import torch

from fusedrf_cli.engine.kernels.reference import cell_at, density, exact, linear, sh_basis


def query(
    field, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) and rgb (N, 3) of a cp field with numbers params (P,) at points (N, 3) along unit dirs (N, 3);
    empty cells answer 0. Differentiable in params, points and dirs."""
    sections, kind = field.with_params(params).sections(), params.dtype
    points, box = exact(points, params.device), exact(field.box, params.device)
    unit = ((points - box[:3]) / (box[3:] - box[:3])).to(kind)
    feature, (_, occupied) = products(sections, "density", unit).sum(1), cell_at(field.occupancy, points)
    sigma = torch.where(occupied, density(feature, field.scale, field.shift), 0)
    shown = sh_basis(field.shape.coefficients, exact(dirs, params.device)).to(kind)
    features = products(sections, "colour", unit)
    logits = torch.einsum("nk,ckr,nr->nc", shown, sections["colour_basis"], features)
    return sigma, torch.where((sigma > 0)[:, None], logits.sigmoid(), 0)


def products(sections: dict[str, torch.Tensor], what: str, unit: torch.Tensor) -> torch.Tensor:
    """(N, R) products X_r Y_r Z_r at unit coordinates (N, 3); what is "density" or "colour"."""
    x, y, z = (linear(sections[f"{what}_line_{axis}"], unit[:, axis]) for axis in range(3))
    return x * y * z
