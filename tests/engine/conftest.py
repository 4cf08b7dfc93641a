"""Fields whose answers are known: analytic ones with exact line integrals, small random VM fields, and rays
to send at them."""

import numpy as np
import pytest
import torch

from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.fields.vm import Block, VMField, VMShape, VMTensor

BOX = np.array([-1.0, -1.2, -0.9, 1.1, 1.0, 1.3])
SIXTY_FOUR = VMShape(8, 16, 3)  # the shape that float64 kernels are compiled for
THIRTY_TWO = VMShape(16, 8, 1)  # and the one of float32 kernels: few shapes, since each costs a compilation


class AnalyticField:
    """A `RadianceField` given by a density with a closed line integral; its colour is a smooth function of
    place and view."""

    kind = "analytic"
    voxel_size = 0.02

    def __init__(self, aabb=BOX, cells: int = 16):
        self.occupancy = OccupancyGrid.full(np.asarray(aabb, np.float64), cells)

    @property
    def aabb(self) -> np.ndarray:
        return self.occupancy.aabb

    def sigma(self, points: np.ndarray) -> np.ndarray:
        """(N,) density at points (N, 3)."""
        raise NotImplementedError

    def depth(self, rays_o: np.ndarray, rays_d: np.ndarray) -> np.ndarray:
        """(N,) ∫ σ dt over the whole of each ray from its origin on."""
        raise NotImplementedError

    def colour(self, points: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        """(N, 3) in [0, 1]."""
        return 0.5 + 0.3 * np.sin(3 * points) + 0.2 * dirs

    def query(self, points, dirs, with_colour=True):
        x, d = points.double().numpy(), dirs.double().numpy()
        rgb = self.colour(x, d) if with_colour else np.zeros_like(x)
        return torch.from_numpy(self.sigma(x)).float(), torch.from_numpy(rgb).float()

    def occupy(self, cells: int) -> "AnalyticField":
        """Mark only the cells that hold matter (a fine grid of probes, grown by one cell)."""
        grid = OccupancyGrid.full(self.aabb, cells)
        index = np.argwhere(grid.occupied)
        found = np.zeros(grid.occupied.shape, bool)
        for shift in np.stack(np.meshgrid(*[[0.02, 0.5, 0.98]] * 3), -1).reshape(-1, 3):
            found[tuple(index.T)] |= self.sigma(grid.aabb[:3] + (index + shift) * grid.cell) > 1e-6
        self.occupancy = OccupancyGrid(self.aabb, found).dilated()
        return self


class Slab(AnalyticField):
    """Density between two planes x = low and x = high, the whole width of the box in y and z."""

    def __init__(self, density=2.0, low=-0.3, high=0.4, **options):
        super().__init__(**options)
        self.density, self.low, self.high = density, low, high

    def sigma(self, points):
        inside = (points >= self.aabb[:3]).all(1) & (points < self.aabb[3:]).all(1)
        return self.density * (inside & (points[:, 0] >= self.low) & (points[:, 0] < self.high))

    def depth(self, rays_o, rays_d):
        lo, hi = self.aabb[:3].copy(), self.aabb[3:].copy()
        lo[0], hi[0] = self.low, self.high
        return self.density * chord_of_box(lo, hi, rays_o, rays_d)


class Ball(AnalyticField):
    """A ball of even density."""

    def __init__(self, density=4.0, centre=(0.1, -0.05, 0.15), radius=0.6, **options):
        super().__init__(**options)
        self.density, self.centre, self.radius = density, np.array(centre), radius

    def sigma(self, points):
        return self.density * (np.linalg.norm(points - self.centre, axis=1) < self.radius)

    def depth(self, rays_o, rays_d):
        to = rays_o - self.centre
        along = (to * rays_d).sum(1)
        half = np.sqrt(np.maximum(along**2 - (to**2).sum(1) + self.radius**2, 0))
        return self.density * np.maximum(np.maximum(half - along, 0) - np.maximum(-half - along, 0), 0)


class Gaussian(AnalyticField):
    """σ = density exp(-|x - centre|² / 2 s²), small enough to vanish (1e-7) at the box's faces."""

    def __init__(self, density=6.0, centre=(0.05, -0.1, 0.2), width=0.16, **options):
        super().__init__(**options)
        self.density, self.centre, self.width = density, np.array(centre), width

    def sigma(self, points):
        return self.density * np.exp(-((points - self.centre) ** 2).sum(1) / (2 * self.width**2))

    def depth(self, rays_o, rays_d):
        to = rays_o - self.centre
        along = (to * rays_d).sum(1)
        off = (to**2).sum(1) - along**2
        behind = torch.from_numpy(along / (np.sqrt(2) * self.width)).erfc().numpy()
        return self.density * np.exp(-off / (2 * self.width**2)) * self.width * np.sqrt(np.pi / 2) * behind


class Slow:
    """Any field without its fast path: `render_rays` has to take the general one."""

    def __init__(self, field):
        self.kind, self.occupancy, self.aabb = field.kind, field.occupancy, field.aabb
        self.voxel_size, self.query = field.voxel_size, field.query


def chord_of_box(lo, hi, rays_o, rays_d) -> np.ndarray:
    """(N,) length of each ray inside a box, by clipping one axis after the other."""
    t0, t1 = np.zeros(len(rays_o)), np.full(len(rays_o), np.inf)
    for axis in range(3):
        o, d = rays_o[:, axis], rays_d[:, axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (lo[axis] - o) / d, (hi[axis] - o) / d
        held = (o >= lo[axis]) & (o < hi[axis])
        t0 = np.maximum(t0, np.where(d == 0, np.where(held, 0, np.inf), np.minimum(a, b)))
        t1 = np.minimum(t1, np.where(d == 0, np.inf, np.maximum(a, b)))
    return np.maximum(t1 - t0, 0)


def random_vm(
    shape: VMShape = SIXTY_FOUR,
    resolution=(5, 8, 7),
    dtype=torch.float64,
    seed: int = 0,
    aabb=BOX,
    cells: int | None = None,
    matrix=None,
    scale: float = 3.0,
    shift: float = -1.0,
) -> VMField:
    """A one-block VM field of random numbers, dense enough to see; `cells` gives it a random occupancy of so
    many cells."""
    generator = torch.Generator().manual_seed(seed)
    params = torch.randn(shape.size(resolution), generator=generator, dtype=torch.float64) * 0.5
    grid = OccupancyGrid.full(aabb, cells or 1)
    if cells is not None:
        grid = OccupancyGrid(grid.aabb, np.random.default_rng(seed).random(grid.occupied.shape) < 0.3)
    tensor = VMTensor(resolution, grid.aabb, scale, shift, None if cells is None else grid.occupied)
    block = Block(0, np.eye(4) if matrix is None else matrix, "one")
    return VMField(shape, (tensor,), (block,), params.to(dtype), grid)


def unit(vectors) -> np.ndarray:
    """Vectors (N, 3) made of unit length."""
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def points_in(aabb, count: int, seed: int = 0, margin: float = 0.0) -> np.ndarray:
    """(count, 3) random points of a box, or of one `margin` of its size larger on each side."""
    rng = np.random.default_rng(seed)
    extent = aabb[3:] - aabb[:3]
    return aabb[:3] - margin * extent + rng.random((count, 3)) * (1 + 2 * margin) * extent


def rays_at(aabb, count: int, seed: int = 0, away: float = 3.0) -> tuple[np.ndarray, np.ndarray]:
    """(count, 3) origins on a sphere around a box and unit directions to random points in it."""
    rng = np.random.default_rng(seed)
    origins = (aabb[:3] + aabb[3:]) / 2 + away * unit(rng.normal(size=(count, 3)))
    return origins, unit(points_in(aabb, count, seed + 1) - origins)


DIRECTIONS_26 = unit(
    np.array(
        [(x, y, z) for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if (x, y, z) != (0, 0, 0)],
        float,
    )
)


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator of its own for every test."""
    return np.random.default_rng(7)
