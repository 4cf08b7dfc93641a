"""Sparse points of structure from motion: positions with colours, read from a .ply file."""

import io
import re
import warnings
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path

import numpy as np

from formats.atomic import atomic_writer
from formats.errors import BadModel, counted
from formats.safe_input import read_input

MAX_BYTES = 2**31
MAX_POINTS = 5_000_000
"""Of more points every second, third and so on is read."""
MAX_HEADER = 1 << 16
TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
ENDS = re.compile(rb"\nend_header\r?\n")


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Points on surfaces, in world units; finite."""

    positions: np.ndarray
    """(N, 3) float64."""
    colours: np.ndarray
    """(N, 3) uint8 sRGB; white where the file has none."""
    thinned: int = 1
    """One out of so many of the file's points is here, from the first on."""
    damaged: int = 0
    """Points of the file that are left out, since they are NaN, infinite or beyond 1e30."""

    def moved(self, matrix: np.ndarray) -> "SparsePoints":
        """The same points behind an affine (3, 4) or (4, 4)."""
        return replace(self, positions=self.positions @ matrix[:3, :3].T + matrix[:3, 3])


def stride(count: int, most: int = MAX_POINTS) -> int:
    """How many points of a file one is read of, so that there are at most so many."""
    return max(1, -(-count // most))


def points_notes(path: Path | str, points: SparsePoints | None) -> list[str]:
    """Sentences where not all points of a file were read."""
    notes = []
    if points is not None and points.thinned > 1:
        notes.append(
            f"{path}: of its many sparse points one in {points.thinned} is read, "
            f"{len(points.positions):,} in all"
        )
    if points is not None and points.damaged:
        count = counted(points.damaged, "sparse point is", "sparse points are")
        notes.append(f"{path}: {count} NaN, infinite or beyond 1e30, and left out")
    return notes


def read_ply_points(path: Path | str, most: int = MAX_POINTS) -> SparsePoints:
    """The vertices of a .ply, text or binary, without those that are NaN, infinite or beyond 1e30; of more
    than `most` only some (`thinned`). Other elements are ignored.

    Raises BadModel, LimitExceeded (before anything is allocated), MissingFile.
    """
    data = read_input(path, MAX_BYTES)
    end = ENDS.search(data, 0, MAX_HEADER)
    if not data.startswith(b"ply") or end is None:
        raise BadModel(f"{path}: not a .ply file with a complete header; export the points again")
    coding, count, fields = _header(path, data[: end.start()].decode("latin-1").split("\n"))
    names = [name for name, _ in fields]
    if not {"x", "y", "z"} <= set(names):
        raise BadModel(f"{path}: its vertices lack x, y or z; export the points again")
    step = stride(count, most)
    if coding == "ascii":
        table = _text_table(path, data, end.end(), count, step, len(fields))
        columns = {name: table[:, i] for i, name in enumerate(names)}
    else:
        order = "<" if coding == "binary_little_endian" else ">"
        record = np.dtype([(name, order + kind) for name, kind in fields])
        if count * record.itemsize > len(data) - end.end():
            raise BadModel(f"{path}: ends before the last of {count:,} points; copy or export it again")
        columns = np.frombuffer(data, record, count, end.end())[::step]
    positions = np.stack([columns[axis].astype(np.float64) for axis in "xyz"], 1)
    sound = (np.abs(positions) < 1e30).all(1)
    colours = _colours(columns, dict(fields))[sound]
    return SparsePoints(positions[sound], colours, step, int((~sound).sum()))


def write_ply_points(path: Path | str, points: SparsePoints) -> None:
    """A binary .ply of float32 positions and colours. Raises ResourceError."""
    kinds = [(axis, "<f4") for axis in "xyz"] + [(hue, "u1") for hue in ("red", "green", "blue")]
    table = np.empty(len(points.positions), kinds)
    for i, axis in enumerate("xyz"):
        table[axis] = points.positions[:, i]
    for i, hue in enumerate(("red", "green", "blue")):
        table[hue] = points.colours[:, i]
    properties = [f"property {'float' if kind == '<f4' else 'uchar'} {name}" for name, kind in kinds]
    head = ["ply", "format binary_little_endian 1.0", f"element vertex {len(table)}", *properties]
    with atomic_writer(path) as file:
        file.write("\n".join([*head, "end_header", ""]).encode() + table.tobytes())


def _header(path: Path | str, lines: list[str]) -> tuple[str, int, list[tuple[str, str]]]:
    """Coding, how many vertices, and their properties as (name, numpy type without byte order)."""
    coding, element, count, fields = "", "", 0, []
    for words in (line.split() for line in lines[1:]):
        if words[:1] == ["format"] and len(words) > 1:
            coding = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            if element == "" and words[1] != "vertex":
                raise BadModel(
                    f"{path}: begins with {words[1][:40]!r}, expected points as its vertices first"
                )
            element = words[1]
            count = _count(path, words[2]) if element == "vertex" else count
        elif words[:1] == ["property"] and element == "vertex":
            if len(words) != 3 or words[1] not in TYPES:
                raise BadModel(
                    f"{path}: a vertex property {' '.join(words[1:])[:40]!r} that is not a single number; "
                    "export the points again"
                )
            fields.append((words[2], TYPES[words[1]]))
    if coding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise BadModel(f"{path}: unknown .ply format {coding[:40]!r}, expected ascii or binary")
    if len({name for name, _ in fields}) < len(fields):
        raise BadModel(f"{path}: two properties of its vertices share a name; export the points again")
    return coding, count, fields


def _count(path: Path | str, digits: str) -> int:
    count = int(digits) if digits.isdecimal() and len(digits) < 16 else -1
    if count < 0:
        raise BadModel(f"{path}: the vertex count is {digits[:40]!r}, expected a whole number")
    return count


def _text_table(path: Path | str, data: bytes, start: int, count: int, step: int, width: int) -> np.ndarray:
    """(N, width) numbers of every `step`-th of `count` lines from a byte on."""
    if not count:
        return np.empty((0, width))
    lines = io.BytesIO(data)
    lines.seek(start)
    expected = -(-count // step)
    try:
        if count > len(data) - start:  # a line is a byte at least
            raise ValueError
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # lines that are all empty
            table = np.loadtxt(islice(lines, 0, count, step), np.float64, comments=None, ndmin=2)
    except ValueError:
        table = np.empty((0, 0))
    if table.shape != (expected, width):
        raise BadModel(
            f"{path}: expected {count:,} lines of {width} numbers after the header; export it again"
        )
    return table


def _colours(columns, kinds: dict[str, str]) -> np.ndarray:
    """(N, 3) uint8 of red, green, blue, whether counted to 255 or to 1."""
    for names in (("red", "green", "blue"), ("r", "g", "b")):
        if set(names) <= set(kinds):
            values = np.stack([columns[name].astype(np.float64) for name in names], 1)
            unit = kinds[names[0]].startswith("f") and not (values > 1).any()
            return np.clip(np.nan_to_num(values) * (255.0 if unit else 1.0), 0, 255).astype(np.uint8)
    return np.full((len(columns["x"]), 3), 255, np.uint8)
