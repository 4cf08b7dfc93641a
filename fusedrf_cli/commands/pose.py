"""`fusedrf pose`: where photos were taken, out of the photos alone."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType


@click.command("pose")
@click.argument("photos", type=InputType())
@options.writing("The folder to write, CAPTURE.")
@options.threads
@options.reporting
def command(**words):
    """Find out where photos were taken.

    PHOTOS is a folder of overlapping photos without poses, or the frames of a film. CAPTURE gets a
    transforms.json, which names the photos where they lie, and sparse points; `train` reads it. Its z is up,
    its units are arbitrary. Needs fusedrf[capture]. `train PHOTOS` does the same first, and keeps it in the
    user's cache.

    \b
    Example:
      fusedrf pose photos/ -o garden
    """
    return verbs.pose(**words)
