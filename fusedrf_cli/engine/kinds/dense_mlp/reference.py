"""What a `dense-mlp` field answers, in plain torch; notation as in bodies.py."""

import torch

from fusedrf_cli.engine.kernels.reference import exact, sh_basis
from fusedrf_cli.engine.kinds.dense.reference import interpolated
from fusedrf_cli.engine.kinds.dense_mlp.bodies import HARMONICS


def query(
    field, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) and rgb (N, 3) of a dense-mlp field with numbers params (P,) at points (N, 3) along unit dirs
    (N, 3); empty cells answer 0. Differentiable in params, points and dirs."""
    sigma, features = interpolated(field, params, points)
    sections = field.with_params(params).sections()
    shown = sh_basis(HARMONICS, exact(dirs, params.device)).to(params.dtype)
    x = torch.cat([features, shown], 1)
    h = (x @ sections["decoder.hidden.weight"] + sections["decoder.hidden.bias"]).relu()
    logits = (h @ sections["decoder.out.weight"] + sections["decoder.out.bias"])[:, :3]
    return sigma, torch.where((sigma > 0)[:, None], logits.sigmoid(), 0)
