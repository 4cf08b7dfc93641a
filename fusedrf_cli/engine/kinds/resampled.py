"""Students on the vertices of a grid that ask a scene what it is there, and so show it before they learn."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.ndimage import gaussian_filter

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.distillation.sampler import RaySampler
from fusedrf_cli.engine.fields.base import RadianceField, sampling_step
from fusedrf_cli.engine.fields.box import BoxField
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kernels.reference import OCTANTS
from fusedrf_cli.engine.kinds.box_kind import GridBuilder
from fusedrf_cli.engine.kinds.builder import (
    Candidate,
    DirectBuilder,
    MemoryEstimate,
    Plan,
    StorageSetting,
    TooSmall,
)
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.kinds.field_sampling import (
    FieldSamplingConfig,
    colours,
    density,
    density_features,
    dilated,
    inverse_softplus,
    seen_colours,
)
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class ResampledConfig:
    """How what is asked becomes a field."""

    smoothed: float = 0.7
    """Voxels: standard deviation of the opacity whose slope says where a surface faces."""
    deepest: float = -40.0
    """Density feature of nothing at all, where a field is copied."""
    inside: float = 1e-7
    """Of a box's sides: on its very faces a field may answer that it ends there."""
    shown_rays: int = 1 << 19
    shown_seed: int = 5
    shown_from: float = 1e-3
    """Weight on a ray from which a cell shows."""
    per_vertex: float = 500.0
    """Bytes, at most: corners, places, what is asked at eight points of a voxel, and matrices."""
    slope: float = 0.2
    """Of opacity per voxel from which a vertex is seen from one side."""


@dataclass(frozen=True)
class GridVertices:
    """The used vertices of a field over one box; see `Vertices`."""

    index: np.ndarray
    """(V,) int64, of the vertices of the whole grid in order."""
    positions: np.ndarray
    corners: np.ndarray
    finest_voxel: np.ndarray
    resolution: tuple[int, int, int]

    @classmethod
    def of(cls, field: BoxField) -> "GridVertices":
        """Of a field on a grid."""
        used = field.used
        index = np.flatnonzero(used)
        numbers = np.full(used.size, -1)
        numbers[index] = np.arange(len(index))
        rows = numbers.reshape(used.shape)
        corners = np.stack(
            [rows[tuple(slice(o, n - 1 + o) for o, n in zip(octant, used.shape, strict=True))].ravel()
             for octant in OCTANTS], 1,
        )  # fmt: skip
        corners = corners[(corners >= 0).all(1)]
        _, low, side = field.corners
        voxel = side / (np.asarray(field.resolution) - 1)
        positions = low + np.stack(np.unravel_index(index, used.shape), 1) * voxel
        return cls(index, positions, corners, np.full(len(positions), voxel.min()), field.resolution)

    def facing(self, sigma: np.ndarray) -> np.ndarray:
        """(V, 3) unit directions along which surfaces at vertices with σ (V,) are seen; 0 where there is no
        one side."""
        config = current(ResampledConfig)
        opacity = np.zeros(self.resolution, np.float32)
        opacity.ravel()[self.index] = -np.expm1(-sigma * self.finest_voxel)
        slopes = np.gradient(gaussian_filter(opacity, config.smoothed))
        normals = np.stack([slope.ravel()[self.index] for slope in slopes], 1).astype(np.float64)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.where(length > config.slope, normals / np.maximum(length, 1e-12), 0)


class TexelGrid(NamedTuple):
    """The only field of a scene, where that has numbers on texels along the scene's axes."""

    field: RadianceField
    """With nothing left out that lies in empty cells."""
    origin: np.ndarray
    """(3,) of its frame, in the scene's."""
    aabb: np.ndarray
    """(6,) box, in the scene's frame."""
    resolution: tuple[int, int, int]
    """Texels per axis, corners on the faces of the box."""


def texel_grid_of(scene: ComposedField) -> TexelGrid | None:
    """The lattice of a scene of one field that is neither turned nor stretched; None where there is none."""
    placed = scene.placed[0]
    matrix = placed.object_to_world
    if len(scene.placed) > 1 or not placed.as_it_is or not np.array_equal(matrix[:3, :3], np.eye(3)):
        return None
    field = opened(placed.field)
    if getattr(field, "resolution", None) is None:
        return None
    origin = matrix[:3, 3]
    everywhere = field.with_occupancy(OccupancyGrid.full(field.aabb))
    return TexelGrid(everywhere, origin, field.aabb + np.tile(origin, 2), tuple(field.resolution))


class ResampledBuilder(DirectBuilder, GridBuilder):
    """A field whose vertices can be given densities and colours: its class has

    fill_vertices(index, features, colours)
                        set vertices (V,), counted z first, to density features (V,), σ = scale
                        softplus(f), and harmonics of their colours' logits (V, 3 coefficients)
    """

    distil_config = DistilConfig(rays=400_000, steps=0, rgb_steps=1000, rgb_rate=0.0006)
    compares = False
    finer = 0.6  # a lattice that lies across a teacher's own needs finer voxels to hold as much
    _shown: OccupancyGrid | None = None

    @property
    def cells(self) -> OccupancyGrid:
        """The scene's that show anything, once that is known."""
        return self._shown or self.scene.occupancy

    def build(self, storage: StorageSetting, limit: int) -> Candidate | None:
        """See `DirectBuilder`."""
        try:
            if self._shown is None:
                self._shown = self.shown(*self.asked(self.largest_of(storage, limit)))
            plan = self.largest_of(storage, limit)
        except TooSmall:
            return None
        lattice = texel_grid_of(self.scene)
        if lattice is not None:
            along = replace(plan, box=lattice.aabb, resolution=lattice.resolution)
            copy = self.copied(along, lattice)
            if self.bytes_of(copy, storage) <= limit:
                return Candidate(copy, self.bytes_of(copy, storage), True)
        field = self.fitted(plan)
        is_finest = field.voxel_size <= self.finer * self.scene.voxel_size * (1 + 1e-6)
        return Candidate(field, self.bytes_of(field, storage), is_finest)

    def fitted(self, plan: Plan) -> BoxField:
        """A field that comes near to the scene between its vertices."""
        field, vertices, sigma = self.asked(plan)
        facing = vertices.facing(sigma)
        rows, weight = seen_colours(self.scene, vertices, sigma, facing, field.shape.sh_degree)
        rows = dilated(vertices, rows.reshape(len(sigma), -1), weight)[0]
        features = density_features(self.scene, vertices, sigma, field.scale)
        field.fill_vertices(vertices.index, features, rows)
        return field

    def copied(self, plan: Plan, lattice: "TexelGrid") -> BoxField:
        """A field with the vertices of the scene's only one and what that says at them: between them it says
        the same as far as both interpolate alike."""
        config = current(ResampledConfig)
        field = self.kind.create(plan, torch.Generator(), "fused").with_occupancy(self.cells)
        vertices = GridVertices.of(field)
        margin = config.inside * (lattice.aabb[3:] - lattice.aabb[:3])
        positions = np.clip(vertices.positions, lattice.aabb[:3] + margin, lattice.aabb[3:] - margin)
        positions -= lattice.origin
        sigma = density(lattice.field, positions)
        features = np.clip(
            inverse_softplus(sigma / field.scale), config.deepest, current(FieldSamplingConfig).most
        )
        rows = colours(lattice.field, positions, vertices.facing(sigma), field.shape.sh_degree)
        field.fill_vertices(vertices.index, features, rows.reshape(len(sigma), -1))
        return field

    def asked(self, plan: Plan) -> tuple[BoxField, GridVertices, np.ndarray]:
        """An empty field as planned, its vertices, and the scene's σ (V,) at them."""
        field = self.kind.create(plan, torch.Generator(), "fused").with_occupancy(self.cells)
        vertices = GridVertices.of(field)
        return field, vertices, density(self.scene, vertices.positions)

    def shown(self, field: BoxField, vertices: GridVertices, sigma: np.ndarray) -> OccupancyGrid:
        """The field's cells of which some ray shows anything, when its vertices have σ (V,)."""
        settings = current(ResampledConfig)
        config = current(FieldSamplingConfig)
        features = np.clip(inverse_softplus(sigma / field.scale), config.least, config.most)
        field.fill_vertices(vertices.index, features, np.zeros((len(sigma), field.shape.numbers), np.float32))
        generator = torch.Generator().manual_seed(settings.shown_seed)
        rays_o, rays_d = RaySampler([self.scene.occupancy.look_at_box]).draw(settings.shown_rays, generator)
        jitter = torch.rand(len(rays_o), generator=generator, dtype=torch.float64).numpy()
        weights = field.weights_in_cells(rays_o, rays_d, jitter, 0.0, sampling_step(field))
        occupancy = self.scene.occupancy.marked(weights > settings.shown_from)
        return occupancy if occupancy.occupied.any() else self.scene.occupancy

    def smallest(self) -> int:
        """See `DirectBuilder`."""
        return self.bytes_of_plan(self.plan(self.plain(), 1), self.plain())

    def needs(self) -> MemoryEstimate:
        """Vertices while they are asked, and the whole grid, of which one copy is what it started as."""
        config = current(ResampledConfig)
        plan, lattice = self.largest(), texel_grid_of(self.scene)
        vertices = sum(section.shape[0] for section in plan.sections[:1])
        numbers = plan.numbers
        if lattice is not None:
            numbers = max(numbers, self.kind.numbers(plan.storage, lattice.resolution))
        making = {
            "vertices while they are asked": config.per_vertex * vertices,
            "what it starts as": 4.0 * numbers,
        }
        return MemoryEstimate(numbers, making=making, points=0)
