"""MessagePack files: nlohmann's binaries, flax's arrays, gzip, and what may not be in them."""

import gzip
import struct
import tracemalloc

import msgpack
import numpy as np
import pytest

from formats.errors import BadCheckpoint, FormatError, LimitExceeded
from formats.foreign import msgpack_file
from formats.foreign.msgpack_file import read_msgpack
from tests.formats.foreign.samples import flax_array, flax_checkpoint, snapshot


@pytest.mark.parametrize("pack", [bytes, lambda data: gzip.compress(data)], ids=["msgpack", "ingp"])
def test_a_snapshot_comes_back(pack, tmp_path):
    (tmp_path / "a").write_bytes(pack(msgpack.packb(snapshot())))
    read = read_msgpack(tmp_path / "a")
    assert read == snapshot() and type(read["snapshot"]["params_binary"]) is bytes


@pytest.mark.parametrize("dtype", ["float32", "float64", "float16", "int32", "uint8", "bool"])
def test_arrays_of_flax_come_back(dtype, tmp_path):
    arrays = [np.arange(6).astype(dtype).reshape(2, 3), np.array(1, dtype), np.zeros((0, 2), dtype)]
    (tmp_path / "a").write_bytes(msgpack.packb({"a": [flax_array(array) for array in arrays]}))
    for one, other in zip(read_msgpack(tmp_path / "a")["a"], arrays, strict=True):
        assert one.shape == other.shape and one.array().dtype == other.dtype
        np.testing.assert_array_equal(one.array(), other)


def test_numbers_of_flax_come_back(tmp_path):
    (tmp_path / "a").write_bytes(msgpack.packb(flax_checkpoint()))
    alpha = read_msgpack(tmp_path / "a")["nerf_alpha"]
    assert alpha == np.float32(1.5) and isinstance(alpha, np.float32)


def array_of(*parts) -> bytes:
    return msgpack.packb({"a": msgpack.ExtType(1, msgpack.packb(parts))})


HOSTILE = {
    "empty": b"",
    "two values": b"\x80\x80",
    "never used byte": b"\xc1",
    "huge list": b"\xdd\xff\xff\xff\xff",
    "huge map": b"\xdf\xff\xff\xff\xff",
    "huge text": b"\xdb\xff\xff\xff\xff" + b"a",
    "huge binary": b"\xc6\xff\xff\xff\xff" + b"a",
    "huge extension": b"\xc9\xff\xff\xff\xff\1" + b"a",
    "nested lists": b"\x91" * 100_000,
    "nested long lists": b"\xdd\0\0\xff\xff" * 2000,
    "nested maps": b"\x81\xa1a" * 100_000 + b"\1",
    "nested to the limit": b"\x91" * 500 + b"\1",
    "key twice": b"\x82\xa1a\1\xa1a\2",
    "list as a key": b"\x81\x90\1",
    "number as a key": b"\x81\1\1",
    "not UTF-8": b"\xa2\xff\xff",
    "unknown extension": msgpack.packb({"a": msgpack.ExtType(9, b"a")}),
    "extension of a number": array_of()[:2] + msgpack.packb(msgpack.ExtType(1, b"\1")),
    "array without parts": array_of(),
    "array of objects": array_of([1], "object", b"abcdefgh"),
    "array of records": array_of([1], "f4,f4", b"abcdefgh"),
    "array too short": array_of([3], "float32", b"abcdefgh"),
    "array too long": array_of([1], "float32", b"abcdefgh"),
    "huge array": array_of([2**40], "float32", b"abcdefgh"),
    "negative array": array_of([-2], "float32", b"abcdefgh"),
    "array of texts": array_of(["a"], "float32", b"abcdefgh"),
    "array of a list": array_of([2], "float32", [1, 2]),
    "type of a list": array_of([2], ["float32"], b"abcdefgh"),
    "cut gzip": gzip.compress(bytes(1000))[:-9],
    "wrong gzip": gzip.compress(bytes(1000))[:-8] + bytes(8),
    "nothing zipped": gzip.compress(b""),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_files_are_refused(name, tmp_path):
    (tmp_path / "a").write_bytes(HOSTILE[name])
    tracemalloc.start()
    try:
        with pytest.raises(FormatError) as caught:
            read_msgpack(tmp_path / "a")
        assert tracemalloc.get_traced_memory()[1] < 32 << 20
    finally:
        tracemalloc.stop()
    assert str(caught.value).isprintable() and str(tmp_path) in str(caught.value)


def test_many_small_values_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(msgpack_file, "MAX_VALUES", 10_000)
    for data in (b"\xdc\x30\x00" + b"\x90" * 0x3000, b"\xdc\x30\x00" + b"\1" * 0x3000):
        (tmp_path / "a").write_bytes(data)
        with pytest.raises(LimitExceeded, match="more than 10,000 values"):
            read_msgpack(tmp_path / "a")


def test_what_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(msgpack_file, "FREE", 1 << 16)
    (tmp_path / "a").write_bytes(gzip.compress(b"\xc6" + struct.pack(">I", 1 << 24) + bytes(1 << 24)))
    with pytest.raises(LimitExceeded, match="unpacks to more than"):
        read_msgpack(tmp_path / "a")


@pytest.mark.parametrize("content", [snapshot(), flax_checkpoint()])
def test_a_file_cut_short_anywhere_is_refused(content, tmp_path):
    packed = msgpack.packb(content)
    for data in (packed, gzip.compress(packed)):
        for stop in range(0, len(data), max(1, len(data) // 100)):
            (tmp_path / "a").write_bytes(data[:stop])
            with pytest.raises(BadCheckpoint):
                read_msgpack(tmp_path / "a")
