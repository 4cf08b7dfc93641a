"""The `assembled` field: over one box, of the encodings and decoders that its file names, with the options
that it gives them."""

from dataclasses import dataclass
from functools import cached_property
from types import ModuleType
from typing import Any

import msgspec
import numpy as np

from fusedrf_cli.engine.decoders import (
    density_linear,
    density_sum,
    direction_basis,
    direction_texture,
    mlp,
    rgb,
    sh,
    sh_basis,
    trunk,
)
from fusedrf_cli.engine.decoders.activations import COLOURS
from fusedrf_cli.engine.encodings import (
    frequencies,
    grid,
    hash_grid,
    line,
    plane_line,
    planes,
    sparse_grid,
    sparse_rows,
    spheres,
    trunk_features,
    warped_frequencies,
)
from fusedrf_cli.engine.fields.assembled import AssembledField, Slot
from fusedrf_cli.engine.fields.box import MAX_ANSWER
from fusedrf_cli.engine.kernels.assembled import READS, assemble

ENCODINGS = (
    plane_line, line, grid, sparse_grid, spheres, hash_grid, planes, frequencies, warped_frequencies
)  # fmt: skip
PARTS: dict[str, tuple[ModuleType, ...]] = {
    "density": ENCODINGS,
    "colour": (*(part for part in ENCODINGS if part is not sparse_grid), sparse_rows, trunk_features),
    "sigma": (density_sum, density_linear, trunk),
    "rgb": (rgb, sh, sh_basis, direction_basis, direction_texture, mlp),
}
"""What may fill each slot, by the names of their modules."""
FARTHEST = 1e4
"""From 0, of a box whose points are encoded as they are: `frequencies.bound` counts on it."""


def name_of(module: ModuleType) -> str:
    """What files call an encoding or a decoder."""
    return module.__name__.rpartition(".")[2]


@dataclass(frozen=True)
class PartsShape:
    """Of each slot, the part that fills it, as `part`, and its Options; widths follow from what it reads."""

    density: dict[str, Any]
    colour: dict[str, Any]
    sigma: dict[str, Any]
    rgb: dict[str, Any]
    colour_activation: str = "sigmoid"

    def __post_init__(self):
        """Refuse what there is not, before it sizes anything."""
        if self.colour_activation not in COLOURS:
            raise ValueError(
                f"'colour_activation' should be one of {', '.join(COLOURS)}, found {self.colour_activation!r}"
            )
        slots = self.slots()
        assemble(**{name: slot.module for name, slot in slots.items()})
        for width in ("sigma", "rgb"):
            if slots[width].options.get("width", 0) % 8 and slots[width].module not in (rgb, sh):
                raise ValueError(f"what '{width}' reads should be a multiple of 8 numbers")

    @property
    def entries(self) -> dict[str, dict[str, Any]]:
        """What fills each slot, by its name."""
        return {name: getattr(self, name) for name in READS}

    def slots(self) -> dict[str, Slot]:
        """What fills the slots. Raises ValueError for what files may not say."""
        parts = {name: part_of(name, entry) for name, entry in self.entries.items()}
        colour, of_colour = parts["colour"]
        sigma, of_sigma = parts["sigma"]
        if sigma is not density_sum:
            of_sigma["width"] = width_of(*parts["density"])
        if colour is trunk_features:
            if sigma is density_sum:
                raise ValueError("'trunk_features' of the colour needs a 'trunk' of the density")
            of_colour["outputs"] = of_sigma.get("outputs", of_sigma["width"])
        if colour is sparse_rows:
            if parts["density"][0] is not sparse_grid:
                raise ValueError("'sparse_rows' of the colour needs a 'sparse_grid' of the density")
            of_colour["rows"] = parts["density"][1]["rows"]
        parts["rgb"][1]["width"] = width_of(colour, of_colour)
        return {name: Slot(module, options, f"{name}_") for name, (module, options) in parts.items()}


def part_of(slot: str, entry: dict[str, Any]) -> tuple[ModuleType, dict[str, Any]]:
    """The module that an entry names, and its options with those that are left out. Raises ValueError."""
    known = {name_of(module): module for module in PARTS[slot]}
    if not isinstance(entry, dict) or entry.get("part") not in known:
        raise ValueError(f"'{slot}' should have a 'part' of {', '.join(known)}, found {str(entry)[:80]}")
    module = known[entry["part"]]
    given = {name: value for name, value in entry.items() if name != "part"}
    try:
        options = msgspec.to_builtins(msgspec.convert(given, module.Options))
    except (msgspec.ValidationError, ValueError) as error:
        raise ValueError(f"'{slot}', {entry['part']}: {error}") from error
    return module, options


def width_of(module: ModuleType, options: dict[str, Any]) -> int:
    """Features of an encoding."""
    return module.sizes(**options)["WIDTH"]


class PartsField(AssembledField):
    """Such a field."""

    kind = "assembled"
    shape_type = PartsShape
    hash_rows = "hash.rows"
    """What files call the rows of a hash grid: a part of its own."""

    @classmethod
    def slots_of(cls, shape: PartsShape) -> dict[str, Slot]:
        """See AssembledField."""
        return shape.slots()

    def state(self) -> tuple[dict[str, np.ndarray], dict]:
        """See BoxField; rows of a hash grid are a part that fields may have in common, as those do that are
        one field in several grids of cells."""
        arrays, metadata = super().state()
        return arrays, metadata | ({"shared": ["hash"]} if self.hash_rows in arrays else {})

    @classmethod
    def stored_name(cls, name: str) -> str:
        """See BoxField."""
        return cls.hash_rows if name == "density_rows" else name

    @cached_property
    def colour_activation(self) -> str:
        """See Assembled."""
        return self.shape.colour_activation

    @property
    def over_texels(self) -> bool:
        """See ComputedField: rows of a hash grid and networks are of the whole cube."""
        return all(slot.module in (plane_line, line, grid) for slot in list(self.slots.values())[:2])

    def check_answers(self) -> None:
        """See BoxField."""
        encoded = [entry for entry in self.shape.entries.values() if entry.get("frame")]
        if encoded and np.abs(self.box).max() > FARTHEST:
            raise ValueError(f"the box of points that are encoded should lie within {FARTHEST:g} of 0")
        sigma = self.slots["sigma"].sizes
        if sigma["ACTIVATION"] == 1 and self.scale * np.exp(sigma["HIGHEST"]) > MAX_ANSWER:
            raise ValueError(f"the density would reach {self.scale:g} exp({sigma['HIGHEST']:g})")
        super().check_answers()
