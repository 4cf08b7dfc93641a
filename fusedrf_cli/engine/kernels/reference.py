"""The readable truth of the kernels: the same maths in plain torch, for any float dtype and device,
differentiable, and slow.

Notation as in bodies.py. `sections` names a tensor's parameters as `VMField.sections` does; `unit` (N, 3) are
points in the unit cube of the tensor. Gradients flow to the sections, not to points or directions. Fields are
of one block here.
"""

import torch
from torch.nn.functional import softplus

MODES = ((0, 1, 2), (0, 2, 1), (1, 2, 0))  # plane axes a, b and line axis c of each mode


def linear(line: torch.Tensor, unit: torch.Tensor) -> torch.Tensor:
    """(N, R) values of a line (n, R) at unit coordinates (N,): linear between texels, corners aligned."""
    lower, share = texel(unit, line.shape[0])
    return (1 - share) * line[lower] + share * line[lower + 1]


def bilinear(plane: torch.Tensor, unit_a: torch.Tensor, unit_b: torch.Tensor) -> torch.Tensor:
    """(N, R) values of a plane (n_a, n_b, R) at unit coordinates (N,) and (N,)."""
    a, share_a = texel(unit_a, plane.shape[0])
    b, share_b = texel(unit_b, plane.shape[1])
    lower = (1 - share_b) * plane[a, b] + share_b * plane[a, b + 1]
    upper = (1 - share_b) * plane[a + 1, b] + share_b * plane[a + 1, b + 1]
    return (1 - share_a) * lower + share_a * upper


def texel(unit: torch.Tensor, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Lower texel (N,) and share of the upper one (N, 1) on an axis of n texels."""
    position = unit * (n - 1)
    lower = position.long().clamp(0, n - 2)
    return lower, (position - lower)[:, None]


def vm_products(sections: dict[str, torch.Tensor], what: str, unit: torch.Tensor) -> torch.Tensor:
    """(N, 3 R) products P_r(a, b) L_r(c), mode after mode (TensoRF, eq. 5); what is "density" or "colour"."""
    products = []
    for m, (a, b, c) in enumerate(MODES):
        plane = bilinear(sections[f"{what}_plane_{m}"], unit[:, a], unit[:, b])
        products.append(plane * linear(sections[f"{what}_line_{m}"], unit[:, c]))
    return torch.cat(products, 1)


def vm_density_feature(sections: dict[str, torch.Tensor], unit: torch.Tensor) -> torch.Tensor:
    """(N,) density before activation: the sum of the products over ranks and modes (TensoRF, eq. 6)."""
    return vm_products(sections, "density", unit).sum(1)


def density(feature: torch.Tensor, scale: float, shift: float) -> torch.Tensor:
    """σ = scale * log(1 + exp(feature + shift)), in the unit of scale."""
    return scale * softplus(feature + shift, threshold=40)


def vm_query(
    sections: dict[str, torch.Tensor], unit: torch.Tensor, dirs: torch.Tensor, scale: float, shift: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) in the object's frame and rgb (N, 3) along unit dirs (N, 3) of that frame; both 0 outside the
    unit cube."""
    inside = ((unit >= 0) & (unit <= 1)).all(1)
    unit = unit.clamp(0, 1)
    sigma = density(vm_density_feature(sections, unit), scale, shift)
    basis = sections["colour_basis"]
    features = vm_products(sections, "colour", unit)
    logits = torch.einsum("nk,ckf,nf->nc", sh_basis(basis.shape[1], dirs).to(basis.dtype), basis, features)
    return torch.where(inside, sigma, 0), torch.where(inside[:, None], logits.sigmoid(), 0)


def sh_basis(count: int, dirs: torch.Tensor) -> torch.Tensor:
    """(N, count) real spherical harmonics of unit dirs (N, 3), count 1, 4, 9 or 16, orders l then m =
    -l..l."""
    x, y, z = dirs.unbind(1)
    xx, yy, zz = x * x, y * y, z * z
    values = [
        0.28209479177387814 * torch.ones_like(x),
        -0.4886025119029199 * y,
        0.4886025119029199 * z,
        -0.4886025119029199 * x,
        1.0925484305920792 * x * y,
        -1.0925484305920792 * y * z,
        0.31539156525252005 * (2 * zz - xx - yy),
        -1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy),
        -0.5900435899266435 * y * (3 * xx - yy),
        2.890611442640554 * x * y * z,
        -0.4570457994644658 * y * (4 * zz - xx - yy),
        0.3731763325901154 * z * (2 * zz - 3 * xx - 3 * yy),
        -0.4570457994644658 * x * (4 * zz - xx - yy),
        1.445305721320277 * z * (xx - yy),
        -0.5900435899266435 * x * (xx - 3 * yy),
    ]
    return torch.stack(values[:count], 1)


def composite_weights(sigma: torch.Tensor, step: float) -> torch.Tensor:
    """(N, K) weights w_i = T_i alpha_i of consecutive samples, alpha_i = 1 - exp(-σ_i δ) (NeRF, eq. 3)."""
    alpha = -torch.expm1(-sigma * step)
    trans = torch.exp(-step * torch.cumsum(sigma, 1))
    before = torch.cat([torch.ones_like(trans[:, :1]), trans[:, :-1]], 1)
    return before * alpha


def field_query(field, points: torch.Tensor, dirs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) in the frame of a one-block VM field, |A d| σ_object with A from field to object, and rgb (N,
    3).

    A box is half open, as cells are: nothing is at its upper faces.
    """
    (tensor,), (block,) = field.tensors, field.blocks
    kind = field.params.dtype
    to_object = torch.linalg.inv(torch.as_tensor(block.object_to_field, dtype=torch.float64))
    box = torch.as_tensor(tensor.aabb)
    unit = (points.double() @ to_object[:3, :3].T + to_object[:3, 3] - box[:3]) / (box[3:] - box[:3])
    turned = dirs.double() @ to_object[:3, :3].T
    stretch = turned.norm(dim=1)
    turned = turned / stretch[:, None]
    sigma, rgb = vm_query(field.sections(0), unit.to(kind), turned.to(kind), tensor.scale, tensor.shift)
    known = torch.from_numpy(field.occupancy.contains(points.double().numpy()))
    return torch.where(known, sigma * stretch.to(kind), 0), torch.where(known[:, None], rgb, 0)


def lattice(field, rays_o, rays_d, near: float, step: float, jitter) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances (N, K) of every ray's samples t_0 + (k + jitter) δ in the field's box, and which (N, K) lie
    in occupied cells."""
    lo, hi = torch.as_tensor(field.aabb[:3]), torch.as_tensor(field.aabb[3:])
    parallel = rays_d == 0
    held = (~parallel | ((rays_o >= lo) & (rays_o < hi))).all(1)
    safe = torch.where(parallel, 1, rays_d)
    a, b = (lo - rays_o) / safe, (hi - rays_o) / safe
    enter = torch.where(parallel, 0, torch.minimum(a, b)).amax(1).clamp_min(near).clamp_min(0)
    leave = torch.where(parallel, torch.inf, torch.maximum(a, b)).amin(1)
    length = torch.where(held, leave - enter, 0).clamp_min(0)
    count = int(torch.ceil(length.max() / step)) + 1 if len(length) else 1
    ts = (enter + jitter * step)[:, None] + step * torch.arange(count, dtype=torch.float64)
    inside = held[:, None] & (ts < leave[:, None])
    points = rays_o[:, None] + ts[..., None] * rays_d[:, None]
    occupied = torch.from_numpy(field.occupancy.occupied)
    shape = torch.tensor(occupied.shape)
    cell = ((points - lo) / torch.as_tensor(field.occupancy.cell)).long().clamp_min(0).minimum(shape - 1)
    return ts, inside & occupied[cell.unbind(-1)]


def render_rays(
    field,
    rays_o,
    rays_d,
    near: float,
    step: float,
    early_stop: float = 0.0,
    jitter=0.5,
    colour_from: float = 0.0,
) -> torch.Tensor:
    """(N, 5) premultiplied rgb, opacity and Σ w t of rays (N, 3) float64 through a one-block VM field.

    Every sample of the lattice is asked. A sample counts while the transmittance before it is over
    early_stop, and its colour where its weight is over colour_from: both thresholds are the kernels' own, 0
    leaves them out.
    """
    ts, taken = lattice(field, rays_o, rays_d, near, step, torch.as_tensor(jitter, dtype=torch.float64))
    points = (rays_o[:, None] + ts[..., None] * rays_d[:, None])[taken]
    dirs = rays_d[:, None].expand(*ts.shape, 3)[taken]
    found, colour = field_query(field, points, dirs)
    sigma = found.new_zeros(ts.shape).masked_scatter(taken, found)
    rgb = found.new_zeros(*ts.shape, 3).masked_scatter(taken[..., None], colour)
    with torch.no_grad():
        before = torch.exp(-step * (torch.cumsum(sigma, 1) - sigma))
    weights = composite_weights(torch.where(before > early_stop, sigma, 0), step)
    shown = torch.where(weights > colour_from, weights, 0)
    columns = [
        (shown[..., None] * rgb).sum(1),
        weights.sum(1, keepdim=True),
        (weights * ts).sum(1, keepdim=True),
    ]
    return torch.cat([c.to(found.dtype) for c in columns], 1)
