"""One radiance field as a plain record, and its bytes: a safetensors file with one metadata key."""

import json
import math
import re
from dataclasses import dataclass, field

import numpy as np
import safetensors.numpy

from formats.errors import (
    BadArray,
    BadHeader,
    BadSchema,
    LimitExceeded,
    NewerVersion,
    NotFinite,
    TruncatedBundle,
)
from formats.inputs import parse_json

KEY = "fusedrf"
VERSION = 1
MAX_HEADER = 1 << 20
MAX_ARRAYS = 256
MAX_ARRAY_BYTES = 2 << 30
MAX_RANK = 5
MAX_DIMENSION = 2**31 - 1
DTYPES = {"F16": np.dtype("<f2"), "F32": np.dtype("<f4"), "U8": np.dtype("u1"), "I32": np.dtype("<i4")}
PRECISIONS = {"float16": np.float16, "float32": np.float32}
NAME = re.compile(r"[A-Za-z0-9_.\-]{1,64}")
KIND = re.compile(r"[a-z][a-z0-9_\-]{0,31}")


@dataclass(frozen=True)
class FieldRecord:
    """A field without its behaviour; `metadata` is JSON-able, an `aabb` in it is in the object frame."""

    kind: str
    arrays: dict[str, np.ndarray]
    metadata: dict = field(default_factory=dict)


@dataclass(frozen=True)
class ArraySpec:
    """Where one array lies in a field's bytes; `start` and `stop` count from the first byte of the file."""

    dtype: np.dtype
    shape: tuple[int, ...]
    start: int
    stop: int


@dataclass(frozen=True)
class FieldHeader:
    """What a field says of itself before any array is read."""

    kind: str
    metadata: dict
    specs: dict[str, ArraySpec]
    size: int
    """Bytes of the whole field in its file."""

    @property
    def decoded_size(self) -> int:
        """Bytes of its arrays once decoded: floats as float32."""
        return sum(
            math.prod(s.shape) * (4 if s.dtype.kind == "f" else s.dtype.itemsize) for s in self.specs.values()
        )


def encode_field(record: FieldRecord, precision: str = "float16") -> bytes:
    """Safetensors bytes of `record`; equal records give equal bytes.

    Floats are cast to `precision` ("float16" or "float32"), bool becomes uint8, other integers int32.
    Raises NotFinite (NaN, infinity, overflow in the cast), BadArray, BadSchema, LimitExceeded.
    """
    where = f"field of kind {record.kind!r}"
    content = {"kind": record.kind, "metadata": record.metadata, "version": VERSION}
    try:
        text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False, default=_plain)
    except (TypeError, ValueError, RecursionError) as error:
        raise BadSchema(f"{where}: its metadata cannot be written as JSON ({error})") from error
    stored = {name: _stored(name, array, precision, where) for name, array in record.arrays.items()}
    data = safetensors.numpy.save(stored, metadata={KEY: text})
    decode_header(data, where)
    return data


def decode_field(data: bytes | memoryview, where: str) -> FieldRecord:
    """The record in `data`, float16 widened to float32, every array its own writable memory.

    `where` leads error sentences. Raises TruncatedBundle, BadHeader, BadArray, BadSchema, BadJson,
    LimitExceeded, NewerVersion, NotFinite.
    """
    header = decode_header(data, where)
    arrays = {}
    for name, spec in header.specs.items():
        array = np.frombuffer(data, spec.dtype, math.prod(spec.shape), spec.start).reshape(spec.shape)
        array = array.astype(np.float32 if spec.dtype.kind == "f" else spec.dtype.newbyteorder("="))
        _check_finite(name, array, where)
        arrays[name] = array
    return FieldRecord(header.kind, arrays, header.metadata)


def decode_header(data: bytes | memoryview, where: str) -> FieldHeader:
    """Everything but the arrays, checked as in `decode_field`; costs the header only."""
    size = len(data)
    length = int.from_bytes(data[:8], "little")
    if size < 8 or (length <= MAX_HEADER and 8 + length > size):
        raise TruncatedBundle(f"{where}: ends within its header ({size} bytes); copy the file again")
    if length > MAX_HEADER:
        raise LimitExceeded(f"{where}: header of {length:,} bytes, at most {MAX_HEADER:,} are read")
    header = parse_json(bytes(data[8 : 8 + length]), where)
    if not isinstance(header, dict):
        raise BadHeader(f"{where}: expected a JSON object as header, found {type(header).__name__}")
    kind, metadata = _content(header.pop("__metadata__", None), where)
    if len(header) > MAX_ARRAYS:
        raise LimitExceeded(f"{where}: {len(header)} arrays, at most {MAX_ARRAYS} are read")
    specs = {name: _spec(name, entry, 8 + length, where) for name, entry in header.items()}
    _check_cover(specs, 8 + length, size, where)
    return FieldHeader(kind, metadata, specs, size)


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is no JSON value")


def _stored(name: str, array: np.ndarray, precision: str, where: str) -> np.ndarray:
    array = np.asarray(array)
    if array.dtype.kind == "f":
        _check_finite(name, array, where)
        with np.errstate(over="ignore"):
            cast = array.astype(PRECISIONS[precision])
        _check_finite(name, cast, where, f"too large for {precision}; use --precision float32")
        return np.asarray(cast, order="C")
    if array.dtype == np.bool_ or array.dtype == np.uint8:
        return np.asarray(array, np.uint8, order="C")
    if array.dtype.kind not in "iu" or (array.size and not -(2**31) <= array.min() <= array.max() < 2**31):
        raise BadArray(f"{where}: array {name!r} of {array.dtype} fits neither float32 nor int32")
    return np.asarray(array, np.int32, order="C")


def _check_finite(name: str, array: np.ndarray, where: str, what: str = "NaN or infinite") -> None:
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        count = array.size - np.count_nonzero(np.isfinite(array))
        raise NotFinite(f"{where}: array {name!r} has {count:,} of {array.size:,} values {what}")


def _content(entry: object, where: str) -> tuple[str, dict]:
    if not isinstance(entry, dict) or set(entry) != {KEY} or not isinstance(entry[KEY], str):
        raise BadHeader(f"{where}: expected one metadata key {KEY!r} holding a string; no field of fusedrf")
    content = parse_json(entry[KEY].encode(), where)
    if not isinstance(content, dict) or type(content.get("version")) is not int:
        raise BadSchema(f"{where}: expected metadata with an integer 'version'")
    version, kind, metadata = content["version"], content.get("kind"), content.get("metadata")
    if version > VERSION:
        raise NewerVersion(f"{where}: field version {version}, this fusedrf reads {VERSION}; update fusedrf")
    if version < 1 or set(content) != {"kind", "metadata", "version"} or not isinstance(metadata, dict):
        raise BadSchema(f"{where}: expected kind, metadata and version 1, found {sorted(content)}")
    if not isinstance(kind, str) or not KIND.fullmatch(kind):
        raise BadSchema(f"{where}: kind {kind!r} is not a lower-case word")
    if "aabb" in metadata:
        _check_aabb(metadata["aabb"], where)
    return kind, metadata


def _check_aabb(aabb: object, where: str) -> None:
    numbers = isinstance(aabb, list) and len(aabb) == 6 and all(type(x) in (int, float) for x in aabb)
    if not numbers or not all(low < high for low, high in zip(aabb[:3], aabb[3:], strict=True)):
        raise BadSchema(f"{where}: aabb {aabb!r} is not six numbers, each minimum below its maximum")


def _spec(name: str, entry: object, base: int, where: str) -> ArraySpec:
    if not NAME.fullmatch(name):
        raise BadArray(f"{where}: array name {name[:80]!r} is not 1 to 64 letters, digits, '_', '.' or '-'")
    if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "data_offsets"}:
        raise BadHeader(f"{where}: array {name!r} does not state dtype, shape and data_offsets alone")
    if not isinstance(entry["dtype"], str) or entry["dtype"] not in DTYPES:
        raise BadArray(f"{where}: array {name!r} is of {entry['dtype']!r}, expected {', '.join(DTYPES)}")
    shape, offsets = entry["shape"], entry["data_offsets"]
    if not _counts(shape) or len(shape) > MAX_RANK or any(n > MAX_DIMENSION for n in shape):
        raise BadArray(f"{where}: array {name!r} has shape {shape!r}, expected {MAX_RANK} sizes at most")
    dtype = DTYPES[entry["dtype"]]
    size = math.prod(shape) * dtype.itemsize
    if size > MAX_ARRAY_BYTES:
        raise LimitExceeded(f"{where}: array {name!r} has {size:,} bytes, the most is {MAX_ARRAY_BYTES:,}")
    if not _counts(offsets) or len(offsets) != 2 or offsets[1] - offsets[0] != size:
        raise BadHeader(f"{where}: array {name!r} lies at {offsets!r}, expected offsets {size} bytes apart")
    return ArraySpec(dtype, tuple(shape), base + offsets[0], base + offsets[1])


def _counts(values: object) -> bool:
    return isinstance(values, list) and all(type(value) is int and value >= 0 for value in values)


def _check_cover(specs: dict[str, ArraySpec], start: int, size: int, where: str) -> None:
    """The arrays follow each other without gap or overlap to the last byte, so nothing hides between them."""
    for name, spec in sorted(specs.items(), key=lambda item: (item[1].start, item[1].stop)):
        if spec.start != start:
            raise BadHeader(f"{where}: array {name!r} begins at byte {spec.start}, expected {start}")
        start = spec.stop
    if start > size:
        raise TruncatedBundle(f"{where}: {size} bytes, but its arrays reach to {start}; copy the file again")
    if start != size:
        raise BadHeader(f"{where}: {size - start} bytes after the last array, expected none")
