"""Pictures: 8-bit sRGB in, PNG out, whole or not at all."""

import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np

from formats.errors import BadImage, LimitExceeded
from formats.inputs import open_input
from formats.png import png_writer

MAX_SIDE = 16384
DEEP_MODES = ("I", "F")
"""Pillow's modes with 16 bits or more, which it would clip to 8, not scale."""
DECODING_ERRORS = (
    OSError,
    SyntaxError,
    ValueError,
    EOFError,
    LookupError,
    TypeError,
    ArithmeticError,
    struct.error,
)
"""What Pillow's decoders are known to raise on broken files."""


def read_image(path: Path | str) -> np.ndarray:
    """(H, W, 4) uint8, straight alpha, 255 where the file has none.

    The pixels stand as stored: an EXIF rotation is not applied, as the tools that estimate poses ignore it
    too. Raises BadImage, LimitExceeded (before decoding), MissingFile.
    """
    with _opened(path) as image:
        return np.array(image.convert("RGBA"))


def read_image_header(path: Path | str) -> tuple[int, int, bool]:
    """Width, height and whether there is alpha, without decoding. Raises as `read_image`."""
    with _opened(path) as image:
        return *image.size, image.has_transparency_data


@contextmanager
def _opened(path: Path | str) -> Iterator:
    from PIL import Image

    with open_input(path) as file:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)
                image = Image.open(file)
            _check_header(image, path)
            yield image
        except Image.DecompressionBombError as error:
            raise LimitExceeded(f"{path}: the picture has too many pixels to be decoded safely") from error
        except DECODING_ERRORS as error:
            reason = "it is no picture in a known format" if _unidentified(error) else str(error)
            raise BadImage(
                f"{path}: the picture cannot be decoded ({reason}); replace or remove it"
            ) from error


def _unidentified(error: Exception) -> bool:
    return type(error).__name__ == "UnidentifiedImageError"


def _check_header(image, path: Path | str) -> None:
    if max(image.size) > MAX_SIDE:
        width, height = image.size
        raise LimitExceeded(
            f"{path}: the picture is {width}x{height} pixels, but at most {MAX_SIDE} a side are read"
        )
    if image.mode.startswith(DEEP_MODES):
        raise BadImage(f"{path}: the picture has more than 8 bits per channel; save it with 8 bits")


def write_png(path: Path | str, pixels: np.ndarray) -> None:
    """(H, W, 3) or (H, W, 4) uint8, straight alpha. Raises ResourceError."""
    height, width, channels = pixels.shape
    with png_writer(path, width, height, channels) as write:
        write(pixels)
