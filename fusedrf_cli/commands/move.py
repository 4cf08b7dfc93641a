"""`fusedrf move`: an object of a bundle somewhere else."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType


@click.command("move")
@click.argument("fused", type=InputType())
@click.argument("name")
@options.writing("The bundle to write, OUT.rfpack.")
@options.placement
@options.undoable
@options.memory
@options.reporting
def command(**words):
    """Move, turn or scale an object of a bundle.

    From where it stands: it is scaled and turned about the middle of its box, then moved by -t; or --matrix
    is applied to it in the world. All fields keep their numbers, so that nothing is lost however often. Of
    one that was distilled into a field with others the source is taken, and the region in that field is
    emptied as `fusedrf delete` does it.

    \b
    Example:
      fusedrf move fused.rfpack chair -t 0.2,0,0 -r 0,0,30 -o moved.rfpack
    """
    return verbs.move(**words)
