"""Pictures and films: 8-bit sRGB in, PNG, GIF and MP4 out, each whole or not at all."""

import itertools
import os
import struct
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np

from formats.atomic import atomic_writer
from formats.errors import BadImage, LimitExceeded, MissingExtra, NoViews
from formats.inputs import open_input
from formats.png import png_writer

MAX_SIDE = 16384
EXIF_ORIENTATION = 0x0112
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


def read_image(path: Path | str, orientation: int = 1) -> np.ndarray:
    """(H, W, 4) uint8, straight alpha, 255 where the file has none.

    The pixels stand as stored: an EXIF rotation is not applied, as the tools that estimate poses ignore it
    too, unless `orientation` (as EXIF counts them) asks for one. Raises BadImage, LimitExceeded (before
    decoding), MissingFile.
    """
    with _opened(path) as image:
        return oriented(np.array(image.convert("RGBA")), orientation)


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


def check_film(path: Path | str) -> None:
    """Before any work: can a film of this name be written here? Raises BadImage or MissingExtra."""
    if Path(path).suffix.lower() not in (".gif", ".mp4"):
        raise BadImage(f"{path}: no film is written under this ending; name it .gif or .mp4")
    if Path(path).suffix.lower() == ".mp4":
        _ffmpeg(path)


def write_film(path: Path | str, frames: Iterable[np.ndarray], fps: float) -> None:
    """Frames (H, W, 3) uint8 of one size, taken one at a time, to a .gif (looping) or .mp4.

    GIF counts in hundredths of a second, so frames last as near to 1/fps as those allow. An odd side of an
    .mp4 gets its last row or column twice. Raises BadImage, MissingExtra, NoViews, ResourceError.
    """
    check_film(path)
    frames = iter(frames)
    first = next(frames, None)
    if first is None:
        raise NoViews(f"{path}: a film needs at least one frame")
    write = _write_gif if Path(path).suffix.lower() == ".gif" else _write_mp4
    with atomic_writer(path) as file:
        write(path, file, itertools.chain([first], frames), fps)


def _write_gif(path: Path | str, file, frames: Iterator[np.ndarray], fps: float) -> None:
    from PIL import Image

    pictures = (Image.fromarray(frame).quantize(256, dither=Image.Dither.FLOYDSTEINBERG) for frame in frames)
    duration = 10 * max(1, round(100 / fps))
    next(pictures).save(file, "GIF", save_all=True, append_images=pictures, duration=duration, loop=0)


def _write_mp4(path: Path | str, file, frames: Iterator[np.ndarray], fps: float) -> None:
    even = (np.pad(f, ((0, f.shape[0] % 2), (0, f.shape[1] % 2), (0, 0)), mode="edge") for f in frames)
    first = next(even)
    # ffmpeg opens the temporary by its name, which does not end in .mp4: it must seek in what it writes.
    size = first.shape[1::-1]
    writer = _ffmpeg(path).write_frames(
        file.name, size, fps=fps, macro_block_size=1, output_params=["-f", "mp4"]
    )
    writer.send(None)
    try:
        for frame in itertools.chain([first], even):
            writer.send(np.ascontiguousarray(frame))
    finally:
        writer.close()
    if os.path.getsize(file.name) == 0:
        raise BadImage(f"{path}: ffmpeg wrote nothing; try a .gif")


def _ffmpeg(path: Path | str):
    try:
        import imageio_ffmpeg
    except ImportError as error:
        raise MissingExtra(f'{path}: films as .mp4 need an extra: pip install "fusedrf[video]"') from error
    return imageio_ffmpeg
