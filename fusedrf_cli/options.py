"""Options that several commands share."""

import contextlib
import functools
import re
import warnings
from collections.abc import Callable, Iterator
from typing import get_args

import click

from formats.errors import FormatWarning
from fusedrf_cli.errors import FusedRFError
from fusedrf_cli.option_types import (
    AffineType,
    BytesType,
    InputType,
    PositiveType,
    RanksType,
    ScaleType,
    SizeType,
    VectorType,
)
from fusedrf_cli.progress import Progress
from fusedrf_cli.report import emit
from fusedrf_cli.requests import Precision

DEBUG = "fusedrf.debug"  # key in click's context.meta


class RenamedOption(click.Option):
    """An option that is still taken by the names that it had in the version before, which no help shows."""

    def __init__(self, *flags: str, earlier: dict[str, str], **words):
        """earlier: the flag that each earlier one stands for."""
        super().__init__(*flags, **words)
        self.earlier = earlier

    def add_to_parser(self, parser, ctx: click.Context) -> None:
        super().add_to_parser(parser, ctx)
        for earlier, flag in self.earlier.items():
            parser._long_opt[earlier] = parser._long_opt[flag]


class NumbersCommand(click.Command):
    """A command of which a word that begins as a negative number does is an argument, and no option."""

    def make_parser(self, ctx: click.Context):
        parser = super().make_parser(ctx)
        process = parser._process_opts

        def process_word(word: str, state) -> None:
            if re.match(r"-[\d.]", word):
                state.largs.append(word)
            else:
                process(word, state)

        parser._process_opts = process_word
        return parser


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
precision = click.option(
    "--precision",
    type=click.Choice(get_args(Precision)),
    help="How numbers are stored; default: int8 of an unbounded scene, else float16.",
)
added_precision = click.option(
    "--precision",
    type=click.Choice(get_args(Precision)),
    help="How the numbers that come are stored; default: as they are.",
)
fused_precision = click.option(
    "--precision",
    type=click.Choice(get_args(Precision)),
    help="How numbers are stored; default: float16, for the kinds vm and sparse int8, or what the size "
    "asks for.",
)
imported_precision = click.option(
    "--precision",
    type=click.Choice(get_args(Precision)),
    default="float32",
    show_default=True,
    help="How numbers are stored; in int8 and int4 arrays of few numbers stay float16.",
)
ranks = click.option(
    "--ranks",
    type=RanksType(),
    help="Keep at most so many density and colour components per mode, such as 8,16.",
)
sh_degree = click.option(
    "--sh-degree", type=click.IntRange(0, 3), help="Keep colour's dependence on the view up to this SH band."
)
time_budget = click.option(
    "--time-budget",
    type=PositiveType(),
    metavar="S",
    help="Stop learning after S seconds, all tries together.",
)
fused_time_budget = click.option(
    "--time-budget",
    type=PositiveType(),
    metavar="S",
    help="Stop learning after S seconds, all tries together; what comes before, such as sampling the scene "
    "for dense and sparse, is not counted.",
)
max_size = click.option("--max-size", type=BytesType(), help="Largest output file, such as 25MB.")
fused_max_size = click.option(
    "--max-size",
    type=BytesType(),
    help="Largest output file; default: 25MB, and what unbounded sources take.",
)
converted_max_size = click.option(
    "--max-size",
    type=BytesType(),
    help="Largest output file; default: 25MB, of dense and dense-mlp 50MB, and what unbounded sources take.",
)
extracted_max_size = click.option(
    "--max-size",
    type=BytesType(),
    help="Largest output file; numbers are left out and learnt again where needed.",
)
memory = click.option(
    "--memory", type=BytesType(), help="Most memory to take, such as 8GiB; default: 80 % of what is free."
)
target_psnr = click.option(
    "--target-psnr",
    type=PositiveType(),
    metavar="DB",
    help="Quality to reach, else exit code 7.",
)
smallest = click.option(
    "--target-psnr",
    type=PositiveType(),
    metavar="DB",
    help="Take the fewest bytes that reach this quality; exit code 7 where none do.",
)
resume = click.option(
    "--resume", is_flag=True, help="Go on from the checkpoint that an interrupted or killed run left."
)
finetune = click.option(
    "--finetune/--no-finetune",
    cls=RenamedOption,
    earlier={"--rgb": "--finetune", "--no-rgb": "--no-finetune"},
    default=True,
    show_default=True,
    help="Finetune on rendered views.",
)
size = click.option("--size", type=SizeType(), help="Picture size in pixels; default: the cameras' own.")
allow_outside = click.option(
    "--allow-outside", is_flag=True, help="Let a scene name sources outside its own folder."
)
extracted_precision = click.option(
    "--precision",
    type=click.Choice(get_args(Precision)),
    help="How numbers are stored; default: as those of FIELD are, where they stay the same, else float16.",
)
PLACEMENT = {  # flags -> what click.option takes; `compose` has them once per input
    ("-t", "--translate"): {"type": VectorType(), "help": "Move by x,y,z."},
    ("-r", "--rotate"): {
        "type": VectorType(),
        "help": "Turn by degrees about the world's x, then y, then z axis.",
    },
    ("-s", "--scale"): {
        "type": ScaleType(),
        "help": "Scale by k, or by x,y,z; applied before turn and move.",
    },
    ("--matrix",): {
        "type": AffineType(),
        "help": "Any affine instead: 16 numbers by rows, a file of them, or -.",
    },
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
            "--refit",
            type=InputType(),
            metavar="PHOTOS",
            help="Learn what was behind from photos without the object.",
        ),
        click.option("--fill", is_flag=True, help="Fill the hole smoothly where nobody saw what was behind."),
    )
)
placement = _stack(tuple(click.option(*flags, **words) for flags, words in PLACEMENT.items()))
undoable = click.option(
    "--undoable",
    cls=RenamedOption,
    earlier={"--keep-history": "--undoable"},
    is_flag=True,
    help="Keep FUSED as it was in OUT.history, for `fusedrf undo`.",
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
        show_line = progress.warn if issubclass(category, FormatWarning) else progress.note
        show_line(str(message))

    with warnings.catch_warnings():
        warnings.simplefilter("always", FormatWarning)
        warnings.showwarning = show
        yield
