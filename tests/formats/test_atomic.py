"""Outputs appear whole or not at all, whatever fails and wherever."""

import errno
import os
import signal
import stat
import subprocess
import sys
import time

import pytest

from formats import atomic
from formats.atomic import atomic_folder, atomic_writer, check_writable
from formats.errors import OutputExists, ResourceError


def write(path, data: bytes):
    with atomic_writer(path) as file:
        file.write(data)


def failing(code):
    def fail(*args, **kwargs):
        raise OSError(code, os.strerror(code))

    return fail


@pytest.fixture
def old(tmp_path):
    path = tmp_path / "out.bin"
    path.write_bytes(b"old")
    return path


def assert_untouched(old):
    assert old.read_bytes() == b"old"
    assert os.listdir(old.parent) == [old.name]


def test_new_content_replaces_old(old):
    write(old, b"new")
    assert old.read_bytes() == b"new"
    assert os.listdir(old.parent) == [old.name]


@pytest.mark.parametrize("interruption", [ValueError, KeyboardInterrupt, SystemExit])
def test_any_exception_in_the_block_leaves_the_old_file(old, interruption):
    with pytest.raises(interruption), atomic_writer(old) as file:
        file.write(b"half")
        raise interruption
    assert_untouched(old)


@pytest.mark.parametrize("code", [errno.ENOSPC, errno.EDQUOT, errno.EACCES, errno.EROFS])
@pytest.mark.parametrize("call", ["fsync", "replace", "chmod"])
def test_any_failing_call_leaves_the_old_file(old, monkeypatch, call, code):
    """P2, P5."""
    monkeypatch.setattr(atomic.os, call, failing(code))
    with pytest.raises(ResourceError, match="out.bin"):
        write(old, b"new")
    assert_untouched(old)


def test_disk_full_while_writing_leaves_the_old_file(old, monkeypatch):
    """P5."""

    def full_disk(path, mode, **_):
        file = open(path, mode, buffering=0)

        class Full:
            name, flush, fileno = file.name, file.flush, file.fileno
            write = staticmethod(failing(errno.ENOSPC))
            __enter__ = lambda self: self  # noqa: E731
            __exit__ = lambda self, *_: file.close()  # noqa: E731

        return Full()

    monkeypatch.setattr(atomic, "open", full_disk, raising=False)
    with pytest.raises(ResourceError, match="disk is full") as caught:
        write(old, b"new")
    assert caught.value.exit_code == 5
    assert_untouched(old)


def test_an_error_about_another_file_is_not_taken_for_ours(old):
    with pytest.raises(PermissionError), atomic_writer(old):
        raise PermissionError(errno.EACCES, "denied", "/somewhere/else")
    assert_untouched(old)


def test_file_then_rename_then_folder_are_flushed(old, monkeypatch):
    """P3."""
    order = []
    fsync, replace = os.fsync, os.replace

    def traced_fsync(descriptor):
        order.append("folder" if stat.S_ISDIR(os.fstat(descriptor).st_mode) else "file")
        fsync(descriptor)

    def traced_replace(*args):
        order.append("rename")
        replace(*args)

    monkeypatch.setattr(atomic.os, "fsync", traced_fsync)
    monkeypatch.setattr(atomic.os, "replace", traced_replace)
    write(old, b"new")
    assert order == ["file", "rename", "folder"]


@pytest.mark.parametrize(("umask", "mode"), [(0o022, 0o644), (0o077, 0o600), (0o002, 0o664)])
def test_new_files_get_the_mode_of_the_umask(tmp_path, umask, mode):
    """P11."""
    before = os.umask(umask)
    try:
        write(tmp_path / "new", b"")
    finally:
        os.umask(before)
    assert stat.S_IMODE((tmp_path / "new").stat().st_mode) == mode


def test_replaced_files_keep_their_mode(old):
    """P11."""
    old.chmod(0o640)
    write(old, b"new")
    assert stat.S_IMODE(old.stat().st_mode) == 0o640


def test_links_are_written_through(old, tmp_path):
    """P10."""
    link = tmp_path / "link"
    link.symlink_to(old)
    write(link, b"new")
    assert link.is_symlink() and old.read_bytes() == b"new"


def test_text_mode_writes_utf8(tmp_path):
    with atomic_writer(tmp_path / "t", mode="w") as file:
        file.write("σ")
    assert (tmp_path / "t").read_bytes() == "σ".encode()


def test_kill_never_leaves_half_a_file(tmp_path):
    """P2."""
    path = tmp_path / "victim"
    code = (
        "import sys\nfrom formats.atomic import atomic_writer\n"
        "for i in range(10**9):\n"
        "    with atomic_writer(sys.argv[1]) as file:\n"
        "        for _ in range(64): file.write(bytes([i % 256]) * 4096)\n"
    )
    for _ in range(5):
        child = subprocess.Popen([sys.executable, "-c", code, path])
        deadline = time.monotonic() + 20
        while not path.exists() and time.monotonic() < deadline:
            time.sleep(0.005)
        time.sleep(0.02)
        child.send_signal(signal.SIGKILL)
        child.wait()
        data = path.read_bytes()
        assert len(data) == 64 * 4096 and len(set(data)) == 1
        path.unlink()


def test_folder_appears_whole(tmp_path):
    with atomic_folder(tmp_path / "views") as folder:
        (folder / "a.png").write_bytes(b"a")
        assert not (tmp_path / "views").exists()
    assert os.listdir(tmp_path) == ["views"]
    assert (tmp_path / "views" / "a.png").read_bytes() == b"a"


def test_failed_folder_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), atomic_folder(tmp_path / "views") as folder:
        (folder / "a.png").write_bytes(b"a")
        raise KeyboardInterrupt
    assert os.listdir(tmp_path) == []


def test_folder_replaces_an_empty_one_and_a_full_one_only_on_request(tmp_path):
    target = tmp_path / "views"
    target.mkdir()
    for overwrite in (False, True):
        with atomic_folder(target, overwrite=overwrite) as folder:
            (folder / f"{overwrite}").touch()
        assert os.listdir(target) == [f"{overwrite}"]
    with pytest.raises(OutputExists), atomic_folder(target):
        pass
    assert os.listdir(tmp_path) == ["views"] and os.listdir(target) == ["True"]


def test_failed_swap_brings_the_old_folder_back(tmp_path, monkeypatch):
    """P2."""
    target = tmp_path / "views"
    target.mkdir()
    (target / "old").touch()
    replace, calls = os.replace, []

    def second_fails(*args):
        calls.append(args)
        failing(errno.ENOSPC)() if len(calls) == 2 else replace(*args)

    monkeypatch.setattr(atomic.os, "replace", second_fails)
    monkeypatch.setattr(atomic, "_exchange", lambda *_: False)  # a system that cannot
    with pytest.raises(ResourceError), atomic_folder(target, overwrite=True):
        pass
    assert os.listdir(tmp_path) == ["views"] and os.listdir(target) == ["old"]


def test_check_writable(tmp_path, monkeypatch, old):
    """P6."""
    check_writable(tmp_path / "fresh", overwrite=False)
    check_writable(old, overwrite=True)
    with pytest.raises(OutputExists, match="--overwrite") as caught:
        check_writable(old, overwrite=False)
    assert caught.value.exit_code == 1
    with pytest.raises(ResourceError, match="does not exist"):
        check_writable(tmp_path / "no" / "where", overwrite=False)
    monkeypatch.setattr(atomic.os, "access", lambda *_: False)
    with pytest.raises(ResourceError, match="cannot write"):
        check_writable(tmp_path / "fresh", overwrite=False)
