"""`fusedrf render`: pictures and films of a field or scene."""

import click

from fusedrf_cli import options
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.requests import RenderRequest


@click.command("render")
@click.argument("scene", type=options.SCENE)
@options.writing("A .png (one view), a folder (one PNG per view), or a .gif or .mp4 (a film).", folders=True)
@click.option("--cameras", type=options.INPUT, help="Views of a transforms.json.")
@click.option("--path", type=options.INPUT, help="Views of a nerfstudio camera_path.json.")
@click.option("--orbit", type=click.IntRange(1), metavar="N", help="N views around the scene.")
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
@options.memory
@options.allow_outside
@options.running
@options.reporting
def command(scene, output, cameras, path, orbit, progress, **words):
    """Render pictures or a film.

    SCENE is a bundle, a scene.json, or - for a scene on stdin. By default one view frames all of it.

    \b
    Example:
      fusedrf render fused.rfpack --orbit 60 --size 400x400 -o turn.gif
    """
    if sum(choice is not None for choice in (cameras, path, orbit)) > 1:
        raise UsageProblem("--cameras, --path and --orbit each choose the views; give one of them")
    from fusedrf_cli import bridge

    views = {"cameras": cameras, "path": path, "orbit": orbit}
    return bridge.render(RenderRequest(scene=scene, output=output, **views, **words), progress)
