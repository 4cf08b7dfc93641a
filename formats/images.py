"""Pictures: 8-bit sRGB in, PNG out, whole or not at all."""

import os
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import BinaryIO, NamedTuple

import numpy as np

from formats.errors import BadImage, FormatError, LimitExceeded, MixedSizes
from formats.other_files import HEAD, identify
from formats.png import png_writer
from formats.safe_input import open_input

FORMATS = ("PNG", "JPEG", "MPO", "WEBP", "BMP", "TGA", "TIFF", "PPM", "GIF", "AVIF", "HEIF")
"""What Pillow may open, by its names; others start programs (EPS) or are no photos. HEIF needs `[heif]`."""
MAX_SIDE = 16384
EXIF_ORIENTATION = 0x0112
EXIF_PART = 0x8769
EXIF_FOCAL_35MM = 0xA405
DIAGONAL_35MM = 43.27
"""Millimetres across the corners of the film that EXIF's equivalent focal lengths refer to."""
LOSSY = ("JPEG", "MPO", "WEBP", "AVIF", "HEIF")
RINGING = 32
"""Levels of 255 up to which a lossy picture that is black may be off."""
DECODING_BYTES = 256 << 20
"""Photos are decoded side by side while they take no more than this together, a larger one alone."""
PER_STORED_PIXEL = 8
"""Bytes while a photo is decoded: Pillow's 4, and what the decoder of a progressive JPEG keeps."""
TAIL = 1 << 12
"""Bytes in which the end of a whole picture is looked for; one that goes on behind it is decoded."""
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
    """Whether there is an alpha channel, or a colour of a palette that is transparent, used or not."""
    orientation: int
    """The EXIF orientation, 1 to 8: how to turn the stored pixels upright; 1 where none is given."""


def decoded_at_once(width: int, height: int) -> int:
    """How many photos of so many stored pixels are decoded side by side."""
    return min(os.cpu_count() or 1, max(1, DECODING_BYTES // (width * height * PER_STORED_PIXEL)))


def decoding_bytes(width: int, height: int) -> int:
    """Memory that decoding such photos takes beside what comes out."""
    return decoded_at_once(width, height) * width * height * PER_STORED_PIXEL


def read_image(
    path: Path | str,
    orientation: int = 1,
    reduction: int = 1,
    alpha: bool = True,
    out: np.ndarray | None = None,
    premultiplied: bool = False,
    at_once: int = 1 << 20,
) -> np.ndarray:
    """(H, W, 4) uint8, straight alpha, 255 where the file has none, or all over where `alpha` is False.

    The pixels stand as stored: an EXIF rotation is not applied, as the tools that estimate poses ignore it
    too, unless `orientation` (as EXIF counts them) asks for one. With `reduction` each is the mean of so many
    a side of the turned picture, colours weighted by alpha; what is left over at the right and below is cut
    off. `out` takes the pixels where it is given. Colours of a file that are `premultiplied` are divided by
    alpha. About `at_once` stored pixels are converted at a time. Raises BadImage, LimitExceeded (before
    decoding), MissingExtra, MissingFile, MixedSizes (`out` has another shape).
    """
    with _decoded(path) as image:
        (left, wide), (top, high) = _kept_spans(image.size, orientation, reduction)
        shape = (wide, high) if orientation >= 5 else (high, wide)
        if out is None:
            out = np.empty((*shape, 4), np.uint8)
        elif out.shape[:2] != shape:
            actual, expected = (f"{w}x{h}" for h, w in (shape, out.shape[:2]))
            raise MixedSizes(f"{path} is {actual} now, expected {expected}; read it again")
        stored = as_stored(out, orientation)
        rows = max(1, at_once // (image.width * reduction))
        for row in range(0, high, rows):
            end = min(row + rows, high)
            box = (left, top + row * reduction, left + wide * reduction, top + end * reduction)
            band = _rgba(image.crop(box), alpha)
            if premultiplied:
                band = _straight(band)
            stored[row:end] = np.asarray(band if reduction == 1 else band.reduce(reduction))
    return out


def _kept_spans(size: tuple[int, int], orientation: int, reduction: int) -> Iterator[tuple[int, int]]:
    """First stored pixel, and number of reduced ones, along x and y: the turned picture is cut at its right
    and lower border."""
    flips = (orientation in (2, 3, 6, 7), orientation in (3, 4, 7, 8))
    for side, flipped in zip(size, flips[::-1] if orientation >= 5 else flips, strict=True):
        yield side % reduction if flipped else 0, side // reduction


def read_alpha(path: Path | str) -> np.ndarray:
    """(H, W) uint8, the alpha of the stored pixels. Raises as `read_image`."""
    with _decoded(path) as image:
        if not image.has_transparency_data:
            return np.full(image.size[::-1], 255, np.uint8)
        has_channel = "A" in image.getbands()
        return np.array((image if has_channel else _rgba(image, True)).getchannel("A"))


def read_mask(path: Path | str) -> np.ndarray:
    """(H, W) bool of a mask picture: True where it is bright, that is, where the photo is used.

    Bright means above half of the mask's maximum, so masks of 0 and 1 work as well as masks of 0 and 255, and
    as 16-bit ones. Where an alpha channel is not the same all over it is the mask if the colour is, and
    otherwise both are: the colour over black. Raises as `read_image`.
    """
    with _decoded(path) as image:
        least = RINGING if image.format in LOSSY else 0
        levels = np.array(image if image.mode.startswith("I") else image.convert("RGB").convert("L"))
        alpha = np.array(_rgba(image, True).getchannel("A")) if image.has_transparency_data else None
    if alpha is not None:
        if np.ptp(levels) == 0 < np.ptp(alpha):
            levels = alpha
        elif np.ptp(alpha) > 0 or np.ptp(levels) == 0:
            both = (levels.astype(np.uint16) * alpha // 255).astype(np.uint8)
            levels = both if both.any() or not np.ptp(alpha) else 255 - alpha  # painted in black on nothing
    brightest = levels.max(initial=0)
    return levels > max(brightest / 2, least)


def read_image_header(path: Path | str) -> Header:
    """Size, alpha and orientation, without decoding. Raises as `read_image`."""
    with _opened(path) as image:
        return Header(*image.size, image.has_transparency_data, _orientation(image))


def check_whole(path: Path | str) -> None:
    """BadImage where a PNG or JPEG ends too early and cannot be decoded; of whole ones only the end is read,
    and of other formats the header tells. Raises as `read_image`."""
    with open_input(path) as file:
        if _reaches_its_end(file):
            return
    try:
        with _decoded(path):
            pass
    except BadImage as error:
        raise BadImage(f"{path}: the file is cut off; copy it again, or remove it") from error


def _reaches_its_end(file: BinaryIO) -> bool:
    """Whether the end of a PNG or JPEG is found in its last bytes; True of other formats."""
    head = file.read(4)
    mark = {b"\x89PNG": b"IEND", b"\xff\xd8\xff": b"\xff\xd9"}.get(head if head[:1] == b"\x89" else head[:3])
    file.seek(max(0, os.fstat(file.fileno()).st_size - TAIL))
    return mark is None or mark in file.read()


def read_focal(path: Path | str) -> float | None:
    """Focal length in diagonals of the picture, from EXIF; None where it does not say. Raises as
    `read_image`."""
    with _opened(path) as image:
        try:
            focal = float(image.getexif().get_ifd(EXIF_PART).get(EXIF_FOCAL_35MM, 0))
        except DECODING_ERRORS:  # broken metadata
            return None
    return focal / DIAGONAL_35MM if 1 <= focal <= 10_000 else None


def write_smaller(path: Path | str, smaller: Path, longest: int) -> tuple[int, int]:
    """Decode all of a picture and write it as RGB PNG, at most `longest` pixels a side, as stored; returns
    its width and height. Raises as `read_image`."""
    from PIL import Image

    with _opened(path) as image:
        shrink = min(1.0, longest / max(image.size))
        size = tuple(max(1, round(side * shrink)) for side in image.size)
        image.draft("RGB", size)  # a JPEG is decoded at about this size, which is several times faster
        picture = eight_bits(image).convert("RGB").resize(size, Image.Resampling.LANCZOS)
    picture.save(smaller, "PNG", compress_level=1)
    return size


def oriented(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """(H, W, ...) stored pixels turned and mirrored as an EXIF orientation from 1 to 8 says; a view."""
    if orientation >= 5:  # stored rows are columns of the picture
        pixels = pixels.swapaxes(0, 1)
    return _flipped(pixels, orientation)


def as_stored(pixels: np.ndarray, orientation: int) -> np.ndarray:
    """The inverse of `oriented`."""
    pixels = _flipped(pixels, orientation)
    return pixels.swapaxes(0, 1) if orientation >= 5 else pixels


def _flipped(pixels: np.ndarray, orientation: int) -> np.ndarray:
    across, down = orientation in (2, 3, 6, 7), orientation in (3, 4, 7, 8)
    return pixels[:: -1 if down else 1, :: -1 if across else 1]


def _rgba(image, alpha: bool):
    """A decoded picture of any mode as RGBA, opaque where `alpha` is False."""
    picture = eight_bits(image).convert("RGBA")  # first, since palettes lose transparency with a warning
    return picture if alpha else picture.convert("RGB").convert("RGBA")


def _straight(image):
    """An RGBA picture whose colours are multiplied by alpha, with straight alpha."""
    from PIL import Image

    return Image.frombytes("RGBa", image.size, image.tobytes()).convert("RGBA")


def eight_bits(image):
    """Grey levels of 16 bits and more as 8, which Pillow would clip; other pictures as they are."""
    from PIL import Image

    if not image.mode.startswith(("I", "F")):
        return image
    scale = 255 / 65535 if image.mode.startswith("I") else 255
    levels = np.rint(np.asarray(image).astype(np.float64) * scale)
    return Image.fromarray(np.clip(levels, 0, 255).astype(np.uint8))


def _orientation(image) -> int:
    try:
        value = image.getexif().get(EXIF_ORIENTATION)
    except DECODING_ERRORS:  # broken metadata; the pixels may be intact
        return 1
    return value if isinstance(value, int) and 1 <= value <= 8 else 1


@contextmanager
def _decoded(path: Path | str) -> Iterator:
    """An open picture whose pixels are in memory until it is left."""
    with _opened(path) as image:
        try:
            image.load()
            yield image
        finally:
            image.close()


@contextmanager
def _opened(path: Path | str) -> Iterator:
    from PIL import Image, UnidentifiedImageError

    with open_input(path) as file:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", Image.DecompressionBombWarning)
                image = Image.open(file, formats=_readable())
            _check_header(image, path)
            yield image
        except Image.DecompressionBombError as error:
            raise LimitExceeded(f"{path}: the picture has too many pixels to be decoded safely") from error
        except UnidentifiedImageError as error:
            file.seek(0)
            raise _unread(path, file.read(HEAD)) from error
        except DECODING_ERRORS as error:
            raise BadImage(
                f"{path}: the picture cannot be decoded ({error}); replace or remove it"
            ) from error


@cache
def _readable() -> tuple[str, ...]:
    """Those of FORMATS that can be read here."""
    from PIL import Image

    Image.init()
    if find_spec("pillow_heif"):
        from pillow_heif import register_heif_opener

        register_heif_opener()
    return tuple(name for name in FORMATS if name in Image.OPEN)


def _unread(path: Path | str, head: bytes) -> FormatError:
    """The error for a file that is no picture of a known format."""
    other = identify(head, Path(path).suffix)
    if other is None or not other.extra and other.kind in ("photo", "heif"):
        return BadImage(
            f"{path}: the picture cannot be decoded (damaged, or in no known format); replace or remove it"
        )
    return other.error(f"{path}: is {other.what}, which is not read as a photo", BadImage)


def _check_header(image, path: Path | str) -> None:
    if max(image.size) > MAX_SIDE:
        width, height = image.size
        raise LimitExceeded(
            f"{path}: the picture is {width}x{height} pixels, but at most {MAX_SIDE} a side are read"
        )
    if image.mode == "F" or image.mode == "I" and image.format not in ("PNG", "PPM"):
        raise BadImage(f"{path}: the picture has 32 bits per channel; save it with 8 or 16 bits")


def write_png(path: Path | str, pixels: np.ndarray) -> None:
    """(H, W, 3) or (H, W, 4) uint8, straight alpha. Raises ResourceError."""
    height, width, channels = pixels.shape
    with png_writer(path, width, height, channels) as write:
        write(pixels)
