"""`fusedrf replace`: another object in the place of one in a bundle."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType


@click.command("replace")
@click.argument("fused", type=InputType())
@click.argument("name")
@click.argument("source", metavar="WITH", type=InputType())
@options.writing("The bundle to write, OUT.rfpack.")
@options.keep_history
@options.memory
@options.added_precision
@options.allow_outside
@options.reporting
def command(**words):
    """Put another object in the place of one.

    WITH stands as NAME stood, by the same move, turn and scale, and goes by its name.

    \b
    Example:
      fusedrf replace fused.rfpack chair lamp.rfpack -o other.rfpack
    """
    return verbs.replace(**words)
