"""Edits of a sparse field that touch no number outside a region: an object put in, a region filled anew."""

from collections.abc import Callable

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.resample import (
    FAINT,
    SEEING_RAYS,
    demanded,
    density,
)
from fusedrf_cli.engine.distillation.teacher import random_rays
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.fields.bricks import MAX_LEVEL, BrickTree, Lattice, key_places
from fusedrf_cli.engine.fields.sparse import SparseField
from fusedrf_cli.engine.kernels.sparse_bodies import SIDE

Takes = Callable[[np.ndarray, np.ndarray, np.ndarray, np.ndarray], np.ndarray]
"""Which vertices (V,) bool are filled anew, by their places (V, 3), the sides of their voxels (V,), and the σ (V,) of
the field as it was and of the teacher."""


def added(field: SparseField, placed: list[Placed]) -> SparseField:
    """The field with objects put in, placed in its frame: where one is the densest, at the level it needs. Raises
    ValueError where that would be too large."""
    for one in placed:
        tree = field.tree.extended(one.aabb)
        level = level_for(one.voxel_size, tree.top)
        alone = demanded(one, one, level, tree.lo, tree.top, tree.counts)
        wanted = [np.zeros(0, np.int64)] * level + [alone]

        def denser(places, side, before, now):
            return (now >= before) & (now * side > FAINT)

        field = refilled(field, tree, wanted, one, denser, one.aabb)
    return field


def emptied(field: SparseField, region: np.ndarray, rest: list[Placed]) -> SparseField:
    """The field whose vertices in a box (6,) say what the rest, placed in its frame, says there, and nothing where
    there is no rest."""
    tree, finest = field.tree, [np.zeros(0, np.int64)]
    inside = [p for p in rest if overlapping(p.aabb, region)]
    for one in inside:
        level = level_for(one.voxel_size, tree.top)
        keys = demanded(Several(inside), one, level, tree.lo, tree.top, tree.counts)
        side = tree.top / 2**level
        low = tree.lo + key_places(keys) * side
        within = ((low < region[3:]) & (low + side > region[:3])).all(1)
        finest += [np.zeros(0, np.int64)] * (level + 1 - len(finest))
        finest[level] = np.union1d(finest[level], keys[within])

    def within_region(places, side, before, now):
        return ((places >= region[:3]) & (places <= region[3:])).all(1)

    return refilled(field, tree, finest, Several(inside), within_region, region)


class Several:
    """Placed fields as one that says what the densest of them says; of none, that there is nothing."""

    def __init__(self, placed: list[Placed]):
        self.placed = placed

    def query(self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True):
        """σ (N,) and rgb (N, 3) at points (N, 3) along unit dirs (N, 3)."""
        sigma, rgb = torch.zeros(len(points)), torch.zeros(len(points), 3)
        for one in self.placed:
            x, d, stretch = one.to_object(points, dirs)
            found, colour = one.field.query(x, d, with_colour)
            found = (found.double() * stretch).float()
            won = found > sigma
            sigma[won], rgb[won] = found[won], colour[won].float()
        return sigma, rgb


def overlapping(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two boxes (6,) meet."""
    return bool((a[:3] <= b[3:]).all() and (b[:3] <= a[3:]).all())


def level_for(voxel: float, top: float) -> int:
    """The level whose voxels are nearest to a size."""
    return int(np.clip(np.round(np.log2(top / (SIDE * voxel))), 0, MAX_LEVEL))


def refilled(
    field: SparseField,
    tree: BrickTree,
    wanted: list[np.ndarray],
    teacher: RadianceField | Placed,
    takes: Takes,
    box: np.ndarray,
) -> SparseField:
    """A field over `tree` (the field's own, maybe in a larger box) and the wanted bricks (keys by level), whose
    vertices that `takes` chooses in the bricks at `box` say what the teacher says; all others keep their bits.
    """
    before = Carried(field, tree)
    whole, touched = with_bricks(tree, wanted, box)
    lattice = Lattice(whole, SIDE)
    rows = before.fine(lattice)
    side = lattice.finest_voxel
    own = np.where(np.isnan(rows[:, 0]), 0, field.scale * np.logaddexp(0, np.nan_to_num(rows[:, 0])))
    asked = np.zeros(len(side), bool)
    asked[lattice.rows[touched][lattice.rows[touched] >= 0]] = True
    now = np.zeros(len(side))
    now[asked] = density(teacher, lattice.places[asked])
    taken = asked & takes(lattice.places, side, own, now)
    sigma = np.where(taken, now, own)
    new = taken[lattice.corners].any(1)
    dense = (sigma * side > FAINT)[lattice.corners].any(1)
    held = before.active(whole)[lattice.active]
    mask = np.zeros(lattice.active.shape, bool)
    mask[lattice.active] = np.where(new, dense, held)
    rays = random_rays([box], SEEING_RAYS // 4, torch.Generator().manual_seed(0))

    built = over_mask(field, whole, mask)
    set_rows(built, lattice, sigma, rows, taken)
    weight, _ = built.seen(*rays)
    ...
