"""Files of torch.save, read without torch: ZIP archives of 1.6 and later, chains of pickles of before.

What they hold is read by `pickles.py`; tensors stay in the file until they are asked for. The layouts are
those of torch/serialization.py (`_save`, `_legacy_save`).
"""

import io
import math
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import BinaryIO

import numpy as np

from formats.errors import BadCheckpoint, FormatError
from formats.foreign.pickles import Global, Named, Pending, read_pickle, set_item
from formats.foreign.stored import CODES, StoredTensor, c_strides, check_plain, shape_of
from formats.foreign.zip_file import Archive
from formats.safe_input import open_input

OLD_MAGIC = b"\x80\x02\x8a\x0al\xfc\x9cF\xf9 j\xa8P\x19."
"""A pickle of the number that every file before torch 1.6 begins with."""
OLD_PROTOCOL = 1001
STORAGES = {
    "Half": "float16",
    "Float": "float32",
    "Double": "float64",
    "BFloat16": "bfloat16",
    "Bool": "bool",
    "Byte": "uint8",
    "Char": "int8",
    "Short": "int16",
    "Int": "int32",
    "Long": "int64",
}
STORAGE_TYPES = {f"{m} {kind}Storage": STORAGES[kind] for m in ("torch", "torch.cuda") for kind in STORAGES}
AGAIN = "copy the file again"


class Storage:
    """Numbers of one type in a row, which tensors show parts of."""

    def __init__(self, dtype: str, count: int, read: Callable[[], bytes | bytearray], byteorder: str):
        self.dtype, self.count, self.read, self.byteorder = dtype, count, read, byteorder


def read_torch(path: Path | str) -> object:
    """What torch.save wrote: dicts, lists, tuples, texts, numbers, numpy scalars and StoredTensors.

    Raises BadCheckpoint, NeedsCode where it holds anything else, ChecksumMismatch, LimitExceeded,
    MissingFile, NotAFile, ResourceError. Tensors raise these as well when they are read.
    """
    where = str(path)
    try:
        with open_input(path) as file:
            if file.read(len(OLD_MAGIC)) == OLD_MAGIC:
                value = _read_old(file, path)
            else:
                value = _read_zip(Archive(path), path)
    except FormatError as error:
        raise error if str(error).startswith(where) else error.within(where) from error
    check_plain(value, where)
    return value


# --- ZIP archives -------------------------------------------------------------------------------------------


def pickle_member(archive: Archive) -> str | None:
    """The member of a torch archive that has the pickle; None in another ZIP archive."""
    return next((n for n in archive.members if n.count("/") == 1 and n.endswith("/data.pkl")), None)


def _read_zip(archive: Archive, path: Path | str) -> object:
    name = pickle_member(archive)
    if name is None:
        raise BadCheckpoint("is no file of torch.save: no member data.pkl")
    folder = name.removesuffix("data.pkl")
    order = (
        bytes(archive.read(folder + "byteorder")) if folder + "byteorder" in archive.members else b"little"
    )
    if order not in (b"little", b"big"):
        raise BadCheckpoint(f"its byte order is {order[:20]!r}, expected little or big")
    byteorder = "<" if order == b"little" else ">"

    def persistent(identity: object) -> Storage:
        dtype, key, count = _storage_id(identity, 5)
        member = archive.members.get(f"{folder}data/{key}")
        if member is None:
            raise BadCheckpoint(f"storage {key} is missing; {AGAIN}")
        if member.size != count * np.dtype(_stored(dtype)).itemsize:
            raise BadCheckpoint(f"storage {key} has {member.size:,} bytes, but {count:,} of {dtype} are said")
        return Storage(dtype, count, partial(archive.read, f"{folder}data/{key}"), byteorder)

    data = archive.read(name)
    return read_pickle(io.BytesIO(data), len(data), KNOWN, persistent)


def _storage_id(identity: object, length: int) -> tuple[str, str, int]:
    """Type, key and count of the persistent id ("storage", type, key, device, count, …) of a storage."""
    if not (type(identity) is tuple and len(identity) == length and identity[0] == "storage"):
        raise BadCheckpoint(f"a storage is not named as torch does; {AGAIN}")
    _, kind, key, _, count = identity[:5]
    if not (isinstance(kind, Named) and kind.name in STORAGE_TYPES and isinstance(key, str)):
        raise BadCheckpoint(f"a storage has no type or no key; {AGAIN}")
    if type(count) is not int or not 0 <= count < 2**48:
        raise BadCheckpoint(f"storage {key} has no count; {AGAIN}")
    return STORAGE_TYPES[kind.name], key, count


def _stored(dtype: str) -> str:
    return "uint16" if dtype == "bfloat16" else dtype


# --- before torch 1.6 ---------------------------------------------------------------------------------------


class _OldStorage(Storage):
    """A storage whose place in the file is known only after the pickle."""

    def __init__(self, path: Path | str, dtype: str, count: int):
        super().__init__(dtype, count, self._bytes, "<")
        self._path, self.start = path, -1

    def _bytes(self) -> bytearray:
        data = bytearray(self.count * np.dtype(_stored(self.dtype)).itemsize)
        with open_input(self._path) as file:
            file.seek(self.start)
            if file.readinto(data) != len(data):
                raise BadCheckpoint(f"{self._path}: is cut short; {AGAIN}")
        return data


def _read_old(file: BinaryIO, path: Path | str) -> object:
    """Protocol, system, the object and the keys of its storages, a pickle each, then the storages: a count of
    8 bytes and the numbers."""
    size = os.fstat(file.fileno()).st_size
    storages: dict[str, _OldStorage] = {}

    def persistent(identity: object) -> Storage:
        dtype, key, count = _storage_id(identity, 6)
        storage = storages.setdefault(key, _OldStorage(path, dtype, count))
        if (storage.dtype, storage.count) != (dtype, count):
            raise BadCheckpoint(f"storage {key} is named with two types or counts; {AGAIN}")
        return storage if identity[5] is None else _view(storage, identity[5])

    def refused(_: object) -> None:
        raise BadCheckpoint(f"a storage is named where none belongs; {AGAIN}")

    if (protocol := read_pickle(file, size, {}, refused)) != OLD_PROTOCOL:
        shown = protocol if type(protocol) is int else type(protocol).__name__
        raise BadCheckpoint(f"has the protocol {shown}, expected {OLD_PROTOCOL}; {AGAIN}")
    system = read_pickle(file, size, {}, refused)
    if type(system) is not dict or system.get("little_endian") is not True:
        raise BadCheckpoint(f"was not written by a little-endian machine, or is damaged; {AGAIN}")
    value = read_pickle(file, size, KNOWN, persistent)
    keys = read_pickle(file, size, {}, refused)
    if type(keys) is not list or not all(type(k) is str for k in keys) or sorted(keys) != sorted(storages):
        raise BadCheckpoint(f"its list of storages is not that of its tensors; {AGAIN}")
    for key in keys:
        _place(file, storages[key], key, size)
    return value


def _place(file: BinaryIO, storage: _OldStorage, key: str, size: int) -> None:
    """Where a storage lies, which begins where the file stands; the file then stands behind it."""
    count = int.from_bytes(file.read(8), "little", signed=True)
    storage.start = file.tell()
    stop = storage.start + storage.count * np.dtype(_stored(storage.dtype)).itemsize
    if stop > size:
        raise BadCheckpoint(f"is cut off: it should go on to byte {stop:,}, found {size:,} bytes; {AGAIN}")
    if count != storage.count:
        raise BadCheckpoint(
            f"storage {key} is said to hold {storage.count:,} numbers, found {count:,}; {AGAIN}"
        )
    file.seek(stop)


def _view(storage: _OldStorage, part: object) -> Storage:
    """A part of a storage, named (key, offset, count)."""
    if not (type(part) is tuple and len(part) == 3 and all(type(n) is int and n >= 0 for n in part[1:])):
        raise BadCheckpoint(f"a part of a storage is not named as torch does; {AGAIN}")
    _, offset, count = part
    if offset + count > storage.count:
        raise BadCheckpoint(f"a part of a storage reaches past its {storage.count:,} numbers; {AGAIN}")
    width = np.dtype(_stored(storage.dtype)).itemsize

    def read() -> bytearray:
        return storage.read()[offset * width : (offset + count) * width]

    return Storage(storage.dtype, count, read, storage.byteorder)


# --- globals ------------------------------------------------------------------------------------------------


def _tensor(arguments: tuple) -> StoredTensor:
    """torch._utils._rebuild_tensor(_v2)(storage, offset, size, stride, …)."""
    storage, offset, size, stride = arguments[:4]
    if not isinstance(storage, Storage):
        raise BadCheckpoint(f"a tensor has no storage; {AGAIN}")
    return StoredTensor(
        shape_of(size),
        storage.dtype,
        storage.count,
        storage.read,
        storage.byteorder,
        offset,
        shape_of(stride),
    )


def _parameter(arguments: tuple) -> StoredTensor:
    if not isinstance(arguments[0], StoredTensor):
        raise BadCheckpoint(f"a parameter is no tensor; {AGAIN}")
    return arguments[0]


def _table(arguments: tuple) -> dict:
    """A dictionary of another class: empty, or of a dictionary or a list of pairs."""
    table: dict = {}
    for key, value in (pair for given in arguments for pair in _pairs(given)):
        set_item(table, key, value)
    return table


def _pairs(given: object) -> list:
    pairs = list(given.items()) if type(given) is dict else given
    if type(pairs) is not list or not all(type(pair) in (list, tuple) and len(pair) == 2 for pair in pairs):
        raise BadCheckpoint(f"a dictionary is made of something else than pairs; {AGAIN}")
    return pairs


class _DType(Pending):
    """A type of numpy, such as "f4", whose byte order comes as its state."""

    def __init__(self, code: str):
        self.code, self.byteorder = code, "<"

    def build(self, state: object) -> None:
        if type(state) is not tuple or len(state) < 2 or state[1] not in ("<", ">", "|", "="):
            raise BadCheckpoint(f"a numpy type has no byte order; {AGAIN}")
        self.byteorder = ">" if state[1] == ">" else "<"


def _dtype(arguments: tuple) -> _DType:
    code = arguments[0]
    if not isinstance(code, str) or code not in CODES:
        shown = code[:20] if isinstance(code, str) else type(code).__name__
        raise BadCheckpoint(
            f"holds a numpy array of type {shown!r}, and only numbers are read (objects would need code)"
        )
    return _DType(code)


class _Array(StoredTensor, Pending):
    """A numpy array whose numbers lie in the pickle, and come as its state (version, shape, type, whether in
    Fortran's order, numbers)."""

    def __init__(self):
        super().__init__((0,), "uint8", 0, bytes)

    def build(self, state: object) -> None:
        _, shape, dtype, fortran, data = state
        data = data.encode("latin-1") if isinstance(data, str) else data  # of Python 2
        if not isinstance(dtype, _DType) or not isinstance(data, bytes):
            raise BadCheckpoint(f"a numpy array has no type or no numbers; {AGAIN}")
        width, shape = int(dtype.code[1:]), shape_of(shape)
        if math.prod(shape) * width != len(data):
            raise BadCheckpoint(f"a numpy array of shape {shape} has {len(data):,} bytes; {AGAIN}")
        strides = c_strides(shape[::-1])[::-1] if fortran else None
        count, read = len(data) // width, partial(bytearray, data)
        super().__init__(shape, CODES[dtype.code], count, read, dtype.byteorder, 0, strides)


def _scalar(arguments: tuple) -> np.generic:
    dtype, data = arguments
    data = data.encode("latin-1") if isinstance(data, str) else data
    if not isinstance(dtype, _DType) or not isinstance(data, bytes) or len(data) != int(dtype.code[1:]):
        raise BadCheckpoint(f"a numpy number has no type or no bytes; {AGAIN}")
    return np.frombuffer(data, np.dtype(dtype.code).newbyteorder(dtype.byteorder))[0].astype(
        CODES[dtype.code]
    )


def _encoded(arguments: tuple) -> bytes:
    """_codecs.encode(text, "latin1") or bytes(), which is how protocol 2 writes bytes."""
    text, codec = arguments or ("", "latin1")
    if not isinstance(text, str) or codec not in ("latin1", "latin-1"):
        raise BadCheckpoint(f"a text is encoded in an unusual way; {AGAIN}")
    return text.encode("latin-1")


def _no_value(arguments: tuple) -> None:
    raise BadCheckpoint(f"a type stands where a value was expected; {AGAIN}")


KNOWN: dict[str, Global] = {
    "collections OrderedDict": _table,
    "collections Counter": _table,
    "mmcv.utils.config ConfigDict": _table,
    "mmengine.config.config ConfigDict": _table,
    "addict.addict Dict": _table,
    "torch Size": lambda arguments: shape_of(arguments[0]),
    "torch._utils _rebuild_tensor": _tensor,
    "torch._utils _rebuild_tensor_v2": _tensor,
    "torch._utils _rebuild_parameter": _parameter,
    "numpy dtype": _dtype,
    "numpy ndarray": _no_value,
    "_codecs encode": _encoded,
    "__builtin__ bytes": _encoded,
    **{f"numpy.{core}.multiarray _reconstruct": lambda _: _Array() for core in ("core", "_core")},
    **{f"numpy.{core}.multiarray scalar": _scalar for core in ("core", "_core")},
    **dict.fromkeys(STORAGE_TYPES, _no_value),
}
