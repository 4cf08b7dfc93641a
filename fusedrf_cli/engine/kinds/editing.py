"""What an edit of a field is asked, and what it gives back."""

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from fusedrf_cli.engine.fields.base import RadianceField, StoredField


@dataclass(frozen=True)
class Part:
    """An object that a field holds apart from others."""

    name: str
    """A node's; with a slash after it, of one of several parts of that node."""
    box: np.ndarray
    """(6,) in the field's frame."""

    def belongs(self, names: set[str]) -> bool:
        """Whether it goes by one of the names, or belongs to a node that does."""
        return goes_by(self.name, names)


def goes_by(part: str, names: set[str]) -> bool:
    """Whether a part's name is one of some names, or belongs to a node that has one."""
    return part in names or any(part.startswith(f"{name}/") for name in names)


@dataclass(frozen=True)
class Edited:
    """A field after an edit."""

    field: StoredField
    box: np.ndarray
    """(6,) in the field's frame: what was touched."""
    how: str
    """One clause: what was done."""
    local: bool = True
    """Whether all numbers that show something outside the box are the same bits."""
    figures: dict = field(default_factory=dict)
    """For the report: PSNR and seconds of what was learnt."""


class Teach(Protocol):
    """Whoever teaches fields what others show."""

    seed: int

    def __call__(
        self, teacher: RadianceField, student: StoredField, boxes: list[np.ndarray], fresh: bool
    ) -> tuple[StoredField, dict]:
        """The student, taught, with its numbers on the CPU, and figures for the report. boxes (6,) in the
        teacher's frame are where rays aim: the first gets half of them, the others share the rest. A student
        that is not fresh knows most of it already and keeps its resolution."""
        ...


class Becoming(Protocol):
    """Says what becomes of the parts of a field."""

    def __call__(self, name: str, object_to_field: np.ndarray) -> list[tuple[str, np.ndarray]]:
        """The names and placements (4, 4) in the field's frame of what a part of a name and a placement
        becomes."""
        ...


def enclosing(boxes: list[np.ndarray]) -> np.ndarray:
    """(6,) the box around boxes."""
    return np.concatenate([np.min([b[:3] for b in boxes], 0), np.max([b[3:] for b in boxes], 0)])
