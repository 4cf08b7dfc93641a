"""What a `sparse` field answers, in plain torch: trilinear interpolation over the vertices of its voxels."""

import torch

from fusedrf_cli.engine.kernels.reference import density, exact, sh_basis, whole
from fusedrf_cli.engine.kinds.asking import OCTANTS

ROW = 4  # numbers of a vertex: density feature, three colours of degree 0


def query(
    field, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) per unit of length and rgb (N, 3) of a sparse field with numbers params (P,), at points (N, 3)
    along unit dirs (N, 3); 0 where no voxel is active.

    The numbers of hanging vertices follow from those of free ones, whatever params says of them.
    Differentiable in params, points and dirs; which voxel a point lies in is a constant.
    """
    points, dirs = exact(points, params.device), exact(dirs, params.device)
    held = field.with_params(params)
    brick = brick_at(field.tree, points)
    here = torch.nonzero(brick >= 0)[:, 0]
    here = here[active(field, brick[here], points[here])]
    brick, at, sigma = brick[here], points[here], params.new_zeros(len(points))
    rows = blend(field.fine, settled(field.fine, held.rows), brick, at)
    logits = rows[:, 1:]
    if field.coarse is None:
        basis = sh_basis(1, dirs[here]).to(params.dtype)
        logits = logits * basis
    else:
        basis = sh_basis(field.shape.coefficients, dirs[here]).to(params.dtype)
        bands = blend(field.coarse, settled(field.coarse, held.bands), brick, at)
        bands = bands.view(len(here), 3, basis.shape[1] - 1)
        logits = logits * basis[:, :1] + (bands * basis[:, None, 1:]).sum(2)
    sigma = sigma.index_put((here,), density(rows[:, 0], field.scale, 0.0))
    return sigma, params.new_zeros(len(points), 3).index_put((here,), logits.sigmoid())


def settled(lattice, rows: torch.Tensor) -> torch.Tensor:
    """The rows (V, R) of a lattice's vertices, those of hanging ones summed anew from the free ones."""
    spread = lattice.spread.tocoo()
    if not spread.shape[0]:
        return rows
    free, (target, source) = rows[: lattice.free], (whole(i, rows.device) for i in (spread.row, spread.col))
    weight = exact(spread.data, rows.device).to(rows.dtype)[:, None]
    hanging = rows.new_zeros(spread.shape[0], rows.shape[1])
    return torch.cat([free, hanging.index_add(0, target, weight * free[source])])


def brick_at(tree, points: torch.Tensor) -> torch.Tensor:
    """(N,) int64 brick that holds each point (N, 3), or -1."""
    device = points.device
    offset, depth, table = (whole(a, device) for a in tree.tables)
    at = (points.detach() - exact(tree.lo, device)) / exact(tree.top, device)
    last = torch.tensor(tree.counts, device=device) - 1
    cell = at.floor().long()
    inside = ((cell >= 0) & (cell <= last)).all(1)
    cell = cell.clamp_min(0).minimum(last)
    start, side = offset[cell.unbind(1)], 1 << depth[cell.unbind(1)]
    inside = inside & (start >= 0)
    a, b, c = ((at - cell) * side[:, None]).long().clamp_min(0).minimum(side[:, None] - 1).unbind(1)
    entry = torch.where(inside, start + (a * side + b) * side + c, 0)
    return torch.where(inside, table[entry], -1).clamp_min(-1)


def in_brick(tree, n: int, brick: torch.Tensor, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The voxel (N, 3) int64 of a brick's n along each axis that points (N, 3) lie in, and the shares (N, 3)
    of its upper corners."""
    device = points.device
    level = whole(tree.level, device)[brick][:, None]
    at = (points - exact(tree.lo, device)) / exact(tree.top, device) * (1 << level)
    at = (at - at.detach().floor()) * n
    voxel = at.detach().long().clamp(0, n - 1)
    return voxel, at - voxel


def active(field, brick: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """(N,) bool, whether the finest voxel around each point is an active one of its brick."""
    voxel, _ = in_brick(field.tree, field.fine.n, brick, points)
    mask = torch.from_numpy(field.tree.mask).to(points.device)
    return mask[(brick, *voxel.unbind(1))]


def blend(lattice, rows: torch.Tensor, brick: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
    """(N, R) rows (V, R) of a lattice's vertices, interpolated at points (N, 3) in active voxels."""
    n, device = lattice.n, points.device
    voxel, share = in_brick(lattice.tree, n, brick, points)
    octants = whole(OCTANTS, device)
    vertex = voxel[:, None] + octants
    vertex = (vertex[..., 0] * (n + 1) + vertex[..., 1]) * (n + 1) + vertex[..., 2]
    row = whole(lattice.rows, device)[brick[:, None], vertex]
    weight = torch.where(octants == 1, share[:, None], 1 - share[:, None]).prod(2)
    return (weight.to(rows.dtype)[..., None] * rows[row]).sum(1)
