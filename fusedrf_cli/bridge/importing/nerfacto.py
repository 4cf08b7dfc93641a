"""nerfstudio's nerfacto (Tancik et al., SIGGRAPH 2023; github.com/nerfstudio-project/nerfstudio), computed by
torch or by tiny-cuda-nn, and its instant-ngp, whose field is the same but for its space until April 2023."""

from collections.abc import Mapping
from itertools import product
from typing import Any

import numpy as np
import torch

from formats.errors import FormatError
from formats.splats.splats import UP_Z
from formats.transforms import Applied, applied_to
from formats.views import Capture
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
from fusedrf_cli.engine.spaces import bounded, contracted_l2, contracted_linf

FIELD = "_model.field."
HARMONICS = 16
USUAL = {"base_res": 16, "features_per_level": 2, "hidden_dim": 64, "hidden_dim_color": 64}
SIZES = {"max_res": 2048, "num_levels": 16, "log2_hashmap_size": 19}
"""What a model of before these were stored in the file has, unless its settings say so."""
EARLIER = 4096, 1024
"""What the finest level of a model of 2022 may have as well: its numbers tell."""
BALL, BOX = 2, 0
"""Numbers of contractions before April 2023 (ContractionType of nerfacc)."""
DEPTHS = 1, 2, 3, 4, 5, 6, 0  # hidden layers that networks may have beside the usual
MOST_SAMPLES = 512  # vertices along an axis by which rays are sampled
DENSITY = 0.01  # average_init_density of the recipe
SEMANTIC = "mlp_semantics", "field_head_semantics"
"""In front of the names of what Semantic NeRF-W has beside: its densities begin at 1, whatever its settings
say."""
CONVERTED = np.array([[0.0, 1, 0, 0], [1, 0, 0, 0], [0, 0, -1, 0]])
"""What was done to the poses of COLMAP before captures said so."""
OWN_ARRAYS = "mlp_base.params", "mlp_base.model.params", "mlp_base_mlp.tcnn_encoding.params"
"""Names of the network of density where tiny-cuda-nn computes it: of 2022, now, and of 2023."""


def read(checkpoint, capture: Capture | None = None) -> Imported:
    """The field of a checkpoint, where its capture lies. Raises FormatError."""
    pipeline = named(Entries(checkpoint.entries).inside("pipeline"))
    state = state_of(pipeline, FIELD)
    marched = any(name.startswith("_model.occupancy_grid.") for name in pipeline)
    settings = Entries(model_settings(checkpoint.beside.get("config.yml")), "config.yml: ")
    finest, *sizes = sizes_of(state, settings)
    codes = codes_of(state, settings, marched)
    known = 0 if codes is None else len(codes)
    if any(name in state.values for name in OWN_ARRAYS):
        levels, rows, trunk = tcnn_base(state, settings, finest, *sizes)
        head, outputs = tcnn_head(state, settings, len(trunk[-1][0]), known)
        trunk[-1] = trunk[-1][0][:outputs], None if trunk[-1][1] is None else trunk[-1][1][:outputs]
    else:
        levels, rows, trunk = torch_base(state, finest[0], *sizes)
        outputs, head = len(trunk[-1][0]), torch_head(state)
    head = folded(head, codes, HARMONICS + outputs - 1)
    sigma, sections = trunk_layers(trunk, eight(len(levels) * rows.shape[1]))
    order = ColourInput(sigma["outputs"], sigma["outputs"], harmonics=True)
    columns = np.concatenate([order.at("direction"), order.at("features")[1:outputs]])
    rgb, more = colour_network(head, order, columns)
    encoding = {"part": "hash_grid", "features": rows.shape[1], "levels": levels}
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma, rgb)
    cells, frame, assumed = space_of_run(pipeline, state, settings)
    resolution = (min(*finest, MOST_SAMPLES) + 1,) * 3
    scale, notes = density_of(state, settings, marched)
    notes += assumed
    if marched:  # nerfstudio's instant-ngp, whose field this is as well
        notes.append(
            "the grid of cells that its pictures are sampled in is left out: it is sampled everywhere"
        )
    numbers = {"density_rows": rows} | sections | more
    field = parts_field(shape, cells.aabb, resolution, numbers, scale * frame[0, 0], occupancy=cells)
    placement, said = placement_of(checkpoint.beside.get("dataparser_transforms.json"), capture)
    if codes is not None:
        said.append(f"its appearance codes are fixed to {'their mean' if codes.any() else '0'}")
    return Imported([ImportedNode(field, placement @ frame)], notes + said, up=up_of(placement))


def named(pipeline: Entries) -> dict[str, Any]:
    """The entries of a pipeline by their names on one GPU: runs on several have "module." in front of a name,
    or within."""
    plain = {str(name).removeprefix("module."): value for name, value in pipeline.values.items()}
    return {name.replace("_model.module.", "_model.", 1): value for name, value in plain.items()}


def state_of(pipeline: Mapping[str, Any], prefix: str) -> Entries:
    """Those entries of a pipeline, as `named` has it, whose names begin so, by the rest of their names."""
    found = {name.removeprefix(prefix): pipeline[name] for name in pipeline if name.startswith(prefix)}
    return Entries(found, prefix)


def sizes_of(state: Entries, settings: Entries) -> tuple[list[int], int, int, int]:
    """Of the hash grid: vertices along an axis that its finest level may have, levels, the exponent of their
    rows, and vertices of its coarsest level."""
    finest, count, log2_rows = (
        int((state if name in state.values else settings).number(name, default))
        for name, default in SIZES.items()
    )
    base = settings.whole("base_res", 1, 1 << 16, USUAL["base_res"])
    if not (1 <= count <= 32 and 1 <= log2_rows <= 26 and base <= finest <= 1 << 20):
        raise FormatError(
            f"a grid of {count} levels of {base} to {finest} vertices and 2^{log2_rows} rows is not read"
        )
    told = "max_res" in state.values or "max_res" in settings.values
    return [finest] if told else [finest, *EARLIER], count, log2_rows, base


def model_settings(config: Any) -> Mapping[str, Any]:
    """The model's part of a run's config.yml, or nothing."""
    for name in ("pipeline", "model"):
        config = config.get(name) if isinstance(config, Mapping) else None
    return config if isinstance(config, Mapping) else {}


def density_of(state: Entries, settings: Entries, marched: bool) -> tuple[float, list[str]]:
    """What densities are multiplied by, and notes. It is 1 where settings do not know it, as of versions
    before that setting, and of models that have none."""
    if any(name.startswith(SEMANTIC) for name in state.values):
        return 1.0, []
    if settings.values:
        scale = settings.number("average_init_density", 1.0)
        if not scale > 0:
            raise FormatError(f"config.yml: 'average_init_density' should be above 0, found {scale:g}")
        return scale, []
    before = marched or not {"mlp_base.model.params", "mlp_base.model.0.hash_table"} & set(state.values)
    scale = 1.0 if before else DENSITY
    shown = "none" if marched else "the mean"
    return scale, [
        "no config.yml lies beside it: its recipe's settings are assumed, densities that begin at "
        f"{scale:g}, contracted space, {shown} of appearance codes"
    ]


def space_of_run(pipeline: dict[str, Any], state: Entries, settings: Entries):
    """A grid of all cells of the space that the field's numbers lie in, the placement (4, 4) of its frame in
    the model's coordinates, and notes."""
    before = "_model.occupancy_grid._binary" in pipeline and "max_res" not in state.values
    if not before and "contraction_type" not in settings.values:
        contracted = not settings.values.get("disable_scene_contraction", False)
        box = np.array([-2.0] * 3 + [2.0] * 3) if contracted else own_box(state)
        cells = OccupancyGrid.full(box, space=contracted_linf if contracted else bounded)
        return cells, np.eye(4), []
    said = settings.values.get("contraction_type", BALL)
    said = said[0] if isinstance(said, list) and len(said) == 1 else said
    box = own_box(state)
    if said == BOX:
        return OccupancyGrid.full(box), np.eye(4), []
    if said != BALL:
        raise FormatError(
            f"config.yml: 'contraction_type' should be {BALL}, of a ball, or {BOX}, of a box, found "
            f"{str(said)[:40]}"
        )
    sides = box[3:] - box[:3]
    if not np.allclose(sides, sides[0]):
        raise FormatError(f"the box in a contracted scene should be a cube, found {box.tolist()}")
    frame = np.diag([*sides / 2, 1])
    frame[:3, 3] = (box[:3] + box[3:]) / 2
    notes = [] if settings.values else ["its space is taken as contracted around a ball, its recipe's"]
    return OccupancyGrid.full(np.array([-2.0] * 3 + [2.0] * 3), space=contracted_l2), frame, notes


def own_box(state: Entries) -> np.ndarray:
    """The box (6,) of a scene that is not contracted."""
    box = state.array("aabb", 2, 3).astype(np.float64).reshape(6)
    if not (box[:3] < box[3:]).all():
        raise FormatError(f"'{FIELD}aabb' should be three minima below three maxima, found {box.tolist()}")
    return box


def codes_of(state: Entries, settings: Entries, marched: bool) -> np.ndarray | None:
    """The code of pictures that is shown: the mean of those that were learnt, or 0, as always before that was
    a setting and in nerfstudio's instant-ngp."""
    names = "embedding_appearance.embedding.weight", "appearance_embedding.embedding.weight"
    if (name := next((name for name in names if name in state.values), None)) is None:
        return None
    codes = state.array(name, None, None).astype(np.float64)
    if not codes.size:
        return None
    averaged = settings.values.get("use_average_appearance_embedding", not settings.values and not marched)
    return codes.mean(0) if averaged else 0 * codes[0]


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
    """The levels of the hash grid, its rows, and the trunk's layers."""
    now = "mlp_base.model.0.hash_table" in state.values
    if not now and "mlp_base_grid.hash_table" not in state.values:
        raise FormatError(
            "its field is another method's of nerfstudio than nerfacto's, which is not read; import one of "
            "nerfacto, instant-ngp or splatfacto"
        )
    table, network = (
        ("mlp_base.model.0.", "mlp_base.model.1.") if now else ("mlp_base_grid.", "mlp_base_mlp.")
    )
    rows = state.array(table + "hash_table", count << log2_rows, None)
    growth = np.exp((np.log(finest) - np.log(base)) / (count - 1)) if count > 1 else 1.0
    # in float32, as there: the finest level of 16 to 2048 has 2047
    scales = torch.floor(base * growth ** torch.arange(count)).tolist()
    levels = [
        {"scale": scale, "side": int(scale) + 1, "rows": 1 << log2_rows, "hashed": True, "offset": 0.0}
        for scale in scales
    ]
    return levels, rows, state.layers(network + "layers.")


def torch_head(state: Entries) -> list[Layer]:
    """The colour network, which reads harmonics of its own kind."""
    (weight, bias), *others = state.layers("mlp_head.layers.")
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


def tcnn_base(state: Entries, settings: Entries, finest: list[int], count: int, log2_rows: int, base: int):
    """See torch_base. Numbers are halves where they are computed with. The outputs are what they are filled
    up to."""
    name = next(name for name in OWN_ARRAYS if name in state.values)
    params = halves(state, name)
    apart = name == OWN_ARRAYS[2]
    table = halves(state, "mlp_base_grid.tcnn_encoding.params") if apart else None
    found = settings.whole("features_per_level", 1, 8, USUAL["features_per_level"])
    tried = [
        (levels, *tried)
        for levels in (tcnn_levels(most, count, log2_rows, base) for most in finest)
        for tried in product(
            dict.fromkeys((found, 1, 2, 4, 8)), (16, 32, 48, 64), widths(settings, "hidden_dim"), (1, *DEPTHS)
        )
    ]
    for levels, features, outputs, neurons, hidden in tried:
        rows = sum(level["rows"] for level in levels)
        shapes = tcnn.shapes_of(count * features, neurons, hidden, outputs, by_of(neurons))
        if tcnn.size_of(shapes) + (0 if apart else rows * features) == len(params) and (
            table is None or len(table) == rows * features
        ):
            layers, rest = tcnn.network_of(params, shapes, count * features, outputs, 1.0 if apart else 0.0)
            return levels, tcnn.rows_of(rest if table is None else table, levels, features), layers
    raise FormatError(
        f"'{FIELD}{name}' has {len(params):,} numbers, which no network over its grid has{unsure(settings)}"
    )


def unsure(settings: Entries) -> str:
    """What to do where no settings say how large networks are."""
    return "" if settings.values else "; put its run's config.yml beside it"


def tcnn_levels(finest: int, count: int, log2_rows: int, base: int) -> list[dict]:
    """Levels that grow from one number of vertices to another."""
    growth = np.exp((np.log(finest) - np.log(base)) / (count - 1)) if count > 1 else 1.0
    return tcnn.levels_of(count, log2_rows, base, tcnn.single(np.log2, np.float32(growth)))


def tcnn_head(state: Entries, settings: Entries, most: int, codes: int) -> tuple[list[Layer], int]:
    """The colour network, whose harmonics are the orthonormal ones, and how many outputs of the trunk's there
    are: as many as it reads, of at most `most`."""
    name = "mlp_head.params" if "mlp_head.params" in state.values else "mlp_head.tcnn_encoding.params"
    params = halves(state, name)
    for outputs, neurons, hidden in product(
        range(most, 1, -1), widths(settings, "hidden_dim_color"), (2, *DEPTHS)
    ):
        read = HARMONICS + outputs - 1 + codes
        shapes = tcnn.shapes_of(read, neurons, hidden, 3, by_of(neurons))
        if tcnn.size_of(shapes) == len(params):
            return tcnn.network_of(params, shapes, read, 3, 1.0)[0], outputs
    raise FormatError(
        f"'{FIELD}{name}' has {len(params):,} numbers, which no network over its features has"
        f"{unsure(settings)}"
    )


def widths(settings: Entries, name: str) -> dict[int, None]:
    """How wide a network may be: as its settings say, or one of those that recipes have."""
    return dict.fromkeys((settings.whole(name, 1, 1024, USUAL[name]), 64, 128, 256, 32, 16))


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


def placement_of(transforms: Any, capture: Capture | None = None) -> tuple[np.ndarray, list[str]]:
    """(4, 4) from the model's coordinates to the capture's, and notes: model = scale (R p + t). p is of the
    world in which the poses were estimated; of poses that A moved and s scaled before a capture's file had
    them, model = scale / s T p' with T A = [R t]."""
    if not isinstance(transforms, Mapping):
        return np.eye(4), ["no dataparser_transforms.json lies beside it: it stays where nerfstudio moved it"]
    entries = Entries(transforms, "dataparser_transforms.json: ")
    matrix, scale = entries.array("transform", 3, 4).astype(np.float64), entries.number("scale")
    tried = [Applied(np.eye(4)[:3], 1.0)] if capture is None else applied_in(capture)
    placements = []
    for applied in tried:
        forward, moved = np.eye(4), np.eye(4)
        forward[:3], moved[:3] = scale / applied.scale * matrix, applied.matrix
        if not all(1e-30 < abs(np.linalg.det(m)) < 1e30 for m in (forward, moved)):
            raise FormatError("dataparser_transforms.json: the transform cannot be undone")
        placements.append(moved @ np.linalg.inv(forward))
    said = "it lies where its capture does: dataparser_transforms.json is undone"
    if capture is None:
        said += "; where its transforms.json has an applied_transform, --cameras undoes that as well"
    if len(placements) > 1:
        said += "; whether its poses were turned before, their middle tells"
    return min(placements, key=lambda placement: off_centre(placement, capture)), [said]


def applied_in(capture: Capture) -> list[Applied]:
    """What nerfstudio may have taken for what was done to the poses of a capture: what its file says, else
    nothing, or since 2023 what its own converter used to do."""
    stated = applied_to(capture) or Applied(None, 1.0)
    if stated.matrix is not None:
        return [stated]
    folder = capture.path if capture.path.is_dir() else capture.path.parent
    converted = [CONVERTED] if (folder / "colmap/sparse/0").is_dir() else []
    return [Applied(matrix, stated.scale) for matrix in (np.eye(4)[:3], *converted)]


def off_centre(placement: np.ndarray, capture: Capture | None) -> float:
    """How far from the middle of the model, where nerfstudio puts it, that of a capture's cameras would
    be."""
    if capture is None:
        return 0.0
    views = capture.train + capture.test
    middle = np.mean([view.camera_to_world[:, 3] for view in views], 0)
    return float(np.linalg.norm((np.linalg.inv(placement) @ [*middle[:3], 1])[:3]))


def up_of(placement: np.ndarray) -> tuple[float, ...]:
    """(3,) which way of the capture is up: +z of the model, by how its cameras were held."""
    up = placement[:3, :3] @ UP_Z
    return tuple((up / np.linalg.norm(up)).round(9).tolist())
