"""`fusedrf validate`: checks every byte of a bundle, or of a scene and all that it names."""

import os

import click

from formats.errors import FormatError
from fusedrf_cli import options
from fusedrf_cli.errors import InvalidInput


@click.command("validate")
@click.argument("scenes", metavar="SCENE...", nargs=-1, required=True, type=options.SCENE)
@options.allow_outside
@options.reporting
def command(scenes, allow_outside, progress):
    """Check bundles and scenes, byte for byte.

    SCENE is a bundle, a scene.json, or - for a scene on stdin; what a scene names is checked as well.

    \b
    Example:
      fusedrf validate scene.json fused.rfpack
    """
    found = [(path, _problem(path, allow_outside)) for path in scenes]
    problems = [problem for _, problem in found if problem is not None]
    files = [
        {"path": path, "valid": not problem, "problem": problem and str(problem)} for path, problem in found
    ]
    report = {"valid": not problems, "files": files}
    if problems:
        raise _verdict(problems, report)
    return report


def _verdict(problems: list[FormatError], report: dict) -> InvalidInput:
    """One error for all; its exit code is that of the first problem."""
    count = len(report["files"])
    many = f"{len(problems)} of {count} files are not valid; see the report"
    sentence = str(problems[0]) if count == 1 else many
    verdict = InvalidInput(sentence, report=report)
    verdict.exit_code = problems[0].exit_code
    return verdict


def _problem(path: str, allow_outside: bool) -> FormatError | None:
    try:
        _check(path, allow_outside, set())
    except FormatError as error:
        return error
    return None


def _check(path: str, allow_outside: bool, seen: set[str]) -> None:
    """Raise what is wrong with `path` or a file it names; each file is read once."""
    from formats.scene import inline_scenes, resolve_source

    seen.add(os.path.realpath(path))
    scene = inline_scenes(_scene(path), path, allow_outside)
    for leaf in scene.leaves():
        if leaf.source is not None:
            target = resolve_source(path, leaf.source, allow_outside)
            if os.path.realpath(target) not in seen:
                _check(str(target), allow_outside, seen)


def _scene(path: str):
    """The scene at `path`; of a bundle every array and checksum is read as well."""
    from formats.bundle import OpenBundle, is_bundle
    from formats.scene import read_scene

    if path == options.STDIO:
        return options.stdin_scene()[0]
    if not is_bundle(path):
        return read_scene(path)
    bundle = OpenBundle(path)
    for member in bundle.headers:  # one at a time is in memory
        bundle.field(member)
    return bundle.scene
