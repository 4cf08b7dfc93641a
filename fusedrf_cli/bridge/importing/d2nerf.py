"""D²NeRF (Wu et al., NeurIPS 2022; github.com/ChikaYan/d2nerf): what stands still, and what moves at one
time."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.bridge.importing.flax_networks import (
    Columns,
    Trunk,
    behind,
    colours_of,
    columns_of,
    diagonal,
    frequencies_of,
    layer_of,
    layers_of,
    sections_of,
    side_by_side,
    trunk_of,
)
from fusedrf_cli.bridge.importing.nerf import SAMPLES, stacked
from fusedrf_cli.bridge.importing.parts import (
    Entries,
    Imported,
    ImportedNode,
    Layer,
    eight,
    parts_field,
)
from fusedrf_cli.engine.encodings import warped_frequencies
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsField, PartsShape
from fusedrf_cli.errors import UsageProblem

TWIST = 6  # numbers that move a point
READ = {
    "norm_type": "none", "activation": "relu", "sigma_activation": "softplus",
    "use_pivot": "False", "use_translation": "False", "spatial_point_min_deg": "0",
    "hyper_point_min_deg": "0", "viewdir_min_deg": "0", "min_deg": "0",
}  # fmt: skip
"""Of settings that are not in the file, the only value that is read."""
NONE = {"count": 0, "hidden": 8, "layers": 1, "skip": 0}
"""A network that does nothing."""


class Model:
    """The parameters of a DecomposeNerfModel and how far its windows are open."""

    def __init__(self, checkpoint):
        entries = Entries(checkpoint.entries)
        self.state = entries.inside("optimizer").inside("target").inside("model")
        self.entries, self.beside = entries, checkpoint.beside
        self.level = "nerf_mlps_fine" if "nerf_mlps_fine" in self.state.values else "nerf_mlps_coarse"
        if "MLP_2" in self.state.inside(self.level).values:
            raise FormatError(
                "its moving part has a weight by which it is blended (blend_mode old or nsff of earlier "
                "versions), which is not read; train it with 'add'"
            )
        self.static = self.state.inside("static_nerf").inside(self.level)
        self.static_layers = layers_of(self.static.inside("MLP_0"))
        self.count, self.identity = frequencies_of(self.static_layers[0][0].shape[1])

    def setting(self, name: str, default: float) -> float:
        """A number of the run's settings, by the last part of its name; the static model's do not count."""
        for settings in self.beside.values():
            for key, value in settings.items() if isinstance(settings, Mapping) else ():
                owner, _, last = str(key).rpartition(".")
                if last == name and owner != "StaticNerfModel" and isinstance(value, int | float):
                    if not np.isfinite(value):
                        raise FormatError(f"its settings: '{key}' should be a number, found {value}")
                    return value
        return default

    def window(self, name: str, count: int) -> np.ndarray:
        """(count,) how much of each frequency is let through."""
        if self.entries.values.get(name) is None:
            return np.ones(count)
        return 0.5 - 0.5 * np.cos(np.pi * np.clip(self.entries.number(name) - np.arange(count), 0, 1))

    def code(self, name: str, time: float | None, place: Entries | None = None) -> np.ndarray:
        """The code of a time, between two that of both, the mean of all where there is no time; none where
        the model has none of that name."""
        place = place or self.state
        if name not in place.values:
            return np.zeros(0)
        codes = place.inside(name).inside("embed").array("embedding", None, None).astype(np.float64)
        if time is None:
            return codes.mean(0)
        if not 0 <= time <= len(codes) - 1:
            raise UsageProblem(
                f"the scene moves: a time from 0 to {len(codes) - 1} (--time) should be given, found {time:g}"
            )
        i = min(int(time), max(len(codes) - 2, 0))
        return codes[i] + (time - i) * (codes[min(i + 1, len(codes) - 1)] - codes[i])


def check_settings(beside: Mapping[str, Any]) -> None:
    """Raise FormatError where a run's settings say that its networks compute something else; those of the
    model that it extends do not count."""
    for name, settings in beside.items():
        for key, value in settings.items() if isinstance(settings, Mapping) else ():
            owner, _, last = str(key).rpartition(".")
            if owner == "NerfModel" or last not in READ or value is None:
                continue
            value = settings.get(str(value)[1:], value) if str(value).startswith("%") else value
            plain = str(value).rpartition(".")[2]  # of @jax.nn.relu
            if plain != READ[last] and plain[:1] not in ("%", "\\"):
                raise FormatError(f"{name}: '{key}' should be {READ[last]}, found {str(value)[:40]}")


def read(checkpoint, box: np.ndarray, time: float | None = None) -> Imported:
    """What stands still, and what moves as it is at a `time`, in a box (6,): fields whose densities add up.
    Times are counted from 0; between two the codes of both are mixed. Without a time what stands still, in
    no shadow. Raises FormatError."""
    check_settings(checkpoint.beside)
    model = Model(checkpoint)
    notes = ["of its coarse and fine networks the fine ones are taken"] * model.level.endswith("fine")
    if time is None:
        notes.append("what moves is left out, and its shadow: a time (--time, counted from 0) shows them")
        return Imported([ImportedNode(static_field(model, None, box))], notes)
    dynamic = Dynamic(model, time)
    notes.append(f"it moves, and stands as at time {time:g}")
    if dynamic.shadow is not None:
        notes.append("the shadow of what moves darkens the static field, also where that is shown alone")
    nodes = [
        ImportedNode(static_field(model, dynamic, box), suffix="-static"),
        ImportedNode(dynamic.field(box), suffix="-dynamic"),
    ]
    return Imported(nodes, notes, "add")


# -- fields -----------------------------------------------------------------------------------------------


def field_of(encoding: dict, sigma: dict, rgb: dict, values: dict, box: np.ndarray) -> PartsField:
    """A field of networks in a box."""
    shape = PartsShape(encoding, {"part": "trunk_features"}, sigma, rgb)
    sides = box[3:] - box[:3]
    resolution = np.maximum(2, np.rint(SAMPLES * sides / sides.max())).astype(int)
    return parts_field(shape, box, resolution, values, occupancy=OccupancyGrid.full(box))


# -- what moves ----------------------------------------------------------------------------------------------


class Dynamic:
    """The parts of what moves."""

    def __init__(self, model: Model, time: float):
        self.model, self.state, self.network = model, model.state, model.state.inside(model.level)
        self.time, self.warp_code = time, model.code("warp_embed", time)
        own = model.code("hyper_embed", time)
        self.hyper_code = own if len(own) else self.warp_code
        self.code = model.code("nerf_embed", time)
        self.layers = layers_of(self.network, "trunk_hidden_")
        self.warp, self.values = self.warped()
        self.sheet, self.coordinates, more = self.sheeted()
        self.values |= more
        self.split_inputs()
        self.shadow = self.shadow_layers()

    def warped(self) -> tuple[dict, dict[str, np.ndarray]]:
        """The options and sections of the network that moves points."""
        if "warp_field" not in self.state.values:
            return NONE, empty("density_warp_", 8)
        place, alpha, prefix = self.state.inside("warp_field"), "warp_alpha", "density_warp_"
        if "mlp" in place.values:  # points are only pushed
            network = place.inside("mlp")
            weight, bias = layer_of(network, "logit")
            if len(weight) != TWIST // 2:
                raise FormatError(f"{network.where}'logit' should make 3 numbers, found {len(weight)}")
            still = np.zeros_like(weight), None if bias is None else np.zeros_like(bias)
            last = stacked(still, (weight, bias))
            return self.moving(layers_of(network), last, alpha, self.warp_code, prefix)
        if more := {"branches_p", "branches_t"} & set(place.values):
            raise FormatError(
                f"{place.where}{min(more)} (use_pivot, use_translation) is not read; train it without"
            )
        branches = [place.inside(f"branches_{name}") for name in "wv"]
        if any("hidden_0" in branch.values for branch in branches):
            raise FormatError(f"{place.where}branches with hidden layers are not taken over")
        last = stacked(*(layer_of(branch, "logit") for branch in branches))
        if len(last[0]) != TWIST:
            raise FormatError(f"{place.where}branches should make {TWIST} numbers, found {len(last[0])}")
        return self.moving(layers_of(place.inside("trunk")), last, alpha, self.warp_code, prefix)

    def sheeted(self) -> tuple[dict, int, dict[str, np.ndarray]]:
        """The options of the network that gives points coordinates, how many, and its sections."""
        if "hyper_sheet_mlp" not in self.state.values:
            return NONE, 1, empty("density_sheet_", 8)
        place = self.state.inside("hyper_sheet_mlp").inside("MLP_0")
        last = layer_of(place, "logit")
        if self.model.setting("use_residual", False):
            if len(last[0]) != len(self.hyper_code):
                raise FormatError(
                    f"{place.where}'logit' should make {len(self.hyper_code)} numbers, as a code"
                )
            last = last[0], (0 if last[1] is None else last[1]) + self.hyper_code
        made = self.moving(layers_of(place), last, "hyper_sheet_alpha", self.hyper_code, "density_sheet_")
        return made[0], len(last[0]), made[1]

    def moving(self, layers: list[Layer], last: Layer, alpha: str, code: np.ndarray, prefix: str):
        """The options and sections of a network that reads a point's frequencies and a code."""
        count, identity = frequencies_of(layers[0][0].shape[1] - len(code))
        columns = columns_of(0, count, identity, self.model.window(alpha, count), code)
        options, sections = sections_of(prefix, trunk_of(layers, columns, 3 + 6 * count), last)
        return {"count": count} | options, sections

    def split_inputs(self) -> None:
        """How many frequencies of the moved point and of its further coordinates the trunk reads."""
        inputs = self.layers[0][0].shape[1]
        constant, said = self.sheet is NONE, int(self.model.setting("hyper_point_max_deg", -1))
        dims = len(self.hyper_code) if constant else self.coordinates
        own = int(self.model.setting("spatial_point_max_deg", self.model.count))
        degrees = {*([said] if said >= 0 else range(25)), *[0] * constant}
        identities = self.model.identity, not self.model.identity
        for identity, count in itertools.product(identities, (own, *range(25 if said >= 0 else 0))):
            left = inputs - 6 * count - 3 * identity
            degree = left / (2 * dims) if dims else 0  # without a coordinate there is nothing to encode
            if degree in degrees if dims else left == 0:
                self.count, self.identity, self.coordinate_count = count, identity, int(degree)
                return self.encode_constants(constant, dims)
        raise FormatError(
            f"{self.network.where}'trunk_hidden_0' reads {inputs} numbers, which are no frequencies of a "
            f"point, as many as of the static one, and of {dims} coordinates"
        )

    def encode_constants(self, constant: bool, dims: int) -> None:
        """What coordinates that are the same everywhere are encoded as."""
        window = np.repeat(self.model.window("hyper_alpha", self.coordinate_count), 2 * dims)
        levels = self.hyper_code * 2.0 ** np.arange(self.coordinate_count)[:, None]
        waves = np.stack([np.sin(levels), np.cos(levels)], 1).reshape(-1)
        self.hyper_window = np.zeros(0) if constant else window
        self.constants = waves * window if constant else np.zeros(0)

    def encoding(self, still: bool) -> dict[str, Any]:
        """The entry of the encoding; `still`: with the frequencies of the point where it is."""
        count = max(self.count, self.model.count) if still else self.count
        constant = self.sheet is NONE
        return {
            "part": "warped_frequencies", "count": count, "warp": self.warp, "sheet": self.sheet,
            "coordinates": self.coordinates, "still": still,
            "coordinate_count": 0 if constant else self.coordinate_count,
        }  # fmt: skip

    def trunk(self, layers: Sequence[Layer], encoding: dict[str, Any]) -> Trunk:
        """A trunk over the features of an encoding."""
        sizes = warped_frequencies.sizes(**{k: v for k, v in encoding.items() if k != "part"})
        window = self.model.window("nerf_alpha", self.count)
        own = columns_of(sizes["MOVED"], self.count, self.identity, window)
        hyper = sizes["OWN"] + np.arange(len(self.hyper_window))
        columns = Columns(
            np.concatenate([own.at, hyper]), np.concatenate([own.factors, self.hyper_window]), self.constants
        )
        return trunk_of(layers, columns, sizes["WIDTH"])

    def shadow_layers(self) -> tuple[list[Layer], Layer] | None:
        """The trunk's layers and the last one of what darkens the static scene."""
        alpha = layer_of(self.network.inside("MLP_1"), "logit")
        if "shadow_model" in self.state.values:
            place = self.state.inside("shadow_model")
            layers, (weight, bias) = (
                layers_of(place, "trunk_hidden_"),
                layer_of(place.inside("MLP_0"), "logit"),
            )
        elif len(alpha[0]) > 1:
            weight, bias = behind(self.network, "MLP_1", slice(-1, None), self.code)[0]
            layers, weight, bias = self.layers, weight[:1], bias[:1]
        else:
            return None
        shift = self.model.setting("shadow_r_shift", 0.0)
        return layers, (weight[-1:], (0.0 if bias is None else bias[-1:]) - shift)

    def field(self, box: np.ndarray) -> PartsField:
        """The field of what moves."""
        encoding = self.encoding(still=False)
        last, features = behind(self.network, "MLP_1", slice(1), self.code)
        options, sections = sections_of("sigma_", self.trunk(self.layers, encoding), last)
        outputs = eight(len(last[0]))
        rgb, colours = colours_of(self.network, "MLP_0", outputs, features, self.code)
        sigma = {"part": "trunk", "outputs": outputs} | options
        return field_of(encoding, sigma, rgb, self.values | sections | colours, box)


def empty(prefix: str, outputs: int) -> dict[str, np.ndarray]:
    """The sections of a network that does nothing."""
    return {f"{prefix}layer_0": np.zeros((4, 8)), f"{prefix}layer_1": np.zeros((9, outputs))}


# -- what stands still ---------------------------------------------------------------------------------------


def static_field(model: Model, dynamic: Dynamic | None, box: np.ndarray) -> PartsField:
    """The field of what stands still, darkened by the shadow of what moves, if there is any."""
    network, layers, count = model.static, model.static_layers, model.count
    columns = columns_of(0, count, model.identity, model.window("nerf_alpha", count))
    time, static_nerf = dynamic and dynamic.time, model.state.inside("static_nerf")
    code = model.code("nerf_embed", time, static_nerf)
    last, features = behind(network, "MLP_2", slice(1), code)
    shadow = dynamic and dynamic.shadow
    encoding, values = {"part": "frequencies", "count": count, "frame": True}, {}
    if shadow is None:
        trunk = trunk_of(layers, columns, eight(3 + 6 * count))
    else:
        encoding, values = dynamic.encoding(still=True), dynamic.values
        dark, logit = dynamic.trunk(shadow[0], encoding), shadow[1]
        trunk = side_by_side(trunk_of(layers, columns, dark.layers[0][0].shape[1]), dark)
        last = diagonal(last[0], logit[0]), np.concatenate([last[1], logit[1]])
    options, sections = sections_of("sigma_", trunk, last)
    outputs = eight(len(last[0]))
    rgb, colours = colours_of(network, "MLP_1", outputs, features, code)
    if shadow is not None:
        rgb["dimmed"] = 1 + features
    sigma = {"part": "trunk", "outputs": outputs} | options
    return field_of(encoding, sigma, rgb, values | sections | colours, box)
