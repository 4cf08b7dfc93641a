"""The elements of a .ply file, text or binary, as columns of numbers."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from formats.errors import FormatError
from formats.surfaces.lines import table, within

MAX_HEADER = 1 << 16
KINDS = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2", "int32": "i4", "uint32": "u4"},
    **{"float": "f4", "double": "f8", "float32": "f4", "float64": "f8"},
}
"""numpy's types, without byte order, by those of a header."""
ENDS = re.compile(rb"(\r\n|\n|\r)end_header[ \t]*(?:\1|\r?\n)")
AXES = ("x", "y", "z")
HUES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))


@dataclass
class Property:
    """One column of an element."""

    name: str
    kind: str
    """numpy's type, without byte order."""
    counted: str | None = None
    """Of a list, the type of its length."""


@dataclass
class Element:
    """A table of the file, as its header states it."""

    name: str
    count: int
    properties: list[Property] = field(default_factory=list)


@dataclass(frozen=True)
class Lists:
    """Lists of numbers of different length."""

    counts: np.ndarray
    values: np.ndarray


def read_elements(
    path: Path | str, data: bytes, wrong: type[FormatError]
) -> tuple[list[str], Iterator[tuple[str, dict[str, np.ndarray | Lists]]]]:
    """The lines of the header; and the elements in turn, each read when it is asked for: its name, and by the
    name of each property its column.

    Counts are held against bytes before anything is allocated. Raises `wrong`.
    """
    end = ENDS.search(data, 0, MAX_HEADER)
    if not data.startswith(b"ply") or end is None:
        raise wrong(f"{path}: not a .ply file with a complete header; export it again")
    text = data[: end.start()].decode("utf-8", "replace")
    lines = text.replace("\r\n", "\n").replace("\r", "\n").split("\n")
    coding, elements = _header(path, lines, wrong)
    body = memoryview(data)[end.end() :]
    tables = _Text(path, bytes(body), wrong) if coding == "ascii" else _Binary(path, body, coding, wrong)
    return lines, ((element.name, tables.read(element)) for element in elements)


def rgb_of(columns: dict[str, np.ndarray | Lists]) -> tuple[np.ndarray, int] | None:
    """(N, 3) float64 red, green and blue of an element, and what they count to; None without them."""
    names = next((hues for hues in HUES if set(hues) <= set(columns)), None)
    if names is None or any(isinstance(columns[name], Lists) for name in names):
        return None
    values = [columns[name] for name in names]
    rgb = np.stack([value.astype(np.float64) for value in values], 1)
    largest = np.nanmax(rgb, initial=0)
    if values[0].dtype.kind == "f":
        return rgb, 255 if largest > 1 else 1
    width = values[0].dtype.itemsize  # wide integers hold colours of 8 or 16 bits
    return rgb, 255 if width == 1 or width > 2 and largest < 256 else 65535


def _header(path: Path | str, lines: list[str], wrong: type[FormatError]) -> tuple[str, list[Element]]:
    coding, elements = "", []
    for words in (line.split() for line in lines[1:]):
        if words[:1] == ["format"] and len(words) > 1:
            coding = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            if not words[2].isdecimal() or len(words[2]) > 15:
                raise wrong(f"{path}: counts {words[2][:40]!r} elements {words[1][:40]!r}; export it again")
            elements.append(Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            elements[-1].properties.append(_property(path, words, wrong))
    if coding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise wrong(f"{path}: unknown .ply format {coding[:40]!r}, expected ascii or binary")
    for element in elements:
        names = [each.name for each in element.properties]
        if len(set(names)) < len(names):
            raise wrong(f"{path}: two properties of {element.name[:40]!r} share a name; export it again")
    return coding, elements


def _property(path: Path | str, words: list[str], wrong: type[FormatError]) -> Property:
    if len(words) == 3 and words[1] in KINDS:
        return Property(words[2], KINDS[words[1]])
    if len(words) == 5 and words[1] == "list" and words[2] in KINDS and words[3] in KINDS:
        return Property(words[4], KINDS[words[3]], KINDS[words[2]])
    raise wrong(f"{path}: a property {' '.join(words[1:])[:40]!r} that is not understood; export it again")


class _Binary:
    """The elements behind a binary header, in turn."""

    def __init__(self, path: Path | str, data: memoryview, coding: str, wrong: type[FormatError]):
        self.path, self.data, self.wrong, self.at = path, data, wrong, 0
        self.order = "<" if coding == "binary_little_endian" else ">"

    def read(self, element: Element) -> dict:
        """A column, or a Lists, for each property."""
        least = sum(np.dtype(each.counted or each.kind).itemsize for each in element.properties)
        if element.count * least > len(self.data) - self.at:
            raise self.wrong(
                f"{self.path}: ends before the last of {element.count:,} {element.name[:40]!r}; copy or "
                "export it again"
            )
        if not least or not element.count:
            return {
                each.name: Lists(np.empty(0, int), np.empty(0)) if each.counted else np.empty(0)
                for each in element.properties
            }
        return self._alike(element) or self._walked(element)

    def _alike(self, element: Element) -> dict | None:
        """All rows at once, where their lists are as long as those of the first."""
        fields, lengths, at = [], {}, self.at
        for number, each in enumerate(element.properties):
            if each.counted:
                length = self._count(each, at)
                lengths[each.name] = length
                fields += [
                    (f"n{number}", self.order + each.counted),
                    (f"p{number}", self.order + each.kind, (length,)),
                ]
            else:
                fields.append((f"p{number}", self.order + each.kind))
            at = self.at + np.dtype(fields).itemsize
        record = np.dtype(fields)
        if element.count * record.itemsize > len(self.data) - self.at:
            return None
        rows = np.frombuffer(self.data, record, element.count, self.at)
        columns = {}
        for number, each in enumerate(element.properties):
            column = rows[f"p{number}"]
            if each.counted:
                if (rows[f"n{number}"] != lengths[each.name]).any():
                    return None
                counts = np.full(element.count, lengths[each.name])
                columns[each.name] = Lists(counts, np.ascontiguousarray(column).reshape(-1))
            else:
                columns[each.name] = column
        self.at += element.count * record.itemsize
        return columns

    def _count(self, each: Property, at: int) -> int:
        kind = np.dtype(self.order + each.counted)
        if at + kind.itemsize > len(self.data):
            raise self.wrong(f"{self.path}: ends within a list; copy or export it again")
        number = np.frombuffer(self.data, kind, 1, at)[0]
        size = np.dtype(each.kind).itemsize
        if not 0 <= number <= (len(self.data) - at - kind.itemsize) / size:
            raise self.wrong(
                f"{self.path}: a list of {number} numbers is longer than the file; export it again"
            )
        return int(number)

    def _walked(self, element: Element) -> dict:
        """Row by row; the numbers of a list are cut out as bytes."""
        columns = [(each, np.dtype(self.order + each.kind), [], []) for each in element.properties]
        for _ in range(element.count):
            for each, kind, parts, counts in columns:
                length = 1
                if each.counted:
                    length = self._count(each, self.at)
                    counts.append(length)
                    self.at += np.dtype(each.counted).itemsize
                stop = self.at + length * kind.itemsize
                if stop > len(self.data):
                    raise self.wrong(
                        f"{self.path}: ends within {element.name[:40]!r}; copy or export it again"
                    )
                parts.append(self.data[self.at : stop])
                self.at = stop
        read = {each.name: np.frombuffer(b"".join(parts), kind) for each, kind, parts, _ in columns}
        return read | {
            each.name: Lists(np.array(counts, int), read[each.name])
            for each, _, _, counts in columns
            if each.counted
        }


class _Text:
    """The lines behind a header of text, in turn."""

    def __init__(self, path: Path | str, data: bytes, wrong: type[FormatError]):
        self.path, self.wrong = path, wrong
        self.rows = [row for row in data.decode("latin-1").splitlines() if row.strip()]
        self.at = 0

    def read(self, element: Element) -> dict:
        if not element.properties:
            return {}
        if element.count > len(self.rows) - self.at:
            raise self.wrong(
                f"{self.path}: ends before the last of {element.count:,} {element.name[:40]!r}; copy or "
                "export it again"
            )
        lines = self.rows[self.at : self.at + element.count]
        self.at += element.count
        try:
            return self._columns(element, lines)
        except (ValueError, IndexError, OverflowError) as error:
            raise self.wrong(
                f"{self.path}: a line of {element.name[:40]!r} is not what the header says ({error}); "
                "export it again"
            ) from error

    def _columns(self, element: Element, rows: list[str]) -> dict:
        columns, offsets = {}, np.zeros(len(rows), int)
        flat, widths, starts = table(rows)
        for each in element.properties:
            if (offsets >= widths).any():
                raise ValueError("too few numbers")
            values = flat[starts + offsets]
            offsets = offsets + 1
            if not each.counted:
                columns[each.name] = _as_stored(values, each.kind)
                continue
            counts = values.astype(int)
            if (counts < 0).any() or (counts != values).any() or (offsets + counts > widths).any():
                raise ValueError("a list is longer than its line")
            row_values = flat[np.repeat(starts + offsets, counts) + within(counts)]
            columns[each.name] = Lists(counts, _as_stored(row_values, each.kind))
            offsets = offsets + counts
        return columns


def _as_stored(values: np.ndarray, kind: str) -> np.ndarray:
    """Of text: whole numbers as integers of their type, so that they are scaled as in binary files."""
    if kind.startswith("f"):
        return values
    limits = np.iinfo(kind)
    if not ((values >= limits.min) & (values <= limits.max)).all():
        raise ValueError(f"a number does not fit {kind}")
    return values.astype(kind)
