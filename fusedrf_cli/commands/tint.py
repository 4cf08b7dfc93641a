"""`fusedrf tint`: an object of a bundle in other colours, or thinner."""

import click

from fusedrf_cli import options
from fusedrf_cli.requests import ShowRequest


@click.command("tint")
@click.argument("fused", type=options.INPUT)
@click.argument("name")
@click.argument("colour", metavar="[R,G,B]", type=options.TINT, required=False)
@options.writing("The bundle to write, OUT.rfpack.", edits="fused")
@click.option("--opacity", type=options.SHARE, help="Its density times this, above 0 and at most 1.")
@options.keep_history
@options.memory
@options.reporting
def command(fused, name, colour, opacity, progress, **words):
    """Multiply the colours of an object.

    By red, green and blue from 0 to 1. Its numbers stay: without a colour, or an opacity, it is shown as it
    was.

    \b
    Example:
      fusedrf tint fused.rfpack chair 1,0.5,0.5 -o red.rfpack
    """
    from fusedrf_cli import bridge

    showing = {"tint": None if colour is None else list(colour), "opacity": opacity}
    request = ShowRequest(fused=fused, name=name, event="tinted", showing=showing, **words)
    return bridge.show(request, progress)
