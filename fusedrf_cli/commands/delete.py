"""`fusedrf delete`: objects out of a fused field."""

import click

from fusedrf_cli import options


@click.command("delete")
@click.argument("fused", type=options.INPUT)
@click.argument("names", metavar="NAME...", nargs=-1, required=True)
@options.writing("The fused field to write, OUT.rfpack.", edits="fused")
@options.time_budget
@options.rgb
@options.edited_precision
@options.allow_outside
@options.seeded
@options.reporting
def command(fused, names, output, **words):
    """Take objects out of a fused field.

    The blocks of the objects NAME... are dropped; out of a distilled tensor only the cells of their boxes are
    cut, and learned again where the other sources are known.

    \b
    Example:
      fusedrf delete fused.rfpack lamp chair-2 -o less.rfpack
    """
    from fusedrf_cli import bridge

    return bridge.delete(fused, names, output, **words)
