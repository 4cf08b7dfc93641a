"""Where a sparse field's bricks are: a tree of them; lattice.py has the vertices over it.

The box is cut into *top cells*, cubic ones where a field was resampled. A node of level l is 2^-l top cells
wide; it is empty, a brick of 4 x 4 x 4 voxels, or split into eight nodes. Vertices are counted in *units*,
voxel sides of the finest level, so that neighbours know each other's vertices whatever their levels.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from fusedrf_cli.engine.encodings.bricks import SIDE
from fusedrf_cli.engine.fields.occupancy import OccupancyGrid
from fusedrf_cli.engine.kernels.reference import OCTANTS
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class BrickLimits:
    """How large a tree of bricks may be."""

    top_cells: int = 1 << 22
    bricks: int = 1 << 22
    entries: int = 1 << 26
    """Of all top cells' tables: 256 MB."""
    entries_at_once: int = 1 << 20
    """While they are filled."""


MAX_LEVEL = 7
EMPTY, BRICK, SPLIT = 0, 1, 2


@dataclass(frozen=True)
class BrickTree:
    """Bricks of several levels in a box, ordered by level, then as a walk through the tree meets them."""

    lo: np.ndarray
    """(3,) float64 lower corner of the box."""
    top: np.ndarray
    """(3,) float64 sides of a top cell, in units of the frame."""
    counts: tuple[int, int, int]
    """Top cells per axis."""
    level: np.ndarray
    """(N,) uint8."""
    at: np.ndarray
    """(N, 3) int64, lower corner of each brick in bricks of its level."""
    mask: np.ndarray
    """(N, 4, 4, 4) bool, the voxels that are active."""
    phase: tuple[int, int, int] = (0, 0, 0)
    """0 or 1 per axis: whether the first top cells are the second ones of the pairs that are stored
    together. It keeps these pairs what they are when the box grows."""

    @classmethod
    def of(
        cls, lo, top, counts, level: np.ndarray, at: np.ndarray, mask: np.ndarray, phase=(0, 0, 0)
    ) -> "BrickTree":
        """The tree of bricks in any order, none inside another; top (3,), or one number for a cube."""
        key = walk_order(level, at, counts)
        order = np.lexsort((key, level))
        counts, phase = (tuple(int(n) for n in three) for three in (counts, phase))
        lo, top = np.asarray(lo, np.float64), sides(top)
        return cls(lo, top, counts, level[order], at[order], mask[order], phase)

    def of_same_box(self, level: np.ndarray, at: np.ndarray, mask: np.ndarray) -> "BrickTree":
        """Other bricks in this tree's top cells."""
        return BrickTree.of(self.lo, self.top, self.counts, level, at, mask, self.phase)

    def coarser(self, halvings: int) -> "BrickTree":
        """The tree whose voxels are at least 2^halvings times as wide as the finest, each active where any
        in it was; in wider top cells where those are needed."""
        finest = self.depth - halvings
        level = np.minimum(self.level.astype(np.int64), finest)
        brick, *inner = np.nonzero(self.mask)
        up = (self.level - level)[brick]
        voxel = (self.at[brick] * SIDE + np.stack(inner, 1)) >> up[:, None]
        wider = max(-finest, 0)
        level, cell = level[brick] + wider, voxel // SIDE
        key, first, back = np.unique(
            np.stack([level, node_keys(cell)], 1), axis=0, return_index=True, return_inverse=True
        )
        mask = np.zeros((len(key), SIDE, SIDE, SIDE), bool)
        mask[(back.ravel(), *(voxel % SIDE).T)] = True
        level, at = key[:, 0].astype(np.uint8), cell[first]
        if not wider:
            return self.of_same_box(level, at, mask)
        counts = -(-np.asarray(self.counts) // 2**wider)
        return BrickTree.of(self.lo, self.top * 2**wider, counts, level, at, mask)

    @property
    def depth(self) -> int:
        """The finest level that there is."""
        return int(self.level.max(initial=0))

    @property
    def aabb(self) -> np.ndarray:
        """(6,) the box."""
        return np.concatenate([self.lo, self.lo + self.top * np.asarray(self.counts)])

    @property
    def unit(self) -> np.ndarray:
        """(3,) sides of a voxel of the finest level."""
        return self.top / (SIDE << self.depth)

    @cached_property
    def codes(self) -> tuple[np.ndarray, ...]:
        """By level: EMPTY, BRICK or SPLIT of every node, (M,) uint8, in the order of the walk, and where it
        is, (M, 3) int64."""
        codes, nodes = [], np.argwhere(np.ones(self.counts, bool))
        for level in range(self.depth + 1):
            level_keys = node_keys(self.at[self.level == level])
            finer = [
                node_keys(self.at[self.level == deep] >> (deep - level))
                for deep in range(level + 1, self.depth + 1)
            ]
            keys = node_keys(nodes)
            code = np.where(np.isin(keys, level_keys), BRICK, EMPTY)
            if finer:
                code = np.where(np.isin(keys, np.unique(np.concatenate(finer))), SPLIT, code)
            codes.append((code.astype(np.uint8), nodes))
            nodes = children(nodes[code == SPLIT])
        return tuple(codes)

    def packed(self) -> tuple[np.ndarray, np.ndarray]:
        """(bytes of the nodes' codes, two bits each, and of the masks, eight per brick)."""
        code = np.concatenate([code for code, _ in self.codes])
        bits = np.stack([code >> 1, code & 1], 1)
        return np.packbits(bits), np.packbits(self.mask.reshape(-1, SIDE**3), axis=1).ravel()

    @classmethod
    def unpacked(cls, lo, top, counts, nodes: np.ndarray, masks: np.ndarray) -> "BrickTree":
        """Inverse of `packed`. Whatever the bytes, nothing is made that is not in proportion to them;
        ValueError where they are no tree."""
        if 4 * len(nodes) < np.prod(counts):
            raise ValueError(
                f"array 'nodes' should tell of {np.prod(counts)} top cells, found {len(nodes)} bytes"
            )
        code = np.unpackbits(nodes).reshape(-1, 4, 2)
        code = (code[..., 0] * 2 + code[..., 1]).ravel()
        here, start, levels, positions = np.argwhere(np.ones(counts, bool)), 0, [], []
        for level in range(MAX_LEVEL + 2):
            level_codes = code[start : start + len(here)]
            if (
                len(level_codes) < len(here)
                or (level_codes > SPLIT).any()
                or (level > MAX_LEVEL and len(here))
            ):
                raise ValueError("array 'nodes' is no tree of bricks")
            start += len(here)
            positions.append(here[level_codes == BRICK])
            levels.append(np.full(len(positions[-1]), level, np.uint8))
            here = children(here[level_codes == SPLIT])
            if not len(here):
                break
        if -(-start // 4) != len(nodes) or code[start:].any():
            raise ValueError(f"array 'nodes' should have {-(-start // 4)} bytes, found {len(nodes)}")
        level, at = np.concatenate(levels), np.concatenate(positions)
        if masks.shape != (8 * len(level),):
            raise ValueError(f"array 'masks' should have shape {[8 * len(level)]}, found {list(masks.shape)}")
        mask = np.unpackbits(masks).reshape(-1, SIDE, SIDE, SIDE).astype(bool)
        return cls(np.asarray(lo, np.float64), sides(top), tuple(counts), level, at, mask)

    @cached_property
    def bits(self) -> np.ndarray:
        """(N,) uint64, the masks: voxel (i, j, k) is bit (i * 4 + j) * 4 + k."""
        weights = np.uint64(1) << np.arange(SIDE**3, dtype=np.uint64)
        return (self.mask.reshape(-1, SIDE**3) * weights).sum(1, dtype=np.uint64)

    @cached_property
    def tables(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(offset (X, Y, Z) int64, depth (X, Y, Z) uint8, table (E,) int32) as encodings/bricks.py has
        them. Raises ValueError where they would be too large."""
        limits = current(BrickLimits)
        depth = np.zeros(self.counts, np.uint8)
        is_brick = np.zeros(self.counts, bool)
        for level in range(self.depth + 1):
            cell = tuple((self.at[self.level == level] >> level).T)
            depth[cell], is_brick[cell] = level, True
        sizes = np.where(is_brick, 1 << (3 * depth.astype(np.int64)), 0)
        if sizes.sum() > limits.entries:
            raise ValueError(
                f"bricks so fine in cells so large need {sizes.sum():,} entries, at most {limits.entries:,}"
            )
        offset = np.where(is_brick, (np.cumsum(sizes) - sizes.ravel()).reshape(sizes.shape), -1)
        table = np.empty(int(sizes.sum()), np.int32)
        for level, (code, nodes) in enumerate(self.codes):
            bare = nodes[code == EMPTY]
            fill_cubes(table, offset, depth, level, bare, np.full(len(bare), -1 - level, np.int32))
            bricks = np.flatnonzero(self.level == level).astype(np.int32)
            fill_cubes(table, offset, depth, level, self.at[bricks], bricks)
        return offset, depth, table

    def voxels_at(
        self, halves: np.ndarray, n: int, active: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(brick, or -1; voxel in it, counted along its n a side; whether that is active) at points (M, 3)
        int64 given in odd halves of a unit, which is a finest voxel."""
        offset, depth, table = self.tables
        span = 2 * SIDE << self.depth
        cell = halves // span
        inside = ((cell >= 0) & (cell < np.asarray(self.counts))).all(1)
        cell = np.where(inside[:, None], cell, 0)
        start, deep = offset[tuple(cell.T)], depth[tuple(cell.T)].astype(np.int64)
        inside &= start >= 0
        entry = ((halves - cell * span) << deep[:, None]) // span
        entry = (entry[:, 0] << 2 * deep) + (entry[:, 1] << deep) + entry[:, 2] + start
        brick = np.where(inside, table[np.where(inside, entry, 0)], -1)
        in_brick = brick >= 0
        safe = np.where(in_brick, brick, 0)
        side = span >> self.level[safe].astype(np.int64)
        voxel = (halves - self.at[safe] * side[:, None]) * n // side[:, None]
        voxel = np.where(in_brick[:, None], voxel, 0)
        voxel = (voxel[:, 0] * n + voxel[:, 1]) * n + voxel[:, 2]
        return np.where(in_brick, brick, -1), voxel, in_brick & active[safe, voxel]

    def occupancy(self, longest: int) -> OccupancyGrid:
        """Cells that active voxels reach: top cells, or their halves or quarters while at most `longest` of
        them lie along an axis."""
        fine = max(s for s in range(3) if s == 0 or max(self.counts) << s <= longest)
        occupied = np.zeros(tuple(n << fine for n in self.counts), bool)
        for level in range(self.depth + 1):
            at_level = self.level == level
            # a cell is at least a voxel of level 0 wide: of a wider brick it is one of n³ equal parts
            finer, coarser = max(fine - level, 0), max(level - fine, 0)
            n, m = 1 << finer, SIDE >> finer
            brick, *inner = np.nonzero(self.mask[at_level].reshape(-1, n, m, n, m, n, m).any((2, 4, 6)))
            part = self.at[at_level][brick] * n + np.stack(inner, 1)
            occupied[tuple((part >> coarser).T)] = True
        return OccupancyGrid(self.aabb, occupied)


def table_entries(nodes: np.ndarray, top: int) -> tuple[int, int]:
    """How many entries the tables of `top` top cells have, at most, and how deep these go, as their nodes'
    codes tell (`packed`)."""
    limits = current(BrickLimits)
    code = np.unpackbits(nodes).reshape(-1, 2)
    split = (code[:, 0] == 1) & (code[:, 1] == 0)
    level, start, count, cells = 0, 0, top, 0
    while count and start < len(split):
        inner = int(np.count_nonzero(split[start : start + count]))
        cells = inner if level == 0 else cells
        start, count, level = start + count, 8 * inner, level + 1
    depth = min(level - 1, MAX_LEVEL)
    return min(top + cells * 8**depth, limits.entries), depth


def sides(top) -> np.ndarray:
    """(3,) float64 of three sides, or of one for all."""
    return np.broadcast_to(np.asarray(top, np.float64), 3).copy()


def check_counts(counts) -> None:
    """Raise ValueError where there are more top cells than a tree may have."""
    limits = current(BrickLimits)
    longest = (1 << 20) // (SIDE << MAX_LEVEL)  # so that positions in units fit in 21 bits
    if max(counts) > longest or np.prod(np.asarray(counts, np.float64)) > limits.top_cells:
        raise ValueError(
            f"counts should be at most {longest} top cells each and {limits.top_cells} in all, found "
            f"{list(counts)}"
        )


def children(nodes: np.ndarray) -> np.ndarray:
    """(8 M, 3) the eight nodes that each of (M, 3) is split into."""
    return (2 * nodes[:, None] + OCTANTS).reshape(-1, 3)


def node_keys(positions: np.ndarray) -> np.ndarray:
    """(M,) one int64 for each of (M, 3) whole numbers from 0 to 2^21 - 1, in their order."""
    return (positions[:, 0] << 42) | (positions[:, 1] << 21) | positions[:, 2]


def key_positions(keys: np.ndarray) -> np.ndarray:
    """Inverse of `node_keys`."""
    low = (1 << 21) - 1
    return np.stack([keys >> 42, keys >> 21 & low, keys & low], 1)


def morton(positions: np.ndarray) -> np.ndarray:
    """(M,) uint64: the bits of three whole numbers (M, 3) from 0 to 2^21 - 1, interleaved, x the highest."""
    spread = (  # shifts and masks that put two zeros behind each of 21 bits
        (32, 0x1F00000000FFFF),
        (16, 0x1F0000FF0000FF),
        (8, 0x100F00F00F00F00F),
        (4, 0x10C30C30C30C30C3),
        (2, 0x1249249249249249),
    )
    codes = np.zeros(len(positions), np.uint64)
    for axis in range(3):
        bits = positions[:, axis].astype(np.uint64)
        for shift, mask in spread:
            bits = (bits | bits << np.uint64(shift)) & np.uint64(mask)
        codes |= bits << np.uint64(2 - axis)
    return codes


def walk_order(level: np.ndarray, at: np.ndarray, counts) -> np.ndarray:
    """(N,) int64 that sorts nodes of one level as a walk through the tree, all levels at once, meets them."""
    cell = at >> level[:, None].astype(np.int64)
    key = (cell[:, 0] * counts[1] + cell[:, 1]) * counts[2] + cell[:, 2]
    for bit in range(MAX_LEVEL - 1, -1, -1):
        below = level > bit
        digit = (at >> bit) & 1
        key = np.where(below, key * 8 + digit @ [4, 2, 1], key)
    return key


def fill_cubes(
    table: np.ndarray,
    offset: np.ndarray,
    depth: np.ndarray,
    level: int,
    nodes: np.ndarray,
    values: np.ndarray,
) -> None:
    """Write values (M,) into the entries that nodes (M, 3) of a level cover, in those top cells that have a
    table."""
    limits = current(BrickLimits)
    cell = nodes >> level
    start, deep = offset[tuple(cell.T)], depth[tuple(cell.T)].astype(np.int64)
    for finer in range(MAX_LEVEL - level + 1):
        reached = np.flatnonzero((start >= 0) & (deep == level + finer))
        at_once = max(1, limits.entries_at_once >> 3 * finer)
        for first in range(0, len(reached), at_once):
            cubes = reached[first : first + at_once]
            a, b, c = ((nodes[cubes] - (cell[cubes] << level)) << finer).T
            side = np.arange(1 << finer)
            n = 1 << (level + finer)
            entry = ((a[:, None] + side) * n)[:, :, None] + (b[:, None] + side)[:, None, :]
            entry = (entry * n)[..., None] + (c[:, None] + side)[:, None, None, :]
            table[entry + start[cubes][:, None, None, None]] = values[cubes][:, None, None, None]
