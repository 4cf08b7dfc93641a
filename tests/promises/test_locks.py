"""Readers and writers of one pack at the same time, and edits that wait for each other."""

import contextlib
import itertools
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import pytest
from click.testing import CliRunner

from formats.bundle import read_bundle
from formats.errors import FormatWarning, ResourceError
from formats.locks import ENDING, output_lock, temporary_folder
from fusedrf_cli.main import cli
from tests.promises.packs import GOLDEN, generation_of, write_generation

ROOT = Path(__file__).parents[2]
PACKS = (sys.executable, "-m", "tests.promises.packs")
# A writer that has no rename: it writes where readers look.
IN_PLACE = """
import contextlib, sys
import formats.bundle
from tests.promises.packs import keep_writing
@contextlib.contextmanager
def in_place(path, **_):
    with open(path, "wb") as file:
        yield file
formats.bundle.atomic_writer = in_place
keep_writing(sys.argv[1])
"""
# `add` with a bridge that reads the pack, is at work for a moment, and writes it back with one node more.
EDITING = """
import dataclasses, sys, time, types
from formats.bundle import BundleWriter, read_bundle
from formats.scene import make_node
def add(request, progress):
    fused, output = request.fused, request.output
    bundle = read_bundle(fused)
    time.sleep(0.02)
    scene = dataclasses.replace(bundle.scene, nodes=(*bundle.scene.nodes, make_node(request.name)))
    writer = BundleWriter()
    for member in bundle.fields:
        writer.copy_field(fused, member)
    writer.write(output, scene, overwrite=True)
    return {}
import fusedrf_cli
fusedrf_cli.bridge = sys.modules["fusedrf_cli.bridge"] = types.SimpleNamespace(add=add)
"""
UNLOCKED = """
import contextlib, formats.locks
formats.locks.output_lock = lambda *_: contextlib.nullcontext()
"""
# A command that holds its output, half written, until it is ended.
HOLDING = """
import sys, time, types
from formats.atomic import atomic_writer
def train(request, progress):
    with atomic_writer(request.output) as file:
        file.write(b"half")
        print("ready", flush=True)
        time.sleep(60)
import fusedrf_cli
fusedrf_cli.bridge = sys.modules["fusedrf_cli.bridge"] = types.SimpleNamespace(train=train)
"""
MAIN = "from fusedrf_cli.main import main; main()"


@contextlib.contextmanager
def running(*words, **options):
    process = subprocess.Popen(words, cwd=ROOT, text=True, stdout=subprocess.PIPE, **options)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


# --- readers ------------------------------------------------------------------------------------------------


def readers_beside(path: Path, writer: tuple, count: int, opens: int) -> tuple[int, int]:
    """(readers that failed, generations that the others saw) of `count` readers beside a writer."""
    write_generation(path, 1)
    words = (*PACKS, "read", str(path), str(opens))
    with running(*writer, str(path)), contextlib.ExitStack() as stack:
        readers = [stack.enter_context(running(*words, stderr=subprocess.DEVNULL)) for _ in range(count)]
        outputs = [reader.communicate(timeout=600)[0] for reader in readers]
    return sum(reader.returncode != 0 for reader in readers), sum(int(text or 0) for text in outputs)


@pytest.mark.parametrize(
    ("count", "opens"), [(4, 150), pytest.param(8, 1000, marks=pytest.mark.slow)], ids=["few", "many"]
)
def test_readers_beside_a_writer_each_see_one_whole_generation(tmp_path, count, opens):
    """P7."""
    failed, seen = readers_beside(tmp_path / "out", (*PACKS, "write"), count, opens)
    assert failed == 0 and seen > 2 * count


def test_readers_beside_a_writer_in_place_fail(tmp_path):
    """P7 with its defence removed."""
    failed, _ = readers_beside(tmp_path / "out", (sys.executable, "-c", IN_PLACE), 3, 2000)
    assert failed > 0


# --- edits --------------------------------------------------------------------------------------------------


def edited(path: Path, code: str, count: int) -> tuple[set[str], list[str]]:
    """(names of the nodes in the end, what was said on stderr) after `count` adds in place at once."""
    write_generation(path, 1)
    with contextlib.ExitStack() as stack:
        edits = [
            stack.enter_context(
                running(
                    *(sys.executable, "-c", code + MAIN, "add", path, path, "--name", f"new-{i}"),
                    *("-w", "-q", "-o", path),
                    stderr=subprocess.PIPE,
                )
            )
            for i in range(count)
        ]
        messages = [edit.communicate(timeout=300)[1] for edit in edits]
    assert [edit.returncode for edit in edits] == [0] * count, messages
    return {node.name for node in read_bundle(path).scene.nodes if node.name.startswith("new-")}, messages


def test_sixteen_edits_at_once_are_all_there(tmp_path):
    """P8."""
    found, messages = edited(tmp_path / "out", EDITING, 16)
    assert len(found) == 16 and os.listdir(tmp_path) == ["out"]
    assert all(text == "" or "waiting for another fusedrf" in text for text in messages)


def test_without_the_lock_edits_are_lost(tmp_path):
    """P8 with its defence removed."""
    found, _ = edited(tmp_path / "out", EDITING + UNLOCKED, 6)
    assert len(found) < 6


@pytest.fixture
def held(tmp_path):
    """A `train` that holds out.rfpack in `tmp_path`."""
    write_generation(tmp_path / "photos", 1)
    words = ("train", str(tmp_path / "photos"), "-o", str(tmp_path / "out.rfpack"))
    with running(sys.executable, "-c", HOLDING + MAIN, *words) as process:
        assert process.stdout.readline() == "ready\n"
        yield process


def second(folder: Path, code: str) -> tuple[int, str]:
    """(exit code, stderr) of another `train` to the same output."""
    words = ("train", str(folder / "photos"), "-w", "-o", str(folder / "out.rfpack"))
    run = subprocess.run([sys.executable, "-c", code, *words], cwd=ROOT, capture_output=True, text=True)
    return run.returncode, run.stderr


QUICK = HOLDING.replace('print("ready", flush=True)', "return {}") + MAIN


def test_a_second_writer_to_one_output_is_refused_at_once(tmp_path, held):
    """P8: it would only be overwritten, so it does not wait."""
    code, said = second(tmp_path, QUICK)
    assert code == 5 and "another fusedrf is writing it" in said
    assert not (tmp_path / "out.rfpack").exists() and held.poll() is None


def test_without_the_lock_a_second_writer_goes_ahead(tmp_path, held):
    """P8 with its defence removed."""
    assert second(tmp_path, UNLOCKED + QUICK)[0] == 0
    assert (tmp_path / "out.rfpack").read_bytes() == b"half"


def test_a_killed_holder_is_no_hindrance_and_its_remains_go(tmp_path, held):
    """P8: the lock ends with its holder, and the next one removes the temporary."""
    held.send_signal(signal.SIGKILL)
    held.wait()
    hidden = [name for name in os.listdir(tmp_path) if name.startswith(".")]
    assert len(hidden) == 2 and f".out.rfpack.{ENDING}" in hidden
    assert second(tmp_path, QUICK)[0] == 0
    assert sorted(os.listdir(tmp_path)) == ["out.rfpack", "photos"]


def test_remains_of_other_outputs_stay(tmp_path):
    """P8: only what its own killed writers left is removed by a writer."""
    others = [f".out2.{'0' * 12}.tmp", f".out.{'0' * 11}.tmp", ".out.tmp", "out.tmp", f".out.{'g' * 12}.tmp"]
    for name in (*others, f".out.{'0' * 12}.tmp", f".out.{'0' * 12}.old"):
        (tmp_path / name).touch()
    with output_lock(tmp_path / "out"):
        pass
    assert sorted(os.listdir(tmp_path)) == sorted([*others, f".out.{'0' * 12}.old"])
    (tmp_path / "out").touch()
    with output_lock(tmp_path / "out"):
        assert sorted(os.listdir(tmp_path)) == sorted([*others, "out", f".out.{ENDING}"])


def test_a_file_system_without_locks_warns_and_goes_on(tmp_path, monkeypatch):
    """P8, where it cannot be kept."""
    import fcntl

    def none(*_):
        raise OSError(38, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", none)
    with pytest.warns(FormatWarning, match="no locks"), output_lock(tmp_path / "out"):
        pass


def test_a_lock_of_another_user_is_a_sentence(tmp_path, monkeypatch):
    import filelock

    def denied(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(filelock.FileLock, "acquire", denied)
    with pytest.raises(ResourceError, match="belongs to another user"), output_lock(tmp_path / "out"):
        pass


def test_a_pack_that_was_edited_says_so_in_one_generation(tmp_path):
    """P7: the size and content that `info` reports are of one file, even if it is replaced meanwhile."""
    path = tmp_path / "out"
    write_generation(path, 1)
    code = (
        "import json, sys\nimport formats.bundle as b\nfrom tests.promises.packs import write_generation\n"
        "real = b._scene_summary\n"
        "def late(*words):\n    write_generation(sys.argv[1], 2, numbers=9000)\n    return real(*words)\n"
        "b._scene_summary = late\nprint(json.dumps(b.read_summary(sys.argv[1])))\n"
    )
    size = path.stat().st_size
    run = subprocess.run(
        [sys.executable, "-c", code, path], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert json.loads(run.stdout)["bytes"] == size and generation_of(path) == 2


# --- temporary folders --------------------------------------------------------------------------------------

HOLDING_A_FOLDER = """
import sys
from formats.locks import temporary_folder
with temporary_folder("fusedrf-poses-") as folder:
    print(folder, flush=True)
    sys.stdin.read()
"""


def test_temporary_folders_of_killed_processes_are_removed_and_those_of_others_not(tmp_path, monkeypatch):
    """P2: whoever lives holds a lock on its folder."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    environment = os.environ | {"TMPDIR": str(tmp_path)}
    words = [sys.executable, "-c", HOLDING_A_FOLDER]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with (
        subprocess.Popen(words, cwd=ROOT, env=environment, **pipes) as killed,
        subprocess.Popen(words, cwd=ROOT, env=environment, **pipes) as living,
    ):
        dead, alive = (Path(process.stdout.readline().strip()) for process in (killed, living))
        killed.kill()
        killed.wait()
        (tmp_path / "fusedrf-poses-file").write_text("mine")
        (tmp_path / "fusedrf-poses-link").symlink_to(tmp_path)
        assert dead.is_dir()
        with temporary_folder("fusedrf-poses-") as own:
            assert own.is_dir() and alive.is_dir() and not dead.exists()
        assert not own.exists() and (tmp_path / "fusedrf-poses-link").is_symlink()
        living.stdin.close()
        living.wait()
        assert not alive.exists()


@pytest.mark.slow
def test_a_render_shows_the_version_that_it_opened(tmp_path):
    """P7: by the command itself, while other versions take the name again and again."""
    path, stop = tmp_path / "pack.rfpack", threading.Event()
    versions = [(GOLDEN / name).read_bytes() for name in ("ring.rfpack", "pair.rfpack", "coded-8.rfpack")]

    def replace_on_and_on():
        for turn in itertools.count():
            if stop.is_set():
                return
            (tmp_path / "other").write_bytes(versions[turn % len(versions)])
            os.replace(tmp_path / "other", path)

    path.write_bytes(versions[0])
    writer = threading.Thread(target=replace_on_and_on)
    writer.start()
    try:
        words = "render", str(path), "-o", str(tmp_path / "out.png"), "--size", "8x8", "-w", "--threads", "1"
        results = [CliRunner().invoke(cli, words) for _ in range(8)]
    finally:
        stop.set()
        writer.join()
    assert [result.exit_code for result in results] == [0] * 8, [result.stderr for result in results]
