"""Plenoxels' files (Fridovich-Keil et al., CVPR 2022; github.com/sxyu/svox2): a SparseGrid's .npz."""

import itertools
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from formats.errors import FormatError, LimitExceeded
from formats.views import Capture
from fusedrf_cli.bridge.importing.parts import (
    Entries,
    Imported,
    ImportedNode,
    check_layers,
    packed_layers,
    parts_field,
)
from fusedrf_cli.engine.encodings.sparse_grid import tables_of
from fusedrf_cli.engine.fields.box import MAX_TEXELS
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsShape
from fusedrf_cli.engine.spaces import contracted_l2, space_of

MAX_VOXELS = 1 << 30
MAX_ROWS = 1 << 24
MOST_CELLS = 256
"""Along an axis."""
SH, TEXTURE, NETWORK = 1, 4, 255
"""Of `basis_type`."""
NDC = "it seems to be learnt in NDC of its cameras, whose lenses it does not tell: it lies as it is there"
BLENDER_SCALE = 2 / 3
"""What svox2 multiplies the positions of a Blender capture's cameras by, unless told otherwise."""
MLP = "pt__basis_mlp__"
"""In front of the names of its layers."""


def read(checkpoint, capture: Capture | None = None) -> Imported:
    """The fields of a file: a grid, and the background around it, if any; where its run's settings or the
    capture it was learnt from tell, as large as that. Raises FormatError."""
    entries = Entries(checkpoint.entries)
    middle, radius = triple_of(entries, "center", 0.0), triple_of(entries, "radius", 1.0)
    if not (radius > 0).all():
        raise FormatError("'radius' should be above 0")
    nodes = [grid_of(entries, middle, radius)]
    if background := background_of(entries, middle, radius):
        nodes = [replace(nodes[0], suffix=" grid"), background]
    settings = checkpoint.beside.get("args.json", {})
    kind = settings.get("dataset_type", "auto")
    # of LLFF's captures its own loader makes such a box, and nothing else does
    forward = not middle.any() and radius[2] == 1 and (radius[:2] > 1).all()
    if kind == "llff" or kind == "auto" and bool(forward):
        return Imported(nodes, [NDC], rule="add")
    scale, note = camera_scale(settings, capture)
    grown = np.diag([1 / scale] * 3 + [1.0])
    nodes = [replace(node, object_to_world=grown @ node.object_to_world) for node in nodes]
    return Imported(nodes, [note], rule="add")


def camera_scale(settings: Mapping[str, Any], capture: Capture | None) -> tuple[float, str]:
    """By how much svox2 scaled the positions of a capture's cameras, as far as its run's args.json or the
    capture tells, and what is to be said of it. Raises FormatError."""
    kind = settings.get("dataset_type", "auto")
    if kind == "nerf" or kind == "auto" and capture is not None and capture.kind == "blender":
        stated = settings.get("scene_scale")
        scale = BLENDER_SCALE if stated is None else Entries(settings, "args.json: ").number("scene_scale")
        if not 1e-6 < scale < 1e6:
            raise FormatError(f"args.json: 'scene_scale' should be above 0, found {scale:g}")
        return scale, f"it lies where its capture does: its cameras, scaled by {scale:.4g}, are scaled back"
    if kind == "auto" and capture is None:
        return 1.0, (
            "it lies where svox2 put its cameras, whose positions it scales, those of a Blender capture by "
            "2/3; --cameras CAPTURE undoes that"
        )
    return 1.0, (
        "it lies where svox2 put its cameras, which it moves and scales unless they are a Blender capture's; "
        "how is told nowhere, and the capture's own cameras may not fit"
    )


def triple_of(entries: Entries, name: str, usual: float) -> np.ndarray:
    """A number for each axis (3,), which may be the same for all."""
    value = entries.array(name) if name in entries.values else np.float64(usual)
    if value.size not in (1, 3):
        raise FormatError(f"'{name}' should be three numbers, found {value.size}")
    return np.resize(value.astype(np.float64), 3)


def links_of(entries: Entries, name: str, dimensions: int, most: int) -> np.ndarray:
    """Numbers of rows on a grid; below 0: none."""
    links = entries.get(name)
    found = getattr(links, "shape", ()), str(getattr(links, "dtype", type(links).__name__))
    if len(found[0]) != dimensions or not found[1].startswith("int") or min(found[0]) < 1:
        raise FormatError(f"'{name}' should be whole numbers on a grid, found {found[1]} {list(found[0])}")
    if np.prod(found[0], dtype=float) > most or max(found[0]) > MAX_TEXELS - 2:
        raise LimitExceeded(f"'{name}' is of {list(found[0])}, larger grids than {most:,} are not read")
    return np.asarray(links.array() if hasattr(links, "array") else links)


def check_links(links: np.ndarray, count: int, name: str) -> None:
    """Raise FormatError unless links lead to some of so many rows."""
    if count == 0 or links.max(initial=-1) >= count:
        raise FormatError(f"{name} should be more than the last link, {links.max(initial=-1)}, found {count}")


def check_count(count: int, name: str) -> None:
    """Raise LimitExceeded unless so many rows are read."""
    if count > MAX_ROWS:
        raise LimitExceeded(f"{name} are {count:,}, more than {MAX_ROWS:,} are not read")


# -- the grid ------------------------------------------------------------------------------------------------


def grid_of(entries: Entries, middle: np.ndarray, radius: np.ndarray) -> ImportedNode:
    """What lies in the box."""
    links = links_of(entries, "links", 3, MAX_VOXELS)
    voxels, resolution = np.nonzero(links >= 0), tuple(n + 2 for n in links.shape)
    rows, counts = links[voxels], np.array(links.shape)
    del links
    density, colour = numbers_of(entries)
    check_links(rows, len(density), "rows of numbers")
    if len(density) > MAX_ROWS:
        voxels, rows, kept = shown_of(voxels, rows, density, counts)
        density, colour = density[kept], colour[kept]
    check_count(len(density), "rows of numbers")
    rgb, basis = basis_of(entries, colour.shape[1])
    box, voxel = np.concatenate([middle - radius, middle + radius]), 2 * radius / counts
    # Numbers stand for middles of voxels, and stay the same in the outer half of the last ones: with a vertex
    # more on each side all lie on faces of a box.
    around = box + np.concatenate([-voxel, voxel]) / 2
    occupancy = OccupancyGrid(box, cells_around(voxels, density[rows, 0] > 0, counts))
    tables = tables_of(resolution, *with_borders(voxels, rows, counts))
    shape = PartsShape(
        {"part": "sparse_grid", "rows": len(density), "blocks": len(tables["vertices"])},
        {"part": "sparse_rows", "numbers": colour.shape[1]},
        {"part": "density_sum", "activation": "relu"}, rgb, "relu",
    )  # fmt: skip
    values = {f"density_{name}": table for name, table in tables.items()}
    values |= {"density_values": density, "colour_values": colour, **basis}
    return ImportedNode(parts_field(shape, around, resolution, values, occupancy=occupancy))


def shown_of(
    voxels: tuple[np.ndarray, ...], rows: np.ndarray, density: np.ndarray, counts: np.ndarray
) -> tuple[tuple[np.ndarray, ...], np.ndarray, np.ndarray]:
    """Of voxels (three (V,)) and their rows (V,) those that have a density or are next to one that has: no
    others change anything. And which rows these are of all, by which they are numbered anew."""
    near = np.zeros(counts, bool)
    near[voxels] = density[rows, 0] > 0
    for axis in range(3):
        before = np.moveaxis(near, axis, 0).copy()
        after = np.moveaxis(near, axis, 0)
        after[1:] |= before[:-1]
        after[:-1] |= before[1:]
    held = near[voxels]
    held[:1] |= not held.any()  # a table has a row
    kept, rows = np.unique(rows[held], return_inverse=True)
    return tuple(at[held] for at in voxels), rows, kept


def numbers_of(entries: Entries) -> tuple[np.ndarray, np.ndarray]:
    """Density (M, 1) and the colours' numbers (M, 3 K), channel by channel, of the rows."""
    if "data" in entries.values:  # of the first version
        data = entries.array("data", None, None)
        return data[:, :1], data[:, 1:]
    density = entries.array("density_data", None, 1)
    return density, entries.array("sh_data", len(density), None)


def basis_of(entries: Entries, columns: int) -> tuple[dict, dict[str, np.ndarray]]:
    """What makes colours of so many numbers a row: the entry of a shape, and sections."""
    kind = entries.whole("basis_type", 0, 255, SH)
    if "basis_data" in entries.values and kind == SH:  # of before types were stored
        kind = TEXTURE
    if kind == SH:
        if columns not in (3, 12, 27, 48):
            raise FormatError(f"'sh_data' should have 3, 12, 27 or 48 numbers a row, found {columns}")
        return {"part": "sh", "coefficients": columns // 3}, {}
    if columns < 3 or columns % 3:
        raise FormatError(f"'sh_data' should have as many numbers for each channel, found {columns}")
    if kind == TEXTURE:
        texture = entries.array("basis_data", None, None, None, columns // 3)
        side = len(texture)
        if texture.shape[:3] != (side,) * 3 or side < 2:
            raise FormatError(f"'basis_data' should be a cube, found {list(texture.shape)}")
        return {"part": "direction_texture", "own": columns // 3, "side": side}, {"rgb_texture": texture}
    if kind != NETWORK:
        raise FormatError(f"'basis_type' should be {SH}, {TEXTURE} or {NETWORK}, found {kind}")
    return network_of(entries, columns // 3)


def network_of(entries: Entries, count: int) -> tuple[dict, dict[str, np.ndarray]]:
    """The same, of a network that makes a basis of so many numbers."""
    named = {
        name[len(MLP) :].replace("__", "."): v for name, v in entries.values.items() if name.startswith(MLP)
    }
    layers = Entries(named, f"{MLP}: ").layers("")
    frequencies = max(layers[0][0].shape[1] - 3, 0) // 6
    hidden = check_layers(layers, 3 + 6 * frequencies, count)
    inputs = 3 + 6 * frequencies
    sections = packed_layers("rgb", layers, np.arange(inputs), inputs, hidden)
    return {
        "part": "direction_basis", "hidden": hidden, "layers": len(layers) - 1, "own": count,
        "frequencies": frequencies, "squashed": True,
    }, sections  # fmt: skip


def with_borders(
    voxels: tuple[np.ndarray, ...], rows: np.ndarray, counts: np.ndarray
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """The vertices (three (V,)) that have rows (V,): middles of voxels, and beyond the first and the last of
    an axis another with the same row."""
    at = np.stack(voxels) + 1
    for axis, count in enumerate(counts):
        for inner, outer in ((1, 0), (count, count + 1)):
            beside = np.flatnonzero(at[axis] == inner)
            more = at[:, beside]
            more[axis] = outer
            at, rows = np.concatenate([at, more], 1), np.concatenate([rows, rows[beside]])
    return tuple(at), rows


def cells_around(voxels: tuple[np.ndarray, ...], dense: np.ndarray, counts: np.ndarray) -> np.ndarray:
    """(X, Y, Z) bool: of cells as fine as voxels, or MOST_CELLS along an axis, those that are less than a
    voxel away from the middle of one (three (V,)) with density (V,)."""
    cells = np.minimum(counts, MOST_CELLS)
    per = cells / counts
    low, high = [], []
    for i, count, each in zip(voxels, cells, per, strict=True):
        i = i[dense]
        low.append(np.maximum(np.floor((i - 0.5) * each + 1e-9), 0).astype(np.int64))
        high.append(np.minimum(np.ceil((i + 1.5) * each - 1e-9) - 1, count - 1).astype(np.int64))
    occupied = np.zeros(cells, bool)
    for offset in itertools.product(range(3), repeat=3):  # a cell is no finer than a voxel
        occupied[tuple(np.minimum(a + o, b) for a, b, o in zip(low, high, offset, strict=True))] = True
    return occupied


# -- the background ------------------------------------------------------------------------------------------


def background_of(entries: Entries, middle: np.ndarray, radius: np.ndarray) -> ImportedNode | None:
    """The spheres around the unit ball of the box, if any. Their σ is per growth of -1/rho, rho counted in
    radii, times the world's length of a radius in the ray's direction."""
    if "background_links" not in entries.values:
        return None
    links = links_of(entries, "background_links", 2, MAX_ROWS)
    if links.max() < 0:
        return None
    data = entries.array("background_data", None, None, 4)
    check_links(links, len(data), "columns of 'background_data'")
    check_count(len(data), "columns of 'background_data'")
    layers = data.shape[1]
    if not 1 <= layers <= MAX_TEXELS // 8:
        raise FormatError(f"'background_data' should have up to {MAX_TEXELS // 8} layers, found {layers}")
    sizes = {"wide": links.shape[0], "high": links.shape[1], "layers": layers, "columns": len(data)}
    shape = PartsShape(
        {"part": "spheres", "numbers": 1, **sizes}, {"part": "spheres", "numbers": 3, **sizes},
        {"part": "density_sum", "activation": "relu"}, {"part": "sh", "coefficients": 1}, "relu",
    )  # fmt: skip
    columns, rows = np.maximum(links, -1), data.reshape(-1, 4)
    values = {
        "density_columns": columns, "density_values": rows[:, 3:],
        "colour_columns": columns, "colour_values": rows[:, :3],
    }  # fmt: skip
    scale = np.prod(radius) ** (1 / 3)
    units = {f"unit_{axis}": float(r / scale) for axis, r in zip("xyz", radius, strict=True)}
    space = space_of(contracted_l2, contracted_density=contracted_l2.OUTWARD,
                     **(units if radius.max() > radius.min() else {}))  # fmt: skip
    cells = OccupancyGrid.full(contracted_l2.WHOLE, 64, space)
    far = np.linalg.norm(cells.centres(), axis=1).reshape(cells.occupied.shape)
    half = np.sqrt(3) * cells.cell[0] / 2
    occupied = cells.marked((far > 1 - half) & (far < 2 + half))
    resolution = (min(8 * max(layers, 32) + 1, MAX_TEXELS),) * 3  # so that samples lie half a layer apart
    field = parts_field(shape, contracted_l2.WHOLE, resolution, values, scale, occupancy=occupied)
    placement = np.diag([*radius, 1.0])
    placement[:3, 3] = middle
    return ImportedNode(field, placement, " background")
