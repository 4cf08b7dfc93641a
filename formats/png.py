"""PNG written row by row, so that a picture need not fit in memory: 8-bit colour, and 16-bit depth.

Pillow and imageio encode whole pictures only; this writes the same format (ISO/IEC 15948), non-interlaced.
"""

import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

import numpy as np

from formats.atomic import atomic_writer

SIGNATURE = b"\x89PNG\r\n\x1a\n"
COLOUR_TYPES = {1: 0, 3: 2, 4: 6}  # channels -> grey, RGB, RGBA
EFFORT = 6
DEEPEST = 65535
ROWS_AT_ONCE_BYTES = 1 << 22


@contextmanager
def png_writer(
    path: Path | str,
    width: int,
    height: int,
    channels: int,
    *,
    bits: int = 8,
    text: dict[str, str] | None = None,
) -> Iterator[Callable[[np.ndarray], None]]:
    """A function that takes the picture's rows from the top, (n, width, channels) uint8 (uint16 with bits=16)
    each time; the file appears, whole, when the block ends after the last of `height` rows.

    `text` becomes tEXt chunks, Latin-1. Raises ValueError (rows missing, or that do not fit).
    """
    with atomic_writer(path) as file:
        file.write(SIGNATURE)
        _chunk(file, b"IHDR", struct.pack(">IIBBBBB", width, height, bits, COLOUR_TYPES[channels], 0, 0, 0))
        for key, value in (text or {}).items():
            _chunk(file, b"tEXt", key.encode("latin-1") + b"\0" + value.encode("latin-1"))
        rows = _Rows(file, width, height, channels, bits)
        yield rows.write
        rows.close()
        _chunk(file, b"IEND", b"")


def _chunk(file: BinaryIO, kind: bytes, data: bytes) -> None:
    file.write(struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data)))


class _Rows:
    """Filters and compresses rows as they are written."""

    def __init__(self, file: BinaryIO, width: int, height: int, channels: int, bits: int):
        self.file, self.missing, self.shape = file, height, (width, channels)
        self.dtype, self.pixel = np.dtype(f">u{bits // 8}"), channels * bits // 8
        self.above = np.zeros((1, width * self.pixel), np.uint8)
        self.packer = zlib.compressobj(EFFORT, strategy=zlib.Z_FILTERED)

    def write(self, rows: np.ndarray) -> None:
        if rows.shape[1:] != self.shape or rows.dtype.itemsize != self.dtype.itemsize:
            raise ValueError(f"rows should be (n, {self.shape[0]}, {self.shape[1]}), found {rows.shape}")
        self.missing -= len(rows)
        at_once = max(1, ROWS_AT_ONCE_BYTES // self.above.size)
        for start in range(0, len(rows), at_once):
            part = np.ascontiguousarray(rows[start : start + at_once], self.dtype)
            raw = part.view(np.uint8).reshape(len(part), -1)
            if packed := self.packer.compress(self.filtered(raw)):
                _chunk(self.file, b"IDAT", packed)
            self.above = raw[-1:].copy()

    def filtered(self, raw: np.ndarray) -> bytes:
        """Rows (n, bytes), each as it is, less its left neighbour or less the row above, whichever is nearest
        to 0 (the specification's own heuristic, §12.8); the filter's number leads each row.
        """
        left, up = raw.copy(), raw.copy()
        left[:, self.pixel :] -= raw[:, : -self.pixel]
        up -= np.concatenate([self.above, raw[:-1]])
        choices = np.stack([raw, left, up])
        best = np.abs(choices.view(np.int8).astype(np.int16)).sum(2).argmin(0)
        chosen = choices[best, np.arange(len(raw))]
        return np.concatenate([best.astype(np.uint8)[:, None], chosen], 1).tobytes()

    def close(self) -> None:
        if self.missing:
            raise ValueError(f"{self.missing} rows of the picture are missing")
        _chunk(self.file, b"IDAT", self.packer.flush())


@contextmanager
def depth_png_writer(
    path: Path | str, width: int, height: int
) -> Iterator[tuple[Callable[[np.ndarray], None], dict]]:
    """A function that takes rows (n, width) of distances in world units, and a report that is filled in when
    the block ends: {"path", "scale"}, a distance being its grey level times `scale`.

    Levels are 16-bit grey; 0 means that nothing was hit, and so does a distance that is 0 or not finite. The
    scale follows from the farthest distance, so until then the rows are kept in an unnamed file beside the
    picture.
    """
    report = {"path": str(path)}
    farthest = 0.0
    with tempfile.TemporaryFile(dir=Path(path).resolve().parent) as waiting:

        def add(rows: np.ndarray) -> None:
            nonlocal farthest
            seen = rows[np.isfinite(rows) & (rows > 0)]
            farthest = max(farthest, float(seen.max(initial=0)))
            waiting.write(np.ascontiguousarray(rows, np.float64).tobytes())

        yield add, report
        waiting.seek(0)
        report["scale"] = scale = (farthest or 1.0) / DEEPEST
        text = {"depth": f"world units = grey level * {scale!r}; level 0 is nothing"}
        with png_writer(path, width, height, 1, bits=16, text=text) as write:
            at_once = max(1, ROWS_AT_ONCE_BYTES // (8 * width))
            for start in range(0, height, at_once):
                count = min(at_once, height - start)
                rows = np.frombuffer(waiting.read(8 * count * width)).reshape(count, width, 1)
                write(_levels(rows, scale))


def _levels(depth: np.ndarray, scale: float) -> np.ndarray:
    """Distances as uint16 grey levels."""
    seen = np.isfinite(depth) & (depth > 0)
    levels = np.where(seen, np.clip(np.where(seen, depth, 0) / scale, 1, DEEPEST), 0)
    return np.rint(levels).astype(np.uint16)
