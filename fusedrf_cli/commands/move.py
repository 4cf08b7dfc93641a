"""`fusedrf move`: an object of a bundle somewhere else."""

import click

from fusedrf_cli import options
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.placement import node_words
from fusedrf_cli.requests import ArrangeRequest


@click.command("move")
@click.argument("fused", type=options.INPUT)
@click.argument("name")
@options.writing("The bundle to write, OUT.rfpack.", edits="fused")
@options.placement
@options.keep_history
@options.memory
@options.reporting
def command(fused, name, translate, rotate, scale, matrix, progress, **words):
    """Move, turn or scale an object of a bundle.

    From where it stands: it is scaled and turned about the middle of its box, then moved by -t; or --matrix
    is applied to it in the world. All fields keep their numbers, so that nothing is lost however often. The
    object has to be a node of its own, as in bundles of --kind blocks.

    \b
    Example:
      fusedrf move fused.rfpack chair -t 0.2,0,0 -r 0,0,30 -o moved.rfpack
    """
    from formats.scene import make_node

    placed = node_words(translate, rotate, scale, matrix)
    if not placed:
        raise UsageProblem("say where to: -t, -r, -s or --matrix")
    node = make_node(name, **placed)
    from fusedrf_cli import bridge

    request = ArrangeRequest(
        fused=fused,
        name=name,
        new_name=None,
        matrix=node.node_to_parent,
        absolute=matrix is not None,
        **words,
    )
    return bridge.move(request, progress)
