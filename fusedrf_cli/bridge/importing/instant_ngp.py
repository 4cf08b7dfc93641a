"""Snapshots of Instant-NGP (Müller et al. 2022; github.com/NVlabs/instant-ngp)."""

import math

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.bridge.importing import tcnn
from fusedrf_cli.bridge.importing.cells import merged, unmortoned
from fusedrf_cli.bridge.importing.parts import (
    ColourInput,
    Entries,
    Imported,
    ImportedNode,
    colour_network,
    eight,
    parts_field,
    trunk_layers,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsShape

HARMONICS = 16
FINEST = 2048  # vertices along an axis, for each unit of the scene's scale
LEAST = 0.01  # density in a cell that is occupied, at most
SAMPLES = 297  # vertices by which rays are sampled a 1024th of a cube's diagonal apart, as there
CYCLED = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
"""From its axes to those of the cameras that it reads."""


def read(checkpoint) -> Imported:
    """The field of a snapshot. Raises FormatError."""
    root = Entries(checkpoint.entries)
    snapshot = root.inside("snapshot")
    nerf = snapshot.inside("nerf")
    data = nerf.inside("dataset")
    scale = int(2 ** round(math.log2(max(1.0, nerf.number("aabb_scale", 1.0)))))
    levels, features = levels_of(root.inside("encoding"), scale)
    layers, colours, rows = networks(root, snapshot, levels, features, data)
    sigma, sections = trunk_layers(layers, eight(len(levels) * features))
    order = ColourInput(sigma["outputs"], sigma["outputs"], harmonics=True)
    columns = np.concatenate([order.at("features")[: len(layers[-1][0])], order.at("direction")])
    rgb, more = colour_network(colours, order, columns)
    encoding = {"part": "hash_grid", "features": features, "levels": levels}
    shown = "exp" if data.values.get("is_hdr") else "sigmoid"
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma, rgb, shown)
    box = np.array([0.5 - scale / 2] * 3 + [0.5 + scale / 2] * 3)
    field = parts_field(
        shape,
        box,
        (SAMPLES,) * 3,
        {"density_rows": rows} | sections | more,
        occupancy=cells_of(snapshot, box, scale),
    )
    return Imported([ImportedNode(field, placement_of(data))], notes_of(snapshot, data, box))


def levels_of(encoding: Entries, scale: int) -> tuple[list[dict], int]:
    """The levels of the hash grid, and numbers of a row."""
    kind = str(encoding.values.get("otype", "HashGrid"))
    if kind.lower() not in ("hashgrid", "grid"):
        raise FormatError(f"encoding: 'otype' should be HashGrid, found {kind[:40]!r}")
    count, base = encoding.whole("n_levels", 1, 32, 16), encoding.whole("base_resolution", 1, 4096, 16)
    features = encoding.whole("n_features_per_level", 1, 8, 2)
    growth = np.exp(np.log(np.float32(FINEST * scale) / np.float32(base)) / np.float32(max(count - 1, 1)))
    growth = encoding.number("per_level_scale", float(growth))
    log2_rows = encoding.whole("log2_hashmap_size", 1, 26, 19)
    return tcnn.levels_of(count, log2_rows, base, np.log2(np.float32(growth))), features


def networks(root: Entries, snapshot: Entries, levels: list[dict], features: int, data: Entries):
    """Layers of the networks of density and of colour, and the rows of the grid. How far a network is padded
    follows from the number of parameters: where there are no halves another one runs than the file says."""
    params = halves(snapshot)
    density, colour = root.inside("network"), root.inside("rgb_network")
    extra = data.whole("n_extra_learnable_dims", 0, 256, 0)
    inputs, outputs = len(levels) * features, density.whole("n_output_dims", 1, 256, 16)
    rows = sum(level["rows"] for level in levels) * features
    for by in (16, 8):
        own = tcnn.shapes_of(inputs, density.whole("n_neurons", 8, 1024, 64),
                             density.whole("n_hidden_layers", 1, 16, 1), outputs, by)  # fmt: skip
        seen = tcnn.padded(outputs, by) + tcnn.padded(HARMONICS + extra, by)
        shading = tcnn.shapes_of(seen, colour.whole("n_neurons", 8, 1024, 64),
                                 colour.whole("n_hidden_layers", 1, 16, 2), 3, by)  # fmt: skip
        if tcnn.size_of(own) + tcnn.size_of(shading) + rows == len(params):
            break
    else:
        raise FormatError(
            f"snapshot: 'params_binary' has {len(params):,} numbers, which its configuration does not"
        )
    layers, params = tcnn.network_of(params, own, inputs, outputs, 0.0)
    # codes of pictures are 0, as where no picture is asked for
    colours, params = tcnn.network_of(params, shading, tcnn.padded(outputs, by) + HARMONICS, 3, 0.0)
    (first, bias), *others = colours
    read = [*range(outputs), *range(tcnn.padded(outputs, by), first.shape[1])]
    return layers, [(first[:, read], bias), *others], tcnn.rows_of(params, levels, features)


def halves(snapshot: Entries) -> np.ndarray:
    """The parameters, as the program computes with them."""
    kind = snapshot.get("params_type")
    if kind not in ("__half", "float"):
        raise FormatError(f"snapshot: 'params_type' should be __half or float, found {str(kind)[:40]!r}")
    values = np.frombuffer(binary(snapshot, "params_binary"), np.float16 if kind == "__half" else np.float32)
    values = values.astype(np.float32)
    if not np.isfinite(values).all():
        raise FormatError("snapshot: 'params_binary' holds NaN or infinity")
    return values


def binary(entries: Entries, name: str) -> bytes:
    """Bytes, or the object that JSON has for them."""
    value = entries.get(name)
    if isinstance(value, dict) and isinstance(value.get("bytes"), list):
        value = bytes(value["bytes"])
    if not isinstance(value, bytes) or len(value) % 2:
        raise FormatError(f"{entries.where}'{name}' should be bytes, found {type(value).__name__}")
    return value


def cells_of(snapshot: Entries, box: np.ndarray, scale: int) -> OccupancyGrid:
    """The cells that rays are sampled in, which lie in the box that is rendered."""
    side = snapshot.whole("density_grid_size", 0, 512, 0)
    if side == 0:
        return OccupancyGrid.full(box)
    values = np.frombuffer(binary(snapshot, "density_grid_binary"), np.float16).astype(np.float32)
    if side & (side - 1) or not len(values) or len(values) % side**3:
        raise FormatError(f"snapshot: 'density_grid_binary' has {len(values):,} cells, no cubes of {side}")
    values = values.reshape(-1, side**3)
    levels = unmortoned(values > min(LEAST, float(np.maximum(values[0], 0).mean())), side)
    for finer, level in zip(levels, levels[1:], strict=False):
        half = slice(side // 4, side // 4 + side // 2)
        level[half, half, half] |= finer.reshape(side // 2, 2, side // 2, 2, side // 2, 2).any((1, 3, 5))
    return merged(levels, box, float(scale))


def placement_of(data: Entries) -> np.ndarray:
    """(4, 4) from the unit cube to the coordinates of the cameras that the program was given."""
    scale = data.number("scale", 0.33)
    if not scale > 0:
        raise FormatError("dataset: 'scale' should be above 0")
    axes = np.eye(3) if data.values.get("from_mitsuba") else CYCLED
    placement = np.eye(4)
    placement[:3, :3] = axes / scale
    placement[:3, 3] = -data.array("offset", 3).astype(np.float64) / scale
    return placement


def notes_of(snapshot: Entries, data: Entries, box: np.ndarray) -> list[str]:
    """What is not taken over."""
    notes = []
    shown = snapshot.values.get("render_aabb", {})
    if {"min", "max"} <= set(shown):
        low, high = (np.array(shown[name], np.float64) for name in ("min", "max"))
        if (low > box[:3] + 1e-6).any() or (high < box[3:] - 1e-6).any():
            notes.append(f"its crop box {low.tolist()} to {high.tolist()} is left out; crop the result")
    if any(np.asarray(data.values.get("envmap_resolution", [0, 0])) > 0):
        notes.append("its environment map is left out")
    if data.whole("n_extra_learnable_dims", 0, 256, 0):
        notes.append("its codes of pictures are taken to be 0")
    return notes
