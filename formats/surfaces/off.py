""".off: polygons as text, with colours of vertices and faces (Geomview's OFF and COFF)."""

import re
from pathlib import Path

import numpy as np

from formats.errors import BadMesh
from formats.safe_input import read_input
from formats.surfaces.lines import table, within
from formats.surfaces.polygons import triangulated
from formats.surfaces.surface import Notes, Surface, sound_colours

KEYWORD = re.compile(r"(ST)?(C)?(N)?OFF$")
OTHER = re.compile(r"(ST)?C?N?(4|4?n)OFF$")


def read_off(path: Path | str, notes: Notes) -> list[Surface]:
    """All faces. Raises BadMesh, LimitExceeded, MissingFile."""
    data = read_input(path)
    rows = (line.partition("#")[0].strip() for line in data.decode("latin-1").splitlines())
    lines = [row for row in rows if row]
    keyword, n_points, n_faces, at = _header(path, lines)
    if n_points + n_faces > len(lines) - at:
        raise BadMesh(
            f"{path}: ends before the last of {n_points + n_faces:,} lines; copy or export it again"
        )
    try:
        numbers, widths, starts = table(lines[at : at + n_points])
        if (widths < 3).any() or not np.isfinite(numbers).all():
            raise ValueError("a vertex of fewer than three numbers, or of NaN or infinity")
        positions = numbers[starts[:, None] + np.arange(3)]
        first = 6 if "N" in keyword else 3
        behind = widths - first - (2 if "ST" in keyword else 0)
        if "ST" in keyword or not np.isin(behind, (0, 3, 4)).all():
            notes.add("has numbers of vertices that are no colours, such as texture coordinates; not used")
        skipped = np.full(n_points, first)
        colours = _colours(numbers, starts, skipped, behind, lines[at : at + n_points], notes)
        lines = lines[at + n_points : at + n_points + n_faces]
        numbers, widths, starts = table(lines)
        counts = numbers[starts].astype(np.int64)
        if (counts < 0).any() or (counts + 1 > widths).any() or not np.isfinite(numbers).all():
            raise ValueError("a face of fewer corners than it counts")
    except (ValueError, OverflowError) as error:
        raise BadMesh(f"{path}: the mesh cannot be loaded ({error}); export it again") from error
    face_colours = _colours(numbers, starts, counts + 1, widths - counts - 1, lines, notes)
    if (widths - counts == 2).any():
        notes.add("colours that are numbers of a palette are not shown")
    corners = numbers[np.repeat(starts + 1, counts) + within(counts)].astype(np.int64)
    corner_indices, polygon = triangulated(path, counts, corners, positions, len(data))
    faces = corners[corner_indices].astype(np.int32).reshape(-1, 3)
    face_colours = None if face_colours is None else face_colours[polygon]
    return [Surface(positions, faces, colours=colours, face_colours=face_colours)]


def _header(path: Path | str, lines: list[str]) -> tuple[str, int, int, int]:
    """The keyword, counts of vertices and faces, and the first line behind them."""
    words, at = (lines[0].split() if lines else []), 1
    keyword = KEYWORD.match(words[0]) if words else None
    if words and OTHER.match(words[0]) or "BINARY" in words:
        raise BadMesh(f"{path}: an .off file in binary or of more dimensions; save it as plain OFF")
    if keyword:
        words = words[1:]
        if not words and len(lines) > 1:
            words, at = lines[1].split(), 2
    if not 2 <= len(words) <= 3 or not all(word.isdecimal() and len(word) < 16 for word in words):
        raise BadMesh(f"{path}: does not begin with OFF and counts of vertices and faces; export it again")
    return keyword[0] if keyword else "OFF", int(words[0]), int(words[1]), at


def _colours(numbers, starts, skipped, widths, lines: list[str], notes: Notes) -> np.ndarray | None:
    """(n, 4) of lines that have a colour of `widths` numbers behind `skipped` others, white where they have
    none; whole numbers count to 255, others to 1."""
    coloured = np.isin(widths, (3, 4))
    if not coloured.any():
        return None
    colours = np.ones((len(widths), 3))
    offsets = starts + skipped
    rgb = numbers[offsets[coloured, None] + np.arange(3)]
    first = int(np.argmax(coloured))
    words = lines[first].split()[skipped[first] : skipped[first] + widths[first]]
    most = 255 if all(word.isdecimal() for word in words) or rgb.max(initial=0) > 1 else 1
    colours[coloured] = rgb / most
    if (numbers[offsets[widths == 4] + 3] < most).any():
        notes.add("the transparency of its colours is not shown")
    return sound_colours(colours)
