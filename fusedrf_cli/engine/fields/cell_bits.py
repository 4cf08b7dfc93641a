"""The cells of an occupancy grid as files have them (formats/SPEC.md, 2.5): a bit each, or in bricks."""

from dataclasses import dataclass

import numpy as np

from fusedrf_cli.engine.settings import current

BRICK = 4  # cells a side


@dataclass(frozen=True)
class CellBitsConfig:
    """Where bricks are used if they save a quarter."""

    few: int = 1 << 22
    """In grids of more cells; no grid of a fit has more."""
    per_number: float = 0.5
    """In those of more cells for each number of their field: of its bytes the cells' are a twentieth then."""


def few_cells(numbers: int) -> int:
    """Of a grid up to which its bits are stored one after the other beside so many numbers."""
    config = current(CellBitsConfig)
    return min(config.few, int(config.per_number * numbers))


def packed_bits(name: str, grid: np.ndarray, few: int) -> dict[str, np.ndarray]:
    """The arrays of a grid (X, Y, Z) bool of that name: its bits; of more than `few` cells, where that is
    much less, for bricks of BRICK cells a side whether they have any and whether they have all, and the bits
    of the others."""
    packed = {name: np.packbits(grid)}
    if grid.size <= few:
        return packed
    bricks = in_bricks(grid)
    some, full = bricks.any(1), bricks.all(1)
    mixed = np.packbits(bricks[some & ~full], axis=1)
    parts = {f"{name}.bricks": np.packbits(np.stack([some, full])), f"{name}.mixed": mixed}
    return parts if saves(8 * sum(part.nbytes for part in parts.values()), grid.size) else packed


def most_bits(grid: np.ndarray) -> int:
    """At most so many bits for bricks of the cells of a grid (X, Y, Z) bool, or of some of them."""
    some = in_bricks(grid).any(1)
    return -(-2 * some.size // 8) * 8 + BRICK**3 * int(some.sum())


def saves(bits: int, cells: int) -> bool:
    """Whether bricks of so many bits are worth it for so many cells: up to three quarters."""
    return bits < 0.75 * cells


def in_bricks(grid: np.ndarray) -> np.ndarray:
    """(N, BRICK³) the cells of each brick of a grid, filled up to whole ones by the last cells of an axis."""
    grid = np.pad(grid, [(0, -n % BRICK) for n in grid.shape], "edge")
    x, y, z = (n // BRICK for n in grid.shape)
    cells = grid.reshape(x, BRICK, y, BRICK, z, BRICK)
    return cells.transpose(0, 2, 4, 1, 3, 5).reshape(x * y * z, BRICK**3)


def unpack_bits(arrays: dict[str, np.ndarray], name: str, shape: list[int]) -> np.ndarray:
    """Inverse of `packed_bits` for the named array, a grid of a known shape. Raises ValueError naming it."""
    count = int(np.prod(shape))
    packed = arrays.get(name)
    if packed is None and f"{name}.bricks" in arrays:
        return unpacked_bricks(arrays[f"{name}.bricks"], arrays.get(f"{name}.mixed"), name, shape)
    if packed is None or packed.shape != (-(-count // 8),):
        have = "nothing" if packed is None else list(packed.shape)
        raise ValueError(
            f"array '{name}' should have shape {[-(-count // 8)]} for a grid of {shape}, found {have}"
        )
    return np.unpackbits(packed, count=count).reshape(shape).view(bool)


def unpacked_bricks(marks: np.ndarray, mixed: np.ndarray | None, name: str, shape: list[int]) -> np.ndarray:
    """(X, Y, Z) bool of the bricks of a grid. Raises ValueError where they are not its."""
    most = 1 << 26
    if np.prod(shape, dtype=float) > most:
        raise ValueError(f"array '{name}' is of {shape} cells, but at most {most:,} are read")
    counts = [-(-n // BRICK) for n in shape]
    number = int(np.prod(counts))
    if marks.dtype != np.uint8 or marks.shape != (-(-number // 4),):
        raise ValueError(f"array '{name}.bricks' should be {-(-number // 4)} bytes for a grid of {shape}")
    some, full = np.unpackbits(marks, count=2 * number).reshape(2, number).astype(bool)
    some &= ~full
    if mixed is None or mixed.dtype != np.uint8 or mixed.shape != (some.sum(), BRICK**3 // 8):
        raise ValueError(f"array '{name}.mixed' should have {some.sum()} rows of {BRICK**3 // 8} bytes")
    bricks = np.zeros((number, BRICK**3), bool)
    bricks[full] = True
    bricks[some] = np.unpackbits(mixed, axis=1)
    cells = bricks.reshape(*counts, BRICK, BRICK, BRICK).transpose(0, 3, 1, 4, 2, 5)
    return cells.reshape([n * BRICK for n in counts])[tuple(slice(n) for n in shape)].copy()
