"""Networks after NeRF (Mildenhall et al., ECCV 2020): checkpoints of nerf-pytorch
(github.com/yenchenlin/nerf-pytorch), of krrish94's (github.com/krrish94/nerf-pytorch), and of HashNeRF
(github.com/yashbhalgat/HashNeRF-pytorch)."""

import re
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from formats.errors import FormatError
from fusedrf_cli.bridge.importing.parts import (
    LLFF,
    Y0,
    ColourInput,
    Entries,
    Imported,
    ImportedNode,
    Layer,
    check_layers,
    colour_network,
    eight,
    packed_layers,
    parts_field,
    trunk_layers,
)
from fusedrf_cli.engine.decoders.sh_mlp import HARMONICS
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsShape

SAMPLES = 256
"""Vertices along the longest side by which rays are sampled."""
BASE, FINEST = 16, 512  # vertices of HashNeRF's coarsest grid, and of the finest where nothing is said
FIRST_PRIMES = 73856093, 19349663, 83492791
MOST_LEVELS = 32
FINE = "of its coarse and fine networks the fine one is taken"
NDC = (
    "its frame is that of the normalised device coordinates that it was trained in; its colours read the "
    "world's directions, and are given those of its frame"
)


def read(checkpoint, box: np.ndarray) -> Imported:
    """The fine network of a checkpoint of nerf-pytorch, or the only one, in a box (6,). Raises
    FormatError."""
    state, notes = network_of(checkpoint, "network_fn_state_dict", "network_fine_state_dict")
    check_biases(state)
    kind = checkpoint.beside.get("args.txt", {}).get("i_embed", 0)
    if kind not in (0, -1):
        raise FormatError(
            f"args.txt beside it says 'i_embed = {str(kind)[:20]}', an encoding that is not read; train it "
            "with 0 or -1"
        )
    layers = state.layers("pts_linears.")
    encoding = encoding_of(layers[0][0].shape[1])
    if "output_linear.weight" in state.values:
        sigma, rgb, sections = without_directions(layers, state.layer("output_linear"), encoding, False)
        return finished(encoding, sigma, rgb, sections, box, notes)
    out = stacked(state.layer("alpha_linear"), state.layer("feature_linear"))
    network = [*state.layers("views_linears."), state.layer("rgb_linear")]
    return finished(encoding, *with_directions([*layers, out], network, encoding), box, notes)


def read_krrish(checkpoint, box: np.ndarray) -> Imported:
    """The same of krrish94's, whose features are rectified before the direction joins them, and whose
    encodings may leave out the point and the direction themselves."""
    check_sampling(checkpoint)
    state, notes = network_of(checkpoint, "model_coarse_state_dict", "model_fine_state_dict")
    check_biases(state)
    if "layer1.weight" not in state.values:
        return finished(*paper(state), box, notes)
    if "layers_xyz.0.weight" not in state.values:
        raise FormatError(
            "its network is neither a FlexibleNeRFModel nor a PaperNeRFModel, which are read; train it with "
            "'type: FlexibleNeRFModel'"
        )
    first, layers = state.layer("layer1"), state.layers("layers_xyz.")
    inputs, hidden = first[0].shape[1], len(layers[-1][0])
    layers[0] = joined(first, layers[0])  # the first has no activation
    if inputs and inputs % 6 == 0:
        layers, inputs = with_point(layers, inputs), inputs + 3
    encoding = encoding_of(inputs)
    if "fc_out.weight" in state.values:
        sigma, rgb, sections = without_directions(layers, state.layer("fc_out"), encoding, True)
        return finished(encoding, sigma, rgb, sections, box, notes)
    out = stacked(state.layer("fc_alpha"), (np.eye(hidden), None))
    sigma, sections = skipping([*layers, out], encoding["count"], hidden_first=True)
    feature, (first, *others) = state.layer("fc_feat"), state.layers("layers_dir.")
    directions = first[0].shape[1] - len(feature[0])
    order, columns = seen(sigma["outputs"], hidden, directions)
    network = [*passing(feature, first, hidden, directions), *others, state.layer("fc_rgb")]
    columns = np.concatenate([order.at("features")[1:], columns])
    rgb, colours = colour_network(network, order, columns)
    return finished(encoding, sigma, rgb, sections | colours, box, notes)


def paper(state: Entries) -> tuple[dict, dict, dict, dict[str, np.ndarray]]:
    """The entries of encoding, sigma and rgb of a PaperNeRFModel, and its sections: the density is made of
    the features, which have no activation, and the last of its layers of colours is not used."""
    layers, feature = state.layers("layers_xyz."), state.layer("fc_feat")
    inputs = layers[0][0].shape[1]
    if inputs and inputs % 6 == 0:
        layers, inputs = with_point(layers, inputs, hidden_first=False), inputs + 3
    out = stacked(joined(feature, state.layer("fc_alpha")), feature)
    network, encoding = [*state.layers("layers_dir.")[:3], state.layer("fc_rgb")], encoding_of(inputs)
    return encoding, *with_directions([*layers, out], network, encoding)


def passing(feature: Layer, first: Layer, hidden: int, directions: int) -> list[Layer]:
    """A rectified layer of features that a direction, so many numbers e behind `hidden` others, passes as
    max(0, e) and max(0, -e), and the layer that reads both."""
    (weight, bias), (reading, own) = feature, first
    count = len(weight)
    check_layers([feature, (reading[:, :count], own)], hidden)
    made = np.zeros((count + 2 * directions, hidden + directions))
    made[:count, :hidden] = weight
    made[count:, hidden:] = np.concatenate([np.eye(directions), -np.eye(directions)])
    bias = np.concatenate([np.zeros(count) if bias is None else bias, np.zeros(2 * directions)])
    return [(made, bias), (np.concatenate([reading, -reading[:, count:]], 1), own)]


def read_hashed(checkpoint, box: np.ndarray) -> Imported:
    """The same of HashNeRF's small networks, which read a hash grid over the box."""
    state, notes = network_of(checkpoint, "network_fn_state_dict", "network_fine_state_dict")
    tables = Entries(checkpoint.entries).inside("embed_fn_state_dict")
    if len(tables.values) > MOST_LEVELS:
        raise FormatError(f"hash grids of up to {MOST_LEVELS} levels are read, found {len(tables.values)}")
    names = [f"embeddings.{level}.weight" for level in range(max(len(tables.values), 1))]
    first = tables.array(names[0], None, None)
    check_hash(first)
    rows = np.concatenate([tables.array(name, *first.shape) for name in names])
    settings = Entries(checkpoint.beside.get("args.txt", {}))
    finest = settings.whole("finest_res", 1, 1 << 20, FINEST)
    if "finest_res" not in settings.values:
        notes.append(f"nothing beside it says its 'finest_res', for which {FINEST} is taken")
    if np.array_equal(box, hashed_box(checkpoint)):
        notes.append("its box is that of args.txt, which has four digits; --aabb takes one with more")
    levels = hashed_levels(len(names), len(first), finest)
    encoding = {"part": "hash_grid", "features": first.shape[1], "levels": levels}
    trunk = state.layers("sigma_net.")
    sigma, sections = trunk_layers(trunk, eight(len(names) * first.shape[1]), activation="relu")
    network, count = state.layers("color_net."), len(trunk[-1][0]) - 1
    order, columns = seen(sigma["outputs"], count, network[0][0].shape[1] - count)
    columns = np.concatenate([columns, order.at("features")[1:]])
    rgb, colours = colour_network(network, order, columns)
    return finished(encoding, sigma, rgb, {"density_rows": rows} | sections | colours, box, notes)


def hashed_levels(count: int, rows: int, finest: int) -> list[dict[str, Any]]:
    """The levels of HashNeRF's grid, whose vertices are hashed on all of them. Their numbers are computed in
    float32, as there: the finest may have one less than was asked for."""
    base, last = torch.tensor(BASE), torch.tensor(finest)
    growth = torch.exp((torch.log(last) - torch.log(base)) / max(count - 1, 1))
    sides = [int(torch.floor(base * growth**level)) for level in range(count)]
    return [
        {"scale": float(side), "side": side + 2, "rows": rows, "hashed": True, "offset": 0.0}
        for side in sides
    ]


def check_hash(rows: np.ndarray) -> None:
    """Raise FormatError where the rows (R, features) of the coarsest level that have learnt are those that
    HashNeRF's first hash finds, and not those of the later one: others are at most 1e-4, as they began."""
    if not rows.size:
        raise FormatError("'embeddings.0.weight' should hold rows of numbers, found none")
    vertices = np.indices((BASE + 1,) * 3).reshape(3, -1)
    learnt = np.flatnonzero(np.abs(rows).max(1) > 1.0001e-4)
    now, first = (
        np.isin(learnt, np.bitwise_xor.reduce(vertices * np.array(primes)[:, None], 0) % len(rows)).all()
        for primes in ((1, 2654435761, 805459861), FIRST_PRIMES)
    )
    if first and not now:
        raise FormatError(
            f"its rows are those of HashNeRF's first hash {FIRST_PRIMES}, which is not read; train it with "
            "HashNeRF as it is published"
        )


def hashed_box(checkpoint) -> np.ndarray | None:
    """The box (6,) of HashNeRF's grid that its run's settings state, with four digits."""
    stated = str(checkpoint.beside.get("args.txt", {}).get("bounding_box"))
    numbers = re.findall(r"-?\d+\.?\d*(?:e[-+]\d+)?", " ".join(re.findall(r"tensor\(\[([^]]*)\]", stated)))
    return np.array(numbers, np.float64) if len(numbers) == 6 else None


# -- what they have in common --------------------------------------------------------------------------------


def network_of(checkpoint, coarse: str, fine: str) -> tuple[Entries, list[str]]:
    """The state of the fine network, or of the only one, and what is to be said of it."""
    entries = Entries(checkpoint.entries)
    notes = [FINE] if entries.values.get(fine) else []
    notes += [NDC] if in_ndc(checkpoint) else [LLFF] if of_llff(checkpoint) else []
    return entries.inside(fine if entries.values.get(fine) else coarse), notes


def in_ndc(checkpoint) -> bool:
    """Whether the settings beside a checkpoint say that it was trained in normalised device coordinates."""
    return without_ndc(checkpoint) is False


def of_llff(checkpoint) -> bool:
    """Whether they say that it was trained on an LLFF capture as its loader moved and scaled it."""
    return without_ndc(checkpoint) is True


def without_ndc(checkpoint) -> bool | None:
    """What the settings beside a checkpoint of an LLFF capture have as no_ndc; None of others."""
    args = checkpoint.beside.get("args.txt", {})
    dataset = checkpoint.beside.get("config.yml", {}).get("dataset")
    said = dataset if isinstance(dataset, dict) else args
    kind = said.get("type", "llff") if said is dataset else said.get("dataset_type", "llff")
    return said.get("no_ndc") if str(kind).lower() == "llff" else None


def check_biases(state: Entries) -> None:
    """Raise FormatError where a layer has no bias."""
    for name in state.values:
        if str(name).endswith(".weight"):
            state.get(f"{str(name).removesuffix('weight')}bias")


def check_sampling(checkpoint) -> None:
    """Refuse encodings by evenly spaced frequencies, which only the settings of krrish94's runs tell."""
    models = checkpoint.beside.get("config.yml", {}).get("models")
    model = models.get("coarse") if isinstance(models, dict) else None
    for name in ("xyz", "dir") if isinstance(model, dict) else ():
        count = model.get(f"num_encoding_fn_{name}", 3)
        if model.get(f"log_sampling_{name}") is False and not (isinstance(count, int) and count < 3):
            raise FormatError(
                f"config.yml beside it says 'log_sampling_{name}: false', and frequencies that are evenly "
                "spaced are not taken over; train it with 'true'"
            )


def with_directions(
    layers: Sequence[Layer], network: Sequence[Layer], encoding: dict[str, Any]
) -> tuple[dict, dict, dict[str, np.ndarray]]:
    """The entries and the sections of a trunk that makes the density and features, in this order, and of a
    colour network that reads these and the direction."""
    sigma, sections = skipping(layers, encoding["count"], hidden_first=False)
    count = len(layers[-1][0]) - 1
    order, columns = seen(sigma["outputs"], count, network[0][0].shape[1] - count)
    columns = np.concatenate([order.at("features")[1:], columns])
    rgb, colours = colour_network(network, order, columns)
    return sigma, rgb, sections | colours


def without_directions(
    layers: Sequence[Layer], out: Layer, encoding: dict[str, Any], hidden_first: bool
) -> tuple[dict, dict, dict[str, np.ndarray]]:
    """The entries and the sections of a trunk that makes three logits and the density, in this order."""
    weight, bias = out
    if len(weight) not in (4, 5):
        raise FormatError(f"a network without directions should make 4 or 5 numbers, found {len(weight)}")
    rows = [3, 0, 1, 2]  # a fifth, where there is one, is unused
    out = weight[rows], None if bias is None else bias[rows]
    sigma, sections = skipping([*layers, out], encoding["count"], hidden_first)
    basis = np.zeros((3, 1, sigma["outputs"]))
    basis[np.arange(3), 0, 1 + np.arange(3)] = 1 / Y0
    return sigma, {"part": "sh_basis", "coefficients": 1}, sections | {"rgb_basis": basis}


def finished(
    encoding: dict[str, Any], sigma: dict, rgb: dict, values: dict, box: np.ndarray, notes: Sequence[str]
) -> Imported:
    """The import of networks in a box."""
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma | {"activation": "relu"}, rgb)
    sides = box[3:] - box[:3]
    resolution = np.maximum(2, np.rint(SAMPLES * sides / sides.max())).astype(int)
    field = parts_field(shape, box, resolution, values, occupancy=OccupancyGrid.full(box))
    return Imported([ImportedNode(field)], notes)


def encoding_of(inputs: int) -> dict[str, Any]:
    """The entry of an encoding of the point by so many numbers."""
    return {"part": "frequencies", "count": frequencies_of(inputs), "frame": True}


def frequencies_of(inputs: int) -> int:
    """Of an encoding of so many numbers: three, and six for each."""
    count, rest = divmod(inputs - 3, 6)
    if rest or not 0 <= count <= 24:
        raise FormatError(
            "a network should read 3 numbers of a point or of a direction, and 6 for each frequency, found "
            f"{inputs}"
        )
    return count


def seen(width: int, features: int, directions: int) -> tuple[ColourInput, np.ndarray]:
    """The input of a colour network of the trunk's outputs, a number and then features, and where in it the
    so many numbers of the direction lie: none, harmonics, or itself, which may be left out, and its sines and
    cosines, frequency by frequency."""
    if directions == HARMONICS:
        order = ColourInput(1 + features, width, harmonics=True)
        return order, order.at("direction")
    bare = directions % 6 == 0
    frequencies = frequencies_of(directions + 3 * bare)
    order = ColourInput(1 + features, width, frequencies, alone=True)
    waves = order.waves("direction", frequencies, by_level=True)
    return order, waves if bare else np.concatenate([order.at("direction"), waves])


def with_point(layers: Sequence[Layer], inputs: int, hidden_first: bool = True) -> list[Layer]:
    """Layers that read the sines and cosines of a point, behind or before what the layer before made, as ones
    that read it itself before them."""
    widened = []
    for i, (weight, bias) in enumerate(layers):
        made = len(layers[i - 1][0]) if i else 0
        at, reads = made * hidden_first, weight.shape[1] == made + inputs
        widened.append((np.insert(weight, [at] * 3, 0, 1) if reads else weight, bias))
    return widened


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
    """The entry and the sections of a trunk of which layers may read the encoded point again, before or
    behind what the layer before them made."""
    inputs, layers, again = 3 + 6 * frequencies, list(layers), {}
    widths = [len(weight) for weight, _ in layers]
    for i in range(1, len(layers)):
        weight, bias = layers[i]
        if weight.shape[1] == widths[i - 1] + inputs:
            parts = np.split(weight, [widths[i - 1] if hidden_first else inputs], 1)
            own, again[i] = parts if hidden_first else reversed(parts)
            layers[i] = own, bias
    if len(again) > 1:
        carry(layers, again, inputs)
    hidden, width = check_layers(layers, inputs), eight(inputs)
    entry = {
        "part": "trunk",
        "hidden": hidden,
        "outputs": eight(len(layers[-1][0])),
        "layers": len(layers) - 1,
    }
    sections = packed_layers("sigma", layers, np.arange(inputs), width, hidden)
    for i, point in again.items():
        entry["skip"], sections["sigma_again"] = i, point.T
    return entry, sections


def carry(layers: list[Layer], again: dict[int, np.ndarray], inputs: int) -> None:
    """Make only the first of the layers that read the encoded point `again` do so: from it to the last, units
    more hand on max(0, x) and max(0, -x) of each of its numbers x."""
    both = np.concatenate([np.eye(inputs), -np.eye(inputs)])
    first, last = min(again), max(again)
    for i in range(first, last + 1):
        weight, bias = layers[i]
        bias = np.zeros(len(weight)) if bias is None else bias
        if i > first:
            came = again.pop(i) @ both.T if i in again else np.zeros((len(weight), 2 * inputs))
            weight = np.concatenate([weight, came], 1)
        if i < last:
            handed = np.eye(2 * inputs, weight.shape[1], weight.shape[1] - 2 * inputs) * (i > first)
            weight = np.concatenate([weight, handed])
            bias = np.concatenate([bias, np.zeros(2 * inputs)])
        layers[i] = weight, bias
    again[first] = np.concatenate([again[first], both])
