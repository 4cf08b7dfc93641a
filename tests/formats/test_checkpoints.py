"""Checkpoints come back as they were, or not at all and with a sentence."""

import hashlib
import json

import numpy as np
import pytest

from formats.checkpoints import MAGIC, VERSION, read_checkpoint, write_checkpoint
from formats.errors import BadHeader, FormatError, MissingFile, NewerVersion, NotAFile, OlderVersion

ARRAYS = {
    "params": np.arange(6, dtype=np.float32).reshape(2, 3),
    "seen": np.array([True, False]),
    "none": np.zeros((0, 2)),
}
STATE = {"command": "train", "mse": float("inf"), "name": "Süd"}


@pytest.fixture
def path(tmp_path):
    write_checkpoint(tmp_path / "c", ARRAYS, STATE)
    return tmp_path / "c"


def test_what_was_written_comes_back(path):
    arrays, state = read_checkpoint(path)
    assert state == STATE and arrays.keys() == ARRAYS.keys()
    for name, array in ARRAYS.items():
        assert arrays[name].dtype == array.dtype and np.array_equal(arrays[name], array)


def test_every_flipped_bit_and_every_length_is_noticed(path):
    data = path.read_bytes()
    damaged = [
        data[:i] + bytes([data[i] ^ 1 << bit]) + data[i + 1 :] for i in range(len(data)) for bit in range(8)
    ]
    damaged += [data[:i] for i in range(len(data))] + [data + b"\0", data * 2]
    for content in damaged:
        path.write_bytes(content)
        with pytest.raises(FormatError) as caught:
            read_checkpoint(path)
        assert caught.value.exit_code == 3


def sealed(header: object, rest: bytes = b"", length: int | None = None) -> bytes:
    """A file with a valid checksum, whatever its header says."""
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    data = MAGIC + (len(text) if length is None else length).to_bytes(8, "little") + text + rest
    return data + hashlib.sha256(data).digest()


def of(*arrays, **words) -> bytes:
    return sealed({"version": VERSION, "state": {}, "arrays": list(arrays)} | words)


@pytest.mark.parametrize(
    "content",
    [
        *(sealed({}), sealed([]), sealed(b"{"), sealed(b"[" * 100_000), sealed({}, length=1 << 62)),
        *(of(state=3), of(arrays=3), of(3), of(["a", "<f4"]), of([1, "<f4", []]), of(["a", 7, [1]])),
        *(of(["a", "<f4", [1 << 62]]), of(["a", "<f4", [-1]]), of(["a", "|O8", [1]]), of(["a", "<f4", 1])),
        *(of(["a", "<f4", [0] * 64]), of(["a", "<f4", [.5]]), of(["a", "<f4", [True]]), sealed({}, b"more")),
    ],
)  # fmt: skip
def test_hostile_headers_are_refused_by_a_sentence(path, content):
    """Whoever can compute a checksum can write any header."""
    path.write_bytes(content)
    with pytest.raises(BadHeader, match="run without --resume"):
        read_checkpoint(path)


def test_other_versions_are_told(path):
    for version, error in ((VERSION + 1, NewerVersion), (VERSION - 1, OlderVersion)):
        path.write_bytes(sealed({"version": version}))
        with pytest.raises(error, match=f"version {version}"):
            read_checkpoint(path)
    path.write_bytes((2).to_bytes(8, "little") + b'{"__metadata__":{}}')
    with pytest.raises(OlderVersion, match="no checksum"):
        read_checkpoint(path)


def test_what_is_no_file_is_not_waited_for(tmp_path):
    import os

    os.mkfifo(tmp_path / "pipe")
    for name, kind in (("pipe", NotAFile), ("", NotAFile), ("nowhere", MissingFile)):
        with pytest.raises(kind):
            read_checkpoint(tmp_path / name)
