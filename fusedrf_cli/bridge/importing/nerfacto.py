"""nerfstudio's nerfacto (Tancik et al., SIGGRAPH 2023; github.com/nerfstudio-project/nerfstudio), computed by
torch or by tiny-cuda-nn."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from formats.errors import FormatError
from fusedrf_cli.bridge.importing import tcnn
from fusedrf_cli.bridge.importing.parts import (
    ColourInput,
    Entries,
    Imported,
    ImportedNode,
    Layer,
    colour_network,
    eight,
    parts_field,
    trunk_layers,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels.reference import sh_basis
from fusedrf_cli.engine.kinds.assembled.field import PartsShape
from fusedrf_cli.engine.spaces import bounded, contracted_linf

FIELD = "_model.field."
HARMONICS, HIDDEN = 16, 64
MOST_SAMPLES = 512  # vertices along an axis by which rays are sampled
DENSITY = 0.01  # average_init_density of the recipe


def read(checkpoint) -> Imported:
    """The field of a checkpoint. Raises FormatError."""
    state = Entries(checkpoint.entries).inside("pipeline")
    settings = model_settings(checkpoint.beside.get("config.yml"))
    finest = state.whole(FIELD + "max_res", 2, 1 << 20)
    count = state.whole(FIELD + "num_levels", 1, 32)
    log2_rows = state.whole(FIELD + "log2_hashmap_size", 1, 26)
    base = int(settings.get("base_res", 16))
    if FIELD + "mlp_base.model.params" in state.values:
        levels, features, rows, trunk = tcnn_base(state, settings, finest, count, log2_rows, base)
        codes, head = codes_of(state, settings), None
        head = tcnn_head(state, settings, len(trunk[-1][0]), codes)
    else:
        levels, features, rows, trunk = torch_base(state, finest, count, log2_rows, base)
        codes = codes_of(state, settings)
        head = torch_head(state, len(trunk[-1][0]), codes)
    sigma, sections = trunk_layers(trunk, eight(count * features))
    order = ColourInput(sigma["outputs"], sigma["outputs"], harmonics=True)
    columns = np.concatenate([order.at("direction"), order.at("features")[1 : len(trunk[-1][0])]])
    rgb, more = colour_network(head, order, columns)
    encoding = {"part": "hash_grid", "features": features, "levels": levels}
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma, rgb)
    contracted = not settings.get("disable_scene_contraction", False)
    box = np.array([-2.0] * 3 + [2.0] * 3) if contracted else own_box(state)
    cells = OccupancyGrid.full(box, space=contracted_linf if contracted else bounded)
    resolution = (min(finest, MOST_SAMPLES) + 1,) * 3
    scale = float(settings.get("average_init_density", DENSITY))
    field = parts_field(
        shape, box, resolution, {"density_rows": rows} | sections | more, scale, occupancy=cells
    )
    placement, notes = placement_of(checkpoint.beside.get("dataparser_transforms.json"))
    if not settings:
        notes.append(f"no config.yml lies beside it: densities are taken to begin at {DENSITY:g}")
    if codes is not None:
        notes.append("its appearance codes are fixed to their mean")
    return Imported([ImportedNode(field, placement)], notes)


def model_settings(config: Any) -> Mapping[str, Any]:
    """The model's part of a run's config.yml, or nothing."""
    for name in ("pipeline", "model"):
        config = config.get(name) if isinstance(config, Mapping) else None
    return config if isinstance(config, Mapping) else {}


def own_box(state: Entries) -> np.ndarray:
    """The box (6,) of a scene that is not contracted."""
    box = state.array(FIELD + "aabb", 2, 3).astype(np.float64).reshape(6)
    if not (box[:3] < box[3:]).all():
        raise FormatError(f"'{FIELD}aabb' should be three minima below three maxima, found {box.tolist()}")
    return box


def codes_of(state: Entries, settings: Mapping[str, Any]) -> np.ndarray | None:
    """The code of pictures that is shown: the mean of those that were learnt."""
    name = FIELD + "embedding_appearance.embedding.weight"
    if name not in state.values:
        return None
    codes = state.array(name, None, None).astype(np.float64)
    return codes.mean(0) if settings.get("use_average_appearance_embedding", True) else 0 * codes[0]


def folded(head: list[Layer], codes: np.ndarray | None, read: int) -> list[Layer]:
    """A network without the columns of the codes, which are the same everywhere: their share is a bias."""
    (weight, bias), *others = head
    if weight.shape[1] != read + (0 if codes is None else len(codes)):
        raise FormatError(f"'mlp_head' should read {read} numbers and codes, found {weight.shape[1]}")
    if codes is not None:
        bias = (0 if bias is None else bias) + weight[:, read:].astype(np.float64) @ codes
    return [(weight[:, :read], bias), *others]


# -- computed by torch ---------------------------------------------------------------------------------------


def torch_base(state: Entries, finest: int, count: int, log2_rows: int, base: int):
    """The levels of the hash grid, numbers of a row, rows, and the trunk's layers."""
    rows = state.array(FIELD + "mlp_base.model.0.hash_table", count << log2_rows, None)
    growth = np.exp((np.log(finest) - np.log(base)) / (count - 1)) if count > 1 else 1.0
    # in float32, as there: the finest level of 16 to 2048 has 2047
    scales = torch.floor(base * growth ** torch.arange(count)).tolist()
    levels = [
        {"scale": scale, "side": int(scale) + 1, "rows": 1 << log2_rows, "hashed": True, "offset": 0.0}
        for scale in scales
    ]
    return levels, rows.shape[1], rows, state.layers(FIELD + "mlp_base.model.1.layers.")


def torch_head(state: Entries, outputs: int, codes: np.ndarray | None) -> list[Layer]:
    """The colour network, which reads harmonics of its own kind."""
    head = folded(state.layers(FIELD + "mlp_head.layers."), codes, HARMONICS + outputs - 1)
    (weight, bias), *others = head
    weight = weight.astype(np.float64)
    weight[:, :HARMONICS] = weight[:, :HARMONICS] @ harmonics_as_there()
    return [(weight, bias), *others]


def harmonics_as_there() -> np.ndarray:
    """(16, 16) M of which M Y(d) is what nerfstudio's SHEncoding gives for (d + 1) / 2, Y the orthonormal
    harmonics: polynomials of degree 3, which on the sphere are sums of them."""
    d = np.random.default_rng(0).normal(size=(400, 3))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    x, y, z = ((d + 1) / 2).T
    xx, yy, zz = x * x, y * y, z * z
    values = [
        0.28209479177387814 + 0 * x, 0.4886025119029199 * y, 0.4886025119029199 * z, 0.4886025119029199 * x,
        1.0925484305920792 * x * y, 1.0925484305920792 * y * z,
        0.9461746957575601 * zz - 0.31539156525251999, 1.0925484305920792 * x * z,
        0.5462742152960396 * (xx - yy), 0.5900435899266435 * y * (3 * xx - yy), 2.890611442640554 * x * y * z,
        0.4570457994644658 * y * (5 * zz - 1), 0.3731763325901154 * z * (5 * zz - 3),
        0.4570457994644658 * x * (5 * zz - 1), 1.445305721320277 * z * (xx - yy),
        0.5900435899266435 * x * (xx - 3 * yy),
    ]  # fmt: skip
    ours = sh_basis(HARMONICS, torch.from_numpy(d)).numpy()
    return np.linalg.lstsq(ours, np.stack(values, 1), rcond=None)[0].T


# -- computed by tiny-cuda-nn --------------------------------------------------------------------------------


def tcnn_base(
    state: Entries, settings: Mapping[str, Any], finest: int, count: int, log2_rows: int, base: int
):
    """See torch_base. Numbers are halves where they are computed with."""
    params = halves(state, FIELD + "mlp_base.model.params")
    growth = np.exp((np.log(finest) - np.log(base)) / (count - 1)) if count > 1 else 1.0
    levels = tcnn.levels_of(count, log2_rows, base, np.log2(np.float32(growth)))
    rows = sum(level["rows"] for level in levels)
    features = int(settings.get("features_per_level", 2))
    neurons, hidden = int(settings.get("hidden_dim", HIDDEN)), int(settings.get("num_layers", 2)) - 1
    outputs = 16
    shapes = tcnn.shapes_of(count * features, neurons, hidden, outputs, by_of(neurons))
    if tcnn.size_of(shapes) + rows * features != len(params):
        raise FormatError(
            f"'{FIELD}mlp_base.model.params' has {len(params):,} numbers, which its sizes do not"
        )
    layers, params = tcnn.network_of(params, shapes, count * features, outputs, 0.0)
    return levels, features, tcnn.rows_of(params, levels, features), layers


def tcnn_head(
    state: Entries, settings: Mapping[str, Any], outputs: int, codes: np.ndarray | None
) -> list[Layer]:
    """See torch_head; its harmonics are the orthonormal ones."""
    name = FIELD + "mlp_head.tcnn_encoding.params"
    params = halves(state, name)
    neurons, hidden = (
        int(settings.get("hidden_dim_color", HIDDEN)),
        int(settings.get("num_layers_color", 3)) - 1,
    )
    read = HARMONICS + outputs - 1 + (0 if codes is None else len(codes))
    shapes = tcnn.shapes_of(read, neurons, hidden, 3, by_of(neurons))
    if tcnn.size_of(shapes) != len(params):
        raise FormatError(f"'{name}' has {len(params):,} numbers, which its sizes do not")
    layers, _ = tcnn.network_of(params, shapes, read, 3, 1.0)
    return folded(layers, codes, HARMONICS + outputs - 1)


def by_of(neurons: int) -> int:
    """Up to what a network of so many neurons is padded."""
    return tcnn.PADDED["FullyFusedMLP" if neurons in tcnn.FUSED else "CutlassMLP"]


def halves(state: Entries, name: str) -> np.ndarray:
    """Numbers as they are computed with."""
    with np.errstate(over="ignore"):
        values = state.array(name, None).astype(np.float16).astype(np.float32)
    if not np.isfinite(values).all():
        raise FormatError(f"'{name}' holds numbers beyond those of float16, in which it is computed")
    return values


# -- where it lies -------------------------------------------------------------------------------------------


def placement_of(transforms: Any) -> tuple[np.ndarray, list[str]]:
    """(4, 4) from the model's coordinates to the capture's, and notes: model = scale (R p + t)."""
    placement, notes = np.eye(4), []
    if not isinstance(transforms, Mapping):
        return placement, ["no dataparser_transforms.json lies beside it: it stays where nerfstudio moved it"]
    entries = Entries(transforms, "dataparser_transforms.json: ")
    matrix, scale = entries.array("transform", 3, 4).astype(np.float64), entries.number("scale")
    forward = np.eye(4)
    forward[:3] = scale * matrix
    if not abs(np.linalg.det(forward)) > 1e-30:
        raise FormatError("dataparser_transforms.json: the transform cannot be undone")
    notes.append("it lies where its capture does: dataparser_transforms.json is undone")
    return np.linalg.inv(forward), notes
