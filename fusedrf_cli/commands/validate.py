"""`fusedrf validate`: checks every byte of a bundle, or of a scene and all that it names."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType


@click.command("validate")
@click.argument("scenes", metavar="SCENE...", nargs=-1, required=True, type=InputType(stdin=True))
@options.allow_outside
@options.reporting
def command(**words):
    """Check bundles and scenes, byte for byte.

    SCENE is a bundle, a scene.json, or - for a scene on stdin; what a scene names is checked as well.

    \b
    Example:
      fusedrf validate scene.json fused.rfpack
    """
    return verbs.validate(**words)
