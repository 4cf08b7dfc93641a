"""SOG: splats as pictures, with a meta.json that says what their bytes stand for; versions 1 and 2.

https://developer.playcanvas.com/user-manual/gaussian-splatting/formats/sog/;
https://github.com/playcanvas/splat-transform (read-sog.ts, read-sog-v1.ts). A .sog is a zip of these files;
they may also lie in a folder.
"""

import io
import lzma
import warnings
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, BinaryIO

import msgspec
import numpy as np

from formats.errors import BadSplats, LimitExceeded, NewerVersion, listed
from formats.images import DECODING_ERRORS
from formats.safe_input import open_input, parse_json
from formats.splats.splats import ANTIALIASED, DISCS, Splats, check_count, gathered, sigmoid
from formats.surfaces.named_files import Beside

META = "meta.json"
MODELS = {"antialiased": ANTIALIASED, "2dgs": DISCS}
MAX_META = 4 << 20
MAX_PICTURE = 1 << 29
"""Bytes of a picture as it is packed."""
FREE_BYTES, UNPACKED = 4 << 20, 4
"""Files of a zip may unpack to FREE_BYTES, or to so many times their own; pictures are packed already."""
MAX_DIRECTORY = 1 << 20
"""Bytes of a zip's directory: a SOG has eight files."""
FREE_PIXELS, PIXELS_PER_SPLAT = 1 << 22, 4
"""Of each picture; there is a pixel for each splat, and a few to fill its last rows."""
PALETTE = 64
"""Coefficients of so many entries of the palette lie in a row of its picture."""
COEFFICIENTS = (3, 8, 15)
"""Of an entry, by degree."""
UNPACKING_ERRORS = (
    *(zipfile.BadZipFile, zlib.error, lzma.LZMAError),
    *(NotImplementedError, RuntimeError, EOFError, OSError, ValueError, OverflowError),
)

Numbers3 = Annotated[list[float], msgspec.Meta(min_length=3, max_length=3)]
Name = Annotated[list[str], msgspec.Meta(min_length=1)]
Names2 = Annotated[list[str], msgspec.Meta(min_length=2)]
BOOK = 256
Codebook = Annotated[list[float | None], msgspec.Meta(min_length=1, max_length=BOOK)]


class Means(msgspec.Struct):
    """Positions: 16 bits in two pictures."""

    mins: Numbers3
    maxs: Numbers3
    files: Names2
    shape: list[int] = []


class Values(msgspec.Struct):
    """What bytes of a picture stand for: entries of a codebook (version 2), or a range (version 1)."""

    files: Name
    codebook: Codebook | None = None
    mins: list[float] = []
    maxs: list[float] = []


class Rest(msgspec.Struct):
    """Harmonics beyond degree 0: a palette, and which entry each splat has."""

    files: Names2
    codebook: Codebook | None = None
    mins: float = 0.0
    maxs: float = 0.0


class Quaternions(msgspec.Struct):
    """Rotations."""

    files: Name


class Meta(msgspec.Struct, rename={"rest": "shN"}):
    """meta.json."""

    means: Means
    scales: Values
    quats: Quaternions
    sh0: Values
    rest: Rest | None = None
    version: int = 1
    count: int = 0
    format: str = "sog"
    model: str = ""
    """Brush's and SplatTransform's: "antialiased", "2dgs" or nothing."""
    antialias: bool | None = None
    """PlayCanvas's."""


# --- files --------------------------------------------------------------------------------------------------


def is_meta(head: bytes) -> bool:
    """Whether a file that begins so is a meta.json."""
    return head.lstrip()[:1] == b"{" and b'"means"' in head and b'"quats"' in head and b'"sh0"' in head


def is_sog(path: Path | str) -> bool:
    """Whether a zip holds a meta.json and pictures."""
    try:
        with open_input(path) as file, _opened(path, file) as pack:
            names = pack.namelist()
    except BadSplats:
        return False
    return any(name.rpartition("/")[2] == META for name in names) and any(n.endswith(".webp") for n in names)


def read_sog(path: Path | str, data: bytes) -> Splats:
    """Of a zip, or of a meta.json beside its pictures. Raises BadJson, BadSplats, LimitExceeded, MissingFile,
    NewerVersion, OutsideFolder."""
    if not data.startswith(b"PK"):
        beside = Beside(path)
        return _read(path, data, lambda name: beside.read(name)[0])
    with _opened(path, io.BytesIO(data)) as pack:
        metas = [name for name in pack.namelist() if name.rpartition("/")[2] == META]
        if len(metas) > 1 and META not in metas:
            raise BadSplats(
                f"{path}: holds {len(metas)} SOGs, as a streamed one does ({listed(metas)}); unpack it, and "
                "give its lod-meta.json, or the meta.json of one"
            )
        found = META if META in metas or not metas else metas[0]
        folder = found.removesuffix(META)
        meta = _member(path, pack, found, MAX_META)
        return _read(path, meta, lambda name: _member(path, pack, folder + name, MAX_PICTURE))


def _opened(path: Path | str, file: BinaryIO) -> zipfile.ZipFile:
    """Raises BadSplats. The library reads the directory at once, so that its size is looked at first."""
    file.seek(max(0, file.seek(0, io.SEEK_END) - (1 << 16)))
    end = file.read().rpartition(b"PK\5\6")[2]
    if len(end) < 18 or int.from_bytes(end[8:12], "little") > MAX_DIRECTORY:
        raise BadSplats(f"{path}: is no whole zip of a few files; copy or export it again")
    try:
        return zipfile.ZipFile(file)
    except UNPACKING_ERRORS as error:
        raise BadSplats(f"{path}: is no whole zip ({error}); copy or export it again") from error


def _member(path: Path | str, pack: zipfile.ZipFile, name: str, most: int) -> bytes:
    """A file of the zip, its checksum found right."""
    try:
        info = pack.getinfo(name)
    except KeyError as error:
        raise BadSplats(f"{path}: lacks the file {name[:80]!r}; copy or export it again") from error
    most = min(most, max(FREE_BYTES, UNPACKED * info.compress_size))
    if info.file_size > most:
        raise LimitExceeded(
            f"{path}: {name[:80]} has {info.file_size:,} bytes, at most {most:,} are read of it"
        )
    try:
        with pack.open(info) as file:
            content = file.read(info.file_size)
            if len(content) == info.file_size and not file.read(1):
                return content
    except UNPACKING_ERRORS as error:
        raise BadSplats(f"{path}: {name[:80]} cannot be unpacked ({error}); copy it again") from error
    raise BadSplats(f"{path}: {name[:80]} has not the size that is stated; copy it again")


# --- splats -------------------------------------------------------------------------------------------------


def _read(path: Path | str, meta: bytes, read: Callable[[str], bytes]) -> Splats:
    try:
        content = msgspec.convert(parse_json(meta, f"{path}: {META}"), Meta)
    except msgspec.ValidationError as error:
        raise BadSplats(f"{path}: its {META} is not that of a SOG: {error}; export it again") from error
    if content.format != "sog":
        raise BadSplats(
            f"{path}: is of the format {content.format[:40]!r}, and only SOGs that stand still are read; "
            "save one moment of it as a .ply"
        )
    if content.version not in (1, 2):
        raise NewerVersion(
            f"{path}: is a SOG of version {content.version}, and 1 and 2 are read; update fusedrf, or "
            "save it as a .ply"
        )
    return _Reader(path, content, read).splats()


class _Reader:
    """The splats of one meta.json."""

    def __init__(self, path: Path | str, meta: Meta, read: Callable[[str], bytes]):
        self.path, self.meta, self.old = path, meta, meta.version == 1
        self.count = (meta.means.shape or [0])[0] if self.old else meta.count
        parts = [meta.means, meta.scales, meta.quats, meta.sh0, *([meta.rest] if meta.rest else [])]
        self.files = {name: read(name) for part in parts for name in part.files[:2]}
        check_count(path, max(self.count, 0), sum(map(len, self.files.values())))

    def splats(self) -> Splats:
        model = self.meta.model or ("antialiased" if self.meta.antialias else "")
        notes = [MODELS[model]] if model in MODELS else []
        colours = self._rows(self.meta.sh0.files[0])
        values = self._values(self.meta.sh0, colours[:, :3])
        opacities = sigmoid(self._range(self.meta.sh0, colours, 3)) if self.old else colours[:, 3] / 255
        scales = self._values(self.meta.scales, self._rows(self.meta.scales.files[0])[:, :3])
        scales = np.exp(scales)
        harmonics = values.astype(np.float32)[:, None]
        if self.meta.rest is not None:
            harmonics = np.concatenate([harmonics, self._rest(self.meta.rest, notes)], 1)
        return gathered(
            self.path,
            f"a SOG of version {self.meta.version}",
            centres=self._centres(),
            scales=scales,
            rotations=_rotations(self._rows(self.meta.quats.files[0])),
            opacities=opacities,
            harmonics=harmonics,
            notes=notes,
        )

    def _rows(self, name: str) -> np.ndarray:
        """(N, 4) uint8, a pixel for each splat."""
        picture = self._picture(name, max(FREE_PIXELS, PIXELS_PER_SPLAT * self.count)).reshape(-1, 4)
        if len(picture) < self.count:
            raise BadSplats(
                f"{self.path}: {name[:80]} has fewer pixels than there are splats; export them again"
            )
        return picture[: self.count]

    def _picture(self, name: str, most: int) -> np.ndarray:
        """(H, W, 4) uint8."""
        from PIL import Image, WebPImagePlugin

        data, where = self.files[name], f"{self.path}: {name[:80]}"
        if data[:4] != b"RIFF" or data[8:12] != b"WEBP":
            raise BadSplats(f"{where} is no WebP picture; export the splats again")
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                image = WebPImagePlugin.WebPImageFile(io.BytesIO(data))
                if image.width * image.height > most:
                    size = f"{image.width}x{image.height}"
                    raise LimitExceeded(f"{where} has {size} pixels, at most {most:,} are read")
                return np.asarray(image.convert("RGBA"))
        except (*DECODING_ERRORS, RuntimeError, Image.DecompressionBombError) as error:
            raise BadSplats(f"{where} cannot be decoded ({error}); export the splats again") from error

    def _values(self, values: Values, picture: np.ndarray) -> np.ndarray:
        """(N, 3) float64 that bytes stand for."""
        if not self.old:
            return self._book(values.codebook)[picture]
        return np.stack([self._range(values, picture, i) for i in range(3)], 1)

    def _range(self, values: Values, picture: np.ndarray, i: int) -> np.ndarray:
        if len(values.mins) <= i or len(values.maxs) <= i:
            raise BadSplats(f"{self.path}: its {META} lacks a range of values; export it again")
        return values.mins[i] + (values.maxs[i] - values.mins[i]) * (picture[:, i] / 255)

    def _book(self, codebook: list[float | None] | None) -> np.ndarray:
        """(256,) float64. Early writers left the first entry out, which goes on evenly before the second; of
        few splats they wrote as many entries as there are numbers."""
        if codebook is None or None in codebook[1:]:
            raise BadSplats(f"{self.path}: its {META} lacks a codebook; export it again")
        if codebook[0] is None and len(codebook) == BOOK:
            codebook = [codebook[1] + (codebook[1] - codebook[-1]) / (BOOK - 1), *codebook[1:]]
        return np.array([*codebook, *[None] * (BOOK - len(codebook))], np.float64)

    def _centres(self) -> np.ndarray:
        """(N, 3) float64: 16 bits between bounds, of sign(x) ln(1 + |x|)."""
        means = self.meta.means
        low, high = (self._rows(name)[:, :3].astype(np.float64) for name in means.files[:2])
        mins, maxs = np.array(means.mins), np.array(means.maxs)
        spans = np.where(maxs > mins, maxs - mins, 1)
        logs = mins + spans * ((low + 256 * high) / 65535)
        return np.sign(logs) * np.expm1(np.abs(logs))

    def _rest(self, rest: Rest, notes: list[str]) -> np.ndarray:
        """(N, 3, 8 or 15, 3) float32 coefficients of the entries of the palette that splats have."""
        files = rest.files[:2]
        if "label" in files[0] and "label" not in files[1]:  # the order of the format's text
            files = files[::-1]
        palette = self._picture(files[0], FREE_PIXELS)
        height, width = palette.shape[:2]
        if width % PALETTE or width // PALETTE not in COEFFICIENTS:
            raise BadSplats(
                f"{self.path}: the palette of harmonics is {width} pixels wide, expected 192, 512 or 960; "
                "export it again"
            )
        if self.old:
            book = rest.mins + (rest.maxs - rest.mins) * np.arange(256) / 255
        else:
            book = self._book(rest.codebook)
        entries = palette.reshape(height * PALETTE, width // PALETTE, 4)[..., :3]
        labels = self._rows(files[1]).astype(np.int64)
        labels = labels[:, 0] + 256 * labels[:, 1]
        outside = labels >= len(entries)
        if outside.any():
            notes.append(f"{int(outside.sum()):,} splats have no entry of its palette, and show one colour")
        coefficients = book.astype(np.float32)[entries][np.where(outside, 0, labels)]
        coefficients[outside] = 0
        return coefficients


def _rotations(picture: np.ndarray) -> np.ndarray:
    """(N, 4) w, x, y, z: alpha from 252 on says which is the largest; any other means no rotation."""
    others = (picture[:, :3] / 255 * 2 - 1) / np.sqrt(2)
    largest = np.sqrt(np.maximum(0, 1 - (others**2).sum(1)))
    quaternions = np.tile([1.0, 0, 0, 0], (len(picture), 1))
    for i in range(4):
        chosen = picture[:, 3] == 252 + i
        quaternions[chosen] = np.insert(others[chosen], i, largest[chosen], axis=1)
    return quaternions
