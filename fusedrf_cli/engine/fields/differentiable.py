"""A field as a function of torch: answers by the compiled loops, gradients in its numbers by their adjoint,
and gradients in points and directions by the kind's plain torch reference.

Where a device has no compiled loops (Apple's, others) the reference does all of it, slower and equal. Cells,
texels, voxels and which block answers are constants: the field is differentiated where it is smooth.
"""

import torch
from torch.autograd.function import once_differentiable

from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kernels.reference import exact


def query(
    field: RadianceField,
    points: torch.Tensor,
    dirs: torch.Tensor,
    params: torch.Tensor | None = None,
    with_colour: bool = True,
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) per unit of the field's frame and rgb (N, 3) in [0, 1] at points (N, 3) along unit dirs (N, 3),
    on the field's device and in its float type; without colour, rgb is 0.

    Differentiable in points, dirs and the field's own `params` (P,), or others of the same shape. Those of
    them that follow from others (a `sparse` field's hanging vertices) are made to follow first, and have no
    gradient. Raises ValueError where a gradient is asked of a field that has no `reference`.
    """
    field = opened(field)
    inputs = (points, dirs, getattr(field, "params", None) if params is None else params)
    needs_grad = torch.is_grad_enabled() and any(x is not None and x.requires_grad for x in inputs)
    if not hasattr(field, "reference"):
        if needs_grad or params is not None:
            raise ValueError(
                f"fields of kind '{field.kind}' have no reference in torch and cannot be differentiated; "
                "convert them to another kind"
            )
        return field.query(points, dirs, with_colour)
    params = inputs[-1]
    points, dirs = exact(points, params.device), exact(dirs, params.device)
    if field.device_loops is None:
        sigma, rgb = field.answers(params, points, dirs)
        return sigma, rgb if with_colour else torch.zeros_like(rgb)
    if not needs_grad:
        return by_kernels(holding(field, params), points, dirs, with_colour)
    return _Query.apply(field, params, points, dirs, with_colour)


def holding(field, params: torch.Tensor):
    """The field with numbers params (P,), of which those that follow from others do."""
    if params is field.params:
        settle(field)
        return field
    if not field.dependent():
        return field.with_params(params.detach())
    other = field.with_params(params.detach().clone())
    other.settle()
    return other


def settle(field: RadianceField) -> None:
    """Make those numbers follow that depend on others, where an optimiser of torch may have moved these."""
    params = getattr(field, "params", None)
    if params is not None and params.requires_grad and field.device_loops is not None:
        field.settle()


def by_kernels(
    field, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """The field's own `query`, on whatever device it lies."""
    values = field.query(points.detach().cpu(), dirs.detach().cpu(), with_colour)
    return tuple(answer.to(field.params.device) for answer in values)


class _Query(torch.autograd.Function):
    @staticmethod
    def forward(ctx, field, params, points, dirs, with_colour):
        ctx.field = holding(field, params)
        ctx.save_for_backward(params, points, dirs)
        sigma, rgb = by_kernels(ctx.field, points, dirs, with_colour)
        if not with_colour:
            ctx.mark_non_differentiable(rgb)
        return sigma, rgb

    @staticmethod
    @once_differentiable
    def backward(ctx, d_sigma, d_rgb):
        params, points, dirs = ctx.saved_tensors
        _, of_params, *of_places, _ = ctx.needs_input_grad
        d_params = gradient(ctx.field, points, dirs, d_sigma, d_rgb) if of_params else None
        d_places = of_reference(ctx.field, points, dirs, d_sigma, d_rgb) if any(of_places) else (None, None)
        return None, d_params, *d_places, None


def gradient(
    field, points: torch.Tensor, dirs: torch.Tensor, d_sigma: torch.Tensor, d_rgb: torch.Tensor
) -> torch.Tensor:
    """(P,) what the derivatives d_sigma (N,) and d_rgb (N, 3) of a loss send back to the field's numbers."""
    params = field.params.detach()
    if not len(points):
        return torch.zeros_like(params)
    rows = params.new_zeros(field.gradient_rows, len(params))
    back = (x.detach().cpu().contiguous() for x in (points, dirs, d_sigma, d_rgb))
    field.query_backward(*back, field.device_loops.shared(rows))
    total = rows.sum(0)
    for low, high in field.dependent():
        total[low:high] = 0
    return total


def of_reference(
    field, points: torch.Tensor, dirs: torch.Tensor, d_sigma: torch.Tensor, d_rgb: torch.Tensor
) -> tuple[torch.Tensor, ...]:
    """(N, 3) and (N, 3) what the derivatives send back to points and directions, by the reference."""
    with torch.enable_grad():
        inputs = [x.detach().requires_grad_() for x in (points, dirs)]
        answers = field.answers(field.params.detach(), *inputs)
        sent = [(a, d) for a, d in zip(answers, (d_sigma, d_rgb), strict=True) if a.requires_grad]
        if not sent:  # nothing is there
            return tuple(torch.zeros_like(x) for x in inputs)
        answers, sent = zip(*sent, strict=True)
        return torch.autograd.grad(answers, inputs, sent, materialize_grads=True)
