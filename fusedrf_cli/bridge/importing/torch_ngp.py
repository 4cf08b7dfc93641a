"""Checkpoints of torch-ngp (github.com/ashawkey/torch-ngp) with CCNeRF, and of PVD (Fang et al., AAAI 2023),
which is built on it: hash grids, planes and lines, networks, volumes. Its networks may be torch's, or those
of its own fused kernels or of tiny-cuda-nn, which are one array each."""

import itertools
import operator
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from formats.errors import FormatError
from formats.splats.splats import UP_Y, UP_Z
from formats.views import Capture
from fusedrf_cli.bridge.importing import tcnn, tensorf
from fusedrf_cli.bridge.importing.cells import cells_of_bits, cropped, nodes_of
from fusedrf_cli.bridge.importing.nerf import frequencies_of, joined, skipping
from fusedrf_cli.bridge.importing.parts import (
    ColourInput,
    Entries,
    Imported,
    Layer,
    beside,
    colour_network,
    eight,
    parts_field,
    ranks_filled,
    trunk_layers,
)
from fusedrf_cli.engine.fields.box import MAX_TEXELS
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsShape

BASE, FINEST = 16, 2048  # vertices of the coarsest grid, and of the finest for each unit of the bound
LEVELS, FEATURES, LOG2_ROWS = 16, 2, 19  # of the grid of its tiny-cuda-nn version
HARMONICS, OUTPUTS = 16, 16
EXPONENTS = -80.0, 50.0  # as good as none
SAMPLES = 297  # vertices along an axis by which rays are sampled where there are no cells
LIMITS = -2.0, 7.0  # of what PVD exponentiates, by its recipe
AXES = {f"plane_{i}": pair for i, pair in enumerate(((0, 1), (0, 2), (1, 2)))} | {
    f"line_{i}": (2 - i,) for i in range(3)
}
"""Along which each of TensoRF's planes and lines runs."""
LINE_AXES = {f"line_{axis}": (axis,) for axis in range(3)}
"""The same of lines alone."""
FRAME = (
    "it lies in the system's own coordinates, which are the capture's y, z, x, scaled and moved by options "
    "that it does not hold"
)
EMA = "its moving averages (ema) are left out, as the system's own rendering does"
RECIPE = (
    "no args.txt lies beside it: what it exponentiates, and colour features of planes, are taken to be kept "
    "between -2 and 7, as PVD does by default where it distills"
)


def read(checkpoint) -> Imported:
    """The field of a checkpoint of torch-ngp. Raises FormatError."""
    model = Entries(checkpoint.entries).inside("model")
    if "basis_mat.weight" in model.values:
        return planes(checkpoint, model, "waves", EXPONENTS, None)
    if "U_vec_density.0" in model.values:
        return products(checkpoint, model)
    return hashed(checkpoint, model, EXPONENTS)


def read_pvd(checkpoint, capture: Capture | None = None) -> Imported:
    """The field of a checkpoint of PVD; where its capture is given, and its run's settings say how that was
    scaled, where the capture lies. Raises FormatError."""
    model = Entries(checkpoint.entries).inside("model")
    settings = checkpoint.beside.get("args.txt")
    limits, of_colours = limits_of(Entries(settings or {}, "args.txt: "))
    if "encoder.embeddings" in model.values:
        made = hashed(checkpoint, model, limits)
    elif "tensor_volume.0" in model.values:
        made = volume(checkpoint, model, of_planes(settings, limits))
    elif "sigma_mat.0" in model.values:
        made = planes(checkpoint, model, "harmonics", of_planes(settings, limits), of_colours)
    else:
        made = network(checkpoint, model, limits)
    if not settings:
        return replace(made, notes=[*made.notes, RECIPE])
    return made if capture is None or "scale" not in settings else in_capture(made, settings)


def in_capture(made: Imported, settings: dict) -> Imported:
    """A field moved to where its capture's y, z, x are, which PVD's loader makes its own axes and scales.
    Raises FormatError."""
    scale = Entries(settings, "args.txt: ").number("scale")
    if not 1e-6 < scale < 1e6:
        raise FormatError(f"args.txt: 'scale' should be above 0, found {scale:g}")
    back = np.eye(4)
    back[:3, :3] = np.eye(3)[[2, 0, 1]] / scale
    nodes = [replace(node, object_to_world=back @ node.object_to_world) for node in made.nodes]
    said = f"it lies where its capture does: its axes, and its scale of {scale:g} by args.txt, are undone"
    notes = [said if note == FRAME else note for note in made.notes]
    return replace(made, nodes=nodes, notes=notes, up=UP_Z)


def limits_of(settings: Entries) -> tuple[tuple[float, float], tuple[float, float] | None]:
    """Between which PVD keeps what it exponentiates, and the colour features of planes: those of a model that
    was learnt from photos as they are."""
    limits = tuple(
        settings.number(f"sigma_clip_{end}", default)
        for end, default in zip(("min", "max"), LIMITS, strict=True)
    )
    if not limits[0] < limits[1]:
        raise FormatError(f"args.txt: 'sigma_clip_min' should be below 'sigma_clip_max', found {limits}")
    kept = max(limits[0], EXPONENTS[0]), min(limits[1], EXPONENTS[1])
    return kept, None if settings.values.get("just_train_a_model") else limits


def of_planes(settings: dict | None, limits: tuple[float, float]) -> tuple[float, float]:
    """What is exponentiated of planes and volumes: of edited ones as little as there may be."""
    edited = (settings or {}).get("enable_edit_plenoxel")
    return (EXPONENTS[0], limits[1]) if edited else limits


def hashed(checkpoint, model: Entries, limits: tuple[float, float]) -> Imported:
    """A hash grid, a trunk and a colour network."""
    bound, said = bound_of(model), []
    if "encoder.params" in model.values:
        growth = 2 ** (np.log2(FINEST * bound / BASE) / (LEVELS - 1))
        levels = tcnn.levels_of(LEVELS, LOG2_ROWS, BASE, tcnn.single(np.log2, np.float32(growth)))
        rows = tcnn.rows_of(halves(model, "encoder.params"), levels, FEATURES)
    else:
        rows, offsets = model.array("encoder.embeddings", None, None), model.array("encoder.offsets", None)
        levels, said = levels_of(offsets.astype(np.int64), len(rows), bound)
    encoding = {"part": "hash_grid", "features": rows.shape[1], "levels": levels}
    count = len(levels) * rows.shape[1]
    sigma, sections = trunk_layers(layers_of(model, "sigma_net", count, OUTPUTS), eight(count), limits=limits)
    rgb, colours = harmonic_network(model, sigma["outputs"])
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma, rgb)
    values = {"density_rows": rows} | sections | colours
    made = finished(checkpoint, model, shape, cube_of(bound), None, values)
    return replace(made, notes=[*made.notes, *said])


def layers_of(model: Entries, name: str, inputs: int, outputs: int) -> list[Layer]:
    """The layers of a network: torch's, or out of one array, whose size tells how many there are."""
    fused = f"{name}.weights" in model.values
    whole = f"{name}.weights" if fused else f"{name}.params"
    if whole not in model.values:
        return model.layers(f"{name}.")
    params = halves(model, whole)
    for neurons, hidden in itertools.product((64, 128, 32, 16, 256), range(1, 9)):
        shapes = tcnn.shapes_of(inputs, neurons, hidden, outputs, 16)
        if tcnn.size_of(shapes) == len(params):
            # tiny-cuda-nn fills inputs up with 1, the fused kernels' caller with 0
            return tcnn.network_of(params, shapes, inputs, outputs, 0.0 if fused else 1.0)[0]
    raise FormatError(f"'{whole}' has {len(params):,} numbers, which no network of {inputs} inputs has")


def halves(model: Entries, name: str) -> np.ndarray:
    """Numbers as they are computed with."""
    return model.array(name, None).astype(np.float16).astype(np.float32)


def planes(
    checkpoint, model: Entries, seen: str, limits: tuple[float, float], of_colours: tuple[float, float] | None
) -> Imported:
    """Planes and lines, or lines alone, and a colour network of what a matrix makes of them and of the
    direction, `seen` as "harmonics" (PVD) or with "waves" of both (torch-ngp's TensoRF). Between limits are
    kept what is exponentiated, and the features of colours."""
    crossed = "sigma_mat.0" in model.values
    density, resolution, _ = factors(model, "sigma", crossed)
    colour, colour_resolution, ranks = factors(model, "color", crossed)
    if resolution != colour_resolution:
        raise FormatError(f"grids of density and colour are of {resolution} and {colour_resolution} texels")
    basis = model.array("basis_mat.weight", None, sum(ranks))
    layers, count = model.layers("color_net."), len(basis)
    if seen == "harmonics":
        order = ColourInput(count, count, harmonics=True)
        columns = [order.at("direction"), order.at("features")]
    else:
        waves = max(0, (layers[0][0].shape[1] // (count + 3) - 1) // 2)
        order = ColourInput(count, count, waves)
        columns = [
            index
            for which in ("features", "direction")
            for index in (order.at(which), order.waves(which, waves, by_level=True))
        ]
    rgb, sections = colour_network(layers, order, np.concatenate(columns), rows=count)
    filled = ranks_filled(ranks)
    basis = beside(np.split(basis, np.cumsum(ranks)[:-1], 1), filled)
    box, around = with_zeros(box_of(model, "aabb_train"), resolution, cube_of(bound_of(model)))
    resolution = tuple(n + sum(more) for n, more in zip(resolution, around, strict=True))
    axes = AXES if crossed else LINE_AXES
    density, colour = (
        {name: np.pad(made[name], [*(around[axis] for axis in axes[name]), (0, 0)]) for name in made}
        for made in (density, colour)
    )
    values = {f"density_{name}": value for name, value in density.items()} | sections
    values |= {f"colour_{name}": value for name, value in colour.items()} | {"rgb_basis": basis}
    part = "plane_line" if crossed else "line"
    encodings = [{"part": part, "rank": made["line_0"].shape[-1]} for made in (density, colour)]
    sigma = {"part": "density_sum", "activation": "exp", "limits": list(limits)}
    rgb |= {} if of_colours is None else {"limits": list(of_colours)}
    shape = PartsShape(*encodings, sigma, rgb)
    return finished(checkpoint, model, shape, box, resolution, values)


def products(checkpoint, model: Entries) -> Imported:
    """Weighted sums of products of three lines and of three planes (CCNeRF, Tang et al., NeurIPS 2022), for
    the density and for the colours' harmonics. Beside the last texels they fall to 0."""
    if "T_1" in model.values:
        raise FormatError("a scene composed of several objects is not read; import each, and compose them")
    texels = [model.array(f"U_vec_density.{2 - axis}", 1, None, None, 1).shape[2] for axis in range(3)]
    density, weights = factors_of(model, "_density", texels)
    colour, basis = factors_of(model, "", texels)
    coefficients, rest = divmod(len(basis), 3)
    if len(weights) != 1 or rest or coefficients not in (1, 4, 9, 16):
        raise FormatError(
            f"'S_vec_density.0' and 'S_vec.0' should have 1 and 3 times 1, 4, 9 or 16 rows, found "
            f"{len(weights)} and {len(basis)}"
        )
    counts = np.array(texels) + 2
    box, margin = around_cube(box_of(model, "aabb_train"), texels, cube_of(bound_of(model)))
    encodings = [
        {"part": "planes", "features": eight(made["line_0_0"].shape[-1]), "scales": [counts.tolist()],
         "lines": True, "margin": margin}
        for made in (density, colour)
    ]  # fmt: skip
    resolution = np.ceil(counts / (1 - 2 * margin)).clip(2, MAX_TEXELS).astype(int).tolist()
    sigma = {"part": "density_linear", "activation": "exp", "limits": list(EXPONENTS)}
    shape = PartsShape(*encodings, sigma, {"part": "sh_basis", "coefficients": coefficients})
    values = {f"density_{name}": value for name, value in density.items()}
    values |= {f"colour_{name}": value for name, value in colour.items()}
    values |= {"sigma_weights": weights[0], "rgb_basis": basis.reshape(3, coefficients, -1)}
    return finished(checkpoint, model, shape, box, resolution, values)


def around_cube(box: np.ndarray, texels: Sequence[int], cube: np.ndarray) -> tuple[np.ndarray, float]:
    """A box (6,) that a cube (6,) lies in, and the share of its sides that lies outside of texels over
    another box, whose faces are faces of texels, and one more on each side."""
    middle, half = (box[:3] + box[3:]) / 2, (box[3:] - box[:3]) / 2
    half = half * (np.array(texels) + 1) / texels
    wider = max(1.0, float((np.maximum(cube[3:] - middle, middle - cube[:3]) / half).max()))
    margin = min((1 - 1 / wider) / 2, 0.49)
    half = half / (1 - 2 * margin)
    return np.concatenate([middle - half, middle + half]), margin


def factors_of(model: Entries, which: str, texels: Sequence[int]) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Planes and lines by the names of our sections, with a texel of 0 around, and the weights (outputs,
    ranks) of their products: of lines first, whose planes are 1, and then of planes, whose lines are 1."""
    weights, found = {}, {}
    for part in ("vec", "mat"):
        groups = range(sum(str(name).startswith(f"S_{part}{which}.") for name in model.values))
        weights[part] = [model.array(f"S_{part}{which}.{k}", None, None) for k in groups]
        for i, (a, b) in enumerate(((0, 1), (0, 2), (1, 2))):
            shape = (texels[2 - i], 1) if part == "vec" else (texels[b], texels[a])
            names = [f"U_{part}{which}.{3 * k + i}" for k in groups]
            sizes = [weight.shape[1] for weight in weights[part]]
            held = [model.array(name, 1, n, *shape)[0] for name, n in zip(names, sizes, strict=True)]
            found[part, i] = np.concatenate([np.zeros((0, *shape), np.float32), *held])
    every = [*weights["vec"], *weights["mat"]]
    if len({len(weight) for weight in every}) != 1:
        raise FormatError(f"'S_vec{which}.*' and 'S_mat{which}.*' should have as many rows")
    made = {}
    for i in range(3):
        line = np.pad(found["vec", i][..., 0].T, [(1, 1), (0, 0)])
        plane = np.pad(found["mat", i].transpose(2, 1, 0), [(1, 1), (1, 1), (0, 0)])
        ones = [np.ones((*at.shape[:-1], n), np.float32)
                for at, n in ((line, plane.shape[-1]), (plane, line.shape[-1]))]  # fmt: skip
        made[f"line_0_{2 - i}"] = np.concatenate([line, ones[0]], -1)
        made[f"plane_0_{i}"] = np.concatenate([ones[1], plane], -1)
    return made, np.concatenate(every, 1)


def volume(checkpoint, model: Entries, limits: tuple[float, float]) -> Imported:
    """A grid of density and spherical harmonics."""
    grid = model.array("tensor_volume.0", 1, None, None, None, None)[0].transpose(3, 2, 1, 0)
    coefficients, rest = divmod(grid.shape[-1] - 1, 3)
    if rest or coefficients not in (1, 4, 9, 16):
        raise FormatError(
            f"'tensor_volume.0' should have 1 and 3 times 1, 4, 9 or 16 channels, found {grid.shape[-1]}"
        )
    shape = PartsShape(
        {"part": "grid", "numbers": 1}, {"part": "grid", "numbers": 3 * coefficients},
        {"part": "density_sum", "activation": "exp", "limits": list(limits)},
        {"part": "sh", "coefficients": coefficients},
    )  # fmt: skip
    box, around = with_zeros(box_of(model, "aabb_train"), grid.shape[:3], cube_of(bound_of(model)))
    grid = np.pad(grid, [*around, (0, 0)])
    values = {"density_": grid[..., 0], "colour_": grid[..., 1:]}
    return finished(checkpoint, model, shape, box, grid.shape[:3], values)


def network(checkpoint, model: Entries, limits: tuple[float, float]) -> Imported:
    """NeRF's network, in front of the trunk."""
    layers, trunk = model.layers("nerf_mlp."), model.layers("sigma_net.")
    frequencies = frequencies_of(layers[0][0].shape[1])
    # its last layer has no activation, and goes with the trunk's first
    layers = [*layers[:-1], joined(layers[-1], trunk[0]), *trunk[1:]]
    sigma, sections = skipping(layers, frequencies, hidden_first=False)
    sigma |= {"activation": "exp", "limits": list(limits)}
    rgb, colours = harmonic_network(model, sigma["outputs"])
    encoding = {"part": "frequencies", "count": frequencies, "frame": True}
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma, rgb)
    return finished(checkpoint, model, shape, cube_of(bound_of(model)), None, sections | colours)


def finished(
    checkpoint, model: Entries, shape: PartsShape, box: np.ndarray, resolution: Sequence[int] | None,
    values: dict,
) -> Imported:  # fmt: skip
    """The import of a field over a box, in the cells that the file holds occupied; resolution: of its texels,
    None where it has none."""
    bound, of_texels = bound_of(model), resolution is not None
    grids = [OccupancyGrid.full(cube_of(bound))]
    if len(getattr(model.values.get("density_grid"), "shape", ())) == 4:
        raise FormatError(
            "its grid of cells is of torch-ngp of spring 2022, which scaled densities by an option that it "
            "does not hold; train it with a later one"
        )
    if "density_bitfield" in model.values:
        bits = np.unpackbits(model.array("density_bitfield", None).astype(np.uint8), bitorder="little")
        grids = cells_of_bits(bits.astype(bool), bound)
    shown = cropped(grids, box_of(model, "aabb_infer"))
    cells = cropped(shown, box)
    field = parts_field(shape, box, resolution or (SAMPLES,) * 3, values)
    notes = [FRAME, *([EMA] if "ema" in checkpoint.entries else [])]
    if any(str(name).startswith(("bg_net.", "bg_mat")) for name in model.values):
        notes.append("its network of what lies behind the scene (bg_net) is left out")
    if not all(map(operator.is_, shown, grids)):
        notes.append("it is cut to the box that the system's pictures show (aabb_infer)")
    return Imported(nodes_of(field, cells, np.eye(4), of_texels), notes, up=UP_Y)  # the capture's z


def bound_of(model: Entries) -> float:
    """How far out the scene's cube goes: that of the larger of the two boxes that is a cube around 0."""
    boxes = [box_of(model, name) for name in ("aabb_train", "aabb_infer")]
    bounds = [float(box[3]) for box in boxes if np.array_equal(box, cube_of(box[3]))]
    if not bounds:
        found = [box.tolist() for box in boxes]
        raise FormatError(f"'aabb_train' or 'aabb_infer' should be a cube around 0, found {found}")
    return max(bounds)


def with_zeros(
    box: np.ndarray, resolution: Sequence[int], cube: np.ndarray
) -> tuple[np.ndarray, list[tuple[int, int]]]:
    """The box (6,) with as many texels of 0 around as reach the cube (6,) that cells lie in, on each axis and
    side: what lies outside counts as 0 there, and is exponentiated. No more than there are texels."""
    if min(resolution) < 2:
        raise FormatError(f"grids should have 2 texels along an axis at least, found {list(resolution)}")
    texel = (box[3:] - box[:3]) / (np.array(resolution) - 1)
    before, after = (
        np.minimum(np.ceil(np.maximum(more, 0) / texel), resolution).astype(int)
        for more in (box[:3] - cube[:3], cube[3:] - box[3:])
    )
    wider = np.concatenate([box[:3] - before * texel, box[3:] + after * texel])
    return wider, list(zip(before.tolist(), after.tolist(), strict=True))


def cube_of(bound: float) -> np.ndarray:
    """The box (6,) out to ±bound."""
    return np.array([-bound] * 3 + [bound] * 3)


def box_of(model: Entries, name: str) -> np.ndarray:
    """A box (6,) of the file."""
    box = model.array(name, 6).astype(np.float64)
    if not (box[:3] < box[3:]).all():
        raise FormatError(f"'{name}' should be three minima below three maxima, found {box.tolist()}")
    return box


def levels_of(offsets: np.ndarray, rows: int, bound: float) -> tuple[list[dict], list[str]]:
    """The levels of torch-ngp's grid, and what is to be said: how many rows levels have tells how fast they
    grow. Its own networks' finest level has 2048 vertices for each unit of the bound, others' differ."""
    if not 2 <= len(offsets) <= 33 or offsets[0] != 0 or offsets[-1] != rows or (np.diff(offsets) <= 0).any():
        raise FormatError(f"'encoder.offsets' should count up to {rows} rows, found {offsets.tolist()[:40]}")
    held = np.diff(offsets).tolist()
    if levels := grown_to(FINEST * bound, held):
        return levels, []
    others = {n * by for n in (FINEST // 4, FINEST // 2, FINEST, 2 * FINEST, 4 * FINEST) for by in (1, bound)}
    others |= {BASE * 2 ** (len(held) - 1)}  # twice at each level, as before that was an option
    fitting = {finest: levels for finest in sorted(others) if (levels := grown_to(finest, held))}
    if len(fitting) != 1:
        raise FormatError(
            f"'encoder.offsets' should count the rows of a grid of {BASE} to {FINEST * bound:g} vertices "
            f"along an axis, found another's: {offsets.tolist()[:40]}"
        )
    ((finest, levels),) = fitting.items()
    return levels, [f"its grid's finest level is taken to have {finest:g} vertices, as rows of others tell"]


def grown_to(finest: float, held: Sequence[int]) -> list[dict]:
    """Levels with one vertex more along an axis than tiny-cuda-nn's, up to a finest one, of which each holds
    so many rows: of all its vertices, perhaps up to a run of eight, or as many as the largest; none where
    that is not so. Scales are computed in float32, as there: the finest is whole but for rounding."""
    power = 2 ** (np.log2(finest / BASE) / max(len(held) - 1, 1))
    growth, levels = np.float32(np.log2(power)), []
    for level, rows in enumerate(held):
        scale = tcnn.single(np.exp2, np.float32(level) * growth) * np.float32(BASE) - np.float32(1)
        if not scale < tcnn.MOST_VERTICES:
            return []
        side = int(np.ceil(scale)) + 2
        sizes = [n**3 for n in (side, int(np.ceil(BASE * power**level)) + 1)]
        if rows not in (*sizes, *map(eight, sizes)) and not (rows == max(held) and rows < min(sizes)):
            return []
        found = tcnn.hashes(side, rows)
        levels.append({"scale": float(scale), "side": side, "rows": rows, "hashed": found, "offset": 0.5})
    return levels


def harmonic_network(model: Entries, outputs: int) -> tuple[dict, dict[str, np.ndarray]]:
    """A colour network of harmonics and of the trunk's outputs but for the first."""
    order = ColourInput(outputs, outputs, harmonics=True)
    layers = layers_of(model, "color_net", HARMONICS + OUTPUTS - 1, 3)
    features = order.at("features")[1 : 1 + layers[0][0].shape[1] - HARMONICS]
    return colour_network(layers, order, np.concatenate([order.at("direction"), features]))


def factors(
    model: Entries, which: str, crossed: bool
) -> tuple[dict[str, np.ndarray], tuple[int, int, int], list[int]]:
    """Planes and lines, or lines alone, laid out as TensoRF's (tensorf.py), by the names of our sections;
    texels per axis, and ranks."""
    renamed = {
        f"app_{part}.{i}": model.get(f"{which}_{there}.{i}")
        for part, there in (("plane", "mat"), ("line", "vec"))[0 if crossed else 1 :]
        for i in range(3)
    }
    return tensorf.factors(Entries(renamed), "app", crossed)
