"""glTF's buffers and accessors as numpy arrays; counts are checked against bytes before they are believed."""

import base64
from pathlib import Path
from urllib.parse import unquote_to_bytes

import numpy as np

from formats.errors import BadMesh, FormatError, LimitExceeded, MissingExtra
from formats.surfaces import gltf_schema as schema
from formats.surfaces.named_files import Beside

COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
FREE_ELEMENTS = 100_000
"""Accessors without bytes are zeros; they may count so many, or as many as the file has bytes."""
FREE_BYTES = 16 << 20
BYTES_PER_BYTE = 256
"""Compressed data may become so many bytes, or so many for each of its own."""
MESHOPT = ("KHR_meshopt_compression", "EXT_meshopt_compression")


class Buffers:
    """The bytes behind a document, read when they are asked for."""

    def __init__(self, document: schema.Document, path: Path | str, beside: Beside, binary: bytes | None):
        self.document, self.path, self.beside, self.binary = document, path, beside, binary
        self.kept: dict[int, memoryview] = {}
        self.unpacked: dict[int, memoryview] = {}

    @property
    def size(self) -> int:
        """Bytes of all buffers read or unpacked so far."""
        return sum(map(len, self.kept.values())) + sum(map(len, self.unpacked.values()))

    def buffer(self, index: int) -> memoryview:
        if index not in self.kept:
            entry = self.item("buffers", index)
            data = self._content(index, entry)
            if len(data) < entry.byte_length:
                raise BadMesh(
                    f"{self.path}: buffer {index} has {len(data):,} bytes, but {entry.byte_length:,} are "
                    "stated; copy or export it again"
                )
            self.kept[index] = memoryview(data)[: entry.byte_length]
        return self.kept[index]

    def _content(self, index: int, entry: schema.Buffer) -> bytes:
        if entry.uri is not None:
            if is_data(entry.uri):
                return data_uri(entry.uri, f"{self.path}: buffer {index}")
            try:
                return self.beside.read(entry.uri, uri=True)[0]
            except FormatError as error:
                raise error.within(f"{self.path}: buffer {index}") from error
        if index == 0 and self.binary is not None:
            return self.binary
        raise BadMesh(f"{self.path}: buffer {index} has no bytes; export the file again")

    def item(self, name: str, index: int):
        """Entry `index` of one of the document's lists."""
        entries = getattr(self.document, name)
        if index >= len(entries):
            raise BadMesh(
                f"{self.path}: refers to {name}[{index}], but there are {len(entries)}; export the file again"
            )
        return entries[index]

    def view(self, index: int) -> memoryview:
        entry = self.item("buffer_views", index)
        for name in MESHOPT:
            if (packed := entry.extension(name, schema.Meshopt, self.path)) is not None:
                if index not in self.unpacked:
                    self.unpacked[index] = self._unpack(packed, name)
                return self.unpacked[index][: entry.byte_length]
        return self._cut(entry.buffer, entry.byte_offset, entry.byte_length, f"buffer view {index}")

    def _cut(self, buffer: int, offset: int, length: int, what: str) -> memoryview:
        data = self.buffer(buffer)
        if offset + length > len(data):
            raise BadMesh(
                f"{self.path}: {what} reaches byte {offset + length:,} of a buffer of {len(data):,}; "
                "export the file again"
            )
        return data[offset : offset + length]

    def _unpack(self, packed: schema.Meshopt, name: str) -> memoryview:
        try:
            import meshopt
        except ImportError as error:
            raise MissingExtra(
                f"{self.path}: is compressed by {name}, which needs the library of fusedrf[meshopt]; install "
                "that, or save the file without compression"
            ) from error
        data = self._cut(packed.buffer, packed.byte_offset, packed.byte_length, "compressed data")
        if packed.count * packed.byte_stride > max(FREE_BYTES, BYTES_PER_BYTE * len(data)):
            raise LimitExceeded(
                f"{self.path}: {packed.count:,} elements by {name} in {len(data):,} bytes are not plausible; "
                "export it again"
            )
        try:
            rows = meshopt.decode_gltf_buffer(
                bytes(data), packed.count, packed.byte_stride, packed.mode, packed.filter
            )
        except (ValueError, RuntimeError, TypeError, OverflowError, MemoryError) as error:
            raise BadMesh(f"{self.path}: {name} cannot be decoded ({error}); export it again") from error
        return memoryview(np.ascontiguousarray(rows).view(np.uint8).reshape(-1).data)

    # --- accessors ------------------------------------------------------------------------------------------

    def rows(self, index: int, widths: tuple[int, ...] = ()) -> np.ndarray:
        """(count, n) numbers as they are stored, not copied where that is possible; `widths` are the n that
        are allowed. Raises BadMesh, LimitExceeded."""
        accessor, where = self.item("accessors", index), f"{self.path}: accessor {index}"
        if accessor.component_type not in COMPONENTS or accessor.type not in WIDTHS:
            raise BadMesh(f"{where} has the unknown type {accessor.type[:20]!r} {accessor.component_type}")
        width = WIDTHS[accessor.type]
        if widths and width not in widths:
            raise BadMesh(f"{where} has the type {accessor.type}, which does not fit its use")
        kind = np.dtype(COMPONENTS[accessor.component_type])
        if accessor.buffer_view is None:
            if accessor.count > max(FREE_ELEMENTS, self.size):
                raise LimitExceeded(f"{where} counts {accessor.count:,} elements, but has no bytes for them")
            table = np.broadcast_to(np.zeros((), kind), (accessor.count, width))
        else:
            stride = self.item("buffer_views", accessor.buffer_view).byte_stride
            table = self._table(accessor, stride, accessor.count, width, kind, where)
        return table if accessor.sparse is None else self._patched(table, accessor.sparse, where)

    def _table(
        self, part: schema.Accessor | schema.SparsePart, stride: int, count: int, width: int, kind, where: str
    ) -> np.ndarray:
        data, offset, size = self.view(part.buffer_view), part.byte_offset, width * kind.itemsize
        stride = stride or size
        if stride < size:
            raise BadMesh(f"{where} has elements of {size} bytes, {stride} apart; export the file again")
        if count and offset + stride * (count - 1) + size > len(data):
            raise BadMesh(
                f"{where} counts {count:,} elements, more than its {len(data):,} bytes hold; "
                "export the file again"
            )
        if not count:
            return np.empty((0, width), kind)
        return np.ndarray((count, width), kind, data, offset, (stride, kind.itemsize))

    def _patched(self, base: np.ndarray, sparse: schema.Sparse, where: str) -> np.ndarray:
        if sparse.count > len(base) or sparse.indices.component_type not in (5121, 5123, 5125):
            raise BadMesh(f"{where} replaces {sparse.count:,} of its {len(base):,} elements; export it again")
        kind = np.dtype(COMPONENTS[sparse.indices.component_type])
        indices = self._table(sparse.indices, 0, sparse.count, 1, kind, where)[:, 0]
        values = self._table(sparse.values, 0, sparse.count, base.shape[1], base.dtype, where)
        if len(indices) and indices.max() >= len(base):
            raise BadMesh(f"{where} replaces an element that it does not have; export the file again")
        patched = base.copy()
        patched[indices] = values
        return patched

    def numbers(
        self,
        index: int,
        widths: tuple[int, ...] = (),
        chosen: np.ndarray | None = None,
        scaled: bool = False,
    ) -> np.ndarray:
        """(count, n) float32, integers divided by their largest where the accessor is normalised or they are
        `scaled` in any case; of the elements `chosen` alone, where that is given."""
        rows, accessor = self.rows(index, widths), self.item("accessors", index)
        if chosen is not None:
            if len(chosen) and chosen[-1] >= len(rows):
                raise BadMesh(
                    f"{self.path}: accessor {index} has {len(rows):,} elements, but the vertices are more; "
                    "export the file again"
                )
            rows = rows[chosen]
        return normalised(rows) if scaled or accessor.normalized else rows.astype(np.float32)


def normalised(rows: np.ndarray) -> np.ndarray:
    """float32 of integers that stand for [0, 1] or [-1, 1]; floats as they are."""
    if rows.dtype.kind == "f":
        return rows.astype(np.float32)
    return np.maximum(rows.astype(np.float32) / np.iinfo(rows.dtype).max, -1)


def is_data(uri: str) -> bool:
    """Whether a URI holds its bytes itself."""
    return uri[:5].lower() == "data:"


def data_uri(uri: str, where: str) -> bytes:
    """The bytes of `data:`. Raises BadMesh."""
    head, comma, body = uri.partition(",")
    if not comma:
        raise BadMesh(f"{where}: a data URI without data")
    data = unquote_to_bytes(body)
    if not head.rstrip().lower().endswith(";base64"):
        return data
    try:
        return base64.b64decode(data + b"=" * (-len(data) % 4))
    except ValueError as error:
        raise BadMesh(f"{where}: the data URI is no base64 ({error}); export the file again") from error
