"""docs/commands.md, out of what `--help` and `fusedrf kinds` say: `make docs` writes it, and
tests/cli/test_help.py holds it equal."""

from pathlib import Path

import click

from fusedrf_cli.main import COMMANDS, cli
from fusedrf_cli.verbs import kinds

WIDTH = 100
"""Columns of the help."""


def page() -> str:
    """The page: what `fusedrf --help` says, and `--help` of every command."""
    root = click.Context(cli, info_name="fusedrf", terminal_width=WIDTH)
    parts = [("fusedrf", cli.get_help(root))]
    for name in COMMANDS:
        command = cli.get_command(root, name)
        context = click.Context(command, root, info_name=name, terminal_width=WIDTH)
        parts.append((f"fusedrf {name}", command.get_help(context)))
    own = [kind for kind in kinds()["kinds"] if kind["package"] == "fusedrf"]
    return "\n".join(
        [
            "# Commands and kinds of field\n\nWhat `--help` says; `make docs` writes this page.\n",
            *(f"## {title}\n\n```text\n{text}\n```\n" for title, text in parts),
            "## Kinds\n\n| `--kind` | good for | made by |\n|---|---|---|",
            *(f"| `{kind['name']}` | {kind['good_for']} | {', '.join(kind['does'])} |" for kind in own),
            "\nOthers come as plug-ins: [kinds.md](kinds.md) shows how one is written.\n",
        ]
    )


if __name__ == "__main__":
    Path(__file__).with_suffix(".md").write_text(page(), encoding="utf-8")
