"""What a `vm-mlp` field answers, in plain torch: the `vm` kind's density, and a small network's colour."""

import torch

from fusedrf_cli.engine.kernels.reference import exact
from fusedrf_cli.engine.kinds.vm.reference import (
    NOBODY,
    block_density,
    object_direction,
    object_point,
    owners,
    vm_products,
)


def query(
    field, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) per unit of the field's frame and rgb (N, 3) of a vm-mlp field with numbers params (P,), at
    points (N, 3) along unit dirs (N, 3); empty cells answer 0. Differentiable in all three."""
    held, kind = field.with_params(params), params.dtype
    points, dirs = exact(points, params.device), exact(dirs, params.device)
    here = torch.nonzero(owners(held.factors, points)[:, 0] != NOBODY)[:, 0]
    points, dirs, count = points[here], dirs[here], len(points)
    unit, _ = object_point(held.factors, 0, points)
    turned, _ = object_direction(held.factors, 0, dirs)
    products = vm_products(held.factors.sections(0), "colour", unit.to(kind))
    rgb = network(held.weights, torch.cat([products @ held.basis.T, turned.to(kind)], 1))
    sigma = block_density(held.factors, 0, points, dirs)
    return (
        params.new_zeros(count).index_put((here,), sigma),
        params.new_zeros(count, 3).index_put((here,), torch.where(sigma[:, None] > 0, rgb, 0)),
    )


def network(weights: dict[str, torch.Tensor], x: torch.Tensor) -> torch.Tensor:
    """(N, 3) rgb in [0, 1] from features and a unit direction, x (N, F + 3): the sines and cosines of x, once
    and twice, then linear layers, rectified between, behind a sigmoid."""
    x = torch.cat([x, x.sin(), (2 * x).sin(), x.cos(), (2 * x).cos()], 1)
    last = len(weights) // 2 - 1
    for i in range(last + 1):
        x = x @ weights[f"{i}.weight"].T + weights[f"{i}.bias"]
        x = x.relu() if i < last else x.sigmoid()
    return x
