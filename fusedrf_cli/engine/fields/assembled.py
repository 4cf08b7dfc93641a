"""Fields that are assembled of an encoding for their density, one for their colour, and a decoder of each
(kernels/assembled.py says how their functions become one namespace)."""

from dataclasses import dataclass, field, replace
from functools import cached_property
from types import ModuleType

import numpy as np
import torch

from fusedrf_cli.engine.decoders import activations
from fusedrf_cli.engine.fields.box import BoxField, ParameterBlock
from fusedrf_cli.engine.fields.computed import ComputedField
from fusedrf_cli.engine.kernels.assembled import assemble
from fusedrf_cli.engine.kernels.reference import cell_at, exact

MAX_RANK = 1024  # of a stored field


@dataclass(frozen=True)
class Slot:
    """What fills a slot of a field."""

    module: ModuleType
    """An encoding or a decoder."""
    options: dict = field(default_factory=dict)
    """What the module's functions for Python are called with."""
    prefix: str = ""
    """In front of the names of its sections, in files."""
    rate: float = 1.0
    """What its numbers learn at, relative to the optimiser's rate and to what the module says."""
    spread: float | None = None
    """Standard deviation of an untrained field's numbers; None: what the module says."""

    @property
    def sizes(self) -> dict[str, int | float]:
        """Its constants."""
        return self.module.sizes(**self.options)

    def arrays(self, field: "Assembled", starts: np.ndarray) -> tuple:
        """Its arrays, of a field where its numbers begin at starts in `params`."""
        return self.module.arrays(field, starts, **self.options) if hasattr(self.module, "arrays") else ()

    def parts(self, resolution: tuple[int, int, int]) -> list[ParameterBlock]:
        """Its numbers."""
        if not hasattr(self.module, "sections"):
            return []
        return [
            replace(
                part,
                name=self.prefix + part.name,
                rate=self.rate * part.rate,
                spread=part.spread if self.spread is None else self.spread,
            )
            for part in self.module.sections(resolution, **self.options)
        ]


def check_counts(shape: object, limits: dict[str, tuple[int, int, int]]) -> None:
    """Refuse a shape that the kernels were not written for: raise ValueError where a number, by its name, is
    no whole one from the first to the second limit, or no multiple of the third."""
    for name, (low, high, each) in limits.items():
        count = getattr(shape, name)
        if type(count) is not int or not low <= count <= high or count % each:
            wanted = "whole number" if each == 1 else f"multiple of {each}"
            raise ValueError(f"'{name}' should be a {wanted} from {low} to {high}, found {count!r}")


class HarmonicShape:
    """What the shapes of kinds have in common whose colours are spherical harmonics."""

    sh_degree: int

    def __post_init__(self):
        """Refuse degrees that the kernels were not written for."""
        if self.sh_degree not in range(4):
            raise ValueError(f"'sh_degree' should be 0, 1, 2 or 3, found {self.sh_degree}")

    @property
    def coefficients(self) -> int:
        """SH coefficients per channel."""
        return (self.sh_degree + 1) ** 2


@dataclass(frozen=True)
class RankedShape(HarmonicShape):
    """Components of a decomposed field."""

    density_rank: int = 16
    """Components, per mode, of the density."""
    colour_rank: int = 24
    """Components, per mode, of the colour features."""
    sh_degree: int = 2

    def __post_init__(self):
        """Refuse what the kernels were not written for: runs of eight components, and HarmonicShape's."""
        check_counts(self, dict.fromkeys(("density_rank", "colour_rank"), (8, MAX_RANK, 8)))
        super().__post_init__()


class Assembled(ComputedField):
    """A field of four slots: `density` and `colour`, encodings, and `sigma` and `rgb`, which decode them.

    Over a box its numbers and all else follow from the slots (AssembledField); a kind over anything else
    defines the methods below.
    """

    slots: dict[str, Slot]
    """What fills the slots, by name, in the order of `kernels.assembled.READS`."""
    colour_activation = "sigmoid"
    """What makes a colour of logits: one of `decoders.activations.COLOURS`."""

    @property
    def cube(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower corner (3,) and sides (3,) of the cube that encodings count in."""
        raise NotImplementedError

    def slot_starts(self) -> dict[str, np.ndarray]:
        """Where in `params` the numbers of each slot begin."""
        raise NotImplementedError

    def slot_sections(self) -> dict[str, dict]:
        """What the references of each slot take for its numbers."""
        raise NotImplementedError

    def located(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Points (N, 3) float64 of the space's coordinates as the encodings' references take them (N, 3), and
        whether the field is there (N,)."""
        raise NotImplementedError

    @property
    def device_module(self) -> ModuleType:
        """See ComputedField."""
        return assemble(**{name: slot.module for name, slot in self.slots.items()})

    def kernel_arrays(self, params: object) -> tuple:
        """See ComputedField."""
        values, starts = [params, *self.cube], self.slot_starts()
        for name, slot in self.slots.items():
            values += slot.arrays(self, starts[name])
        return self.device_module.Arrays(*values)

    def reference(
        self, params: torch.Tensor, points: torch.Tensor, dirs: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See ComputedField: the references of the slots, one after the other."""
        bare = self.with_params(params)
        own = bare.slot_sections()
        unit, held = bare.located(exact(points, params.device))
        density, colour, sigma, rgb = self.slots.values()
        features = density.module.reference(self, own["density"], unit, None, **density.options)
        values, outputs = sigma.module.reference(self, own["sigma"], features, **sigma.options)
        values = torch.where(held, values, 0)
        features = colour.module.reference(self, own["colour"], unit, outputs, **colour.options)
        dirs = exact(dirs, params.device)
        asks = {"unit": unit} if hasattr(rgb.module, "point_setup") else {}
        logits = rgb.module.reference(self, own["rgb"], features, dirs, **asks, **rgb.options)
        if hasattr(density.module, "logits_reference"):
            logits = logits + density.module.logits_reference(self, own["density"], unit, **density.options)
        rgb = activations.colour_reference(self.colour_activation, logits)
        return values, torch.where((values > 0)[:, None], rgb, 0)


class AssembledField(Assembled, BoxField):
    """Such a field over one box.

    A kind sets `kind` and `shape_type`, and defines `slots_of`; the rest follows from the slots' modules.
    """

    @classmethod
    def slots_of(cls, shape: object) -> dict[str, Slot]:
        """What fills the slots, by name, in the order of `kernels.assembled.READS`."""
        raise NotImplementedError

    @cached_property
    def slots(self) -> dict[str, Slot]:
        """See Assembled."""
        return self.slots_of(self.shape)

    @classmethod
    def parts_of(cls, shape: object, resolution: tuple[int, int, int]) -> list[ParameterBlock]:
        """See BoxField: those of each slot in turn."""
        return [part for slot in cls.slots_of(shape).values() for part in slot.parts(resolution)]

    def planes(self, numbers: torch.Tensor) -> list[torch.Tensor]:
        """See ComputedField."""
        sections = self.with_params(numbers).sections()
        return [sections[part.name] for part in self.parts if len(part.axes) == 2]

    @property
    def cube(self) -> tuple[np.ndarray, np.ndarray]:
        """See Assembled: the box."""
        return self.corners[1:]

    def slot_starts(self) -> dict[str, np.ndarray]:
        """See Assembled."""
        counts = [len(slot.parts(self.resolution)) for slot in self.slots.values()]
        return dict(zip(self.slots, np.split(self.starts[:-1], np.cumsum(counts)), strict=False))

    def slot_sections(self) -> dict[str, dict[str, torch.Tensor]]:
        """See Assembled: views of the numbers of each slot, by the names that its module gives them."""
        sections = self.sections()
        return {
            name: {
                part.name.removeprefix(slot.prefix): sections[part.name]
                for part in slot.parts(self.resolution)
            }
            for name, slot in self.slots.items()
        }

    def located(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """See Assembled: in the unit cube, where a cell is occupied."""
        low, sides = (exact(part, points.device) for part in self.cube)
        unit = (points - low) / sides
        inside = ((unit - 0.5).abs() <= 0.5 + 1e-9).all(1)  # as kernels/assembled.py's `steps_at`
        return unit.to(self.params.dtype), cell_at(self.occupancy, points)[1] & inside

    def check_answers(self) -> None:
        """See BoxField."""
        sections = self.slot_sections()
        density, colour, sigma, rgb = self.slots.values()
        features = self.features_bound(density, sections["density"], None)
        largest, outputs = sigma.module.bound(self, sections["sigma"], features, **sigma.options)
        self.check_density(largest)
        features = self.features_bound(colour, sections["colour"], outputs)
        logit = rgb.module.bound(self, sections["rgb"], features, **rgb.options)
        if hasattr(density.module, "logits_bound"):
            logit += density.module.logits_bound(sections["density"], **density.options)
        self.check_logit(logit)

    def features_bound(self, slot: Slot, sections: dict, read: torch.Tensor | None) -> torch.Tensor:
        """`bound` of the encoding of a slot, which reads what is at most `read`; where it begins with the
        point as it is, that lies in the box."""
        reach = float(np.abs(self.box).max())
        if hasattr(slot.module, "bound_within"):
            return slot.module.bound_within(reach, sections, **slot.options)
        most = slot.module.bound(sections, read, **slot.options)
        if slot.options.get("frame"):
            most[:3] = reach
        return most
