"""Fields of encodings and decoders, out of the numbers of another system's file."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from dataclasses import field as with_default
from typing import Any

import numpy as np
import torch

from formats.errors import FormatError
from formats.foreign.stored import StoredTensor
from formats.splats.splats import UP_Z
from fusedrf_cli.engine.decoders import mlp
from fusedrf_cli.engine.decoders.sh_mlp import HARMONICS
from fusedrf_cli.engine.fields.base import check_samples, sampling_step
from fusedrf_cli.engine.fields.box import checked_box, whole_numbers
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kinds.assembled.field import PartsField, PartsShape

Y0 = 0.28209479177387814  # the spherical harmonic of degree 0
Layer = tuple[np.ndarray, np.ndarray | None]
"""The weights (outputs, inputs) and the bias (outputs,) of a dense layer."""
LLFF = "its loader moved and scaled its cameras, and how is told nowhere: the capture's own do not fit"
"""What is to be said of what was trained on an LLFF capture in its own world."""


@dataclass(frozen=True)
class ImportedNode:
    """One field of an import, and where it lies."""

    field: PartsField
    object_to_world: np.ndarray = with_default(default_factory=lambda: np.eye(4))
    """(4, 4) from the field's frame to what the file's system calls world."""
    suffix: str = ""
    """Of its name, where there are several."""


@dataclass(frozen=True)
class Imported:
    """What a file holds."""

    nodes: Sequence[ImportedNode]
    notes: Sequence[str] = ()
    """Sentences about what was chosen, or could not be taken over."""
    rule: str = "max"
    """By which several nodes are composed."""
    up: tuple[float, ...] = UP_Z
    """(3,) which way of its world is up."""
    framing: tuple[float, ...] | None = None
    """(6,) the box of its world that pictures show; None: all of it."""


class Entries:
    """A nested dict of a file. What is missing, or no such array, raises FormatError naming it."""

    def __init__(self, values: Mapping[str, Any], where: str = ""):
        self.values, self.where = values, where

    def inside(self, name: str) -> "Entries":
        """A dict in it."""
        value = self.get(name)
        if not isinstance(value, Mapping):
            raise FormatError(f"{self.where}'{name}' should be a dict, found {type(value).__name__}")
        return Entries(value, f"{self.where}{name}: ")

    def get(self, name: str) -> Any:
        """An entry."""
        if name not in self.values:
            raise FormatError(f"{self.where}'{name}' is missing")
        return self.values[name]

    def values_of(self, name: str) -> np.ndarray:
        """An entry as an array of any type; of lists that differ in length it is no numbers."""
        value = self.get(name)
        if hasattr(value, "array"):
            return value.array()
        try:
            return np.asarray(value)
        except ValueError:
            return np.asarray(None)

    def numbers(self, name: str, *shape: int | None) -> np.ndarray:
        """An array as float32, or float64 where it is that, also with NaN; of a shape, None for any size,
        which a file's own array is asked before it is read."""
        if isinstance(self.get(name), StoredTensor):
            self._check_shape(name, self.get(name).shape, shape)
        value = self.values_of(name)
        if value.dtype.kind not in "fiub":
            raise FormatError(f"{self.where}'{name}' should hold numbers")
        self._check_shape(name, value.shape, shape)
        return value if value.dtype == np.float64 else value.astype(np.float32, copy=False)

    def _check_shape(self, name: str, found: tuple[int, ...], shape: tuple[int | None, ...]) -> None:
        fits = not shape or len(shape) == len(found)
        if not fits or any(n not in (None, m) for n, m in zip(shape, found, strict=False)):
            expected = ["any" if n is None else n for n in shape]
            raise FormatError(f"{self.where}'{name}' should have shape {expected}, found {list(found)}")

    def array(self, name: str, *shape: int | None) -> np.ndarray:
        """Finite numbers, otherwise as `numbers` gives them."""
        value = self.numbers(name, *shape)
        if not np.isfinite(value).all():
            raise FormatError(f"{self.where}'{name}' holds NaN or infinity")
        return value

    def number(self, name: str, default: float | None = None) -> float:
        """A number."""
        if default is not None and name not in self.values:
            return default
        value = self.values_of(name).reshape(-1)
        if value.size != 1 or value.dtype.kind not in "fiub" or not np.isfinite(value[0]):
            raise FormatError(f"{self.where}'{name}' should be a number")
        return float(value[0])

    def whole(self, name: str, low: int, high: int, default: int | None = None) -> int:
        """A whole number between two."""
        value = self.number(name, default)
        if value != int(value) or not low <= value <= high:
            raise FormatError(
                f"{self.where}'{name}' should be a whole number from {low} to {high}, found {value}"
            )
        return int(value)

    def layers(self, prefix: str) -> list[Layer]:
        """The dense layers of a network whose names begin so: `<prefix><numbers>.weight` and, if there are
        any, `.bias`, in the order of their numbers: 0, 1, 2; with activations between them 0, 2, 4; or, where
        they are nested as DVGO's, 0, 2.0, 3."""
        found = re.compile(re.escape(prefix) + r"(\d{1,3}(?:\.\d{1,3})*)\.weight")
        middles = [match[1] for name in self.values if (match := found.fullmatch(str(name)))]
        if not middles:
            raise FormatError(f"{self.where}'{prefix}0.weight' is missing")
        ordered = sorted(middles, key=lambda middle: [int(n) for n in middle.split(".")])
        numbers, count = [int(middle.split(".")[0]) for middle in ordered], len(ordered)
        nested = any("." in middle for middle in ordered)
        if numbers not in (
            list(range(count)), list(range(0, 2 * count, 2)), [0, *range(2, count + 1)] if nested else [],
        ):  # fmt: skip
            raise FormatError(f"{self.where}'{prefix}*' has layers {', '.join(ordered)}: one is missing")
        layers = [self.layer(prefix + middle) for middle in ordered]
        if len({bias is None for _, bias in layers}) > 1:
            raise FormatError(f"{self.where}'{prefix}*' has biases of some layers only: one is missing")
        return layers

    def layer(self, name: str) -> Layer:
        """One dense layer."""
        weight = self.array(f"{name}.weight", None, None)
        bias = f"{name}.bias"
        return weight, self.array(bias, len(weight)) if bias in self.values else None


# -- fields --------------------------------------------------------------------------------------------------


def parts_field(
    shape: PartsShape,
    box: np.ndarray,
    resolution: Sequence[int],
    values: Mapping[str, np.ndarray],
    scale: float = 1.0,
    shift: float = 0.0,
    occupancy: OccupancyGrid | None = None,
) -> PartsField:
    """A field of these numbers by the names of its sections; where one has fewer, the others are 0. Raises
    ValueError for what a bundle may not say either."""
    resolution = whole_numbers([int(n) for n in resolution], 2, "texels per axis")
    if not (0 < scale < np.inf and np.isfinite(shift)):
        raise FormatError(
            f"the density's scale should be above 0 and its shift finite, found {scale}, {shift}"
        )
    field = PartsField(
        shape, checked_box(np.asarray(box).tolist(), "the box"), resolution, scale, shift, occupancy=occupancy
    )
    check_samples(field.occupancy.most_samples(sampling_step(field)), "the field")
    sections = field.sections()
    if values.keys() != sections.keys():
        raise ValueError(f"the sections are {sorted(sections)}, found {sorted(values)}")
    for name, value in values.items():
        target, value = sections[name], np.asarray(value, np.float32)
        if value.ndim != target.dim() or any(n > m for n, m in zip(value.shape, target.shape, strict=True)):
            raise FormatError(f"{name} should fit into {list(target.shape)}, found {list(value.shape)}")
        value = value if min(value.strides, default=0) >= 0 else value.copy()  # which torch cannot read
        target[tuple(slice(n) for n in value.shape)] = torch.from_numpy(value)
    field.check_answers()
    return field


def ranks_filled(ranks: Sequence[int]) -> int:
    """The rank of all modes: the largest, up to a run of eight."""
    return eight(max(ranks))


def beside(blocks: Sequence[np.ndarray], width: int) -> np.ndarray:
    """Columns of modes side by side, each filled up to a width."""
    return np.concatenate([np.pad(block, ((0, 0), (0, width - block.shape[1]))) for block in blocks], 1)


def eight(count: int) -> int:
    """Up to a run of eight."""
    return -(-count // 8) * 8


# -- networks ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ColourInput:
    """The input of a colour network (decoders/mlp.py), in the order of a foreign one's first layer: where in
    our own each column goes."""

    features: int
    """That the network reads; what they are filled up to is `width`."""
    width: int
    frequencies: int = 0
    harmonics: bool = False
    point: bool = False
    alone: bool = False
    """Whether only the direction is encoded by frequencies."""

    @property
    def core(self) -> int:
        waves = 6 * self.frequencies * self.alone
        return self.width + (HARMONICS if self.harmonics else 3) + waves + 3 * self.point

    @property
    def direction(self) -> str:
        """As the network's options have it."""
        return "harmonics" if self.harmonics else ("waves" if self.alone else "raw")

    def at(self, which: str) -> np.ndarray:
        """The rows of the features, the direction or the point."""
        start = {"features": 0, "direction": self.width, "point": self.core - 3}[which]
        count = {"features": self.features, "direction": HARMONICS if self.harmonics else 3, "point": 3}[
            which
        ]
        return start + np.arange(count)

    def waves(self, which: str, frequencies: int, by_level: bool = False) -> np.ndarray:
        """The rows of sines and cosines of the features, the direction or the point: all sines, dimension by
        dimension, then all cosines; or by_level, sines and cosines of all dimensions for each level."""
        dims, levels = self.at(which)[:, None], np.arange(frequencies)[None]
        apart = 3 if self.alone else self.core
        sines = dims + apart * (1 + levels)
        cosines = dims + apart * (1 + self.frequencies + levels)
        if by_level:
            return np.stack([sines, cosines], 1).transpose(2, 1, 0).reshape(-1)
        return np.concatenate([sines.reshape(-1), cosines.reshape(-1)])


def colour_network(
    layers: Sequence[Layer],
    order: ColourInput,
    columns: np.ndarray,
    rows: int = 0,
    diffuse: bool = False,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """The entry of a shape, and the sections but for the basis, of a colour network whose first layer reads
    `columns` (N,) of `order`. Raises FormatError where the layers do not fit each other."""
    hidden = check_layers(layers, len(columns), 3)
    entry = {
        "part": "mlp", "rows": rows, "hidden": hidden, "layers": len(layers) - 1,
        "frequencies": order.frequencies, "direction": order.direction,
        "point": order.point, "diffuse": diffuse,
    }  # fmt: skip
    inputs = mlp.layer_shapes(order.width, 0, hidden, len(layers) - 1, order.frequencies, entry["direction"],
                              order.point)[0][0]  # fmt: skip
    return entry, packed_layers("rgb", layers, columns, inputs, hidden)


def check_layers(layers: Sequence[Layer], inputs: int, outputs: int | None = None) -> int:
    """The width that hidden layers are filled up to. Raises FormatError where one does not fit the other."""
    if len(layers) < 2:
        raise FormatError(f"a network should have a hidden layer, found {len(layers)} in all")
    for i, (weight, _) in enumerate(layers):
        if weight.shape[1] != inputs:
            raise FormatError(f"layer {i} of a network should read {inputs} numbers, found {weight.shape[1]}")
        inputs = len(weight)
    if outputs is not None and inputs != outputs:
        raise FormatError(f"a network should make {outputs} numbers, found {inputs}")
    return eight(max(len(weight) for weight, _ in layers[:-1]))


def scattered(weight: np.ndarray, columns: np.ndarray, count: int) -> np.ndarray:
    """Weights (outputs, N) whose columns lie at `columns` (N,) of `count`."""
    wide = np.zeros((len(weight), count), np.float64)
    np.add.at(wide.T, columns, weight.T)
    return wide


def packed(weight: np.ndarray, bias: np.ndarray | None, inputs: int) -> np.ndarray:
    """(inputs + 1, outputs) of a layer as sections have it: transposed, its bias behind."""
    made = np.zeros((inputs + 1, len(weight)), np.float64)
    made[: weight.shape[1]] = weight.T
    if bias is not None:
        made[-1] = bias
    return made


def packed_layers(
    slot: str, layers: Sequence[Layer], columns: np.ndarray, inputs: int, hidden: int
) -> dict[str, np.ndarray]:
    """The sections of a network of a slot whose first layer reads `columns` (N,) of so many inputs, and whose
    hidden ones are filled up to a width."""
    (weight, bias), *others = layers
    sections = [packed(scattered(weight, columns, inputs), bias, inputs)]
    sections += [packed(weight, bias, hidden) for weight, bias in others]
    return {f"{slot}_layer_{i}": section for i, section in enumerate(sections)}


def trunk_layers(
    layers: Sequence[Layer], width: int, columns: np.ndarray | None = None, activation: str = "exp",
    limits: tuple[float, float] = (-80.0, 50.0),
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:  # fmt: skip
    """The entry and the sections of a network of density whose first layer reads the first of `width`
    features, or those at `columns`, and whose first output is the density's."""
    columns = np.arange(layers[0][0].shape[1]) if columns is None else columns
    if len(columns) > width or len(columns) and columns.max() >= width:
        raise FormatError(f"a network should read at most {width} features, found {len(columns)}")
    hidden = check_layers(layers, len(columns))
    entry = {
        "part": "trunk", "hidden": hidden, "outputs": eight(len(layers[-1][0])), "layers": len(layers) - 1,
        "activation": activation, "limits": list(limits),
    }  # fmt: skip
    return entry, packed_layers("sigma", layers, columns, width, hidden)
