"""Numpy's `.npz` archives, without pickles: arrays of numbers that stay in the file until they are read."""

import io
import math
import warnings
from pathlib import Path

import numpy as np

from formats.errors import BadCheckpoint
from formats.foreign.stored import DTYPES, StoredTensor, c_strides
from formats.foreign.zip_file import Archive

MAX_HEADER = 4096
HEADERS = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}


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
    head = io.BytesIO(archive.start(member, MAX_HEADER))
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of headers that Python 2 wrote
            shape, fortran, dtype = HEADERS[np.lib.format.read_magic(head)](head, MAX_HEADER)
    except (
        ValueError,
        KeyError,
        TypeError,
        SyntaxError,
        RecursionError,
        MemoryError,
        OverflowError,
    ) as error:
        raise BadCheckpoint(f"{where} has no readable header ({error}); copy the file again") from error
    if dtype.name not in DTYPES:
        raise BadCheckpoint(f"{where} has the type {str(dtype)[:80]!r}, and only numbers are read")
    start, size = head.tell(), archive.members[member].size
    if not all(type(n) is int and n >= 0 for n in shape) or start + math.prod(shape) * dtype.itemsize != size:
        raise BadCheckpoint(f"{where} has {size - start:,} bytes, which do not fit its shape {shape}"[:300])
    strides = c_strides(shape[::-1])[::-1] if fortran else None
    byteorder = ">" if dtype.byteorder == ">" else "<"

    def read() -> bytes | bytearray:
        return memoryview(archive.read(member))[start:]

    return StoredTensor(shape, dtype.name, math.prod(shape), read, byteorder, 0, strides)
