"""Options that several commands share, and the types of their values; each type checks what it converts.

Lengths are in world units, angles in degrees, times in seconds.
"""

import contextlib
import functools
import math
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator

import click
from click.shell_completion import CompletionItem

from formats.errors import FormatWarning, MissingFile
from fusedrf_cli.errors import FusedRFError, UsageProblem
from fusedrf_cli.progress import Progress
from fusedrf_cli.report import emit
from fusedrf_cli.requests import STDIO

DEBUG = "fusedrf.debug"  # key in click's context.meta
MAX_PIXELS_PER_SIDE = 32768
MAX_AFFINE_TEXT = 65536

_SEPARATORS = re.compile(r"[\s,\[\]]+")
_BYTES = re.compile(r"(\d+(?:\.\d+)?)\s*([kmgt]?)(i?)b?", re.IGNORECASE)


# --- types --------------------------------------------------------------------------------------------------


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
    found = tuple(float(word) for word in _SEPARATORS.split(text) if word)
    if len(found) not in counts or not all(map(math.isfinite, found)):
        raise ValueError(text)
    return found


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

    name, expected = "WxH", f"a size such as 800x600, of 1 to {MAX_PIXELS_PER_SIDE} pixels a side"

    def parse(self, text):
        match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.lower())
        width, height = map(int, match.groups()) if match else (0, 0)
        if not (1 <= width <= MAX_PIXELS_PER_SIDE and 1 <= height <= MAX_PIXELS_PER_SIDE):
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
        if text == STDIO:
            return sys.stdin.read(MAX_AFFINE_TEXT)
        if os.path.exists(text):
            with open(text, encoding="utf-8") as file:
                return file.read(MAX_AFFINE_TEXT)
        return text


class InputType(click.Path):
    """A path that must be there, checked before any slow import; '-' passes where a command takes it."""

    name = "path"

    def __init__(self, *, stdin: bool = False):
        super().__init__(allow_dash=stdin)

    def convert(self, value, param, ctx):
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

        return [*self.others, *registry.names()]

    def get_metavar(self, param, ctx=None):
        return f"[{'|'.join(self.names())}]"

    def shell_complete(self, ctx, param, incomplete):
        return [CompletionItem(name) for name in self.names() if name.startswith(incomplete)]

    def convert(self, value, param, ctx):
        if value not in self.names():
            self.fail(f"{value[:80]!r} is not one of {', '.join(self.names())}", param, ctx)
        return value


class KindsType(KindType):
    """'a,b' -> those kinds, in the order of their names."""

    name = "KINDS"

    def get_metavar(self, param, ctx=None):
        return self.name

    def convert(self, value, param, ctx):
        if not isinstance(value, str):  # the default
            return value
        asked = [super(KindsType, self).convert(name, param, ctx) for name in value.split(",")]
        return tuple(name for name in self.names() if name in asked)


RANKS, DIRECTION, UP = RanksType(), DirectionType(), UpType()
POSITIVE, SIZE, BYTES, VECTOR, SCALE = PositiveType(), SizeType(), BytesType(), VectorType(), ScaleType()
AABB, COLOUR, AFFINE = BoxType(), ColourType(), AffineType()
SPHERE, POINT, CROP, SHARE, TINT = SphereType(), PointType(), CropType(), ShareType(), TintType()
INPUT, SCENE, FOLDER, DOWNSCALE = InputType(), InputType(stdin=True), FolderType(), DownscaleType()


# --- options ------------------------------------------------------------------------------------------------


def _remember_debug(ctx: click.Context, param: click.Parameter, value: bool) -> None:
    if value:
        ctx.meta[DEBUG] = True


debug = click.option(
    "--debug",
    is_flag=True,
    expose_value=False,
    callback=_remember_debug,
    help="Show the traceback of an error.",
)
overwrite = click.option("-w", "--overwrite", is_flag=True, help="Replace the output if it exists.")
PRECISION = click.Choice(["float16", "float32", "int8", "int4"])
precision = click.option(
    "--precision",
    type=PRECISION,
    help="How numbers are stored; default: int8 of a place that fills all of space, else float16.",
)
added_precision = click.option(
    "--precision", type=PRECISION, help="How the numbers that come are stored; default: as they are."
)
fused_precision = click.option(
    "--precision",
    type=PRECISION,
    help="How numbers are stored; default: float16, for the kinds vm and sparse int8, or what the size "
    "asks for.",
)
ranks = click.option(
    "--ranks", type=RANKS, help="Keep at most so many density and colour components per mode, such as 8,16."
)
sh_degree = click.option(
    "--sh-degree", type=click.IntRange(0, 3), help="Keep colour's dependence on the view up to this SH band."
)
time_budget = click.option(
    "--time-budget", type=POSITIVE, metavar="S", help="Stop learning after S seconds, all tries together."
)
max_size = click.option("--max-size", type=BYTES, help="Largest output file, such as 25MB.")
fused_max_size = click.option(
    "--max-size", type=BYTES, help="Largest output file; default: 25MB, and what places of the scene take."
)
extracted_max_size = click.option(
    "--max-size", type=BYTES, help="Largest output file; numbers are left out and learnt again where needed."
)
memory = click.option(
    "--memory", type=BYTES, help="Most memory to take, such as 8GiB; default: 80 % of what is free."
)
target_psnr = click.option(
    "--target-psnr",
    type=POSITIVE,
    metavar="DB",
    help="Quality to reach, else exit code 7.",
)
smallest = click.option(
    "--target-psnr",
    type=POSITIVE,
    metavar="DB",
    help="Take the fewest bytes that reach this quality; exit code 7 where none do.",
)
resume = click.option(
    "--resume", is_flag=True, help="Go on from the checkpoint that an interrupted or killed run left."
)
rgb = click.option("--rgb/--no-rgb", default=True, show_default=True, help="Finish on rendered views.")
size = click.option("--size", type=SIZE, help="Picture size in pixels; default: the cameras' own.")
allow_outside = click.option(
    "--allow-outside", is_flag=True, help="Let a scene name sources outside its own folder."
)
extracted_precision = click.option(
    "--precision",
    type=PRECISION,
    help="How numbers are stored; default: as those of FIELD are, where they stay the same, else float16.",
)
PLACEMENT = {  # flags -> what click.option takes; `compose` has them once per input
    ("-t", "--translate"): {"type": VECTOR, "help": "Move by x,y,z."},
    ("-r", "--rotate"): {"type": VECTOR, "help": "Turn by degrees about the world's x, then y, then z axis."},
    ("-s", "--scale"): {"type": SCALE, "help": "Scale by k, or by x,y,z; applied before turn and move."},
    ("--matrix",): {"type": AFFINE, "help": "Any affine instead: 16 numbers by rows, a file of them, or -."},
}
threads = click.option("--threads", type=click.IntRange(1, 4096), help="CPU threads; default: all.")
_RUNNING = (
    click.option(
        "--device",
        type=click.Choice(["auto", "cpu", "cuda"]),
        default="auto",
        show_default=True,
        help="Where to compute.",
    ),
    threads,
)
_seed = click.option(
    "--seed",
    type=click.IntRange(0, 2**63 - 1),
    default=0,
    show_default=True,
    help="On the CPU, as many steps by as many threads: same seed, same bytes. A GPU adds in no fixed order.",
)
_REPORTING = (
    click.option("--json", "as_json", is_flag=True, help="Print one JSON object on stdout."),
    click.option("-q", "--quiet", is_flag=True, help="No progress and no summary; warnings and errors only."),
    click.option("-v", "--verbose", is_flag=True, help="Say more on stderr."),
    debug,
)


def _stack(options: tuple[Callable, ...]) -> Callable:
    """One decorator that adds `options` in this order."""
    return lambda command: functools.reduce(lambda inner, option: option(inner), reversed(options), command)


mending = _stack(
    (
        click.option(
            "--refit", type=INPUT, metavar="PHOTOS", help="Learn what was behind from photos of the place."
        ),
        click.option("--fill", is_flag=True, help="Fill the hole smoothly where nobody saw what was behind."),
    )
)
placement = _stack(tuple(click.option(*flags, **words) for flags, words in PLACEMENT.items()))
keep_history = click.option(
    "--keep-history", is_flag=True, help="Keep FUSED as it was in OUT.history, for `fusedrf undo`."
)
running = _stack(_RUNNING)
seeded = _stack((*_RUNNING, _seed))


def writing(what: str) -> Callable:
    """-o/--output (`what` it is) and -w."""
    return _stack((click.option("-o", "--output", required=True, type=click.Path(), help=what), overwrite))


def reporting(
    command: Callable[..., dict] | None = None, *, brief: Callable[[dict], dict] = dict
) -> Callable:
    """--json -q -v --debug; gives `command` a `progress` and prints the dict that it returns, if any.

    `brief` makes of the dict what people see. The report of an error (FusedRFError.report) is printed
    before the error goes on its way.
    """
    if command is None:
        return functools.partial(reporting, brief=brief)

    @functools.wraps(command)
    def run(*, as_json: bool, quiet: bool, verbose: bool, **words) -> None:
        def tell(report: dict | None) -> None:
            if report:
                full = {**report, "warnings": report.get("warnings", progress.warnings)}
                emit(full if as_json else brief(full), as_json=as_json, quiet=quiet)

        progress = Progress(quiet=quiet, verbose=verbose)
        try:
            with progress, _warnings_to(progress):
                report = command(progress=progress, **words)
        except FusedRFError as error:
            tell(error.report)
            raise
        tell(report)

    return _stack(_REPORTING)(run)


@contextlib.contextmanager
def _warnings_to(progress: Progress) -> Iterator[None]:
    """Python's warnings as lines of progress: those of `formats` always, other libraries' with -v."""

    def show(message, category, *where) -> None:
        tell = progress.warn if issubclass(category, FormatWarning) else progress.note
        tell(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always", FormatWarning)
        warnings.showwarning = show
        yield
