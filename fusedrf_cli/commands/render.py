"""`fusedrf render`: pictures and films of a field or scene."""

import math
from pathlib import Path

import click

from fusedrf_cli import options
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.requests import RenderRequest


def beside(output: str, words: dict) -> dict[str, bool]:
    """The depth of a single picture, where that is asked for."""
    from formats.filenames import depth_of

    single = Path(output).suffix.lower() == ".png"
    return {str(depth_of(Path(output))): False} if words["depth"] and single else {}


@click.command("render")
@click.argument("scene", type=options.SCENE)
@options.writing(
    "A .png (one view), a folder (one PNG per view), or a .gif or .mp4 (a film).", folders=True, beside=beside
)
@click.option("--cameras", type=options.INPUT, help="Views of a transforms.json.")
@click.option("--path", type=options.INPUT, help="Views of a nerfstudio camera_path.json.")
@click.option(
    "--views",
    type=click.Choice(["capture", "heldout"]),
    help="All views of the photos that the scene was learnt from, or those that were held out.",
)
@click.option("--orbit", type=click.IntRange(1), metavar="N", help="N views around the scene.")
@click.option("--look-at", type=options.VECTOR, help="Look at this point of the world.")
@click.option(
    "--from",
    "direction",
    type=options.DIRECTION,
    help="Look from this side: degrees from +x about the upward axis, and above the horizon.",
)
@click.option(
    "--zoom", type=options.POSITIVE, default=1.0, show_default=True, help="2: from half as far away."
)
@click.option(
    "--up",
    type=options.UP,
    default="auto",
    show_default=True,
    help="Which way of the world is up; auto: as photos were held, or +z.",
)
@click.option(
    "--near", type=options.POSITIVE, metavar="D", help="Leave out what is nearer to the camera than D."
)
@click.option(
    "--far", type=options.POSITIVE, metavar="D", help="Leave out what is farther from the camera than D."
)
@options.size
@click.option(
    "--background",
    type=options.COLOUR,
    default="white",
    show_default=True,
    help="white, black, transparent or #rrggbb.",
)
@click.option("--depth", is_flag=True, help="Write 16-bit depth pictures as well.")
@click.option("--fps", type=options.POSITIVE, default=24.0, show_default=True, help="Frames per second.")
@click.option(
    "--naive",
    is_flag=True,
    help="Ask every field of a scene at every sample, as fused fields are measured against.",
)
@options.memory
@options.allow_outside
@options.running
@options.reporting
def command(scene, output, progress, **words):
    """Render pictures or a film.

    SCENE is a bundle, a scene.json, or - for a scene on stdin. What was learnt from photos of a place is
    shown as one of them shows it, and --orbit circles what they look at, at their distance and height;
    where they were taken from one side, it swings to and fro between them. Anything else is framed from
    outside. --look-at, --from, --zoom and --up change that view or orbit.

    A scene.json of vm fields is put together in memory first, which takes a second or two, and is then as
    fast to look at as a fused one.

    \b
    Example:
      fusedrf render fused.rfpack --orbit 60 --size 400x400 -o turn.gif
    """
    chosen = [name for name in ("cameras", "path", "views", "orbit") if words[name] is not None]
    if len(chosen) > 1:
        raise UsageProblem("--cameras, --path, --views and --orbit each choose the views; give one of them")
    aimed = any(words[name] is not None for name in ("look_at", "direction", "up")) or words["zoom"] != 1
    if aimed and chosen and chosen != ["orbit"]:
        raise UsageProblem(
            f"--look-at, --from, --zoom and --up do not apply to --{chosen[0]}; leave them out"
        )
    near, far = words.pop("near") or 0.0, words.pop("far") or math.inf
    if near >= far:
        raise UsageProblem(f"--near {near:g} leaves nothing before --far {far:g}; give a greater --far")
    from fusedrf_cli import bridge

    return bridge.render(RenderRequest(scene=scene, output=output, near=near, far=far, **words), progress)
