"""K-Planes (Fridovich-Keil et al., CVPR 2023; github.com/sarafridov/K-Planes): hybrid and explicit models, of
scenes that stand still or, at one time, move."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.bridge.importing import tcnn
from fusedrf_cli.bridge.importing.nerfacto import HARMONICS, folded, halves
from fusedrf_cli.bridge.importing.parts import (
    ColourInput,
    Entries,
    Imported,
    ImportedNode,
    Layer,
    colour_network,
    eight,
    packed,
    parts_field,
    scattered,
    trunk_layers,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsShape
from fusedrf_cli.engine.spaces import bounded, contracted_linf, space_of
from fusedrf_cli.errors import UsageProblem

FIELD = "field."
MOST_SAMPLES = 512  # vertices along an axis by which rays are sampled
REACH = 0.7
"""How far around a box the values on its border go on, in its sides: about as far as cameras are followed
that look at it from a few times its size away."""
HIDDEN, BASIS_HIDDEN = 64, 128  # neurons of its networks
GEOMETRY = 15  # features that the density's network makes for the colour
SHIFT = -1.0  # of what is exponentiated
LIMITS = (-80.0, 50.0)


def read(checkpoint, time: float | None = None) -> Imported:
    """The field of a checkpoint; `time`, from -1 to 1, of a scene that moves. Raises FormatError."""
    state = Entries(checkpoint.entries).inside("model")
    settings = settings_of(checkpoint.beside.get("config.py"))
    grids, notes = grids_of(state), []
    moving = len(grids[0]) == 6
    if moving:
        grids = [at_time(planes, time) for planes in grids]
        notes.append(f"it moves, and stands as at time {time:g} of -1 to 1")
    elif time is not None:
        notes.append("its scene stands still: no time is needed")
    box, flipped, placement, space, scale = where(state)
    margin = REACH / (1 + 2 * REACH) if space is bounded and not settings.get("ndc") else 0.0
    if margin:
        notes.append(f"its box is {box.round(4).tolist()}, and around it the values on its border go on")
        reach = REACH * (box[3:] - box[:3])
        box = box + np.concatenate([-reach, reach])
    features, width = grids[0][0].shape[-1], eight(grids[0][0].shape[-1])
    encoding, values = planes_of(grids, width, flipped)
    sigma_net, summed = density_net(state, features, len(grids), settings, notes)
    encoding |= {"summed": summed, "margin": margin}
    columns = np.concatenate([s * width + np.arange(features) for s in range(1 if summed else len(grids))])
    codes = codes_of(state, notes)
    rest = {"activation": activation_of(settings, notes), "limits": list(LIMITS)}
    explicit = FIELD + "color_basis.params" in state.values
    decoders = explicit_decoders if explicit else hybrid_decoders
    sigma, rgb, more = decoders(state, sigma_net, columns, width * (1 if summed else len(grids)), codes, rest)
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma, rgb)
    vertices = np.minimum(np.max(encoding["scales"], 0), MOST_SAMPLES)
    resolution = np.rint((vertices - 1) / (1 - 2 * margin)) + 1
    cells = OccupancyGrid.full(box, space=space)
    field = parts_field(shape, box, resolution, values | more, scale, occupancy=cells)
    if settings.get("ndc"):
        notes.append("its world is that of normalised device coordinates, in which it was trained")
    return Imported([ImportedNode(field, placement)], notes)


def settings_of(config: Any) -> Mapping[str, Any]:
    """What a run's config.py says, or nothing."""
    config = config.get("config") if isinstance(config, Mapping) else None
    return config if isinstance(config, Mapping) else {}


def activation_of(settings: Mapping[str, Any], notes: list[str]) -> str:
    """Of the density."""
    name = settings.get("density_activation", "trunc_exp")
    if name not in ("trunc_exp", "relu"):
        raise FormatError(f"'density_activation' should be trunc_exp or relu, found {str(name)[:40]!r}")
    if "density_activation" not in settings:
        notes.append("no config.py lies beside it: densities are taken to be exponentials (trunc_exp)")
    return "relu" if name == "relu" else "exp"


# -- planes --------------------------------------------------------------------------------------------------


def grids_of(state: Entries) -> list[list[np.ndarray]]:
    """Of each scale, its planes (n_a, n_b, C) of the axes a < b; the fourth is time."""
    grids = []
    while f"{FIELD}grids.{len(grids)}.0" in state.values:
        name = f"{FIELD}grids.{len(grids)}."
        planes = 6 if name + "3" in state.values else 3
        found = [state.array(f"{name}{m}", 1, None, None, None)[0].transpose(2, 1, 0) for m in range(planes)]
        for pair, plane in zip(pairs_of(found), found, strict=True):
            expected = (*(counts_of(found)[axis] for axis in pair), found[0].shape[2])
            if plane.shape != expected:
                raise FormatError(f"planes '{name}*' should fit each other, found {plane.shape}")
        grids.append(found)
    if not grids:
        raise FormatError(f"'{FIELD}grids.0.0' is missing")
    if len({(len(planes), planes[0].shape[2]) for planes in grids}) > 1:
        raise FormatError(f"'{FIELD}grids' should have as many planes and features at each scale")
    return grids


def pairs_of(planes: Sequence[np.ndarray]) -> list[tuple[int, int]]:
    """The axes of each plane of a scale."""
    return list(itertools.combinations(range(4 if len(planes) == 6 else 3), 2))


def counts_of(planes: Sequence[np.ndarray]) -> dict[int, int]:
    """Texels along each axis of a scale."""
    counts: dict[int, int] = {}
    for pair, plane in zip(pairs_of(planes), planes, strict=True):
        for axis, count in zip(pair, plane.shape, strict=False):
            counts.setdefault(axis, count)
    return counts


def at_time(planes: Sequence[np.ndarray], time: float | None) -> list[np.ndarray]:
    """The three planes of a scale, and for each axis the line (n, C) that its plane with time is then."""
    if time is None or not -1 <= time <= 1:
        found = "none" if time is None else f"{time:g}"
        raise UsageProblem(f"the scene moves: a time from -1 to 1 (--time) should be given, found {found}")
    still, lines = [], []
    for (_, b), plane in zip(pairs_of(planes), planes, strict=True):
        if b < 3:
            still.append(plane)
            continue
        at = (time + 1) / 2 * (plane.shape[1] - 1)
        i = min(int(at), max(plane.shape[1] - 2, 0))
        after = plane[:, min(i + 1, plane.shape[1] - 1)].astype(np.float64)
        lines.append((1 - (at - i)) * plane[:, i] + (at - i) * after)
    return still + lines


def planes_of(
    grids: Sequence[Sequence[np.ndarray]], width: int, flipped: np.ndarray
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The entry and the sections of planes and lines; `flipped` are axes (3,) that run the other way."""
    values, scales = {}, []
    for s, factors in enumerate(grids):
        axes_of = [(0, 1), (0, 2), (1, 2), (0,), (1,), (2,)]
        for m, (factor, axes) in enumerate(zip(factors, axes_of, strict=False)):
            for dimension, axis in enumerate(axes):
                factor = np.flip(factor, dimension) if flipped[axis] else factor
                factor = np.repeat(factor, 2, dimension) if factor.shape[dimension] == 1 else factor
            values[f"density_plane_{s}_{m}" if m < 3 else f"density_line_{s}_{m - 3}"] = factor
        scales.append([max(2, n) for n in (*factors[0].shape[:2], factors[1].shape[1])])
    lines = len(grids[0]) == 6
    return {"part": "planes", "features": width, "scales": scales, "lines": lines}, values


def where(state: Entries):
    """The box (6,), which axes (3,) run the other way in it, where it lies, its space, and what densities are
    to be multiplied by."""
    name = FIELD + "spatial_distortion.global_"
    if name + "scale" not in state.values:
        corners = state.array(FIELD + "aabb", 2, 3).astype(np.float64)
        if (corners[0] == corners[1]).any():
            raise FormatError(f"'{FIELD}aabb' should be two corners of a box, found {corners.tolist()}")
        box = np.concatenate([corners.min(0), corners.max(0)])
        return box, corners[0] > corners[1], np.eye(4), bounded, 1.0
    scale = state.array(name + "scale", 3).astype(np.float64)
    moved = state.array(name + "translation", 3).astype(np.float64)
    if not (scale > 0).all() or scale.max() > 100 * scale.min():
        raise FormatError(f"'{name}scale' should be three numbers above 0, found {scale.tolist()}")
    mean = float(np.prod(scale) ** (1 / 3))
    placement = np.diag([1 / mean] * 3 + [1.0])
    placement[:3, 3] = -moved / scale
    stretch = () if np.ptp(scale) == 0 else zip("xyz", scale / mean, strict=True)
    space = space_of(contracted_linf, **{f"stretch_{axis}": float(share) for axis, share in stretch})
    return np.array([-2.0] * 3 + [2.0] * 3), np.zeros(3, bool), placement, space, 1 / mean


# -- networks ------------------------------------------------------------------------------------------------


def density_net(
    state: Entries, features: int, scales: int, settings: Mapping[str, Any], notes: list[str]
) -> tuple[list[Layer], bool]:
    """The layers of sigma_net, and whether it reads the sum of the scales' features, not all of them."""
    params = halves(state, FIELD + "sigma_net.params")
    explicit = FIELD + "color_basis.params" in state.values
    fitting = []
    for summed in (False, True):
        inputs = features if summed else features * scales
        if explicit:
            shapes = tcnn.shapes_of(inputs, BASIS_HIDDEN, 0, 1, tcnn.PADDED["CutlassMLP"])
        else:
            shapes = tcnn.shapes_of(inputs, HIDDEN, 1, GEOMETRY + 1, tcnn.PADDED["FullyFusedMLP"])
        if tcnn.size_of(shapes) == len(params) and explicit:
            matrix = params.reshape(shapes[0])[:1]
            fitting.append(([(matrix[:, :inputs], matrix[:, inputs:].sum(1))], summed))
        elif tcnn.size_of(shapes) == len(params):
            fitting.append((tcnn.network_of(params, shapes, inputs, GEOMETRY + 1, 1.0)[0], summed))
    if not fitting:
        raise FormatError(
            f"'{FIELD}sigma_net.params' has {len(params):,} numbers, which no network of {features} features "
            f"at {scales} scales does"
        )
    if len(fitting) > 1 and scales > 1 and "concat_features_across_scales" not in settings:
        notes.append(
            "no config.py lies beside it: its network is taken to read the features of all scales beside "
            "each other, as its recipes have it, and not their sum"
        )
    concatenated = settings.get("concat_features_across_scales", not fitting[0][1])
    return next((found for found in fitting if found[1] != concatenated), fitting[0])


def codes_of(state: Entries, notes: list[str]) -> np.ndarray | None:
    """The mean of the codes of pictures."""
    name = FIELD + "appearance_embedding.weight"
    if name not in state.values:
        return None
    notes.append("its appearance codes are fixed to their mean")
    codes = state.array(name, None, None).astype(np.float64)
    if not codes.size:
        raise FormatError(f"'{name}' should hold codes, found none")
    return codes.mean(0)


def hybrid_decoders(state, sigma_net, columns, width, codes, rest):
    """The entries of sigma and rgb, and their sections, of networks for density and colour."""
    (first, bias), (weight, last) = sigma_net
    last = np.zeros(len(weight)) if last is None else last
    order = [GEOMETRY, *range(GEOMETRY)]  # the density's comes last there
    weight, last = weight[order], last[order]
    last[0] += SHIFT * (rest["activation"] == "exp")
    limits = tuple(rest["limits"])
    sigma, sections = trunk_layers(
        [(first, bias), (weight, last)], width, columns, rest["activation"], limits
    )
    read = HARMONICS + GEOMETRY + (0 if codes is None else len(codes))
    params = halves(state, FIELD + "color_net.params")
    shapes = tcnn.shapes_of(read, HIDDEN, 2, 3, tcnn.PADDED["FullyFusedMLP"])
    if tcnn.size_of(shapes) != len(params):
        raise FormatError(f"'{FIELD}color_net.params' has {len(params):,} numbers, which its sizes do not")
    network = tcnn.network_of(params, shapes, read, 3, 1.0)[0]
    order = ColourInput(GEOMETRY + 1, sigma["outputs"], harmonics=True)
    rows = np.concatenate([order.at("direction"), order.at("features")[1:]])
    rgb, more = colour_network(folded(network, codes, HARMONICS + GEOMETRY), order, rows)
    return sigma, rgb, sections | more


def explicit_decoders(state, sigma_net, columns, width, codes, rest):
    """The same of a density that is linear in the features, and a learnt basis of directions."""
    ((weight, bias),) = sigma_net
    shift = float(bias[0]) + SHIFT * (rest["activation"] == "exp")
    weights = np.append(scattered(weight, columns, width)[0], shift)
    read, count = 3 + (0 if codes is None else len(codes)), len(columns)
    params = halves(state, FIELD + "color_basis.params")
    for layers in range(1, 9):
        shapes = tcnn.shapes_of(read, BASIS_HIDDEN, layers, 3 * count, tcnn.PADDED["FullyFusedMLP"])
        if tcnn.size_of(shapes) >= len(params):
            break
    if tcnn.size_of(shapes) != len(params):
        raise FormatError(f"'{FIELD}color_basis.params' has {len(params):,} numbers, which its sizes do not")
    network = folded(tcnn.network_of(params, shapes, read, 3 * count, 1.0)[0], codes, 3)
    last = np.zeros((3, width, BASIS_HIDDEN))
    last[:, columns] = network[-1][0].reshape(3, count, BASIS_HIDDEN)
    network[-1] = last.reshape(3 * width, BASIS_HIDDEN), None
    sections = {
        f"rgb_layer_{i}": packed(matrix, bias, BASIS_HIDDEN if i else 3)
        for i, (matrix, bias) in enumerate(network)
    }
    rgb = {"part": "direction_basis", "hidden": BASIS_HIDDEN, "layers": layers}
    return {"part": "density_linear"} | rest, rgb, {"sigma_weights": weights} | sections
