"""Textures of meshes: pictures decoded from bytes, in named formats and within limits."""

import io
import math
import warnings
from collections.abc import Callable, Hashable

import numpy as np

from formats.errors import BadImage, FormatError, LimitExceeded, MissingExtra, printable
from formats.images import DECODING_ERRORS, eight_bits
from formats.surfaces.surface import Notes

FORMATS = ("PNG", "JPEG", "WEBP", "AVIF", "BMP", "GIF", "TIFF", "DDS", "TGA")
"""What is decoded, in this order of asking; TGA, which has no signature, by its ending alone."""
MAX_TEXELS = 2**25
"""Of all pictures of a mesh together; one is made smaller where its share is less."""
LEAST_SHARE = 2**16
MAX_PICTURES = 1024
FREE_BYTES = 300 << 20
BYTES_PER_BYTE = 16
MAX_DECODED = 4 << 30
"""What decoding may take: FREE_BYTES, or so many bytes for each of a file's, but never more than this."""
KTX2 = b"\xabKTX 20\xbb\r\n\x1a\n"
STRIP = 1 << 22
"""Pixels converted at once."""


def read_picture(data: bytes, name: str, share: int, notes: Notes) -> np.ndarray:
    """(H, W, 4) uint8 sRGB, straight alpha, of at most about `share` texels.

    Raises BadImage for what is no picture in a known format, LimitExceeded (before decoding) for what would
    take too much memory, and MissingExtra for KTX2 without its library.
    """
    from PIL import Image

    if data.startswith(KTX2):
        return _pixels(Image.fromarray(_ktx2(data, name)), len(data), name, share, notes)

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            image = _identified(data, name)
            return _pixels(image, len(data), name, share, notes)
    except (*DECODING_ERRORS, RuntimeError, Image.DecompressionBombError) as error:
        raise BadImage(f"{name}: the picture cannot be decoded ({error}); save it again") from error


class Pictures:
    """The pictures of a mesh, each read once, within what all of them may take together."""

    def __init__(self, count: int, notes: Notes):
        """Raises LimitExceeded for more than MAX_PICTURES."""
        if count > MAX_PICTURES:
            raise LimitExceeded(
                f"{notes.path}: {count:,} pictures, at most {MAX_PICTURES:,} are read; join them"
            )
        self.notes, self.share = notes, max(MAX_TEXELS // max(count, 1), LEAST_SHARE)
        self.pixels: dict[Hashable, np.ndarray | None] = {}

    def get(
        self, key: Hashable, content: Callable[[], tuple[bytes, str]], subject: str | None = None
    ) -> np.ndarray | None:
        """The picture in the bytes that `content` gives with their name, as `read_picture` reads it; None and
        a note where it cannot be read."""
        if key not in self.pixels:
            try:
                self.pixels[key] = read_picture(*content(), self.share, self.notes)
            except FormatError as error:
                self.pixels[key] = None
                self.notes.add(f"has a texture that is not shown: {error}", subject)
        return self.pixels[key]


def _identified(data: bytes, name: str):
    """Pillow's picture of the first of FORMATS that knows the bytes. Its own `open` is not used: that would
    ask every format there is, some of which start programs, and refuse large pictures whatever they take."""
    from PIL import Image

    Image.init()
    for kind in FORMATS:
        if kind not in Image.OPEN:
            continue
        factory, accept = Image.OPEN[kind]
        known = name.lower().endswith(".tga") if kind == "TGA" else accept and accept(data[:16])
        if known and not isinstance(known, str):  # a text is Pillow's reason against
            return factory(io.BytesIO(data), name)
    beginning = printable(data[:12].decode("latin-1"))
    raise BadImage(
        f"{name}: no picture in a format that is read ({', '.join(FORMATS)}); it begins with {beginning!r}"
    )


def _pixels(image, n_bytes: int, name: str, share: int, notes: Notes) -> np.ndarray:
    stored, factor = image.size, _factor(image.size, share)
    if image.format in ("JPEG", "MPO") and factor > 1:
        image.draft(None, (stored[0] // factor, stored[1] // factor))
    width, height = image.size
    needed = width * height * (1 if image.mode in ("1", "L", "P") else 4)
    if needed > min(MAX_DECODED, max(FREE_BYTES, BYTES_PER_BYTE * n_bytes)):
        raise LimitExceeded(
            f"{name}: the picture of {stored[0]}x{stored[1]} pixels is too large, decoding it would take "
            f"{needed >> 20:,} MiB; make it smaller"
        )
    if min(stored) < 1:
        raise BadImage(f"{name}: the picture has no pixels")
    image.load()
    if factor > 1:
        notes.add(
            f"the picture {name} of {stored[0]}x{stored[1]} pixels is made {factor} times smaller on reading"
        )
    return _reduced(image, _factor(image.size, share))


def _factor(size: tuple[int, int], share: int) -> int:
    return max(1, math.ceil(math.sqrt(size[0] * size[1] / share) - 1e-9))


def _reduced(image, factor: int) -> np.ndarray:
    """A loaded picture as RGBA, each pixel the mean of `factor` x `factor`, converted in strips."""
    width, height = image.size
    out = np.empty((-(-height // factor), -(-width // factor), 4), np.uint8)
    rows = max(1, STRIP // max(width, 1) // factor) * factor
    for top in range(0, height, rows):
        strip = image.crop((0, top, width, min(top + rows, height)))
        strip = eight_bits(strip).convert("RGBA")
        done = np.asarray(strip.reduce(factor) if factor > 1 else strip)
        out[top // factor : top // factor + len(done)] = done
    return out


def _ktx2(data: bytes, name: str) -> np.ndarray:
    """(H, W, 4) of a KTX2 picture in Basis Universal."""
    try:
        import opengl_basisu
    except ImportError as error:
        raise MissingExtra(
            f"{name}: a KTX2 picture (KHR_texture_basisu), which needs the library of fusedrf[ktx2]; install "
            "that, or save the picture as PNG"
        ) from error
    width, height = (int.from_bytes(data[at : at + 4], "little") for at in (20, 24))
    if width * height * 4 > max(FREE_BYTES, BYTES_PER_BYTE * len(data)):
        raise LimitExceeded(f"{name}: the KTX2 picture of {width}x{height} pixels is too large; reduce it")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return np.ascontiguousarray(opengl_basisu.open(data).transcode("rgba8").data)
    except Exception as error:  # the library's own classes, and what numpy raises on what it gives
        raise BadImage(f"{name}: the KTX2 picture cannot be decoded ({error}); save it as PNG") from error
