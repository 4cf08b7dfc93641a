"""One radiance field as a plain record, and its bytes: a safetensors file with one metadata key."""

import json
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
import safetensors.numpy

from formats.archive import give_back, sha256_of_bytes
from formats.errors import (
    BadArray,
    BadSchema,
    NotFinite,
)
from formats.field_header import (
    CODED,
    DTYPES,
    KEY,
    PLAIN,
    VERSION,
    ArraySpec,
    CodedSpec,
    FieldHeader,
    coded_parts,
    decode_header,
    runs_of,
)
from formats.quantisation import (
    code_bytes,
    dequantised,
    is_coded,
    quantised,
    scales_shape,
)

BITS = {"int8": 8, "int4": 4}
# How floats that are not coded are stored, by precision.
PRECISIONS = {"float16": np.float16, "float32": np.float32, "int8": np.float16, "int4": np.float16}
# Of a trained field, about: with its scales, and the small arrays that stay float16.
BYTES_PER_NUMBER = {"float16": 2, "float32": 4, "int8": 1.04, "int4": 0.54}


@dataclass(frozen=True)
class FieldRecord:
    """A field without its behaviour; `metadata` is JSON-able, an `aabb` in it is in the object frame."""

    kind: str
    arrays: dict[str, np.ndarray]
    metadata: dict = field(default_factory=dict)


def encode_field(record: FieldRecord, precision: str = "float16") -> bytes:
    """Safetensors bytes of `record`; equal records give equal bytes.

    Floats are cast to `precision`, "float16" or "float32"; in "int8" and "int4" large arrays of two or three
    dimensions are coded (formats/quantisation.py), others cast to float16. Where there is an array NAME.runs
    of whole numbers, it holds the lengths of runs of NAME's rows, and each is coded in blocks of its own.
    Bool becomes uint8, other integers int32. Raises NotFinite (NaN, infinity, overflow in the cast),
    BadArray, BadSchema, LimitExceeded.
    """
    stored, coded = _stored_arrays(record.arrays, precision, f"field of kind {record.kind!r}")
    return encode_stored(record.kind, record.metadata, stored, coded)


def encode_stored(kind: str, metadata: dict, stored: dict[str, np.ndarray], coded: dict[str, dict]) -> bytes:
    """As `encode_field`, of arrays as they are stored, and what the header says of those that are coded."""
    where = f"field of kind {kind!r}"
    content = {"kind": kind, "metadata": metadata, "version": PLAIN}
    if coded:
        content |= {"version": CODED, "coded": coded}
    if "needs" in metadata:
        content["version"] = VERSION
    try:
        text = json.dumps(content, sort_keys=True, separators=(",", ":"), allow_nan=False, default=_plain)
    except (TypeError, ValueError, RecursionError) as error:
        raise BadSchema(f"{where}: its metadata cannot be written as JSON ({error})") from error
    data = safetensors.numpy.save(stored, metadata={KEY: text})
    decode_header(data, where)
    return data


def member_name(data: bytes | memoryview) -> str:
    """The name that a field's bytes give it in a bundle."""
    return f"fields/{sha256_of_bytes(data)[:16]}.safetensors"


def coded_bytes(shape: tuple[int, ...], precision: str) -> int:
    """The most bytes that a float array of that shape takes in a field."""
    numbers = math.prod(shape)
    if precision not in BITS or not is_coded(shape):
        return numbers * np.dtype(PRECISIONS[precision]).itemsize
    return math.prod(scales_shape(shape)) * DTYPES["F16"].itemsize + code_bytes(numbers, BITS[precision])


def as_stored(
    array: np.ndarray, precision: str, name: str = "", runs: np.ndarray | None = None
) -> np.ndarray:
    """The float32 numbers that a float array comes back as from a field; runs (R,) are the lengths of those
    of its rows, if it has any. Raises NotFinite."""
    cast = _cast(name, array, precision, "the field")
    if precision in BITS and is_coded(array.shape):
        bits = BITS[precision]
        return dequantised(*quantised(array, bits, runs), bits, array.shape, name, runs)
    return cast.astype(np.float32)


def decode_field(data: bytes | memoryview, where: str) -> FieldRecord:
    """The record in `data`, float16 and codes widened to float32, every array its own writable memory.

    `where` leads error sentences. Raises TruncatedBundle, BadHeader, BadArray, BadSchema, BadJson,
    LimitExceeded, NewerVersion, NotFinite.
    """
    header = decode_header(data, where)
    return FieldRecord(header.kind, dict(StoredArrays(data, header, where)), header.metadata)


class StoredArrays(Mapping):
    """The arrays of a field in its bytes, each decoded, as `decode_field` has it, when it is asked for."""

    def __init__(self, data: bytes | memoryview, header: FieldHeader, where: str):
        self.data, self.header, self.where = data, header, where

    def __iter__(self) -> Iterator[str]:
        return iter(self.header.arrays)

    def __len__(self) -> int:
        return len(self.header.arrays)

    def __contains__(self, name: object) -> bool:
        return name in self.header.arrays

    def __getitem__(self, name: str) -> np.ndarray:
        array = self._coded(name) if name in self.header.coded else self._plain(name)
        give_back(self.data)
        return array

    def _plain(self, name: str) -> np.ndarray:
        array = mapped_array(self.data, self.header.specs[name])
        array = array.astype(np.float32 if array.dtype.kind == "f" else array.dtype.newbyteorder("="))
        _check_finite(name, array, self.where)
        return array

    def _coded(self, name: str) -> np.ndarray:
        spec, where = self.header.coded[name], f"{self.where}: array {name!r}"
        scales, codes = (mapped_array(self.data, self.header.specs[part]) for part in coded_parts(name))
        runs = self._plain(runs_of(name)) if spec.runs else None
        if runs is not None:
            _check_runs(runs, spec.shape[0], scales.shape[0], where)
        return dequantised(scales, codes, spec.bits, spec.shape, where, runs)


def _plain(value: object) -> object:
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} is not a JSON value")


def mapped_array(data: bytes | memoryview, spec: ArraySpec) -> np.ndarray:
    """An array as it lies in its field's bytes."""
    return np.frombuffer(data, spec.dtype, math.prod(spec.shape), spec.start).reshape(spec.shape)


def _stored_arrays(
    arrays: dict[str, np.ndarray], precision: str, where: str
) -> tuple[dict[str, np.ndarray], dict[str, dict]]:
    """Arrays by the names under which they are stored, and the metadata's entries for coded ones."""
    stored, coded = {}, {}
    for name, array in arrays.items():
        shape = np.shape(array)
        if precision in BITS and np.asarray(array).dtype.kind == "f" and is_coded(shape):
            _cast(name, array, precision, where)  # a scale is a float16 too
            runs = arrays.get(runs_of(name))
            parts = dict(zip(coded_parts(name), quantised(array, BITS[precision], runs), strict=True))
            coded[name] = CodedSpec(BITS[precision], shape, runs is not None).entry
        else:
            parts = {name: _stored(name, array, precision, where)}
        if twice := parts.keys() & stored.keys():
            raise BadArray(f"{where}: two arrays would be stored as {min(twice)!r}; rename one of them")
        stored |= parts
    return stored, coded


def _stored(name: str, array: np.ndarray, precision: str, where: str) -> np.ndarray:
    array = np.asarray(array)
    if array.dtype.kind == "f":
        return np.asarray(_cast(name, array, precision, where), order="C")
    if array.dtype == np.bool_ or array.dtype == np.uint8:
        return np.asarray(array, np.uint8, order="C")
    if array.dtype.kind not in "iu" or (array.size and not -(2**31) <= array.min() <= array.max() < 2**31):
        raise BadArray(f"{where}: array {name!r} of {array.dtype} fits neither float32 nor int32")
    return np.asarray(array, np.int32, order="C")


def _cast(name: str, array: np.ndarray, precision: str, where: str) -> np.ndarray:
    _check_finite(name, array, where)
    with np.errstate(over="ignore"):
        cast = array.astype(PRECISIONS[precision])
    _check_finite(name, cast, where, f"too large for {precision}; use --precision float32")
    return cast


def _check_finite(name: str, array: np.ndarray, where: str, what: str = "NaN or infinite") -> None:
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        count = array.size - np.count_nonzero(np.isfinite(array))
        raise NotFinite(f"{where}: array {name!r} has {count:,} of {array.size:,} values {what}")


def _check_runs(runs: np.ndarray, rows: int, blocks: int, where: str) -> None:
    """Raise BadArray where the lengths of runs are not those of so many rows and blocks."""
    if runs.min(initial=1) < 1 or runs.sum(dtype=np.int64) != rows:
        raise BadArray(f"{where}: its runs should be of 1 row and more, {rows:,} in all; make the file again")
    if scales_shape((rows, 1), runs)[0] != blocks:
        raise BadArray(f"{where}: its runs do not have {blocks:,} blocks in all; make the file again")
