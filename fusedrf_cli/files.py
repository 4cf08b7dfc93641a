"""Verbs that read and write files alone: nothing is computed, and nothing slow is loaded."""

import os
import sys
from pathlib import Path

from formats import undo as past
from formats.bundle import OpenBundle, is_bundle, read_summary, summary_of
from formats.errors import FormatError
from formats.overview import overview
from formats.scene import (
    MAX_SCENE_BYTES,
    Node,
    SceneGraph,
    dump_scene,
    is_scene,
    make_node,
    parse_scene,
    read_scene,
    write_scene,
)
from formats.sources import inline_scenes, resolve_source
from fusedrf_cli import __version__
from fusedrf_cli.errors import InvalidInput
from fusedrf_cli.placement import common_up, lying_note
from fusedrf_cli.request_parts import STDIO
from fusedrf_cli.requests import (
    ComposeRequest,
    HistoryRequest,
    InfoRequest,
    Input,
    UndoRequest,
    ValidateRequest,
)

# --- compose ------------------------------------------------------------------------------------------------


def compose(request: ComposeRequest, progress) -> dict:
    """Write the scene graph of the inputs; their names are relative to its folder. The graph itself goes to
    stdout where the output is "-", and the report is empty then."""
    inputs = [Input(path=entry) if isinstance(entry, str) else entry for entry in request.inputs]
    summaries = [read_summary(entry.path) for entry in inputs]
    named = zip(inputs, _names(inputs), strict=True)
    nodes = tuple(_node(entry, name, request) for entry, name in named)
    ups, placed = [summary["up"] for summary in summaries], [node.node_to_parent for node in nodes]
    up = common_up(ups, placed)
    scene = SceneGraph(nodes, request.composition, generator=f"fusedrf {__version__}", up=up)
    inline_scenes(scene, request.output, request.allow_outside)
    if up is None:
        lying = map(lying_note, (entry.path for entry in inputs), ups, placed)
        for note in filter(None, dict.fromkeys(lying)):
            progress.warn(note)
    if request.output == STDIO:
        sys.stdout.buffer.write(dump_scene(scene))
        sys.stdout.flush()
        return {}
    write_scene(request.output, scene, overwrite=request.overwrite)
    return {
        "output": request.output,
        "bytes": os.path.getsize(request.output),
        "nodes": [
            {"name": node.name, "source": node.source, "source_bytes": summary["bytes"]}
            for node, summary in zip(nodes, summaries, strict=True)
        ],
    }


def _node(entry: Input, name: str, request: ComposeRequest) -> Node:
    source = _relative(entry.path, request.output)
    resolve_source(request.output, source, request.allow_outside, name)
    shown = {key: getattr(entry, key) for key in ("crop", "opacity", "tint")}
    showing = {key: value for key, value in shown.items() if value is not None}
    showing |= {"visible": False} if entry.hidden else {}
    background = entry.background_node
    return make_node(name, source=source, background=background, showing=showing, **entry.words)


def _names(inputs: list[Input]) -> list[str]:
    """A name for each input: the one given, else the file's stem, numbered where that is taken."""
    used = {entry.name for entry in inputs if entry.name is not None}
    names = []
    for entry in inputs:
        stem, count, name = Path(entry.path).stem, 1, entry.name
        while name is None:
            candidate = stem if count == 1 else f"{stem}-{count}"
            name, count = (None if candidate in used else candidate), count + 1
        used.add(name)
        names.append(name)
    return names


def _relative(path: str, output: str) -> str:
    """`path` as the scene at `output` names it. Links are resolved, as from a link `..` leads elsewhere."""
    folder = os.path.realpath(os.path.dirname(output))
    real = os.path.join(os.path.realpath(os.path.dirname(path)), os.path.basename(path))
    return Path(os.path.relpath(real, folder)).as_posix()


# --- info, history and undo ---------------------------------------------------------------------------------


def info(request: InfoRequest, progress) -> dict:
    """What is in a bundle or a scene, without decoding arrays, or what `train` would read."""
    if request.scene == STDIO:
        scene, size = _stdin_scene()
        return summary_of(scene, STDIO, size) | {"notes": _notes(scene, "standard input")}
    summary = overview(request.scene) or read_summary(request.scene)
    if summary["format"] == "scene":
        summary |= {"notes": _notes(read_scene(request.scene), request.scene)}
    return summary


def _notes(scene: SceneGraph, path: str) -> list[str]:
    """What of a plain scene no command would take."""
    notes = [] if scene.leaves() else [f"{path}: the scene places nothing; give a node a 'source'"]
    for leaf in scene.leaves():
        try:
            target = resolve_source(path, leaf.source, node=leaf.name)
        except FormatError as error:
            notes.append(str(error))
        else:
            if not (is_bundle(target) or is_scene(target)):
                where = f"{path}: node {leaf.name!r}: source {leaf.source!r}"
                notes.append(f"{where} is no bundle and no scene; train it to a .rfpack first")
    return notes


def history(request: HistoryRequest, progress) -> dict:
    """What was done to a bundle."""
    return past.history(request.fused)


def undo(request: UndoRequest, progress) -> dict:
    """Write the bytes that a bundle had before its last edit."""
    return past.undo(request.fused, request.output)


def _stdin_scene() -> tuple[SceneGraph, int]:
    """The scene graph on stdin, and its bytes; sources in it are relative to the current folder."""
    data = sys.stdin.buffer.read(MAX_SCENE_BYTES + 1)
    return parse_scene(data, "standard input"), len(data)


# --- validate -----------------------------------------------------------------------------------------------


def validate(request: ValidateRequest, progress) -> dict:
    """Check every byte of bundles, and of scenes and all that they name. Raises InvalidInput, which carries
    the report, where one is not valid."""
    problems = [_problem(path, request.allow_outside) for path in request.scenes]
    files = [
        {"path": path, "valid": not problem, "problem": problem and str(problem)}
        for path, problem in zip(request.scenes, problems, strict=True)
    ]
    wrong = [problem for problem in problems if problem is not None]
    report = {"valid": not wrong, "files": files}
    if wrong:
        raise _verdict(wrong, report)
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
    seen.add(os.path.realpath(path))
    scene = inline_scenes(_scene(path), path, allow_outside)
    for leaf in scene.leaves():
        if leaf.source is not None:
            target = resolve_source(path, leaf.source, allow_outside, leaf.name)
            if os.path.realpath(target) not in seen:
                _check(str(target), allow_outside, seen)


def _scene(path: str) -> SceneGraph:
    """The scene at `path`; of a bundle every array and checksum is read as well."""
    if path == STDIO:
        return _stdin_scene()[0]
    if not is_bundle(path):
        return read_scene(path)
    bundle = OpenBundle(path)
    for member in bundle.headers:  # one at a time is in memory
        bundle.field(member)
    return bundle.scene
