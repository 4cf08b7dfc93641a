"""The outer layer: readable by any ZIP tool, aligned, and of one possible shape only."""

import io
import zipfile

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats import errors
from formats.archive import ALIGNMENT, MAX_MEMBERS, parse_archive, read_archive, write_archive

names = st.from_regex(r"[a-z0-9_]{1,90}(\.[a-z]{1,3})?", fullmatch=True)


def archive(*members: tuple[str, bytes]) -> bytes:
    file = io.BytesIO()
    write_archive(file, members)
    return file.getvalue()


def contents(data: bytes) -> dict[str, bytes]:
    return {name: bytes(view) for name, view in parse_archive(memoryview(data), "here").items()}


@settings(max_examples=60, deadline=None)
@given(st.dictionaries(names, st.binary(max_size=200), min_size=1, max_size=5))
def test_round_trip_and_any_zip_tool_agrees(members):
    data = archive(*members.items())
    assert contents(data) == members and archive(*members.items()) == data
    with zipfile.ZipFile(io.BytesIO(data)) as theirs:
        assert theirs.testzip() is None
        assert {info.filename: theirs.read(info) for info in theirs.infolist()} == members
        assert all(info.compress_type == zipfile.ZIP_STORED for info in theirs.infolist())


@given(st.integers(1, 140))
def test_data_is_aligned_whatever_the_name(length):
    data = archive(("a" * length, b"first payload"), ("b" * length, b"second payload"))
    assert data.index(b"first payload") % ALIGNMENT == data.index(b"second payload") % ALIGNMENT == 0


def test_files_are_mapped(tmp_path):
    (tmp_path / "a").write_bytes(archive(("x", b"123")))
    assert bytes(read_archive(tmp_path / "a")["x"]) == b"123"


ONE = archive(("x", b"123"))
TWICE = archive(("x", b"123"), ("y", b"456")).replace(b"y", b"x")


def other_tool(**settings) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", **settings) as theirs:
        theirs.writestr("x", b"123" * 100)
    return file.getvalue()


REFUSED = {
    "empty": (b"", errors.NotABundle),
    "picture": (b"\x89PNG" + ONE, errors.NotABundle),
    "magic alone": (ONE[:4], errors.TruncatedBundle),
    "added to": (ONE + b"\0", errors.TruncatedBundle),
    "second archive": (ONE + ONE, errors.TruncatedBundle),
    "gap": (ONE[:67] + b"\0" + ONE[67:], errors.TruncatedBundle),
    "comment": (ONE[:-2] + b"\1\0c", errors.TruncatedBundle),
    "no members": (ONE[:4] + b"PK\5\6" + bytes(18), errors.LimitExceeded),
    "many members": (
        ONE[:-14] + (MAX_MEMBERS + 1).to_bytes(2, "little") * 2 + ONE[-10:],
        errors.LimitExceeded,
    ),
    "name twice": (TWICE, errors.BadHeader),
    "path": (ONE.replace(b"x", b"/"), errors.BadHeader),
    "compressed": (other_tool(compression=zipfile.ZIP_DEFLATED), errors.BadHeader),
    "unaligned": (other_tool(), errors.TruncatedBundle),
    "data": (ONE.replace(b"123", b"124"), errors.ChecksumMismatch),
}


@pytest.mark.parametrize(("data", "error"), REFUSED.values(), ids=REFUSED)
def test_refused(data, error, tmp_path):
    (tmp_path / "a").write_bytes(data)
    for read in (lambda: parse_archive(memoryview(data), "here"), lambda: read_archive(tmp_path / "a")):
        with pytest.raises(error) as caught:
            read()
        assert type(caught.value) is error and str(caught.value).isprintable()


def test_gap_that_the_end_record_knows_of():
    data = bytearray(ONE[:67] + b"\0" + ONE[67:])
    begin = int.from_bytes(data[-6:-2], "little") + 1
    data[-6:-2] = begin.to_bytes(4, "little")
    with pytest.raises(errors.BadHeader, match="1 stray bytes"):
        contents(bytes(data))


def test_sizes_are_judged_before_they_are_believed(tmp_path):
    """P14."""
    with open(tmp_path / "sparse", "wb") as file:
        file.write(ONE[:4])
        file.truncate(1 << 40)
    with pytest.raises(errors.LimitExceeded, match="4 GiB"):
        read_archive(tmp_path / "sparse")


class Endless(bytes):
    def __len__(self):
        return 2**32


def test_a_bundle_beyond_4_gib_is_not_begun():
    file = io.BytesIO()
    with pytest.raises(errors.LimitExceeded, match="--max-size"):
        write_archive(file, [("x", Endless())])
    assert file.getvalue() == b""
