"""The numbers of a sparse field's vertices, asked of any other field and fitted, not learned."""

import numpy as np
import torch
from scipy import sparse

from fusedrf_cli.engine.encodings.bricks import COARSE, SIDE
from fusedrf_cli.engine.fields.base import RadianceField
from fusedrf_cli.engine.kernels.reference import OCTANTS
from fusedrf_cli.engine.kinds.field_sampling import (
    FieldSamplingConfig,
    density_features,
    dilated,
    inverse_softplus,
    seen_colours,
)
from fusedrf_cli.engine.kinds.sparse.bricks import BrickTree
from fusedrf_cli.engine.kinds.sparse.field import SparseField
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice, corner_offsets
from fusedrf_cli.engine.settings import current


def fill(field: SparseField, teacher: RadianceField, sigma: np.ndarray, facing: np.ndarray) -> None:
    """Give the vertices the numbers that show what the teacher does, whose σ there is known (V,), and the
    directions along which they are seen (V, 3), as of `shown`."""
    fine, degree = field.fine, field.shape.sh_degree
    field.rows[:, 0] = torch.from_numpy(density_features(teacher, fine, sigma, field.scale))
    field.settle()
    coefficients, weight = seen_colours(teacher, fine, sigma, facing, degree)
    field.rows[:, 1:] = torch.from_numpy(dilated(fine, coefficients[..., 0], weight)[0])
    if field.coarse:
        bands, band_weight = coarser(
            fine, field.coarse, coefficients[..., 1:].reshape(len(sigma), -1), weight
        )
        field.bands[:] = torch.from_numpy(dilated(field.coarse, bands, band_weight)[0])
    field.settle()


def density_scale(tree: BrickTree) -> float:
    """σ of a feature of 1, about: an optical depth of 1 in a voxel between the widest and the finest."""
    return float(1 / np.sqrt(tree.unit.min() * tree.top.min() / (SIDE << int(tree.level.min()))))


def set_density(field: SparseField, sigma: np.ndarray) -> None:
    """Give the vertices densities (V,), as far as the feature's range goes."""
    config = current(FieldSamplingConfig)
    feature = np.clip(inverse_softplus(sigma / field.scale), config.least, config.most)
    field.rows[:, 0] = torch.from_numpy(feature)
    field.settle()


def coarser(
    fine: VertexLattice, coarse: VertexLattice, values: np.ndarray, weight: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(W, D) values of the coarse vertices whose interpolation comes near to values (V, D) of the fine ones,
    where these have a weight (V,), and their own weights (W,)."""
    matrix = interpolation(fine, coarse)
    weighted = matrix.T @ sparse.diags(weight.astype(np.float32))
    total = np.asarray(weighted.sum(1)).ravel()
    values = values.astype(np.float32)
    share = (1 / np.maximum(total, 1e-12))[:, None].astype(np.float32)
    blended = share * (weighted @ values)
    for _ in range(3):  # corrections
        blended += share * (weighted @ (values - matrix @ blended))
    return blended, total


def interpolation(fine: VertexLattice, coarse: VertexLattice) -> sparse.csr_matrix:
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
    valid = (columns >= 0) & (data > 0)
    return sparse.csr_matrix(
        (data[valid].astype(np.float32), (np.broadcast_to(row[:, None], valid.shape)[valid], columns[valid])),
        (len(fine.vertices), len(coarse.vertices)),
    )
