"""Density and colour features of a VM field as torch functions of its parameters, by the kernels.

`field` is anything with a VM field's `kernel_shape`, `arrays` and `grid`. Nothing here is differentiable in
the points. Where `grads` (parts, P) is given, backward adds to its rows and `params.grad` stays None: a step
of training then neither allocates nor sums a gradient as large as the field, most of which is 0.
"""

import numpy as np
import torch

from fusedrf_cli.engine.kernels import cpu


def density(
    field, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor, grads: np.ndarray | None = None
) -> torch.Tensor:
    """σ (N,) per unit of the field's frame at points (N, 3) along unit dirs (N, 3); 0 in empty cells."""
    return _Density.apply(params, field, points.numpy(), dirs.numpy(), grads)


def features(
    field, params: torch.Tensor, points: torch.Tensor, grads: np.ndarray | None = None, block: int = 0
) -> torch.Tensor:
    """(N, 3 rank) products P_r(a, b) L_r(c) of a block's colour at points (N, 3); 0 outside its box."""
    return _Features.apply(params, field, points.numpy(), grads, block)


class _Density(torch.autograd.Function):
    @staticmethod
    def forward(ctx, params, field, points, dirs, grads):
        vm, kind = _arrays(field, params), params.detach().numpy().dtype
        sigma, rgb = np.empty(len(points), kind), np.empty((len(points), 3), kind)
        cpu.query(*field.kernel_shape, vm, field.grid, points, dirs, False, sigma, rgb)
        ctx.rest = field, vm, points, dirs, grads
        return torch.from_numpy(sigma)

    @staticmethod
    def backward(ctx, d_sigma):
        field, vm, points, dirs, grads = ctx.rest
        rows = _rows(vm, grads)
        d_rgb = np.zeros((len(points), 3), vm.params.dtype)
        d_sigma = d_sigma.contiguous().numpy()
        cpu.query_backward(*field.kernel_shape, vm, field.grid, points, dirs, d_sigma, d_rgb, rows)
        return _sum(rows, grads), None, None, None, None


class _Features(torch.autograd.Function):
    @staticmethod
    def forward(ctx, params, field, points, grads, block):
        vm, ranks = _arrays(field, params), field.kernel_shape[1]
        out = np.empty(len(points) * 3 * len(ranks), vm.params.dtype)
        cpu.features(ranks, vm, block, points, out)
        ctx.rest = ranks, vm, block, points, grads
        return torch.from_numpy(out).view(len(points), 3 * len(ranks))

    @staticmethod
    def backward(ctx, d_features):
        ranks, vm, block, points, grads = ctx.rest
        rows = _rows(vm, grads)
        cpu.features_backward(ranks, vm, block, points, d_features.contiguous().view(-1).numpy(), rows)
        return _sum(rows, grads), None, None, None, None


def _arrays(field, params: torch.Tensor):
    """The field's arrays over the parameters that were handed in."""
    return field.arrays._replace(params=params.detach().numpy())


def _rows(vm, grads: np.ndarray | None) -> np.ndarray:
    """Where backward adds: the caller's rows, or one fresh row per thread."""
    return np.zeros((torch.get_num_threads(), vm.params.size), vm.params.dtype) if grads is None else grads


def _sum(rows: np.ndarray, grads: np.ndarray | None) -> torch.Tensor | None:
    """The gradient of `params`, or None where the caller keeps it in rows."""
    return torch.from_numpy(rows.sum(0)) if grads is None else None
