"""A folder with two small bundles, a way to run a command line in it, and a bridge that only takes notes."""

import dataclasses
import subprocess
import sys
import types
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result

import fusedrf_cli
from formats.records import FieldRecord
from fusedrf_cli.main import cli
from tests.bundles import write_single

ROOT = Path(__file__).parents[2]
BRIDGE_VERBS = (
    *("pose", "train", "import_field", "fuse", "convert", "add", "delete", "move", "duplicate", "rename"),
    "render",
    *("evaluate", "chart", "extract", "replace", "show"),
)


def names_of(request) -> list[str]:
    """What a request is made of."""
    return [field.name for field in dataclasses.fields(request)]


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """The current folder, holding chair.rfpack and table.rfpack."""
    for value, name in enumerate(("chair", "table"), 1):
        arrays = {"planes": np.full((3, 2, 4, 4), value, np.float32)}
        record = FieldRecord("vm", arrays, {"aabb": [-1, -1, -1, 1, 1, 2]})
        write_single(tmp_path / f"{name}.rfpack", record, name)
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def run(folder):
    """run("info", "chair.rfpack") -> click's Result, in `folder`."""

    def run(*words: str, stdin: str | bytes | None = None) -> Result:
        return CliRunner().invoke(cli, words, input=stdin)

    return run


@pytest.fixture
def bridge(monkeypatch) -> types.ModuleType:
    """A bridge whose verbs return `bridge.report` (or raise `bridge.error`) and leave `bridge.call`."""
    stub = types.ModuleType("fusedrf_cli.bridge")
    stub.report, stub.error, stub.call = {}, None, None

    def verb(name):
        def note(request, progress):
            words = {word: getattr(request, word) for word in names_of(request)}
            stub.call, stub.request = (name, words), request
            if stub.error is not None:
                raise stub.error
            return stub.report

        return note

    for name in BRIDGE_VERBS:
        setattr(stub, name, verb(name))
    stub.list_kinds = lambda request, progress: stub.report
    monkeypatch.setitem(sys.modules, "fusedrf_cli.bridge", stub)
    monkeypatch.setattr(fusedrf_cli, "bridge", stub, raising=False)
    return stub


@pytest.fixture
def process(folder):
    """process(code, *words) -> a started Python process that runs `code` in `folder`, all streams pipes. It
    hears an interrupt, also where these tests run in the background of a script, which ignores it."""
    hears = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler)"
    started = []

    def start(code: str, *words: str, **options) -> subprocess.Popen:
        pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE, **options}
        code = f"{hears}\nimport sys; sys.path.insert(0, {str(ROOT)!r})\n{code}"
        started.append(subprocess.Popen([sys.executable, "-c", code, *words], text=True, **pipes))
        return started[-1]

    yield start
    for running in started:
        running.kill()
        with running:  # waits, and closes the pipes
            pass
