"""Arrays in 8 or 4 bits: a code for every number, and a scale for every block of neighbours.

An array of three dimensions (na, nb, R) is cut into blocks of 8 x 8 x 1, one of two (V, C) into blocks of
64 x 1, from index 0, smaller at the far edges; where the rows of the latter lie in runs, they are cut anew at
each, so that what one run holds leaves the others as they are. With L = 127 in 8 bits and 7 in 4, a number is

    value = scale * code / L        scale a float16 >= 0 of its block, code an integer from -L to L

computed in float32, the product first: it is exact, so that code L gives back the scale itself. A block whose
scale is 0 is all zero and stores no codes. Encoding what was decoded gives the same numbers: a block has a
number of code L or -L, from which its scale follows, or, where that was left out since, a scale that gives
all that are left (`_regained`).
"""

import math
from collections.abc import Iterator

import numpy as np

from formats.errors import BadArray, NotFinite

BLOCKS = {2: (64, 1), 3: (8, 8, 1)}  # by an array's dimensions
LEAST = {2: 65536, 3: 4096}  # numbers of an array that a writer codes; smaller ones stay float16
LEVELS = {8: 127, 4: 7}  # the largest code, by bits
# Of a block's largest number: the scales that are tried for the least squared error. With eight bits,
# cutting off the largest number gains nothing. None may be above 1, or no code would reach L.
FACTORS = {8: (1.0,), 4: (1.0, 0.95, 0.9, 0.85, 0.8, 0.75, 0.7, 0.65)}
NUMBERS_AT_ONCE = 1 << 17  # of an array, so that what is made of them stays in the cache
MOST_AT_ONCE = 8 * NUMBERS_AT_ONCE  # where a row of blocks has more than that
MADE_AT_ONCE = 20 * MOST_AT_ONCE  # bytes that are made of them on the way


def is_coded(shape: tuple[int, ...]) -> bool:
    """Whether a writer codes an array of that shape."""
    return len(shape) in LEAST and math.prod(shape) >= LEAST[len(shape)]


def scales_shape(shape: tuple[int, ...], runs: np.ndarray | None = None) -> tuple[int, ...]:
    """Blocks per axis of an array of two or three dimensions; runs (R,) are the rows in each run of one of
    two."""
    counts = [-(-n // b) for n, b in zip(shape, BLOCKS[len(shape)], strict=True)]
    if runs is not None:
        counts[0] = int((-(-np.asarray(runs, np.int64) // BLOCKS[2][0])).sum())
    return tuple(counts)


def block_sides(shape: tuple[int, ...], runs: np.ndarray | None = None) -> tuple[np.ndarray, ...]:
    """The lengths of the blocks along each axis, (scales_shape[axis],) int64."""
    sides = []
    for axis, (n, b) in enumerate(zip(shape, BLOCKS[len(shape)], strict=True)):
        lengths = np.asarray([n] if axis or runs is None else runs, np.int64)
        counts = -(-lengths // b)
        full = np.full(int(counts.sum()), b, np.int64)
        full[np.cumsum(counts)[lengths > 0] - 1] += (lengths - counts * b)[lengths > 0]
        sides.append(full)
    return tuple(sides)


def code_bytes(numbers: int, bits: int) -> int:
    """Bytes that this many codes take."""
    return -(-numbers * bits // 8)


def quantised(array: np.ndarray, bits: int, runs: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Scales, float16 of `scales_shape`, and codes, flat uint8, of a float array of two or three dimensions.

    An error is at most scale / (2 L), or 2^-24 where that is more, in 8 bits; in 4 the largest numbers of a
    block may be cut off where the others gain by it. Magnitudes have to be at most 65504.
    """
    levels = LEVELS[bits]
    scales, codes = np.empty(scales_shape(array.shape, runs), np.float16), []
    for rows, blocks, sides in _slabs(array.shape, runs):
        values = np.asarray(array[rows], np.float32)
        scales[blocks] = _best_scales(values, sides, bits)
        spread = _spread(scales[blocks], sides)
        codes.append((_codes(values, spread, levels) + np.float32(levels + 1)).astype(np.uint8)[spread > 0])
    packed = np.concatenate(codes) if codes else np.zeros(0, np.uint8)
    return scales, packed if bits == 8 else _paired(packed)


def dequantised(
    scales: np.ndarray,
    codes: np.ndarray,
    bits: int,
    shape: tuple[int, ...],
    where: str,
    runs: np.ndarray | None = None,
) -> np.ndarray:
    """float32 numbers of `shape` from what `quantised` gave; `scales` have the `scales_shape` of it.

    `where` leads error sentences. Before the numbers are allocated, raises NotFinite (scales) and BadArray
    (negative scales, invalid codes, too many or too few of them).
    """
    levels, kept_numbers = LEVELS[bits], check_scales(scales, shape, where, runs)
    if codes.size != code_bytes(kept_numbers, bits):
        raise BadArray(
            f"{where}: {codes.size:,} bytes of codes, but its scales need "
            f"{code_bytes(kept_numbers, bits):,}; make the file again"
        )
    if bits == 4:
        codes = _single(codes)
        if codes[kept_numbers:].any():
            raise BadArray(f"{where}: its last half byte should be 0; make the file again")
        codes = codes[:kept_numbers]
    if kept_numbers and not codes.min():
        raise BadArray(f"{where}: has a code 0, expected 1 to {2 * levels + 1}; make the file again")
    array, at = np.zeros(shape, np.float32), 0
    for rows, blocks, sides in _pieces(block_sides(shape, runs)):
        if not scales[blocks].any():
            continue  # pages of zeros are never touched
        spread = _spread(scales[blocks], sides)
        nonzero = spread > 0
        count = np.count_nonzero(nonzero)
        signed = np.zeros(nonzero.shape, np.float32)
        signed[nonzero] = codes[at : at + count].astype(np.float32) - (levels + 1)
        array[rows] = spread * signed / np.float32(levels)
        at += count
    return array


def check_scales(
    scales: np.ndarray, shape: tuple[int, ...], where: str, runs: np.ndarray | None = None
) -> int:
    """How many numbers of an array of `shape` have codes. Raises NotFinite and BadArray for invalid
    scales."""
    if not np.isfinite(scales).all():
        raise NotFinite(f"{where}: has scales that are NaN or infinite; make the file again")
    if np.signbit(scales).any():
        raise BadArray(f"{where}: has negative scales; make the file again")
    count = 0
    for _, blocks, sides in _pieces(block_sides(shape, runs)):
        nonzero = (scales[blocks] > 0).astype(np.int64)
        for axis, lengths in enumerate(sides):
            nonzero *= lengths.reshape([-1 if a == axis else 1 for a in range(len(shape))])
        count += int(nonzero.sum())
    return count


def _pieces(
    sides: tuple[np.ndarray, ...],
) -> Iterator[tuple[tuple[slice, ...], tuple[slice, ...], tuple[np.ndarray, ...]]]:
    """Slices of an array with blocks of these sides, in its own order, and of its scales, and the blocks'
    lengths in them along each axis: of MOST_AT_ONCE numbers at most, whatever its shape."""
    first, *rest = sides
    beside = math.prod(int(side.sum()) for side in rest)
    inner_all = tuple(slice(0, int(side.sum())) for side in rest), tuple(slice(0, len(side)) for side in rest)
    in_a_row = beside * int(first.max(initial=1))
    if in_a_row <= MOST_AT_ONCE or not rest:
        at, step = 0, max(1, NUMBERS_AT_ONCE // max(1, in_a_row))
        for block in range(0, len(first), step):
            lengths = first[block : block + step]
            rows = slice(at, at := at + int(lengths.sum()))
            yield (rows, *inner_all[0]), (slice(block, block + step), *inner_all[1]), (lengths, *rest)
        return
    row = 0
    for block, length in enumerate(first.tolist()):
        for _ in range(length):  # a row of so many numbers, whose codes follow each other
            for inner, blocks, lengths in _pieces(tuple(rest)):
                block_slices = (slice(row, row + 1), *inner), (slice(block, block + 1), *blocks)
                yield *block_slices, (np.ones(1, np.int64), *lengths)
            row += 1


def _slabs(
    shape: tuple[int, ...], runs: np.ndarray | None = None
) -> Iterator[tuple[slice, slice, tuple[np.ndarray, ...]]]:
    """Slices of an array's first axis, and of its scales', that cut no block, and the blocks' lengths in them
    along each axis."""
    rows, *others = block_sides(shape, runs)
    step = max(1, NUMBERS_AT_ONCE // (BLOCKS[len(shape)][0] * max(1, math.prod(shape[1:]))))
    at = 0
    for first in range(0, len(rows), step):
        sides = rows[first : first + step]
        yield slice(at, at := at + int(sides.sum())), slice(first, first + step), (sides, *others)


def _spread(scales: np.ndarray, sides: tuple[np.ndarray, ...]) -> np.ndarray:
    """float32: the scale of every number's block."""
    spread = scales.astype(np.float32)
    for axis, lengths in enumerate(sides):
        if (lengths != 1).any():
            spread = np.repeat(spread, lengths, axis)
    return spread


def _by_block(reduce: np.ufunc, values: np.ndarray, sides: tuple[np.ndarray, ...]) -> np.ndarray:
    """The largest of every block, or its sum."""
    for axis, lengths in enumerate(sides):
        if (lengths != 1).any():
            values = reduce.reduceat(values, np.cumsum(lengths) - lengths, axis)
    return values


def _floored(peaks: np.ndarray) -> np.ndarray:
    """float16, rounded towards zero: the largest number of a block then always gets the largest code, below
    the smallest normal float16 too."""
    near = peaks.astype(np.float16)
    return np.where(near > peaks, np.nextafter(near, np.float16(0)), near)


def _best_scales(values: np.ndarray, sides: tuple[np.ndarray, ...], bits: int) -> np.ndarray:
    """float16 scales of the blocks of a slab, of the least squared error among those tried."""
    levels, peaks = LEVELS[bits], _by_block(np.maximum, np.abs(values), sides)
    tried = np.stack([_floored(np.float32(factor) * peaks) for factor in FACTORS[bits]])
    scales = tried[0]
    if len(tried) > 1:
        off = (values - _decoded(values, one, sides, levels) for one in tried)
        errors = [_by_block(np.add, np.square(o, dtype=np.float64), sides) for o in off]
        first = np.argmin(errors, 0)  # of equal ones the largest scale, so that what was coded stays
        scales = np.take_along_axis(tried, first[None], 0)[0]
    missed = _by_block(np.logical_or, _decoded(values, scales, sides, levels) != values, sides)
    return _regained(values, sides, levels, peaks, scales, missed) if missed.any() else scales


def _decoded(
    values: np.ndarray, scales: np.ndarray, sides: tuple[np.ndarray, ...], levels: int
) -> np.ndarray:
    """What the codes of values give under their blocks' scales."""
    spread = _spread(scales, sides)
    return spread * _codes(values, spread, levels) / np.float32(levels)


def _regained(
    values: np.ndarray,
    sides: tuple[np.ndarray, ...],
    levels: int,
    peaks: np.ndarray,
    scales: np.ndarray,
    sought: np.ndarray,
) -> np.ndarray:
    """The scales, of the blocks that are sought those under which all numbers are codes exactly, where there
    are such: they were coded by them before the largest was left out."""
    at, codes = np.argwhere(sought), np.arange(levels - 1, 0, -1, dtype=np.float32)
    tried = peaks[sought][:, None] * (np.float32(levels) / codes)
    near = (tried.view(np.int32) + 4 & 0x1FFF) <= 8  # to a rounding or two float16 numbers
    which, code = np.nonzero(near)
    with np.errstate(over="ignore"):
        tried = tried[which, code].astype(np.float16)
    which, tried = which[np.isfinite(tried)], tried[np.isfinite(tried)]
    numbers = _numbers_of(at[which], values, sides)
    by = tried.astype(np.float32)[:, None]
    codes = _codes(numbers, np.broadcast_to(by, numbers.shape), levels)
    exact = (by * codes / np.float32(levels) == numbers).all(1)
    best = scales.copy()
    best[tuple(at[which[exact]][::-1].T)] = tried[exact][::-1]  # of several the smallest scale
    return best


def _numbers_of(blocks: np.ndarray, values: np.ndarray, sides: tuple[np.ndarray, ...]) -> np.ndarray:
    """(N, K) the numbers of blocks (N, dimensions) of a slab; smaller ones repeat some of theirs."""
    index = []
    for axis, lengths in enumerate(sides):
        rows = blocks[:, axis, None]
        at = (np.cumsum(lengths) - lengths)[rows] + np.minimum(np.arange(lengths.max()), lengths[rows] - 1)
        shape = [1] * (1 + len(sides))
        shape[0], shape[1 + axis] = at.shape
        index.append(at.reshape(shape))
    numbers = values[tuple(index)]
    return numbers.reshape(len(blocks), math.prod(numbers.shape[1:]))


def _codes(values: np.ndarray, spread: np.ndarray, levels: int) -> np.ndarray:
    """Signed codes of values under their blocks' scales, as float32; 0 where the scale is."""
    by = np.divide(np.float32(levels), spread, out=np.zeros_like(spread), where=spread > 0)
    return np.clip(np.rint(values * by), -levels, levels)


def _paired(codes: np.ndarray) -> np.ndarray:
    """Two codes a byte, the first in the lower half; the last byte is filled with 0."""
    even = np.append(codes, np.uint8(0)) if codes.size % 2 else codes
    return even[0::2] | even[1::2] << 4


def _single(codes: np.ndarray) -> np.ndarray:
    """Inverse of `_paired`, with what filled the last byte."""
    return np.stack([codes & 15, codes >> 4], 1).ravel()
