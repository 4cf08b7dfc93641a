"""Pictures: what is written comes back, and what is broken is refused in one sentence."""

import struct
import zlib

import numpy as np
import pytest
from PIL import Image

from formats.errors import BadImage, LimitExceeded, MissingFile
from formats.images import read_image, read_image_header, write_png

RANDOM = np.random.default_rng(0)


@pytest.mark.parametrize("channels", [3, 4])
@pytest.mark.parametrize("size", [(1, 1), (7, 13), (1, 40)])
def test_png_round_trip(tmp_path, size, channels):
    pixels = RANDOM.integers(0, 256, (*size, channels), np.uint8)
    write_png(tmp_path / "a.png", pixels)
    back = read_image(tmp_path / "a.png")
    assert (back[..., :channels] == pixels).all()
    assert (back[..., 3] == 255).all() or channels == 4
    assert read_image_header(tmp_path / "a.png") == (size[1], size[0], channels == 4, 1)


@pytest.mark.parametrize(
    "mode, expected", [("L", (90, 90, 90, 255)), ("LA", (90, 90, 90, 40)), ("P", (90, 90, 90, 255))]
)
def test_other_modes_become_rgba(tmp_path, mode, expected):
    picture = Image.new("LA", (4, 3), (90, 40)).convert(mode)
    picture.save(tmp_path / "a.png")
    assert read_image(tmp_path / "a.png")[1, 1].tolist() == list(expected)


@pytest.mark.parametrize("ending", ["png", "jpg", "gif"])
@pytest.mark.parametrize("kept", [0, 10, 0.5])
def test_truncated(tmp_path, ending, kept):
    path = tmp_path / f"a.{ending}"
    Image.fromarray(RANDOM.integers(0, 256, (64, 64, 3), np.uint8)).save(path)
    data = path.read_bytes()
    path.write_bytes(data[: int(kept * len(data)) if kept < 1 else kept])
    with pytest.raises(BadImage, match=rf"a\.{ending}"):
        read_image(path)


def test_every_flipped_byte_reads_or_is_refused(tmp_path):
    path = tmp_path / "a.png"
    write_png(path, RANDOM.integers(0, 256, (6, 5, 4), np.uint8))
    data = path.read_bytes()
    for i in range(len(data)):
        path.write_bytes(data[:i] + bytes([data[i] ^ 0x41]) + data[i + 1 :])
        try:
            read_image(path)
        except (BadImage, LimitExceeded):
            pass


def png_of_size(width: int, height: int) -> bytes:
    """A PNG whose header claims a size that its data do not have."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return (
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(b"\0" * 64))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("size", [(16385, 1), (1, 16385), (2**31 - 1, 2**31 - 1), (16384, 16384)])
def test_size_is_checked_before_decoding(tmp_path, size):
    path = tmp_path / "huge.png"
    path.write_bytes(png_of_size(*size))
    for read in (read_image_header, read_image):
        with pytest.raises(LimitExceeded, match=r"huge\.png"):
            read(path)


def test_longest_side_is_read(tmp_path):
    write_png(tmp_path / "a.png", np.zeros((1, 16384, 3), np.uint8))
    assert read_image(tmp_path / "a.png").shape == (1, 16384, 4)


def test_pictures_of_32_bits_are_refused(tmp_path):
    Image.fromarray(np.full((3, 3), 0.5, np.float32)).save(tmp_path / "a.tif")
    with pytest.raises(BadImage, match="8 or 16 bits"):
        read_image(tmp_path / "a.tif")


def test_missing(tmp_path):
    with pytest.raises(MissingFile, match=r"no\.png"):
        read_image(tmp_path / "no.png")
