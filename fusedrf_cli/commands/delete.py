"""`fusedrf delete`: objects out of a bundle."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType


@click.command("delete")
@click.argument("fused", type=InputType())
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@options.writing("The bundle to write, OUT.rfpack.")
@options.mending
@options.keep_history
@options.time_budget
@options.rgb
@options.memory
@options.allow_outside
@options.seeded
@options.reporting
def command(**words):
    """Take objects out of a bundle.

    An object that is a node goes as it is. Of one that was distilled into a field with others the region is
    emptied, and shows what it hid where the other sources are known, or --refit gives photos of it. With
    --fill what nobody saw goes on smoothly with what is seen around it.

    \b
    Example:
      fusedrf delete fused.rfpack lamp chair-2 -o less.rfpack
    """
    return verbs.delete(**words)
