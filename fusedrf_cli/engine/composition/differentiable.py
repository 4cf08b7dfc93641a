"""Placed and composed fields as functions of torch, differentiable also in where the fields are placed.

`poses` are placements (4, 4) by name, object to the frame of the composed field, that take the place of its
own: σ_world(x, d) = σ_object(M⁻¹ x) |M⁻¹ d| is differentiated as it stands. Which field is densest is a
constant.
"""

from collections.abc import Mapping
from functools import reduce

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.composite import Composite
from fusedrf_cli.engine.fields import differentiable
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, box_corners
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kernels.reference import exact
from fusedrf_cli.engine.settings import current

Poses = Mapping[str, torch.Tensor]


def query(
    field: RadianceField | Placed,
    points: torch.Tensor,
    dirs: torch.Tensor,
    poses: Poses | None = None,
    with_colour: bool = True,
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) and rgb (N, 3) of a field, placed or composed or neither, at points (N, 3) along unit dirs
    (N, 3) of its frame, as `fields.differentiable.query`; differentiable in `poses` too. Raises ValueError
    for a pose of what the field does not place."""
    check_names(field, poses)
    if isinstance(field, Composite) and not needs_gradient(field, points, dirs, *(poses or {}).values()):
        kind, device = float_type(field), device_of(field)
        for part in parts(field):
            differentiable.settle(part)
        answers = structure(field, poses).query(points, dirs, with_colour)
        return tuple(answer.to(device, kind) for answer in answers)
    if isinstance(field, ComposedField):
        return composed_query(field, points, dirs, poses or {}, with_colour)
    if isinstance(field, Placed):
        return placed_query(field, points, dirs, (poses or {}).get(field.name), with_colour)
    return differentiable.query(field, points, dirs, with_colour=with_colour)


def needs_gradient(field: RadianceField, *inputs: torch.Tensor) -> bool:
    """Whether a gradient is wanted of anything that a field's answers follow from."""
    if not torch.is_grad_enabled():
        return False
    return any(x.requires_grad for x in inputs) or any(p.requires_grad for p in numbers(field))


def check_names(field: RadianceField | Placed, poses: Poses | None) -> None:
    """Raise ValueError for a pose of what a field does not place."""
    placed = [field] if isinstance(field, Placed) else getattr(field, "placed", [])
    unknown = sorted((poses or {}).keys() - {p.name for p in placed})
    if unknown:
        placed_names = ", ".join(f"'{p.name}'" for p in placed) or "nothing"
        raise ValueError(f"there is no '{unknown[0]}' to place; this scene places {placed_names}")


def composed_query(
    field: ComposedField, points: torch.Tensor, dirs: torch.Tensor, poses: Poses, with_colour: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) and rgb (N, 3) of a composed field, by its rule."""
    device, kind = device_of(field), float_type(field)
    points, dirs = exact(points, device), exact(dirs, device)
    parts = [(p, poses.get(p.name)) for p in structure(field, poses).placed]
    sigma = torch.zeros(len(points), dtype=points.dtype, device=device)
    rgb = torch.zeros(len(points), 3, dtype=points.dtype, device=device)
    if field.rule == "max":
        densest_parts = densest(parts, points, dirs)
    else:
        densest_parts = [(p, pose, reached(p, points)) for p, pose in parts]
    # also where a part is asked nothing: so its gradient is 0, not unknown
    for placed, pose, indices in densest_parts:
        sigma_part, colour = placed_query(placed, points[indices], dirs[indices], pose, with_colour)
        sigma_part, colour = sigma_part.to(sigma.dtype), colour.to(rgb.dtype)
        share = 1 if field.rule == "max" else sigma_part[:, None]
        sigma, rgb = sigma.index_add(0, indices, sigma_part), rgb.index_add(0, indices, share * colour)
    if field.rule == "add":
        rgb = rgb / sigma.clamp_min(1e-30)[:, None]
    return sigma.to(kind), rgb.to(kind)


@torch.no_grad()
def densest(parts: list, points: torch.Tensor, dirs: torch.Tensor) -> list:
    """(placed field, its pose or None, indices of the points (N, 3) at which it is the densest) of every
    part; the earlier one in a tie, none where nothing is."""
    best = torch.zeros(len(points), dtype=points.dtype, device=points.device)
    winner = torch.full((len(points),), -1, device=points.device)
    for i, (placed, pose) in enumerate(parts):
        indices = reached(placed, points)
        if len(indices):
            sigma_part, _ = placed_query(placed, points[indices], dirs[indices], pose, with_colour=False)
            denser = sigma_part > best[indices]
            best[indices[denser]], winner[indices[denser]] = sigma_part[denser].to(best.dtype), i
    return [(*part, torch.nonzero(winner == i)[:, 0]) for i, part in enumerate(parts)]


def reached(placed: Placed, points: torch.Tensor) -> torch.Tensor:
    """Indices of the points (N, 3) that lie in a placed field's box; of all where it fills all of space."""
    if placed.unbounded:
        return torch.arange(len(points), device=points.device)
    box = exact(placed.aabb, points.device)
    return torch.nonzero(((points >= box[:3]) & (points <= box[3:])).all(1))[:, 0]


def placed_query(
    placed: Placed, points: torch.Tensor, dirs: torch.Tensor, pose: torch.Tensor | None, with_colour: bool
) -> tuple[torch.Tensor, torch.Tensor]:
    """σ (N,) and rgb (N, 3) of a placed field in the frame it is placed in."""
    device = device_of(placed.field)
    x, d, stretch = placed.to_object(exact(points, device), dirs.to(device), pose)
    sigma, rgb = query(opened(placed.field), x, d, with_colour=with_colour)
    return placed.shown(x, (exact(sigma, device) * stretch).to(sigma.dtype), rgb)


def structure(field: RadianceField, poses: Poses | None) -> RadianceField:
    """A composed field with its parts where `poses` place them now, without gradients: what marching
    needs. Any other field as it is, and that itself where nothing is elsewhere."""
    check_names(field, poses)
    if not poses:
        return field
    host = torch.device("cpu")
    now = {name: exact(pose.detach(), host).numpy() for name, pose in poses.items()}
    known = {p.name: p.object_to_world for p in field.placed}
    same = all(np.array_equal(pose, known[name]) for name, pose in now.items())
    return field if same else field.posed(now)


def bounds(field: RadianceField, poses: Poses | None) -> torch.Tensor:
    """(6,) the box of a field, on its device and differentiable in `poses`."""
    device = device_of(field)
    box = exact(structure(field, poses).aabb, device)
    if not poses:
        return box
    corners = []
    for placed in field.placed:
        matrix = exact(poses.get(placed.name, placed.object_to_world), device)
        inner = exact(box_corners(placed.occupancy.look_at_box), device)
        corners.append(inner @ matrix[:3, :3].T + matrix[:3, 3])
    corners = torch.stack(corners)
    low, high = corners.amin((0, 1)), corners.amax((0, 1))
    margin = (high - low).max() / current(OccupancyConfig).scene_cells  # as `occupancy.placed_cells` has it
    same = torch.cat([low - margin, high + margin])
    return box + same - same.detach()


def parts(field: RadianceField | Placed) -> list[RadianceField]:
    """The fields that a field places, each once; of one that places none, itself."""
    field = opened(field)
    if isinstance(field, Placed):
        return parts(field.field)
    if not isinstance(field, ComposedField):
        return [field]
    return list({id(part): part for placed in field.placed for part in parts(placed)}.values())


def numbers(field: RadianceField | Placed) -> list[torch.Tensor]:
    """The `params` of all the fields that a field places, or its own, each once."""
    vectors = (part.params for part in parts(field) if hasattr(part, "params"))
    return list({id(params): params for params in vectors}.values())


def device_of(field: RadianceField | Placed) -> torch.device:
    """Where a field's numbers lie, of a composed one those of its first part; the CPU for one without."""
    return next((p.device for p in numbers(field)), torch.device("cpu"))


def float_type(field: RadianceField | Placed) -> torch.dtype:
    """The widest float type of a field's numbers; float32 for one without."""
    return reduce(torch.promote_types, (p.dtype for p in numbers(field)), torch.float32)
