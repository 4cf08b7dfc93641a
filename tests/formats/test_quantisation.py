"""Codes of 8 and 4 bits: how far off numbers may be, what stays exactly, and bytes that are none."""

import itertools
import struct
import time
from pathlib import Path

import hypothesis.extra.numpy as hnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from formats import errors, quantisation
from formats.field_header import decode_header
from formats.quantisation import BLOCKS, LEVELS, dequantised, scales_shape
from formats.records import BYTES_PER_NUMBER, FieldRecord, as_stored, coded_bytes, decode_field, encode_field

SPEC = Path(__file__).parents[2] / "formats" / "SPEC.md"
SMALLEST = 2.0**-24  # of the float16 above 0
TWO = st.tuples(st.integers(1, 200), st.integers(1, 3))
THREE = st.tuples(st.integers(1, 20), st.integers(1, 20), st.integers(1, 3))


@st.composite
def arrays(draw) -> np.ndarray:
    """Ragged arrays of two or three dimensions: tiles of zeros, of few values, of tiny and of large ones."""
    shape = draw(st.one_of(TWO, THREE))
    sizes = st.sampled_from([0.0, 1e-9, 3e-8, 6e-8, 1e-7, 1e-6, 6e-5, 0.1, 1.0, 300.0, 65504.0])
    tiles = draw(hnp.arrays(np.float32, scales_shape(shape), elements=sizes))
    values = np.random.default_rng(draw(st.integers(0, 99))).uniform(-1, 1, shape).astype(np.float32)
    if draw(st.booleans()):
        values = np.rint(2 * values) / 2
    return values * spread(tiles, shape)


def spread(scales: np.ndarray, shape) -> np.ndarray:
    """The scale of each number's block, one by one."""
    found = np.empty(shape, np.float64)
    for at in np.ndindex(shape):
        found[at] = scales[tuple(i // b for i, b in zip(at, BLOCKS[len(shape)], strict=True))]
    return found


def decoded_slowly(scales: np.ndarray, codes: bytes, bits: int, shape) -> np.ndarray:
    """The specification, number by number."""
    values, at = np.zeros(shape), 0
    for index in np.ndindex(shape):
        scale = float(scales[tuple(i // b for i, b in zip(index, BLOCKS[len(shape)], strict=True))])
        if scale:
            byte = codes[at * bits // 8]
            code = byte - 128 if bits == 8 else (byte >> 4 * (at % 2) & 15) - 8
            values[index] = scale * code / LEVELS[bits]
            at += 1
    assert len(codes) == (at * bits + 7) // 8
    return values


@settings(max_examples=60, deadline=None)
@given(arrays(), st.sampled_from([8, 4]))
def test_numbers_come_back_within_half_a_step(array, bits):
    """And below the smallest float16, within that. In 4 bits what lies beyond the scale is cut to it."""
    scales, codes = quantisation.quantised(array, bits)
    back = dequantised(scales, codes, bits, array.shape, "here")
    assert back.dtype == np.float32 and (back[array == 0] == 0).all()
    scale = spread(scales, array.shape)
    expected = np.clip(array, -scale, scale) if bits == 4 else array
    half = np.maximum(scale / (2 * LEVELS[bits]), SMALLEST) * (1 + 1e-5)
    assert (np.abs(back - expected) <= half).all()


@settings(max_examples=60, deadline=None)
@given(arrays(), st.sampled_from([8, 4]))
def test_what_was_decoded_is_encoded_to_the_same_bytes(array, bits):
    """Edits encode what they read, over and over: nothing drifts."""
    first = quantisation.quantised(array, bits)
    again = quantisation.quantised(dequantised(*first, bits, array.shape, "here"), bits)
    for one, other in zip(first, again, strict=True):
        assert one.tobytes() == other.tobytes()


@settings(max_examples=30, deadline=None)
@given(arrays(), st.sampled_from([8, 4]))
def test_decoding_agrees_with_the_specification_number_by_number(array, bits):
    scales, codes = quantisation.quantised(array, bits)
    expected = decoded_slowly(scales, codes.tobytes(), bits, array.shape)
    np.testing.assert_allclose(dequantised(scales, codes, bits, array.shape, "here"), expected, rtol=1e-7)


@pytest.mark.parametrize("bits", [8, 4])
@pytest.mark.parametrize("rows, columns", list(itertools.product(range(1, 10), (1, 7, 8, 9))))
def test_ragged_edges_store_only_what_is_there(rows, columns, bits):
    array = 1 + np.arange(rows * columns * 2, dtype=np.float32).reshape(rows, columns, 2)
    scales, codes = quantisation.quantised(array, bits)
    assert scales.shape == (1 + (rows > 8), 1 + (columns > 8), 2)
    assert len(codes) == -(-array.size * bits // 8)
    back = dequantised(scales, codes, bits, array.shape, "here")
    np.testing.assert_allclose(back, array, atol=array.max() / LEVELS[bits])


def test_a_block_of_zeros_costs_its_scale_only():
    array = np.zeros((64, 64, 8), np.float32)
    assert [part.nbytes for part in quantisation.quantised(array, 8)] == [2 * 8 * 8 * 8, 0]
    array[3, 60, 5] = 1
    assert (
        quantisation.quantised(array, 8)[1].nbytes == 64 and quantisation.quantised(array, 4)[1].nbytes == 32
    )
    assert coded_bytes(array.shape, "int8") == 2 * 512 + 64 * 64 * 8


@pytest.mark.parametrize("bits", [8, 4])
def test_scales_below_the_smallest_normal_number(bits):
    """They are rounded towards zero, so the largest number keeps the largest code; what is smaller than any
    float16 is zero."""
    array = np.array([[1.9 * SMALLEST], [-1000.6 * SMALLEST], [0.99 * SMALLEST], [0.0]], np.float32)
    for i, scale in enumerate((1, 1000, 0, 0)):
        row = array[i : i + 1]
        scales, codes = quantisation.quantised(row, bits)
        assert scales[0, 0] == scale * SMALLEST and len(codes) == (scale > 0)
        assert dequantised(scales, codes, bits, (1, 1), "here")[0, 0] == np.sign(row[0, 0]) * scales[0, 0]


def test_four_bits_take_the_scale_of_the_least_squared_error():
    """One large number among many small ones is cut off where that helps, tried here by brute force."""
    block = np.random.default_rng(5).normal(size=(8, 8, 1)).astype(np.float32)
    block[0, 0] = 3.5
    scales, codes = quantisation.quantised(block, 4)

    def error(scale: float) -> float:
        return float(np.sum((block - scale * np.clip(np.rint(7 * block / scale), -7, 7) / 7) ** 2))

    found = error(float(scales[0, 0, 0]))
    assert scales[0, 0, 0] < 3.5 and found < error(3.5)
    assert found < 1.1 * min(error(scale) for scale in np.linspace(1.5, 3.5, 400))


# --- runs of rows -------------------------------------------------------------------------------------------


@st.composite
def arrays_in_runs(draw) -> tuple[np.ndarray, np.ndarray]:
    """Rows in runs, short and long, each as large as its own numbers."""
    runs = np.array(draw(st.lists(st.sampled_from([1, 2, 63, 64, 65, 128, 200]), min_size=1, max_size=6)))
    sizes = draw(hnp.arrays(np.float32, len(runs), elements=st.sampled_from([0.0, 1e-7, 0.1, 300.0])))
    values = np.random.default_rng(draw(st.integers(0, 99))).uniform(-1, 1, (runs.sum(), 3))
    return (values * np.repeat(sizes, runs)[:, None]).astype(np.float32), runs.astype(np.int32)


@settings(max_examples=60, deadline=None)
@given(arrays_in_runs(), st.sampled_from([8, 4]))
def test_runs_are_coded_as_if_each_were_an_array_of_its_own(case, bits):
    """So what changes in one leaves the others as they are."""
    array, runs = case
    scales, codes = quantisation.quantised(array, bits, runs)
    assert scales.shape == scales_shape(array.shape, runs)
    parts = np.split(array, np.cumsum(runs)[:-1])
    alone = [quantisation.quantised(part, bits) for part in parts]
    np.testing.assert_array_equal(scales, np.concatenate([one[0] for one in alone]))
    back = [dequantised(*one, bits, part.shape, "here") for one, part in zip(alone, parts, strict=True)]
    found = dequantised(scales, codes, bits, array.shape, "here", runs)
    np.testing.assert_array_equal(found, np.concatenate(back))
    if bits == 8:
        np.testing.assert_array_equal(codes, np.concatenate([one[1] for one in alone]))


def in_runs(runs, rows: int = 70000) -> bytes:
    """A field of one coded array of numbers, whose rows lie in runs."""
    array = np.random.default_rng(0).normal(size=(rows, 1)).astype(np.float32)
    arrays = {"a": array, "a.runs": np.asarray(runs, np.int32)}
    return encode_field(FieldRecord("sparse", arrays, {"needs": ["runs"]}), "int8")


def test_a_field_in_runs_comes_back_and_is_encoded_to_the_same_bytes():
    data = in_runs([100, 1, 69899])
    header, record = decode_header(data, "here"), decode_field(data, "here")
    assert header.coded["a"].runs and header.specs["a.scales"].shape == (2 + 1 + 1093, 1)
    assert encode_field(record, "int8") == data
    array, runs = record.arrays["a"], record.arrays["a.runs"]
    np.testing.assert_array_equal(as_stored(array, "int8", "a", runs), array)


def altered(data: bytes, old: bytes, new: bytes) -> bytes:
    """Bytes with others of the same length in one place."""
    assert data.count(old) == 1 and len(old) == len(new)
    return data.replace(old, new)


def little(*numbers: int) -> bytes:
    return np.array(numbers, "<i4").tobytes()


BAD_RUNS = {
    "a run of nothing": (little(100, 1, 69899), little(101, 0, 69899), "of 1 row and more, 70,000 in all"),
    "a negative run": (little(100, 1, 69899), little(102, -1, 69899), "of 1 row and more, 70,000 in all"),
    "too few rows": (little(100, 1, 69899), little(100, 1, 69898), "of 1 row and more, 70,000 in all"),
    "other blocks": (little(100, 1, 69899), little(64, 36, 69900), "do not have 1,096 blocks"),
    "no runs": (b'"a.runs":', b'"b.runs":', "lacks 'a.runs', whole numbers in one dimension"),
    "said otherwise": (b'\\"runs\\":true', b'\\"runs\\":1234', "should be true"),
}


@pytest.mark.parametrize("name", BAD_RUNS)
def test_runs_that_fit_no_array_are_refused(name):
    """P12."""
    old, new, sentence = BAD_RUNS[name]
    with pytest.raises(errors.FormatError, match=f"^here: .*{sentence}"):
        decode_field(altered(in_runs([100, 1, 69899]), old, new), "here")


# --- what is left of an array keeps its codes ---------------------------------------------------------------


@pytest.mark.parametrize("bits", [8, 4])
@pytest.mark.parametrize("shape", [(1000, 5), (40, 33, 3)])
def test_numbers_that_are_left_keep_their_values(bits, shape):
    """Whatever else of their blocks is made 0, the number that told the scale too."""
    rng = np.random.default_rng(0)
    array = rng.standard_normal(shape).astype(np.float32) * np.exp(rng.normal(size=shape[-1])).astype("f4")
    read = dequantised(*quantisation.quantised(array, bits), bits, shape, "a")
    for share in (0.5, 0.05):
        left = np.where(rng.random(shape) < share, read, 0)
        scales, codes = quantisation.quantised(left, bits)
        again = dequantised(scales, codes, bits, shape, "a")
        np.testing.assert_array_equal(again, left)
        for one, other in zip(quantisation.quantised(again, bits), (scales, codes), strict=True):
            np.testing.assert_array_equal(one, other)


@pytest.mark.parametrize("bits", [8, 4])
def test_rows_that_are_left_keep_their_values_in_runs_of_their_blocks(bits):
    rng = np.random.default_rng(1)
    read = rng.standard_normal((64 * 30, 4)).astype(np.float32)
    read = dequantised(*quantisation.quantised(read, bits), bits, read.shape, "a")
    kept = rng.random(len(read)) < 0.2
    runs = kept.reshape(-1, 64).sum(1).astype(np.uint8)
    left = read[kept]
    again = dequantised(*quantisation.quantised(left, bits, runs), bits, left.shape, "a", runs)
    np.testing.assert_array_equal(again, left)


# --- bytes --------------------------------------------------------------------------------------------------


def field_of(array: np.ndarray, precision: str) -> bytes:
    return encode_field(FieldRecord("dense", {"a": array}), precision)


def test_the_bytes_of_a_coded_field_are_the_specifications():
    """P16: written out by hand, a field of 8 bits whose last block alone is not zero."""
    array = np.zeros((64, 65, 1), np.float32)
    array[56:, 64, 0] = [0, 1, -1, 0.5, -0.5, 0.26, 0.001, 2]
    scales = struct.pack("<72e", *[0] * 71, 2)
    codes = bytes.fromhex("80 c0 40 a0 60 91 80 ff")
    assert "80 c0 40 a0 60 91 80 ff" in SPEC.read_text()
    text = (
        b'{"__metadata__":{"fusedrf":"{\\"coded\\":{\\"a\\":{\\"bits\\":8,\\"shape\\":[64,65,1]}},'
        b'\\"kind\\":\\"dense\\",\\"metadata\\":{},\\"version\\":2}"},'
        b'"a.scales":{"dtype":"F16","shape":[8,9,1],"data_offsets":[0,144]},'
        b'"a.codes":{"dtype":"U8","shape":[8],"data_offsets":[144,152]}}'
    )
    text += b" " * (-len(text) % 8)
    assert field_of(array, "int8") == len(text).to_bytes(8, "little") + text + scales + codes


def test_four_bits_lie_two_a_byte():
    array = np.zeros((64, 65, 1), np.float32)
    array[62:, 64, 0] = [7, -1]
    array[7, 64, 0] = 14  # another block, earlier in the array
    data = field_of(array, "int4")
    scales = [14 if block == 8 else 7 if block == 71 else 0 for block in range(72)]
    assert data[-152:] == struct.pack("<72e", *scales) + bytes.fromhex("888888f8 8888887f")


def test_small_arrays_and_what_is_no_float_stay_as_they_were():
    """A field without coded arrays has the bytes of version 1, whatever the precision."""
    few = {"a": np.ones((15, 16, 17)), "b": np.ones((65535, 1)), "c": np.ones(70000), "d": np.ones((1,) * 4)}
    few |= {dtype.__name__: np.ones((64, 64, 8), dtype) for dtype in (np.uint8, bool, int)}
    record = FieldRecord("dense", few)
    assert encode_field(record, "int8") == encode_field(record, "int4") == encode_field(record, "float16")
    assert decode_header(encode_field(record, "int8"), "here").coded == {}


@pytest.mark.parametrize("precision", ["float16", "float32", "int8", "int4"])
def test_a_field_tells_its_precision_and_what_it_decodes_to(precision):
    arrays = {"a": np.ones((16, 16, 16)), "b": np.ones((40000, 2)), "c": np.ones(9)}
    arrays["d"] = np.ones(7, np.uint8)
    data = encode_field(FieldRecord("dense", arrays), precision)
    header = decode_header(data, "here")
    assert header.precision == precision and header.decoded_size == 4 * (4096 + 80000 + 9) + 7
    assert {name: shape for name, (_, shape) in header.arrays.items()} == {
        name: array.shape for name, array in arrays.items()
    }
    record = decode_field(data, "here")
    assert {name: array.shape for name, array in record.arrays.items()} == {
        name: array.shape for name, array in arrays.items()
    }
    assert all(array.flags.writeable for array in record.arrays.values())
    assert encode_field(record, precision) == data
    bound = sum(coded_bytes(array.shape, precision) for array in list(arrays.values())[:3])
    assert bound == sum(spec.stop - spec.start for spec in header.specs.values()) - 7
    for name in "abc":
        np.testing.assert_array_equal(as_stored(arrays[name], precision), record.arrays[name])


def test_bytes_per_number_are_those_of_trained_sizes():
    """The lines and the colour basis beside planes of 256 x 256: what the averages are reckoned from."""
    planes, lines = [(256, 256, 16), (256, 256, 24)], [(256, 16), (256, 24)]
    shapes = 3 * planes + 3 * lines + [(3, 9, 72)]
    numbers = sum(int(np.prod(shape)) for shape in shapes)
    for precision, average in BYTES_PER_NUMBER.items():
        assert sum(coded_bytes(s, precision) for s in shapes) == pytest.approx(average * numbers, rel=0.01)


@pytest.mark.parametrize("value", [7e4, np.inf, np.nan])
def test_scales_beyond_float16_are_refused(value):
    array = np.ones((16, 16, 16))
    array[3, 4, 5] = value
    for use in (lambda: field_of(array, "int8"), lambda: as_stored(array, "int4")):
        with pytest.raises(errors.NotFinite) as caught:
            use()
        assert ("use --precision float32" in str(caught.value)) == (value == 7e4)


def test_names_that_coding_would_give_twice():
    twice = {"a": np.ones((16, 16, 16)), "a.codes": np.ones(3)}
    for names in (("a", "a.codes"), ("a.codes", "a")):
        with pytest.raises(errors.BadArray, match=r"two arrays would be stored as 'a\.codes'"):
            encode_field(FieldRecord("dense", {name: twice[name] for name in names}), "int8")


# --- hostile bytes ------------------------------------------------------------------------------------------

SCALES, CODES = np.array([[1], [0.5]], np.float16), np.full(65, 7, np.uint8)
HOSTILE = {
    "scale nan": (np.array([[np.nan], [1]]), CODES, 8, errors.NotFinite, "scales that are NaN"),
    "scale infinite": (np.array([[np.inf], [1]]), CODES, 8, errors.NotFinite, "scales that are NaN"),
    "scale negative": (np.array([[-1], [1]]), CODES, 8, errors.BadArray, "negative scales"),
    "scale minus zero": (np.array([[-0.0], [1]]), CODES[:1], 8, errors.BadArray, "negative scales"),
    "code 0": (SCALES, np.arange(65, dtype=np.uint8), 8, errors.BadArray, "a code 0, expected 1 to 255"),
    "code 0 of 4 bits": (SCALES, np.full(33, 0x0F, np.uint8), 4, errors.BadArray, "code 0, expected 1 to 15"),
    "half a byte": (SCALES, np.full(33, 0x77, np.uint8), 4, errors.BadArray, "last half byte should be 0"),
    "too few": (SCALES, CODES[:64], 8, errors.BadArray, "64 bytes of codes, but its scales need 65"),
    "too many": (0 * SCALES, CODES, 8, errors.BadArray, "65 bytes of codes, but its scales need 0"),
    "of a zero block": (SCALES * [[1], [0]], CODES, 8, errors.BadArray, "its scales need 64"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_hostile_scales_and_codes(name, monkeypatch):
    """P12, P14: refused before the numbers are allocated."""
    scales, codes, bits, error, sentence = HOSTILE[name]
    monkeypatch.setattr(quantisation.np, "zeros", lambda *_: pytest.fail("allocated"))
    with pytest.raises(error, match=f"^here: .*{sentence}") as caught:
        dequantised(scales.astype(np.float16), codes, bits, (65, 1), "here")
    assert type(caught.value) is error


def test_random_bytes_are_refused_or_finite():
    """P18."""
    rng, taken = np.random.default_rng(0), 0
    for _ in range(300):
        bits, shape = int(rng.choice([4, 8])), tuple(rng.integers(1, 20, 2)) + (2,)
        scales = rng.integers(0, 1 << 15, scales_shape(shape)).astype(np.uint16).view(np.float16)
        codes = rng.integers(1, 256, -(-int(np.prod(shape)) * bits // 8)).astype(np.uint8)
        try:
            taken += bool(np.isfinite(dequantised(scales, codes, bits, shape, "here")).all())
        except (errors.BadArray, errors.NotFinite):
            continue
    assert taken > 10


def test_scales_of_zero_for_2_gigabytes_cost_neither_time_nor_memory():
    """P14: the array is there, but none of its pages."""
    shape = (8192, 8192, 8)
    began = time.process_time()
    array = dequantised(np.zeros(scales_shape(shape), np.float16), np.zeros(0, np.uint8), 8, shape, "here")
    assert array.nbytes == 2 << 30 and not array[::4096, ::4096].any()
    assert time.process_time() - began < 2


@pytest.mark.parametrize("bits", [8, 4])
def test_a_trained_size_decodes_in_no_time(bits):
    """100 MB/s; it is ten times that on an idle core."""
    array = np.random.default_rng(1).normal(size=(250, 240, 24)).astype(np.float32)
    scales, codes = quantisation.quantised(array, bits)
    began = time.process_time()
    dequantised(scales, codes, bits, array.shape, "here")
    assert array.nbytes / (time.process_time() - began) > 100e6
