"""The verbs of fusedrf. Each takes what its request says (requests.py), in order or by keyword, checks it and
its outputs before any work, writes its output whole or not at all, and returns its report, a JSON-able dict.
`progress` is told of what goes on; `settings` are in force meanwhile (engine/settings.py).

Nothing slow is imported until a verb needs it.
"""

import contextlib
import functools
import importlib
import inspect
import os
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import msgspec

from fusedrf_cli import requests
from fusedrf_cli.engine.settings import using
from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.progress import NullProgress
from fusedrf_cli.request_parts import STDIO, ending_of
from fusedrf_cli.requests import EditRequest, Writing

__all__ = [
    *("pose", "train", "import_field", "compose", "fuse", "convert", "add", "delete", "move", "duplicate"),
    *("rename", "replace", "crop", "tint", "extract", "history", "undo"),
    *("render", "eval", "chart", "info", "kinds", "validate"),
]


def verb(name: str, request: type, does: str = "", module: str = "bridge") -> Callable[..., dict]:
    """The verb of a name, which hands a request to a function of a module of this package, by default of that
    name."""
    signature = inspect.signature(request)
    # keywords that are still taken by the names that they had in the version before
    earlier = {"rgb": "finetune", "naive": "reference", "direction": "view_from", "keep_history": "undoable"}

    def run(
        *words: Any, progress: NullProgress | None = None, settings: Sequence = (), **options: Any
    ) -> dict:
        options = {earlier.get(name, name): value for name, value in options.items()}
        checked_request = checked(request, signature.bind(*words, **options).arguments)
        progress = progress or NullProgress()
        held = (
            locked_outputs(checked_request, progress)
            if isinstance(checked_request, Writing)
            else contextlib.nullcontext()
        )
        with held, using(*settings):
            work = getattr(importlib.import_module(f"fusedrf_cli.{module}"), does or name)
            report = work(checked_request, progress)
        return report and {**report, "warnings": report.get("warnings", progress.warnings)}

    how = {"progress": None, "settings": ()}
    how = [
        inspect.Parameter(word, inspect.Parameter.KEYWORD_ONLY, default=value) for word, value in how.items()
    ]
    run.__signature__ = signature.replace(parameters=[*signature.parameters.values(), *how])
    run.__name__ = run.__qualname__ = name
    run.__doc__ = request.__doc__
    return run


def checked(request: type, words: dict[str, Any]):
    """The request of those words. Raises UsageProblem for a value that is none of its kind."""
    try:
        return msgspec.convert({name: _plain(value) for name, value in words.items()}, request)
    except msgspec.ValidationError as error:
        what, _, where = str(error).partition(" - at `$.")
        raise UsageProblem(f"{where.rstrip('`')}: {what}" if where else what) from error


def _plain(value: Any) -> Any:
    """Paths as text, and arrays as lists."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    if isinstance(value, list | tuple):
        return [_plain(part) for part in value]
    return value.tolist() if hasattr(value, "tolist") else value


@contextlib.contextmanager
def locked_outputs(request: Writing, progress: NullProgress) -> Iterator[None]:
    """A block in which nobody else writes the outputs. An output that is in the way, cannot be written, or is
    being written is refused before any work, and so are those beside it. An edit in place waits instead, and
    reads only then: no edit is lost."""
    if request.stdout and request.output == STDIO:
        yield
        return
    from formats.atomic import check_writable
    from formats.locks import output_lock

    if not request.folders:
        _check_no_other_ending(request)
    others = request.beside()
    outputs = {request.output: request.folders} | others
    if len({os.path.realpath(path) for path in outputs}) <= len(others):
        raise UsageProblem(f"{request.output}: two outputs go there; give them different names")
    for path, folder in outputs.items():
        if folder:
            _check_ending(path, request.endings if path == request.output else ())
    edited = getattr(request, "fused", None)
    in_place = edited is not None and os.path.realpath(edited) == os.path.realpath(request.output)
    check_all = functools.partial(_check_all, check_writable, outputs, request.overwrite)
    with contextlib.ExitStack() as locks:
        check_all()
        for path in outputs:
            waiting = progress.tell if in_place and path == request.output else None
            locks.enter_context(output_lock(path, waiting))
        check_all()  # one may have come while we waited
        if isinstance(request, EditRequest) and request.undoable:
            from formats.undo import check_history_folder

            check_history_folder(edited, request.output)
        yield


def _check_ending(path: str, endings: Sequence[str]) -> None:
    """UsageProblem where a name is that of a file of a kind that is not written."""
    ending = ending_of(path)
    if ending and ending not in endings:
        files = f"give a name that ends in {', '.join(endings)}, or" if endings else "give"
        raise UsageProblem(
            f"{path}: no {ending} is written; {files} a folder, whose name has no ending, or ends in a slash"
        )


OF_OTHERS = frozenset(
    ".png .jpg .jpeg .webp .gif .mp4 .ply .obj .glb .gltf .stl .off .splat .spz .sog .ksplat "
    ".ckpt .pth .pt .th .tar .npz .ingp .msgpack".split()
)
"""Endings that bundles and scenes never have."""


def _check_no_other_ending(request: Writing) -> None:
    """UsageProblem where a bundle or a scene would have the name of something else."""
    ending, usual = ending_of(request.output), ".json" if request.stdout else ".rfpack"
    if ending in OF_OTHERS:
        raise UsageProblem(
            f"{request.output}: what is written is no {ending} file; give another name, such as NAME{usual}"
        )


def _check_all(check: Callable, outputs: dict[str, bool], overwrite: bool) -> None:
    for path, folder in outputs.items():
        check(path, overwrite, folders=folder)


pose = verb("pose", requests.PoseRequest)
train = verb("train", requests.TrainRequest)
import_field = verb("import_field", requests.ImportRequest)
compose = verb("compose", requests.ComposeRequest, module="files")
fuse = verb("fuse", requests.FuseRequest)
convert = verb("convert", requests.ConvertRequest)
add = verb("add", requests.AddRequest)
delete = verb("delete", requests.DeleteRequest)
move = verb("move", requests.MoveRequest)
duplicate = verb("duplicate", requests.DuplicateRequest)
rename = verb("rename", requests.RenameRequest)
replace = verb("replace", requests.ReplaceRequest)
crop = verb("crop", requests.CropRequest, does="show")
tint = verb("tint", requests.TintRequest, does="show")
extract = verb("extract", requests.ExtractRequest)
history = verb("history", requests.HistoryRequest, module="files")
undo = verb("undo", requests.UndoRequest, module="files")
render = verb("render", requests.RenderRequest)
eval = verb("eval", requests.EvaluateRequest, does="evaluate")
chart = verb("chart", requests.ChartRequest)
info = verb("info", requests.InfoRequest, module="files")
kinds = verb("kinds", requests.KindsRequest, does="list_kinds")
validate = verb("validate", requests.ValidateRequest, module="files")
