"""`fusedrf eval`: how close a field comes to photos, or to another scene."""

import click

from fusedrf_cli import options
from fusedrf_cli.requests import EvaluateRequest


@click.command("eval")
@click.argument("bundle", type=options.SCENE)
@click.option("--against", type=options.INPUT, required=True, help="A capture, or a scene to compare with.")
@click.option(
    "--split",
    type=click.Choice(["test", "train", "all"]),
    default="test",
    show_default=True,
    help="Which photos of a capture.",
)
@options.size
@options.memory
@options.allow_outside
@options.running
@options.reporting
def command(bundle, against, progress, **words):
    """Measure PSNR and SSIM against photos or a scene.

    BUNDLE (or a scene.json, or - for a scene on stdin) is rendered from the views of --against.

    \b
    Example:
      fusedrf eval chair.rfpack --against photos/ --json
    """
    from fusedrf_cli import bridge

    return bridge.evaluate(EvaluateRequest(bundle=bundle, against=against, **words), progress)
