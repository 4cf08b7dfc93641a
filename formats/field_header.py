"""The header of a field's bytes: its kind, its metadata and where its arrays lie, read without them."""

import math
import re
from dataclasses import dataclass

import numpy as np

from formats.errors import (
    BadArray,
    BadHeader,
    BadSchema,
    LimitExceeded,
    NewerVersion,
    TruncatedBundle,
)
from formats.quantisation import (
    BLOCKS,
    LEVELS,
    MADE_AT_ONCE,
    code_bytes,
    scales_shape,
)
from formats.safe_input import parse_json

KEY = "fusedrf"
PLAIN, CODED, VERSION = 1, 2, 3  # of fields without coded arrays, with them, and that need what is in NEEDS
NEEDS = ("hashed", "held", "runs")  # that a field's metadata may say a reader must know, to show it as it is
MAX_HEADER = 1 << 20
MAX_ARRAYS = 4096
MAX_ARRAY_BYTES = 2 << 30
MAX_DECODED_BYTES = 8 << 30  # of a field: a bundle of 4 GiB that is all F16, as float32
MAX_RANK = 5
MAX_DIMENSION = 2**31 - 1
DTYPES = {"F16": np.dtype("<f2"), "F32": np.dtype("<f4"), "U8": np.dtype("u1"), "I32": np.dtype("<i4")}
NAME = re.compile(r"[A-Za-z0-9_.\-]{1,64}")
KIND = re.compile(r"[a-z][a-z0-9_\-]{0,31}")


@dataclass(frozen=True)
class ArraySpec:
    """Where one array lies in a field's bytes; `start` and `stop` count from the first byte of the file."""

    dtype: np.dtype
    shape: tuple[int, ...]
    start: int
    stop: int


@dataclass(frozen=True)
class CodedSpec:
    """An array that is stored as codes of 8 or 4 bits and their scales."""

    bits: int
    shape: tuple[int, ...]
    runs: bool
    """Whether its rows lie in runs, of the lengths in NAME.runs."""

    @property
    def entry(self) -> dict:
        """What the field's header says of it."""
        return {"bits": self.bits, "shape": list(self.shape)} | ({"runs": True} if self.runs else {})


@dataclass(frozen=True)
class FieldHeader:
    """A field's description, which is read without its arrays."""

    kind: str
    metadata: dict
    specs: dict[str, ArraySpec]
    """Of the arrays as they are stored."""
    coded: dict[str, CodedSpec]
    """Of the arrays that lie in two of those, NAME.scales and NAME.codes."""
    size: int
    """Bytes of the whole field in its file."""

    @property
    def arrays(self) -> dict[str, tuple[str, tuple[int, ...]]]:
        """How each array is stored ("int8", "float16", ...) and the shape that it decodes to, by name."""
        arrays = {name: (str(self.specs[name].dtype), self.specs[name].shape) for name in self.plain}
        return arrays | {name: (f"int{spec.bits}", spec.shape) for name, spec in self.coded.items()}

    @property
    def plain(self) -> list[str]:
        """Names of the arrays that are not coded."""
        parts = {part for name in self.coded for part in coded_parts(name)}
        return [name for name in self.specs if name not in parts]

    @property
    def box(self) -> list[float] | None:
        """(6,) in the field's frame: its own, or that of its cells; None: neither is told."""
        cells = self.metadata.get("cells")
        around = cells.get("aabb") if isinstance(cells, dict) else None
        return self.metadata.get("aabb") or (around if _is_box(around) else None)

    @property
    def precision(self) -> str:
        """The one of PRECISIONS that it was written with, as its arrays show; of several the most exact."""
        if any(self.specs[name].dtype == DTYPES["F32"] for name in self.plain):
            return "float32"
        bits = max((spec.bits for spec in self.coded.values()), default=None)
        return "float16" if bits is None else f"int{bits}"

    @property
    def decoded_size(self) -> int:
        """Bytes of its arrays once decoded: floats as float32."""
        return sum(math.prod(shape) * (1 if dtype == "uint8" else 4) for dtype, shape in self.arrays.values())


def decode_header(data: bytes | memoryview, where: str, most: int = MAX_DECODED_BYTES) -> FieldHeader:
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
    kind, metadata, coded = _content(header.pop("__metadata__", None), where)
    arrays = max(len(coded), len(header) - len(coded))  # a coded one lies in two
    if arrays > MAX_ARRAYS:
        raise LimitExceeded(f"{where}: {arrays} arrays, at most {MAX_ARRAYS} are read")
    specs = {name: _spec(name, entry, 8 + length, where) for name, entry in header.items()}
    _check_cover(specs, 8 + length, size, where)
    coded = {name: _coded_spec(name, entry, specs, where) for name, entry in coded.items()}
    field_header = FieldHeader(kind, metadata, specs, coded, size)
    if field_header.decoded_size > most:
        raise LimitExceeded(
            f"{where}: decodes to {field_header.decoded_size:,} bytes, but at most {most:,} are read"
        )
    return field_header


def reading_size(header: FieldHeader) -> int:
    """Bytes that reading a field takes beside its decoded arrays, at most: of the largest array what lies in
    the file, and what is made of that on the way."""
    sizes = [0]
    for name in header.plain:
        spec = header.specs[name]
        sizes.append((spec.stop - spec.start) + math.prod(spec.shape))
    for name, spec in header.coded.items():
        scales, codes = (header.specs[part] for part in coded_parts(name))
        widened = codes.stop - codes.start if spec.bits == 8 else 5 * (codes.stop - codes.start)
        sizes.append(2 * (scales.stop - scales.start) + widened + MADE_AT_ONCE)
    return max(sizes)


def coded_parts(name: str) -> tuple[str, str]:
    """The names of the two arrays that a coded one lies in: its scales and its codes."""
    return f"{name}.scales", f"{name}.codes"


def runs_of(name: str) -> str:
    """The name of the array that holds the lengths of an array's runs of rows."""
    return f"{name}.runs"


def _content(entry: object, where: str) -> tuple[str, dict, dict]:
    if not isinstance(entry, dict) or set(entry) != {KEY} or not isinstance(entry[KEY], str):
        raise BadHeader(
            f"{where}: expected one metadata key {KEY!r} holding a string; this is not a field of fusedrf"
        )
    content = parse_json(entry[KEY].encode(), where)
    if not isinstance(content, dict) or type(content.get("version")) is not int:
        raise BadSchema(f"{where}: expected metadata with an integer 'version'")
    version, kind, metadata = content["version"], content.get("kind"), content.get("metadata")
    if version > VERSION:
        raise NewerVersion(f"{where}: field version {version}, this fusedrf reads {VERSION}; update fusedrf")
    coded, is_coded_too = content.get("coded", {}), version == CODED or version > CODED and "coded" in content
    expected = {"kind", "metadata", "version"} | ({"coded"} if is_coded_too else set())
    if version < PLAIN or set(content) != expected or not isinstance(metadata, dict):
        raise BadSchema(
            f"{where}: expected {', '.join(sorted(expected))} in version {version}, found {sorted(content)}"
        )
    if not isinstance(coded, dict) or (is_coded_too and not coded):
        raise BadSchema(f"{where}: 'coded' should be an object that names the coded arrays")
    needs = metadata.get("needs", [])
    if ("needs" in metadata) != (version == VERSION) or not isinstance(needs, list):
        raise BadSchema(f"{where}: fields of version {VERSION}, and no others, have a list 'needs'")
    unknown = [need for need in needs if need not in NEEDS]
    if unknown:
        raise NewerVersion(f"{where}: needs {unknown[0]!r}, which this fusedrf does not know; update fusedrf")
    if not isinstance(kind, str) or not KIND.fullmatch(kind):
        raise BadSchema(f"{where}: kind {kind!r} is not a lower-case word")
    if "aabb" in metadata:
        _check_aabb(metadata["aabb"], where)
    return kind, metadata, coded


def _is_box(aabb: object) -> bool:
    numbers = isinstance(aabb, list) and len(aabb) == 6 and all(type(x) in (int, float) for x in aabb)
    return numbers and all(low < high for low, high in zip(aabb[:3], aabb[3:], strict=True))


def _check_aabb(aabb: object, where: str) -> None:
    if not _is_box(aabb):
        raise BadSchema(f"{where}: aabb {aabb!r} is not six numbers, each minimum below its maximum")


def _spec(name: str, entry: object, base: int, where: str) -> ArraySpec:
    if not NAME.fullmatch(name):
        raise BadArray(f"{where}: array name {name[:80]!r} is not 1 to 64 letters, digits, '_', '.' or '-'")
    if not isinstance(entry, dict) or set(entry) != {"dtype", "shape", "data_offsets"}:
        raise BadHeader(f"{where}: array {name!r} should state dtype, shape and data_offsets only")
    if not isinstance(entry["dtype"], str) or entry["dtype"] not in DTYPES:
        raise BadArray(f"{where}: array {name!r} is of {entry['dtype']!r}, expected {', '.join(DTYPES)}")
    shape, offsets = entry["shape"], entry["data_offsets"]
    if not _counts(shape) or len(shape) > MAX_RANK or any(n > MAX_DIMENSION for n in shape):
        raise BadArray(f"{where}: array {name!r} has shape {shape!r}, expected at most {MAX_RANK} sizes")
    dtype = DTYPES[entry["dtype"]]
    size = math.prod(shape) * dtype.itemsize
    if size > MAX_ARRAY_BYTES:
        raise LimitExceeded(
            f"{where}: array {name!r} has {size:,} bytes, but at most {MAX_ARRAY_BYTES:,} are read"
        )
    if not _counts(offsets) or len(offsets) != 2 or offsets[1] - offsets[0] != size:
        raise BadHeader(f"{where}: array {name!r} lies at {offsets!r}, expected offsets {size} bytes apart")
    return ArraySpec(dtype, tuple(shape), base + offsets[0], base + offsets[1])


def _coded_spec(name: str, entry: object, specs: dict[str, ArraySpec], where: str) -> CodedSpec:
    if not NAME.fullmatch(name) or name in specs:
        raise BadArray(f"{where}: coded array {name[:80]!r} has a wrong or taken name; make the file again")
    if not isinstance(entry, dict) or set(entry) - {"runs"} != {"bits", "shape"}:
        raise BadSchema(f"{where}: coded array {name!r} should state bits, shape and runs only")
    bits, shape, in_runs = entry["bits"], entry["shape"], entry.get("runs", False)
    if type(bits) is not int or bits not in LEVELS:
        raise BadSchema(f"{where}: array {name!r} is coded in {bits!r} bits, expected 4 or 8")
    if not _counts(shape) or len(shape) not in BLOCKS or not all(1 <= n <= MAX_DIMENSION for n in shape):
        raise BadArray(f"{where}: coded array {name!r} has shape {shape!r}, expected two or three sizes")
    numbers = math.prod(shape)
    if 4 * numbers > MAX_ARRAY_BYTES:
        raise LimitExceeded(
            f"{where}: array {name!r} decodes to {4 * numbers:,} bytes, but at most "
            f"{MAX_ARRAY_BYTES:,} are read"
        )
    scales, codes = (specs.get(part) for part in coded_parts(name))
    if scales is None or codes is None:
        raise BadArray(f"{where}: coded array {name!r} lacks its scales or its codes; make the file again")
    least = scales_shape(shape)
    if in_runs:
        least = _in_runs(name, shape, in_runs, scales, specs.get(runs_of(name)), where)
    if scales.dtype != DTYPES["F16"] or scales.shape != least:
        actual = f"{scales.dtype} {list(scales.shape)}"
        raise BadArray(f"{where}: array {name!r} has scales {actual}, expected float16 {list(least)}")
    if codes.dtype != DTYPES["U8"] or len(codes.shape) != 1 or codes.shape[0] > code_bytes(numbers, bits):
        actual = f"{codes.dtype} {list(codes.shape)}"
        raise BadArray(
            f"{where}: array {name!r} has codes {actual}, expected at most "
            f"{code_bytes(numbers, bits):,} bytes"
        )
    return CodedSpec(bits, tuple(shape), bool(in_runs))


def _in_runs(
    name: str, shape: list[int], content: object, scales: ArraySpec, runs: ArraySpec | None, where: str
) -> tuple[int, ...]:
    """The scales' shape of an array whose rows lie in runs: at least one block in each, as far as a header
    can tell."""
    if content is not True or len(shape) != 2:
        raise BadSchema(f"{where}: 'runs' of array {name!r} should be true, and the array of two sizes")
    if runs is None or runs.dtype not in (DTYPES["I32"], DTYPES["U8"]) or len(runs.shape) != 1:
        raise BadArray(f"{where}: array {name!r} lacks {runs_of(name)!r}, whole numbers in one dimension")
    (count,), blocks = runs.shape, scales.shape[0] if scales.shape else 0
    least, *columns = scales_shape(tuple(shape))
    if not max(least, count) <= blocks <= least + count:
        raise BadArray(
            f"{where}: array {name!r} has {blocks:,} scales in a column, expected {max(least, count):,} to "
            f"{least + count:,} for its {count:,} runs"
        )
    return blocks, *columns


def _counts(values: object) -> bool:
    return isinstance(values, list) and all(type(value) is int and value >= 0 for value in values)


def _check_cover(specs: dict[str, ArraySpec], start: int, size: int, where: str) -> None:
    """The arrays follow each other without gap or overlap to the last byte: no data hides between."""
    for name, spec in sorted(specs.items(), key=lambda item: (item[1].start, item[1].stop)):
        if spec.start != start:
            raise BadHeader(f"{where}: array {name!r} begins at byte {spec.start}, expected {start}")
        start = spec.stop
    if start > size:
        raise TruncatedBundle(f"{where}: {size} bytes, but its arrays reach to {start}; copy the file again")
    if start != size:
        raise BadHeader(f"{where}: {size - start} bytes after the last array, expected none")
