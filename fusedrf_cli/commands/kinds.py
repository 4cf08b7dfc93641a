"""`fusedrf kinds`: the kinds of field, and what each is good for."""

import click

from fusedrf_cli import options, verbs


@click.command("kinds")
@options.reporting
def command(**words):
    """List the kinds of field, and what each is good for.

    \b
    Example:
      fusedrf kinds
    """
    return verbs.kinds(**words)
