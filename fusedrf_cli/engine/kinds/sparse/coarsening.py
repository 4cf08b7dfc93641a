"""A sparse field made smaller: with wider voxels, and fewer degrees of the colour."""

import numpy as np
import torch

from fusedrf_cli.engine.kinds.builder import Contents, Section
from fusedrf_cli.engine.kinds.field_sampling import density_features, dilated
from fusedrf_cli.engine.kinds.reduction import Reduction
from fusedrf_cli.engine.kinds.sparse.bricks import MAX_LEVEL, node_keys
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice
from fusedrf_cli.engine.kinds.sparse.vertex_fit import density_scale
from fusedrf_cli.engine.spaces import bounded


def reduced(outline: SparseField, voxel: float, degree: int) -> Reduction:
    """The field with voxels no finer than `voxel`, in the field's coordinates, as powers of two allow, and an
    SH degree of at most so much; outline: it, or it without its numbers."""
    shape = SparseShape(min(outline.shape.sh_degree, degree))
    halvings = halvings_to(outline, voxel)
    lattice = outline.fine.coarser(halvings)

    def make(field: SparseField) -> SparseField:
        made = truncated(field, shape)
        return coarsened(made, halvings) if halvings else made

    return Reduction(contents_of(lattice, shape), make, not halvings and shape == outline.shape)


def halvings_to(field: SparseField, voxel: float) -> int:
    """How often the finest voxels are made twice as wide until they are as wide as `voxel`, or as a quarter
    of the box; in a space without end, as those of its top cells."""
    tree = field.tree
    most = tree.depth + (int(np.log2(max(tree.counts))) if field.lies_in is bounded else 0)
    wanted = np.ceil(np.log2(max(voxel / tree.unit.min(), 1.0)) - 1e-6)
    return int(min(wanted, most))


def coarsened(field: SparseField, halvings: int) -> SparseField:
    """The field with its finest voxels 2^halvings times as wide: the numbers of those vertices that it
    keeps, and densities that come nearest to its own between them."""
    new = field.fine.coarser(halvings)
    other = SparseField(field.shape, new, density_scale(new.tree), space=field.lies_in)
    rows, held = stored_rows(field.fine, new, field.rows, halvings)
    sigma = np.where(held, field.scale * np.logaddexp(0, rows[:, 0]), 0)
    # a vertex with a colour of its own counts for little beside one that shows something
    weight = np.where(held, np.maximum(-np.expm1(-sigma * new.finest_voxel), 1e-3), 0)
    other.rows[:, 0] = torch.from_numpy(density_features(field, new, sigma, other.scale))
    other.rows[:, 1:] = torch.from_numpy(dilated(new, rows[:, 1:], weight)[0])
    if other.coarse:
        bands, held = stored_rows(field.coarse, other.coarse, field.bands, halvings)
        other.bands[:] = torch.from_numpy(dilated(other.coarse, bands, held)[0])
    other.settle()
    return other


def stored_rows(
    old: VertexLattice, new: VertexLattice, rows: torch.Tensor, halvings: int
) -> tuple[np.ndarray, np.ndarray]:
    """(W, R) rows (V, R) of a lattice at the vertices of a coarser one, and which of these (W,) it has."""
    row, held = old.find(node_keys(new.vertices << (halvings + MAX_LEVEL - old.tree.depth)))
    return rows.numpy()[row], held


def truncated(field: SparseField, shape: SparseShape) -> SparseField:
    """The field with no higher degrees of the colour than a shape has; itself where it has none."""
    if shape == field.shape:
        return field
    other = SparseField(shape, field.fine, field.scale, space=field.lies_in)
    other.rows[:] = field.rows
    if other.coarse:
        count = len(field.bands)
        bands = field.bands.reshape(count, 3, -1)[..., : shape.coefficients - 1]
        other.bands[:] = bands.reshape(count, -1).to(torch.float32)
    other.settle()
    return other


def contents_of(lattice: VertexLattice, shape: SparseShape) -> Contents:
    """What a field over a lattice is stored with: a run adds a block of scales per column, and its length."""
    held = [("rows", lattice, 4)]
    held += [("bands", lattice.wider, shape.band_numbers)] if shape.sh_degree else []
    runs = sum(len(one.stored_order[1]) * (2 * columns + 4) for _, one, columns in held)
    nodes, masks = lattice.tree.packed()
    sections = [Section(name, (one.free, columns)) for name, one, columns in held]
    return Contents(sections, 8 * (len(nodes) + len(masks) + runs))
