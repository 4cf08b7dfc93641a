""".stl: triangles without colours, binary or text."""

import re
from pathlib import Path

import numpy as np

from formats.errors import BadMesh
from formats.inputs import read_input
from formats.surfaces.surface import Notes, Surface, check_budget

MAX_FILE = 2**31
HEADER = 84
RECORD = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)


def read_stl(path: Path | str, notes: Notes) -> list[Surface]:
    """All triangles. Raises BadMesh, LimitExceeded, MissingFile."""
    data = read_input(path, MAX_FILE)
    count = int.from_bytes(data[80:84], "little")
    if len(data) >= HEADER and HEADER + RECORD.itemsize * count == len(data):
        corners = _binary(data, count, notes)
    elif data.lstrip()[:5].lower() == b"solid" and b"\0" not in data[:512]:
        corners = _text(data, path)
    elif len(data) >= HEADER and 0 < HEADER + RECORD.itemsize * count < len(data):
        notes.add("has bytes behind its last triangle, which are left out")
        corners = _binary(data, count, notes)
    else:
        raise BadMesh(f"{path}: ends before the last of {count:,} triangles; copy or export it again")
    check_budget(path, len(corners), len(data))
    return [Surface(corners.reshape(-1, 3), np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3))]


def _binary(data: bytes, count: int, notes: Notes) -> np.ndarray:
    rows = np.frombuffer(data, RECORD, count, HEADER)
    if rows["more"].any():
        notes.add("has colours in its spare bytes, which are not shown")
    return rows["corners"].astype(np.float64)


def _text(data: bytes, path: Path | str) -> np.ndarray:
    found = [number for match in VERTEX.finditer(data) for number in match.groups()]
    try:
        return np.array(found[: len(found) // 9 * 9], np.float64).reshape(-1, 3, 3)
    except ValueError as error:
        raise BadMesh(f"{path}: holds {error}; export the mesh again") from error
