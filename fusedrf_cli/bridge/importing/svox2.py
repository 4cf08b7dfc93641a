"""Plenoxels' files (Fridovich-Keil et al., CVPR 2022; github.com/sxyu/svox2): a SparseGrid's .npz."""

import numpy as np

from formats.errors import FormatError, LimitExceeded
from fusedrf_cli.bridge.importing.parts import Entries, Imported, ImportedNode, parts_field
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsShape

MAX_VERTICES = 1 << 28


def read(checkpoint) -> Imported:
    """The field of a file. Raises FormatError."""
    entries = Entries(checkpoint.entries)
    links = entries.get("links")
    links = np.asarray(links.array() if hasattr(links, "array") else links)
    if links.ndim != 3 or links.dtype.kind != "i" or min(links.shape) < 1:
        raise FormatError(
            f"'links' should be whole numbers on a grid, found {links.dtype} {list(links.shape)}"
        )
    density, sh = numbers_of(entries)
    coefficients = sh.shape[1] // 3
    if links.max(initial=-1) >= len(density):
        raise FormatError(f"'links' should lead to one of {len(density)} rows, found {links.max()}")
    if np.prod(np.array(links.shape) + 2, dtype=float) > MAX_VERTICES:
        raise LimitExceeded(
            f"'links' has {list(links.shape)} voxels, more than {MAX_VERTICES:,} are not read"
        )
    shape = PartsShape(
        {"part": "grid", "numbers": 1}, {"part": "grid", "numbers": 3 * coefficients},
        {"part": "density_sum", "activation": "relu"}, {"part": "sh", "coefficients": coefficients}, "relu",
    )  # fmt: skip
    middle, radius = (
        np.broadcast_to(entries.array(name).astype(np.float64), 3) if name in entries.values else default
        for name, default in (("center", np.zeros(3)), ("radius", np.ones(3)))
    )
    if not (radius > 0).all():
        raise FormatError("'radius' should be above 0")
    box, voxel = np.concatenate([middle - radius, middle + radius]), 2 * radius / links.shape
    # Numbers stand for middles of voxels, and stay the same in the outer half of the last ones: with a vertex
    # more on each side all lie on faces of a box.
    around = box + np.concatenate([-voxel, voxel]) / 2
    values = {"density_": spread(links, density[:, 0]), "colour_": spread(links, sh)}
    resolution = np.array(links.shape) + 2
    field = parts_field(shape, around, resolution, values, occupancy=OccupancyGrid(box, reached(links >= 0)))
    return Imported([ImportedNode(field)])


def numbers_of(entries: Entries) -> tuple[np.ndarray, np.ndarray]:
    """Density (M, 1) and coefficients (M, 3 K) of the rows."""
    if "data" in entries.values:  # of the first version
        data = entries.array("data", None, None)
        density, sh = data[:, :1], data[:, 1:]
    else:
        density = entries.array("density_data", None, 1)
        sh = entries.array("sh_data", len(density), None)
    basis = entries.whole("basis_type", 0, 255, 1)
    if basis != 1:
        raise FormatError(f"'basis_type' should be 1, spherical harmonics, found {basis}")
    if sh.shape[1] not in (3, 12, 27, 48):
        raise FormatError(f"'sh_data' should have 3, 12, 27 or 48 numbers a row, found {sh.shape[1]}")
    return density, sh


def spread(links: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Rows (M, ..) at the vertices (X + 2, Y + 2, Z + 2, ..) of a grid; 0 where there are none."""
    at, count = np.nonzero(links >= 0), np.array(links.shape) + 2
    values = np.zeros((*count, *rows.shape[1:]), np.float32)
    values[tuple(index + 1 for index in at)] = rows[links[at]]
    for axis in range(3):
        moved = np.moveaxis(values, axis, 0)
        moved[0], moved[-1] = moved[1], moved[-2]
    return values


def reached(held: np.ndarray) -> np.ndarray:
    """(X, Y, Z) which voxels have numbers, or a neighbour that has."""
    for axis in range(3):
        wide = np.pad(held, [(int(a == axis),) * 2 for a in range(3)])
        n = held.shape[axis]
        held = wide.take(range(n), axis) | wide.take(range(1, n + 1), axis) | wide.take(range(2, n + 2), axis)
    return held
