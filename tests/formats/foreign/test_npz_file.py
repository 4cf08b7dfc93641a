"""Numpy's archives come back number for number; no pickle in one is read."""

import io
import zipfile

import numpy as np
import pytest

from formats.errors import BadCheckpoint, ChecksumMismatch, FormatError, LimitExceeded
from formats.foreign import zip_file
from formats.foreign.npz_file import read_npz

GRID = np.arange(24).reshape(2, 3, 4)
TYPES = ("float16", "float32", "float64", "int8", "int32", "int64", "uint8", "uint16", "bool", ">f4", ">i8")


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_every_type_and_layout_comes_back(save, tmp_path):
    arrays = {f"a{n}": GRID.astype(dtype) for n, dtype in enumerate(TYPES)}
    arrays |= {
        "fortran": np.asfortranarray(GRID),
        "scalar": np.array(0.1),
        "empty": GRID[:0],
        "one": GRID[0, 0, :1],
    }
    save(tmp_path / "a.npz", **arrays)
    read = read_npz(tmp_path / "a.npz")
    assert list(read) == list(arrays)
    for name, expected in arrays.items():
        array = read[name].array()
        assert read[name].shape == expected.shape and array.dtype == expected.dtype.newbyteorder("=")
        assert array.flags.c_contiguous and array.flags.writeable
        np.testing.assert_array_equal(array, expected)


@pytest.mark.parametrize(
    "array", [np.array([{}], object), np.array(["a"]), np.zeros(2, "f4,f4"), np.zeros(2, "c8")]
)
def test_only_numbers_are_read(array, tmp_path):
    np.savez(tmp_path / "a.npz", a=array)
    with pytest.raises(BadCheckpoint, match="something else than numbers"):
        read_npz(tmp_path / "a.npz")


def npz(header: str, data: bytes = b"") -> bytes:
    """An archive of one array with any header."""
    text = header.encode("latin-1")
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("a.npy", b"\x93NUMPY\1\0" + len(text).to_bytes(2, "little") + text + data)
    return file.getvalue()


SOUND = "{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }\n"


@pytest.mark.parametrize(
    "header, data",
    [
        (SOUND, bytes(7)),
        (SOUND, bytes(9)),
        (SOUND.replace("(2,)", "(10**12,)"), bytes(8)),
        (SOUND.replace("(2,)", "(1000000000000,)"), bytes(8)),
        (SOUND.replace("(2,)", "(-2, -1)"), bytes(8)),
        (SOUND.replace("(2,)", "(True, 2)"), bytes(8)),
        (SOUND.replace("(2,)", "(0, 9223372036854775807, 9)"), bytes(8)),
        (SOUND.replace("(2,)", "(" + "1," * 70 + ")"), bytes(4)),
        (SOUND.replace("<f4", "|O"), bytes(16)),
        (SOUND.replace("(2,)", "(" * 1000), bytes(8)),
        (SOUND.replace("False", "__import__('os')"), bytes(8)),
        ("{" * 300, b""),
        ("", b""),
        ("\0" * 90, b""),
    ],
)
def test_headers_that_do_not_fit_are_refused(header, data, tmp_path):
    (tmp_path / "a.npz").write_bytes(npz(header, data))
    with pytest.raises(FormatError) as caught:
        read_npz(tmp_path / "a.npz")
    assert str(caught.value).isprintable()


def test_a_sound_header_is_read(tmp_path):
    (tmp_path / "a.npz").write_bytes(npz(SOUND, np.array([1, 2], "<f4").tobytes()))
    assert read_npz(tmp_path / "a.npz")["a"].array().tolist() == [1, 2]


def test_what_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(zip_file, "FREE", 1 << 16)
    np.savez_compressed(tmp_path / "a.npz", a=np.zeros(1 << 20))
    with pytest.raises(LimitExceeded, match="than is believed"):
        read_npz(tmp_path / "a.npz")


def test_damage_is_noticed(tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, a=GRID.astype(np.float32))
    whole = path.read_bytes()
    for stop in range(0, len(whole), max(1, len(whole) // 100)):
        path.write_bytes(whole[:stop])
        with pytest.raises(FormatError):
            read_npz(path)["a"].array()
    at = whole.index(GRID.astype("<f4").tobytes()) + 20
    path.write_bytes(whole[:at] + b"\xff" + whole[at + 1 :])
    with pytest.raises(ChecksumMismatch, match="a.npy is damaged"):
        read_npz(path)["a"].array()
