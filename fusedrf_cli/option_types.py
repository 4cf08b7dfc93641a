"""The types of options' values; each checks what it converts.

Lengths are in world units, angles in degrees, times in seconds.
"""

import math
import os
import re
import sys

import click
from click.shell_completion import CompletionItem

from formats.errors import MissingFile
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.request_parts import STDIO

_SEPARATORS = re.compile(r"[\s,\[\]]+")
_BYTES = re.compile(r"(\d+(?:\.\d+)?)\s*([kmgt]?)(i?)b?", re.IGNORECASE)


class _Text(click.ParamType):
    """A type that reads text; `parse` raises ValueError with what was expected."""

    expected = ""

    def convert(self, value, param, ctx):
        if not isinstance(value, str):  # a default, converted already
            return value
        try:
            return self.parse(value)
        except (ValueError, OverflowError):
            self.fail(f"{value[:80]!r} is not {self.expected}", param, ctx)

    def parse(self, text: str):
        raise NotImplementedError


def _numbers(text: str, counts: tuple[int, ...]) -> tuple[float, ...]:
    """Finite numbers between commas, blanks or brackets; ValueError if not as many as one of `counts`."""
    numbers = tuple(float(word) for word in _SEPARATORS.split(text) if word)
    if len(numbers) not in counts or not all(map(math.isfinite, numbers)):
        raise ValueError(text)
    return numbers


class PositiveType(_Text):
    """A finite number above 0."""

    name, expected = "NUMBER", "a finite number above 0"

    def parse(self, text):
        (number,) = _numbers(text, (1,))
        if number <= 0:
            raise ValueError(text)
        return number


class SizeType(_Text):
    """'WxH' -> (width, height) in pixels."""

    most = 32768
    name, expected = "WxH", f"a size such as 800x600, of 1 to {most} pixels a side"

    def parse(self, text):
        match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.lower())
        width, height = map(int, match.groups()) if match else (0, 0)
        if not (1 <= width <= self.most and 1 <= height <= self.most):
            raise ValueError(text)
        return width, height


class BytesType(_Text):
    """'25MB' -> 25,000,000; kB, MB, GB and TB are powers of 1000, KiB, MiB, GiB and TiB of 1024."""

    name, expected = "BYTES", "a number of bytes above 0, such as 25MB, 500kB or 1GiB"

    def parse(self, text):
        match = _BYTES.fullmatch(text.strip())
        if not match or (match[3] and not match[2]):
            raise ValueError(text)
        count = int(float(match[1]) * (1024 if match[3] else 1000) ** " kmgt".index(match[2].lower() or " "))
        if count < 1:
            raise ValueError(text)
        return count


class VectorType(_Text):
    """'x,y,z' -> three floats."""

    name, expected = "x,y,z", "three finite numbers, x,y,z"

    def parse(self, text):
        return _numbers(text, (3,))


class UpType(_Text):
    """'auto' -> None, or 'x,y,z' -> three floats, not all of them 0."""

    name, expected = "auto|x,y,z", "auto or a direction x,y,z, not 0,0,0"

    def parse(self, text):
        if text == "auto":
            return None
        direction = _numbers(text, (3,))
        if not any(direction):
            raise ValueError(text)
        return direction


class DirectionType(_Text):
    """'azimuth,elevation' -> two floats, degrees; the elevation is from straight below to straight above."""

    name, expected = "AZIMUTH,ELEVATION", "two angles in degrees, the elevation from -90 to 90"

    def parse(self, text):
        azimuth, elevation = _numbers(text, (2,))
        if abs(elevation) > 90:
            raise ValueError(text)
        return azimuth, elevation


class ScaleType(_Text):
    """'k' or 'x,y,z' -> three floats, none of them 0; a negative one mirrors."""

    name, expected = "k|x,y,z", "one number or three, x,y,z, none of them 0"

    def parse(self, text):
        factors = _numbers(text, (1, 3))
        if 0 in factors:
            raise ValueError(text)
        return factors * 3 if len(factors) == 1 else factors


class BoxType(_Text):
    """Six numbers -> (xmin, ymin, zmin, xmax, ymax, zmax)."""

    name, expected = "AABB", "a box xmin,ymin,zmin,xmax,ymax,zmax with each minimum below its maximum"

    def parse(self, text):
        box = _numbers(text, (6,))
        if any(low >= high for low, high in zip(box[:3], box[3:], strict=True)):
            raise ValueError(text)
        return box


class CropType(_Text):
    """Six numbers, a box as BoxType's, or four, a sphere as SphereType's."""

    name, expected = "BOX|SPHERE", "a box xmin,ymin,zmin,xmax,ymax,zmax or a sphere x,y,z,r"

    def parse(self, text):
        return (BoxType() if len(_numbers(text, (4, 6))) == 6 else SphereType()).parse(text)


class ShareType(_Text):
    """A number above 0 and at most 1."""

    name, expected = "SHARE", "a number above 0 and at most 1"

    def parse(self, text):
        (number,) = _numbers(text, (1,))
        if not 0 < number <= 1:
            raise ValueError(text)
        return number


class TintType(_Text):
    """'r,g,b' -> three floats from 0 to 1."""

    name, expected = "r,g,b", "red, green and blue from 0 to 1, r,g,b"

    def parse(self, text):
        tint = _numbers(text, (3,))
        if not all(0 <= share <= 1 for share in tint):
            raise ValueError(text)
        return tint


class SphereType(_Text):
    """'x,y,z,radius' -> four floats, the last above 0."""

    name, expected = "x,y,z,r", "a centre and a radius above 0, x,y,z,r"

    def parse(self, text):
        sphere = _numbers(text, (4,))
        if sphere[3] <= 0:
            raise ValueError(text)
        return sphere


class PointType(_Text):
    """'VIEW:x,y' or 'VIEW:x,y,out' -> name of the view, column and row, and whether it shows the object."""

    name, expected = "VIEW:x,y[,out]", "a view's name and a pixel, VIEW:x,y, or VIEW:x,y,out"

    def parse(self, text):
        view, _, pixel = text.rpartition(":")
        shows = not pixel.endswith(",out")
        column, row = _numbers(pixel.removesuffix(",out"), (2,))
        if not view or min(column, row) < 0:
            raise ValueError(text)
        return view, column, row, shows


class ColourType(_Text):
    """A name or #rrggbb -> (r, g, b) in [0, 1]; transparent -> None."""

    name, expected = "COLOUR", "white, black, transparent or #rrggbb"
    named = {"white": (1.0, 1.0, 1.0), "black": (0.0, 0.0, 0.0), "transparent": None}

    def parse(self, text):
        if text.lower() in self.named:
            return self.named[text.lower()]
        if not re.fullmatch("#[0-9a-fA-F]{6}", text):
            raise ValueError(text)
        return tuple(byte / 255 for byte in bytes.fromhex(text[1:]))


class AffineType(_Text):
    """16 numbers, a file that holds them, or '-' for stdin -> four rows of four; the last row is 0 0 0 1."""

    name, expected = "MATRIX", "an affine: 16 numbers by rows, the last row 0,0,0,1, or a file of them, or -"

    def parse(self, text):
        entries = _numbers(self._read(text), (16,))
        if entries[12:] != (0, 0, 0, 1):
            raise ValueError(text)
        return tuple(entries[row : row + 4] for row in range(0, 16, 4))

    @staticmethod
    def _read(text: str) -> str:
        most = 1 << 16
        if text == STDIO:
            return sys.stdin.read(most)
        if os.path.exists(text):
            with open(text, encoding="utf-8") as file:
                return file.read(most)
        return text


class InputType(click.Path):
    """A path that must be there, checked before any slow import; '-' passes where a command takes it."""

    name = "path"

    def __init__(self, *, stdin: bool = False):
        super().__init__(allow_dash=stdin)

    def convert(self, value, param, ctx):
        if not value:
            raise MissingFile(f"{param.get_error_hint(ctx)} is an empty path; give that of a file")
        if not (value == STDIO and self.allow_dash) and not os.path.exists(value):
            raise MissingFile(f"{value}: no such file; check the spelling and the folder it is relative to")
        return value


class FolderType(InputType):
    """A folder that must be there."""

    name = "DIR"

    def convert(self, value, param, ctx):
        if not os.path.isdir(super().convert(value, param, ctx)):
            raise UsageProblem(f"{value}: no folder; {param.opts[0]} takes one")
        return value


class RanksType(_Text):
    """'D,C' -> components per mode of density and of colour."""

    name, expected = "D,C", "two multiples of 8, of density and colour components, such as 8,16"

    def parse(self, text):
        ranks = tuple(int(word) for word in text.split(","))
        if len(ranks) != 2 or any(rank < 8 or rank % 8 or rank > 1024 for rank in ranks):
            raise ValueError(text)
        return ranks


class DownscaleType(_Text):
    """'auto' -> None, or a whole number."""

    name, expected = "auto|N", "auto or a whole number from 1 to 64"

    def parse(self, text):
        if text == "auto":
            return None
        factor = int(text)
        if not 1 <= factor <= 64:
            raise ValueError(text)
        return factor


class KindType(click.ParamType):
    """The name of a kind of field, or another word that is allowed. Names are looked up when they are needed,
    and no kind is imported for it."""

    name = "KIND"

    def __init__(self, *others: str):
        self.others = others

    def names(self) -> list[str]:
        """All that may be given."""
        from fusedrf_cli.engine.kinds import registry

        return [*self.others, *(name for name in registry.names() if name not in registry.IMPORTED)]

    def get_metavar(self, param, ctx=None):
        return f"[{'|'.join(self.names())}]"

    def shell_complete(self, ctx, param, incomplete):
        return [CompletionItem(name) for name in self.names() if name.startswith(incomplete)]

    def convert(self, value, param, ctx):
        if value not in self.names():
            self.fail(f"{value[:80]!r} is not one of {', '.join(self.names())}", param, ctx)
        return value


class FieldKindType(KindType):
    """The name of a kind that fields are of."""

    def names(self) -> list[str]:
        from fusedrf_cli.engine.kinds import registry

        left_out = {*registry.WAYS, *registry.IMPORTED}
        return [name for name in registry.names() if name not in left_out]


class KindsType(KindType):
    """'a,b' -> those kinds, in the order of their names."""

    name = "KINDS"

    def get_metavar(self, param, ctx=None):
        return self.name

    def convert(self, value, param, ctx):
        if not isinstance(value, str):  # the default
            return value
        kinds = [super(KindsType, self).convert(name, param, ctx) for name in value.split(",")]
        return tuple(name for name in self.names() if name in kinds)
