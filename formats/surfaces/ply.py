"""Polygons of a .ply, text or binary: colours of vertices and faces, coordinates of vertices and corners."""

import re
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from formats.errors import BadMesh, FormatError
from formats.points import MAX_HEADER, TYPES
from formats.safe_input import read_input
from formats.surfaces.lines import numbers_in
from formats.surfaces.named_files import Beside
from formats.surfaces.pictures import read_picture, share_of
from formats.surfaces.polygons import triangulated
from formats.surfaces.surface import (
    Notes,
    Paint,
    Surface,
    Texture,
    check_budget,
    check_indices,
    laid,
    listed,
    opaque,
    sound_colours,
)

MAX_FILE = 2**31
ENDS = re.compile(rb"(\r\n|\n|\r)end_header[ \t]*(?:\1|\r?\n)")
TEXTURE = re.compile(r"comment +texturefile:? +(.+)", re.IGNORECASE)
AXES = ("x", "y", "z")
HUES = (("red", "green", "blue"), ("r", "g", "b"), ("diffuse_red", "diffuse_green", "diffuse_blue"))
CORNERS = ("vertex_indices", "vertex_index")
COORDINATES = tuple(
    (f"{before}{u}{after}", f"{before}{v}{after}")
    for u, v in ("st", "uv")
    for before in ("", "texture_", "texcoord_", "tex", "tex_", "t")
    for after in ("", "0")
)
OF_VERTICES = {*AXES, "nx", "ny", "nz", "alpha", "flags", "radius", *sum(HUES + COORDINATES, ())}
OF_FACES = {*CORNERS, "nx", "ny", "nz", "alpha", "flags", "texcoord", "texnumber", *sum(HUES, ())}
OF_NO_LOOKS = ("camera", "range_grid")


@dataclass
class _Property:
    name: str
    kind: str
    """numpy's type, without byte order."""
    counted: str | None = None
    """Of a list, the type of its length."""


@dataclass
class _Element:
    name: str
    count: int
    properties: list[_Property] = field(default_factory=list)


@dataclass(frozen=True)
class _List:
    """Lists of numbers of different length."""

    counts: np.ndarray
    values: np.ndarray


def read_ply(path: Path | str, notes: Notes) -> list[Surface]:
    """Faces and strips. Raises BadMesh, LimitExceeded (before anything is allocated), MissingFile."""
    data = read_input(path, MAX_FILE)
    end = ENDS.search(data, 0, MAX_HEADER)
    if end is None:
        raise BadMesh(f"{path}: not a .ply file with a complete header; export the mesh again")
    lines = (
        data[: end.start()].decode("utf-8", "replace").replace("\r\n", "\n").replace("\r", "\n").split("\n")
    )
    coding, elements = _header(path, lines)
    body = memoryview(data)[end.end() :]
    tables = _Text(path, bytes(body)) if coding == "ascii" else _Binary(path, body, coding)
    read = {}
    for element in elements:
        columns = tables.read(element)
        read.setdefault(element.name, {name.lower(): column for name, column in columns.items()} | columns)
    textures = [
        match[1].strip() for line in lines if (match := TEXTURE.match(line.replace("\t", " ").strip()))
    ]
    return _surfaces(path, read, textures, len(data), notes)


def _header(path: Path | str, lines: list[str]) -> tuple[str, list[_Element]]:
    coding, elements = "", []
    for words in (line.split() for line in lines[1:]):
        if words[:1] == ["format"] and len(words) > 1:
            coding = words[1]
        elif words[:1] == ["element"] and len(words) == 3:
            if not words[2].isdecimal() or len(words[2]) > 15:
                raise BadMesh(f"{path}: counts {words[2][:40]!r} elements {words[1][:40]!r}; export it again")
            elements.append(_Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            elements[-1].properties.append(_property(path, words))
    if coding not in ("ascii", "binary_little_endian", "binary_big_endian"):
        raise BadMesh(f"{path}: unknown .ply format {coding[:40]!r}, expected ascii or binary")
    for element in elements:
        names = [each.name for each in element.properties]
        if len(set(names)) < len(names):
            raise BadMesh(f"{path}: two properties of {element.name[:40]!r} share a name; export it again")
    return coding, elements


def _property(path: Path | str, words: list[str]) -> _Property:
    if len(words) == 3 and words[1] in TYPES:
        return _Property(words[2], TYPES[words[1]])
    if len(words) == 5 and words[1] == "list" and words[2] in TYPES and words[3] in TYPES:
        return _Property(words[4], TYPES[words[3]], TYPES[words[2]])
    raise BadMesh(f"{path}: a property {' '.join(words[1:])[:40]!r} that is not understood; export it again")


class _Binary:
    """The elements behind a binary header, in turn."""

    def __init__(self, path: Path | str, data: memoryview, coding: str):
        self.path, self.data, self.at = path, data, 0
        self.order = "<" if coding == "binary_little_endian" else ">"

    def read(self, element: _Element) -> dict:
        """A column, or a _List, for each property."""
        least = sum(np.dtype(each.counted or each.kind).itemsize for each in element.properties)
        if element.count * least > len(self.data) - self.at:
            raise BadMesh(
                f"{self.path}: ends before the last of {element.count:,} {element.name[:40]!r}; copy or "
                "export it again"
            )
        if not least or not element.count:
            return {
                each.name: _List(np.empty(0, int), np.empty(0)) if each.counted else np.empty(0)
                for each in element.properties
            }
        return self._alike(element) or self._walked(element)

    def _alike(self, element: _Element) -> dict | None:
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
                columns[each.name] = _List(counts, np.ascontiguousarray(column).reshape(-1))
            else:
                columns[each.name] = column
        self.at += element.count * record.itemsize
        return columns

    def _count(self, each: _Property, at: int) -> int:
        kind = np.dtype(self.order + each.counted)
        if at + kind.itemsize > len(self.data):
            raise BadMesh(f"{self.path}: ends within a list; copy or export it again")
        number = np.frombuffer(self.data, kind, 1, at)[0]
        size = np.dtype(each.kind).itemsize
        if not 0 <= number <= (len(self.data) - at - kind.itemsize) / size:
            raise BadMesh(f"{self.path}: a list of {number} numbers is longer than the file; export it again")
        return int(number)

    def _walked(self, element: _Element) -> dict:
        """Row by row; the numbers of a list are cut out as bytes."""
        parts = [[] for _ in element.properties]
        counts = [[] for _ in element.properties]
        data, order, at = self.data, self.order, self.at
        sizes = [np.dtype(each.kind).itemsize for each in element.properties]
        count_kinds = [each.counted and np.dtype(order + each.counted) for each in element.properties]
        property_order = range(len(element.properties))
        for _ in range(element.count):
            for i in property_order:
                length = 1
                if count_kinds[i]:
                    length = self._count(element.properties[i], at)
                    counts[i].append(length)
                    at += count_kinds[i].itemsize
                stop = at + length * sizes[i]
                if stop > len(data):
                    raise BadMesh(f"{self.path}: ends within {element.name[:40]!r}; copy or export it again")
                parts[i].append(data[at:stop])
                at = stop
        self.at, columns = at, {}
        for i, each in enumerate(element.properties):
            values = np.frombuffer(b"".join(parts[i]), order + each.kind)
            columns[each.name] = _List(np.array(counts[i], int), values) if each.counted else values
        return columns


class _Text:
    """The lines behind a header of text, in turn."""

    def __init__(self, path: Path | str, data: bytes):
        self.path, self.left = path, data
        self.rows = [row for row in data.decode("latin-1").splitlines() if row.strip()]
        self.at = 0

    def read(self, element: _Element) -> dict:
        if not element.properties:
            return {}
        if element.count > len(self.rows) - self.at:
            raise BadMesh(
                f"{self.path}: ends before the last of {element.count:,} {element.name[:40]!r}; copy or "
                "export it again"
            )
        lines = self.rows[self.at : self.at + element.count]
        self.at += element.count
        try:
            return self._columns(element, lines)
        except (ValueError, IndexError, OverflowError) as error:
            raise BadMesh(
                f"{self.path}: a line of {element.name[:40]!r} is not what the header says ({error}); "
                "export it again"
            ) from error

    def _columns(self, element: _Element, rows: list[str]) -> dict:
        columns, offsets = {}, np.zeros(len(rows), int)
        widths = np.array([len(row.split()) for row in rows], int)
        flat = numbers_in(" ".join(rows))
        if len(flat) != widths.sum():
            raise ValueError("words that are no numbers")
        starts = np.cumsum(widths) - widths
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
            within = np.arange(counts.sum()) - np.repeat(np.cumsum(counts) - counts, counts)
            row_values = flat[np.repeat(starts + offsets, counts) + within]
            columns[each.name] = _List(counts, _as_stored(row_values, each.kind))
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


# --- what the elements mean ---------------------------------------------------------------------------------


def _surfaces(path, read: dict[str, dict], textures: list[str], n_bytes: int, notes: Notes) -> list[Surface]:
    vertices = read.get("vertex", {})
    if not set(AXES) <= set(vertices):
        raise BadMesh(f"{path}: its vertices lack x, y or z; export the mesh again")
    positions = np.stack([vertices[axis].astype(np.float64) for axis in AXES], 1)
    colours, surfaces = _colours(vertices, notes), []
    _tell_unused(read, notes)
    for name, cut in (("face", _polygons), ("tristrips", _strips)):
        faces = read.get(name, {})
        lists = next((faces[key] for key in CORNERS if isinstance(faces.get(key), _List)), None)
        if lists is None:
            continue
        values = _whole(path, lists.values)
        corners, polygon, corner_indices = cut(path, _List(lists.counts, values), positions, n_bytes)
        if not len(corners):
            continue
        rest = _one_colour(colours, _colours(faces, notes), polygon, notes)
        uv = _coordinates(path, vertices, faces, lists, corner_indices, corners, notes)
        if uv is not None and textures:
            numbers = _numbers_of(faces, polygon)
            surfaces += _textured(path, positions, corners, uv, numbers, textures, rest, notes)
            continue
        if textures:
            notes.add(f"its pictures are not shown, since it has no coordinates: {listed(textures)}")
        elif uv is not None:
            notes.add("has coordinates for a picture, but names none (comment TextureFile)")
        surfaces.append(
            Surface(positions.copy() if surfaces else positions, corners.astype(np.int32), **rest)
        )
    return surfaces


def _tell_unused(read: dict[str, dict], notes: Notes) -> None:
    """Note elements and properties that are neither shape nor colour."""
    known = {"vertex": OF_VERTICES, "face": OF_FACES, "tristrips": OF_FACES}
    unused = [name for name in read if name not in known and name not in OF_NO_LOOKS]
    for element, names in known.items():
        unused += [
            f"{name} ({element})" for name in read.get(element, {}) if name.islower() and name not in names
        ]
    if unused:
        notes.add(f"holds numbers that are not shown: {listed(unused)}")


def _polygons(path, lists: _List, positions, n_bytes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(F, 3) vertices of triangles, which polygon each is of, and places of its corners in the lists."""
    check_budget(path, int(np.maximum(lists.counts - 2, 0).sum()), n_bytes)
    check_indices(path, lists.values, len(positions))
    corner_indices, polygon = triangulated(lists.counts, lists.values, positions)
    return lists.values[corner_indices], polygon, corner_indices


def _one_colour(colours, face_colours, polygon, notes: Notes) -> dict:
    """Colours of vertices, or where those are all the same, of faces."""
    if face_colours is not None and colours is not None:
        plain = len(colours) and (colours == colours[0]).all()
        notes.add(
            f"has colours of vertices and of faces; those of {'faces' if plain else 'vertices'} are shown"
        )
        colours, face_colours = (None, face_colours) if plain else (colours, None)
    return {"colours": colours, "face_colours": None if face_colours is None else face_colours[polygon]}


def _textured(path, positions, corners, uv, numbers, textures, rest, notes: Notes) -> list[Surface]:
    """A surface for each picture; every corner becomes a vertex of its own."""
    beside, share, surfaces = Beside(path), share_of(len(textures), notes), []
    numbers = np.where((numbers >= 0) & (numbers < len(textures)), numbers, 0)
    pictures: dict[int, np.ndarray] = {}
    for number in np.unique(numbers):
        try:
            data, file = beside.read(textures[number])
            pictures[number] = read_picture(data, file.name, share, notes)
        except FormatError as error:
            notes.add(f"a texture is not shown: {error}")
    if pictures and (rest["colours"] is not None or rest["face_colours"] is not None):
        notes.add("colours of vertices and faces are not used where there is a picture")
    for number in np.unique(numbers):
        chosen = numbers == number
        flat = corners[chosen].reshape(-1)
        faces = np.arange(len(flat), dtype=np.int32).reshape(-1, 3)
        if number in pictures:
            texture = Texture(opaque(pictures[number]))
            paint = laid(Paint(np.ones(4, np.float32), texture), uv[chosen].reshape(-1, 2))
            surfaces.append(Surface(positions[flat], faces, paint))
            continue
        colours, face_colours = rest["colours"], rest["face_colours"]
        colours = None if colours is None else colours[flat]
        face_colours = None if face_colours is None else face_colours[chosen]
        surfaces.append(Surface(positions[flat], faces, colours=colours, face_colours=face_colours))
    return surfaces


def _coordinates(path, vertices, faces, lists, corner_indices, corners, notes) -> np.ndarray | None:
    """(F, 3, 2) of the corners of triangles, v down: each corner's own (MeshLab's `texcoord`), else its
    vertex's."""
    wedges = faces.get("texcoord")
    if isinstance(wedges, _List) and corner_indices is not None and (wedges.counts == 2 * lists.counts).all():
        uv = wedges.values.astype(np.float64).reshape(-1, 2)[corner_indices]
    else:
        if isinstance(wedges, _List) and len(wedges.values):
            notes.add("coordinates of corners that are not two a corner are not used")
        names = next((pair for pair in COORDINATES if set(pair) <= set(vertices)), None)
        if names is None:
            return None
        uv = np.stack([vertices[name].astype(np.float64) for name in names], 1)[corners]
    return np.stack([uv[..., 0], 1 - uv[..., 1]], -1)


def _numbers_of(faces: dict, polygon: np.ndarray) -> np.ndarray:
    """(F,) which picture each triangle shows."""
    number = faces.get("texnumber")
    if isinstance(number, np.ndarray) and len(number):
        return np.nan_to_num(number.astype(np.float64), nan=0.0).astype(int)[polygon]
    return np.zeros(len(polygon), int)


def _colours(columns: dict, notes: Notes) -> np.ndarray | None:
    names = next((hues for hues in HUES if set(hues) <= set(columns)), None)
    if names is None or any(isinstance(columns[name], _List) for name in names):
        return None
    if "alpha" in columns and isinstance(columns["alpha"], np.ndarray) and len(columns["alpha"]):
        alpha = columns["alpha"]
        if (alpha < (np.iinfo(alpha.dtype).max if alpha.dtype.kind in "ui" else 1)).any():
            notes.add("the transparency of its colours is not shown")
    values = [columns[name] for name in names]
    is_integer = values[0].dtype.kind in "ui"
    rgb = np.stack([value.astype(np.float64) for value in values], 1)
    largest = np.nanmax(rgb, initial=0)
    if is_integer:  # wide integers hold colours of 8 or 16 bits
        width = values[0].dtype.itemsize
        most = 255 if width == 1 or width > 2 and largest < 256 else 65535
    else:
        most = 255 if largest > 1 else 1
    return sound_colours(rgb / most)


def _whole(path: Path | str, values: np.ndarray) -> np.ndarray:
    """Indices as int64."""
    if values.dtype.kind == "f" and not (
        (np.abs(values) < 2**53).all() and (values == np.floor(values)).all()
    ):
        raise BadMesh(f"{path}: its faces count vertices by fractions; export the mesh again")
    return values.astype(np.int64)


def _strips(path, lists: _List, positions, n_bytes: int) -> tuple[np.ndarray, np.ndarray, None]:
    """(F, 3) corners of strips that -1 ends, and which strip each is of."""
    values = lists.values
    ends = np.repeat(np.arange(len(lists.counts)), lists.counts)
    number = np.arange(len(values))
    breaks = (values < 0) | np.concatenate([[True], ends[1:] != ends[:-1]])[: len(values)]
    first = np.maximum.accumulate(np.where(breaks, number + (values < 0), 0))
    faces = np.stack([values[:-2], values[1:-1], values[2:]], 1) if len(values) > 2 else np.empty((0, 3), int)
    odd = (number - first)[: len(faces)] % 2 == 1
    faces[odd] = faces[odd][:, [0, 2, 1]]
    sound = (faces >= 0).all(1) & (first[2:][: len(faces)] <= number[: len(faces)])
    faces = faces[sound]
    check_budget(path, len(faces), n_bytes)
    check_indices(path, faces.reshape(-1), len(positions))
    return faces, ends[: len(sound)][sound], None
