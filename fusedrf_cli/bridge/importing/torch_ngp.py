"""Checkpoints of torch-ngp (github.com/ashawkey/torch-ngp), and of PVD (Fang et al., AAAI 2023), which is
built on it: hash grids, planes and lines, networks, volumes."""

from collections.abc import Sequence

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.bridge.importing import tensorf
from fusedrf_cli.bridge.importing.cells import cells_of_bits
from fusedrf_cli.bridge.importing.nerf import frequencies_of, joined, skipping
from fusedrf_cli.bridge.importing.parts import (
    ColourInput,
    Entries,
    Imported,
    ImportedNode,
    beside,
    colour_network,
    eight,
    parts_field,
    ranks_filled,
    trunk_layers,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsShape

BASE, FINEST = 16, 2048  # vertices of the coarsest grid, and of the finest for each unit of the bound
LIMITS = (-2.0, 7.0)  # of what PVD exponentiates
SAMPLES = 297  # vertices along an axis by which rays are sampled as there, a 1024th of a diagonal apart
EMA = "its moving averages (ema) are left out, as the system's own rendering does"


def read(checkpoint) -> Imported:
    """The field of a checkpoint of torch-ngp. Raises FormatError."""
    return hashed(checkpoint, (-80.0, 50.0))


def read_pvd(checkpoint) -> Imported:
    """The field of a checkpoint of PVD. Raises FormatError."""
    names = Entries(checkpoint.entries).inside("model").values
    if "encoder.embeddings" in names:
        return hashed(checkpoint, LIMITS)
    if "tensor_volume.0" in names:
        return volume(checkpoint)
    return planes(checkpoint) if "sigma_mat.0" in names else network(checkpoint)


def hashed(checkpoint, limits: tuple[float, float]) -> Imported:
    """A hash grid, a trunk and a colour network."""
    model = Entries(checkpoint.entries).inside("model")
    rows, offsets = model.array("encoder.embeddings", None, None), model.array("encoder.offsets", None)
    box = box_of(model, "aabb_infer")
    levels = levels_of(offsets.astype(np.int64), len(rows), float(box[3]))
    encoding = {"part": "hash_grid", "features": rows.shape[1], "levels": levels}
    width = eight(len(levels) * rows.shape[1])
    sigma, sections = trunk_layers(model.layers("sigma_net."), width, limits=limits)
    rgb, colours = harmonic_network(model, sigma["outputs"])
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma, rgb)
    values = {"density_rows": rows} | sections | colours
    return finished(checkpoint, model, shape, box, (SAMPLES,) * 3, values)


def planes(checkpoint) -> Imported:
    """Planes and lines, and a colour network of 15 features."""
    model = Entries(checkpoint.entries).inside("model")
    density, resolution, _ = factors(model, "sigma")
    colour, _, ranks = factors(model, "color")
    basis = model.array("basis_mat.weight", None, sum(ranks))
    order = ColourInput(len(basis), len(basis), harmonics=True)
    columns = np.concatenate([order.at("direction"), order.at("features")])
    rgb, sections = colour_network(model.layers("color_net."), order, columns, rows=len(basis))
    basis = beside(np.split(basis, np.cumsum(ranks)[:-1], 1), ranks_filled(ranks))
    values = {f"density_{name}": value for name, value in density.items()} | sections
    values |= {f"colour_{name}": value for name, value in colour.items()} | {"rgb_basis": basis}
    encodings = [{"part": "plane_line", "rank": made["line_0"].shape[-1]} for made in (density, colour)]
    sigma = {"part": "density_sum", "activation": "exp", "limits": LIMITS}
    shape = PartsShape(*encodings, sigma, rgb | {"limits": LIMITS})
    return finished(checkpoint, model, shape, box_of(model, "aabb_train"), resolution, values)


def volume(checkpoint) -> Imported:
    """A grid of density and spherical harmonics."""
    model = Entries(checkpoint.entries).inside("model")
    grid = model.array("tensor_volume.0", 1, None, None, None, None)[0].transpose(3, 2, 1, 0)
    coefficients, rest = divmod(grid.shape[-1] - 1, 3)
    if rest or coefficients not in (1, 4, 9, 16):
        raise FormatError(
            f"'tensor_volume.0' should have 1 and 3 times 1, 4, 9 or 16 channels, found {grid.shape[-1]}"
        )
    shape = PartsShape(
        {"part": "grid", "numbers": 1}, {"part": "grid", "numbers": 3 * coefficients},
        {"part": "density_sum", "activation": "exp", "limits": LIMITS},
        {"part": "sh", "coefficients": coefficients},
    )  # fmt: skip
    values = {"density_": grid[..., 0], "colour_": grid[..., 1:]}
    return finished(checkpoint, model, shape, box_of(model, "aabb_train"), grid.shape[:3], values)


def network(checkpoint) -> Imported:
    """NeRF's network, in front of the trunk."""
    model = Entries(checkpoint.entries).inside("model")
    layers, trunk = model.layers("nerf_mlp."), model.layers("sigma_net.")
    frequencies = frequencies_of(layers[0][0].shape[1])
    # its last layer has no activation, and goes with the trunk's first
    layers = [*layers[:-1], joined(layers[-1], trunk[0]), *trunk[1:]]
    box = box_of(model, "aabb_infer")
    sigma, sections = skipping(layers, frequencies, hidden_first=False)
    sigma |= {"activation": "exp", "limits": list(LIMITS)}
    rgb, colours = harmonic_network(model, sigma["outputs"])
    encoding = {"part": "frequencies", "count": frequencies, "frame": True}
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma, rgb)
    return finished(checkpoint, model, shape, box, (SAMPLES,) * 3, sections | colours)


def finished(
    checkpoint, model: Entries, shape: PartsShape, box: np.ndarray, resolution: Sequence[int], values: dict
) -> Imported:
    """The import of a field over a box, in the cells that the file holds occupied."""
    cells = OccupancyGrid.full(box)
    if "density_bitfield" in model.values:
        bound = float(box_of(model, "aabb_infer")[3])
        cascades = 1 + int(np.ceil(np.log2(max(bound, 1))))
        bits = np.unpackbits(model.array("density_bitfield", None).astype(np.uint8), bitorder="little")
        cells = cells_of_bits(bits.astype(bool), cascades, bound)
    field = parts_field(shape, box, resolution, values, occupancy=cells)
    notes = [EMA] if "ema" in checkpoint.entries else []
    return Imported([ImportedNode(field)], notes)


def box_of(model: Entries, name: str) -> np.ndarray:
    """A box (6,) of the file."""
    box = model.array(name, 6).astype(np.float64)
    if not (box[:3] < box[3:]).all():
        raise FormatError(f"'{name}' should be three minima below three maxima, found {box.tolist()}")
    return box


def levels_of(offsets: np.ndarray, rows: int, bound: float) -> list[dict]:
    """The levels of torch-ngp's grid: rows of one vertex more than tiny-cuda-nn's. Scales are computed in
    float32, as there: the finest is a whole number but for rounding."""
    count = len(offsets) - 1
    if count < 1 or offsets[0] != 0 or offsets[-1] != rows or (np.diff(offsets) <= 0).any():
        raise FormatError(f"'encoder.offsets' should count up to {rows} rows, found {offsets.tolist()[:40]}")
    growth = np.float32(np.log2(2 ** (np.log2(FINEST * bound / BASE) / max(count - 1, 1))))
    levels = []
    for level, held in enumerate(np.diff(offsets)):
        scale = np.exp2(np.float32(level) * growth) * np.float32(BASE) - np.float32(1)
        side = int(np.ceil(scale)) + 2
        hashed = bool(side**3 > held)
        levels.append(
            {"scale": float(scale), "side": side, "rows": int(held), "hashed": hashed, "offset": 0.5}
        )
    return levels


def harmonic_network(model: Entries, outputs: int) -> tuple[dict, dict[str, np.ndarray]]:
    """A colour network of harmonics and of the trunk's outputs but for the first."""
    order = ColourInput(outputs, outputs, harmonics=True)
    layers = model.layers("color_net.")
    features = order.at("features")[1 : 1 + layers[0][0].shape[1] - len(order.at("direction"))]
    return colour_network(layers, order, np.concatenate([order.at("direction"), features]))


def factors(model: Entries, which: str) -> tuple[dict[str, np.ndarray], tuple, list[int]]:
    """Planes and lines, laid out as TensoRF's (tensorf.py), by the names of our sections; texels per axis,
    and ranks."""
    renamed = {
        f"app_{part}.{i}": model.get(f"{which}_{there}.{i}")
        for part, there in (("plane", "mat"), ("line", "vec"))
        for i in range(3)
    }
    return tensorf.factors(Entries(renamed), "app", True)
