"""The numbers that vertices of a grid need to show what any other field does: asked of it and fitted, not
learned."""

from collections.abc import Iterator
from dataclasses import dataclass
from types import ModuleType
from typing import Protocol

import numpy as np
import torch
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.occupancy import PROBES
from fusedrf_cli.engine.kernels.reference import OCTANTS, sh_basis
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class FieldSamplingConfig:
    """How a field is asked at the vertices of voxels."""

    least: float = -12.0
    """Of the density feature."""
    most: float = 60.0
    reach: float = 5.0
    """Of features in a voxel that a surface runs through, on either side of the one at which light falls to
    `half`. Measured: 32.4 dB by asking at vertices, 35.0 dB with these three."""
    half: float = 0.6
    fit_steps: int = 6
    coloured: float = 1e-2
    """Opacity of what a vertex stands for, from which its colour is asked and not its neighbours'."""
    directions: int = 32
    """Along which colours are asked."""
    one_sided: float = 0.4
    """Length of the mean direction a vertex is seen along, from which only that side is asked."""
    looks: int = 9
    """Places along a look through the voxels before and behind a vertex."""
    ridge: float = 1e-3
    """Keeps harmonics small where no direction tells of them."""
    logits: float = 8.0
    """Colours are told apart up to sigmoid(8)."""
    dilations: int = 3
    at_once: int = 1 << 18
    """Points."""


class Vertices(Protocol):
    """Vertices (V) of active voxels (K), between which numbers are interpolated."""

    positions: np.ndarray
    """(V, 3) float64."""
    corners: np.ndarray
    """(K, 8) which vertices are a voxel's corners, as OCTANTS has them."""
    finest_voxel: np.ndarray
    """(V,) the shortest side of the finest voxel at each vertex."""


def placed_in(teacher: RadianceField) -> list[Placed]:
    """The placed fields of a composed one; any other field by itself."""
    return getattr(teacher, "placed", None) or [Placed("", teacher, np.eye(4))]


def density(source, positions: np.ndarray, space: ModuleType | None = None) -> np.ndarray:
    """(N,) float64 σ, per length of a space's coordinates, at positions (N, 3) in them, of a field or a
    placed one: the mean over three axes where that depends on the direction. The space is a field's own where
    none is given."""
    space = space or source.occupancy.space
    parts = [source] if isinstance(source, Placed) else placed_in(source)
    stretched = any(p.condition > 1 + 1e-6 for p in parts)
    densities = np.zeros(len(positions))
    axes = np.eye(3)[: 3 if stretched else 1]
    for part in pieces(len(positions), current(FieldSamplingConfig).at_once):
        points = space.inv_contract(torch.from_numpy(positions[part]))
        for axis in axes:
            dirs = torch.from_numpy(np.broadcast_to(axis, points.shape).copy())
            densities[part] += source.query(points, dirs, False)[0].double().numpy() / len(axes)
    return densities / space.rates(torch.from_numpy(positions)).numpy()


def seen_colours(
    teacher: RadianceField, lattice: Vertices, sigma: np.ndarray, facing: np.ndarray, degree: int
) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3, coefficients) float32 of the harmonics of the colours that vertices show, whose σ (V,) is known
    and the directions along which they are seen (V, 3), of length 1 where from one side alone; and what each
    counts (V,), 0 where it shows nothing.

    What lies under a surface was never seen, and what lies before it is nothing: a vertex takes its colour
    from where a look along its facing ends.
    """
    config = current(FieldSamplingConfig)
    positions, opacity = look(teacher, lattice, sigma, facing)
    coefficients = np.zeros((len(sigma), 3, (degree + 1) ** 2), np.float32)
    indices = np.flatnonzero(opacity > config.coloured)
    coefficients[indices] = colours(teacher, positions[indices], facing[indices], degree)
    return coefficients, np.where(opacity > config.coloured, opacity, 0)


def look(
    teacher: RadianceField, lattice: Vertices, sigma: np.ndarray, facing: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What is seen from a voxel before a vertex to a voxel behind, along its facing: where most of that is
    (V, 3), and the opacity (V,) of it all. A vertex that is seen from all sides, or never, is all that it
    sees."""
    config = current(FieldSamplingConfig)
    size, positions = lattice.finest_voxel, lattice.positions.copy()
    opacity = -np.expm1(-sigma * size)
    length = np.linalg.norm(facing, axis=1)
    which = np.flatnonzero(length > config.one_sided)
    along = facing[which] / length[which, None] * size[which, None]
    spots = np.linspace(-1, 1, config.looks)
    trans, heaviest, end = np.ones(len(which)), np.zeros(len(which)), np.zeros(len(which))
    for spot in spots:
        depth = (
            density(teacher, lattice.positions[which] + spot * along) * size[which] * (spots[1] - spots[0])
        )
        weight = -trans * np.expm1(-depth)
        end, heaviest = np.where(weight > heaviest, spot, end), np.maximum(weight, heaviest)
        trans = trans - weight
    positions[which] += end[:, None] * along
    opacity[which] = 1 - trans
    return positions, opacity


def density_features(
    teacher: RadianceField, lattice: Vertices, sigma: np.ndarray, scale: float
) -> np.ndarray:
    """(V,) density features f, σ = scale softplus(f), that, interpolated, come nearest to the teacher's in
    the squares of their differences at eight points of every active voxel; sigma (V,) is what the teacher
    says at the vertices.

    In a voxel that a surface runs through, features are told apart up to `reach` on either side of the one at
    which it is half opaque: so the surface comes to lie where it is, between vertices of which one knows only
    that there is much and the other that there is nothing.
    """
    config = current(FieldSamplingConfig)
    corners = lattice.corners
    first = lattice.positions[corners[:, 0]]
    extent = lattice.positions[corners[:, 7]] - first
    weights = np.where(OCTANTS == 1, PROBES[:, None], 1 - PROBES[:, None]).prod(2)
    answers = np.stack([density(teacher, first + extent * spot) for spot in PROBES], 1)
    half, deepest = (half_opaque(scale, size) for size in (extent.min(1)[:, None], lattice.finest_voxel))
    targets = np.clip(inverse_softplus(answers / scale), config.least, half + config.reach)
    targets = np.where(
        targets.max(1, keepdims=True) > half, np.maximum(targets, half - config.reach), targets
    )
    features = np.clip(inverse_softplus(sigma / scale), deepest - config.reach, deepest + config.reach)
    scatter = sparse.csr_matrix(
        (np.ones(corners.size), (corners.ravel(), np.arange(corners.size))), (len(features), corners.size)
    )

    def adjoint(rest: np.ndarray) -> np.ndarray:
        return scatter @ (rest @ weights).ravel()

    count = (len(features), len(features))
    normal = LinearOperator(count, lambda x: adjoint(x[corners] @ weights.T), dtype=np.float64)
    diagonal = scatter @ np.tile((weights**2).sum(0), len(corners))
    inverse = sparse.diags(1 / np.maximum(diagonal, 1e-12))
    exact = {"rtol": 0.0, "atol": np.finfo(float).tiny}  # until there is no more to be gained
    features, _ = cg(normal, adjoint(targets), features, **exact, maxiter=config.fit_steps, M=inverse)
    most = np.clip(inverse_softplus(sigma / scale), None, config.most)
    return np.where(features > deepest + 0.9 * config.reach, np.maximum(features, most), features)


def half_opaque(scale: float, side: np.ndarray) -> np.ndarray:
    """The feature at which light falls to `half` on its way through a voxel of a side."""
    return inverse_softplus(-np.log(current(FieldSamplingConfig).half) / (scale * side))


def inverse_softplus(y: np.ndarray) -> np.ndarray:
    """f with log(1 + e^f) = y; -inf at 0."""
    with np.errstate(divide="ignore"):
        return np.where(y > 15, y, np.log(np.expm1(np.minimum(y, 15))))


def colours(teacher: RadianceField, positions: np.ndarray, facing: np.ndarray, degree: int) -> np.ndarray:
    """(N, 3, coefficients) float32 of the harmonics of the teacher's colour logits at positions (N, 3) in the
    coordinates of its space, by least squares over the directions along which they are seen (facing (N, 3),
    as `Vertices` have it).

    What a teacher says to those who look from inside was never learnt. Where it has no higher degree the fit
    is exact, however the teacher is turned, but for what `one_sided` leaves.
    """
    config = current(FieldSamplingConfig)
    dirs, space = even_directions(config.directions), teacher.occupancy.space
    basis = sh_basis((degree + 1) ** 2, torch.from_numpy(dirs)).numpy()
    coefficients = np.empty((len(positions), 3, len(basis[0])), np.float32)
    one_sided = np.linalg.norm(facing, axis=1) > config.one_sided
    side = np.where(one_sided, (facing @ dirs.T).argmax(1), len(dirs))
    for group in np.unique(side):
        counts = np.ones(len(dirs)) if group == len(dirs) else np.maximum(dirs @ dirs[group], 0)
        indices = np.flatnonzero(counts > 0.1)
        weighted = basis[indices] * counts[indices, None]
        ridge = config.ridge * np.diag([0.0] + [1.0] * (len(basis[0]) - 1))
        solve = np.linalg.solve(weighted.T @ basis[indices] + ridge, weighted.T)
        group_indices = np.flatnonzero(side == group)
        for part in pieces(len(group_indices), config.at_once // len(indices)):
            points = space.inv_contract(
                torch.from_numpy(np.repeat(positions[group_indices[part]], len(indices), 0))
            )
            along = np.tile(dirs[indices], (len(points) // len(indices), 1))
            rgb = teacher.query(points, torch.from_numpy(along))[1].double().numpy()
            edge = 1 / (1 + np.exp(config.logits))
            rgb = np.clip(rgb, edge, 1 - edge)
            logits = np.log(rgb / (1 - rgb)).reshape(-1, len(indices), 3)
            coefficients[group_indices[part]] = np.einsum("kd,ndc->nck", solve, logits)
    return coefficients


def even_directions(count: int) -> np.ndarray:
    """(count, 3) unit directions, evenly spread along a spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * np.pi * (3 - 5**0.5)
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)


def dilated(lattice: Vertices, values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (V, D) where their weight (V,) is 0 from the vertices around, step by step; and the weights
    (V,) then."""
    touches = touching(lattice)
    values, weight = values.astype(np.float32).copy(), weight.astype(np.float32)
    for _ in range(current(FieldSamplingConfig).dilations):
        gathered = touches.T @ (touches @ np.concatenate([values * weight[:, None], weight[:, None]], 1))
        new = (weight == 0) & (gathered[:, -1] > 0)
        values[new] = gathered[new, :-1] / gathered[new, -1:]
        weight[new] = 1e-3
    return values, weight


def pieces(count: int, size: int) -> Iterator[slice]:
    """Slices of at most a size that cover 0 to count."""
    for start in range(0, count, size):
        yield slice(start, min(count, start + size))


def touching(lattice: Vertices) -> sparse.csr_matrix:
    """(K, V) ones where an active voxel has a vertex as a corner."""
    count = len(lattice.corners)
    start = np.arange(0, 8 * count + 1, 8)
    return sparse.csr_matrix(
        (np.ones(8 * count, np.float32), lattice.corners.ravel(), start), (count, len(lattice.positions))
    )
