"""Files that torch.save wrote come back number for number, and nothing else is read from one."""

import io
import pickle
import sys
import tracemalloc
import types
import zipfile
from collections import Counter, OrderedDict

import numpy as np
import pytest
import torch

from formats.errors import BadCheckpoint, ChecksumMismatch, FormatError, LimitExceeded, NeedsCode
from formats.foreign import pickles, torch_file, zip_file
from formats.foreign.stored import StoredTensor
from formats.foreign.torch_file import read_torch
from tests.formats.foreign.samples import torch_zip

DTYPES = ("float16", "float32", "float64", "bfloat16", "bool", "uint8", "int8", "int16", "int32", "int64")
OLD = {"_use_new_zipfile_serialization": False}
FORMATS = pytest.mark.parametrize(
    "options", [{}, OLD, {"pickle_protocol": 4}], ids=["zip", "old", "protocol-4"]
)


def saved(value, path, **options):
    torch.save(value, path, **options)
    return read_torch(path)


# --- round trips --------------------------------------------------------------------------------------------


@FORMATS
@pytest.mark.parametrize("dtype", DTYPES)
def test_every_type_and_layout_of_tensors_comes_back(dtype, options, tmp_path):
    whole = torch.arange(-60, 60).reshape(4, 5, 6).to(getattr(torch, dtype))
    tensors = {
        "whole": whole,
        "transposed": whole.transpose(0, 2),
        "part": whole[1:3, ::2, 3:],
        "column": whole[:, 0, 0],
        "scalar": whole[2, 2, 2],
        "repeated": whole[0, 0, :1].expand(3, 7),
        "empty": whole[:0],
    }
    read = saved(tensors, tmp_path / "a.pth", **options)
    for name, tensor in tensors.items():
        expected = (tensor.float() if dtype == "bfloat16" else tensor).numpy()
        array = read[name].array()
        assert isinstance(read[name], StoredTensor) and read[name].dtype == dtype
        assert read[name].shape == tuple(tensor.shape) and array.dtype == expected.dtype
        assert array.flags.c_contiguous and array.flags.writeable
        np.testing.assert_array_equal(array, expected)


@FORMATS
def test_plain_containers_come_back(options, tmp_path):
    model = torch.nn.Linear(2, 3)
    value = {
        "state": model.state_dict(),  # an OrderedDict with an attribute
        "ordered": OrderedDict(a=1, b=[None, True, False]),
        "counted": Counter({3: 2}),
        "size": model.weight.shape,
        "parameter": model.weight,
        "numbers": (1, -1, 2**40, 2**70, 0.1, float("inf"), "text é", b"bytes"),
        "numpy": [np.float32(1.5), np.float64(0.1), np.int64(-3), np.bool_(True)],
        7: {"nested": [[[{}]]]},
    }
    read = saved(value, tmp_path / "a.pth", **options)
    assert list(read) == list(value)
    assert read["ordered"] == {"a": 1, "b": [None, True, False]} and read["counted"] == {3: 2}
    assert read["size"] == (3, 2) and read["numbers"] == value["numbers"] and read[7] == value[7]
    for one, other in zip(read["numpy"], value["numpy"], strict=True):
        assert one == other and one.dtype == other.dtype
    for array in (read["state"]["weight"].array(), read["parameter"].array()):
        np.testing.assert_array_equal(array, model.weight.detach().numpy())


@FORMATS
@pytest.mark.parametrize("core", ["core", "_core"], ids=["numpy 1", "numpy 2"])
def test_numpy_arrays_come_back(core, options, tmp_path):
    grid = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    arrays = {
        "c": grid,
        "fortran": np.asfortranarray(grid),
        "big": grid.astype(">f8"),
        "bits": np.packbits(grid > 3),
        "mask": grid > 3,
        "none": grid[:0],
        "scalar": np.array(2.5),
    }
    path = tmp_path / "a.pth"
    torch.save(arrays, path, **options)
    if core == "core" and options != {"pickle_protocol": 4}:
        rewrite(path, lambda data: data.replace(b"numpy._core.multiarray", b"numpy.core.multiarray"), options)
    read = read_torch(path)
    for name, array in arrays.items():
        assert read[name].array().dtype == array.dtype.newbyteorder("=")
        np.testing.assert_array_equal(read[name].array(), array)


def rewrite(path, change, options):
    """Change the pickle of a torch file."""
    if options == OLD:
        path.write_bytes(change(path.read_bytes()))
        return
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            archive.writestr(name, change(data) if name.endswith("data.pkl") else data)


@FORMATS
def test_tensors_of_a_gpu_are_read(options, tmp_path):
    path = tmp_path / "a.pth"
    torch.save({"a": torch.arange(5.0)}, path, **options)
    short = options.get("pickle_protocol") == 4
    old, new = (b"\x8c\x03cpu", b"\x8c\x06cuda:0") if short else (b"X\3\0\0\0cpu", b"X\6\0\0\0cuda:0")

    def on_gpu(data):
        assert old in data
        return data.replace(old, new)

    rewrite(path, on_gpu, options)
    np.testing.assert_array_equal(read_torch(path)["a"].array(), np.arange(5.0, dtype=np.float32))


def test_big_endian_files_are_read(tmp_path):
    path = tmp_path / "a.pth"
    torch.save({"a": torch.arange(5.0)}, path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in members.items():
            data = b"big" if name.endswith("byteorder") else data
            swapped = "/data/" in name
            archive.writestr(name, np.frombuffer(data, ">f4").astype("<f4").tobytes() if swapped else data)
    np.testing.assert_array_equal(read_torch(path)["a"].array(), np.arange(5.0))


@FORMATS
@pytest.mark.parametrize("module", ["mmcv.utils.config", "mmengine.config.config"])
def test_a_config_dict_is_a_dict(module, options, tmp_path, monkeypatch):
    class ConfigDict(dict):  # as addict's, whose state is itself
        def __getstate__(self):
            return self

    ConfigDict.__module__, ConfigDict.__qualname__ = module, "ConfigDict"
    made = types.ModuleType(module)
    made.ConfigDict = ConfigDict
    names = module.split(".")
    for n in range(1, len(names)):
        monkeypatch.setitem(sys.modules, ".".join(names[:n]), types.ModuleType(names[n - 1]))
    monkeypatch.setitem(sys.modules, module, made)
    value = {"density_config": ConfigDict(), "k0_config": ConfigDict(n_comp=8, inner=ConfigDict(a=[1]))}
    read = saved(value, tmp_path / "a.tar", **options)
    assert read == {"density_config": {}, "k0_config": {"n_comp": 8, "inner": {"a": [1]}}}
    assert type(read["k0_config"]) is dict


def test_storages_stay_in_the_file_until_they_are_asked_for(tmp_path, monkeypatch):
    torch.save({"a": torch.zeros(1000), "optimizer": torch.zeros(1_000_000)}, tmp_path / "a.pth")
    read = []
    monkeypatch.setattr(
        zip_file.Archive,
        "read",
        lambda self, name, real=zip_file.Archive.read: read.append(name) or real(self, name),
    )
    value = read_torch(tmp_path / "a.pth")
    assert not any("/data/" in name for name in read)
    value["a"].array()
    assert [name for name in read if "/data/" in name] == ["a/data/0"]


def test_compressed_archives_are_read(tmp_path):
    torch.save({"a": torch.arange(1000.0)}, tmp_path / "a.pth")
    with zipfile.ZipFile(tmp_path / "a.pth") as old, zipfile.ZipFile(tmp_path / "b.pth", "w", 8) as new:
        for name in old.namelist():
            new.writestr(name, old.read(name))
    np.testing.assert_array_equal(read_torch(tmp_path / "b.pth")["a"].array(), np.arange(1000.0))


# --- hostile files ------------------------------------------------------------------------------------------


def refused(pickled: bytes, path, *storages: bytes) -> FormatError:
    """The error of a torch file with this pickle, for which little memory was taken."""
    path.write_bytes(torch_zip(pickled, *storages))
    tracemalloc.start()
    try:
        with pytest.raises(FormatError) as caught:
            read_torch(path)
        assert tracemalloc.get_traced_memory()[1] < (32 << 20) + 20 * len(pickled)
    finally:
        tracemalloc.stop()
    assert str(caught.value).isprintable() and str(path) in str(caught.value)
    return caught.value


class Runs:
    """An object whose pickle calls something."""

    def __init__(self, *call):
        self.call = call

    def __reduce__(self):
        return self.call


@pytest.mark.parametrize("protocol", [0, 1, 2, 4, 5])
def test_nothing_is_called(protocol, tmp_path):
    import os

    sign = tmp_path / "sign"
    error = refused(pickle.dumps({"a": Runs(os.system, (f"touch {sign}",))}, protocol), tmp_path / "a.pth")
    assert isinstance(error, NeedsCode) and "needs code to load" in str(error) and not sign.exists()
    if protocol >= 2:
        assert f"{os.system.__module__}.system" in str(error)


@pytest.mark.parametrize(
    "module, name",
    [
        *[("builtins", name) for name in ("eval", "exec", "getattr", "open", "__import__", "dict", "object")],
        *[("torch", name) for name in ("load", "FloatTensor", "nn.Linear", "Tensor", "device")],
        *[("numpy", "load"), ("collections", "namedtuple"), ("_codecs", "decode"), ("os", "system")],
        *[("torch._utils", "_rebuild_device_tensor_from_numpy"), ("torch.storage", "_load_from_bytes")],
        *[("collections.OrderedDict", "fromkeys"), ("collections", "OrderedDict.fromkeys"), ("", "")],
    ],
)
def test_unknown_names_are_refused_and_said(module, name, tmp_path):
    error = refused(f"\x80\x02c{module}\n{name}\n(tR.".encode("latin-1"), tmp_path / "a.pth")
    assert isinstance(error, NeedsCode) and f"{module}.{name}" in str(error)
    stacked = b"\x80\x04" + b"".join(b"\x8c" + bytes([len(t)]) + t.encode() for t in (module, name))
    error = refused(stacked + b"\x93)R.", tmp_path / "a.pth")
    assert isinstance(error, NeedsCode) and f"{module}.{name}" in str(error)


ARRAY = b"cnumpy.core.multiarray\n_reconstruct\n(cnumpy\nndarray\nK\0\x85U\1btR"
FLOAT = b"cnumpy\ndtype\n(X\2\0\0\0f4\x89\x88tR"
STORAGE = b"(X\7\0\0\0storagectorch\nFloatStorage\nX\1\0\0\x000X\3\0\0\0cpu%stQ"
TENSOR = b"ctorch._utils\n_rebuild_tensor_v2\n(" + STORAGE + b"%s%s%s\x89)tR"
BIG = b"\x8a\x08" + (2**62).to_bytes(8, "little")
HOSTILE = {
    "empty": b"",
    "no stop": b"\x80\x02}",
    "two values": b"\x80\x02]].",
    "no value": b"\x80\x02.",
    "object array": ARRAY + b"(K\1K\1\x85cnumpy\ndtype\n(X\2\0\0\0O8\x89\x88tR\x89]tb.",
    "text array": b"cnumpy\ndtype\n(X\2\0\0\0U9\x89\x88tR.",
    "record array": b"cnumpy\ndtype\n(X\5\0\0\0f4,f4\x89\x88tR.",
    "type alone": FLOAT + b".",
    "name alone": b"ctorch\nFloatStorage\n.",
    "storage alone": STORAGE % b"K\1" + b".",
    "list of a name": b"]ctorch\nFloatStorage\na.",
    "array too long": ARRAY + b"(K\1" + BIG + b"\x85" + FLOAT + b"\x89C\4abcdtb.",
    "array too short": ARRAY + b"(K\1K\1\x85" + FLOAT + b"\x89C\x08abcdabcdtb.",
    "array without state": b"]" + ARRAY + b"Nba.",
    "negative array": ARRAY + b"(K\1J\xff\xff\xff\xff\x85" + FLOAT + b"\x89C\0tb.",
    "encoded as something": b"c_codecs\nencode\nX\1\0\0\0aX\3\0\0\0hex\x86R.",
    "dict of a list": b"ccollections\nOrderedDict\n]K\1a\x85R.",
    "state of a number": b"K\1}b.",
    "state of a tuple": b")}b.",
    "call of a number": b"K\1)R.",
    "call of a list": b"ccollections\nOrderedDict\n]R.",
    "appended to a dict": b"}K\1a.",
    "items of a list": b"]K\1K\1s.",
    "odd items": b"}(K\1K\1K\1u.",
    "unhashable key": b"}]K\1s.",
    "tuple as a key": b"})K\1s.",
    "huge key": b"}\x8a\x10" + b"\x7f" * 16 + b"K\1s.",
    "float as a key": b"}G" + bytes(8) + b"K\1s.",
    "mark without end": b"(((((.",
    "tuple without mark": b"t.",
    "below a mark": b"K\1(\x85.",
    "not in the memo": b"h\x07.",
    "huge memo index": b"]r\xff\xff\xff\x7fj\xfe\xff\xff\x7f.",
    "huge text": b"\x8d" + (2**62).to_bytes(8, "little") + b"abc.",
    "huge bytes": b"\x8e" + (2**40).to_bytes(8, "little") + b"abc.",
    "huge bytearray": b"\x96" + (2**40).to_bytes(8, "little") + b"abc.",
    "huge integer": b"\x8b\xff\xff\xff\x7fabc.",
    "long integer": b"\x8a\xff" + b"\x7f" * 255 + b".",
    "text of a number": b"I" + b"9" * 5000 + b"\n.",
    "extension": b"\x82\x01.",
    "instance": b"(ios\nsystem\n.",
    "persistent text": b"P0\n.",
    "persistent number": b"K\1Q.",
    "no such storage": TENSOR.replace(b"\0\x000", b"\0\x009") % (b"K\1", b"K\0", b"K\1\x85", b"K\1\x85")
    + b".",
    "huge storage": TENSOR % (BIG, b"K\0", b"K\1\x85", b"K\1\x85") + b".",
    "storage of a text": TENSOR % (b"X\1\0\0\0a", b"K\0", b"K\1\x85", b"K\1\x85") + b".",
    "offset beyond": TENSOR % (b"K\4", b"K\4", b"K\1\x85", b"K\1\x85") + b".",
    "huge offset": TENSOR % (b"K\4", BIG, b"K\1\x85", b"K\1\x85") + b".",
    "negative offset": TENSOR % (b"K\4", b"J\xff\xff\xff\xff", b"K\1\x85", b"K\1\x85") + b".",
    "size beyond": TENSOR % (b"K\4", b"K\0", b"K\5\x85", b"K\1\x85") + b".",
    "stride beyond": TENSOR % (b"K\4", b"K\0", b"K\2\x85", b"K\4\x85") + b".",
    "negative stride": TENSOR % (b"K\4", b"K\3", b"K\2\x85", b"J\xff\xff\xff\xff\x85") + b".",
    "repeated too often": TENSOR % (b"K\4", b"K\0", BIG + b"\x85", b"K\0\x85") + b".",
    "overflowing sizes": TENSOR % (b"K\4", b"K\0", BIG + BIG + b"\x86", BIG + BIG + b"\x86") + b".",
    "sizes without strides": TENSOR % (b"K\4", b"K\0", b"K\1\x85", b")") + b".",
    "sizes of texts": TENSOR % (b"K\4", b"K\0", b"X\1\0\0\0a\x85", b"K\1\x85") + b".",
    "many dimensions": TENSOR % (b"K\4", b"K\0", b"(" + b"K\1" * 99 + b"t", b"(" + b"K\1" * 99 + b"t") + b".",
    "tensor of nothing": b"ctorch._utils\n_rebuild_tensor_v2\n)R.",
    "parameter of nothing": b"ctorch._utils\n_rebuild_parameter\nN\x88}\x87R.",
    "nested lists": b"]" * 10_000 + b"a" * 9_999 + b".",
    "nested tuples": b")" + b"\x85" * 10_000 + b".",
    "in itself": b"]q\0h\0a.",
    "in its own items": b"}q\0X\1\0\0\0ah\0s.",
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_pickles_are_refused(name, tmp_path):
    refused(b"\x80\x02" * (HOSTILE[name][:1] != b"\x80") + HOSTILE[name], tmp_path / "a.pth", bytes(16))


def test_endless_pickles_are_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(pickles, "MAX_INSTRUCTIONS", 10_000)
    assert isinstance(refused(b"\x80\x02]" + b"K\1a" * 10_000 + b".", tmp_path / "a.pth"), LimitExceeded)


PAIRS = b"](" + b"".join(b"]q\1(X\3\0\0\0%03dK\1e" % n for n in range(900)) + b"e"
SHARED = {
    "texts": (b"X\0\0\1\0" + b"a" * (1 << 16) + b"q\2", b"c_codecs\nencode\nh\2X\6\0\0\0latin1\x86R"),
    "pairs": (PAIRS + b"q\2", b"ccollections\nOrderedDict\nh\2\x85R"),
    "arrays": (
        b"C\0q\3X\0\0\1\0" + b"a" * (1 << 16) + b"q\2",
        ARRAY + b"(K\1M\0\x40\x85" + FLOAT + b"\x89h\2tb",
    ),
    "sizes": (b"](" + b"K\1" * 1000 + b"eq\2", b"ctorch\nSize\nh\2\x85R"),
}


@pytest.mark.parametrize("name", SHARED)
def test_many_values_made_of_one_argument_are_refused(name, tmp_path):
    shared, call = SHARED[name]
    error = refused(b"\x80\x02(" + shared + call * 20_000 + b"t.", tmp_path / "a.pth")
    assert isinstance(error, LimitExceeded)


@pytest.mark.parametrize("wrap", [list, tuple, lambda values: dict(zip("0123456789", values, strict=True))])
def test_shared_containers_do_not_multiply(wrap, tmp_path):
    value = 1
    for _ in range(30):
        value = wrap([value] * 10)
    assert isinstance(refused(pickle.dumps(value, 2), tmp_path / "a.pth"), LimitExceeded)


def test_a_file_cut_short_anywhere_is_refused(tmp_path):
    for options in ({}, OLD):
        whole = io.BytesIO()
        torch.save({"a": torch.arange(300.0), "b": np.arange(30)}, whole, **options)
        data = whole.getvalue()
        for stop in range(0, len(data), max(1, len(data) // 100)):
            (tmp_path / "a.pth").write_bytes(data[:stop])
            with pytest.raises(FormatError):
                read_torch(tmp_path / "a.pth")["a"].array()


def test_a_changed_number_is_noticed(tmp_path):
    path = tmp_path / "a.pth"
    torch.save({"a": torch.arange(300.0)}, path)
    data = bytearray(path.read_bytes())
    data[data.index(np.arange(300, dtype="<f4").tobytes()) + 40] ^= 1
    path.write_bytes(data)
    with pytest.raises(ChecksumMismatch, match="member a/data/0 is damaged"):
        read_torch(path)["a"].array()


def test_a_file_that_was_replaced_is_noticed(tmp_path):
    path = tmp_path / "a.pth"
    tensor = saved({"a": torch.arange(300.0)}, path, **OLD)["a"]
    path.write_bytes(path.read_bytes()[:-40])
    with pytest.raises(BadCheckpoint, match="cut short"):
        tensor.array()


def test_a_file_of_the_old_layout_that_was_cut_short_says_so(tmp_path):
    path = tmp_path / "a.pth"
    torch.save({"a": torch.arange(300.0), "b": torch.arange(9.0)}, path, **OLD)
    size = path.stat().st_size
    path.write_bytes(path.read_bytes()[: size - 500])
    with pytest.raises(BadCheckpoint, match=f"is cut off: it should go on to byte .* {size - 500:,} bytes"):
        read_torch(path)


def test_what_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(zip_file, "FREE", 1 << 16)
    bomb = torch_zip(pickle.dumps({"a": "x" * (8 << 20)}, 2), method=zipfile.ZIP_DEFLATED)
    assert len(bomb) < 1 << 15
    (tmp_path / "a.pth").write_bytes(bomb)
    with pytest.raises(LimitExceeded, match="than is believed"):
        read_torch(tmp_path / "a.pth")


def test_what_uses_a_storage_over_and_over_is_refused(tmp_path):
    """Each tensor reads the whole of what it is stored in, some twice."""
    base = torch.zeros(100_000)
    torch.save({str(i): base[i : i + 10] for i in range(200)}, tmp_path / "a.pth")
    held = read_torch(tmp_path / "a.pth")
    assert all(len(held[str(i)].array()) == 10 for i in range(50))
    with pytest.raises(LimitExceeded, match="over and over"):
        [tensor.array() for tensor in held.values()]


def test_members_that_lie_about_their_size_are_refused(tmp_path):
    path = tmp_path / "a.pth"
    packed = torch_zip(pickle.dumps({"a": "x" * 5000}, 2), method=zipfile.ZIP_DEFLATED)
    stored = torch_zip(pickle.dumps({"a": "x" * 5000}, 2))
    for data in (packed, stored):
        at = data.index(b"PK\1\2")
        for offset in (24, 20, 42):
            for number in (0, 1, 4000, 2**20, 2**31, 2**32 - 2):
                changed = data[: at + offset] + number.to_bytes(4, "little") + data[at + offset + 4 :]
                if changed != data:
                    path.write_bytes(changed)
                    with pytest.raises(FormatError):
                        read_torch(path)


def test_a_directory_of_a_thousand_thousand_members_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(zip_file, "MAX_DIRECTORY", 10_000)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for n in range(1000):
            archive.writestr(f"a/data/{n}", b"")
    (tmp_path / "a.pth").write_bytes(file.getvalue())
    with pytest.raises(LimitExceeded, match="ZIP directory"):
        read_torch(tmp_path / "a.pth")


def test_a_member_twice_is_refused(tmp_path):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive, pytest.warns(UserWarning, match="Duplicate"):
        archive.writestr("a/data.pkl", pickle.dumps(1, 2))
        archive.writestr("a/data.pkl", pickle.dumps(2, 2))
    (tmp_path / "a.pth").write_bytes(file.getvalue())
    with pytest.raises(BadCheckpoint, match="twice"):
        read_torch(tmp_path / "a.pth")


OLD_PARTS = {  # protocol, system, object, keys
    "protocol": (b"\x80\x02M\xea\x03.", None, None, None),
    "protocol of a list": (b"\x80\x02].", None, None, None),
    "system": (None, pickle.dumps({"little_endian": False}, 2), None, None),
    "system of a number": (None, b"\x80\x02K\1.", None, None),
    "keys too few": (None, None, None, pickle.dumps([], 2)),
    "keys too many": (None, None, None, pickle.dumps(["0", "1"], 2)),
    "keys twice": (None, None, None, pickle.dumps(["0", "0"], 2)),
    "keys of numbers": (None, None, None, pickle.dumps([0], 2)),
    "storage among keys": (None, None, None, b"\x80\x02" + STORAGE % b"K\4" + b"."),
    "code among keys": (None, None, None, b"\x80\x02cos\nsystem\n."),
    "code in the protocol": (b"\x80\x02cos\nsystem\n.", None, None, None),
}


@pytest.mark.parametrize("name", OLD_PARTS)
def test_hostile_old_files_are_refused(name, tmp_path):
    path = tmp_path / "a.pth"
    torch.save({"a": torch.arange(4.0)}, path, **OLD)
    file = io.BytesIO(path.read_bytes())
    parts = [file.read(len(torch_file.OLD_MAGIC))]
    for changed in OLD_PARTS[name]:
        start = file.tell()
        list(pickles.pickletools.genops(file))
        parts.append(changed or file.getvalue()[start : file.tell()])
    parts.append(file.read())
    for count in (None, 2**62, -1, 3):
        tail = parts[-1] if count is None else count.to_bytes(8, "little", signed=True) + parts[-1][8:]
        path.write_bytes(b"".join(parts[:-1]) + tail)
        with pytest.raises(FormatError):
            read_torch(path)
