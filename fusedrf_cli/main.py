"""The `fusedrf` command: finds the subcommand, and turns every failure into one line and an exit code."""

import contextlib
import importlib
import os
import signal
import sys
import traceback

import click
from click.exceptions import Exit, NoArgsIsHelpError
from click.shell_completion import shell_complete

from formats.errors import FormatError, printable
from fusedrf_cli import __version__, options, signals, streams
from fusedrf_cli.errors import FusedRFError

COMMANDS = (
    *("pose", "train", "import", "compose", "fuse", "convert", "add", "delete", "move", "duplicate"),
    *("rename", "replace", "crop", "tint", "extract", "history", "undo"),
    *("render", "eval", "chart", "info", "kinds", "validate", "completion"),
)
COMPLETE_VARIABLE = "_FUSEDRF_COMPLETE"

_MISSING_INPUT = (FileNotFoundError, IsADirectoryError, NotADirectoryError)


class LazyGroup(click.Group):
    """Imports a subcommand's module only when it is asked for, and handles the errors of all commands."""

    def list_commands(self, ctx: click.Context) -> list[str]:
        return list(COMMANDS)

    def get_command(self, ctx: click.Context, name: str) -> click.Command | None:
        if name not in COMMANDS:
            return None
        return importlib.import_module(f"fusedrf_cli.commands.{name}").command

    def main(self, args=None, prog_name="fusedrf", **extra):
        """Run one command line (`args`, or the process's own) and leave by SystemExit with its code."""
        if instruction := os.environ.get(COMPLETE_VARIABLE):
            sys.exit(shell_complete(self, {}, prog_name, COMPLETE_VARIABLE, instruction))
        if os.environ.get("NO_COLOR"):  # click does not look at it by itself
            extra["color"] = False
        ctx = None
        try:
            ctx = self.make_context(prog_name, list(sys.argv[1:] if args is None else args), **extra)
            with ctx:
                self.invoke(ctx)
            code = 0
        except Exit as done:
            code = done.exit_code
        except (Exception, KeyboardInterrupt) as error:
            if ctx is not None and ctx.meta.get(options.DEBUG):
                traceback.print_exc()
            code = _report_error(error)
        sys.exit(code)


def _report_error(error: BaseException) -> int:
    """Print one line on stderr that says what went wrong; returns the exit code."""
    if isinstance(error, NoArgsIsHelpError):
        click.echo(error.format_message(), err=True)
        return error.exit_code
    if isinstance(error, BrokenPipeError):  # the reader (`head`, for example) has closed the pipe
        return 128 + signal.SIGPIPE  # as a shell reports a process that this signal ended
    sentence, code = _sentence(error)
    if isinstance(error, KeyboardInterrupt) or signals.raised():
        signals.said()
    with contextlib.suppress(OSError):  # stderr may be full, or nobody may read it
        click.echo(f"Error: {printable(sentence)}", err=True)
    return code


def _sentence(error: BaseException) -> tuple[str, int]:
    match error:
        case FusedRFError() | FormatError():
            return str(error), error.exit_code
        case KeyboardInterrupt() | click.Abort():
            sentence = getattr(error, "sentence", None) or signals.remains or "interrupted"
            return sentence, getattr(error, "exit_code", 130)
        case click.UsageError(ctx=click.Context() as ctx):
            return f"{error.format_message().rstrip('.')}; try '{ctx.command_path} --help'", error.exit_code
        case click.ClickException():
            return error.format_message(), error.exit_code
        case MemoryError():
            return "not enough memory; ask for less with --max-size or --size, or close other programs", 5
        case OSError():
            where = f"{error.filename}: " if error.filename is not None else ""
            return f"{where}{error.strerror or error}", 3 if isinstance(error, _MISSING_INPUT) else 5
    if (interrupt := signals.raised()) is not None:
        return _sentence(interrupt)
    return f"internal error: {type(error).__name__}: {error}; run again with --debug for the traceback", 1


@click.group(
    "fusedrf", cls=LazyGroup, context_settings={"auto_envvar_prefix": "FUSEDRF", "max_content_width": 100}
)
@click.version_option(__version__, message="%(prog)s %(version)s")
@options.debug
def cli() -> None:
    """Fuse many radiance fields into one, and edit the result.

    Progress goes to stderr, results to stdout. Every option can also be set by an environment variable:
    FUSEDRF_TRAIN_SEED is --seed of train.

    \b
    Exit codes:
      0  done
      1  any other error
      2  usage
      3  invalid or corrupt input
      4  input of another version
      5  resources: disk, memory, permission, device
      6  numeric failure
      7  the requested quality was not reached
      130, 143  interrupted (SIGINT, SIGTERM)
      141  the reader of stdout has closed it (SIGPIPE)

    \b
    Example:
      fusedrf compose chair.rfpack table.rfpack -t 1,0,0 -o scene.json
      fusedrf fuse scene.json -o fused.rfpack
    """


def main() -> None:
    """The entry point of the process."""
    streams.hold()
    signals.obey()
    try:
        cli.main()
    finally:
        signals.leave()
        streams.seal()
