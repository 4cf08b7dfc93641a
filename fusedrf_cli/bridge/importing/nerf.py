"""Networks of frequencies: nerf-pytorch's checkpoints (github.com/yenchenlin/nerf-pytorch) and krrish94's
(github.com/krrish94/nerf-pytorch), after NeRF (Mildenhall et al., ECCV 2020)."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.bridge.importing.parts import (
    Y0,
    ColourInput,
    Entries,
    Imported,
    ImportedNode,
    Layer,
    check_layers,
    colour_network,
    eight,
    packed,
    parts_field,
    scattered,
)
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsShape

SAMPLES = 256
"""Vertices along the longest side by which rays are sampled."""


def read(checkpoint, box: np.ndarray) -> Imported:
    """The fine network of a checkpoint of nerf-pytorch, or the only one, in a box (6,). Raises
    FormatError."""
    entries = Entries(checkpoint.entries)
    fine = entries.values.get("network_fine_state_dict") is not None
    state = entries.inside("network_fine_state_dict" if fine else "network_fn_state_dict")
    layers = state.layers("pts_linears.")
    frequencies = frequencies_of(layers[0][0].shape[1])
    if "output_linear.weight" in state.values:
        weight, bias = state.layer("output_linear")
        rows = [3, 0, 1, 2]  # a fifth, where there is one, is unused
        out = weight[rows], None if bias is None else bias[rows]
        sigma, sections = skipping([*layers, out], frequencies, hidden_first=False)
        basis = np.zeros((3, 1, sigma["outputs"]))
        basis[np.arange(3), 0, 1 + np.arange(3)] = 1 / Y0
        rgb, colours = {"part": "sh_basis", "coefficients": 1}, {"rgb_basis": basis}
    else:
        out = stacked(state.layer("alpha_linear"), state.layer("feature_linear"))
        sigma, sections = skipping([*layers, out], frequencies, hidden_first=False)
        order, columns = seen(sigma["outputs"], len(out[0]) - 1, state.layer("views_linears.0"))
        network = [*state.layers("views_linears."), state.layer("rgb_linear")]
        rgb, colours = colour_network(network, order, columns)
    notes = [] if not fine else ["of its coarse and fine networks the fine one is taken"]
    return finished(frequencies, sigma, rgb, sections | colours, box, notes)


def read_krrish(checkpoint, box: np.ndarray) -> Imported:
    """The same of krrish94's, whose features are rectified before the direction joins them."""
    entries = Entries(checkpoint.entries)
    fine = entries.values.get("model_fine_state_dict") is not None
    state = entries.inside("model_fine_state_dict" if fine else "model_coarse_state_dict")
    first, *layers = [state.layer("layer1"), *state.layers("layers_xyz.")]
    frequencies, hidden = frequencies_of(first[0].shape[1]), len(layers[-1][0])
    layers[0] = joined(first, layers[0])  # the first has no activation
    out = stacked(state.layer("fc_alpha"), (np.eye(hidden), None))
    sigma, sections = skipping([*layers, out], frequencies, hidden_first=True)
    features, first = state.layer("fc_feat"), state.layer("layers_dir.0")
    order, columns = seen(
        sigma["outputs"], hidden, (np.zeros((1, first[0].shape[1] - len(features[0]) + hidden)), None)
    )
    directions = len(columns) - hidden
    # A direction e passes a rectified layer as max(0, e) and max(0, -e).
    made, count = np.zeros((len(features[0]) + 2 * directions, len(columns))), len(features[0])
    made[:count, :hidden] = features[0]
    made[count : count + directions, hidden:] = np.eye(directions)
    made[count + directions :, hidden:] = -np.eye(directions)
    bias = np.zeros(len(made))
    bias[:count] = 0 if features[1] is None else features[1]
    second = np.concatenate([first[0], -first[0][:, count:]], 1)
    network = [(made, bias), (second, first[1]), *state.layers("layers_dir.")[1:], state.layer("fc_rgb")]
    rgb, colours = colour_network(network, order, columns)
    notes = [] if not fine else ["of its coarse and fine networks the fine one is taken"]
    return finished(frequencies, sigma, rgb, sections | colours, box, notes)


def finished(
    frequencies: int, sigma: dict, rgb: dict, values: dict, box: np.ndarray, notes: Sequence[str]
) -> Imported:
    """The import of networks in a box."""
    encoding = {"part": "frequencies", "count": frequencies, "frame": True}
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma | {"activation": "relu"}, rgb)
    sides = box[3:] - box[:3]
    resolution = np.maximum(2, np.rint(SAMPLES * sides / sides.max())).astype(int)
    field = parts_field(shape, box, resolution, values, occupancy=OccupancyGrid.full(box))
    return Imported([ImportedNode(field)], notes)


def frequencies_of(inputs: int) -> int:
    """Of an encoding of so many numbers: three, and six for each."""
    count, rest = divmod(inputs - 3, 6)
    if rest or not 0 <= count <= 24:
        raise FormatError(
            f"a network of points should read 3 numbers and 6 for each frequency, found {inputs}"
        )
    return count


def seen(width: int, features: int, layer: Layer) -> tuple[ColourInput, np.ndarray]:
    """The input of a colour network of the trunk's outputs but for the first, and of the direction and its
    sines and cosines, frequency by frequency; as many as its first layer reads."""
    frequencies = frequencies_of(layer[0].shape[1] - features)
    order = ColourInput(1 + features, width, frequencies)
    waves = order.waves("direction", frequencies, by_level=True)
    return order, np.concatenate([order.at("features")[1:], order.at("direction"), waves])


def stacked(*layers: Layer) -> Layer:
    """Layers that read the same, as one."""
    if len(reads := {weight.shape[1] for weight, _ in layers}) > 1:
        raise FormatError(f"layers side by side should read as many numbers, found {sorted(reads)}")
    weights = np.concatenate([weight for weight, _ in layers])
    biases = [np.zeros(len(weight)) if bias is None else bias for weight, bias in layers]
    return weights, np.concatenate(biases)


def joined(first: Layer, second: Layer) -> Layer:
    """Two layers with no activation between them, as one."""
    (inner, inner_bias), (outer, outer_bias) = first, second
    if outer.shape[1] != len(inner):
        raise FormatError(f"a layer should read {len(inner)} numbers, found {outer.shape[1]}")
    outer = outer.astype(np.float64)
    bias = np.zeros(len(outer)) if outer_bias is None else outer_bias
    return outer @ inner, bias + (0 if inner_bias is None else outer @ inner_bias)


def skipping(
    layers: Sequence[Layer], frequencies: int, hidden_first: bool
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The entry and the sections of a trunk of which one layer may read the encoded point again, before or
    behind what the layer before it made."""
    inputs, layers, again = 3 + 6 * frequencies, list(layers), {}
    for i in range(1, len(layers)):
        weight, bias = layers[i]
        made = len(layers[i - 1][0])
        if weight.shape[1] == made + inputs and weight.shape[1] != made:
            if again:
                raise FormatError("more than one layer reads the point again, which is not taken over")
            parts = np.split(weight, [made if hidden_first else inputs], 1)
            own, point = parts if hidden_first else reversed(parts)
            layers[i], again = (own, bias), {i: point}
    hidden, width = check_layers(layers, inputs), eight(inputs)
    entry = {
        "part": "trunk",
        "hidden": hidden,
        "outputs": eight(len(layers[-1][0])),
        "layers": len(layers) - 1,
    }
    sections = {}
    for i, (weight, bias) in enumerate(layers):
        weight = scattered(weight, np.arange(inputs), width) if i == 0 else weight
        sections[f"sigma_layer_{i}"] = packed(weight, bias, width if i == 0 else hidden)
    for i, point in again.items():
        entry["skip"], sections["sigma_again"] = i, point.T
    return entry, sections
