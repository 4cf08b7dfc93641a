"""`fusedrf import`: another system's file to a bundle."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import BoxType, InputType, PositiveType, UpType


@click.command("import")
@click.argument("path", metavar="FILE", type=InputType())
@options.writing("The bundle to write, FIELD.rfpack.")
@click.option("--name", help="Name of its node; default: that of the file.")
@click.option(
    "--aabb", type=BoxType(), help="Where a field lies whose file has no box, xmin,ymin,zmin,xmax,ymax,zmax."
)
@click.option(
    "--near",
    type=PositiveType(),
    metavar="LENGTH",
    help="With --cameras, instead: how near to these it begins,",
)
@click.option("--far", type=PositiveType(), metavar="LENGTH", help="and how far from them it ends.")
@click.option(
    "--cameras", type=InputType(), metavar="CAPTURE", help="The capture it was learnt from: keep its cameras."
)
@click.option(
    "--up", type=UpType(), help="Which way of its world is up; auto, the default: as its format has it."
)
@click.option(
    "--time", type=float, help="Take a moving scene at this time: K-Planes' from -1 to 1, D²NeRF's from 0 on."
)
@options.imported_precision
@options.memory
@options.reporting
def command(**words):
    """Turn another system's file into a bundle of its numbers.

    FILE is a checkpoint of TensoRF, Plenoxels (svox2), DVGO, Instant-NGP, NeRF (nerf-pytorch), HashNeRF,
    torch-ngp, PVD, nerfacto, K-Planes, D²NeRF, 3D Gaussian splatting, splatfacto or gsplat, or the folder
    of a run, whose newest checkpoint is taken; or Gaussian splats: .ply, .spz, .sog, .splat, .ksplat or
    glTF. Files are told apart by what they hold.
    Nothing in them is run, and nothing is learnt.

    \b
    Example:
      fusedrf import lego.th -o lego.rfpack
    """
    return verbs.import_field(**words)
