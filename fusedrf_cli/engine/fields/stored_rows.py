"""Which rows of a hash grid a file holds: of an object that was cut out those that it can ask, the others
being 0 (SPEC, section 2.5)."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fusedrf_cli.engine.fields.computed import runs_of
from fusedrf_cli.engine.settings import current

RUN = 4  # rows that are held together: neighbours share a cache line
TOGETHER = 64  # rows that files code by one scale


@dataclass(frozen=True)
class StoredRowsConfig:
    """When files leave rows out."""

    most_held: float = 0.75
    """Of the bytes of all rows, up to which a file has the held ones alone."""
    max_numbers: int = 2 << 30
    """Of a field that is read: of a hash grid a file may hold few rows."""


@dataclass(frozen=True)
class StoredRows:
    """Which runs of RUN rows a file holds."""

    runs: np.ndarray
    """(K * TOGETHER / RUN,) bool, of the least K blocks of TOGETHER rows that have them all."""
    all: int
    """Rows, of which K TOGETHER - `all` are lacking at the end."""

    @classmethod
    def of(cls, numbers: np.ndarray) -> "StoredRows | None":
        """Of rows (R, C) the runs with a number other than 0; None where a file is to hold all."""
        held = None if len(numbers) % RUN else cls.other_than_0(numbers)
        return held if held and held.saves(numbers.shape[1]) else None

    @classmethod
    def other_than_0(cls, numbers: np.ndarray) -> "StoredRows":
        """The runs of rows (R, C) with a number other than 0; R is a multiple of RUN."""
        held = numbers.reshape(len(numbers) // RUN, -1).any(1)
        return cls(np.pad(held, (0, -len(held) % (TOGETHER // RUN))), len(numbers))

    def first(self, count: int) -> "StoredRows":
        """Those of the first so many rows, a multiple of RUN."""
        return StoredRows(self.runs & (np.arange(len(self.runs)) < count // RUN), self.all)

    def spread(self, count: int) -> "StoredRows":
        """So many rows of these, rounded down to runs, in as many blocks as they can be: no others take more
        to tell."""
        blocks = self.runs.reshape(-1, TOGETHER // RUN)
        nth = (blocks.cumsum(1) - 1).ravel()[self.runs]
        chosen, runs = np.argsort(nth, kind="stable")[: max(count // RUN, 1)], np.zeros_like(self.runs)
        runs[np.flatnonzero(self.runs)[chosen]] = True
        return StoredRows(runs, self.all)

    def saves(self, width: int) -> bool:
        """Whether a file is to have these alone of all rows, of so many numbers."""
        most = current(StoredRowsConfig).most_held * width * self.all
        return self.count * width + self.told(width) // 8 <= most

    @cached_property
    def rows(self) -> np.ndarray:
        """(R,) bool: the rows of these runs."""
        return self.runs.repeat(RUN)[: self.all]

    @property
    def count(self) -> int:
        """Of rows."""
        return RUN * int(np.count_nonzero(self.runs))

    @cached_property
    def blocks(self) -> np.ndarray:
        """(K,) bool: which blocks of rows hold any."""
        return self.runs.reshape(-1, TOGETHER // RUN).any(1)

    @cached_property
    def masks(self) -> np.ndarray:
        """(B, TOGETHER / RUN) bool: the runs of those blocks."""
        return self.runs.reshape(-1, TOGETHER // RUN)[self.blocks]

    @property
    def lengths(self) -> np.ndarray:
        """(B,) uint8 how many rows each of them holds: they are coded by scales of their own, as they are
        among all rows, so that they keep their codes."""
        return RUN * self.masks.sum(1, dtype=np.uint8)

    def told(self, width: int) -> int:
        """Bits that tell of them, at most, of rows of so many numbers: of a block that it holds any, which,
        how many, and scales, where these are more than those of as many whole blocks."""
        few, scales = len(self.masks), len(self.masks) - self.count // TOGETHER
        return len(self.blocks) + (TOGETHER // RUN + 8) * few + 16 * width * scales

    def state(self) -> dict[str, np.ndarray]:
        """Bits: which blocks hold any rows, and which of their runs."""
        return {"blocks": np.packbits(self.blocks), "held": np.packbits(self.masks, axis=1)}

    @classmethod
    def from_state(cls, blocks: np.ndarray, masks: np.ndarray, rows: int) -> "StoredRows":
        """Inverse of `state`, of so many rows in all. Raises ValueError where that cannot be."""
        runs = np.zeros((-(-rows // TOGETHER), TOGETHER // RUN), bool)
        if rows % RUN or blocks.dtype != np.uint8 or blocks.shape != (-(-len(runs) // 8),):
            raise ValueError(f"which of {rows} rows are held should be told by a bit for {TOGETHER}")
        bits = np.unpackbits(blocks)
        some, rest = bits[: len(runs)].astype(bool), bits[len(runs) :]
        if masks.dtype != np.uint8 or masks.shape != (some.sum(), runs.shape[1] // 8) or rest.any():
            raise ValueError(f"which rows are held of {some.sum()} times {TOGETHER} should be told")
        runs[some] = np.unpackbits(masks, axis=1).astype(bool)
        if not runs[some].any(1).all():
            raise ValueError(f"of {TOGETHER} rows that are said to be held none is")
        if runs.ravel()[rows // RUN :].any():
            raise ValueError(f"rows are said to be held beyond the {rows} that there are")
        return cls(runs.ravel(), rows)


def folded(name: str, numbers: np.ndarray) -> dict[str, np.ndarray]:
    """The arrays that a file has of rows (R, C) of a name: themselves, or those alone that it holds, and
    which these are."""
    held = StoredRows.of(numbers)
    if held is None:
        return {name: numbers}
    told = {f"{name}_{which}": bits for which, bits in held.state().items()}
    return {name: numbers[held.rows], runs_of(name): held.lengths} | told


def unfolded(name: str, shape: tuple[int, int], arrays: Mapping[str, np.ndarray]) -> np.ndarray | None:
    """All rows (R, C) of an array of a file, which may hold few of them; None: it is not there. Raises
    ValueError naming what does not fit."""
    stored = arrays.get(name)
    blocks, masks = (arrays.get(f"{name}_{which}") for which in ("blocks", "held"))
    if blocks is None or masks is None:
        return stored
    held = StoredRows.from_state(blocks, masks, shape[0])
    lengths = arrays.get(runs_of(name))
    if lengths is None or not np.array_equal(lengths, held.lengths):
        raise ValueError(f"the runs of array '{name}' are not those of its blocks")
    if stored is None or stored.shape != (held.count, shape[1]):
        have = "nothing" if stored is None else list(stored.shape)
        raise ValueError(f"array '{name}' should have shape {[held.count, shape[1]]}, found {have}")
    whole = np.zeros(shape, stored.dtype)
    whole[held.rows] = stored
    return whole
