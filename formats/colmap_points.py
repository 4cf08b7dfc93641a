"""The sparse points of a COLMAP model, binary or text."""

import struct
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import numpy as np

from formats.colmap_text import check_count, number, numbered_lines
from formats.errors import BadModel
from formats.points import SparsePoints, stride

MOST_ERROR = 1.5
"""Pixels of the photos that were compared. A point that lies farther, on average, from where photos show it
says nothing of them."""


@dataclass(frozen=True, eq=False)
class ListedPoints:
    """The points of a model as its files name them."""

    ids: np.ndarray
    """(N,) uint64, rising."""
    points: SparsePoints
    errors: np.ndarray
    """(N,) float64, pixels."""

    def found(self, seen: np.ndarray) -> np.ndarray:
        """(M,) int64, rising: where the points of some ids are among these, without those that are not."""
        at = np.minimum(np.searchsorted(self.ids, seen), max(len(self.ids) - 1, 0))
        return np.unique(at[self.ids[at] == seen]) if len(self.ids) else np.empty(0, np.int64)

    def sure(self, indices: np.ndarray) -> np.ndarray:
        """Those of `found` that lie where photos show them."""
        return indices[self.errors[indices] <= MOST_ERROR]


HEAD = np.dtype([("id", "<u8"), ("xyz", "<f8", 3), ("rgb", "u1", 3), ("error", "<f8"), ("track", "<u8")])
"""A point before its track, each entry of which has 8 bytes."""


def binary_points(most: int, path: Path, data: bytes, block: int = 1 << 16) -> ListedPoints:
    """At most so many points; of `block` of them at a time the bytes are gathered."""
    (count,) = struct.unpack_from("<Q", data)
    check_count(path, count, len(data), HEAD.itemsize)
    step, at, track = stride(count, most), 8, struct.Struct("<Q").unpack_from
    starts = np.empty(-(-count // step), np.int64)
    for i in range(count):
        (length,) = track(data, at + 43)
        if length > (len(data) - at - HEAD.itemsize) // 8:
            (point,) = track(data, at)
            raise BadModel(f"{path}: the file is truncated in point {point}; copy or export it again")
        if i % step == 0:
            starts[i // step] = at
        at += HEAD.itemsize + 8 * length
    rows, head = np.frombuffer(data, np.uint8), np.arange(HEAD.itemsize)
    parts = np.array_split(starts, -(-len(starts) // block) or 1)
    heads = np.concatenate([rows[part[:, None] + head].view(HEAD)[:, 0] for part in parts])
    return _sorted_points(heads["id"], heads["xyz"], heads["rgb"], heads["error"], step)


def text_points(most: int, path: Path, data: bytes) -> ListedPoints:
    step, rows, ids = stride(data.count(b"\n"), most), [], []
    numbered = (item for item in numbered_lines(path, data) if item[1])
    for line, text in islice(numbered, 0, None, step):
        words = text.split(None, 8)
        if len(words) < 7:
            raise BadModel(f"{path}: line {line}: expected an id, a position and a colour")
        ids.append(number(path, line, words[0], int) % 2**64)
        position = [number(path, line, word, float) for word in words[1:4]]
        colour = [number(path, line, word, int) for word in words[4:7]]
        error = number(path, line, words[7], float) if len(words) > 7 else 0.0
        rows.append((*position, *colour, error))
    table = np.array(rows, np.float64).reshape(-1, 7)
    return _sorted_points(np.array(ids, np.uint64), table[:, :3], table[:, 3:6], table[:, 6], step)


def _sorted_points(
    ids: np.ndarray, positions: np.ndarray, colours: np.ndarray, errors: np.ndarray, step: int
) -> ListedPoints:
    """(N,), (N, 3), (N, 3) and (N,) numbers of every `step`-th point of a file."""
    order = np.argsort(ids)
    order = order[(np.abs(positions[order]) < 1e30).all(1)]
    colours = np.clip(colours[order], 0, 255).astype(np.uint8)
    points = SparsePoints(positions[order], colours, step, len(ids) - len(order))
    return ListedPoints(ids[order], points, errors[order])
