"""`fusedrf crop`: a part of an object of a bundle."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import CropType, InputType


@click.command("crop", cls=options.NumbersCommand)
@click.argument("fused", type=InputType())
@click.argument("name")
@click.argument("shape", type=CropType(), required=False)
@options.writing("The bundle to write, OUT.rfpack.")
@options.undoable
@options.memory
@options.reporting
def command(**words):
    """Show what of an object lies in a box or a sphere.

    SHAPE is a box, xmin,ymin,zmin,xmax,ymax,zmax, or a sphere, x,y,z,r, in the object's own world, as it was
    before it was placed; `fusedrf info FUSED --json` has its box there, "aabb". Its numbers stay: without
    SHAPE all of it is shown again.

    \b
    Example:
      fusedrf crop fused.rfpack chair 0,0,0.5,1 -o part.rfpack
    """
    return verbs.crop(**words)
