"""`fusedrf history`: what was done to a fused field."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.option_types import InputType


def _brief(report: dict) -> dict:
    """The report with an edit's objects on one line."""
    entries = [
        {"edit": number, **entry, "objects": ", ".join(entry["objects"])}
        for number, entry in enumerate(report["history"])
    ]
    return {**report, "history": entries}


@click.command("history")
@click.argument("fused", type=InputType())
@options.reporting(brief=_brief)
def command(**words):
    """List what was done to a fused field.

    It says too how many of its edits can be undone.

    \b
    Example:
      fusedrf history fused.rfpack
    """
    return verbs.history(**words)
