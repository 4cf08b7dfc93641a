"""Tensors that lie in a file until they are asked for, and the plain containers that hold them."""

import math
from collections.abc import Callable

import numpy as np

from formats.errors import BadCheckpoint, LimitExceeded

DTYPES = ("float16", "float32", "float64", "bfloat16", "bool", *(f"int{n}" for n in (8, 16, 32, 64)))
DTYPES += tuple(f"uint{n}" for n in (8, 16, 32, 64))
CODES = {np.dtype(name).str[1:]: name for name in DTYPES if name != "bfloat16"}
"""Names of types by numpy's codes, such as "f4"."""
MAX_DIMENSIONS = 16
MAX_REPEATED = 1 << 16
"""Elements of a tensor that shows stored numbers several times."""
MAX_DEPTH = 64
MAX_VALUES = 1_000_000
"""Of all containers, each counted as often as it is shown."""
MAX_KEY_BITS = 63
MAX_BITS = 128
Reader = Callable[[], bytes | bytearray]


class StoredTensor:
    """Numbers of a file with their shape and type, read when `array` is called.

    `dtype` is a name of DTYPES. `shape` and `dtype` were checked against the bytes that are there.
    """

    __slots__ = ("shape", "dtype", "_count", "_read", "_byteorder", "_offset", "_strides")

    def __init__(
        self,
        shape: tuple[int, ...],
        dtype: str,
        count: int,
        read: Reader,
        byteorder: str = "<",
        offset: int = 0,
        strides: tuple[int, ...] | None = None,
    ):
        """`read` gives `count` numbers of `dtype`; `offset` and `strides` (of C order by default) count them.

        Raises BadCheckpoint, LimitExceeded.
        """
        if dtype not in DTYPES:
            raise BadCheckpoint(f"a tensor has the type {dtype!r}, expected one of {', '.join(DTYPES)}")
        strides = c_strides(shape) if strides is None else strides
        sizes = (*shape, *strides, offset)
        if len(shape) != len(strides) or len(shape) > MAX_DIMENSIONS:
            raise BadCheckpoint(f"a tensor has {len(shape)} sizes and {len(strides)} strides")
        if not all(type(size) is int and 0 <= size < 2**63 for size in sizes):
            raise BadCheckpoint("a tensor has sizes or strides that are no counts")
        last = offset + sum((size - 1) * stride for size, stride in zip(shape, strides, strict=True))
        total = math.prod(shape)
        if total and last >= count:
            raise BadCheckpoint(
                f"a tensor of shape {_short(shape)} needs {last + 1:,} numbers, found {count:,}"
            )
        if total > max(count, MAX_REPEATED):
            raise LimitExceeded(f"a tensor of shape {_short(shape)} repeats its {count:,} numbers too often")
        self.shape, self.dtype, self._count, self._read = shape, dtype, count, read
        self._byteorder, self._offset, self._strides = byteorder, offset, strides

    def array(self) -> np.ndarray:
        """The numbers, in C order and writable; bfloat16 as float32. Raises FormatError."""
        stored = np.dtype("uint16" if self.dtype == "bfloat16" else self.dtype)
        if math.prod(self.shape) == 0:
            flat, offset = np.zeros(0, stored), 0
        else:
            flat, offset = np.frombuffer(self._read(), stored.newbyteorder(self._byteorder)), self._offset
            if len(flat) < self._count:
                raise BadCheckpoint(
                    f"{len(flat):,} numbers were left of {self._count:,}; the file has changed"
                )
        steps = tuple(stride * stored.itemsize for stride in self._strides)
        view = np.lib.stride_tricks.as_strided(flat[offset:], self.shape, steps)
        array = np.require(view, stored, ["C", "W"])
        if self.dtype == "bfloat16":
            wide = array.astype(np.uint32)
            wide <<= 16
            return wide.view(np.float32)
        return array

    def __repr__(self) -> str:
        return f"StoredTensor({self.shape}, {self.dtype})"


def c_strides(shape: tuple[int, ...]) -> tuple[int, ...]:
    """Strides in numbers of an array in C order."""
    strides = [1] * len(shape)
    for axis in range(len(shape) - 2, -1, -1):
        strides[axis] = strides[axis + 1] * max(shape[axis + 1], 1)
    return tuple(strides)


def shape_of(value: object) -> tuple[int, ...]:
    """A shape out of a file: a list or tuple of counts. Raises BadCheckpoint."""
    if not isinstance(value, list | tuple) or not all(type(size) is int for size in value):
        raise BadCheckpoint("a tensor has no shape")
    return tuple(value)


def _short(shape: tuple[int, ...]) -> str:
    return "×".join(map(str, shape)) or "one number"


def check_plain(value: object, where: str) -> None:
    """Raise unless a value consists of plain containers of numbers, texts, bytes and tensors, no deeper than
    MAX_DEPTH, and of no more than MAX_VALUES, where what is shown twice counts twice."""
    level, count = [value], 0
    for _ in range(MAX_DEPTH):
        inner = []
        for item in level:
            if isinstance(item, dict):
                if not all(isinstance(key, str) or _is_index(key) for key in item):
                    raise BadCheckpoint(f"{where}: holds a dictionary whose keys are no texts or integers")
                inner.extend(item.values())
            elif isinstance(item, list | tuple):
                inner.extend(item)
            elif isinstance(item, int) and item.bit_length() > MAX_BITS:
                raise LimitExceeded(f"{where}: holds an integer of {item.bit_length():,} bits")
            elif not isinstance(item, StoredTensor | np.generic | str | bytes | int | float | None):
                raise BadCheckpoint(f"{where}: holds {item!r} where a number or a container was expected")
            if (count := count + 1) + len(inner) > MAX_VALUES:
                raise LimitExceeded(f"{where}: holds more than {MAX_VALUES:,} values")
        if not (level := inner):
            return
    raise LimitExceeded(f"{where}: its containers are nested deeper than {MAX_DEPTH} levels")


def _is_index(key: object) -> bool:
    return isinstance(key, int) and key.bit_length() <= MAX_KEY_BITS
