"""Any field as a sparse one, by asking it: where bricks are needed, and of which level.

A place is about as fine as the object that is densest there needs in world units; where all of that is too
much, what is finest gives way most. What no camera sees is not held. vertex_fit.py says what the vertices
get.
"""

from dataclasses import dataclass
from types import ModuleType

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.encodings.bricks import SIDE
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.kinds.field_sampling import (
    FieldSamplingConfig,
    density,
    even_directions,
    pieces,
    placed_in,
)
from fusedrf_cli.engine.kinds.sparse.bricks import (
    MAX_LEVEL,
    BrickLimits,
    BrickTree,
    children,
    key_positions,
    node_keys,
    sides,
)
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice
from fusedrf_cli.engine.kinds.sparse.training import of_voxels
from fusedrf_cli.engine.kinds.sparse.vertex_fit import density_scale, fill, set_density
from fusedrf_cli.engine.kinds.sparse.visible_cells import is_one_grid
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded


@dataclass(frozen=True)
class ResampleConfig:
    """How the bricks are found that a scene needs."""

    finer: float = 0.6
    """Of a teacher's voxel: a lattice that lies across its own needs finer ones to hold as much."""
    give_way: float = 1 / 6
    """Of its distance to the widest, in logarithms, by which a finer placed field gives way."""
    in_place: float = 0.5
    """Of the widening of an unbounded scene, in logarithms, that of what stands in it: it takes few
    bricks."""
    deepest: int = 6
    """Levels under the coarsest: where voxels differ by more, the widest are finer than needed."""
    faint: float = 1e-4
    """Optical depth of a voxel under which there is nothing."""
    lost_depth: float = 5e-3
    """Optical depth that leaving out voxels may take off a ray: opacity to half a percent."""
    most_lost: float = 0.05
    """Optical depth of a voxel that is always held."""
    odd_lines: int = 20
    """One line of voxels in so many may lose more: a few rays through thin floaters decide nothing."""
    looked_from: int = 20
    """Directions from which voxels are sought."""
    camera_far: float = 0.1
    """Of the box's diagonal: the nearest a camera comes from which a voxel has to be seen."""
    blocked: float = 0.05
    """Transmittance under which nothing is seen."""
    most_tried: int = 1 << 31
    """Bricks in a placed field's box."""
    attempts: int = 4
    """Sizes that are tried."""
    most_attempts: int = 10
    """Where none has fitted yet."""
    aimed: float = 0.97
    """Share of the numbers allowed that the next try aims at."""
    full_enough: float = 0.83
    """Share from which no other is tried."""
    first_widening: float = 2.0
    """What is tried first is cheap."""
    first_in_place: float = 4.0
    """The same of an unbounded scene, of which much more shows."""
    usual_slope: float = -2.7
    """Of the logarithm of numbers over that of the widening, as seen."""
    slope_in_place: float = -2.1


class TooFewNumbers(ValueError):
    """Not even the widest voxels fit."""


def resampled(
    teacher: RadianceField, shape: SparseShape, max_numbers: int, per_brick: float = 0.0
) -> SparseField:
    """The teacher as a sparse field in its frame with at most so many numbers, as which each brick counts
    `per_brick`. Raises EmptyField where the teacher shows nothing, TooFewNumbers where not even the widest
    voxels fit.
    """
    lattice, known = fitted(teacher, shape, max_numbers, per_brick)
    field = SparseField(shape, lattice, density_scale(lattice.tree), space=teacher.occupancy.space)
    fill(field, teacher, *known)
    return field


def fitted(
    teacher: RadianceField, shape: SparseShape, max_numbers: int, per_brick: float
) -> tuple[VertexLattice, list[np.ndarray]]:
    """The finest lattice found with at most so many numbers, and σ (V,) and facing (V, 3) of its vertices."""
    config = current(ResampleConfig)
    voxels, in_place = own_voxels(teacher), teacher.occupancy.space is not bounded
    # No voxel is wider than needed at the least widening.
    least = 1.0 if in_place else (voxels.min() / voxels.max()) ** config.give_way
    widening, best, tried = config.first_in_place if in_place else max(config.first_widening, least), None, []
    for attempt in range(config.most_attempts):
        if attempt >= config.attempts and best is not None:
            break
        try:
            candidate = occupied(teacher, widening)
        except EmptyField:
            if not tried:
                raise
            break  # so wide that nothing shows
        count = number_count(candidate[0], shape) + per_brick * len(candidate[0].tree.level)
        tried.append((np.log(widening), np.log(count)))
        if count <= max_numbers and (best is None or widening < best[0]):
            best = widening, candidate
        if count <= max_numbers and (widening <= least or count >= config.full_enough * max_numbers):
            break
        slope = config.slope_in_place if in_place else config.usual_slope
        if len(tried) > 1 and tried[-1][0] != tried[-2][0]:
            slope = min(-1.5, (tried[-1][1] - tried[-2][1]) / (tried[-1][0] - tried[-2][0]))
        target = tried[-1][0] + (np.log(config.aimed * max_numbers) - tried[-1][1]) / slope
        widening = float(np.exp(np.clip(target, np.log(least), tried[-1][0] + 1)))
    if best is None:
        raise TooFewNumbers(f"a sparse field of this scene needs more than {max_numbers:,} numbers")
    return best[1]


def number_count(lattice: VertexLattice, shape: SparseShape) -> int:
    """Numbers of a sparse field over a lattice."""
    count = 4 * lattice.free
    return count + (shape.band_numbers * lattice.wider.free if shape.sh_degree else 0)


def frame_of(teacher: RadianceField, widening: float) -> tuple[np.ndarray, np.ndarray, tuple, list[int]]:
    """(lower corner, side of a top cell, top cells per axis, level of each placed field) where voxels are
    `finer` times as wide as `voxels_wanted` has it."""
    limits = current(BrickLimits)
    config = current(ResampleConfig)
    needs = config.finer * voxels_wanted(teacher, widening)
    depth = int(np.clip(np.round(np.log2(needs.max() / needs.min())), 0, config.deepest))
    top = SIDE * min(needs.max(), needs.min() * 2**config.deepest)
    box = teacher.occupancy.tight_aabb(0)
    while True:
        counts = np.maximum(np.ceil((box[3:] - box[:3]) / top + 0.5), 1).astype(int)
        if np.prod(counts.astype(float)) <= limits.top_cells // 4:
            break
        depth, top = min(depth + 1, MAX_LEVEL), 2 * top
    lo = (box[:3] + box[3:] - top * counts) / 2
    levels = np.clip(np.round(np.log2(top / (SIDE * needs))), 0, depth).astype(int)
    return lo, sides(top), tuple(counts), [int(level) for level in levels]


def own_voxels(teacher: RadianceField) -> np.ndarray:
    """(P,) the voxels of each placed field."""
    return np.array([p.voxel_size for p in placed_in(teacher)])


def voxels_wanted(teacher: RadianceField, widening: float) -> np.ndarray:
    """(P,) how wide a voxel may be for each placed field: as its own, or as much wider as a widening says.

    What is finer than the widest own voxel gives way a little more: by `give_way` of the distance, in
    logarithms. What stands in an unbounded scene gives way less than the place (`in_place`).
    """
    config = current(ResampleConfig)
    voxels = own_voxels(teacher)
    if teacher.occupancy.space is bounded:
        return np.maximum(
            voxels, widening * voxels ** (1 - config.give_way) * voxels.max() ** config.give_way
        )
    is_unbounded = np.array([p.unbounded for p in placed_in(teacher)])
    return voxels * np.maximum(1, widening) ** np.where(is_unbounded, 1, config.in_place)


def occupied(teacher: RadianceField, widening: float) -> tuple[VertexLattice, list[np.ndarray]]:
    """The lattice whose active voxels hold all density that shows, and σ (V,) and facing (V, 3) of its
    vertices."""
    lo, top, counts, levels = frame_of(teacher, widening)
    needed: list[list[np.ndarray]] = [[] for _ in range(max(levels) + 1)]
    for placed, level in zip(placed_in(teacher), levels, strict=True):
        needed[level].append(demanded(teacher, placed, level, lo, top, counts))
    level, at = leaves([np.unique(np.concatenate(w)) if w else np.zeros(0, np.int64) for w in needed])
    mask = np.ones((len(level), SIDE, SIDE, SIDE), bool)
    lattice = VertexLattice(BrickTree.of(lo, top, counts, level, at, mask), SIDE)
    sigma = density(teacher, lattice.positions)
    dense = (sigma * lattice.finest_voxel > current(ResampleConfig).faint)[lattice.corners].any(1)
    lattice, (sigma,) = thinned(lattice, dense, sigma)
    field = SparseField(SparseShape(0), lattice, density_scale(lattice.tree), space=teacher.occupancy.space)
    set_density(field, sigma)
    is_background = is_too_fine_unbounded(teacher, lattice, levels)
    visible, facing = shown(field, ~is_background | one_of_eight(lattice))
    return thinned(lattice, visible | is_background, sigma, facing)


def is_too_fine_unbounded(teacher: RadianceField, lattice: VertexLattice, levels: list[int]) -> np.ndarray:
    """(K,) bool: which active voxels are no finer than a place needs that visible_cells.py has cut down to
    what its views show, so that there is nothing to be left out of it."""
    finest = [level for p, level in zip(placed_in(teacher), levels, strict=True) if is_one_grid(p)]
    return np.repeat(lattice.tree.level <= max(finest, default=-1), lattice.active.sum(1))


def one_of_eight(lattice: VertexLattice) -> np.ndarray:
    """(K,) bool: active voxels of which every vertex has one beside it, where all around it are active."""
    i, j, k = np.unravel_index(np.nonzero(lattice.active)[1], (SIDE,) * 3)
    return (i | j | k) % 2 == 0


class EmptyField(ValueError):
    """Nothing is there to be held."""


def thinned(
    lattice: VertexLattice, mask: np.ndarray, *values: np.ndarray
) -> tuple[VertexLattice, list[np.ndarray]]:
    """The lattice of those active voxels of another that are mask (K,), and the values (V, ...) of its
    vertices. Raises EmptyField where there are none."""
    smaller = of_voxels(lattice, mask)
    if smaller is None:
        raise EmptyField("the scene shows nothing")
    at = lattice.find(smaller.keys)[0]
    return smaller, [v[at] for v in values]


def shown(field: SparseField, which: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Which active voxels (K,) a camera sees anything of that is not closer than `camera_far` times the box;
    and the mean direction (V, 3) along which each vertex is seen, of length 1 where from one side alone. With
    `which` (K,) bool only those voxels are looked at, and all others shown.

    What is hidden in solids is not held, and of low density as much is left out as no line of sight misses.
    """
    config = current(ResampleConfig)
    lattice = field.fine
    which = np.ones(len(lattice.corners), bool) if which is None else which
    corners, box, feature = lattice.corners[which], field.aabb, field.rows[:, 0].numpy()
    far = config.camera_far * float(np.linalg.norm(box[3:] - box[:3]))
    low, high = lattice.positions[corners[:, 0]], lattice.positions[corners[:, 7]]
    clearest, facing = field.exposed(low, high, even_directions(config.looked_from), far, config.blocked)
    sigma = np.where(feature > current(FieldSamplingConfig).least, field.scale * np.logaddexp(0, feature), 0)
    depth = sigma[corners].max(1) * (high - low).min(1) * clearest
    mask = which.copy()
    mask[which] = depth > harmless(depth, lattice.vertices[corners[:, 0]])
    weighted = np.concatenate([facing, np.ones((len(facing), 1))], 1) * (depth * mask[which])[:, None]
    summed = at_vertices(corners, weighted, len(lattice.positions))
    return mask | ~which, summed[:, :3] / np.maximum(summed[:, 3:], 1e-12)


def at_vertices(corners: np.ndarray, values: np.ndarray, count: int) -> np.ndarray:
    """(count, D) sums at vertices of what voxels (K,) of corners (K, 8) are worth (K, D); column by column,
    since a matrix of them all would take the most memory of anything."""
    found = np.zeros((count, values.shape[1]))
    for corner in corners.T:
        for column, total in zip(values.T, found.T, strict=True):
            total += np.bincount(corner, column, count)
    return found


def demanded(
    teacher: RadianceField, placed: Placed, level: int, lo: np.ndarray, top: np.ndarray, counts: tuple
) -> np.ndarray:
    """Keys of the bricks of a level at one of whose vertices the placed field is the densest there is."""
    side, space = top / 2**level, teacher.occupancy.space
    bricks = touched(placed, side, lo, np.asarray(counts) << level, space)
    n = SIDE + 1
    inner = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    keys, inverse = np.unique(node_keys((bricks[:, None] * SIDE + inner).reshape(-1, 3)), return_inverse=True)
    positions = lo + key_positions(keys) * (side / SIDE)
    sigma = density(placed, positions, space)
    dense = sigma * np.min(side) / SIDE > current(ResampleConfig).faint
    for other in placed_in(teacher):
        beside = dense & holds(other, positions, space)
        if other is not placed and beside.any():
            dense[beside] = sigma[beside] >= density(other, positions[beside], space)
    needed = dense[inverse].reshape(-1, n**3).any(1)
    return node_keys(bricks[needed])


def holds(placed: Placed, positions: np.ndarray, space: ModuleType) -> np.ndarray:
    """(N,) bool: which places, in the coordinates of a scene's space, lie in a placed field's box."""
    if placed.unbounded:
        return np.ones(len(positions), bool)
    points = space.inv_contract(torch.from_numpy(positions)).numpy()
    return (points >= placed.aabb[:3]).all(1) & (points <= placed.aabb[3:]).all(1)


def touched(
    placed: Placed, side: np.ndarray, lo: np.ndarray, counts: np.ndarray, space: ModuleType
) -> np.ndarray:
    """(M, 3) the bricks of a side that the occupied cells of a placed field reach, and a voxel around
    them."""
    if space is not bounded:
        return touched_in_space(placed, side, lo, counts, space)
    grid, matrix = placed.field.occupancy, placed.object_to_world
    stretch = np.linalg.norm(matrix[:3, :3], axis=0)
    margin = np.max(side) / SIDE / np.maximum(stretch, 1e-30)
    steps = np.ceil((grid.cell + 2 * margin) * stretch / (0.7 * np.min(side))).astype(int) + 1
    spots = [np.linspace(-m, c + m, s) for m, c, s in zip(margin, grid.cell, steps, strict=True)]
    inner = np.stack(np.meshgrid(*spots, indexing="ij"), -1).reshape(-1, 3) @ matrix[:3, :3].T
    corners = (grid.aabb[:3] + np.argwhere(grid.occupied) * grid.cell) @ matrix[:3, :3].T + matrix[:3, 3]
    first = np.clip(np.floor((placed.aabb[:3] - lo) / side).astype(int) - 1, 0, counts - 1)
    last = np.clip(np.floor((placed.aabb[3:] - lo) / side).astype(int) + 1, 0, counts - 1)
    if np.prod(last - first + 1.0) > current(ResampleConfig).most_tried:
        raise ValueError(f"'{placed.name}' is too large for voxels so fine")
    marked = np.zeros(last - first + 1, bool)
    start = ((corners - lo) / side - first).astype(np.float32)
    fewer, more = sorted((start, (inner / side).astype(np.float32)), key=len)
    for part in pieces(len(more), current(FieldSamplingConfig).at_once):
        for offset in fewer:
            index = np.clip((more[part] + offset).astype(np.int32), 0, last - first)
            marked[index[:, 0], index[:, 1], index[:, 2]] = True
    return np.argwhere(marked) + first


def touched_in_space(
    placed: Placed, side: np.ndarray, lo: np.ndarray, counts: np.ndarray, space: ModuleType
) -> np.ndarray:
    """As `touched`, for a scene whose coordinates are not those of its frame: the bricks at one of whose
    points, a few per voxel apart, a cell of the placed field is occupied."""
    first, last = reached(placed, side, lo, counts, space)
    if np.prod(last - first + 1.0) > current(ResampleConfig).most_tried:
        raise ValueError(f"'{placed.name}' is too large for voxels so fine")
    spots = np.linspace(-1 / SIDE, 1 + 1 / SIDE, SIDE if placed.field.voxel_size < np.min(side) else 2)
    inner = np.stack(np.meshgrid(spots, spots, spots, indexing="ij"), -1).reshape(-1, 3)
    grid, into, bricks = placed.field.occupancy, np.linalg.inv(placed.object_to_world), []
    for part in pieces(int(np.prod(last - first + 1)), current(FieldSamplingConfig).at_once // len(inner)):
        at = np.stack(np.unravel_index(np.arange(part.start, part.stop), last - first + 1), -1) + first
        points = torch.from_numpy((lo + (at[:, None] + inner) * side).reshape(-1, 3))
        points = space.inv_contract(points).numpy() @ into[:3, :3].T + into[:3, 3]
        points = grid.space.contract(torch.from_numpy(points)).numpy()
        bricks.append(at[grid.contains(points).reshape(len(at), -1).any(1)])
    return np.concatenate(bricks)


def reached(
    placed: Placed, side: np.ndarray, lo: np.ndarray, counts: np.ndarray, space: ModuleType
) -> tuple[np.ndarray, np.ndarray]:
    """The first and the last (3,) of the bricks of a side, in a space's coordinates, in which there may be
    anything of a placed field."""
    if placed.unbounded:
        return np.zeros(3, int), counts - 1
    grid, matrix = placed.field.occupancy, placed.object_to_world
    centres = torch.from_numpy(grid.centres() @ matrix[:3, :3].T + matrix[:3, 3])
    centres = space.contract(centres).numpy()
    # half a cell's diagonal, which the map of space makes twice as long at most
    margin = np.linalg.norm(matrix[:3, :3], 2) * np.linalg.norm(grid.cell) + side
    first = np.clip(np.floor((centres.min(0) - margin - lo) / side).astype(int), 0, counts - 1)
    last = np.clip(np.floor((centres.max(0) + margin - lo) / side).astype(int), 0, counts - 1)
    return first, last


def leaves(needed: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(level (N,), place (N, 3)) of the leaves of the tree in which every wanted brick (keys by level) is
    held at its level or a finer one: where a finer brick lies inside, the rest of the wanted one is split
    around it."""
    finer = [
        np.unique(
            np.concatenate(
                [np.zeros(0, np.int64)]
                + [
                    node_keys(key_positions(keys) >> (deep - level))
                    for deep, keys in enumerate(needed)
                    if deep > level
                ]
            )
        )
        for level in range(len(needed))
    ]
    levels, positions = [], []
    nodes = np.union1d(needed[0], finer[0])
    covered = np.isin(nodes, needed[0])
    for level in range(len(needed)):
        covered = covered | np.isin(nodes, needed[level])
        split = np.isin(nodes, finer[level])
        leaf = covered & ~split
        positions.append(key_positions(nodes[leaf]))
        levels.append(np.full(len(positions[-1]), level, np.uint8))
        nodes, covered = node_keys(children(key_positions(nodes[split]))), np.repeat(covered[split], 8)
    return np.concatenate(levels), np.concatenate(positions)


def harmless(depth: np.ndarray, positions: np.ndarray) -> float:
    """The largest optical depth of a voxel up to which voxels (K,) at positions (K, 3) may be left out, when
    one in `odd_lines` of the axis-parallel lines through them may lose more than `lost_depth`: thin floaters
    are no emptiness."""
    config = current(ResampleConfig)
    if not len(depth):
        return 0.0
    lines = []
    for a, b in ((0, 1), (0, 2), (1, 2)):
        lines.append(np.unique(positions[:, a] << 21 | positions[:, b], return_inverse=True)[1])
    for threshold in config.most_lost * 0.5 ** np.arange(12):
        lost = np.where(depth <= threshold, depth, 0)
        most = max(np.quantile(np.bincount(line, lost), 1 - 1 / config.odd_lines) for line in lines)
        if most <= config.lost_depth:
            return float(threshold)
    return 0.0
