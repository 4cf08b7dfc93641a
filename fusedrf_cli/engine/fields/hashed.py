"""Numbers beside a grid for what is finer than it: rows found by a hash of their place (Müller et al. 2022,
"Instant Neural Graphics Primitives", section 3), added to what the grid says before the activations.

A place of photos has surfaces everywhere, and products of planes and lines over all of it cannot tell leaves
and stones apart; vertices that are found by a hash cost memory only where some surface uses them.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

RUN = 4  # rows that lie side by side along z, so that neighbours share a cache line
WIDTH = 4  # numbers of a row: density, then red, green and blue
EMPTY_FROM = -6.0  # density before activation, shift included, under which none is asked for
MAX_LEVELS, MAX_ROWS = 8, 1 << 24
MAX_VERTEX = 1 << 20  # along an axis: past it, float32 would not tell where between two a point is
TOGETHER = 64  # rows that files code by one scale
WORTH = 0.75  # of the bytes of all rows: up to which a file has those alone that are not 0


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


@dataclass(frozen=True)
class Held:
    """Which rows of a detail a file holds: of an object that was cut out those that it can ask, the others
    being 0."""

    rows: np.ndarray
    """(R,) bool, R a multiple of TOGETHER."""

    @classmethod
    def of(cls, detail: np.ndarray) -> "Held | None":
        """Of a detail (R, WIDTH) the rows other than 0; None where a file is to hold all of them."""
        if len(detail) % TOGETHER:
            return None
        held = cls(detail.any(1))
        blocks = TOGETHER // 8 + 4 + 2 * WIDTH  # bytes of each: its mask, its length, scales
        small = held.rows.sum() * WIDTH + len(held.masks) * blocks <= WORTH * WIDTH * len(detail)
        return held if small else None

    @cached_property
    def masks(self) -> np.ndarray:
        """(K, TOGETHER) bool: of each block of rows of which any is held, which."""
        blocks = self.rows.reshape(-1, TOGETHER)
        return blocks[blocks.any(1)]

    @property
    def runs(self) -> np.ndarray:
        """(K,) int32 how many rows of each such block are held: they are coded by scales of their own, as
        they are among all rows, so that they keep their codes."""
        return self.masks.sum(1, dtype=np.int32)

    def state(self) -> dict[str, np.ndarray]:
        """Bits, first which blocks hold any, then which of their rows they hold."""
        blocks = self.rows.reshape(-1, TOGETHER).any(1)
        return {"blocks": np.packbits(blocks), "rows": np.packbits(self.masks, axis=1)}

    @classmethod
    def from_state(cls, blocks: np.ndarray, rows: np.ndarray, count: int) -> "Held":
        """Inverse of `state`, of so many rows in all. Raises ValueError where that cannot be."""
        found = np.zeros((count // TOGETHER, TOGETHER), bool)
        if count % TOGETHER or blocks.dtype != np.uint8 or blocks.shape != (-(-len(found) // 8),):
            raise ValueError(f"which of {count} rows are held should be told by a bit for {TOGETHER}")
        bits = np.unpackbits(blocks)
        some = bits[: len(found)].astype(bool)
        if rows.dtype != np.uint8 or rows.shape != (some.sum(), TOGETHER // 8) or bits[len(found) :].any():
            raise ValueError(f"{some.sum()} times {TOGETHER} rows are held in part, but not told which")
        found[some] = np.unpackbits(rows, axis=1).astype(bool)
        if not found[some].any(1).all():
            raise ValueError(f"{TOGETHER} rows are held in part, but none of them is")
        return cls(found.ravel())
