"""`fusedrf rename`: another name for an object of a bundle."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType


@click.command("rename")
@click.argument("fused", type=InputType())
@click.argument("name")
@click.argument("new_name", metavar="NEW")
@options.writing("The bundle to write, OUT.rfpack.")
@options.undoable
@options.memory
@options.reporting
def command(**words):
    """Give an object of a bundle another name.

    One that was distilled into a field with others goes by the new name as well.

    \b
    Example:
      fusedrf rename fused.rfpack chair red-chair -o named.rfpack
    """
    return verbs.rename(**words)
