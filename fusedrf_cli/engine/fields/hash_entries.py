"""Numbers beside a grid for what is finer than it: rows found by a hash of their place (Müller et al. 2022,
"Instant Neural Graphics Primitives", section 3), added to what the grid says before the activations.

A place of photos has surfaces everywhere, and products of planes and lines over all of it cannot tell leaves
and stones apart; vertices that are found by a hash cost memory only where some surface uses them.
"""

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np

RUN = 4  # rows that lie side by side along z, so that neighbours share a cache line
ROW = 4  # numbers of a row: density, then red, green and blue
EMPTY_FROM = -6.0  # density before activation, shift included, under which none is asked for
STEPS = 2.0  # of its finest spacing from one sample of a picture to the next
MAX_LEVELS, MAX_ROWS = 8, 1 << 24
MAX_VERTEX = 1 << 20  # along an axis: past it, float32 would not tell where between two a point is
TOGETHER = 64  # rows that files code by one scale
PER_BLOCK = TOGETHER // RUN // 8 + 1 + 2 * ROW  # bytes of those: which are held, how many, and scales


@dataclass(frozen=True)
class HashGrid:
    """Where the rows of a tensor lie in its box's coordinates: those of a level on the vertices of a cubic
    lattice through the origin."""

    spacings: tuple[float, ...]
    """Of the vertices of each level."""
    rows: int
    """Of each level, a power of two; vertices share them."""
    learns_from: int = field(default=100, compare=False)
    """Texels along a field's longest axis from which it learns; before, it would learn what is coarse."""
    rate: float = field(default=0.5, compare=False)
    """It learns at, relative to the factors; at 1 smooth things come out grainy: a cup after 100 s SSIM 0.77,
    with 0.5 0.79."""

    def __post_init__(self):
        """Refuse what the kernels were not written for."""
        if not self.spacings or not all(0 < h < np.inf for h in self.spacings):
            raise ValueError(f"'spacings' should be finite numbers above 0, found {list(self.spacings)}")
        if self.rows < RUN or self.rows & (self.rows - 1):
            raise ValueError(f"'rows' should be a power of two of at least {RUN}, found {self.rows}")

    @property
    def shape(self) -> tuple[int, int]:
        """Of the array of all rows, level after level."""
        return len(self.spacings) * self.rows, ROW

    @property
    def picture_step(self) -> float:
        """At which pictures sample it."""
        return STEPS * min(self.spacings)


@dataclass(frozen=True)
class StoredEntries:
    """Which runs of RUN rows of a detail a file holds: of an object that was cut out those that it can ask,
    the others being 0."""

    runs: np.ndarray
    """(R / RUN,) bool, R a multiple of TOGETHER."""

    @classmethod
    def of(cls, detail: np.ndarray) -> "StoredEntries | None":
        """Of a detail (R, ROW) the runs with a number other than 0; None where a file is to hold all."""
        if len(detail) % TOGETHER:
            return None
        entries = cls(detail.reshape(-1, RUN * ROW).any(1))
        bytes_held = entries.count * ROW + len(entries.masks) * PER_BLOCK
        # A file has those alone that are not 0 up to three quarters of the bytes of all rows.
        return entries if bytes_held <= 0.75 * ROW * len(detail) else None

    @property
    def rows(self) -> np.ndarray:
        """(R,) bool: the rows of these runs."""
        return self.runs.repeat(RUN)

    @property
    def count(self) -> int:
        """Of rows."""
        return RUN * int(np.count_nonzero(self.runs))

    @cached_property
    def blocks(self) -> np.ndarray:
        """(R / TOGETHER,) bool: which blocks of rows hold any."""
        return self.runs.reshape(-1, TOGETHER // RUN).any(1)

    @cached_property
    def masks(self) -> np.ndarray:
        """(K, TOGETHER / RUN) bool: the runs of those blocks."""
        return self.runs.reshape(-1, TOGETHER // RUN)[self.blocks]

    @property
    def lengths(self) -> np.ndarray:
        """(K,) uint8 how many rows each of them holds: they are coded by scales of their own, as they are
        among all rows, so that they keep their codes."""
        return RUN * self.masks.sum(1, dtype=np.uint8)

    def state(self) -> dict[str, np.ndarray]:
        """Bits: which blocks hold any rows, and which of their runs."""
        return {"blocks": np.packbits(self.blocks), "held": np.packbits(self.masks, axis=1)}

    @classmethod
    def from_state(cls, blocks: np.ndarray, masks: np.ndarray, rows: int) -> "StoredEntries":
        """Inverse of `state`, of so many rows in all. Raises ValueError where that cannot be."""
        runs = np.zeros((rows // TOGETHER, TOGETHER // RUN), bool)
        if rows % TOGETHER or blocks.dtype != np.uint8 or blocks.shape != (-(-len(runs) // 8),):
            raise ValueError(f"which of {rows} rows are held should be told by a bit for {TOGETHER}")
        bits = np.unpackbits(blocks)
        some, rest = bits[: len(runs)].astype(bool), bits[len(runs) :]
        if masks.dtype != np.uint8 or masks.shape != (some.sum(), runs.shape[1] // 8) or rest.any():
            raise ValueError(f"which rows are held of {some.sum()} times {TOGETHER} should be told")
        runs[some] = np.unpackbits(masks, axis=1).astype(bool)
        if not runs[some].any(1).all():
            raise ValueError(f"of {TOGETHER} rows that are said to be held none is")
        return cls(runs.ravel())
