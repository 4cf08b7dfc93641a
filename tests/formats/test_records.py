"""Fields survive their bytes, equal fields have equal bytes, and hostile bytes end in a sentence."""

import json

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
import safetensors.numpy
from hypothesis import given, settings
from hypothesis import strategies as st

from formats import errors
from formats.field_header import MAX_HEADER, decode_header
from formats.records import FieldRecord, decode_field, encode_field

CONTENT = {"kind": "dense", "metadata": {}, "version": 1}
SIGMA = {"dtype": "F32", "shape": [1], "data_offsets": [0, 4]}
shapes = hnp.array_shapes(min_dims=0, max_dims=5, min_side=0, max_side=3)
stored = st.one_of(
    hnp.arrays(np.float32, shapes, elements=st.floats(-6e4, 6e4, width=32)),
    hnp.arrays(np.uint8, shapes),
    hnp.arrays(np.int32, shapes),
)
metadata = st.dictionaries(
    st.text("xyz", min_size=1),
    st.one_of(
        st.integers(-(2**63) + 1, 2**63 - 1), st.floats(allow_nan=False, allow_infinity=False), st.text()
    ),
    max_size=3,
)


def raw(header, data=b"\0" * 4) -> bytes:
    text = header if isinstance(header, bytes) else json.dumps(header).encode()
    return len(text).to_bytes(8, "little") + text + data


def field(arrays=None, content=None) -> dict:
    return {"__metadata__": {"fusedrf": json.dumps(content or CONTENT)}, **(arrays or {})}


@settings(max_examples=50, deadline=None)
@given(st.dictionaries(st.text("abz_.-09", min_size=1, max_size=8), stored, max_size=4), metadata)
def test_round_trip(arrays, metadata):
    back = decode_field(encode_field(FieldRecord("dense", arrays, metadata), "float32"), "here")
    assert back.kind == "dense" and back.metadata == metadata and back.arrays.keys() == arrays.keys()
    for name, array in arrays.items():
        assert back.arrays[name].dtype == array.dtype and back.arrays[name].flags.writeable
        np.testing.assert_array_equal(back.arrays[name], array)


def test_decoding_agrees_with_the_safetensors_library():
    arrays = {"b": np.arange(6.0).reshape(2, 3), "a": np.arange(5, dtype=np.uint8), "c": np.int64(7)}
    data = encode_field(FieldRecord("vm", arrays))
    ours, theirs = decode_field(data, "here").arrays, safetensors.numpy.load(data)
    assert ours.keys() == theirs.keys()
    for name in theirs:
        np.testing.assert_array_equal(ours[name], theirs[name])


def test_bytes_do_not_depend_on_order_or_layout():
    """P16."""
    a, b = np.arange(6.0).reshape(2, 3), np.arange(4)
    first = encode_field(FieldRecord("vm", {"a": a, "b": b}, {"x": 1, "y": (2,)}))
    second = encode_field(
        FieldRecord("vm", {"b": b, "a": np.asfortranarray(a)}, {"y": np.array([2]), "x": 1})
    )
    assert first == second


def test_precision_and_types():
    arrays = {"f": np.array([1 / 3]), "m": np.array([True]), "i": np.array([-5], np.int64)}
    half = decode_field(encode_field(FieldRecord("vm", arrays), "float16"), "here").arrays
    assert half["f"] == np.float16(1 / 3) and half["f"].dtype == np.float32
    assert (half["m"], half["m"].dtype, half["i"], half["i"].dtype) == (1, np.uint8, -5, np.int32)
    full = decode_field(encode_field(FieldRecord("vm", arrays), "float32"), "here").arrays
    assert full["f"] == np.float32(1 / 3)


@pytest.mark.parametrize(
    ("array", "precision", "sentence"),
    [
        ([1, np.nan, np.inf], "float32", "'sigma' has 2 of 3 values NaN or infinite"),
        ([1, 7e4, -7e4], "float16", "'sigma' has 2 of 3 values too large for float16"),
        ([1e39], "float32", "too large for float32"),
    ],
)
def test_numbers_that_do_not_fit_are_named(array, precision, sentence):
    with pytest.raises(errors.NotFinite, match=sentence):
        encode_field(FieldRecord("vm", {"sigma": np.array(array)}), precision)


@pytest.mark.parametrize("array", [np.array([2**31]), np.array([1j]), np.array(["a"]), np.zeros((1,) * 6)])
def test_arrays_that_cannot_be_stored(array):
    with pytest.raises(errors.BadArray, match="sigma"):
        encode_field(FieldRecord("vm", {"sigma": array}))


@pytest.mark.parametrize("value", [object(), float("nan"), {1, 2}])
def test_metadata_that_is_no_json(value):
    with pytest.raises(errors.BadSchema):
        encode_field(FieldRecord("vm", {}, {"x": value}))


A_CODED = {"bits": 8, "shape": [3, 1, 2]}
A_SCALES = {"dtype": "F16", "shape": [1, 1, 2], "data_offsets": [0, 4]}
A_CODES = {"dtype": "U8", "shape": [3], "data_offsets": [4, 7]}
ONE = b"\0\x3c\0\0" + b"\x80" * 3  # a scale of 1, one of 0, three codes of 0


def coded(coded_as, scales=A_SCALES, codes=A_CODES, data=ONE, **others) -> bytes:
    """A field of version 2 whose metadata has this for coded arrays; array "a" is stored."""
    arrays = {"a.scales": scales, "a.codes": codes, **others}
    content = CONTENT | {"version": 2, "coded": coded_as}
    return raw(field({k: v for k, v in arrays.items() if v}, content), data)


def entry(**words) -> dict:
    return {"a": A_CODED | words}


HOSTILE = {
    "empty": (b"", errors.TruncatedBundle),
    "header cut": (raw(field())[:20], errors.TruncatedBundle),
    "header huge": ((MAX_HEADER + 1).to_bytes(8, "little"), errors.LimitExceeded),
    "header no json": (raw(b"{"), errors.BadJson),
    "header list": (raw([]), errors.BadHeader),
    "nan": (raw(b'{"a": NaN}'), errors.BadJson),
    "deep": (raw(b"[" * 100_000), errors.BadJson),
    "metadata missing": (raw({"sigma": SIGMA}), errors.BadHeader),
    "two metadata keys": (raw({"__metadata__": {"fusedrf": "{}", "x": ""}}), errors.BadHeader),
    "content no object": (raw(field(content=[1])), errors.BadSchema),
    "version boolean": (raw(field(content=CONTENT | {"version": True})), errors.BadSchema),
    "version newer": (raw(field(content=CONTENT | {"version": 4})), errors.NewerVersion),
    "version 3 in need of nothing": (raw(field(content=CONTENT | {"version": 3})), errors.BadSchema),
    "needs in version 1": (
        raw(field(content=CONTENT | {"metadata": {"needs": ["hashed"]}})),
        errors.BadSchema,
    ),
    "needs no list": (
        raw(field(content=CONTENT | {"version": 3, "metadata": {"needs": "hashed"}})),
        errors.BadSchema,
    ),
    "version old": (raw(field(content=CONTENT | {"version": 0})), errors.BadSchema),
    "kind": (raw(field(content=CONTENT | {"kind": "../x"})), errors.BadSchema),
    "key unknown": (raw(field(content=CONTENT | {"x": 1})), errors.BadSchema),
    "aabb inside out": (raw(field(content=CONTENT | {"metadata": {"aabb": [0] * 6}})), errors.BadSchema),
    "aabb text": (raw(field(content=CONTENT | {"metadata": {"aabb": "abcdef"}})), errors.BadSchema),
    "array name": (raw(field({"../x": SIGMA})), errors.BadArray),
    "array twice": (raw(json.dumps(field({"a": SIGMA}))[:-1].encode() + b', "a": 1}'), errors.BadJson),
    "array keys": (raw(field({"a": SIGMA | {"x": 1}})), errors.BadHeader),
    "dtype": (raw(field({"a": SIGMA | {"dtype": "BF16"}})), errors.BadArray),
    "dtype list": (raw(field({"a": SIGMA | {"dtype": []}})), errors.BadArray),
    "rank": (raw(field({"a": SIGMA | {"shape": [1] * 6}})), errors.BadArray),
    "negative": (raw(field({"a": SIGMA | {"shape": [-1]}})), errors.BadArray),
    "boolean size": (raw(field({"a": SIGMA | {"shape": [True]}})), errors.BadArray),
    "float size": (raw(field({"a": SIGMA | {"shape": [1.0]}})), errors.BadArray),
    "zero by 1e12": (raw(field({"a": SIGMA | {"shape": [0, 10**12]}})), errors.BadArray),
    "too large": (raw(field({"a": SIGMA | {"shape": [2**16, 2**16]}})), errors.LimitExceeded),
    "wrong size": (raw(field({"a": SIGMA | {"shape": [2]}})), errors.BadHeader),
    "data cut": (raw(field({"a": SIGMA}), b"\0\0\0"), errors.TruncatedBundle),
    "data over": (raw(field({"a": SIGMA}), b"\0" * 5), errors.BadHeader),
    "gap": (raw(field({"a": SIGMA | {"data_offsets": [4, 8]}}), b"\0" * 8), errors.BadHeader),
    "overlap": (raw(field({"a": SIGMA, "b": SIGMA})), errors.BadHeader),
    "too many": (raw(field({f"a{i}": SIGMA for i in range(4097)})), errors.LimitExceeded),
    "infinite": (raw(field({"a": SIGMA}), np.float32(np.inf).tobytes()), errors.NotFinite),
    "coded in version 1": (raw(field(content=CONTENT | {"coded": {}})), errors.BadSchema),
    "coded missing": (raw(field(content=CONTENT | {"version": 2})), errors.BadSchema),
    "coded nothing": (coded({}), errors.BadSchema),
    "coded list": (coded(["a"]), errors.BadSchema),
    "coded name": (coded({"../x": A_CODED}), errors.BadArray),
    "coded twice": (coded({"a": A_CODED, "a.scales": A_CODED}), errors.BadArray),
    "coded without bits": (coded({"a": {"shape": [3, 1, 2]}}), errors.BadSchema),
    "coded with more": (coded(entry(scale=1)), errors.BadSchema),
    "coded no object": (coded({"a": [8]}), errors.BadSchema),
    "coded 5 bits": (coded(entry(bits=5)), errors.BadSchema),
    "coded 8.0 bits": (coded(entry(bits=8.0)), errors.BadSchema),
    "coded true bits": (coded(entry(bits=True)), errors.BadSchema),
    "coded list of bits": (coded(entry(bits=[8])), errors.BadSchema),
    "coded vector": (coded(entry(shape=[6])), errors.BadArray),
    "coded in 4 dimensions": (coded(entry(shape=[3, 1, 2, 1])), errors.BadArray),
    "coded nowhere": (coded(entry(shape=[0, 1, 2])), errors.BadArray),
    "coded shape of text": (coded(entry(shape="312")), errors.BadArray),
    "coded negative": (coded(entry(shape=[-3, 1, 2])), errors.BadArray),
    "coded too wide": (coded(entry(shape=[2**31, 1, 2])), errors.BadArray),
    "coded too large": (coded(entry(shape=[2**30, 2**30, 2])), errors.LimitExceeded),
    "coded of another shape": (coded(entry(shape=[9, 1, 2])), errors.BadArray),
    "coded on its side": (coded(entry(shape=[3, 2, 1])), errors.BadArray),
    "scales missing": (coded(entry(), None, A_CODES | {"data_offsets": [0, 3]}, ONE[4:]), errors.BadArray),
    "codes missing": (coded(entry(), codes=None, data=ONE[:4]), errors.BadArray),
    "scales of bytes": (
        coded(entry(), {"dtype": "U8", "shape": [1, 1, 4], "data_offsets": [0, 4]}),
        errors.BadArray,
    ),
    "codes in a square": (coded(entry(), codes=A_CODES | {"shape": [3, 1]}), errors.BadArray),
    "codes for more": (
        coded(entry(), codes=A_CODES | {"shape": [7], "data_offsets": [4, 11]}, data=ONE + ONE[-4:]),
        errors.BadArray,
    ),
    "codes for fewer": (
        coded(entry(), codes=A_CODES | {"shape": [2], "data_offsets": [4, 6]}, data=ONE[:-1]),
        errors.BadArray,
    ),
    "code 0": (coded(entry(), data=ONE[:-1] + b"\0"), errors.BadArray),
    "scale negative": (coded(entry(), data=b"\0\xbc" + ONE[2:]), errors.BadArray),
    "scale infinite": (coded(entry(), data=b"\0\x7c" + ONE[2:]), errors.NotFinite),
    "too many coded": (coded({f"a{i}": A_CODED for i in range(4097)}), errors.LimitExceeded),
}


@pytest.mark.parametrize(("data", "error"), HOSTILE.values(), ids=HOSTILE)
def test_hostile_bytes(data, error):
    """P12, P14."""
    with pytest.raises(error, match="^here: ") as caught:
        decode_field(data, "here")
    assert type(caught.value) is error and "\n" not in str(caught.value)


def test_a_coded_field_without_a_fault_is_taken():
    """So that each of the hostile ones has its own."""
    record = decode_field(coded(entry()), "here")
    np.testing.assert_array_equal(record.arrays["a"], np.zeros((3, 1, 2), np.float32))
    assert list(record.arrays) == ["a"]


def test_what_all_arrays_decode_to_is_bounded():
    """P14: a scale alone may stand for 64 numbers."""
    assert decode_header(coded(entry()), "here").decoded_size == 24
    with pytest.raises(errors.LimitExceeded, match="here: decodes to 24 bytes, but at most 23 are read"):
        decode_header(coded(entry()), "here", 23)


def test_as_many_arrays_are_read_whether_they_are_coded_or_not():
    record = FieldRecord("vm", {f"a{i}": np.ones((16, 16, 16)) for i in range(256)})
    assert len(decode_field(encode_field(record, "int4"), "here").arrays) == 256


def test_the_header_alone_tells_kind_and_shapes():
    data = encode_field(FieldRecord("vm", {"a": np.zeros((2, 3))}, {"aabb": [0, 0, 0, 1, 1, 1]}))
    header = decode_header(memoryview(data), "here")
    assert (header.kind, header.specs["a"].shape, header.specs["a"].dtype) == ("vm", (2, 3), np.float16)
