"""Fields made smaller: with coarser texels, fewer components or SH bands. What they will be stored with is
known before they are made."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.kinds.builder import Contents


@dataclass(frozen=True)
class Reduction:
    """A smaller field in place of another."""

    contents: Contents | None
    """That it will be stored with; None: only the field's own numbers tell."""
    make: Callable[[StoredField], StoredField]
    """Makes it of the field."""
    lossless: bool
    """Whether it answers as the field does."""


def coarser(box: np.ndarray, resolution: tuple[int, int, int], voxel: float) -> tuple[int, int, int]:
    """Texels per axis over a box (6,) that are no finer than a voxel, and no more than a resolution has."""
    wanted = np.ceil(np.minimum((box[3:] - box[:3]) / max(voxel, 1e-300), 1e9)).astype(int) + 1
    return tuple(int(n) for n in np.clip(wanted, 2, resolution))
