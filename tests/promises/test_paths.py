"""Nothing outside of a scene's folder is opened, whatever a pack or scene names."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from formats.errors import BadSchema
from formats.history import check_history
from formats.scene import SceneGraph, dump_scene, make_node
from formats.sources import resolve_source
from tests.formats.test_scene import OUTSIDE
from tests.promises.packs import GOLDEN, write_generation

ROOT = Path(__file__).parents[2]
# Runs a command line, and tells every path that was opened meanwhile, and whether to write.
WATCHED = """
import json, os, sys
from fusedrf_cli.main import cli
import fusedrf_cli.commands.validate, fusedrf_cli.commands.info, formats.bundle, formats.scene, formats.locks
opened = []
def hook(event, words):
    if event == "open" and isinstance(words[0], (str, bytes)):
        writing = bool((words[2] or 0) & (os.O_WRONLY | os.O_RDWR))
        opened.append((os.fsdecode(os.path.realpath(words[0])), writing))
    elif event.split(".")[0] in ("os", "shutil") and event != "os.listdir" and event != "os.scandir":
        opened.append((event, True))
sys.addaudithook(hook)
try:
    cli.main(sys.argv[1:])
except SystemExit as done:
    print(json.dumps({"code": done.code, "opened": opened}), file=sys.stderr)
"""
CORPUS = [*OUTSIDE, "pipe", "zero", "loop", "bundle/../../secret.rfpack", "./../secret.rfpack", "a\u2215b"]


@pytest.fixture
def folder(tmp_path):
    """scene/, where links lead out of it, beside secret packs that nobody may read."""
    inside = tmp_path / "scene"
    inside.mkdir()
    (tmp_path / "scene-evil").mkdir()
    for path in ("secret.rfpack", "scene-evil/a.rfpack", "scene/a.rfpack"):
        write_generation(tmp_path / path, 1)
    (inside / "link").symlink_to(tmp_path / "scene-evil")
    (inside / "link.rfpack").symlink_to(tmp_path / "scene-evil" / "a.rfpack")
    (inside / "zero").symlink_to("/dev/zero")
    (inside / "loop").symlink_to("loop")
    os.mkfifo(inside / "pipe")
    return inside


def run(*words) -> dict:
    """Exit code, opened paths and stderr of a command line."""
    done = subprocess.run(
        [sys.executable, "-c", WATCHED, *map(str, words)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=300,
    )
    *said, report = done.stderr.splitlines()
    return {**json.loads(report), "said": said}


def scene_of(folder: Path, source: str) -> Path:
    path = folder / "scene.json"
    path.write_bytes(dump_scene(SceneGraph((make_node("n", source=source),))))
    return path


def paths_outside(report: dict, folder: Path) -> list[str]:
    """Paths opened beside the folder, or opened to write."""
    near = [(path, writing) for path, writing in report["opened"] if path.startswith(str(folder.parent))]
    return [path for path, writing in near if writing or not Path(path).is_relative_to(folder)]


@pytest.mark.parametrize("source", CORPUS)
def test_a_source_that_leads_out_is_refused_unopened(folder, source):
    """P9: judged as a name, and through links; pipes and devices are not waited for."""
    report = run("validate", scene_of(folder, source))
    assert report["code"] == 3 and paths_outside(report, folder) == [], report
    assert "/dev/zero" not in dict(report["opened"]) and len(report["said"]) == 1


@pytest.mark.parametrize("source", ["../secret.rfpack", "link.rfpack"])
def test_without_the_judgement_it_is_opened(folder, source):
    """P9 with its defence removed, as users may: --allow-outside."""
    report = run("validate", scene_of(folder, source), "--allow-outside")
    assert report["code"] == 0 and paths_outside(report, folder)


def test_names_within_a_pack_are_no_paths(folder):
    """P9: a pack's members are looked up in it, and nowhere else; nothing is written."""
    report = run("validate", GOLDEN / "pair.rfpack")
    assert report["code"] == 0
    paths = [path for path, _ in report["opened"] if path.endswith(".rfpack")]
    assert set(paths) == {str(GOLDEN / "pair.rfpack")} and not any(writing for _, writing in report["opened"])


def test_a_hard_link_is_a_file_like_any_other(folder):
    """P9: de-duplicated and content-addressed stores are full of them, and whoever can make one could read
    the file. Refusing them would break honest users and stop nobody.
    """
    os.link(folder.parent / "secret.rfpack", folder / "hard.rfpack")
    assert resolve_source(folder / "scene.json", "hard.rfpack") == folder / "hard.rfpack"


@pytest.mark.parametrize("source", ["../secret.rfpack", "/etc/passwd", "a\0b", "x" * 5000, "\u202e"])
def test_a_history_cannot_send_an_edit_outside(folder, source, monkeypatch):
    """P9: edits look for the sources that a history names, where these lie inside alone."""
    from fusedrf_cli.bridge import sources

    def opened(path, _):
        assert path.is_relative_to(folder), "a file outside was read"

    monkeypatch.setattr(sources, "unchanged", opened)
    node = {"source": source, "sha256": "0" * 64, "field": "f"}
    try:
        assert sources.source_bundle(node, folder / "fused.rfpack", False, None) is None
    except ValueError:
        assert not source.isprintable()  # such a history is refused before; see below


@pytest.mark.parametrize(
    "nodes",
    [[1], "x", [{}], [{"name": "a"}], [{"name": 1, "aabb": []}], None]
    + [
        [{"name": "a", "aabb": [0, 0, 0, 1, 1, 1], "field": "f", "object_to_world": matrix, "source": source}]
        for matrix, source in (
            ([[0, 0, 0, 0]] * 4, "a"),
            ([[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]], "a\0b"),
        )
    ],
)
def test_a_history_of_another_shape_is_refused(nodes):
    """P9, P12: the format leaves a history free; an edit says what it cannot use."""
    scene = SceneGraph((), history=({"event": "fused", "nodes": nodes},))
    with pytest.raises(BadSchema, match="history is malformed"):
        check_history(scene, "a.rfpack")


@pytest.mark.parametrize("sources", [[1], "x", {"f": 1}, {"f": {}}, {"f": {"field": "g", "source": "a\0b"}}])
def test_sources_of_another_shape_are_refused(sources):
    """P9, P12: as above, of what a history says that fields were made of."""
    scene = SceneGraph((), history=({"event": "fused", "sources": sources},))
    with pytest.raises(BadSchema, match="history is malformed"):
        check_history(scene, "a.rfpack")
