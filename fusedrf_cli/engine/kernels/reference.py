"""What references share: the readable truth of the kernels in plain torch, for any float dtype and device,
differentiable, and slow.

The `reference` of a field says what it answers; tests hold the compiled loops to it, and where a device has
no compiled loops it answers itself. `unit` are coordinates in a box, 0 at its lower face and 1 at
its upper one.
"""

import numpy as np
import torch

OCTANTS = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1], indexing="ij"), -1).reshape(-1, 3)
"""(8, 3) the corners of a voxel, z first."""


def exact(values: torch.Tensor | np.ndarray, device: torch.device) -> torch.Tensor:
    """Values on a device as float64, or as float32 where the device knows no other (Apple's)."""
    kind = torch.float32 if device.type == "mps" else torch.float64
    return torch.as_tensor(values).to(kind).to(device)


def whole(values: np.ndarray, device: torch.device) -> torch.Tensor:
    """Whole numbers on a device as int64: indices."""
    return torch.from_numpy(np.ascontiguousarray(values, np.int64)).to(device)


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


def trilinear(grid: torch.Tensor, unit: torch.Tensor) -> torch.Tensor:
    """(N, R) values of a grid (n_x, n_y, n_z, R) at unit coordinates (N, 3)."""
    lower, share = texel(unit[:, 0], grid.shape[0])
    sides = torch.stack([bilinear_at(grid, lower + i, unit[:, 1], unit[:, 2]) for i in (0, 1)])
    return (1 - share) * sides[0] + share * sides[1]


def bilinear_at(
    grid: torch.Tensor, i: torch.Tensor, unit_b: torch.Tensor, unit_c: torch.Tensor
) -> torch.Tensor:
    """(N, R) values of the planes i (N,) of a grid (n_x, n_y, n_z, R) at unit coordinates (N,) and (N,)."""
    b, share_b = texel(unit_b, grid.shape[1])
    c, share_c = texel(unit_c, grid.shape[2])
    lower = (1 - share_c) * grid[i, b, c] + share_c * grid[i, b, c + 1]
    upper = (1 - share_c) * grid[i, b + 1, c] + share_c * grid[i, b + 1, c + 1]
    return (1 - share_b) * lower + share_b * upper


def texel(unit: torch.Tensor, n: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Lower texel (N,) and share of the upper one (N, 1) on an axis of n texels."""
    position = unit * (n - 1)
    lower = position.long().clamp(0, n - 2)
    return lower, (position - lower)[:, None]


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


def cell_at(grid, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The cells (N, 3) int64 of an OccupancyGrid that points (N, 3) lie in, nearest ones where they lie
    outside, and whether the points (N,) lie in an occupied one. A box is half open, as cells are: nothing is
    at its upper faces."""
    at = points.detach()
    lo, side = exact(grid.aabb[:3], at.device), exact(grid.cell, at.device)
    occupied = torch.from_numpy(grid.occupied).to(at.device)
    last = torch.tensor(occupied.shape, device=at.device) - 1
    index = ((at - lo) / side).floor().long()
    inside = ((index >= 0) & (index <= last)).all(1)
    index = index.clamp_min(0).minimum(last)
    return index, inside & occupied[index.unbind(1)]


def composite_weights(sigma: torch.Tensor, step: float) -> torch.Tensor:
    """(N, K) weights w_i = T_i alpha_i of consecutive samples, alpha_i = 1 - exp(-σ_i δ) (NeRF, eq. 3)."""
    alpha = -torch.expm1(-sigma * step)
    trans = torch.exp(-step * torch.cumsum(sigma, 1))
    before = torch.cat([torch.ones_like(trans[:, :1]), trans[:, :-1]], 1)
    return before * alpha


def shared_colour_weights(weights: torch.Tensor, first: float, later: float) -> torch.Tensor:
    """(N, K) the weights that the colours of a ray's samples stand for, of weights (N, K): that of all since
    the last sample that was shaded, where it is over `first`, or over `later` behind the first that was; what
    is left over at the end goes to the last."""
    shown, rows = torch.zeros_like(weights), torch.arange(len(weights))
    waiting, enough = torch.zeros_like(weights[:, 0]), torch.full_like(weights[:, 0], first)
    last = torch.full((len(weights),), -1)
    for k in range(weights.shape[1]):
        waiting = waiting + weights[:, k]
        shaded = waiting > enough
        shown[:, k] = torch.where(shaded, waiting, 0)
        waiting, enough = torch.where(shaded, 0, waiting), torch.where(shaded, later, enough)
        last = torch.where(shaded, k, last)
    shown[rows, last] += torch.where(last >= 0, waiting, 0)
    return shown


def interval(
    rays_o: torch.Tensor, rays_d: torch.Tensor, box: torch.Tensor, near: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances (N,) at which rays (N, 3) enter a box (6,), not before `near`, and leave it; a ray that
    misses leaves before it enters. Differentiable in all three tensors."""
    lo, hi = box[:3], box[3:]
    parallel = rays_d == 0
    is_between = (~parallel | ((rays_o >= lo) & (rays_o < hi))).all(1)
    safe = torch.where(parallel, 1, rays_d)
    a, b = (lo - rays_o) / safe, (hi - rays_o) / safe
    enter = torch.where(parallel, 0, torch.minimum(a, b)).amax(1).clamp_min(near).clamp_min(0)
    leave = torch.where(parallel, torch.inf, torch.maximum(a, b)).amin(1)
    return enter, torch.where(is_between, leave, enter)


def lattice(field, rays_o, rays_d, near: float, step: float, jitter) -> tuple[torch.Tensor, torch.Tensor]:
    """Distances (N, K) of every ray's samples t_0 + (k + jitter) δ in the field's box, and which (N, K) lie
    in occupied cells."""
    enter, leave = interval(rays_o, rays_d, torch.as_tensor(field.aabb), near)
    length = (leave - enter).clamp_min(0)
    count = int(torch.ceil(length.max() / step)) + 1 if len(length) else 1
    ts = (enter + jitter * step)[:, None] + step * torch.arange(count, dtype=torch.float64)
    points = rays_o[:, None] + ts[..., None] * rays_d[:, None]
    lo, cell = torch.as_tensor(field.aabb[:3]), torch.as_tensor(field.occupancy.cell)
    occupied = torch.from_numpy(field.occupancy.occupied)
    index = ((points - lo) / cell).long().clamp_min(0).minimum(torch.tensor(occupied.shape) - 1)
    return ts, (ts < leave[:, None]) & occupied[index.unbind(-1)]


def render_rays(
    field,
    rays_o,
    rays_d,
    near: float,
    step: float,
    early_stop: float = 0.0,
    jitter=0.5,
    lending: tuple[float, float | None] = (0.0, None),
) -> torch.Tensor:
    """(N, 5) premultiplied rgb, opacity and Σ w t of rays (N, 3) float64 through a field that has a
    `reference`, on the CPU.

    Every sample of the lattice is asked. A sample counts while the transmittance before it is over
    early_stop, and its colour where its weight is over the first number of `lending`: both thresholds are the
    kernels' own, 0 leaves them out. With a second one, light samples take other ones' colours as in pictures
    (`shared_colour_weights`).
    """
    colour_from, shared_colour_from = lending
    ts, is_sampled = lattice(field, rays_o, rays_d, near, step, torch.as_tensor(jitter, dtype=torch.float64))
    points = (rays_o[:, None] + ts[..., None] * rays_d[:, None])[is_sampled]
    dirs = rays_d[:, None].expand(*ts.shape, 3)[is_sampled]
    densities, colour = field.reference(field.params, points, dirs)
    sigma = densities.new_zeros(ts.shape).masked_scatter(is_sampled, densities)
    rgb = densities.new_zeros(*ts.shape, 3).masked_scatter(is_sampled[..., None], colour)
    with torch.no_grad():
        before = torch.exp(-step * (torch.cumsum(sigma, 1) - sigma))
    weights = composite_weights(torch.where(before > early_stop, sigma, 0), step)
    shown = torch.where(weights > colour_from, weights, 0)
    if shared_colour_from is not None:
        shown = shared_colour_weights(weights, colour_from, shared_colour_from)
    columns = [
        (shown[..., None] * rgb).sum(1),
        weights.sum(1, keepdim=True),
        (weights * ts).sum(1, keepdim=True),
    ]
    return torch.cat([c.to(densities.dtype) for c in columns], 1)
