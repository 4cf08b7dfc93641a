"""Polygons of a .ply, text or binary: colours of vertices and faces, coordinates of vertices and corners."""

import re
from pathlib import Path

import numpy as np

from formats.errors import BadMesh, listed
from formats.ply_elements import AXES, HUES, Lists, read_elements, rgb_of
from formats.safe_input import read_input
from formats.surfaces.named_files import Beside
from formats.surfaces.pictures import Pictures
from formats.surfaces.polygons import triangulated
from formats.surfaces.surface import (
    Notes,
    Paint,
    Surface,
    Texture,
    check_budget,
    check_indices,
    laid,
    opaque,
    sound_colours,
)

TEXTURE = re.compile(r"comment +texturefile:? +(.+)", re.IGNORECASE)
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


def read_ply(path: Path | str, notes: Notes) -> list[Surface]:
    """Faces and strips. Raises BadMesh, LimitExceeded (before anything is allocated), MissingFile."""
    data = read_input(path)
    lines, elements = read_elements(path, data, BadMesh)
    read = {}
    for element, columns in elements:
        read.setdefault(element, {name.lower(): column for name, column in columns.items()} | columns)
    textures = [
        match[1].strip() for line in lines if (match := TEXTURE.match(line.replace("\t", " ").strip()))
    ]
    return _surfaces(path, read, textures, len(data), notes)


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
        lists = next((faces[key] for key in CORNERS if isinstance(faces.get(key), Lists)), None)
        if lists is None:
            continue
        values = _whole(path, lists.values)
        corners, polygon, corner_indices = cut(path, Lists(lists.counts, values), positions, n_bytes)
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


def _polygons(path, lists: Lists, positions, n_bytes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(F, 3) vertices of triangles, which polygon each is of, and places of its corners in the lists."""
    corner_indices, polygon = triangulated(path, lists.counts, lists.values, positions, n_bytes)
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
    beside, surfaces = Beside(path), []
    numbers = np.where((numbers >= 0) & (numbers < len(textures)), numbers, 0)
    reader = Pictures(len(textures), notes)
    pictures = {n: reader.get(n, lambda n=n: beside.read(textures[n])) for n in np.unique(numbers)}
    pictures = {number: pixels for number, pixels in pictures.items() if pixels is not None}
    if pictures and (rest["colours"] is not None or rest["face_colours"] is not None):
        notes.add("colours of vertices and faces are not used where there is a picture")
    for number in np.unique(numbers):
        chosen = numbers == number
        flat = corners[chosen].reshape(-1)
        faces = np.arange(len(flat), dtype=np.int32).reshape(-1, 3)
        look = {
            "colours": None if rest["colours"] is None else rest["colours"][flat],
            "face_colours": None if rest["face_colours"] is None else rest["face_colours"][chosen],
        }
        if number in pictures:
            paint = Paint(np.ones(4, np.float32), Texture(opaque(pictures[number])))
            look = {"paint": laid(paint, uv[chosen].reshape(-1, 2))}
        surfaces.append(Surface(positions[flat], faces, **look))
    return surfaces


def _coordinates(path, vertices, faces, lists, corner_indices, corners, notes) -> np.ndarray | None:
    """(F, 3, 2) of the corners of triangles, v down: each corner's own (MeshLab's `texcoord`), else its
    vertex's."""
    wedges = faces.get("texcoord")
    if isinstance(wedges, Lists) and corner_indices is not None and (wedges.counts == 2 * lists.counts).all():
        uv = wedges.values.astype(np.float64).reshape(-1, 2)[corner_indices]
    else:
        if isinstance(wedges, Lists) and len(wedges.values):
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
    if (hues := rgb_of(columns)) is None:
        return None
    if "alpha" in columns and isinstance(columns["alpha"], np.ndarray) and len(columns["alpha"]):
        alpha = columns["alpha"]
        if (alpha < (np.iinfo(alpha.dtype).max if alpha.dtype.kind in "ui" else 1)).any():
            notes.add("the transparency of its colours is not shown")
    rgb, most = hues
    return sound_colours(rgb / most)


def _whole(path: Path | str, values: np.ndarray) -> np.ndarray:
    """Indices as int64."""
    if values.dtype.kind == "f" and not (
        (np.abs(values) < 2**53).all() and (values == np.floor(values)).all()
    ):
        raise BadMesh(f"{path}: its faces count vertices by fractions; export the mesh again")
    return values.astype(np.int64)


def _strips(path, lists: Lists, positions, n_bytes: int) -> tuple[np.ndarray, np.ndarray, None]:
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
