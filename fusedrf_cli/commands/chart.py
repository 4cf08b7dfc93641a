"""`fusedrf chart`: what fusing a scene costs in each way that is worth it, and what it gives."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType, KindsType, PositiveType, SizeType
from fusedrf_cli.requests import ChartRequest


def shown(report: dict) -> dict:
    """The frontier, without the points that another one surpasses."""
    return {name: value for name, value in report.items() if name not in ("points", "warnings")}


@click.command("chart")
@click.argument("scene", type=InputType())
@options.writing("The folder for chart.png, chart.svg and chart.csv.")
@click.option(
    "--budget",
    type=PositiveType(),
    metavar="S",
    default=ChartRequest.budget,
    show_default=True,
    help="Start no new point after S seconds.",
)
@click.option(
    "--kinds",
    type=KindsType(),
    default=",".join(ChartRequest.kinds),
    show_default=True,
    help="Kinds to try, separated by commas.",
)
@click.option(
    "--least-psnr",
    type=PositiveType(),
    metavar="DB",
    default=ChartRequest.least_psnr,
    show_default=True,
    help="Go no smaller once a point falls below it.",
)
@click.option(
    "--size",
    type=SizeType(),
    default=ChartRequest.size,
    help="Size of the pictures compared; default: 400x400.",
)
@options.memory
@options.allow_outside
@options.seeded
@options.reporting(brief=shown)
def command(**words):
    """Chart PSNR against seconds, bytes and time per frame.

    SCENE, a scene.json or a bundle, is fused in many ways; each is compared with the scene as composed, on
    views that no fusing uses. Every point of the frontier is labelled with the flags of fuse that give it.

    \b
    Example:
      fusedrf chart scene.json -o chart --budget 120
    """
    return verbs.chart(**words)
