"""`fusedrf extract`: an object out of a field."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import BoxType, InputType, PointType, SphereType


@click.command("extract")
@click.argument("field", type=InputType())
@options.writing("The object to write, OUT.rfpack.")
@click.option(
    "--masks",
    type=InputType(),
    help="A folder of masks, black where the object is not, each named as the view that it masks.",
)
@click.option("--cameras", type=InputType(), help="The views of --masks and --points: a transforms.json.")
@click.option(
    "--points",
    multiple=True,
    type=PointType(),
    help="A pixel of a view that shows the object, or, with ,out after it, that does not. Repeat it.",
)
@click.option(
    "--box", "boxes", multiple=True, type=BoxType(), help="It lies in this box. Repeat it: in one of them."
)
@click.option("--sphere", "spheres", multiple=True, type=SphereType(), help="It lies in this sphere.")
@click.option("--mesh", type=InputType(), help="It lies in this closed mesh.")
@click.option("--name", help="The node, group or distilled object that goes by this name.")
@click.option("--invert", is_flag=True, help="Write the field without the object.")
@click.option(
    "--preview",
    type=click.Path(file_okay=False),
    help="Write pictures to this folder: the object, the rest, and the object marked in the whole.",
)
@options.mending
@options.time_budget
@options.extracted_max_size
@options.extracted_precision
@options.memory
@options.seeded
@options.reporting
def command(**words):
    """Cut an object out of a field.

    The object is told by masks of a few views, by points, by a box, a sphere or a mesh around it, or by any
    mix of them. Views are those of the photos that FIELD was learnt from, or of --cameras. It stays where it
    stands in the world: composed with what --invert writes, it gives the field again. What it hid is empty
    then, and is filled on request: --refit learns it from photos, --fill goes on smoothly with what is seen
    around it.

    \b
    Example:
      fusedrf extract fused.rfpack --masks masks -o object.rfpack --preview look
    """
    return verbs.extract(**words)
