"""What a bundle was before it was edited: kept, bounded, given back to the byte, and not believed blindly."""

import os

import numpy as np
import pytest

from formats import undo as undoing
from formats.bundle import sha256_of
from formats.errors import BadSchema, FormatError, MissingFile, ResourceError
from formats.records import FieldRecord
from formats.undo import check_history_folder, history, history_folder, keep, undo
from tests.bundles import write_single


def write(path, value: int, *entries) -> bytes:
    """A bundle of one field of a value; its bytes."""
    record = FieldRecord(
        "vm", {"planes": np.full((3, 2, 4, 4), value, np.float32)}, {"aabb": [0] * 3 + [1] * 3}
    )
    write_single(path, record, "one", history=entries, overwrite=True)
    return path.read_bytes()


def edited(path, value: int, *entries, onto=None, **how) -> tuple[bytes, tuple]:
    """The bundle after an edit that keeps what was; its bytes and its history."""
    onto = onto or path
    entry = {"event": "moved", "names": [], "nodes": [], "before": keep(path, onto, **how)}
    return write(onto, value, *entries, entry), (*entries, entry)


def test_edits_are_undone_one_after_the_other_to_the_byte(tmp_path):
    path = tmp_path / "one.rfpack"
    was, entries = [write(path, 0)], ()
    for value in (1, 2, 3):
        data, entries = edited(path, value, *entries)
        was.append(data)
    assert history(path)["undoable"] == 3
    for left in (2, 1, 0):
        said = undo(path, path)
        assert path.read_bytes() == was[left]
        assert (said["more"], said["undone"]) == (left, "moved")
    with pytest.raises(BadSchema, match="not edited since it was made"):
        undo(path, path)
    write(path, 1, {"event": "fused"}, {"event": "added"})
    with pytest.raises(BadSchema, match="was not kept; edit with --undoable"):
        undo(path, path)


def test_a_chain_over_several_files_can_be_undone(tmp_path):
    """Each output knows all that came before, and shares its bytes with the files that are there."""
    a, b, c, back, start = (tmp_path / f"{name}.rfpack" for name in ("a", "b", "c", "back", "start"))
    first = write(a, 0)
    second, entries = edited(a, 1, onto=b)
    edited(b, 2, *entries, onto=c)
    assert sum(os.path.samefile(a, one) for one in history_folder(c).iterdir()) == 1
    undo(c, back)
    assert back.read_bytes() == second
    undo(back, start)
    assert start.read_bytes() == first


def test_where_nothing_can_be_linked_bytes_are_copied(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError("no links here")

    monkeypatch.setattr(undoing.os, "link", refuse)
    path = tmp_path / "one.rfpack"
    was = write(path, 0)
    edited(path, 1)
    undo(path, path)
    assert path.read_bytes() == was


def test_the_oldest_go(tmp_path):
    path = tmp_path / "one.rfpack"
    write(path, 0)
    entries = ()
    for value in range(1, 7):
        os.utime(path, (value, value))
        _, entries = edited(path, value, *entries, most=3)
    assert len(list(history_folder(path).iterdir())) == 3 and history(path)["undoable"] == 3


@pytest.mark.parametrize("harm", ["gone", "another"])
def test_what_is_not_there_as_it_was_is_not_given_back(tmp_path, harm):
    path = tmp_path / "one.rfpack"
    write(path, 0)
    edited(path, 1)
    (kept,) = history_folder(path).iterdir()
    kept.unlink()
    if harm == "another":
        kept.write_bytes(b"another")
    now = path.read_bytes()
    with pytest.raises(MissingFile, match="is not there as it was"):
        undo(path, path)
    assert path.read_bytes() == now


@pytest.mark.parametrize("said", ["../../secret", "a" * 63, 7, None, ["a"], "A" * 64])
def test_a_history_cannot_name_another_file(tmp_path, said):
    path = tmp_path / "one.rfpack"
    write(path, 0, {"event": "moved", "before": said})
    with pytest.raises(BadSchema, match="was not kept"):
        undo(path, path)


@pytest.mark.parametrize("entry", [{}, {"names": 3}, {"nodes": [4, {"name": 5}]}, {"event": None}])
def test_odd_histories_are_listed(tmp_path, entry):
    path = tmp_path / "one.rfpack"
    write(path, 0, entry)
    assert history(path)["history"][0]["objects"] == []


def test_what_others_put_there_stays_and_what_was_just_kept_too(tmp_path):
    """Files beside it that are newer, a user's own bundle, and one that only looks like ours."""
    path, folder = tmp_path / "one.rfpack", tmp_path / "one.rfpack.history"
    folder.mkdir()
    for i in range(4):
        write(folder / f"mine{i}.rfpack", 100 + i)
    write(folder / f"{'a' * 64}.rfpack", 200)
    (folder / "notes.txt").write_text("mine")
    mine = {place: place.read_bytes() for place in folder.iterdir()}
    for place in mine:
        os.utime(place, (2**31, 2**31))
    write(path, 0)
    os.utime(path, (0, 0))
    entries = ()
    for value in range(1, 6):
        _, entries = edited(path, value, *entries, most=2)
        os.utime(path, (0, 0))
        assert history(path)["undoable"] == min(value, 2)
    assert all(place.read_bytes() == data for place, data in mine.items())
    assert len(list(folder.iterdir())) == len(mine) + 2


def test_what_another_bundle_left_goes_first(tmp_path):
    """Of an output that was replaced by something else: its own edits stay, however old their files."""
    path = tmp_path / "one.rfpack"
    write(path, 50)
    edited(path, 51, most=2)
    entries = ()
    write(path, 0)
    for value in (1, 2):
        os.utime(path, (0, 0))
        _, entries = edited(path, value, *entries, most=2)
    assert history(path)["undoable"] == 2 and len(list(history_folder(path).iterdir())) == 2


@pytest.mark.parametrize("linked", [True, False])
def test_what_is_kept_is_on_the_disk(tmp_path, monkeypatch, linked):
    """P3: the file before its name in the folder, and the folder's own name."""
    flushed = []
    real = os.fsync
    monkeypatch.setattr(os, "fsync", lambda fd: (flushed.append(os.fstat(fd).st_ino), real(fd)))
    if not linked:
        monkeypatch.setattr(undoing.os, "link", lambda *_: (_ for _ in ()).throw(OSError()))
    path = tmp_path / "one.rfpack"
    write(path, 0)
    flushed.clear()
    keep(path, path)
    (kept,) = history_folder(path).iterdir()
    where = [place.stat().st_ino for place in (kept, history_folder(path), tmp_path)]
    assert set(where) <= set(flushed) and flushed[-1] == where[1]


@pytest.mark.parametrize("harm", ["a file", "a dangling link", "no permission"])
def test_a_folder_that_cannot_keep_is_found_before(tmp_path, monkeypatch, harm):
    """P6."""
    path = tmp_path / "one.rfpack"
    write(path, 0)
    if harm == "a file":
        history_folder(path).touch()
    elif harm == "a dangling link":
        history_folder(path).symlink_to("nowhere")
    else:
        history_folder(path).mkdir()
        monkeypatch.setattr(os, "access", lambda place, _: place != history_folder(path))
    with pytest.raises(ResourceError, match="--undoable"):
        check_history_folder(path, path)


def test_a_file_in_the_place_of_what_is_to_be_kept_is_told(tmp_path):
    path = tmp_path / "one.rfpack"
    write(path, 0)
    history_folder(path).mkdir()
    (history_folder(path) / f"{sha256_of(path)}.rfpack").write_text("mine")
    with pytest.raises(ResourceError, match="something else than its name says"):
        keep(path, path)


def test_a_scene_has_none(tmp_path):
    (tmp_path / "scene.json").write_text("{}")
    for act in (lambda path: undo(path, tmp_path / "out"), history):
        with pytest.raises(FormatError, match="not a bundle"):
            act(tmp_path / "scene.json")
