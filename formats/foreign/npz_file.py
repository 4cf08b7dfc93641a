"""Numpy's `.npz` archives, without pickles: arrays of numbers that stay in the file until they are read."""

import math
import re
from pathlib import Path

import numpy as np

from formats.errors import BadCheckpoint
from formats.foreign.stored import CODES, StoredTensor, c_strides
from formats.foreign.zip_file import Archive

MAX_HEADER = 4096
MAGIC = b"\x93NUMPY"
LENGTHS = {1: 2, 2: 4, 3: 4}
"""Bytes of the header's length, by the version of the format."""
HEADER = re.compile(
    rb"\{'descr': '([<>|]?)(\w{2})', 'fortran_order': (True|False), "
    rb"'shape': \(((?:\d{1,18}L?, ?)*(?:\d{1,18}L?)?)\), *\} *\n?"
)


def array_names(archive: Archive) -> list[str]:
    """Names of the arrays of an archive."""
    return [name.removesuffix(".npy") for name in archive.members if name.endswith(".npy")]


def read_npz(path: Path | str) -> dict[str, StoredTensor]:
    """The arrays of an `.npz`. Raises BadCheckpoint (where one holds objects as well), ChecksumMismatch,
    LimitExceeded, MissingFile, NotAFile, ResourceError."""
    archive = Archive(path)
    return {name: _array(archive, f"{name}.npy") for name in array_names(archive)}


def _array(archive: Archive, member: str) -> StoredTensor:
    where = f"{archive.path}: array {member}"
    head = bytes(archive.start(member, MAX_HEADER))
    width = LENGTHS.get(head[6] if head.startswith(MAGIC) and len(head) > 10 else 0, 0)
    start = 8 + width + int.from_bytes(head[8 : 8 + width], "little")
    header = HEADER.fullmatch(head[8 + width : start])
    code = header[2].decode() if header else ""
    if not header or code not in CODES:
        raise BadCheckpoint(
            f"{where} is damaged or holds something else than numbers, and only these are read"
        )
    dtype = CODES[code]
    shape = tuple(int(n.rstrip(b"L")) for n in header[4].split(b",") if n.strip())
    size = archive.members[member].size
    if start + math.prod(shape) * np.dtype(dtype).itemsize != size:
        raise BadCheckpoint(f"{where} has {size - start:,} bytes, which do not fit its shape {shape}"[:300])
    strides = c_strides(shape[::-1])[::-1] if header[3] == b"True" else None

    def read() -> memoryview:
        return memoryview(archive.read(member))[start:]

    byteorder = ">" if header[1] == b">" else "<"
    return StoredTensor(shape, dtype, math.prod(shape), read, byteorder, 0, strides)
