"""`fusedrf render`: pictures and films of a field or scene."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import ColourType, DirectionType, InputType, PositiveType, UpType, VectorType
from fusedrf_cli.requests import RenderRequest


@click.command("render")
@click.argument("scene", type=InputType(stdin=True))
@options.writing(
    "A .png (one view), a folder (one PNG per view; no ending, or OUT/), or a .gif or .mp4 (a film)."
)
@click.option("--cameras", type=InputType(), help="Views of a transforms.json.")
@click.option("--path", type=InputType(), help="Views of a nerfstudio camera_path.json.")
@click.option(
    "--views",
    type=click.Choice(["capture", "heldout"]),
    help="All views of the photos that the scene was learnt from, or those that were held out.",
)
@click.option("--orbit", type=click.IntRange(1), metavar="N", help="N views around the scene.")
@click.option("--look-at", type=VectorType(), help="Look at this point of the world.")
@click.option(
    "--view-from",
    cls=options.RenamedOption,
    earlier={"--from": "--view-from"},
    type=DirectionType(),
    help="Look from this side: degrees from +x about the upward axis, and above the horizon.",
)
@click.option(
    "--zoom",
    type=PositiveType(),
    default=RenderRequest.zoom,
    show_default=True,
    help="2: from half as far away.",
)
@click.option(
    "--up",
    type=UpType(),
    default="auto",
    show_default=True,
    help="Which way of the world is up; auto: as photos were held, or +z.",
)
@click.option(
    "--near", type=PositiveType(), metavar="D", help="Leave out what is nearer to the camera than D."
)
@click.option(
    "--far", type=PositiveType(), metavar="D", help="Leave out what is farther from the camera than D."
)
@click.option(
    "--step",
    type=PositiveType(),
    metavar="LENGTH",
    help="How far samples of a ray lie apart; default: half a voxel.",
)
@options.size
@click.option(
    "--background",
    type=ColourType(),
    default="white",
    show_default=True,
    help="white, black, transparent or #rrggbb.",
)
@click.option("--depth", is_flag=True, help="Write 16-bit depth pictures as well.")
@click.option(
    "--fps", type=PositiveType(), default=RenderRequest.fps, show_default=True, help="Frames per second."
)
@click.option(
    "--reference",
    cls=options.RenamedOption,
    earlier={"--naive": "--reference"},
    is_flag=True,
    help="Query every field of a scene at every sample: the composition that others are measured against.",
)
@options.memory
@options.allow_outside
@options.running
@options.reporting
def command(**words):
    """Render pictures or a film.

    SCENE is a bundle, a scene.json, or - for a scene on stdin. An unbounded scene learnt from photos is shown
    as one of them shows it, and --orbit circles what they look at, at their distance and height; where they
    were taken from one side, it swings to and fro between them. Anything else is framed from
    outside. --look-at, --view-from, --zoom and --up change that view or orbit.

    A scene.json is rendered as fast as a fused one; where memory does not hold all its fields, more slowly.

    \b
    Example:
      fusedrf render fused.rfpack --orbit 60 --size 400x400 -o turn.gif
    """
    limits = {name: words.pop(name) for name in ("near", "far")}
    words |= {name: limit for name, limit in limits.items() if limit is not None}
    return verbs.render(**words)
