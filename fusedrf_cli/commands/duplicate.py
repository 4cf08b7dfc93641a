"""`fusedrf duplicate`: an object of a bundle once more."""

import click

from fusedrf_cli import options
from fusedrf_cli.placement import node_words
from fusedrf_cli.requests import ArrangeRequest


@click.command("duplicate")
@click.argument("fused", type=options.INPUT)
@click.argument("name")
@click.argument("new_name", metavar="NEW")
@options.writing("The bundle to write, OUT.rfpack.", edits="fused")
@options.placement
@options.keep_history
@options.memory
@options.reporting
def command(fused, name, new_name, translate, rotate, scale, matrix, progress, **words):
    """Put a copy of an object of a bundle beside it.

    The copy, NEW, is placed from where NAME stands as `fusedrf move` does, and shares its field: a copy
    costs a few hundred bytes. The object has to be a node of its own, as in bundles of --kind blocks.

    \b
    Example:
      fusedrf duplicate fused.rfpack chair chair-2 -t 1,0,0 -o two.rfpack
    """
    from formats.scene import make_node

    node = make_node(new_name, **node_words(translate, rotate, scale, matrix))
    from fusedrf_cli import bridge

    request = ArrangeRequest(
        fused=fused,
        name=name,
        new_name=new_name,
        matrix=node.node_to_parent,
        absolute=matrix is not None,
        **words,
    )
    return bridge.duplicate(request, progress)
