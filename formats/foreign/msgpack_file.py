"""MessagePack files: snapshots of instant-ngp (`.ingp` in a gzip stream) and checkpoints of flax."""

import gzip
import math
import zlib
from pathlib import Path

import msgpack
import numpy as np

from formats.errors import BadCheckpoint, FormatError, LimitExceeded
from formats.foreign.stored import DTYPES, StoredTensor, check_plain, shape_of
from formats.safe_input import MAX_BYTES, open_input, read_input

GZIP = b"\x1f\x8b"
MAX_RATIO = 20
"""How often larger than its bytes a gzip stream may become, beyond FREE bytes."""
FREE = 64 << 20
PIECE = 1 << 20
MAX_LENGTH = 1 << 14
"""Of a list or map, which is allocated before its items are read."""
MAX_VALUES = 500_000
ARRAY, SCALAR = 1, 3
"""Kinds of flax's extension: [shape, type, bytes] of an array and of a single number."""


def read_msgpack(path: Path | str) -> dict:
    """The map of a MessagePack file, gzip undone: binaries are bytes, flax's arrays StoredTensors and its
    scalars numpy's.

    Raises BadCheckpoint, LimitExceeded, MissingFile, NotAFile, ResourceError.
    """
    with open_input(path) as file:
        packed = file.read(len(GZIP)) == GZIP
    data = _unzipped(path) if packed else read_input(path)
    count = _Count(path)
    try:
        value = msgpack.unpackb(
            data,
            max_array_len=MAX_LENGTH,
            max_map_len=MAX_LENGTH,
            list_hook=count.list,
            object_pairs_hook=count.map,
            ext_hook=_extension,
            timestamp=1,
        )
    except FormatError as error:
        raise error if str(error).startswith(str(path)) else error.within(str(path)) from error
    except (
        ValueError,
        TypeError,
        msgpack.UnpackException,
        RecursionError,
        MemoryError,
        OverflowError,
    ) as error:
        raise BadCheckpoint(f"{path}: its MessagePack is damaged ({error}); copy it again") from error
    if not isinstance(value, dict):
        raise BadCheckpoint(f"{path}: its MessagePack holds a {type(value).__name__}, expected a map")
    check_plain(value, str(path))
    return value


def _unzipped(path: Path | str) -> bytearray:
    data = bytearray()
    with open_input(path) as file:
        limit = min(MAX_BYTES, max(FREE, MAX_RATIO * file.seek(0, 2)))
        file.seek(0)
        try:
            with gzip.GzipFile(fileobj=file) as stream:
                while piece := stream.read(PIECE):
                    data += piece
                    if len(data) > limit:
                        raise LimitExceeded(
                            f"{path}: unpacks to more than {limit:,} bytes, which is not believed"
                        )
        except (OSError, EOFError, zlib.error) as error:
            raise BadCheckpoint(
                f"{path}: its gzip stream is damaged or cut short ({error}); copy it again"
            ) from error
    return data


class _Count:
    """Counts values, so that small bytes do not become large objects without end."""

    def __init__(self, path: Path | str):
        self.path, self.values = path, 0

    def list(self, items: list) -> list:
        return self._counted(items)

    def map(self, pairs: list) -> dict:
        table = dict(self._counted(pairs))
        if len(table) != len(pairs):
            raise BadCheckpoint(f"{self.path}: a key of its MessagePack appears twice")
        return table

    def _counted(self, items: list) -> list:
        self.values += 1 + len(items)
        if self.values > MAX_VALUES:
            raise LimitExceeded(f"{self.path}: its MessagePack holds more than {MAX_VALUES:,} values")
        return items


def _extension(kind: int, data: bytes) -> StoredTensor | np.generic:
    """An array or a number as flax.serialization writes them."""
    if kind not in (ARRAY, SCALAR):
        raise BadCheckpoint(
            f"its MessagePack has an extension of kind {kind}, expected flax's {ARRAY} or {SCALAR}"
        )
    shape, dtype, numbers = msgpack.unpackb(data, max_array_len=32, max_map_len=0)
    dtype = dtype.decode("latin-1") if isinstance(dtype, bytes) else dtype
    if dtype not in DTYPES or not isinstance(numbers, bytes):
        raise BadCheckpoint(f"an array has the type {str(dtype)[:40]!r}, and only numbers are read")
    width = 2 if dtype == "bfloat16" else np.dtype(dtype).itemsize
    tensor = StoredTensor(shape_of(shape), dtype, len(numbers) // width, lambda: bytearray(numbers))
    if math.prod(tensor.shape) * width != len(numbers):
        raise BadCheckpoint(f"an array of shape {tensor.shape} has {len(numbers):,} bytes")
    return tensor if kind == ARRAY else tensor.array()[()]
