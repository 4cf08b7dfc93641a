"""`fusedrf completion`: the script by which a shell completes fusedrf's command lines."""

import click
from click.shell_completion import get_completion_class


@click.command("completion")
@click.argument("shell", type=click.Choice(["bash", "zsh", "fish"]))
@click.pass_context
def command(ctx, shell):
    """Print a shell's completion script.

    Load it from the start-up file of SHELL, or save it where SHELL looks for completions.

    \b
    Example:
      fusedrf completion bash
    """
    from fusedrf_cli.main import COMPLETE_VARIABLE, cli

    click.echo(get_completion_class(shell)(cli, {}, "fusedrf", COMPLETE_VARIABLE).source())
