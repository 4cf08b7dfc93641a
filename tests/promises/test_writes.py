"""What a write leaves behind, whatever fails in it and whenever: the old output, or the new one."""

import contextlib
import errno
import os
import resource
import shutil
import stat
import subprocess
import sys
import tempfile
from pathlib import Path
from types import SimpleNamespace

import pytest

from formats import atomic
from formats.atomic import atomic_folder, check_space, check_writable, remove_leftovers
from formats.bundle import BundleWriter, read_bundle
from formats.errors import ResourceError
from formats.scene import make_node
from tests.promises.calls import At, watched
from tests.promises.packs import generation_of, write_generation

ROOT = Path(__file__).parents[2]
CODES = (errno.ENOSPC, errno.EIO)


def names(folder: Path) -> list[str]:
    return sorted(os.listdir(folder))


def content(folder: Path) -> dict[str, bytes]:
    return {place.name: place.read_bytes() for place in folder.iterdir()}


def write_views(path: Path, number: int) -> None:
    with atomic_folder(path, overwrite=True) as folder:
        for name in ("a.png", "b.png"):
            with atomic.atomic_writer(folder / name) as file:
                file.write(b"%d" % number)


def views_of(path: Path) -> int:
    found = content(path)
    assert names(path) == ["a.png", "b.png"] and len(set(found.values())) == 1
    return int(found["a.png"])


OUTPUTS = {"pack": (write_generation, generation_of), "folder": (write_views, views_of)}


@pytest.fixture(params=OUTPUTS)
def output(request, tmp_path):
    """(path, write, number): an output that says 1, a way to write it anew, and to read what it says."""
    write, number = OUTPUTS[request.param]
    write(tmp_path / "out", 1)
    return tmp_path / "out", write, number


def each_failing(path: Path, write, number) -> tuple[int, list[str]]:
    """Fail every call of a write in turn, with each error; how many, and what was wrong afterwards."""
    k, wrong = 0, []
    while True:
        k += 1
        for code in CODES:

            def fail(code=code):
                raise OSError(code, os.strerror(code))

            at = At(k, fail)
            with watched(at), contextlib.suppress(OSError, ResourceError):
                write(path, 2)
            if at.count < k:
                return k - 1, wrong
            try:
                if (
                    number(path) == 2
                ):  # what failed then is the removal of the old, which the next writer does
                    remove_leftovers(path)
                elif number(path) != 1:
                    wrong.append(f"call {k}: it says {number(path)}")
            except Exception as error:
                wrong.append(f"call {k}: {error!r}")
            if names(path.parent) != ["out"]:
                wrong.append(f"call {k}: {names(path.parent)}")
            shutil.rmtree(path) if path.is_dir() else path.unlink()
            write(path, 1)


def test_any_failing_call_leaves_old_or_new_and_no_temporary(output):
    """P2, P5."""
    calls, wrong = each_failing(*output)
    assert calls > 10 and wrong == []


def test_without_the_clean_up_a_temporary_stays(output, monkeypatch):
    """P5 with its defence removed."""
    monkeypatch.setattr(Path, "unlink", lambda *_, **__: None)
    monkeypatch.setattr(shutil, "rmtree", lambda *_, **__: None)
    path, write, _ = output

    def fail():
        raise OSError(errno.ENOSPC, "full")

    with watched(At(4, fail)), pytest.raises((OSError, ResourceError)):
        write(path, 2)
    assert names(path.parent) != ["out"]


def test_a_system_that_cannot_exchange_brings_the_old_folder_back(tmp_path, monkeypatch):
    """P2, where folders take two renames."""
    monkeypatch.setattr(atomic, "_exchange", lambda *_: False)
    write_views(tmp_path / "out", 1)
    calls, wrong = each_failing(tmp_path / "out", write_views, views_of)
    assert calls > 10 and wrong == []


# --- power loss ---------------------------------------------------------------------------------------------


class Disk:
    """What a disk may hold if the power fails after any call: only what was flushed is sure to be there."""

    def __init__(self):
        self.dirty: set[int] = set()
        self.unsure = False
        self.risks: list[str] = []

    def before(self, name: str, *words) -> None:
        if name == "write":
            self.dirty.add(os.fstat(words[0]).st_ino)
        elif name == "fsync":
            self.dirty.discard(os.fstat(words[0]).st_ino)
            self.unsure &= not stat.S_ISDIR(os.fstat(words[0]).st_mode)
        elif name in ("replace", "exchange"):
            inside = [Path(words[0]), *Path(words[0]).rglob("*")]
            if self.dirty & {place.stat().st_ino for place in inside}:
                self.risks.append("a name may outlive its content")
            self.unsure = True

    def after(self) -> list[str]:
        return self.risks + ["a finished write may be lost"] * self.unsure


def risks(path: Path, write) -> list[str]:
    disk = Disk()
    with watched(disk.before):
        write(path, 2)
    return disk.after()


def test_content_is_on_the_disk_before_its_name_and_the_name_before_the_end(output):
    """P3."""
    path, write, _ = output
    assert risks(path, write) == []


@pytest.mark.parametrize(
    ("kept", "risk"), [(stat.S_ISDIR, "a name may outlive its content"), (stat.S_ISREG, "a finished write")]
)
def test_without_a_flush_the_power_may_fail_at_the_wrong_moment(output, monkeypatch, kept, risk):
    """P3 with its defence removed: files, or folders, are not flushed."""
    path, write, _ = output
    real = os.fsync
    disk = Disk()

    def forgetful(name, *words):
        if name != "fsync" or kept(os.fstat(words[0]).st_mode):
            disk.before(name, *words)

    with watched(forgetful):
        write(path, 2)
    assert os.fsync is real and any(found.startswith(risk) for found in disk.after())


def test_files_that_a_folder_was_given_unflushed_are_flushed(tmp_path):
    """P3: whoever fills the folder need not know."""

    def write(path, number):
        with atomic_folder(path, overwrite=True) as folder:
            with atomic.open(folder / "a", "wb") as file:
                file.write(b"x")

    write_views(tmp_path / "out", 1)
    assert risks(tmp_path / "out", write) == []


@pytest.mark.skipif(shutil.which("strace") is None, reason="strace is not installed")
def test_the_kernel_sees_the_same_order(tmp_path):
    """P3, as the system calls of a process tell it."""
    code = (
        f"from tests.promises.packs import write_generation; write_generation({str(tmp_path / 'out')!r}, 1)"
    )
    words = ["strace", "-f", "-y", "-o", tmp_path / "trace", "-e", "trace=fsync,rename,renameat,renameat2"]
    run = subprocess.run([*words, sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    if run.returncode and "ptrace" in run.stderr:
        pytest.skip("tracing is not permitted here")
    assert run.returncode == 0, run.stderr
    lines = [line for line in (tmp_path / "trace").read_text().splitlines() if str(tmp_path) in line]
    assert [line.split("(")[0].split()[-1] for line in lines] == ["fsync", "rename", "fsync"]
    assert ".tmp>" in lines[0] and f"<{tmp_path}>" in lines[2]


# --- full and forbidden places ------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 1 MB, or a skip where none may be mounted."""
    place = tmp_path / "small"
    place.mkdir()
    words = ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", place]
    if (
        not hasattr(os, "geteuid")
        or os.geteuid() != 0
        or subprocess.run(words, capture_output=True).returncode
    ):
        pytest.skip("mounting is not permitted here")
    yield place
    subprocess.run(["umount", place], check=True)


def test_a_full_disk_keeps_the_old_pack(small_disk):
    """P5."""
    write_generation(small_disk / "out", 1)
    with pytest.raises(ResourceError, match="disk is full") as caught:
        write_generation(small_disk / "out", 2, numbers=300_000)
    assert caught.value.exit_code == 5
    assert generation_of(small_disk / "out") == 1 and names(small_disk) == ["out"]


def test_the_space_is_claimed_before_anything_is_written(small_disk):
    """P5: with the claim no byte reaches a disk that is too small; without it the disk fills first."""
    written = []

    def before(name, *words):
        if name == "write":
            written.append(words)

    for reserving in (True, False):
        with pytest.MonkeyPatch.context() as patch, watched(before), pytest.raises(ResourceError):
            if not reserving:
                patch.setattr(atomic, "_reserve", lambda *_: None)
            write_generation(small_disk / "out", 2, numbers=300_000)
        assert bool(written) != reserving


def test_a_file_size_limit_keeps_the_old_pack(tmp_path):
    """P5, where nothing can be mounted: exit 5, old pack, no temporary."""
    write_generation(tmp_path / "out", 1)
    old = (tmp_path / "out").read_bytes()
    code = (
        "import resource, sys\nresource.setrlimit(resource.RLIMIT_FSIZE, (9000, 9000))\n"
        "from formats.errors import ResourceError\nfrom tests.promises.packs import write_generation\n"
        f"try:\n    write_generation({str(tmp_path / 'out')!r}, 2)\n"
        "except ResourceError as error:\n    sys.exit(error.exit_code)\n"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 5
    assert (tmp_path / "out").read_bytes() == old and names(tmp_path) == ["out"]


def test_space_is_looked_at_before_work(tmp_path, monkeypatch):
    """P5."""
    check_space(tmp_path / "out", 1000)
    monkeypatch.setattr(atomic.shutil, "disk_usage", lambda _: SimpleNamespace(free=999))
    with pytest.raises(ResourceError, match="needs 1,000 bytes, but the disk has 999 left") as caught:
        check_space(tmp_path / "out", 1000)
    assert caught.value.exit_code == 5


COMMAND = "import sys\nfrom fusedrf_cli.main import main\nmain()"
# All is imported before: the interpreter's own folders may be closed to others.
AS_NOBODY = (
    "import difflib, os, sys\nimport formats.locks, fusedrf_cli.commands.train\n"
    "import fusedrf_cli.engine.kinds.registry\n"
    "from fusedrf_cli.main import main\nos.setuid(65534)\nmain()"
)


def test_a_read_only_place_is_refused_before_work():
    """P6: a folder without write permission, as a user who is not root."""
    root = os.geteuid() == 0
    with tempfile.TemporaryDirectory() as folder:  # pytest's own is closed to other users
        locked = Path(folder) / "locked"
        locked.mkdir()
        write_generation(f"{folder}/a.rfpack", 1)
        Path(folder).chmod(0o755)
        locked.chmod(0o555)
        # `train` of what is no capture at all: the place is judged before the input is looked at.
        words = [AS_NOBODY if root else COMMAND, "train", f"{folder}/a.rfpack", "-o", f"{locked}/out.rfpack"]
        run = subprocess.run([sys.executable, "-c", *words], cwd=ROOT, capture_output=True, text=True)
        assert run.returncode == 5 and "cannot write in" in run.stderr and run.stderr.count("\n") == 1
        assert names(locked) == []


def test_a_read_only_mount_is_refused_before_work_even_for_root(small_disk):
    """P6."""
    write_generation(small_disk / "out", 1)
    subprocess.run(["mount", "-o", "remount,ro", small_disk], check=True)
    with pytest.raises(ResourceError, match="cannot write in") as caught:
        check_writable(small_disk / "out", overwrite=True)
    assert caught.value.exit_code == 5 and generation_of(small_disk / "out") == 1


def test_without_looking_first_the_refusal_comes_after_the_work(tmp_path, monkeypatch):
    """P6 with its defence removed: the writer is what finds out."""
    monkeypatch.setattr(os, "access", lambda *_: True)
    check_writable(tmp_path / "out", overwrite=False)
    at = At(1, lambda: (_ for _ in ()).throw(PermissionError(errno.EACCES, "no")))
    with watched(at), pytest.raises(ResourceError, match="permission is missing"):
        write_generation(tmp_path / "out", 1)


@pytest.mark.parametrize("kind", ["pipe", "folder"])
def test_what_is_no_file_is_refused_before_work(tmp_path, kind):
    """P6: a pipe, a device or a folder where a pack should go is not replaced, with -w either."""
    os.mkfifo(tmp_path / "out") if kind == "pipe" else (tmp_path / "out").mkdir()
    with pytest.raises(ResourceError, match="in the way"):
        check_writable(tmp_path / "out", overwrite=True)
    with pytest.raises(ResourceError, match="in the way"):
        check_writable("/dev/null", overwrite=True)


# --- over its own input -------------------------------------------------------------------------------------


@pytest.mark.parametrize("linked", [False, True])
def test_saving_over_its_own_input_is_safe(tmp_path, linked):
    """P10: arrays still mapped from the file that is replaced stay whole; a link keeps pointing."""
    path = tmp_path / "out"
    write_generation(tmp_path / "real" if linked else path, 7)
    if linked:
        path.symlink_to("real")
    before = read_bundle(path)
    writer = BundleWriter()
    nodes = [make_node(f"n{i}", field=writer.copy_field(path, name)) for i, name in enumerate(before.fields)]
    writer.write(path, type(before.scene)(tuple(nodes), history=before.scene.history), overwrite=True)
    assert generation_of(path) == 7 and path.is_symlink() == linked
    assert list(read_bundle(path).fields) == list(before.fields)


def test_writing_in_place_spoils_what_is_still_being_read(tmp_path):
    """P10 with its defence removed."""
    write_generation(tmp_path / "out", 7)

    @contextlib.contextmanager
    def in_place(path, **_):
        with open(path, "r+b") as file:
            file.truncate(4096)
            yield file

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("formats.bundle.atomic_writer", in_place)
        with pytest.raises(OSError):
            patch.setattr("formats.bundle.write_archive", lambda *_: (_ for _ in ()).throw(OSError("no")))
            write_generation(tmp_path / "out", 8)
    with pytest.raises(Exception, match="copy it again|copy the file again"):
        generation_of(tmp_path / "out")


@pytest.mark.parametrize("kind", OUTPUTS)
@pytest.mark.parametrize("mode", [0o640, 0o755])
def test_replaced_outputs_keep_their_mode(tmp_path, kind, mode):
    """P11, of packs and of folders."""
    write, _ = OUTPUTS[kind]
    write(tmp_path / "out", 1)
    (tmp_path / "out").chmod(mode | 0o700)
    write(tmp_path / "out", 2)
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) == mode | 0o700


def test_a_folder_in_the_place_of_a_file_can_be_entered(tmp_path):
    """P11: a file's mode is none for a folder."""
    (tmp_path / "out").touch(0o600)
    write_views(tmp_path / "out", 2)
    assert (
        stat.S_IMODE((tmp_path / "out").stat().st_mode) & 0o700 == 0o700 and views_of(tmp_path / "out") == 2
    )


@pytest.mark.parametrize("kind", OUTPUTS)
def test_without_care_for_the_mode_it_is_lost(tmp_path, kind, monkeypatch):
    """P11 with its defence removed."""
    write, _ = OUTPUTS[kind]
    write(tmp_path / "out", 1)
    (tmp_path / "out").chmod(0o700)
    monkeypatch.setattr(atomic, "_keep_mode", lambda *_: None)
    write(tmp_path / "out", 2)
    assert stat.S_IMODE((tmp_path / "out").stat().st_mode) != 0o700


def test_names_as_long_as_a_file_may_have(tmp_path):
    """P2: the temporary's name fits beside the longest output's."""
    for name in ("x" * 255, "日" * 85):
        write_generation(tmp_path / name, 1)
        assert generation_of(tmp_path / name) == 1
    assert len(names(tmp_path)) == 2


def test_limits_of_the_process_are_left_alone():
    """The tests above set theirs in processes of their own."""
    assert resource.getrlimit(resource.RLIMIT_FSIZE)[0] == resource.RLIM_INFINITY
