"""Analytic fields as every stored field kind: the same truth in each.

`exported` looks a kind up in EXPORTERS; a kind that is registered in the engine and missing here is reported
by `NotExportable`, which tests turn into a skip with that reason.
"""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from fusedrf_cli.engine.encodings.bricks import SIDE
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.builder import StorageSetting
from fusedrf_cli.engine.kinds.sparse.bricks import BrickTree
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape
from fusedrf_cli.engine.kinds.vm_mlp.field import FEATURE_DEGREE, VMMLPField, VMMLPShape, weight_shapes
from tests.analytic.fields import NOISE_NODES, SHIFT, AnalyticField, Tint

SHAPE = VMShape(16, 8, 1)  # float32 kernels of it are compiled for the engine's tests too
BANDED = VMShape(16, 8, 2)  # for tints of degree 2
Y0, Y1 = 0.28209479177387814, 0.4886025119029199  # constants of the first two SH bands
CELLS = 4  # of the occupancy, per axis


def way_of(shape: VMShape) -> StorageSetting:
    """The way in which a student has a shape."""
    return StorageSetting(ranks=(shape.density_rank, shape.colour_rank), sh_degree=shape.sh_degree)


class NotExportable(ValueError):
    """The field cannot be told in that kind, or nobody has written how."""


def exported(
    field: AnalyticField, kind: str, resolution: tuple[int, int, int] = (NOISE_NODES,) * 3, **options
):
    """The analytic field as a stored one of a registered kind; "analytic" is the field itself.

    `options` go to the kind's own exporter below.
    """
    if kind == "analytic":
        return field
    if kind not in EXPORTERS:
        raise NotExportable(f"nothing exports analytic fields to '{kind}' yet (tests/analytic/export.py)")
    return EXPORTERS[kind](field, resolution, **options)


def vm_field(
    field: AnalyticField,
    resolution: tuple[int, int, int] = (NOISE_NODES,) * 3,
    shape: VMShape | None = None,
    dtype: torch.dtype = torch.float32,
    cells: int = CELLS,
) -> VMField:
    """A VM field over the box of the field's matter.

    Exact at the texels, and between them wherever the functions of `activation` and the tint are linear; hard
    faces are those of its box.
    """
    tint = field.tint or Tint()
    shape = shape or (BANDED if tint.bands.shape[1] else SHAPE)
    vm = bare_field(field, resolution, shape, dtype, cells)
    write_colour_products(vm, texels(vm))
    basis = vm.basis
    level = np.concatenate(
        [
            np.asarray(tint.level)[:, None] / Y0,
            tint.facing[:, [1, 2, 0]] / (np.array([-1, 1, -1]) * Y1),  # bands of degree 1 are -y, z, -x
            tint.bands,
        ],
        1,
    )
    if level[:, shape.coefficients :].any():
        raise NotExportable(f"this tint needs more than SH degree {shape.sh_degree}")
    basis[:, : level.shape[1], 0] = torch.from_numpy(level[:, : shape.coefficients]).to(dtype)
    basis[:, 0, 1:4] = torch.from_numpy(tint.slope / Y0).to(dtype)
    return vm


def vm_mlp_field(
    field: AnalyticField, resolution: tuple[int, int, int] = (NOISE_NODES,) * 3, cells: int = CELLS
) -> VMMLPField:
    """A vm-mlp field whose network computes an affine tint exactly: ReLU(z) - ReLU(-z) = z, twice."""
    tint = field.tint or Tint()
    if tint.bands.any():
        raise NotExportable("the small network of 'vm-mlp' holds no tint of degree 2 or more exactly")
    shape = replace(SHAPE, sh_degree=FEATURE_DEGREE)
    vm = bare_field(field, resolution, shape, torch.float32, cells)
    write_colour_products(vm, texels(vm))
    features = 3 * shape.coefficients
    vm.basis.view(features, -1)[:4, :4] = torch.eye(4)
    weights = {name: torch.zeros(size) for name, size in weight_shapes(features, 8).items()}
    first = np.concatenate([np.asarray(tint.level)[:, None], tint.slope], 1)
    into = weights["0.weight"]
    into[:3, :4], into[:3, features : features + 3] = map(torch.from_numpy, (first, tint.facing))
    into[3:6] = -into[:3]
    weights["1.weight"][:6, :6] = torch.eye(6)
    weights["2.weight"][:, :6] = torch.cat([torch.eye(3), -torch.eye(3)], 1)
    return with_network(vm, weights)


def with_network(vm: VMField, weights: dict[str, torch.Tensor]) -> VMMLPField:
    """A vm-mlp field of the factors and the basis of a vm field, and of a network."""
    ranks = vm.shape.density_rank, vm.shape.colour_rank
    shape = VMMLPShape(*ranks, vm.shape.sh_degree, len(weights["0.bias"]))
    field = VMMLPField(shape, vm.box, vm.resolution, vm.scale, vm.shift, occupancy=vm.occupancy)
    field.params = field.params.to(vm.params.dtype)
    for name, view in vm.sections().items():
        if name != "colour_basis":
            field.sections()[name].copy_(view)
    field.basis.copy_(vm.basis.flatten(0, 1))
    for name, view in field.weights.items():
        view.copy_(weights[name])
    return field


def sparse_field(field: AnalyticField, resolution: tuple[int, int, int] = (NOISE_NODES,) * 3) -> SparseField:
    """A sparse field of one level over the box of the field's matter, `resolution` vertices along each axis:
    as exact as the `vm` field is."""
    told, tint = field.activation, field.tint or Tint()
    if told is None:
        raise NotExportable(f"the density of {type(field).__name__} is no sum of products of axes")
    box, voxels = field.matter, np.asarray(resolution) - 1
    counts = -(-voxels // SIDE)
    at = np.argwhere(np.ones(counts, bool))
    inner = np.argwhere(np.ones((SIDE,) * 3, bool))
    mask = ((at[:, None] * SIDE + inner) < voxels).all(2).reshape(-1, SIDE, SIDE, SIDE)
    top = (box[3:] - box[:3]) / voxels * SIDE
    tree = BrickTree.of(box[:3], top, counts, np.zeros(len(at), np.uint8), at, mask)
    degree = {0: 1, 5: 2, 12: 3}[tint.bands.shape[1]]
    sparse = SparseField(SparseShape(degree), VertexLattice(tree, SIDE), told.scale)
    x, y, z = sparse.fine.positions.T
    sparse.rows[:, 0] = torch.from_numpy(SHIFT + sum((a(x) * b(y) * c(z) for a, b, c in told.terms), 0 * x))
    level = np.asarray(tint.level) + sparse.fine.positions @ tint.slope.T
    sparse.rows[:, 1:] = torch.from_numpy(level / Y0)
    bands = np.concatenate([tint.facing[:, [1, 2, 0]] / (np.array([-1, 1, -1]) * Y1), tint.bands], 1)
    sparse.bands[:] = torch.from_numpy(bands.ravel())
    return sparse


def bare_field(
    field: AnalyticField, resolution: tuple[int, int, int], shape: VMShape, dtype: torch.dtype, cells: int
) -> VMField:
    """The density alone: every term in one component of mode 0, a(x) b(y) in its plane and c(z) in its
    line."""
    told = field.activation
    if told is None:
        raise NotExportable(f"the density of {type(field).__name__} is no sum of products of axes")
    box = field.matter
    grid = OccupancyGrid(box, np.ones((cells,) * 3, bool))
    params = torch.zeros(VMField.size_of(shape, resolution), dtype=dtype)
    vm = VMField(shape, box, resolution, told.scale, SHIFT, params, grid)
    x, y, z = texels(vm)
    sections = vm.sections()
    for i, (a, b, c) in enumerate(told.terms):
        sections["density_plane_0"][..., i] = torch.from_numpy(np.outer(a(x), b(y))).to(dtype)
        sections["density_line_0"][:, i] = torch.from_numpy(c(z)).to(dtype)
    return vm


def texels(field: VMField) -> list[np.ndarray]:
    """Coordinates of the texels on each axis."""
    return [np.linspace(field.box[a], field.box[a + 3], field.resolution[a]) for a in range(3)]


def write_colour_products(field: VMField, axes: list[np.ndarray]) -> None:
    """Make the first four colour products 1, x, y and z."""
    x, y, z = axes
    plane, line = field.sections()["colour_plane_0"], field.sections()["colour_line_0"]
    for i, values in enumerate((np.outer(x**0, y**0), np.outer(x, y**0), np.outer(x**0, y))):
        plane[..., i] = torch.from_numpy(values).to(plane.dtype)
        line[:, i] = 1
    plane[..., 3] = 1
    line[:, 3] = torch.from_numpy(z).to(line.dtype)


EXPORTERS: dict[str, Callable] = {"vm": vm_field, "vm-mlp": vm_mlp_field, "sparse": sparse_field}
