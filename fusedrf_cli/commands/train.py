"""`fusedrf train`: posed photos, or a mesh, to one field; or several to fields that share a decoder."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import (
    BoxType,
    DownscaleType,
    FieldKindType,
    InputType,
    PositiveType,
    VectorType,
)
from fusedrf_cli.requests import TrainRequest


@click.command("train")
@click.argument("source", metavar="SOURCE...", nargs=-1, required=True, type=InputType())
@options.writing("The bundle to write, FIELD.rfpack.")
@click.option(
    "--kind",
    type=FieldKindType(),
    help="Kind of field; default: vm, of surroundings that learn for 2 minutes or more hash, with "
    "--shared-decoder dense-mlp.",
)
@click.option(
    "--shared-decoder",
    is_flag=True,
    help="Learn a field of each SOURCE, all of which have one decoder of colours.",
)
@options.ranks
@options.sh_degree
@options.max_size
@options.target_psnr
@click.option(
    "--quality",
    type=click.Choice(["draft", "normal", "high", "best"]),
    help="How fine, and how long to train; default: normal, or what --time-budget is enough for.",
)
@options.time_budget
@click.option(
    "--views",
    type=click.IntRange(2, 1000),
    default=TrainRequest.views,
    show_default=True,
    help="Views taken of a mesh.",
)
@click.option(
    "--size",
    type=click.IntRange(16, 4096),
    default=TrainRequest.size,
    show_default=True,
    help="Pixels a side of a mesh's views.",
)
@click.option("--holdout", type=click.IntRange(2), metavar="N", help="Keep every N-th photo to measure with.")
@click.option(
    "--downscale",
    type=DownscaleType(),
    default="auto",
    show_default=True,
    help="Make a side of photos N times smaller; auto: to at most 1080 pixels.",
)
@click.option("--aabb", type=BoxType(), help="Box to learn, xmin,ymin,zmin,xmax,ymax,zmax.")
@click.option(
    "--unbounded/--bounded",
    default=None,
    help="Learn an unbounded scene, or a box; default: as the photos need.",
)
@click.option("--centre", type=VectorType(), help="Middle of what is learnt finest.")
@click.option("--radius", type=PositiveType(), help="Half the side of what is learnt finest.")
@click.option(
    "--masks",
    type=click.Choice(["ignore", "alpha"]),
    default=TrainRequest.masks,
    show_default=True,
    help="Leave what masks exclude out of training, or learn it as transparent.",
)
@click.option(
    "--refine-poses", is_flag=True, help="Look for where photos were taken from, near the poses they have."
)
@options.memory
@options.precision
@options.resume
@options.seeded
@options.reporting
def command(**words):
    """Learn one field from photos or a mesh.

    SOURCE is the folder of a capture (Blender, instant-ngp, nerfstudio, COLMAP, LLFF and others), its
    transforms.json, or a .glb, .gltf, .obj, .ply, .stl or .off mesh. Photos without poses are posed first,
    as by `fusedrf pose`.

    Of several SOURCEs, with --shared-decoder, each becomes a node in the frame of its own capture. They learn
    in turns, for --time-budget together, and have equal parts of --max-size.

    \b
    Example:
      fusedrf train photos/ -o chair.rfpack
      fusedrf train photos/ table.glb --shared-decoder -o both.rfpack
    """
    return verbs.train(**words)
