"""What a `vm` field answers, in plain torch; notation as in kernels/reference.py.

`sections` names a tensor's parameters as `VMField.sections` does, and `unit` (N, 3) are points in the unit
cube of a tensor.
"""

import torch

from fusedrf_cli.engine.encodings import plane_line
from fusedrf_cli.engine.fields.hashed import EMPTY_FROM, RUN, Hashed
from fusedrf_cli.engine.kernels.reference import (
    EDGE,
    cell_at,
    density,
    exact,
    sh_basis,
    whole,
)

NOBODY = -1  # in place of a block's number, where no block is asked


def query(
    field, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) per unit of the field's frame and rgb (N, 3) of a VM field with numbers params (P,), at points
    (N, 3) along unit dirs (N, 3); empty cells answer 0.

    Where two blocks meet the denser one answers, the lower one in a tie. Differentiable in params, points and
    dirs; cells, texels and which block answers are constants.
    """
    held = field.with_params(params)
    points, dirs = exact(points, params.device), exact(dirs, params.device)
    asked = owners(field, points)
    both = params.new_zeros(len(points), 2)
    for b in range(len(field.blocks)):
        point, column = torch.nonzero(asked == b, as_tuple=True)
        if len(point):
            both = both.index_put((point, column), block_density(held, b, points[point], dirs[point]))
    column = (both[:, 1] > both[:, 0]).long()[:, None]
    sigma, block = both.gather(1, column)[:, 0], asked.gather(1, column)[:, 0]
    rgb = params.new_zeros(len(points), 3)
    for b in range(len(field.blocks)):
        seen = torch.nonzero((block == b) & (sigma > 0))[:, 0]
        if len(seen):
            rgb = rgb.index_put((seen,), block_colour(held, b, points[seen], dirs[seen]))
    return sigma, rgb


def owners(field, points: torch.Tensor) -> torch.Tensor:
    """(N, 2) int64: the one or two blocks that are asked at points (N, 3), else NOBODY."""
    cell, occupied = cell_at(field.occupancy, points)
    if field.owners is None:
        first = torch.where(occupied, 0, NOBODY)
        return torch.stack([first, torch.full_like(first, NOBODY)], 1)
    grids = [whole(grid, points.device)[cell.unbind(1)] for grid in field.owners]
    found = torch.stack(grids, 1)
    return torch.where(occupied[:, None] & (found < len(field.blocks)), found, NOBODY)


def object_point(field, b: int, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit coordinates (N, 3) of points in block b's tensor, and whether (N,) it is asked there: in a field
    of several blocks a tensor's own empty cells are left out, of which it never learnt anything."""
    block = field.blocks[b]
    tensor = field.tensors[block.tensor]
    to_object = torch.linalg.inv(exact(block.object_to_field, points.device))
    box = exact(tensor.aabb, points.device)
    at = field.space.placed(points) if field.crossings[b] else points
    at = at @ to_object[:3, :3].T + to_object[:3, 3]
    at = tensor.space.contracted(at) if field.crossings[b] == 2 else at
    unit = (at - box[:3]) / (box[3:] - box[:3])
    inside = ((unit >= -EDGE) & (unit <= 1 + EDGE)).all(1)
    if field.owners is not None:
        occupied = torch.from_numpy(tensor.occupancy.occupied).to(points.device)
        counts = torch.tensor(occupied.shape, device=points.device)
        cell = (unit.detach() * counts).long().clamp_min(0).minimum(counts - 1)
        inside = inside & occupied[cell.unbind(1)]
    return unit, inside


def crossed(field, b: int, points: torch.Tensor) -> torch.Tensor | float:
    """(N,) what makes the density of a block of another space than the field's one per length of the field's
    coordinates (N, 3)."""
    if not field.crossings[b]:
        return 1.0
    block = field.blocks[b]
    to_object = torch.linalg.inv(exact(block.object_to_field, points.device))
    space = field.tensors[block.tensor].space
    own = space.contracted(field.space.placed(points) @ to_object[:3, :3].T + to_object[:3, 3])
    return space.rates(own) / field.space.rates(points)


def object_direction(field, b: int, dirs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Unit dirs (N, 3) in block b's object frame and |A d| (N,), which keeps the optical depth (σ_field =
    σ_object |A d|)."""
    to_object = torch.linalg.inv(exact(field.blocks[b].object_to_field, dirs.device))
    turned = dirs @ to_object[:3, :3].T
    stretch = turned.norm(dim=1)
    return turned / stretch[:, None], stretch


def block_density(field, b: int, points: torch.Tensor, dirs: torch.Tensor) -> torch.Tensor:
    """(N,) σ of block b in the field's frame; 0 where it is not asked."""
    tensor = field.tensors[field.blocks[b].tensor]
    unit, inside = object_point(field, b, points)
    kind = field.params.dtype
    sections = field.sections(field.blocks[b].tensor)
    feature = vm_density_feature(sections, unit.to(kind))
    if tensor.hashed:
        added = detail(sections, tensor, unit)[:, 0]
        feature = torch.where(asks_detail(feature, tensor), feature + added, feature)
    _, stretch = object_direction(field, b, dirs)
    stretch = stretch * crossed(field, b, points)
    return torch.where(inside, stretch.to(kind) * density(feature, tensor.scale, tensor.shift), 0)


def block_colour(field, b: int, points: torch.Tensor, dirs: torch.Tensor) -> torch.Tensor:
    """(N, 3) rgb of block b."""
    unit, _ = object_point(field, b, points)
    turned, _ = object_direction(field, b, dirs)
    kind, tensor = field.params.dtype, field.tensors[field.blocks[b].tensor]
    sections = field.sections(field.blocks[b].tensor)
    added = 0.0
    if tensor.hashed:
        asked = asks_detail(vm_density_feature(sections, unit.to(kind)), tensor)
        added = torch.where(asked[:, None], detail(sections, tensor, unit)[:, 1:], 0)
    return vm_colour(sections, unit.to(kind), turned.to(kind), added)


def vm_products(sections: dict[str, torch.Tensor], what: str, unit: torch.Tensor) -> torch.Tensor:
    """(N, 3 R) products P_r(a, b) L_r(c), mode after mode (TensoRF, eq. 5); what is "density" or "colour"."""
    own = {name.removeprefix(f"{what}_"): view for name, view in sections.items()}
    return plane_line.reference(own, unit, None, 0)


def vm_density_feature(sections: dict[str, torch.Tensor], unit: torch.Tensor) -> torch.Tensor:
    """(N,) density before activation: the sum of the products over ranks and modes (TensoRF, eq. 6)."""
    return vm_products(sections, "density", unit).sum(1)


def asks_detail(feature: torch.Tensor, tensor) -> torch.Tensor:
    """(N,) bool: where a tensor's planes and lines say by their density (N,) before activation that there may
    be matter."""
    return feature.detach() + tensor.shift > EMPTY_FROM


def detail(sections: dict[str, torch.Tensor], tensor, unit: torch.Tensor) -> torch.Tensor:
    """(N, 4) what a tensor's hashed detail adds at unit points (N, 3): to the density before activation and
    to the logits of the colour (Müller et al. 2022, eq. 4, with runs of RUN vertices along z, and its levels
    added instead of put side by side)."""
    box, rows = exact(tensor.aabb, unit.device), sections["detail"]
    at, total = box[:3] + unit.to(box.dtype) * (box[3:] - box[:3]), 0.0
    for level, spacing in enumerate(tensor.hashed.spacings):
        below = torch.floor(at.detach() / spacing)
        share = at / spacing - below
        for corner in range(8):
            offset = torch.tensor([corner >> 2, corner >> 1 & 1, corner & 1], device=unit.device)
            weight = torch.where(offset == 1, share, 1 - share).prod(1).to(rows.dtype)
            row = level * tensor.hashed.rows + hashed_row(tensor.hashed, below.long() + offset)
            total = total + weight[:, None] * rows[row]
    return total


def hashed_row(hashed: Hashed, vertex: torch.Tensor) -> torch.Tensor:
    """(N,) int64: which row of a level the vertices (N, 3) int64 of its lattice have. Products wrap around at
    64 bits; what is kept of them is the same whether they have a sign."""
    i, j, k = vertex.unbind(1)
    h = (i * 2654435761) ^ (j * 805459861) ^ (k.div(RUN, rounding_mode="floor") * 3674653429)
    h = h ^ (h >> 15)
    return (h & (hashed.rows // RUN - 1)) * RUN + k.remainder(RUN)


def vm_colour(
    sections: dict[str, torch.Tensor],
    unit: torch.Tensor,
    dirs: torch.Tensor,
    added: torch.Tensor | float = 0.0,
) -> torch.Tensor:
    """(N, 3) rgb along unit dirs (N, 3) of the object's frame; `added` to its logits."""
    basis = sections["colour_basis"]
    features = vm_products(sections, "colour", unit)
    shown = sh_basis(basis.shape[1], dirs).to(basis.dtype)
    return (torch.einsum("nk,ckf,nf->nc", shown, basis, features) + added).sigmoid()


def vm_query(
    sections: dict[str, torch.Tensor], unit: torch.Tensor, dirs: torch.Tensor, scale: float, shift: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) in the object's frame and rgb (N, 3) along unit dirs (N, 3) of that frame, of one tensor; both 0
    outside the unit cube."""
    inside = ((unit >= 0) & (unit <= 1)).all(1)
    unit = unit.clamp(0, 1)
    sigma = density(vm_density_feature(sections, unit), scale, shift)
    rgb = vm_colour(sections, unit, dirs)
    return torch.where(inside, sigma, 0), torch.where(inside[:, None], rgb, 0)
