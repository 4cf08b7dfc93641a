"""Snapshots of Instant-NGP (Müller et al. 2022; github.com/NVlabs/instant-ngp)."""

import itertools
import operator
from dataclasses import replace

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.bridge.importing import tcnn
from fusedrf_cli.bridge.importing.cells import SAMPLED, cascades_of, cropped, grids_of, nodes_of, unmortoned
from fusedrf_cli.bridge.importing.parts import (
    ColourInput,
    Entries,
    Imported,
    Layer,
    colour_network,
    eight,
    parts_field,
    trunk_layers,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsShape

HARMONICS = 16
FINEST = 2048  # vertices along an axis, for each unit of the scene's scale
LEAST = 0.01  # optical depth of a step through a cell that is occupied, at most
CROPPED = "it is cut to its crop box, as the program shows it"
MOST_SCALE = 128
CYCLED = np.array([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
"""From its axes to those of the cameras that it reads."""


def read(checkpoint) -> Imported:
    """The field of a snapshot. Raises FormatError."""
    root = Entries(checkpoint.entries)
    snapshot = root.inside("snapshot")
    data = dataset_of(snapshot.inside("nerf"))
    scale = scale_of(data)
    cube = np.array([0.5 - scale / 2] * 3 + [0.5 + scale / 2] * 3)
    box = box_of(snapshot, "aabb", cube)
    levels, features = levels_of(root.inside("encoding"), scale)
    layers, colours, rows = networks(root, snapshot, levels, features, data)
    sigma, sections = trunk_layers(layers, eight(len(levels) * features))
    order = ColourInput(sigma["outputs"], sigma["outputs"], harmonics=True)
    columns = np.concatenate([order.at("features")[: len(layers[-1][0])], order.at("direction")])
    rgb, more = colour_network(colours, order, columns)
    encoding = {"part": "hash_grid", "features": features, "levels": levels}
    shown = "exp" if data.values.get("is_hdr") else "sigmoid"
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma, rgb, shown)
    field = parts_field(shape, box, (2, 2, 2), {"density_rows": rows} | sections | more)
    grids = cells_of(snapshot, cube, scale)
    # that of the capture's transforms.json, until a user changes it
    shown = cropped_to(snapshot if "render_aabb" in snapshot.values else data, grids, box)
    notes = [] if all(map(operator.is_, shown, grids)) else [CROPPED]
    return Imported(nodes_of(field, shown, placement_of(data)), notes_of(snapshot, data) + notes)


def dataset_of(nerf: Entries) -> Entries:
    """What the file says of its capture; with the scene's scale alone where it says no more."""
    own = {"aabb_scale": nerf.values["aabb_scale"]} if "aabb_scale" in nerf.values else {}
    if "dataset" not in nerf.values:
        return Entries(own | {"unknown": True}, "snapshot: nerf: ")
    data = nerf.inside("dataset")
    return Entries(dict(data.values) | own, data.where)


def scale_of(data: Entries) -> int:
    """The side of the cube that the scene fills."""
    scale = data.whole("aabb_scale", 1, MOST_SCALE, 1)
    if scale & (scale - 1):
        raise FormatError(f"{data.where}'aabb_scale' should be a power of two, found {scale}")
    return scale


def box_of(entries: Entries, name: str, otherwise: np.ndarray) -> np.ndarray:
    """A box (6,) of the file; another where it has none, or an empty one."""
    if name not in entries.values:
        return otherwise
    found = entries.inside(name)
    low, high = listed(found, "min", 3), listed(found, "max", 3)
    return np.concatenate([low, high]) if (low < high).all() and np.isfinite([low, high]).all() else otherwise


def listed(entries: Entries, name: str, *shape: int) -> np.ndarray:
    """Numbers in lists, as float64; they may be infinite."""
    try:
        values = np.asarray(entries.get(name), np.float64)
    except (TypeError, ValueError):
        values = np.full(shape, np.nan)
    if values.shape != shape or np.isnan(values).any():
        raise FormatError(f"{entries.where}'{name}' should be {' × '.join(map(str, shape))} numbers")
    return values


# -- numbers -------------------------------------------------------------------------------------------------


def levels_of(encoding: Entries, scale: int) -> tuple[list[dict], int]:
    """The levels of the grid, and numbers of a row."""
    kind = str(encoding.values.get("otype", "HashGrid")).lower()
    rows = str(encoding.values.get("type", "hash" if kind == "grid" else kind.removesuffix("grid"))).lower()
    if kind not in ("hashgrid", "densegrid", "tiledgrid", "grid") or rows not in ("hash", "dense", "tiled"):
        raise FormatError(
            "encoding: 'otype' should be HashGrid, DenseGrid or TiledGrid, found "
            f"{kind[:40]!r} of {rows[:40]!r}; other encodings are not read"
        )
    for key, expected in (("interpolation", "Linear"), ("hash", "CoherentPrime")):
        found = str(encoding.values.get(key, expected))
        if found.lower() != expected.lower():
            raise FormatError(f"encoding: '{key}' should be {expected}, found {found[:40]!r}")
    features = encoding.whole("n_features_per_level", 1, 8, 2)
    count = encoding.whole("n_features", 0, 256, 0) // features or encoding.whole("n_levels", 1, 32, 16)
    log2_rows = encoding.whole("log2_hashmap_size", 1, 26, 19)
    usual = encoding.whole("log2_hashmap_size", 1, 26, 15)  # the program's own, beside its library's
    base = encoding.whole("base_resolution", 0, 4096, 0) or 1 << usual // 3
    growth = encoding.number("per_level_scale", 0.0)
    if growth <= 0:
        ratio = np.float32(FINEST) * np.float32(scale) / np.float32(base)
        growth = tcnn.single(np.exp, tcnn.single(np.log, ratio) / np.float32(max(count - 1, 1)))
    log2_growth = tcnn.single(np.log2, np.float32(growth))
    return tcnn.levels_of(count, log2_rows, base, log2_growth, rows), features


def networks(
    root: Entries, snapshot: Entries, levels: list[dict], features: int, data: Entries
) -> tuple[list[Layer], list[Layer], np.ndarray]:
    """Layers of the networks of density and of colour, and the rows of the grid. How far a network is padded
    follows from the number of parameters: where there are no halves another one runs than the file says."""
    params = halves(snapshot)
    density, colour = network(root, "network"), network(root, "rgb_network")
    extra = data.whole("n_extra_learnable_dims", 0, 256, 0)
    check_directions(root)
    inputs, outputs = len(levels) * features, density.whole("n_output_dims", 1, 256, 16)
    rows = sum(level["rows"] for level in levels) * features
    for before, own_by, by in itertools.product((16, 8), repeat=3):
        own = tcnn.shapes_of(tcnn.padded(inputs, before), *neurons_of(density, 64, 1), outputs, own_by)
        made, seen = tcnn.padded(outputs, own_by), tcnn.padded(HARMONICS + extra, by)
        shading = tcnn.shapes_of(tcnn.padded(made + seen, by), *neurons_of(colour, 64, 2), 3, by)
        if tcnn.size_of(own) + tcnn.size_of(shading) + rows == len(params):
            break
    else:
        raise FormatError(
            f"snapshot: 'params_binary' has {len(params):,} numbers, which its configuration does not"
        )
    # the colour's reads what the density's is filled up to as well
    layers, params = tcnn.network_of(params, own, inputs, made, 0.0)
    shading_size = tcnn.size_of(shading)
    colours, _ = tcnn.network_of(params[:shading_size], shading, tcnn.padded(made + seen, by), 3, 0.0)
    (first, _), *others = colours
    # what is the same everywhere: the code of a picture, filled up with 1
    same = np.ones(seen - HARMONICS)
    same[:extra] = code_of(snapshot, extra)
    bias = first[:, made + HARMONICS : made + seen].astype(np.float64) @ same
    first = first[:, : made + HARMONICS]
    return layers, [(first, bias), *others], tcnn.rows_of(params[shading_size:], levels, features)


def code_of(snapshot: Entries, count: int) -> np.ndarray:
    """The code (count,) by which pictures are shown: the first photo's, or 0 where the file has none."""
    codes = snapshot.inside("nerf").values.get("extra_dims_opt")
    if not count or not isinstance(codes, list) or not codes or not isinstance(codes[0], dict):
        return np.zeros(count)
    return Entries(codes[0], "snapshot: nerf: extra_dims_opt: ").array("variable", count).astype(np.float64)


def network(root: Entries, name: str) -> Entries:
    """The configuration of a network. Raises FormatError for activations that are not read."""
    entries = root.inside(name)
    for key, expected in (("activation", "ReLU"), ("output_activation", "None")):
        found = str(entries.values.get(key, expected))
        if found.lower() != expected.lower():
            raise FormatError(f"{name}: '{key}' should be {expected}, found {found[:40]!r}; no other is read")
    return entries


def neurons_of(network: Entries, neurons: int, hidden: int) -> tuple[int, int]:
    """Neurons of a layer, and hidden layers."""
    return network.whole("n_neurons", 8, 1024, neurons), network.whole("n_hidden_layers", 0, 16, hidden)


def check_directions(root: Entries) -> None:
    """Raise FormatError unless directions are encoded by 16 harmonics."""
    encoding = root.values.get("dir_encoding")
    nested = encoding.get("nested") if isinstance(encoding, dict) else None
    first = nested[0] if isinstance(nested, list) and nested else encoding
    if isinstance(first, dict):
        kind, degree = str(first.get("otype", "SphericalHarmonics")), first.get("degree", 4)
        if kind.lower() != "sphericalharmonics" or degree != 4:
            raise FormatError(
                f"dir_encoding: should be SphericalHarmonics of degree 4, found {kind[:40]} of "
                f"{degree!r:.20}; other encodings are not read"
            )


def halves(snapshot: Entries) -> np.ndarray:
    """The parameters, as the program computes with them."""
    kind = snapshot.values.get("params_type", missing_type(snapshot))
    if kind not in ("__half", "float"):
        raise FormatError(f"snapshot: 'params_type' should be __half or float, found {str(kind)[:40]!r}")
    values = numbers(snapshot, "params_binary", np.float16 if kind == "__half" else np.float32)
    if np.isinf(values).any():
        raise FormatError("snapshot: 'params_binary' holds infinity")
    return values


def missing_type(snapshot: Entries) -> str:
    """The type of the parameters of a snapshot of 2022 that does not say it, by how many they are."""
    held, count = snapshot.values.get("params_binary"), snapshot.values.get("n_params")
    whole = isinstance(held, bytes) and isinstance(count, int) and len(held) == 4 * count
    return "float" if whole else "__half"


def numbers(entries: Entries, name: str, dtype: type) -> np.ndarray:
    """The numbers that bytes hold, as float32; none is NaN."""
    value = entries.get(name)
    if not isinstance(value, bytes) or len(value) % np.dtype(dtype).itemsize:
        raise FormatError(f"{entries.where}'{name}' should be bytes of {np.dtype(dtype).name}")
    values = np.frombuffer(value, dtype).astype(np.float32)
    if np.isnan(values).any():
        raise FormatError(f"{entries.where}'{name}' holds NaN")
    return values


# -- where there is something --------------------------------------------------------------------------------


def cells_of(snapshot: Entries, cube: np.ndarray, scale: int) -> list[OccupancyGrid]:
    """The cells that rays are sampled in."""
    side = snapshot.whole("density_grid_size", 0, 512, 0)
    values = numbers(snapshot, "density_grid_binary", np.float16) if side else np.zeros(0)
    if not len(values):  # never filled
        return [replace(OccupancyGrid.full(cube), unit=SAMPLED)]
    cascades = cascades_of(scale)
    if side < 4 or side & (side - 1) or len(values) != cascades * side**3:
        raise FormatError(
            f"snapshot: 'density_grid_binary' has {len(values):,} cells, and an 'aabb_scale' of {scale} asks "
            f"for {cascades} cubes of {side}³"
        )
    values = values.reshape(cascades, -1)
    levels = unmortoned(values > min(LEAST, float(np.maximum(values[0], 0).mean(dtype=np.float64))), side)
    for finer, level in itertools.pairwise(levels):
        half = slice(side // 4, side // 4 + side // 2)
        level[half, half, half] |= finer.reshape(side // 2, 2, side // 2, 2, side // 2, 2).any((1, 3, 5))
    return grids_of(levels, np.full(3, 0.5), float(scale), 0.5)


def cropped_to(said: Entries, grids: list[OccupancyGrid], box: np.ndarray) -> list[OccupancyGrid]:
    """The cells within the box that rays are cut to."""
    shown, turned = box_of(said, "render_aabb", box), np.eye(3)
    if "render_aabb_to_local" in said.values:
        turned = listed(said, "render_aabb_to_local", 3, 3)
        if not 1e-12 < abs(np.linalg.det(turned)) < np.inf:
            raise FormatError(f"{said.where}'render_aabb_to_local' should be a matrix that can be undone")
    return cropped(cropped(grids, box), shown, turned)


def placement_of(data: Entries) -> np.ndarray:
    """(4, 4) from the unit cube to the coordinates of the cameras that the program was given."""
    scale = data.number("scale", 0.33)
    if not scale > 0:
        raise FormatError(f"{data.where}'scale' should be above 0, found {scale:g}")
    offset = data.array("offset", 3).astype(np.float64) if "offset" in data.values else np.full(3, 0.5)
    axes = np.eye(3) if data.values.get("from_mitsuba") else CYCLED
    placement = np.eye(4)
    placement[:3, :3] = axes / scale
    placement[:3, 3] = -offset / scale
    return placement


def notes_of(snapshot: Entries, data: Entries) -> list[str]:
    """What is not taken over, or not known."""
    notes = []
    if data.values.get("unknown"):
        notes.append(
            "it does not say where its capture lies: the program's usual scale 0.33 and offset 0.5 are undone"
        )
    if "envmap_resolution" in data.values and listed(data, "envmap_resolution", 2).any():
        notes.append("its environment map is left out")
    if count := data.whole("n_extra_learnable_dims", 0, 256, 0):
        shown = "the first photo's, as the program shows it" if code_of(snapshot, count).any() else "0"
        notes.append(f"its codes of pictures are fixed to {shown}")
    return notes
