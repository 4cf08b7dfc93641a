"""`fusedrf compose`: writes a scene graph that places bundles; nothing is optimised or copied."""

import click

from fusedrf_cli import options, verbs
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.option_types import CropType, InputType, ShareType, TintType
from fusedrf_cli.requests import ComposeRequest


class PlacedOption(click.Option):
    """An option that belongs to the input before it; its value is ((index of the input, value), ...)."""

    def __init__(self, *flags, **words):
        super().__init__(*flags, allow_from_autoenv=False, **words)

    def add_to_parser(self, parser, ctx):
        super().add_to_parser(parser, ctx)
        known = {**parser._long_opt, **parser._short_opt}

        def process(value, state):
            placed = (len(state.largs) - 1, True if self.is_flag else value)
            state.opts.setdefault(self.name, []).append(placed)
            state.order.append(self)

        for flag in self.opts:  # click gives an option its value, but not its position in the line
            known[flag].process = process

    def type_cast_value(self, ctx, value):
        if not isinstance(value, list):  # not given
            return ()
        if value[0][0] < 0:
            raise click.BadParameter("belongs to the input before it, and there is none", ctx, self)
        return tuple((index, self.type(given, self, ctx)) for index, given in value)


def _placed_options(command):
    """The options that each input may be followed by."""
    flags = {
        **options.PLACEMENT,
        ("--name",): {"help": "The node's name; default: the file's stem."},
        ("--background-node",): {"is_flag": True, "help": "This input is the background."},
        ("--crop",): {
            "type": CropType(),
            "help": "Show what lies in a box, xmin,ymin,zmin,xmax,ymax,zmax, or in a sphere, x,y,z,r, of its "
            "own world.",
        },
        ("--opacity",): {"type": ShareType(), "help": "Its density times this, above 0 and at most 1."},
        ("--tint",): {"type": TintType(), "help": "Its colours times red, green and blue from 0 to 1."},
        ("--hidden",): {"is_flag": True, "help": "Leave it out, but keep its node in the scene."},
    }
    for names, words in reversed(flags.items()):
        command = click.option(*names, cls=PlacedOption, **words)(command)
    return command


@click.command("compose")
@click.argument("inputs", metavar="INPUT...", nargs=-1, required=True, type=InputType())
@_placed_options
@options.writing("The scene to write, scene.json, or - for stdout.")
@click.option(
    "--composition",
    type=click.Choice(["max", "add"]),
    default=ComposeRequest.composition,
    show_default=True,
    help="Where fields overlap: the densest wins, or they mix.",
)
@options.allow_outside
@options.reporting
def command(inputs, output, overwrite, composition, allow_outside, progress, **placed):
    """Place bundles and scenes in one scene graph.

    Each INPUT, a bundle or a scene.json, is followed by the options that place it: it is scaled, then
    turned, then moved, in whatever order these are given. Nothing is optimised. Sources are written relative
    to the scene's folder. An INPUT that is a scene is a group: its fields are one by its own --composition,
    and that one is placed.

    \b
    Example:
      fusedrf compose table.rfpack --background-node chair.rfpack -t 0.4,0,0 -r 0,0,45 -s 0.5 -o scene.json
    """
    given = _by_input(inputs, placed)
    words = {"composition": composition, "allow_outside": allow_outside, "overwrite": overwrite}
    return verbs.compose(given, output, progress=progress, **words)


def _by_input(inputs: tuple[str, ...], placed: dict[str, tuple]) -> list[dict]:
    """The words of each input, from the values of each option."""
    words = [{"path": path} for path in inputs]
    for option, pairs in placed.items():
        for index, value in pairs or ():
            if option in words[index]:
                raise UsageProblem(f"{inputs[index]}: --{option.replace('_', '-')} is given twice")
            words[index][option] = value
    return words
