"""`fusedrf import`: another system's file to a bundle."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import BoxType, InputType, PositiveType


@click.command("import")
@click.argument("path", metavar="FILE", type=InputType())
@options.writing("The bundle to write, FIELD.rfpack.")
@click.option("--name", help="Name of its node; default: that of the file.")
@click.option(
    "--aabb", type=BoxType(), help="Where a field lies whose file has no box, xmin,ymin,zmin,xmax,ymax,zmax."
)
@click.option("--near", type=PositiveType(), metavar="LENGTH", help="Or nearest to the cameras that it does,")
@click.option("--far", type=PositiveType(), metavar="LENGTH", help="and farthest from them.")
@click.option(
    "--cameras", type=InputType(), metavar="CAPTURE", help="The capture it was learnt from: keep its cameras."
)
@click.option("--time", type=float, help="Take a moving scene at this time.")
@options.imported_precision
@options.memory
@options.reporting
def command(**words):
    """Turn another system's file into a bundle that answers exactly as it does.

    FILE is a checkpoint of TensoRF, Plenoxels (svox2), DVGO, Instant-NGP, NeRF (nerf-pytorch),
    torch-ngp, PVD or nerfacto, told apart by what it holds, or the folder of a run, whose newest
    checkpoint is taken. Nothing in it is run, and nothing is learnt.

    \b
    Example:
      fusedrf import logs/lego/lego.th -o lego.rfpack
    """
    return verbs.import_field(**words)
