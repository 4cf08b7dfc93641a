"""`fusedrf eval`: how close a field comes to photos, or to another scene."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType
from fusedrf_cli.requests import EvaluateRequest


@click.command("eval")
@click.argument("bundle", type=InputType(stdin=True))
@click.option("--against", type=InputType(), required=True, help="A capture, or a scene to compare with.")
@click.option(
    "--split",
    type=click.Choice(["test", "train", "all"]),
    default=EvaluateRequest.split,
    show_default=True,
    help="Which photos of a capture.",
)
@options.size
@options.memory
@options.allow_outside
@options.running
@options.reporting
def command(**words):
    """Measure PSNR and SSIM against photos or a scene.

    BUNDLE (or a scene.json, or - for a scene on stdin) is rendered from the views of --against.

    \b
    Example:
      fusedrf eval chair.rfpack --against photos/ --json
    """
    return verbs.eval(**words)
