"""`fusedrf add`: one more object into a fused field."""

import click

from fusedrf_cli import options, verbs


@click.command("add")
@click.argument("fused", type=options.INPUT)
@click.argument("source", metavar="OBJECT", type=options.INPUT)
@options.writing("The fused field to write, OUT.rfpack.")
@click.option("--name", required=True, help="The object's name in the scene.")
@options.placement
@options.keep_history
@options.time_budget
@options.rgb
@options.memory
@options.edited_precision
@options.seeded
@options.reporting
def command(**words):
    """Put one more object into a fused field.

    OBJECT is scaled, then turned, then moved. What is in FUSED
    already keeps its numbers.

    \b
    Example:
      fusedrf add fused.rfpack lamp.rfpack --name lamp -t 0,0,1 -r 0,0,45 -o more.rfpack
    """
    return verbs.add(**words)
