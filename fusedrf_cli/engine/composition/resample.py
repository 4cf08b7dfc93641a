"""Any field as a sparse one, by asking it at the vertices: no learning.

A place is as fine as the object that is densest there needs in world units, not finer; where all of that is
too much, all is coarser by one factor.
"""

from collections.abc import Iterator

import numpy as np
import torch
from scipy import sparse

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.bricks import (
    MAX_LEVEL,
    MAX_TOP_CELLS,
    OCTANTS,
    BrickTree,
    Lattice,
    children,
    corner_offsets,
    key_places,
    node_keys,
    sides,
)
from fusedrf_cli.engine.fields.sparse import COARSE, SparseField, SparseShape
from fusedrf_cli.engine.kernels.reference import sh_basis
from fusedrf_cli.engine.kernels.sparse_bodies import SIDE

FINER = (
    0.6  # of a teacher's voxel: a lattice that lies across the teacher's own needs finer ones to hold as much
)
DEEPEST = (
    6  # levels below the coarsest; a ratio of voxels beyond 2^6 makes the coarse object's finer than it needs
)
FAINT = 1e-4  # optical depth of a voxel under which there is nothing
LOST_DEPTH = 5e-3  # optical depth that leaving out voxels may take off a ray: opacity to half a percent
COLOURED = (
    1e-2  # optical depth of a voxel from which a vertex's colour is the teacher's and not its neighbours'
)
LEAST, MOST = -12.0, 60.0  # of the density feature
REACH, HALF, FIT_STEPS = 5.0, 0.6, 6  # measured: 32.4 dB by asking at vertices, 35.0 dB with these
LOOKED_FROM, DIRECTIONS = 20, 32  # directions along which voxels are sought, and colours asked
ONE_SIDED = (
    0.4  # length of the mean direction along which a vertex is seen, from which only that side is asked
)
LOOKS = 9  # places along a look through the voxels before and behind a vertex
RIDGE = 1e-3  # keeps harmonics small where no direction tells of them
LOGITS = 8.0  # colours are told apart up to sigmoid(8)
AT_ONCE = 1 << 18
ATTEMPTS = 4
FULL_ENOUGH = 0.93  # of the numbers allowed
DILATIONS = 3
CAMERA_FAR = 0.1  # of the box's diagonal: the nearest a camera comes from which a voxel has to be seen
BLOCKED = 0.05  # transmittance under which nothing is seen
MOST_LOST = 0.05  # optical depth of a voxel that is always held
ODD_LINES = 20
CORRECTIONS = 3


class TooFewNumbers(ValueError):
    """Not even the widest voxels fit."""


def resampled(teacher: RadianceField, shape: SparseShape, max_numbers: int) -> SparseField:
    """The teacher as a sparse field in its frame with at most so many numbers. Raises EmptyField where the
    teacher shows nothing, TooFewNumbers where not even the widest voxels fit.
    """
    lattice, known = fitted(teacher, shape, max_numbers)
    field = SparseField(shape, lattice, density_scale(lattice.tree))
    fill(field, teacher, *known)
    return field


def fitted(teacher: RadianceField, shape: SparseShape, max_numbers: int) -> tuple[Lattice, list[np.ndarray]]:
    """The finest lattice found with at most so many numbers, and σ (V,) and facing (V, 3) of its vertices."""
    own = [p.voxel_size for p in placed_in(teacher)]
    common, best, tried = 2 * max(own), None, []
    for _ in range(ATTEMPTS):
        found = occupied(teacher, common)
        count = number_count(found[0], shape)
        tried.append((np.log(common), np.log(count)))
        if count <= max_numbers and (best is None or common < best[0]):
            best = common, found
        if count <= max_numbers and (common <= min(own) or count >= FULL_ENOUGH * max_numbers):
            break
        slope = -1.5
        if len(tried) > 1 and tried[-1][0] != tried[-2][0]:
            slope = min(-0.5, (tried[-1][1] - tried[-2][1]) / (tried[-1][0] - tried[-2][0]))
        wanted = tried[-1][0] + (np.log(0.97 * max_numbers) - tried[-1][1]) / slope
        common = float(np.exp(np.clip(wanted, np.log(min(own)), tried[-1][0] + 2)))
    if best is None:
        raise TooFewNumbers(f"a sparse field of this scene needs more than {max_numbers:,} numbers")
    return best[1]


def number_count(lattice: Lattice, shape: SparseShape) -> int:
    """Numbers of a sparse field over a lattice."""
    count = 4 * lattice.free
    return count + (shape.band_numbers * Lattice(lattice.tree, COARSE).free if shape.sh_degree else 0)


# -- where ---------------------------------------------------------------------------------------------------


def placed_in(teacher: RadianceField) -> list[Placed]:
    """The placed fields of a composed one; any other field by itself."""
    return getattr(teacher, "placed", None) or [Placed("", teacher, np.eye(4))]


def frame_of(teacher: RadianceField, common: float) -> tuple[np.ndarray, np.ndarray, tuple, list[int]]:
    """(lower corner, side of a top cell, top cells per axis, level of each placed field) where voxels should
    be no finer than each placed field's own, nor than the geometric mean of that and a common one.

    With an error that grows as the square of the voxel over a field's own, and numbers that fall with its
    square, the mean is what gives the least error for the numbers.
    """
    own = np.array([p.voxel_size for p in placed_in(teacher)])
    needs = FINER * np.sqrt(own * np.maximum(own, common))
    depth = int(np.clip(np.round(np.log2(needs.max() / needs.min())), 0, DEEPEST))
    top = SIDE * min(needs.max(), needs.min() * 2**DEEPEST)
    box = teacher.occupancy.tight_aabb(0)
    while True:
        counts = np.maximum(np.ceil((box[3:] - box[:3]) / top + 0.5), 1).astype(int)
        if np.prod(counts.astype(float)) <= MAX_TOP_CELLS // 4:
            break
        depth, top = min(depth + 1, MAX_LEVEL), 2 * top
    lo = (box[:3] + box[3:] - top * counts) / 2
    levels = np.clip(np.round(np.log2(top / (SIDE * needs))), 0, depth).astype(int)
    return lo, sides(top), tuple(counts), [int(level) for level in levels]


def occupied(teacher: RadianceField, common: float) -> tuple[Lattice, list[np.ndarray]]:
    """The lattice whose active voxels hold all matter that shows, and σ (V,) and facing (V, 3) of its
    vertices."""
    lo, top, counts, levels = frame_of(teacher, common)
    wanted: list[list[np.ndarray]] = [[] for _ in range(max(levels) + 1)]
    for placed, level in zip(placed_in(teacher), levels, strict=True):
        wanted[level].append(demanded(teacher, placed, level, lo, top, counts))
    level, at = leaves([np.unique(np.concatenate(w)) if w else np.zeros(0, np.int64) for w in wanted])
    whole = BrickTree.of(lo, top, counts, level, at, np.ones((len(level), SIDE, SIDE, SIDE), bool))
    lattice = Lattice(whole, SIDE)
    sigma = density(teacher, lattice.places)
    dense = (sigma * lattice.finest_voxel > FAINT)[lattice.corners].any(1)
    lattice, (sigma,) = thinned(lattice, dense, sigma)
    field = SparseField(SparseShape(0), lattice, density_scale(lattice.tree))
    set_density(field, sigma)
    kept, facing = shown(field)
    return thinned(lattice, kept, sigma, facing)


class EmptyField(ValueError):
    """Nothing is there to be held."""


def thinned(lattice: Lattice, kept: np.ndarray, *values: np.ndarray) -> tuple[Lattice, list[np.ndarray]]:
    """The lattice of those active voxels of another that are kept (K,), and the values (V, ...) of its
    vertices. Raises EmptyField where there are none."""
    if not kept.any():
        raise EmptyField("the scene shows nothing")
    whole = lattice.tree
    mask = np.zeros(lattice.active.shape, bool)
    mask[lattice.active] = kept
    own = mask.any(1)
    mask = mask[own].reshape(-1, SIDE, SIDE, SIDE)
    tree = BrickTree.of(whole.lo, whole.top, whole.counts, whole.level[own], whole.at[own], mask)
    smaller = Lattice(tree, SIDE)
    at = lattice.find(smaller.keys)[0]
    return smaller, [v[at] for v in values]


def shown(field: SparseField, which: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Which active voxels (K,) a camera sees anything of that is not closer than CAMERA_FAR times the box;
    and the mean direction (V, 3) along which each vertex is seen, of length 1 where from one side alone. With
    `which` (K,) bool only those voxels are looked at, and all others shown.

    What is hidden in solids is not held, and of haze as much is left out as no line of sight misses.
    """
    lattice = field.fine
    which = np.ones(len(lattice.corners), bool) if which is None else which
    corners, box, feature = lattice.corners[which], field.aabb, field.rows[:, 0].numpy()
    far = CAMERA_FAR * float(np.linalg.norm(box[3:] - box[:3]))
    low, high = lattice.places[corners[:, 0]], lattice.places[corners[:, 7]]
    clearest, facing = field.exposed(low, high, even_directions(LOOKED_FROM), far, BLOCKED)
    sigma = np.where(feature > LEAST, field.scale * np.logaddexp(0, feature), 0)
    depth = sigma[corners].max(1) * (high - low).min(1) * clearest
    kept = which.copy()
    kept[which] = depth > harmless(depth, lattice.vertices[corners[:, 0]])
    told = np.concatenate([facing, np.ones((len(facing), 1))], 1) * (depth * kept[which])[:, None]
    summed = touching(lattice)[which].T @ told
    return kept | ~which, summed[:, :3] / np.maximum(summed[:, 3:], 1e-12)


def touching(lattice: Lattice) -> sparse.csr_matrix:
    """(K, V) ones where an active voxel has a vertex as a corner."""
    count = len(lattice.corners)
    start = np.arange(0, 8 * count + 1, 8)
    return sparse.csr_matrix(
        (np.ones(8 * count, np.float32), lattice.corners.ravel(), start), (count, len(lattice.vertices))
    )


def demanded(
    teacher: RadianceField, placed: Placed, level: int, lo: np.ndarray, top: np.ndarray, counts: tuple
) -> np.ndarray:
    """Keys of the bricks of a level at one of whose vertices the placed field is the densest there is."""
    side = top / 2**level
    bricks = touched(placed, side, lo, np.asarray(counts) << level)
    n = SIDE + 1
    inner = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3)
    keys, inverse = np.unique(node_keys((bricks[:, None] * SIDE + inner).reshape(-1, 3)), return_inverse=True)
    places = lo + key_places(keys) * (side / SIDE)
    own = density(placed, places)
    dense = own * np.min(side) / SIDE > FAINT
    for other in placed_in(teacher):
        beside = dense & (places >= other.aabb[:3]).all(1) & (places <= other.aabb[3:]).all(1)
        if other is not placed and beside.any():
            dense[beside] = own[beside] >= density(other, places[beside])
    kept = dense[inverse].reshape(-1, n**3).any(1)
    return node_keys(bricks[kept])


def touched(placed: Placed, side: np.ndarray, lo: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(M, 3) the bricks of a side that the occupied cells of a placed field reach, and a voxel around
    them."""
    grid, matrix = placed.field.occupancy, placed.object_to_world
    stretch = np.linalg.norm(matrix[:3, :3], axis=0)
    margin = np.max(side) / SIDE / np.maximum(stretch, 1e-30)
    steps = np.ceil((grid.cell + 2 * margin) * stretch / (0.7 * np.min(side))).astype(int) + 1
    spots = [np.linspace(-m, c + m, s) for m, c, s in zip(margin, grid.cell, steps, strict=True)]
    inner = np.stack(np.meshgrid(*spots, indexing="ij"), -1).reshape(-1, 3) @ matrix[:3, :3].T
    corners = (grid.aabb[:3] + np.argwhere(grid.occupied) * grid.cell) @ matrix[:3, :3].T + matrix[:3, 3]
    first = np.clip(np.floor((placed.aabb[:3] - lo) / side).astype(int) - 1, 0, counts - 1)
    last = np.clip(np.floor((placed.aabb[3:] - lo) / side).astype(int) + 1, 0, counts - 1)
    found = np.zeros(last - first + 1, bool)
    start = ((corners - lo) / side - first).astype(np.float32)
    fewer, more = sorted((start, (inner / side).astype(np.float32)), key=len)
    for part in pieces(len(more), AT_ONCE):
        for offset in fewer:
            index = np.clip((more[part] + offset).astype(np.int32), 0, last - first)
            found[index[:, 0], index[:, 1], index[:, 2]] = True
    return np.argwhere(found) + first


def leaves(wanted: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """(level (N,), place (N, 3)) of the leaves of the tree in which every wanted brick (keys by level) is
    held at its level or a finer one: where a finer brick lies inside, the rest of the wanted one is split
    around it."""
    finer = [
        np.unique(
            np.concatenate(
                [np.zeros(0, np.int64)]
                + [
                    node_keys(key_places(keys) >> (deep - level))
                    for deep, keys in enumerate(wanted)
                    if deep > level
                ]
            )
        )
        for level in range(len(wanted))
    ]
    levels, places = [], []
    nodes = np.union1d(wanted[0], finer[0])
    covered = np.isin(nodes, wanted[0])
    for level in range(len(wanted)):
        covered = covered | np.isin(nodes, wanted[level])
        split = np.isin(nodes, finer[level])
        leaf = covered & ~split
        places.append(key_places(nodes[leaf]))
        levels.append(np.full(len(places[-1]), level, np.uint8))
        nodes, covered = node_keys(children(key_places(nodes[split]))), np.repeat(covered[split], 8)
    return np.concatenate(levels), np.concatenate(places)


def harmless(depth: np.ndarray, places: np.ndarray) -> float:
    """The largest optical depth of a voxel up to which voxels (K,) at places (K, 3) may be left out, when one
    in ODD_LINES of the axis-parallel lines through them may lose more than LOST_DEPTH: thin fog is no
    emptiness."""
    if not len(depth):
        return 0.0
    lines = []
    for a, b in ((0, 1), (0, 2), (1, 2)):
        lines.append(np.unique(places[:, a] << 21 | places[:, b], return_inverse=True)[1])
    for threshold in MOST_LOST * 0.5 ** np.arange(12):
        lost = np.where(depth <= threshold, depth, 0)
        if max(np.quantile(np.bincount(line, lost), 1 - 1 / ODD_LINES) for line in lines) <= LOST_DEPTH:
            return float(threshold)
    return 0.0


# -- what ----------------------------------------------------------------------------------------------------


def density(source, places: np.ndarray) -> np.ndarray:
    """(N,) float64 σ at places (N, 3) of a field or a placed one, the mean over three axes where that depends
    on the direction."""
    parts = [source] if isinstance(source, Placed) else placed_in(source)
    stretched = any(p.condition > 1 + 1e-6 for p in parts)
    found = np.zeros(len(places))
    axes = np.eye(3)[: 3 if stretched else 1]
    for part in pieces(len(places), AT_ONCE):
        points = torch.from_numpy(places[part])
        for axis in axes:
            dirs = torch.from_numpy(np.broadcast_to(axis, points.shape).copy())
            if isinstance(source, Placed):
                x, d, stretch = source.to_object(points, dirs)
                sigma = source.field.query(x, d, False)[0].double() * stretch
            else:
                sigma = source.query(points, dirs, False)[0].double()
            found[part] += sigma.numpy() / len(axes)
    return found


def fill(field: SparseField, teacher: RadianceField, sigma: np.ndarray, facing: np.ndarray) -> None:
    """Give the vertices the numbers that show what the teacher does, whose σ there is known (V,), and the
    directions along which they are seen (V, 3), as of `shown`.

    What lies under a surface was never seen, and what lies before it is nothing: a vertex takes its colour
    from where a look along its facing ends.
    """
    fine, degree = field.fine, field.shape.sh_degree
    fit_density(field, teacher, sigma)
    places, opacity = look(teacher, fine, sigma, facing)
    coefficients = np.zeros((len(sigma), 3, field.shape.coefficients), np.float32)
    asked = np.flatnonzero(opacity > COLOURED)
    coefficients[asked] = colours(teacher, places[asked], facing[asked], degree)
    weight = np.where(opacity > COLOURED, opacity, 0)
    field.rows[:, 1:] = torch.from_numpy(dilated(fine, coefficients[..., 0], weight)[0])
    if field.coarse:
        bands, held = coarser(fine, field.coarse, coefficients[..., 1:].reshape(len(sigma), -1), weight)
        field.bands[:] = torch.from_numpy(dilated(field.coarse, bands, held)[0])
    field.settle()


def look(
    teacher: RadianceField, lattice: Lattice, sigma: np.ndarray, facing: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """What is seen from a voxel before a vertex to a voxel behind, along its facing: where most of that is
    (V, 3), and the opacity (V,) of it all. A vertex that is seen from all sides, or never, is all that it
    sees."""
    size, places = lattice.finest_voxel, lattice.places.copy()
    opacity = -np.expm1(-sigma * size)
    length = np.linalg.norm(facing, axis=1)
    which = np.flatnonzero(length > ONE_SIDED)
    along = facing[which] / length[which, None] * size[which, None]
    spots = np.linspace(-1, 1, LOOKS)
    trans, heaviest, end = np.ones(len(which)), np.zeros(len(which)), np.zeros(len(which))
    for spot in spots:
        depth = density(teacher, lattice.places[which] + spot * along) * size[which] * (spots[1] - spots[0])
        weight = -trans * np.expm1(-depth)
        end, heaviest = np.where(weight > heaviest, spot, end), np.maximum(weight, heaviest)
        trans = trans - weight
    places[which] += end[:, None] * along
    opacity[which] = 1 - trans
    return places, opacity


def fit_density(field: SparseField, teacher: RadianceField, sigma: np.ndarray) -> None:
    """Density features that, interpolated, come nearest to the teacher's in the squares of their differences
    at eight points of every active voxel; sigma (V,) is what the teacher says at the vertices.

    In a voxel that a surface runs through, features are told apart up to REACH on either side of the one at
    which it is half opaque: so the surface comes to lie where it is, between vertices of which one knows only
    that there is much and the other that there is nothing.
    """
    lattice = field.fine
    corners = lattice.corners
    first = lattice.places[corners[:, 0]]
    extent = lattice.places[corners[:, 7]] - first
    spots = 0.25 + 0.5 * OCTANTS
    weights = np.where(OCTANTS == 1, spots[:, None], 1 - spots[:, None]).prod(2)
    answers = np.stack([density(teacher, first + extent * spot) for spot in spots], 1)
    half, own = (half_opaque(field.scale, size) for size in (extent.min(1)[:, None], lattice.finest_voxel))
    wanted = np.clip(inverse_softplus(answers / field.scale), LEAST, half + REACH)
    wanted = np.where(wanted.max(1, keepdims=True) > half, np.maximum(wanted, half - REACH), wanted)
    found = np.clip(inverse_softplus(sigma / field.scale), own - REACH, own + REACH)
    scatter = sparse.csr_matrix(
        (np.ones(corners.size), (corners.ravel(), np.arange(corners.size))), (len(found), corners.size)
    )

    def adjoint(rest: np.ndarray) -> np.ndarray:
        return scatter @ (rest @ weights).ravel()

    found = conjugate_gradients(
        lambda x: x[corners] @ weights.T,
        adjoint,
        scatter @ np.tile((weights**2).sum(0), len(corners)),
        wanted,
        found,
    )
    most = np.clip(inverse_softplus(sigma / field.scale), None, MOST)
    field.rows[:, 0] = torch.from_numpy(np.where(found > own + 0.9 * REACH, np.maximum(found, most), found))
    field.settle()


def conjugate_gradients(
    apply, adjoint, diagonal: np.ndarray, wanted: np.ndarray, start: np.ndarray
) -> np.ndarray:
    """x that makes the squares of apply(x) - wanted small, in FIT_STEPS steps from a start; the diagonal is
    that of adjoint(apply(.))."""
    x, diagonal = start, np.maximum(diagonal, 1e-12)
    rest = adjoint(wanted - apply(x))
    along = rest / diagonal
    size = rest @ along
    for _ in range(FIT_STEPS):
        if size <= 0:
            break
        curved = adjoint(apply(along))
        length = size / (along @ curved)
        x, rest = x + length * along, rest - length * curved
        new = rest @ (rest / diagonal)
        along, size = rest / diagonal + new / size * along, new
    return x


def half_opaque(scale: float, side: np.ndarray) -> np.ndarray:
    """The feature at which light falls to HALF on its way through a voxel of a side."""
    return inverse_softplus(-np.log(HALF) / (scale * side))


def density_scale(tree: BrickTree) -> float:
    """σ of a feature of 1, about: an optical depth of 1 in a voxel between the widest and the finest."""
    return float(1 / np.sqrt(tree.unit.min() * tree.top.min() / (SIDE << int(tree.level.min()))))


def set_density(field: SparseField, sigma: np.ndarray) -> None:
    """Give the vertices densities (V,), as far as the feature's range goes."""
    field.rows[:, 0] = torch.from_numpy(np.clip(inverse_softplus(sigma / field.scale), LEAST, MOST))
    field.settle()


def inverse_softplus(y: np.ndarray) -> np.ndarray:
    """f with log(1 + e^f) = y; -inf at 0."""
    with np.errstate(divide="ignore"):
        return np.where(y > 15, y, np.log(np.expm1(np.minimum(y, 15))))


def colours(teacher: RadianceField, places: np.ndarray, facing: np.ndarray, degree: int) -> np.ndarray:
    """(N, 3, coefficients) float32 of the harmonics of the teacher's colour logits at places (N, 3), by least
    squares over the directions along which they are seen (facing (N, 3), as `around` has it).

    What a teacher says to those who look from inside was never learnt. Where it has no higher degree the fit
    is exact, however the teacher is turned, but for what ONE_SIDED leaves.
    """
    dirs = even_directions(DIRECTIONS)
    basis = sh_basis((degree + 1) ** 2, torch.from_numpy(dirs)).numpy()
    found = np.empty((len(places), 3, len(basis[0])), np.float32)
    one_sided = np.linalg.norm(facing, axis=1) > ONE_SIDED
    side = np.where(one_sided, (facing @ dirs.T).argmax(1), len(dirs))
    for group in np.unique(side):
        counts = np.ones(len(dirs)) if group == len(dirs) else np.maximum(dirs @ dirs[group], 0)
        asked = np.flatnonzero(counts > 0.1)
        weighted = basis[asked] * counts[asked, None]
        ridge = RIDGE * np.diag([0.0] + [1.0] * (len(basis[0]) - 1))
        solve = np.linalg.solve(weighted.T @ basis[asked] + ridge, weighted.T)
        own = np.flatnonzero(side == group)
        for part in pieces(len(own), AT_ONCE // len(asked)):
            points = np.repeat(places[own[part]], len(asked), 0)
            along = np.tile(dirs[asked], (len(points) // len(asked), 1))
            rgb = teacher.query(torch.from_numpy(points), torch.from_numpy(along))[1].double().numpy()
            edge = 1 / (1 + np.exp(LOGITS))
            rgb = np.clip(rgb, edge, 1 - edge)
            logits = np.log(rgb / (1 - rgb)).reshape(-1, len(asked), 3)
            found[own[part]] = np.einsum("kd,ndc->nck", solve, logits)
    return found


def even_directions(count: int) -> np.ndarray:
    """(count, 3) unit directions, evenly spread along a spiral."""
    z = 1 - (2 * np.arange(count) + 1) / count
    angle = np.arange(count) * np.pi * (3 - 5**0.5)
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(angle), ring * np.sin(angle), z], 1)


def dilated(lattice: Lattice, values: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (V, D) where their weight (V,) is 0 from the vertices around, step by step; and the weights
    (V,) then."""
    touches = touching(lattice)
    values, weight = values.astype(np.float32).copy(), weight.astype(np.float32)
    for _ in range(DILATIONS):
        gathered = touches.T @ (touches @ np.concatenate([values * weight[:, None], weight[:, None]], 1))
        new = (weight == 0) & (gathered[:, -1] > 0)
        values[new] = gathered[new, :-1] / gathered[new, -1:]
        weight[new] = 1e-3
    return values, weight


def coarser(
    fine: Lattice, coarse: Lattice, values: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(W, D) values of the coarse vertices whose interpolation comes near to values (V, D) of the fine ones,
    where these have a weight (V,), and their own weights (W,)."""
    matrix = interpolation(fine, coarse)
    weighted = matrix.T @ sparse.diags(weight.astype(np.float32))
    total = np.asarray(weighted.sum(1)).ravel()
    values = values.astype(np.float32)
    share = (1 / np.maximum(total, 1e-12))[:, None].astype(np.float32)
    found = share * (weighted @ values)
    for _ in range(CORRECTIONS):
        found += share * (weighted @ (values - matrix @ found))
    return found, total


def interpolation(fine: Lattice, coarse: Lattice) -> sparse.csr_matrix:
    """(V, W) weights of the coarse vertices at the fine ones, both over one tree."""
    n, m = SIDE + 1, COARSE
    at = np.stack(np.meshgrid(*[np.arange(n)] * 3, indexing="ij"), -1).reshape(-1, 3) * m / SIDE
    voxel = np.minimum(at.astype(int), m - 1)
    share = at - voxel
    weights = np.where(OCTANTS == 1, share[:, None], 1 - share[:, None]).prod(2)
    first = (voxel[:, 0] * (m + 1) + voxel[:, 1]) * (m + 1) + voxel[:, 2]
    inner = first[:, None] + corner_offsets(m)
    row, first = np.unique(fine.rows, return_index=True)  # every vertex by the first brick that has it
    row, first = row[row >= 0], first[row >= 0]
    brick, vertex = np.divmod(first, n**3)
    columns, data = coarse.rows[brick[:, None], inner[vertex]], weights[vertex]
    kept = (columns >= 0) & (data > 0)
    return sparse.csr_matrix(
        (data[kept].astype(np.float32), (np.broadcast_to(row[:, None], kept.shape)[kept], columns[kept])),
        (len(fine.vertices), len(coarse.vertices)),
    )


def pieces(count: int, size: int) -> Iterator[slice]:
    """Slices of at most a size that cover 0 to count."""
    for start in range(0, count, size):
        yield slice(start, min(count, start + size))
