"""Parameters as tiny-cuda-nn (github.com/NVlabs/tiny-cuda-nn) has them: one flat array of networks, whose
matrices are padded, and of grids."""

from collections.abc import Sequence

import numpy as np

from formats.errors import FormatError
from fusedrf_cli.bridge.importing.parts import Layer

FUSED = 16, 32, 64, 128  # neurons that a FullyFusedMLP can have
PADDED = {"FullyFusedMLP": 16, "CutlassMLP": 8}
"""Up to multiples of what inputs and outputs are filled."""
MOST_VERTICES = 1 << 24
"""Along an axis of a grid's level."""


def padded(count: int, by: int) -> int:
    """Up to a multiple."""
    return -(-count // by) * by


def shapes_of(inputs: int, neurons: int, hidden: int, outputs: int, by: int) -> list[tuple[int, int]]:
    """(outputs, inputs) of the matrices of a network with so many hidden layers."""
    if hidden == 0:
        return [(padded(outputs, by), padded(inputs, by))]
    first, last = (neurons, padded(inputs, by)), (padded(outputs, by), neurons)
    return [first, *[(neurons, neurons)] * (hidden - 1), last]


def size_of(shapes: Sequence[tuple[int, int]]) -> int:
    """Numbers of matrices."""
    return sum(rows * columns for rows, columns in shapes)


def network_of(
    params: np.ndarray, shapes: Sequence[tuple[int, int]], inputs: int, outputs: int, filler: float
) -> tuple[list[Layer], np.ndarray]:
    """The layers of a network without what it is padded by, and the numbers behind them. Inputs are padded by
    `filler`: a column that always reads 1 is a bias."""
    if len(params) < size_of(shapes):
        raise FormatError(f"a network of tiny-cuda-nn has {size_of(shapes):,} numbers, found {len(params):,}")
    layers: list[Layer] = []
    for i, (rows, columns) in enumerate(shapes):
        matrix, params = params[: rows * columns].reshape(rows, columns), params[rows * columns :]
        bias = None
        if i == 0:
            bias = filler * matrix[:, inputs:].astype(np.float64).sum(1)
            matrix = matrix[:, :inputs]
        if i == len(shapes) - 1:
            matrix, bias = matrix[:outputs], bias if bias is None else bias[:outputs]
        layers.append((matrix, bias))
    if len(layers) == 1:  # x = max(0, x) - max(0, -x)
        (matrix, bias), same = layers[0], np.eye(outputs)
        layers = [(np.concatenate([matrix, -matrix]), np.concatenate([bias, -bias])),
                  (np.concatenate([same, -same], 1), None)]  # fmt: skip
    return layers, params


def levels_of(count: int, log2_rows: int, base: int, log2_growth: float, kind: str = "hash") -> list[dict]:
    """The levels of a grid, whose scales are computed in float32, as there. Its vertices share rows by a
    hash, each has its own ("dense"), or as many have as the coarsest level has, over and over ("tiled")."""
    if not 1 <= count <= 32 or not 1 <= log2_rows <= 26 or not 1 <= base <= 1 << 16:
        raise FormatError(
            f"a hash grid of {count} levels, 2^{log2_rows} rows and {base} vertices is not read"
        )
    levels, most = [], {"hash": 1 << log2_rows, "tiled": base**3}.get(kind)
    for level in range(count):
        grown = single(np.exp2, np.float32(level) * np.float32(log2_growth))
        scale = grown * np.float32(base) - np.float32(1)
        if not scale < MOST_VERTICES:
            raise FormatError(f"a level of {scale:g} vertices along an axis is not read")
        side = int(np.ceil(scale)) + 1
        rows = padded(side**3, 8) if most is None else min(padded(side**3, 8), most)
        if rows > 1 << 26:
            raise FormatError(f"a grid of {side} vertices along an axis, each with a row, is not read")
        if kind == "tiled" and side * side > rows:  # of which the last axis would not count
            raise FormatError(f"a tiled grid of {side} vertices along an axis in {rows:,} rows is not read")
        hashed = kind == "hash" and hashes(side, rows)
        levels.append({"scale": float(scale), "side": side, "rows": rows, "hashed": hashed, "offset": 0.5})
    return levels


def hashes(side: int, rows: int) -> bool:
    """Whether so many rows are found by a hash. The product that tells wraps at 2³², as there: a level of
    2^16 vertices is none."""
    stride = 1
    for _ in range(3):
        if stride <= rows:
            stride = stride * side % (1 << 32)
    return rows < stride


def single(function, value: float) -> np.float32:
    """A function of a number in float32, rounded as a C library does."""
    return np.float32(function(np.float64(value)))


def rows_of(params: np.ndarray, levels: Sequence[dict], features: int) -> np.ndarray:
    """(rows, features) of a grid, which are all the numbers that are left."""
    rows = sum(level["rows"] for level in levels)
    if len(params) != rows * features:
        raise FormatError(f"a hash grid has {rows * features:,} numbers, found {len(params):,}")
    return params.reshape(rows, features)
