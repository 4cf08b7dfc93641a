"""Which rows of a hash grid (encodings/hash_runs.py) a file holds."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fusedrf_cli.engine.encodings.hash_runs import ROW, RUN

TOGETHER = 64  # rows that files code by one scale
PER_BLOCK = TOGETHER // RUN // 8 + 1 + 2 * ROW  # bytes of those: which are held, how many, and scales


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
