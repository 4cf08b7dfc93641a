"""`fusedrf rename`: another name for an object of a bundle."""

import click

from fusedrf_cli import options
from fusedrf_cli.requests import ArrangeRequest


@click.command("rename")
@click.argument("fused", type=options.INPUT)
@click.argument("name")
@click.argument("new_name", metavar="NEW")
@options.writing("The bundle to write, OUT.rfpack.", edits="fused")
@options.keep_history
@options.memory
@options.reporting
def command(fused, name, new_name, progress, **words):
    """Give an object of a bundle another name.

    The object has to be a node of its own, as in bundles of --kind blocks.

    \b
    Example:
      fusedrf rename fused.rfpack chair red-chair -o named.rfpack
    """
    from formats.scene import make_node

    node = make_node(new_name)
    from fusedrf_cli import bridge

    request = ArrangeRequest(
        fused=fused,
        name=name,
        new_name=new_name,
        matrix=node.node_to_parent,
        absolute=True,
        **words,
    )
    return bridge.rename(request, progress)
