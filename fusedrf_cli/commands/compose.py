"""`fusedrf compose`: writes a scene graph that places bundles; nothing is optimised or copied."""

import os
from pathlib import Path

import click

from fusedrf_cli import __version__, options
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.placement import node_words


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
            "type": options.CROP,
            "help": "Show what lies in a box, xmin,ymin,zmin,xmax,ymax,zmax, or in a sphere, x,y,z,r, of its "
            "own world.",
        },
        ("--opacity",): {"type": options.SHARE, "help": "Its density times this, above 0 and at most 1."},
        ("--tint",): {"type": options.TINT, "help": "Its colours times red, green and blue from 0 to 1."},
        ("--hidden",): {"is_flag": True, "help": "Leave it out, but keep its place in the scene."},
    }
    for names, words in reversed(flags.items()):
        command = click.option(*names, cls=PlacedOption, **words)(command)
    return command


@click.command("compose")
@click.argument("inputs", metavar="INPUT...", nargs=-1, required=True, type=options.INPUT)
@_placed_options
@options.writing("The scene to write, scene.json, or - for stdout.", stdout=True)
@click.option(
    "--composition",
    type=click.Choice(["max", "add"]),
    default="max",
    show_default=True,
    help="Where fields overlap: the densest wins, or they mix.",
)
@options.allow_outside
@options.reporting
def command(inputs, output, overwrite, composition, allow_outside, progress, **placed):
    """Place bundles and scenes in one scene graph.

    Each INPUT, a bundle or a scene.json, is followed by the options that place it: it is scaled, then
    turned, then moved, in whatever order these are given. Nothing is optimised. Sources are written relative
    to the scene's folder.

    \b
    Example:
      fusedrf compose table.rfpack --background-node chair.rfpack -t 0.4,0,0 -r 0,0,45 -s 0.5 -o scene.json
    """
    from formats.bundle import read_summary
    from formats.scene import SceneGraph, dump_scene, inline_scenes, write_scene

    summaries = [read_summary(path) for path in inputs]
    nodes = tuple(_nodes(inputs, output, allow_outside, _by_input(inputs, placed)))
    scene = SceneGraph(nodes, composition, generator=f"fusedrf {__version__}")
    inline_scenes(scene, output, allow_outside)
    if output == options.STDIO:
        click.echo(dump_scene(scene), nl=False)
        return {}
    write_scene(output, scene, overwrite=overwrite)
    return {
        "output": output,
        "bytes": os.path.getsize(output),
        "nodes": [
            {"name": node.name, "source": node.source, "source_bytes": summary["bytes"]}
            for node, summary in zip(nodes, summaries, strict=True)
        ],
    }


def _by_input(inputs: tuple[str, ...], placed: dict[str, tuple]) -> list[dict]:
    """The options of each input, from the values of each option."""
    words = [dict.fromkeys(placed) for _ in inputs]
    for option, pairs in placed.items():
        for index, value in pairs or ():
            if words[index][option] is not None:
                raise UsageProblem(f"{inputs[index]}: --{option.replace('_', '-')} is given twice")
            words[index][option] = value
    return words


def _nodes(inputs, output, allow_outside, words):
    from formats.scene import make_node, resolve_source

    names = _names(inputs, [given.pop("name") for given in words])
    for path, name, given in zip(inputs, names, words, strict=True):
        source = _relative(path, output)
        resolve_source(output, source, allow_outside)
        background, hidden = bool(given.pop("background_node")), bool(given.pop("hidden"))
        showing = {key: value for key in ("crop", "opacity", "tint") if (value := given.pop(key)) is not None}
        showing |= {"visible": False} if hidden else {}
        words = node_words(**given)
        yield make_node(name, source=source, background=background, showing=showing, **words)


def _names(inputs: tuple[str, ...], given: list[str | None]) -> list[str]:
    """A name for each input: the one given, else the file's stem, numbered where that is taken."""
    taken = {name for name in given if name is not None}
    names = []
    for path, name in zip(inputs, given, strict=True):
        stem, count = Path(path).stem, 1
        while name is None:
            candidate = stem if count == 1 else f"{stem}-{count}"
            name, count = (None if candidate in taken else candidate), count + 1
        taken.add(name)
        names.append(name)
    return names


def _relative(path: str, output: str) -> str:
    """`path` as the scene at `output` names it. Links are resolved, as from a link `..` leads elsewhere."""
    folder = os.path.realpath(os.path.dirname(output))
    real = os.path.join(os.path.realpath(os.path.dirname(path)), os.path.basename(path))
    return Path(os.path.relpath(real, folder)).as_posix()
