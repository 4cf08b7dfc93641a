"""`fusedrf convert`: a field of any kind to one of any other."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import FieldKindType, InputType


@click.command("convert")
@click.argument("field", type=InputType())
@options.writing("The field to write, OUT.rfpack.")
@click.option(
    "--kind", type=FieldKindType(), required=True, help="Kind of field to make; see `fusedrf kinds`."
)
@options.converted_max_size
@options.smallest
@options.fused_time_budget
@options.memory
@options.fused_precision
@options.ranks
@options.sh_degree
@options.seeded
@options.reporting
def command(**words):
    """Turn a field into one of another kind that shows the same.

    FIELD is a bundle, trained, imported or fused. The report gives PSNR and SSIM against it on views
    that nothing was learnt from, and bytes before and after.

    \b
    Example:
      fusedrf convert chair.rfpack -o small.rfpack --kind cp
    """
    return verbs.convert(**words)
