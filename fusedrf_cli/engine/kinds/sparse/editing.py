"""Edits of a sparse field that touch no number outside a region: an object put in, a region filled anew."""

from collections.abc import Callable

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.region import MaxOf
from fusedrf_cli.engine.kinds.asking import LEAST, OCTANTS, density
from fusedrf_cli.engine.kinds.sparse.bodies import SIDE
from fusedrf_cli.engine.kinds.sparse.bricks import (
    MAX_LEVEL,
    BrickTree,
    Lattice,
    corner_offsets,
    key_places,
    node_keys,
)
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape
from fusedrf_cli.engine.kinds.sparse.filling import fill, set_density
from fusedrf_cli.engine.kinds.sparse.resample import FAINT, EmptyField, demanded, leaves, shown, thinned

RefillMask = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Which vertices (V,) bool are filled anew, by their places (V, 3), the sides of their voxels (V,), and the σ
(V,) of the field as it was and of what is put there."""


def added(field: SparseField, placed: Placed) -> SparseField:
    """The field with an object put in, placed in its frame: where that is the densest, at the level that it
    needs. Raises ValueError where it would be too large."""
    tree = field.tree.extended(placed.aabb)
    both = MaxOf([Placed("", field, np.eye(4)), placed], field.occupancy)
    level = level_for(placed.voxel_size, tree.top)
    wanted = [np.zeros(0, np.int64)] * (level + 1)
    wanted[level] = demanded(both, placed, level, tree.lo, tree.top, tree.counts)

    def denser(places, side, before, now):
        return (now > before) & (now * side > FAINT)

    return refilled(field, tree, wanted, placed, both, denser, placed.aabb)


def emptied(field: SparseField, region: np.ndarray, rest: list[Placed]) -> SparseField | None:
    """The field whose vertices in a box (6,) show what the rest, placed in its frame, does there; nothing
    where there is no rest. None where nothing is left."""
    inside = MaxOf([p for p in rest if p.reaches(region)], field.occupancy)
    tree, wanted = field.tree, [np.zeros(0, np.int64)] * (MAX_LEVEL + 1)
    for one in inside.placed:
        level = level_for(one.voxel_size, tree.top)
        keys = demanded(inside, one, level, tree.lo, tree.top, tree.counts)
        side = tree.top / 2**level
        low = tree.lo + key_places(keys) * side
        wanted[level] = np.union1d(wanted[level], keys[meets(low, low + side, region)])

    def within(places, side, before, now):
        return ((places >= region[:3]) & (places <= region[3:])).all(1)

    try:
        return refilled(field, tree, wanted, inside, inside, within, region)
    except EmptyField:
        return None


def with_fringe(field: SparseField, box: np.ndarray) -> np.ndarray:
    """(6,) the box grown by the widest voxel around its vertices: one beyond its face, where there is
    nothing, has its share in where a surface on that face lies."""
    inside = meets(field.fine.places, field.fine.places, box)
    return box + np.repeat([-1, 1], 3) * field.fine.finest_voxel[inside].max(initial=0)


def runs_box(field: SparseField, box: np.ndarray) -> np.ndarray:
    """(6,) in the field's frame: the runs of rows that are stored together (`Lattice.stored_order`) of which
    an edit in a box (6,) can change any. Bricks that reach into the box are as wide as a top cell at most."""
    tree, space = field.tree, field.space
    cells = (through(space.contracted, box).reshape(2, 3) - tree.lo) / tree.top
    low, high = np.floor(cells[0]) - 1, np.ceil(cells[1]) + 1
    low, high = low - (low + tree.phase) % 2, high + (high + tree.phase) % 2
    return through(space.placed, np.concatenate([tree.lo + low * tree.top, tree.lo + high * tree.top]))


def through(mapping: Callable[[torch.Tensor], torch.Tensor], box: np.ndarray) -> np.ndarray:
    """(6,) the box of what a space makes of a box. Each coordinate grows with itself, and for the rest
    depends on the largest alone, so it has its extremes where the others have theirs, or are nearest to 0."""
    low, high = box[:3], box[3:]
    ends = np.stack([low, high, np.clip(0, low, high)])
    found = mapping(torch.from_numpy(np.stack(np.meshgrid(*ends.T, indexing="ij"), -1).reshape(-1, 3)))
    return np.concatenate([found.min(0).values.numpy(), found.max(0).values.numpy()])


def meets(low: np.ndarray, high: np.ndarray, box: np.ndarray) -> np.ndarray:
    """(N,) whether boxes of corners low and high (N, 3) and a box (6,) have a point in common."""
    return (low <= box[3:]).all(-1) & (box[:3] <= high).all(-1)


def level_for(voxel: float, top: np.ndarray) -> int:
    """The level whose voxels are nearest to a size."""
    return int(np.clip(np.round(np.log2(top.min() / (SIDE * voxel))), 0, MAX_LEVEL))


def refilled(
    field: SparseField,
    tree: BrickTree,
    wanted: list[np.ndarray],
    source,
    shows,
    takes: RefillMask,
    box: np.ndarray,
) -> SparseField:
    """A field over the field's bricks, in the box of `tree`, and the wanted ones (keys by level), whose
    vertices in a box (6,) that `takes` chooses by the σ of a source show what `shows` does. All others keep
    their bits.
    """
    old = CarriedRows(field.fine, field.rows.numpy(), tree)
    lattice = Lattice(with_bricks(old, wanted, box), SIDE)
    taken, sigma = chosen(field, old, lattice, source, takes, box)
    new = taken[lattice.corners].any(1)
    dense = (sigma * lattice.finest_voxel > FAINT)[lattice.corners].any(1)
    middles = (
        lattice.vertices[lattice.corners[:, 0]] + lattice.vertices[lattice.corners[:, 7]]
    ) << MAX_LEVEL - lattice.tree.depth
    lattice, (taken, sigma) = thinned(lattice, np.where(new, dense, old.covers(middles)), taken, sigma)

    probe = SparseField(SparseShape(0), lattice, field.scale, space=field.space)
    set_density(probe, sigma)
    kept, facing = shown(probe, taken[lattice.corners].any(1))
    lattice, (taken, facing) = thinned(lattice, kept, taken, facing)

    result = SparseField(field.shape, lattice, field.scale, space=field.space)
    rows, _ = old.at(lattice)
    fresh = taken | np.isnan(rows[:, 0])
    local = local_fill(result, shows, fresh, facing)
    rows[fresh] = local.rows.numpy()[local.fine.find(lattice.keys[fresh])[0]]
    result.rows[:] = torch.from_numpy(rows)
    if field.coarse:
        bands, _ = CarriedRows(field.coarse, field.bands.numpy(), tree).at(result.coarse)
        taken, _ = chosen(field, old, result.coarse, source, takes, box)
        at, found = local.coarse.find(result.coarse.keys)
        fresh = (taken | np.isnan(bands[:, 0])) & found
        bands[fresh] = local.bands.numpy()[at[fresh]]
        result.bands[:] = torch.from_numpy(np.nan_to_num(bands))
    result.settle()
    return result


class CarriedRows:
    """The rows of a lattice, wherever they are asked for, in the box of another tree of the same bricks."""

    def __init__(self, lattice: Lattice, rows: np.ndarray, tree: BrickTree):
        self.lattice, self.rows, self.tree = lattice, rows, tree
        shift = np.round((lattice.tree.lo - tree.lo) / tree.top).astype(np.int64) * SIDE << MAX_LEVEL
        self.keys = node_keys((lattice.vertices << MAX_LEVEL - tree.depth) + shift)
        self.order = np.argsort(self.keys)

    def at(self, other: Lattice) -> tuple[np.ndarray, np.ndarray]:
        """Rows (V, D) at another lattice's vertices, NaN where no voxel is active, and which vertices are
        this lattice's own, whose rows are the same bits."""
        found = np.full((len(other.vertices), self.rows.shape[1]), np.nan, np.float32)
        at = np.minimum(np.searchsorted(self.keys, other.keys, sorter=self.order), len(self.keys) - 1)
        own = self.keys[self.order[at]] == other.keys
        found[own] = self.rows[self.order[at[own]]]
        rest = np.flatnonzero(~own)
        places, n = other.vertices[rest] << MAX_LEVEL - other.tree.depth, self.lattice.n
        for octant in OCTANTS:
            brick, voxel, active = self.tree.voxels_at(
                2 * places + 2 * octant - 1, n, self.lattice.active, MAX_LEVEL
            )
            active &= np.isnan(found[rest, 0])
            brick, voxel = brick[active], voxel[active]
            i, j, k = voxel // n**2, voxel // n % n, voxel % n
            width = (SIDE // n << MAX_LEVEL - self.tree.level[brick].astype(np.int64))[:, None]
            share = places[active] / width - (self.tree.at[brick] * n + np.stack([i, j, k], 1))
            weights = np.where(OCTANTS == 1, share[:, None], 1 - share[:, None]).prod(2)
            first = (i * (n + 1) + j) * (n + 1) + k
            corners = self.lattice.rows[brick[:, None], first[:, None] + corner_offsets(n)]
            found[rest[active]] = np.einsum("kq,kqd->kd", weights, self.rows[corners])
        return found, own

    def covers(self, halves: np.ndarray) -> np.ndarray:
        """(K,) whether points (K, 3), in halves of units of MAX_LEVEL, lie in an active voxel."""
        return self.tree.voxels_at(halves, self.lattice.n, self.lattice.active, MAX_LEVEL)[2]


def with_bricks(old: CarriedRows, wanted: list[np.ndarray], box: np.ndarray) -> BrickTree:
    """The tree of the old bricks and the wanted ones, with all voxels active in those that reach into a
    box."""
    tree = old.tree
    keys = []
    for level in range(max(len(wanted), tree.depth + 1)):
        own = node_keys(tree.at[tree.level == level])
        keys.append(np.union1d(own, wanted[level]) if level < len(wanted) else own)
    level, at = leaves(keys)
    side = tree.top / 2.0 ** level[:, None]
    low = tree.lo + at * side
    width = SIDE << MAX_LEVEL - level.astype(np.int64)[:, None, None]
    voxels = np.argwhere(np.ones((SIDE,) * 3, bool))
    halves = (at[:, None] * width + voxels * (width // SIDE)) * 2 + width // SIDE
    mask = old.covers(halves.reshape(-1, 3)).reshape(len(at), SIDE, SIDE, SIDE)
    mask |= meets(low, low + side, box)[:, None, None, None]
    held = mask.any((1, 2, 3))
    return tree.of_same_box(level[held], at[held], mask[held])


def chosen(
    field: SparseField, old: CarriedRows, lattice: Lattice, source, takes: RefillMask, box: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Which vertices of a lattice (V,) are filled anew, and the σ (V,) that is to be there, taken or
    carried."""
    rows, places, side = old.at(lattice)[0], lattice.places, lattice.finest_voxel
    feature = np.nan_to_num(rows[:, 0].astype(float), nan=LEAST)
    before = np.where(feature > LEAST, field.scale * np.logaddexp(0, feature), 0)
    near = meets(places, places, box)
    now = np.zeros(len(places))
    now[near] = density(source, places[near], field.space)
    taken = near & takes(places, side, before, now)
    return taken, np.where(taken, now, before)


def local_fill(field: SparseField, shows, fresh: np.ndarray, facing: np.ndarray) -> SparseField:
    """The bricks of a field that have a fresh vertex (V,), as a field of their own that shows what `shows`
    does."""
    tree = field.tree
    rows = field.fine.rows
    own = (fresh[rows] & (rows >= 0)).any(1)
    if not own.any():
        own[:1] = True
    part = tree.of_same_box(tree.level[own], tree.at[own], tree.mask[own])
    local = SparseField(field.shape, Lattice(part, SIDE), field.scale, space=field.space)
    at = field.fine.find(local.fine.keys)[0]
    fill(local, shows, density(shows, local.fine.places), facing[at])
    return local
