""".off: polygons without colours, as text, by trimesh."""

import io
from pathlib import Path

import numpy as np

from formats.errors import BadMesh
from formats.inputs import read_input
from formats.surfaces.surface import Notes, Surface, check_budget

MAX_FILE = 2**30


def read_off(path: Path | str, notes: Notes) -> list[Surface]:
    """All faces. Raises BadMesh, LimitExceeded, MissingFile."""
    from trimesh.exchange.off import load_off

    data = read_input(path, MAX_FILE)
    try:
        loaded = load_off(io.BytesIO(data))
        positions = np.asarray(loaded["vertices"], np.float64).reshape(-1, 3)
        faces = np.asarray(loaded["faces"], np.int32).reshape(-1, 3)
        last = data.rstrip().rsplit(b"\n", 1)[-1].split()
    except Exception as error:  # the loader raises errors of any class on broken files
        raise BadMesh(f"{path}: the mesh cannot be loaded ({error}); export it again") from error
    check_budget(path, len(faces), len(data))
    if data.lstrip().startswith(b"COFF") or last[0].isdigit() and len(last) > int(last[0]) + 1:
        notes.add("its colours are not shown")
    return [Surface(positions, faces)]
