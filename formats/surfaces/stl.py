""".stl: triangles, binary or text, with the colours that Magics and VisCAM put into spare bytes."""

import re
from pathlib import Path

import numpy as np

from formats.errors import BadMesh
from formats.safe_input import read_input
from formats.surfaces.surface import Notes, Surface, check_budget, sound_colours

HEADER = 84
RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
END = re.compile(rb"end\s*solid", re.IGNORECASE)
MAGICS = b"COLOR="
FLAG = 0x8000


def read_stl(path: Path | str, notes: Notes) -> list[Surface]:
    """All triangles. Raises BadMesh, LimitExceeded, MissingFile."""
    data = read_input(path)
    count, colours = int.from_bytes(data[80:84], "little"), None
    if count == 0 and len(data) > HEADER and (len(data) - HEADER) % RECORD.itemsize == 0:
        count = (len(data) - HEADER) // RECORD.itemsize
        notes.add(f"counts no triangles, but holds {count:,}, which are shown")
    beginning = data[:512].removeprefix(b"\xef\xbb\xbf").lstrip()
    if len(data) >= HEADER and HEADER + RECORD.itemsize * count == len(data):
        corners, colours = _binary(data, count, notes)
    elif beginning[:5].lower() == b"solid" and b"\0" not in beginning:
        corners = _text(data, path)
        if not END.search(data, max(0, len(data) - 4096)):
            notes.add("does not end with endsolid; triangles at its end may be missing")
    elif len(data) >= HEADER and 0 < HEADER + RECORD.itemsize * count < len(data):
        notes.add("has bytes behind its last triangle, which are left out")
        corners, colours = _binary(data, count, notes)
    elif len(data) < HEADER:
        raise BadMesh(f"{path}: neither text nor long enough for a binary .stl; copy or export it again")
    else:
        raise BadMesh(f"{path}: ends before the last of {count:,} triangles; copy or export it again")
    check_budget(path, len(corners), len(data))
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    return [Surface(corners.reshape(-1, 3), faces, face_colours=colours)]


def _binary(data: bytes, count: int, notes: Notes) -> tuple[np.ndarray, np.ndarray | None]:
    rows = np.frombuffer(data, RECORD, count, HEADER)
    return rows["corners"].astype(np.float64), _colours(data[:80], rows["more"], notes)


def _colours(header: bytes, more: np.ndarray, notes: Notes) -> np.ndarray | None:
    """(F, 4) of spare bytes of five bits a colour. Magics: red lowest, its flag stands for the header's
    colour, as do zeros alone; VisCAM: red highest, its flag for a colour."""
    five = (more[:, None] >> np.array([0, 5, 10], np.uint16) & 31) / 31
    at = header.find(MAGICS)
    if at >= 0 and len(header) >= at + 9:
        base = np.frombuffer(header, np.uint8, 3, at + len(MAGICS)) / 255
        return sound_colours(np.where(((more & FLAG) > 0)[:, None] | (not more.any()), base, five))
    if not more.any():
        return None
    if not (more & FLAG).any():
        notes.add("has spare bytes that are no colours, which are not used")
        return None
    return sound_colours(np.where(((more & FLAG) > 0)[:, None], five[:, ::-1], 1))


def _text(data: bytes, path: Path | str) -> np.ndarray:
    numbers = [number for match in VERTEX.finditer(data) for number in match.groups()]
    try:
        return np.array(numbers[: len(numbers) // 9 * 9], np.float64).reshape(-1, 3, 3)
    except ValueError as error:
        raise BadMesh(f"{path}: holds {error}; export the mesh again") from error
