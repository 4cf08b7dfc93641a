"""A sparse field while it learns from photos: bricks of one level over all of a box, ever finer, without
those voxels in which nothing was found."""

from collections.abc import Callable

import numpy as np
import torch

from fusedrf_cli.engine.encodings.bricks import SIDE
from fusedrf_cli.engine.fields.box import DENSITY_SHIFT
from fusedrf_cli.engine.kernels.reference import OCTANTS
from fusedrf_cli.engine.kinds.sparse.bricks import BrickTree
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice


def whole_lattice(box: np.ndarray, resolution: tuple[int, int, int]) -> VertexLattice:
    """The vertices of a box (6,) in whole bricks of one level, at least as many per axis as asked."""
    counts = -(-(np.asarray(resolution) - 1) // SIDE)
    at = np.argwhere(np.ones(counts, bool))
    mask = np.ones((len(at), SIDE, SIDE, SIDE), bool)
    tree = BrickTree.of(box[:3], (box[3:] - box[:3]) / counts, counts, np.zeros(len(at), np.uint8), at, mask)
    return VertexLattice(tree, SIDE)


def occupied_voxels(
    lattice: VertexLattice, contains: Callable[[np.ndarray], np.ndarray]
) -> VertexLattice | None:
    """The lattice of those active voxels in which some of nine points lie where contains((N, 3)) says so;
    None where there is none."""
    low, high = lattice.positions[lattice.corners[:, 0]], lattice.positions[lattice.corners[:, 7]]
    reached = contains((low + high) / 2)
    inset = 1e-6  # of a voxel, so that no corner is a neighbour's
    for octant in inset + (1 - 2 * inset) * OCTANTS:
        reached |= contains(low + (high - low) * octant)
    return of_voxels(lattice, reached)


def wholly_inside(lattice: VertexLattice, holds: Callable[[np.ndarray], np.ndarray]) -> VertexLattice | None:
    """The lattice of those active voxels of which holds((N, 3)) says that all corners are kept; None where
    there is none."""
    mask = holds(lattice.positions)
    return of_voxels(lattice, mask[lattice.corners].all(1))


def of_voxels(lattice: VertexLattice, chosen: np.ndarray) -> VertexLattice | None:
    """The lattice of some of its active voxels, (N,) bool; None of none."""
    if not chosen.any():
        return None
    tree, mask = lattice.tree, np.zeros(lattice.active.shape, bool)
    mask[lattice.active] = chosen
    has_voxels = mask.any(1)
    mask = mask[has_voxels].reshape(-1, SIDE, SIDE, SIDE)
    return VertexLattice(tree.of_same_box(tree.level[has_voxels], tree.at[has_voxels], mask), SIDE)


def on_grid(lattice: VertexLattice, values: torch.Tensor, missing: torch.Tensor) -> torch.Tensor:
    """(1, D, X, Y, Z) rows (V, D) of a lattice of one level, and the row `missing` (D,) where there is
    none."""
    step = SIDE // lattice.n
    sides = (np.asarray(lattice.tree.counts) * lattice.n + 1).tolist()
    dense = missing.to(values).expand(*sides, -1).clone()
    i, j, k = torch.from_numpy(lattice.vertices // step).T
    dense[i, j, k] = values
    return dense.permute(3, 0, 1, 2)[None]


def interpolated(
    old: VertexLattice, values: torch.Tensor, missing: torch.Tensor, new: VertexLattice
) -> torch.Tensor:
    """(W, D) rows of a new lattice by interpolating those (V, D) of an old one of one level."""
    box = old.tree.aabb
    unit = torch.from_numpy((new.positions - box[:3]) / (box[3:] - box[:3])).to(values)
    at = (2 * unit - 1).flip(1)[None, None, None]  # torch counts axes from the last
    grid = on_grid(old, values, missing)
    return torch.nn.functional.grid_sample(
        grid, at, mode="bilinear", padding_mode="border", align_corners=True
    )[0, :, 0, 0].T.contiguous()


def transferred(field, lattice: VertexLattice):
    """A field over another lattice of one level with what it holds, interpolated."""
    other = type(field)(field.shape, lattice, field.scale, space=field.space)
    here = field.to("cpu")
    missing = torch.zeros(here.rows.shape[1])
    missing[0] = DENSITY_SHIFT
    other.rows[:] = interpolated(here.fine, here.rows, missing, other.fine)
    if other.coarse:
        nothing = torch.zeros(here.bands.shape[1])
        other.bands[:] = interpolated(here.coarse, here.bands, nothing, other.coarse)
    other.settle()
    return other.to(field.params.device)


def check_one_level(field) -> None:
    """ValueError for a field of several levels, which was made for a scene and has no resolution to
    change."""
    if field.resolution is None:
        raise ValueError("a sparse field of several levels has no one resolution")
