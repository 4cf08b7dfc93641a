"""Networks of Flax as D²NeRF (Wu et al., NeurIPS 2022; github.com/ChikaYan/d2nerf) stores them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.bridge.importing.nerf import stacked
from fusedrf_cli.bridge.importing.parts import (
    ColourInput,
    Entries,
    Layer,
    check_layers,
    colour_network,
    packed,
    scattered,
)


@dataclass(frozen=True)
class Columns:
    """Where the inputs (N,) of a network lie among our features, and what each is to be multiplied by. The
    inputs behind them are `constants`."""

    at: np.ndarray
    factors: np.ndarray
    constants: np.ndarray


@dataclass(frozen=True)
class Trunk:
    """Rectified layers, of which the first reads our features, and the weights by which others read them
    again."""

    layers: list[Layer]
    again: dict[int, np.ndarray]


def layer_of(place: Entries, name: str) -> Layer:
    """A dense layer, whose kernel is (inputs, outputs)."""
    layer = place.inside(name)
    kernel = layer.array("kernel", None, None)
    return kernel.T, layer.array("bias", kernel.shape[1]) if "bias" in layer.values else None


def layers_of(place: Entries, prefix: str = "hidden_") -> list[Layer]:
    """The hidden layers whose names begin so."""
    found: list[Layer] = []
    while f"{prefix}{len(found)}" in place.values:
        found.append(layer_of(place, f"{prefix}{len(found)}"))
    if not found:
        raise FormatError(f"{place.where}'{prefix}0' is missing")
    return found


def frequencies_of(inputs: int) -> tuple[int, bool]:
    """Of an encoding of so many numbers, and whether the point itself comes first."""
    count, rest = divmod(inputs, 6)
    if rest not in (0, 3) or not 0 <= count <= 24:
        raise FormatError(
            f"a network of points should read 6 numbers a frequency, and 3 more or none, found {inputs}"
        )
    return count, rest == 3


def columns_of(start: int, count: int, identity: bool, window: np.ndarray, constants=()) -> Columns:
    """Of a point's frequencies among our features, from `start` on."""
    at = np.arange(0 if identity else 3, 3 + 6 * count)
    factors = np.concatenate([np.ones(3 * identity), np.repeat(window, 6)])
    return Columns(start + at, factors, np.asarray(constants, np.float64))


def trunk_of(layers: Sequence[Layer], columns: Columns, width: int) -> Trunk:
    """The layers over `width` features. One that reads the input again does so behind what the layer before
    it made."""
    inputs, made, again = len(columns.at) + len(columns.constants), [], {}
    for i, (weight, bias) in enumerate(layers):
        bias = np.zeros(len(weight)) if bias is None else bias.astype(np.float64)
        before = len(layers[i - 1][0]) if i else 0
        if weight.shape[1] not in (before, before + inputs)[i == 0 :]:
            raise FormatError(
                f"layer {i} of a network should read {before or inputs} numbers, found {weight.shape[1]}"
            )
        read = weight[:, before:].astype(np.float64)
        if read.shape[1]:
            bias = bias + read[:, len(columns.at) :] @ columns.constants
            read = scattered(read[:, : len(columns.at)] * columns.factors, columns.at, width)
            again |= {i: read} if i else {}
        made.append((weight[:, :before] if i else read, bias))
    if len(again) > 1:
        raise FormatError("more than one layer reads the point again, which is not taken over")
    return Trunk(made, again)


def sections_of(prefix: str, trunk: Trunk, last: Layer) -> tuple[dict[str, int], dict[str, np.ndarray]]:
    """The options hidden, layers and skip of a network with a last layer, and its sections."""
    layers = [*trunk.layers, last]
    width = layers[0][0].shape[1]
    hidden = check_layers(layers, width)
    sections = {
        f"{prefix}layer_{i}": packed(weight, bias, hidden if i else width)
        for i, (weight, bias) in enumerate(layers)
    }
    for weight in trunk.again.values():
        sections[f"{prefix}again"] = weight.T
    return {"hidden": hidden, "layers": len(layers) - 1, "skip": next(iter(trunk.again), 0)}, sections


def side_by_side(first: Trunk, second: Trunk) -> Trunk:
    """Two trunks over the same features as one. A rectified layer may be passed on unchanged."""
    if first.again and second.again and first.again.keys() != second.again.keys():
        raise FormatError("the networks of shadow and static scene read the point again in different layers")
    layers, again = [], {}
    for i in range(max(len(first.layers), len(second.layers))):
        pair = [passed_on(trunk, i) for trunk in (first, second)]
        blocks = [np.concatenate([weight for weight, _ in pair])] if i == 0 else [w for w, _ in pair]
        layers.append((diagonal(*blocks), np.concatenate([bias for _, bias in pair])))
        if i in first.again or i in second.again:
            width = layers[0][0].shape[1]
            both = zip((first, second), pair, strict=True)
            again[i] = np.concatenate([t.again.get(i, np.zeros((len(w), width))) for t, (w, _) in both])
    return Trunk(layers, again)


def passed_on(trunk: Trunk, i: int) -> Layer:
    """A layer of a trunk, or behind the last one that hands it on."""
    count = len(trunk.layers[-1][0])
    return trunk.layers[i] if i < len(trunk.layers) else (np.eye(count), np.zeros(count))


def diagonal(*blocks: np.ndarray) -> np.ndarray:
    """A matrix of blocks on its diagonal."""
    made = np.zeros(np.sum([block.shape for block in blocks], 0))
    for block, (row, column) in zip(
        blocks, np.cumsum([(0, 0), *(b.shape for b in blocks[:-1])], 0), strict=True
    ):
        made[row : row + block.shape[0], column : column + block.shape[1]] = block
    return made


def behind(network: Entries, alpha: str, rows: slice, code: np.ndarray) -> tuple[Layer, int]:
    """The layer behind a trunk that makes the density, by the `rows` of the layer `alpha`, and then what the
    colour reads; and how much that is."""
    weight, bias = layer_of(network.inside(alpha), "logit")
    bias = np.zeros(len(weight)) if bias is None else bias
    if "bottleneck" in network.values:
        bottleneck = layer_of(network, "bottleneck")
    else:
        bottleneck = np.eye(weight.shape[1]), None
    if weight.shape[1] != bottleneck[0].shape[1]:  # it reads the bottleneck and a code
        count = len(bottleneck[0])
        inner = 0 if bottleneck[1] is None else bottleneck[1]
        if weight.shape[1] != count + len(code):
            raise FormatError(f"{network.where}'{alpha}' should read {count} numbers and a code")
        bias = bias + weight[:, :count] @ inner + weight[:, count:] @ code
        weight = weight[:, :count] @ bottleneck[0]
    return stacked((weight[rows], bias[rows]), bottleneck), len(bottleneck[0])


def colours_of(network: Entries, name: str, outputs: int, features: int, code: np.ndarray):
    """The entry and sections of a colour network that reads a trunk's outputs but for the first, the
    direction's frequencies and a code."""
    place = network.inside(name)
    layers = [*layers_of(place), layer_of(place, "logit")]
    (weight, bias), *others = layers
    tried = {len(read): weight.shape[1] - features - len(read) for read in (code[:0], code)}
    fitting = [(n, seen) for n, seen in tried.items() if seen >= 0 and seen % 6 in (0, 3)]
    if not fitting:
        raise FormatError(f"{place.where}'hidden_0' should read {features} numbers and more")
    known, seen = fitting[-1]
    code = code[:known]
    count, identity = frequencies_of(seen)
    bias = (0 if bias is None else bias) + weight[:, features + seen :].astype(np.float64) @ code
    order = ColourInput(1 + features, outputs, count, alone=True)
    directions = [order.at("direction")] if identity else []
    columns = [order.at("features")[1:], *directions, order.waves("direction", count, by_level=True)]
    layers = [(weight[:, : features + seen], bias), *others]
    return colour_network(layers, order, np.concatenate(columns))
