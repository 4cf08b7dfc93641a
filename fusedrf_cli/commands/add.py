"""`fusedrf add`: one more object into a bundle."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType


@click.command("add")
@click.argument("fused", type=InputType())
@click.argument("source", metavar="OBJECT", type=InputType())
@options.writing("The bundle to write, OUT.rfpack.")
@click.option("--name", required=True, help="The object's name in the scene.")
@options.placement
@options.keep_history
@options.memory
@options.added_precision
@options.reporting
def command(**words):
    """Put one more object into a bundle.

    OBJECT, of any kind, is scaled, then turned, then moved, and becomes a node of FUSED. All fields keep
    their numbers; one that is there already is stored once.

    \b
    Example:
      fusedrf add fused.rfpack lamp.rfpack --name lamp -t 0,0,1 -r 0,0,45 -o more.rfpack
    """
    return verbs.add(**words)
