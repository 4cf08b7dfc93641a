"""`fusedrf duplicate`: an object of a bundle once more."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType


@click.command("duplicate")
@click.argument("fused", type=InputType())
@click.argument("name")
@click.argument("new_name", metavar="NEW")
@options.writing("The bundle to write, OUT.rfpack.")
@options.placement
@options.undoable
@options.memory
@options.reporting
def command(**words):
    """Put a copy of an object of a bundle beside it.

    The copy, NEW, is placed from where NAME stands as `fusedrf move` does, and shares its field: a copy
    costs a few hundred bytes. Of one that was distilled into a field with others the source is placed.

    \b
    Example:
      fusedrf duplicate fused.rfpack chair chair-2 -t 1,0,0 -o two.rfpack
    """
    return verbs.duplicate(**words)
