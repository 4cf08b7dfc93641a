""".ksplat of GaussianSplats3D: sections of splats, plain or quantised about the centres of buckets.

https://github.com/mkkellogg/GaussianSplats3D (src/loaders/SplatBuffer.js). Level 0 holds float32; level 1
halves, with positions in 16 bits; level 2 the same with harmonics in bytes.
"""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from formats.errors import BadSplats
from formats.splats.splats import Splats, check_count, coefficients_of, gathered, of_colours

HEADER, SECTION = 4096, 1024
"""Bytes of the file's header, and of that of each section."""
MAX_SECTIONS = 10_000
FIELDS = struct.Struct("<BBHIIIIHHfffff")
"""Version, 0; sections and how many are filled; splats likewise; level, 0; centre; range of level 2."""
SECTION_FIELDS = struct.Struct("<IIIIfHHIIIIH")
NUMBERS = ("<f4", "<f2", "<f2")
"""By level: of scales and rotations."""
POSITIONS = ("<f4", "<u2", "<u2")
HARMONICS = ("<f4", "<f2", "u1")
HALF_RANGE, SH_RANGE = 32767, 1.5
"""Where a header states 0: half the range of positions, and the range of harmonics about 0."""


@dataclass(frozen=True)
class _Section:
    """The layout of a section."""

    count: int
    capacity: int
    """Splats in it, and those that it has room for."""
    bucket: int
    """Splats of a full bucket."""
    n_buckets: int
    block: float
    """Side of a bucket."""
    bucket_bytes: int
    half_range: int
    full: int
    partial: int
    """Buckets that are full, and those behind them, whose sizes are stored."""
    degree: int

    def row(self, level: int) -> np.dtype:
        """A splat."""
        fields = [
            ("centre", POSITIONS[level], 3),
            ("scale", NUMBERS[level], 3),
            ("rotation", NUMBERS[level], 4),
            ("rgba", "u1", 4),
            ("harmonics", HARMONICS[level], (3 * ((self.degree + 1) ** 2 - 1),)),
        ]
        return np.dtype(fields)

    @property
    def rows_at(self) -> int:
        """Bytes before the splats: the sizes of buckets, then their centres."""
        return 4 * self.partial + self.n_buckets * self.bucket_bytes

    def size(self, level: int) -> int:
        """Bytes in all, without the header."""
        return self.rows_at + self.capacity * self.row(level).itemsize


def is_ksplat(head: bytes, size: int) -> bool:
    """Whether a file of `size` bytes begins as one. There is no signature, so that the header has to suit."""
    if len(head) < HEADER + SECTION or any(head[FIELDS.size : HEADER]):
        return False
    major, minor, zero, sections, _, _, count, level, *_ = FIELDS.unpack_from(head)
    likely = (major, zero) == (0, 0) and minor >= 1 and level < 10 and count > 0
    return likely and 1 <= sections <= MAX_SECTIONS and HEADER + SECTION * sections < size


def read_ksplat(path: Path | str, data: bytes) -> Splats:
    """Raises BadSplats, LimitExceeded."""
    _, _, _, n_sections, _, _, count, level, *_, least, largest = FIELDS.unpack_from(data)
    at = HEADER + SECTION * n_sections
    if level > 2:
        raise BadSplats(f"{path}: states compression level {level}, and 0 to 2 are read; save it as a .ply")
    sections = [_section(data, HEADER + SECTION * i, level) for i in range(n_sections)]
    if any(section.degree > 3 for section in sections):
        raise BadSplats(f"{path}: states harmonics of a degree above 3; export it again")
    held = sum(section.count for section in sections)
    check_count(path, held)
    stated = at + sum(section.size(level) for section in sections)
    if stated > len(data) or any(section.count > section.capacity for section in sections):
        raise BadSplats(
            f"{path}: states {held:,} splats in sections of {stated:,} bytes, but has {len(data):,}; copy or "
            "export it again"
        )
    notes = [] if held == count else [f"counts {count:,} splats, but {held:,} are in its sections and read"]
    most = max(section.degree for section in sections)
    span, parts = (least or -SH_RANGE, largest or SH_RANGE), []
    for section in sections:
        parts.append(_splats(path, section, memoryview(data)[at:], level, span, most))
        at += section.size(level)
    columns = [np.concatenate(each) for each in zip(*parts, strict=True)]
    names = ("centres", "scales", "rotations", "opacities", "harmonics")
    return gathered(path, "a .ksplat file", notes=notes, **dict(zip(names, columns, strict=True)))


def _section(data: bytes, at: int, level: int) -> _Section:
    fields = SECTION_FIELDS.unpack_from(data, at)
    count, capacity, bucket, n_buckets, block, bucket_bytes, _, half, _, full, partial, degree = fields
    half = half or (HALF_RANGE if level else 1)
    return _Section(count, capacity, bucket, n_buckets, block, bucket_bytes, half, full, partial, degree)


def _splats(path, section: _Section, data: memoryview, level: int, span: tuple, degree: int) -> tuple:
    """Centres, scales, rotations, opacities and harmonics, these of as many degrees as any section has."""
    rows = np.frombuffer(data, section.row(level), section.count, section.rows_at)
    centres = rows["centre"].astype(np.float64)
    if level:
        step = section.block / 2 / section.half_range
        centres = (centres - section.half_range) * step + _bucket_centres(path, section, data)
    stored, _ = coefficients_of(path, rows["harmonics"].shape[1], [])
    rest = _ordered(rows["harmonics"].astype(np.float64), stored)
    if level == 2:
        rest = span[0] + rest / 255 * (span[1] - span[0])
    harmonics = np.zeros((section.count, (degree + 1) ** 2, 3), np.float32)
    harmonics[:, :1] = of_colours(rows["rgba"][:, :3] / 255)
    harmonics[:, 1 : 1 + stored] = rest
    numbers = (rows[name].astype(np.float64) for name in ("scale", "rotation"))
    return centres, *numbers, rows["rgba"][:, 3] / 255, harmonics


def _ordered(rest: np.ndarray, stored: int) -> np.ndarray:
    """(N, stored, 3) of numbers that lie by degree, then by colour, then by order."""
    parts, at = [np.empty((len(rest), 0, 3))], 0
    for width in (3, 5, 7):
        if at < 3 * stored:
            parts.append(rest[:, at : at + 3 * width].reshape(-1, 3, width).transpose(0, 2, 1))
            at += 3 * width
    return np.concatenate(parts, 1)


def _bucket_centres(path, section: _Section, data: memoryview) -> np.ndarray:
    """(count, 3) the centre of the bucket that each splat lies in: full ones first, then those with sizes."""
    if section.bucket_bytes < 12 or section.full + section.partial > section.n_buckets:
        raise BadSplats(f"{path}: has fewer buckets than its splats lie in; export it again")
    sizes = np.frombuffer(data, "<u4", section.partial).astype(np.int64)
    ends = np.cumsum(np.concatenate([np.full(section.full, section.bucket, np.int64), sizes]))
    bucket = np.searchsorted(ends, np.arange(section.count), side="right")
    if section.count and bucket[-1] >= len(ends):
        raise BadSplats(f"{path}: some of {section.count:,} splats lie in no bucket; export it again")
    shape, strides = (section.n_buckets, 3), (section.bucket_bytes, 4)
    return np.ndarray(shape, "<f4", data, 4 * section.partial, strides)[bucket].astype(np.float64)
