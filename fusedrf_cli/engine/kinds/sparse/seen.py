"""A scene whose places hold no more than shows: most of what photos of a place leave in a field is haze
behind surfaces, or too thin to see, which bricks would hold at the cost of what does show."""

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
class SeenConfig:
    """How cells of a place are found that show."""

    cells: int = 256
    """Along the longest side of a place."""
    rays: int = 1 << 20
    """That look at the middle of the scene, where no views of it are known."""
    shown_from: float = 5e-3
    """Weight on a ray from which what a cell holds counts."""
    seed: int = 3_000_017


def as_seen(scene: ComposedField, views: Sequence[Camera]) -> ComposedField:
    """The scene, its places with those cells alone of which one of the views, cameras in its frame, shows
    anything, grown by one; of a scene without a place itself."""
    if not any(can_be_cut(p) for p in scene.placed):
        return scene
    rays = rays_of(scene, views)
    other = copy(scene)
    other.__dict__.pop("occupancy", None)
    other.placed = [cut_down(p, *rays) if can_be_cut(p) else p for p in scene.placed]
    return other


def can_be_cut(placed: Placed) -> bool:
    """Whether it is a place of one grid."""
    return placed.unbounded and opened(placed.field).resolution is not None


def cut_down(placed: Placed, rays_o: np.ndarray, rays_d: np.ndarray) -> Placed:
    """A place with those cells alone that rays (N, 3) of the scene's frame show."""
    config = current(SeenConfig)
    field = opened(placed.field)
    grid = field.occupancy
    finer = OccupancyGrid.full(grid.aabb, config.cells, grid.space)
    finer = finer.marked(grid.contains(finer.centres()).reshape(cell_counts(grid.aabb, config.cells)))
    asked = field.with_occupancy(finer)
    origins = rays_o @ placed.world_to_object[:3, :3].T + placed.world_to_object[:3, 3]
    ways = rays_d @ placed.world_to_object[:3, :3].T
    ways /= np.linalg.norm(ways, axis=1, keepdims=True)
    generator = torch.Generator().manual_seed(config.seed)
    jitter = torch.rand(len(origins), generator=generator, dtype=torch.float64).numpy()
    weights = asked.weights_in_cells(origins, ways, jitter, 0.0, sampling_step(asked))
    shown = finer.marked(weights > config.shown_from).dilated().occupied & finer.occupied
    return replace(placed, field=field.with_occupancy(finer.marked(shown)))


def rays_of(scene: ComposedField, views: Sequence[Camera]) -> tuple[np.ndarray, np.ndarray]:
    """Origins and unit directions (N, 3) of all pixels of the views; of none, of rays at the scene's middle
    and its objects."""
    config = current(SeenConfig)
    if not views:
        generator = torch.Generator().manual_seed(config.seed)
        return RaySampler.of(scene).draw(config.rays, generator)
    rays_o, rays_d = (np.concatenate(parts) for parts in zip(*(v.rays() for v in views), strict=True))
    return rays_o, rays_d
