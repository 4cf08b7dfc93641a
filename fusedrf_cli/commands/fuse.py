"""`fusedrf fuse`: a scene graph to one field."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import FolderType, InputType, KindType
from fusedrf_cli.requests import FuseRequest


def brief(report: dict) -> dict:
    """What people see: all but the learning curve."""
    return {key: value for key, value in report.items() if key != "curve"}


@click.command("fuse")
@click.argument("scene", type=InputType(stdin=True))
@options.writing("The fused field to write, OUT.rfpack.")
@click.option(
    "--kind",
    type=KindType("auto"),
    default=FuseRequest.kind,
    show_default=True,
    help="Kind of field, or way of fusing; auto: what suits the scene best.",
)
@options.fused_max_size
@options.smallest
@options.fused_time_budget
@options.finetune
@click.option("--from-scratch", is_flag=True, help="Do not start from the background's weights.")
@click.option(
    "--keep-sources", is_flag=True, help="Keep the sources inside; delete then restores what was hidden."
)
@click.option(
    "--sources",
    metavar="DIR",
    type=FolderType(),
    help="Where the sources of a fused bundle are looked for, by checksum, if not where its history says.",
)
@options.memory
@options.fused_precision
@options.ranks
@options.sh_degree
@options.resume
@options.allow_outside
@options.seeded
@options.reporting(brief=brief)
def command(**words):
    """Turn a whole scene into one bundle.

    SCENE is a scene.json, a bundle, or - for a scene on stdin. By --kind blocks its sources stay nodes, each
    with a field of its own; by any other kind one field is learnt from all of them. A fused bundle is built
    anew from its sources, where these are found as they were.

    \b
    Example:
      fusedrf fuse scene.json -o fused.rfpack
    """
    return verbs.fuse(**words)
