"""Niantic's .spz, versions 1 to 4: quantised splats, packed by gzip as a whole or by zstd in streams.

https://github.com/nianticlabs/spz (README.md, load-spz.cc); of levels of detail
https://github.com/sparkjsdev/spark (rust/spark-lib/src/spz.rs). Positions, rotations and harmonics are stored
with the axes right, up, back, or with those that an extension states; a .ply of the same splats has right,
down, front. Nothing in a file tells whether its writer turned the axes, as the format asks.
"""

import struct
import zlib
from pathlib import Path

import numpy as np

from formats.errors import BadSplats, NewerVersion
from formats.splats.harmonics import basis
from formats.splats.placing import placed
from formats.splats.splats import (
    ANTIALIASED,
    DOWN_Y,
    UP_Y,
    Splats,
    check_count,
    coefficients_of,
    gathered,
    not_honoured,
)

MAGIC, GZIP = b"NGSP", b"\x1f\x8b"
HEADER = struct.Struct("<4sIIBBBB")
STREAMS_AT = struct.Struct("<I")
STREAM = struct.Struct("<QQ")
CONTAINER = 32
"""Bytes of version 4's header."""
LATEST = 4
SMOOTHED, EXTENDED, LEVELLED = 1, 2, 128
"""Flags: antialiasing, extensions, and Spark's for a tree of levels of detail."""
MAX_FRACTION = 24
MAX_EXTENSIONS = 1 << 20
COLOUR = 0.15
"""What a step of 1 of the first coefficient is of the range of a byte."""
AXES_EXTENSION = 0xADBE0003
"""SPZ_ADOBE_coordinate_system, a number: less one, its bits say right, up and front (instead of left, down
and back), and the last that all is turned about x, as where z is up."""
RIGHT_UP_BACK, RIGHT_DOWN_FRONT = 4, 6
UNSTATED = (
    "does not state its axes, which are taken as its format has them: right, up, back; where its writer left "
    "those of a .ply, as SplatTransform, Spark and gsbox do, it stands upside down, and --up 0,1,0 mends that"
)
Z_UP = np.array([[1.0, 0, 0, 0], [0, 0, 1, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
"""From axes with z up to those with y up: -90 degrees about x."""


def is_spz(head: bytes) -> bool:
    """Whether a file begins as one, also behind gzip."""
    if head.startswith(GZIP):
        try:
            head = zlib.decompressobj(zlib.MAX_WBITS | 16).decompress(head, HEADER.size)
        except zlib.error:
            return False
    return head.startswith(MAGIC)


def read_spz(path: Path | str, data: bytes | memoryview, as_stored: bool = False) -> Splats:
    """In the axes of a .ply, or with those that the file has, if `as_stored`, as within glTF. Raises
    BadSplats, LimitExceeded, NewerVersion."""
    notes: list[str] = []
    if data[:2] == GZIP:
        parts = _Legacy(path, data, notes)
    elif len(data) >= HEADER.size and HEADER.unpack_from(data)[1] < LATEST:
        parts = _Legacy(path, data, notes, plain=True)
    else:
        parts = _Container(path, data, notes)
    return parts.splats(as_stored)


class _Packed:
    """The header and the arrays of bytes of a file."""

    def __init__(self, path: Path | str, header: bytes, n_bytes: int, notes: list[str]):
        self.path, self.notes = path, notes
        if len(header) < HEADER.size:
            raise BadSplats(f"{path}: ends within its header; copy or export it again")
        magic, self.version, self.count, degree, self.fraction, flags, self.extra = HEADER.unpack_from(header)
        if magic != MAGIC:
            raise BadSplats(f"{path}: is no .spz, which begins with NGSP; export it again")
        if self.version > LATEST:
            raise NewerVersion(
                f"{path}: is a .spz of version {self.version}, and versions 1 to {LATEST} are read; update "
                "fusedrf, or save it as a .ply"
            )
        if not self.version or degree > 4 or self.fraction > MAX_FRACTION:
            raise BadSplats(
                f"{path}: states version {self.version}, degree {degree} and {self.fraction} bits of "
                "fraction, which no .spz has; export it again"
            )
        check_count(path, self.count, n_bytes)
        self.stored, self.kept = coefficients_of(path, 3 * ((degree + 1) ** 2 - 1), notes)
        self.extended = bool(flags & EXTENDED)
        self.levelled = bool(flags & LEVELLED) and self.version < LATEST
        if flags & SMOOTHED:
            notes.append(ANTIALIASED)
        known = SMOOTHED | EXTENDED | (LEVELLED if self.levelled else 0)
        not_honoured([hex(1 << i) for i in range(8) if flags & ~known & 1 << i], notes, "flags")
        self.axes, self.stated = RIGHT_UP_BACK, False
        self.arrays: dict[str, np.ndarray] = {}

    @property
    def widths(self) -> dict[str, int]:
        """Bytes that a splat takes in each array, in the order of the file."""
        return {
            "positions": 6 if self.version == 1 else 9,
            "alphas": 1,
            "colours": 3,
            "scales": 3,
            "rotations": 3 if self.version < 3 else 4,
            "harmonics": 3 * self.stored,
        } | ({"children": 2, "first children": 4} if self.levelled else {})

    def read_extensions(self, data: bytes | memoryview) -> None:
        """Records of type and length: the one of axes is read, others are told."""
        names, at = [], 0
        while at + 8 <= len(data) and len(names) < 100:
            kind, length = struct.unpack_from("<II", data, at)
            at += 8 + length
            if kind == AXES_EXTENSION and length == 4 and at <= len(data):
                (axes,) = struct.unpack_from("<I", data, at - 4)
                self.stated = 1 <= axes <= 16
                self.axes = axes if self.stated else RIGHT_UP_BACK
            else:
                names.append(f"0x{kind:08X}")
        not_honoured(names, self.notes, "extensions")

    def keep_finest(self) -> None:
        """Of a tree of levels of detail, what has no children: the others stand for it from afar."""
        finest = self.arrays["children"].view("<u2") == 0
        if not (kept := int(finest.sum())):
            raise BadSplats(f"{self.path}: its levels of detail have no finest; export it again")
        self.notes.append(f"holds levels of detail: {kept:,} of {self.count:,} splats, the finest, are read")
        self.arrays = {name: self._bytes(name)[finest].reshape(-1) for name in self.arrays}
        self.count = kept

    # --- what the bytes stand for ---------------------------------------------------------------------------

    def splats(self, as_stored: bool) -> Splats:
        """An axis that changes its sign changes those of harmonics, and two of a quaternion's."""
        if not self.stated and not as_stored:
            self.notes.append(UNSTATED)
        bits = self.axes - 1 ^ RIGHT_DOWN_FRONT - 1
        turn = np.ones(3) if as_stored else 1.0 - 2 * np.array([bits & 1, bits >> 1 & 1, bits >> 2 & 1])
        point = np.array([[0.3, 0.5, 0.7]])
        signs = np.sign(basis(point * turn) / basis(point))[0, 1 : 1 + self.kept]
        harmonics = np.empty((self.count, 1 + self.kept, 3), np.float32)
        harmonics[:, 0] = (self._bytes("colours") / 255 - 0.5) / COLOUR
        rest = self.arrays["harmonics"].reshape(self.count, self.stored, 3)[:, : self.kept]
        np.multiply(rest.astype(np.float32) / 128 - 1, signs[:, None], out=harmonics[:, 1:], casting="unsafe")
        splats = gathered(
            self.path,
            f"a .spz file of version {self.version}",
            centres=self._positions() * turn,
            scales=np.exp(self._bytes("scales") / 16 - 10),
            rotations=self._rotations() * np.concatenate([[1], turn.prod() * turn]),
            opacities=np.minimum(self._bytes("alphas")[:, 0] / (127.5 if self.levelled else 255), 1),
            harmonics=harmonics,
            up=UP_Y if as_stored else DOWN_Y,
            notes=self.notes,
        )
        return placed(splats, Z_UP) if bits & 8 and not as_stored else splats

    def _bytes(self, name: str) -> np.ndarray:
        return self.arrays[name].reshape(self.count, -1)

    def _positions(self) -> np.ndarray:
        """(N, 3) float64 of halves (version 1), or of whole numbers of 24 bits with a sign."""
        rows = self._bytes("positions")
        if self.version == 1:
            return rows.view("<f2").astype(np.float64)
        low, middle, high = rows.reshape(-1, 3, 3).astype(np.int32).transpose(2, 0, 1)
        return (low | middle << 8 | (high ^ 0x80) - 0x80 << 16) / 2.0**self.fraction

    def _rotations(self) -> np.ndarray:
        """(N, 4) w, x, y, z of x, y, z as bytes, or of the three smallest as ten bits each."""
        rows = self._bytes("rotations")
        if self.version < 3:
            xyz = rows / 127.5 - 1
            return np.concatenate([np.sqrt(np.maximum(0, 1 - (xyz**2).sum(1, keepdims=True))), xyz], 1)
        packed = rows.view("<u4")[:, 0]
        largest = (packed >> 30).astype(int)
        xyzw = np.zeros((self.count, 4))
        shift = np.zeros(self.count, np.uint32)
        for i in (3, 2, 1, 0):
            field = packed >> shift & 1023
            value = np.sqrt(0.5) * (field & 511) / 511 * np.where(field >> 9, -1, 1)
            xyzw[:, i] = np.where(largest == i, 0, value)
            shift += np.where(largest == i, 0, 10).astype(np.uint32)
        rest = np.sqrt(np.maximum(0, 1 - (xyzw**2).sum(1)))
        xyzw[np.arange(self.count), largest] = rest
        return np.roll(xyzw, 1, axis=1)


class _Legacy(_Packed):
    """Versions 1 to 3: header, arrays and extensions in one stream of gzip, or as they are."""

    def __init__(self, path: Path | str, data: bytes | memoryview, notes: list[str], plain: bool = False):
        self.unpack = None if plain else zlib.decompressobj(zlib.MAX_WBITS | 16)
        self.rest = bytes(data)
        super().__init__(path, self._take(path, HEADER.size), len(data), notes)
        if self.version >= LATEST:
            raise BadSplats(f"{path}: a .spz of version {self.version} within gzip; export it again")
        for name, width in self.widths.items():
            part = self._take(path, self.count * width)
            if len(part) < self.count * width:
                raise BadSplats(
                    f"{path}: ends within the {name} of {self.count:,} splats; copy or export it again"
                )
            self.arrays[name] = np.frombuffer(part, np.uint8)
        extensions = self._take(path, MAX_EXTENSIONS)
        if self.unpack and not self.unpack.eof:  # so that its checksum is read
            raise BadSplats(f"{path}: is cut off, or goes on behind its splats; copy or export it again")
        if self.extended:
            self.read_extensions(extensions)
        if self.levelled:
            self.keep_finest()

    def _take(self, path: Path | str, size: int) -> bytes:
        """The next bytes, fewer at the end."""
        if not self.unpack:
            part, self.rest = self.rest[:size], self.rest[size:]
            return part
        if not size:
            return b""
        try:
            part = self.unpack.decompress(self.rest, size)
            while len(part) < size and self.unpack.unconsumed_tail and not self.unpack.eof:
                part += self.unpack.decompress(self.unpack.unconsumed_tail, size - len(part))
        except zlib.error as error:
            raise BadSplats(f"{path}: cannot be unpacked ({error}); copy or export it again") from error
        self.rest = self.unpack.unconsumed_tail
        return part


class _Container(_Packed):
    """Version 4: a header, extensions, a table of sizes and a stream of zstd for each array."""

    def __init__(self, path: Path | str, data: bytes | memoryview, notes: list[str]):
        super().__init__(path, data[: HEADER.size], len(data), notes)
        if len(data) < CONTAINER:
            raise BadSplats(f"{path}: ends within its header; copy or export it again")
        (table,) = STREAMS_AT.unpack_from(data, HEADER.size)
        names = [name for name, width in self.widths.items() if width]
        at = table + STREAM.size * self.extra
        if table < CONTAINER or at > len(data) or self.extra != len(names):
            raise BadSplats(
                f"{path}: its {self.extra} streams begin at byte {at:,} of {len(data):,}, expected "
                f"{len(names)} of them; copy or export it again"
            )
        if self.extended:
            self.read_extensions(data[CONTAINER:table])
        for index, name in enumerate(names):
            packed, size = STREAM.unpack_from(data, table + STREAM.size * index)
            if size != self.count * self.widths[name] or packed > len(data) - at:
                raise BadSplats(
                    f"{path}: states {packed:,} bytes packed and {size:,} unpacked for the {name} of "
                    f"{self.count:,} splats; copy or export it again"
                )
            unpacked = _unzstd(path, bytes(data[at : at + packed]), size)
            self.arrays[name], at = np.frombuffer(unpacked, np.uint8), at + packed
        if at != len(data):
            raise BadSplats(f"{path}: has {len(data) - at:,} bytes behind its streams; copy it again")
        self.arrays.setdefault("harmonics", np.empty(0, np.uint8))


def _unzstd(path: Path | str, packed: bytes, size: int) -> bytes:
    """One whole frame of so many bytes. Raises BadSplats."""
    try:
        from compression import zstd
    except ImportError:  # before Python 3.14
        from backports import zstd
    try:
        stream = zstd.ZstdDecompressor()
        unpacked = stream.decompress(packed, size)
        if not stream.eof:
            unpacked += stream.decompress(b"", 1)
    except (zstd.ZstdError, MemoryError, EOFError) as error:
        raise BadSplats(f"{path}: cannot be unpacked ({error}); copy or export it again") from error
    if len(unpacked) != size or not stream.eof or stream.unused_data:
        raise BadSplats(f"{path}: a stream is not of the {size:,} bytes that are stated; copy it again")
    return unpacked
