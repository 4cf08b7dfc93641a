"""Pictures: 8-bit sRGB in, PNG out, whole or not at all."""

import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from formats.errors import BadImage, LimitExceeded
from formats.inputs import open_input
from formats.png import png_writer

MAX_SIDE = 16384
EXIF_ORIENTATION = 0x0112
EXIF_PART = 0x8769
EXIF_FOCAL_35MM = 0xA405
DIAGONAL_35MM = 43.27
"""Millimetres across the corners of the film that EXIF's equivalent focal lengths refer to."""
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


class Header(NamedTuple):
    """What the header of a picture file states."""

    width: int
    height: int
    """As stored, whatever the orientation."""
    alpha: bool
    orientation: int
    """The EXIF orientation, 1 to 8: how to turn the stored pixels upright; 1 where none is given."""


def read_image(path: Path | str, orientation: int = 1, reduction: int = 1) -> np.ndarray:
    """(H, W, 4) uint8, straight alpha, 255 where the file has none.

    The pixels stand as stored: an EXIF rotation is not applied, as the tools that estimate poses ignore it
    too, unless `orientation` (as EXIF counts them) asks for one. With `reduction` each is the mean of so many
    a side of the turned picture, colours weighted by alpha; what is left over at the right and below is cut
    off. Raises BadImage, LimitExceeded (before decoding), MissingFile.
    """
    with _opened(path) as image:
        return reduced(oriented(np.array(image.convert("RGBA")), orientation), reduction)


def reduced(pixels: np.ndarray, factor: int) -> np.ndarray:
    """(H, W, 4) uint8, straight alpha, to (H // factor, W // factor, 4)."""
    from PIL import Image

    if factor == 1:
        return pixels
    high, wide = (side // factor * factor for side in pixels.shape[:2])
    return np.array(Image.fromarray(np.ascontiguousarray(pixels)).reduce(factor, (0, 0, wide, high)))


def read_mask(path: Path | str) -> np.ndarray:
    """(H, W) bool of a mask picture: True where it is bright, that is, where the photo is used.

    Bright means above half of the mask's maximum, so masks of 0 and 1 work as well as masks of 0 and 255.
    Raises as `read_image`.
    """
    with _opened(path) as image:
        levels = np.array(image.convert("L"))
    return levels > levels.max(initial=0) / 2


def read_image_header(path: Path | str) -> Header:
    """Size, alpha and orientation, without decoding. Raises as `read_image`."""
    with _opened(path) as image:
        return Header(*image.size, image.has_transparency_data, _orientation(image))


def read_focal(path: Path | str) -> float | None:
    """Focal length in diagonals of the picture, from EXIF; None where it does not say. Raises as
    `read_image`."""
    with _opened(path) as image:
        try:
            said = float(image.getexif().get_ifd(EXIF_PART).get(EXIF_FOCAL_35MM, 0))
        except DECODING_ERRORS:  # broken metadata
            return None
    return said / DIAGONAL_35MM if 1 <= said <= 10_000 else None


def write_smaller(path: Path | str, smaller: Path, longest: int) -> tuple[int, int]:
    """Decode all of a picture and write it as RGB PNG, at most `longest` pixels a side, as stored; returns
    its width and height. Raises as `read_image`."""
    from PIL import Image

    with _opened(path) as image:
        shrink = min(1.0, longest / max(image.size))
        size = tuple(max(1, round(side * shrink)) for side in image.size)
        image.draft("RGB", size)  # a JPEG is decoded at about this size, which is several times faster
        picture = image.convert("RGB")
    picture.resize(size, Image.Resampling.LANCZOS).save(smaller, "PNG", compress_level=1)
    return size


def oriented(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """(H, W, ...) stored pixels turned and mirrored as an EXIF orientation from 1 to 8 says."""
    if orientation >= 5:  # stored rows are columns of the picture
        pixels = pixels.swapaxes(0, 1)
    across, down = orientation in (2, 3, 6, 7), orientation in (3, 4, 7, 8)
    return pixels[:: -1 if down else 1, :: -1 if across else 1]


def _orientation(image) -> int:
    try:
        found = image.getexif().get(EXIF_ORIENTATION)
    except DECODING_ERRORS:  # broken metadata; the pixels may be intact
        return 1
    return found if isinstance(found, int) and 1 <= found <= 8 else 1


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
