"""Numbers beside a grid for what is finer than it: rows found by a hash of their place (Müller et al. 2022,
"Instant Neural Graphics Primitives", section 3), added to what the grid says before the activations.

A place of photos has surfaces everywhere, and products of planes and lines over all of it cannot tell leaves
and stones apart; vertices that are found by a hash cost memory only where some surface uses them.
"""

from dataclasses import dataclass

import numpy as np

RUN = 4  # rows that lie side by side along z, so that neighbours share a cache line
WIDTH = 4  # numbers of a row: density, then red, green and blue
EMPTY_FROM = -6.0  # density before activation, shift included, under which none is asked for
MAX_LEVELS, MAX_ROWS = 8, 1 << 24
MAX_VERTEX = 1 << 20  # along an axis: past it, float32 would not tell where between two a point is


@dataclass(frozen=True)
class Hashed:
    """Where the rows of a tensor lie in its box's coordinates: those of a level on the vertices of a cubic
    lattice through the origin."""

    spacings: tuple[float, ...]
    """Of the vertices of each level."""
    rows: int
    """Of each level, a power of two; vertices share them."""

    def __post_init__(self):
        """Refuse what the kernels were not written for."""
        if not self.spacings or not all(0 < h < np.inf for h in self.spacings):
            raise ValueError(f"'spacings' should be finite numbers above 0, found {list(self.spacings)}")
        if self.rows < RUN or self.rows & (self.rows - 1):
            raise ValueError(f"'rows' should be a power of two of at least {RUN}, found {self.rows}")

    @property
    def shape(self) -> tuple[int, int]:
        """Of the array of all rows, level after level."""
        return len(self.spacings) * self.rows, WIDTH
