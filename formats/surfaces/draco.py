"""Meshes within a glTF file that are compressed by Draco."""

import numpy as np

from formats.errors import BadMesh, MissingExtra
from formats.surfaces.surface import check_budget

DRACO = "KHR_draco_mesh_compression"


def draco_arrays(data: bytes, names: dict[str, int], where: str) -> dict[str, np.ndarray]:
    """Attributes (V, n) by name and "indices" (F, 3) of a Draco bitstream. Raises BadMesh, LimitExceeded,
    MissingExtra."""
    try:
        import DracoPy
    except ImportError as error:
        raise MissingExtra(
            f"{where}: is compressed by {DRACO}, which needs the library of fusedrf[draco]; install that, or "
            "save the mesh without compression"
        ) from error
    _check_draco(data, where)
    try:
        mesh = DracoPy.decode(data)
        by_id = {entry["unique_id"]: np.asarray(entry["data"]) for entry in mesh.attributes}
        attributes = {name: by_id[number] for name, number in names.items() if number in by_id}
        attributes["indices"] = np.asarray(mesh.faces)
    except Exception as error:  # the library raises errors of any class on broken data
        raise BadMesh(f"{where}: {DRACO} cannot be decoded ({error}); export the mesh again") from error
    if len({len(rows) for name, rows in attributes.items() if name != "indices"}) != 1:
        raise BadMesh(f"{where}: {DRACO} lacks its attributes; export the mesh again")
    return attributes


def _check_draco(data: bytes, where: str) -> None:
    """Counts of a Draco bitstream (its specification, sections 4 and 5) against its bytes, since the library
    allocates what they say. Raises BadMesh, LimitExceeded."""
    major, minor, kind, method = data[5:9] if len(data) > 11 else (0, 0, 0, 0)
    flags = int.from_bytes(data[9:11], "little")
    if not data.startswith(b"DRACO") or (major, minor) != (2, 2) or kind != 1 or flags & 0x8000:
        raise BadMesh(f"{where}: {DRACO} holds no mesh of version 2.2 without metadata; export it again")
    at = 12 if method == 1 else 11  # the way that a mesh is gone through
    for _ in range(2):  # its vertices and faces
        count, shift = 0, 0
        while at < len(data) and shift < 35:
            count |= (data[at] & 127) << shift
            at, shift = at + 1, shift + 7
            if data[at - 1] < 128:
                break
        check_budget(where, count, 2 * len(data))
