"""`fusedrf undo`: a fused field as it was before its last edit."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType


@click.command("undo")
@click.argument("fused", type=InputType())
@options.writing("The field to write, OUT.rfpack.")
@options.reporting
def command(**words):
    """Undo the last edit of a fused field.

    What is written has the bytes that were there before. The edit must have been made with --keep-history,
    which keeps them in FUSED.history.

    \b
    Example:
      fusedrf undo fused.rfpack -o fused.rfpack -w
    """
    return verbs.undo(**words)
