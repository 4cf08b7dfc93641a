"""Fields whose answers are known: densities with closed line integrals, colours by a formula.

A density that is softplus of a sum of products a(x) b(y) c(z) says so in `activation`; what can be exported
to stored kinds (export.py) follows from that.
"""

from dataclasses import dataclass, field

import numpy as np
import torch

from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels.reference import sh_basis

BOX = np.array([-1.0, -1.2, -0.9, 1.1, 1.0, 1.3])
NOISE_NODES = 16  # per axis; the export's own texels, so that noise is exported exactly
SHIFT = -8.0  # of the softplus, as trained fields have it


@dataclass(frozen=True)
class Activation:
    """σ = scale softplus(SHIFT + Σ a(x) b(y) c(z)), each term three functions of coordinates (N,)."""

    scale: float
    terms: tuple = ()


@dataclass(frozen=True)
class Tint:
    """rgb = sigmoid(level + facing d + slope x + bands Y(d)); each row belongs to one channel."""

    level: tuple = (0.0, 0.0, 0.0)
    """(3,)"""
    facing: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3), how the logits grow with the unit view direction."""
    slope: np.ndarray = field(default_factory=lambda: np.zeros((3, 3)))
    """(3, 3), how they grow with the place, per unit of length."""
    bands: np.ndarray = field(default_factory=lambda: np.zeros((3, 0)))
    """(3, K), weights of the spherical harmonics of degree 2 and more, K 0, 5 or 12."""

    @classmethod
    def of(cls, *rgb: float) -> "Tint":
        """One colour (3,), each channel strictly between 0 and 1, from everywhere."""
        return cls(tuple(np.log(np.asarray(rgb) / (1 - np.asarray(rgb)))))

    def __call__(self, points: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        """rgb (N, 3) at points (N, 3) seen along unit dirs (N, 3)."""
        logits = np.asarray(self.level) + dirs @ self.facing.T + points @ self.slope.T
        if self.bands.shape[1]:
            basis = sh_basis(4 + self.bands.shape[1], torch.from_numpy(np.asarray(dirs, np.float64)))
            logits = logits + basis[:, 4:].numpy() @ self.bands.T
        return 1 / (1 + np.exp(-logits))


class AnalyticField:
    """A `RadianceField` given by a density with a closed line integral; without a tint its colour is some
    smooth function of place and view."""

    kind = "analytic"
    voxel_size = 0.02
    activation: Activation | None = None

    def __init__(self, aabb=BOX, cells: int = 16, tint: Tint | None = None):
        self.occupancy = OccupancyGrid.full(np.asarray(aabb, np.float64), cells)
        self.tint = tint

    @property
    def aabb(self) -> np.ndarray:
        return self.occupancy.aabb

    @property
    def matter(self) -> np.ndarray:
        """(6,) the box outside of which σ is 0."""
        return self.aabb

    def sigma(self, points: np.ndarray) -> np.ndarray:
        """(N,) density at points (N, 3)."""
        raise NotImplementedError

    def depth(self, rays_o: np.ndarray, rays_d: np.ndarray) -> np.ndarray:
        """(N,) ∫ σ dt over the whole of each ray from its origin on."""
        raise NotImplementedError

    def colour(self, points: np.ndarray, dirs: np.ndarray) -> np.ndarray:
        """(N, 3) in [0, 1]."""
        if self.tint is not None:
            return self.tint(points, dirs)
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

    @property
    def matter(self):
        return np.array([self.low, *self.aabb[1:3], self.high, *self.aabb[4:]])

    @property
    def activation(self):
        return even(self.density)

    def sigma(self, points):
        inside = (points >= self.aabb[:3]).all(1) & (points < self.aabb[3:]).all(1)
        return self.density * (inside & (points[:, 0] >= self.low) & (points[:, 0] < self.high))

    def depth(self, rays_o, rays_d):
        return self.density * chord_of_box(self.matter[:3], self.matter[3:], rays_o, rays_d)


class Box(AnalyticField):
    """A box of even density, or of one that swings by a share `noise` around it (no closed depth then)."""

    def __init__(self, density=2.0, half=(0.5, 0.5, 0.5), noise: float = 0.0, seed: int = 0, **options):
        half = np.broadcast_to(np.asarray(half, float), 3)
        super().__init__(aabb=np.concatenate([-half, half]), cells=4, **options)
        self.density, self.noise = density, noise
        self.waves = np.random.default_rng(seed).choice([-1.0, 1.0], (3, NOISE_NODES))
        self.voxel_size = float(2 * half.min() / (NOISE_NODES - 1))

    @property
    def activation(self):
        if not self.noise:
            return even(self.density)
        first = lambda x: self.swing() * self.wave(0, x)  # noqa: E731
        noise = (first, lambda y: self.wave(1, y), lambda z: self.wave(2, z))
        return Activation(even(self.density).scale, (*even(self.density).terms, noise))

    def swing(self) -> float:
        """Amplitude of the softplus' argument at which σ swings by the share: d ln softplus / df at 0."""
        return self.noise * np.log(2) / 0.5

    def wave(self, axis: int, at: np.ndarray) -> np.ndarray:
        """Linear between random ±1 at NOISE_NODES even nodes of an axis."""
        nodes = np.linspace(self.aabb[axis], self.aabb[axis + 3], NOISE_NODES)
        return np.interp(at, nodes, self.waves[axis])

    def sigma(self, points):
        inside = (points >= self.aabb[:3]).all(1) & (points < self.aabb[3:]).all(1)
        if not self.noise:
            return self.density * inside
        swing = self.swing() * np.prod([self.wave(a, points[:, a]) for a in range(3)], 0)
        return self.density * inside * np.log1p(np.exp(swing)) / np.log(2)

    def depth(self, rays_o, rays_d):
        return self.density * chord_of_box(self.aabb[:3], self.aabb[3:], rays_o, rays_d)


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

    @property
    def activation(self):
        """Far below 0 the softplus is the exponential, to a relative e^SHIFT / 2 = 2e-4."""
        one = np.ones_like
        part = [lambda p, c=c: -((p - c) ** 2) / (2 * self.width**2) for c in self.centre]
        terms = ((part[0], one, one), (one, part[1], one), (one, one, part[2]))
        return Activation(self.density / np.log1p(np.exp(SHIFT)), terms)

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


def even(density: float) -> Activation:
    """The same density everywhere: the argument is 0. Nothing at all is the softplus' floor of a scale of 1e-30."""
    one, up = np.ones_like, lambda x: np.full_like(x, -SHIFT)
    return Activation(density / np.log(2), ((up, one, one),)) if density > 0 else Activation(1e-30)


def interval_of_box(lo, hi, rays_o, rays_d) -> tuple[np.ndarray, np.ndarray]:
    """Distances (N,) at which each ray enters and leaves a box, by clipping one axis after the other; a miss
    leaves before it enters."""
    t0, t1 = np.zeros(len(rays_o)), np.full(len(rays_o), np.inf)
    for axis in range(3):
        o, d = rays_o[:, axis], rays_d[:, axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            a, b = (lo[axis] - o) / d, (hi[axis] - o) / d
        held = (o >= lo[axis]) & (o < hi[axis])
        t0 = np.maximum(t0, np.where(d == 0, np.where(held, 0, np.inf), np.minimum(a, b)))
        t1 = np.minimum(t1, np.where(d == 0, np.inf, np.maximum(a, b)))
    return t0, t1


def chord_of_box(lo, hi, rays_o, rays_d) -> np.ndarray:
    """(N,) length of each ray inside a box."""
    t0, t1 = interval_of_box(lo, hi, rays_o, rays_d)
    return np.maximum(t1 - t0, 0)
