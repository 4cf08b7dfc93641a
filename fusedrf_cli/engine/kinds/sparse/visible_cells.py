"""A scene whose places hold no more than shows: most of what photos of an unbounded scene leave in a field is
low density behind surfaces, or too thin to see, which bricks would hold at the cost of what does show."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.fields.base import sampling_step
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid, cell_counts
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class VisibleCellsConfig:
    """How cells of an unbounded scene are found that show."""

    cells: int = 256
    """Along the longest side of an unbounded scene."""
    rays: int = 1 << 20
    """That look at the middle of the scene, where no views of it are known."""
    shown_from: float = 5e-3
    """Weight on a ray from which what a cell holds counts."""
    seed: int = 3_000_017


def visible_only(scene: ComposedField, views: Sequence[Camera]) -> ComposedField:
    """The scene, its places with those cells alone of which one of the views, cameras in its frame, shows
    anything, grown by one; of a scene without a place itself."""
    if not any(is_one_grid(p) for p in scene.placed):
        return scene
    rays = rays_of(scene, views)
    other = copy(scene)
    other.__dict__.pop("occupancy", None)
    other.placed = [visible_part(p, *rays) if is_one_grid(p) else p for p in scene.placed]
    return other


def is_one_grid(placed: Placed) -> bool:
    """Whether it is a place of one grid."""
    return placed.unbounded and opened(placed.field).resolution is not None


def visible_part(placed: Placed, rays_o: np.ndarray, rays_d: np.ndarray) -> Placed:
    """A place with those cells alone that rays (N, 3) of the scene's frame show."""
    config = current(VisibleCellsConfig)
    field = opened(placed.field)
    grid = field.occupancy
    finer = OccupancyGrid.full(grid.aabb, config.cells, grid.space)
    finer = finer.marked(grid.contains(finer.centres()).reshape(cell_counts(grid.aabb, config.cells)))
    finer_field = field.with_occupancy(finer)
    origins = rays_o @ placed.world_to_object[:3, :3].T + placed.world_to_object[:3, 3]
    directions = rays_d @ placed.world_to_object[:3, :3].T
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    generator = torch.Generator().manual_seed(config.seed)
    jitter = torch.rand(len(origins), generator=generator, dtype=torch.float64).numpy()
    weights = finer_field.weights_in_cells(origins, directions, jitter, 0.0, sampling_step(finer_field))
    shown = finer.marked(weights > config.shown_from).dilated().occupied & finer.occupied
    return replace(placed, field=field.with_occupancy(finer.marked(shown)))


def rays_of(scene: ComposedField, views: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (N, 3) of all pixels of the views; of none, of rays at the scene's middle
    and its objects."""
    config = current(VisibleCellsConfig)
    if not views:
        generator = torch.Generator().manual_seed(config.seed)
        return RaySampler.of(scene).draw(config.rays, generator)
    rays_o, rays_d = (np.concatenate(parts) for parts in zip(*(v.rays() for v in views), strict=True))
    return rays_o, rays_d
