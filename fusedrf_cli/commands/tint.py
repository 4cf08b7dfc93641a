"""`fusedrf tint`: an object of a bundle in other colours, or thinner."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType, ShareType, TintType


@click.command("tint", cls=options.NumbersCommand)
@click.argument("fused", type=InputType())
@click.argument("name")
@click.argument("colour", metavar="[R,G,B]", type=TintType(), required=False)
@options.writing("The bundle to write, OUT.rfpack.")
@click.option("--opacity", type=ShareType(), help="Its density times this, above 0 and at most 1.")
@options.undoable
@options.memory
@options.reporting
def command(**words):
    """Multiply the colours of an object.

    By red, green and blue from 0 to 1. Its numbers stay: without a colour, or an opacity, it is shown as it
    was.

    \b
    Example:
      fusedrf tint fused.rfpack chair 1,0.5,0.5 -o red.rfpack
    """
    return verbs.tint(**words)
