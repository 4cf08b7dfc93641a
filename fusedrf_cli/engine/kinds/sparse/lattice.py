"""The vertices of a sparse field's voxels: which there are, which hang on others, and in which order they are
stored."""

from functools import cached_property

import numpy as np
from scipy import sparse

from fusedrf_cli.engine.encodings.bricks import COARSE, SIDE
from fusedrf_cli.engine.kernels.reference import OCTANTS
from fusedrf_cli.engine.kinds.sparse.bricks import MAX_LEVEL, BrickTree, key_positions, morton, node_keys


class VertexLattice:
    """The vertices of a tree's voxels, with n of these along a brick's side: 4, or 2 or 1 of wider ones.

    A vertex that lies on an edge or a face of a wider voxel without being its corner *hangs*: its numbers are
    that voxel's, interpolated, so that neighbouring levels join without a crack. Rows are those of the free
    vertices, in the order in which bricks need them, and behind them those of the hanging ones.
    """

    def __init__(self, tree: BrickTree, n: int):
        """Raises ValueError where the tree is too large."""
        self.tree, self.n = tree, n
        m = SIDE // n
        wide = tree.mask.reshape(-1, n, m, n, m, n, m).any((2, 4, 6))
        self.active = wide.reshape(-1, n**3)
        used = np.zeros((len(wide), n + 1, n + 1, n + 1), bool)
        for a, b, c in OCTANTS:
            used[:, a : a + n, b : b + n, c : c + n] |= wide
        self.used = used.reshape(-1, (n + 1) ** 3)
        of_bricks = self._keys()
        keys, first, inverse = np.unique(of_bricks, return_index=True, return_inverse=True)
        vertices = key_positions(keys)
        hanging, parents = self._constraints(vertices, of_bricks)
        rank = np.empty(len(keys), np.int64)
        rank[np.lexsort((first, hanging))] = np.arange(len(keys))
        self.free = int(np.count_nonzero(~hanging))
        self.rows = np.full(self.used.shape, -1, np.int32)
        self.rows[self.used] = rank[inverse]
        self.vertices = np.empty_like(vertices)
        """(V, 3) int64 in units of the tree, free ones first."""
        self.vertices[rank] = vertices
        self.spread = self._spread(keys, rank, hanging, parents)
        self._coarser: dict[int, VertexLattice] = {}

    def coarser(self, halvings: int) -> "VertexLattice":
        """The vertices of `BrickTree.coarser`, made once."""
        if not halvings:
            return self
        if halvings not in self._coarser:
            self._coarser[halvings] = VertexLattice(self.tree.coarser(halvings), self.n)
        return self._coarser[halvings]

    @cached_property
    def wider(self) -> "VertexLattice":
        """The vertices of the same tree with COARSE voxels a side of a brick."""
        return VertexLattice(self.tree, COARSE)

    @property
    def width(self) -> np.ndarray:
        """(N,) int64 side of the bricks' voxels, in units."""
        return (SIDE // self.n) << (self.tree.depth - self.tree.level.astype(np.int64))

    @cached_property
    def positions(self) -> np.ndarray:
        """(V, 3) float64 vertices in the frame of the tree."""
        return self.tree.lo + self.vertices * self.tree.unit

    @cached_property
    def keys(self) -> np.ndarray:
        """(V,) int64, one for each vertex, that stays the same whatever else the box holds."""
        return node_keys(self.vertices << (MAX_LEVEL - self.tree.depth))

    def find(self, keys: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(N,) rows of the vertices of those keys, and whether there is such a vertex."""
        order = np.argsort(self.keys)
        row = order[np.minimum(np.searchsorted(self.keys, keys, sorter=order), len(order) - 1)]
        return row, self.keys[row] == keys

    @cached_property
    def stored_order(self) -> tuple[np.ndarray, np.ndarray]:
        """Which free row (F,) each stored one is, and how many of these (R,) int32 lie in each run: the rows
        of 2 x 2 x 2 top cells, as a Morton curve meets them. What changes in one moves no row of another."""
        units = SIDE << MAX_LEVEL  # of the finest level that there may be, along a top cell
        positions = self.vertices[: self.free] << (MAX_LEVEL - self.tree.depth)
        code = morton(positions + np.asarray(self.tree.phase) * units)
        order = np.argsort(code)
        eight_cells = (code[order] >> 3 * units.bit_length()).astype(np.int64)
        starts = np.flatnonzero(np.diff(eight_cells, prepend=-1))
        return order, np.diff(np.append(starts, self.free)).astype(np.int32)

    @cached_property
    def corners(self) -> np.ndarray:
        """(K, 8) int32 rows of every active voxel's corners, bricks in order."""
        n = self.n
        brick, voxel = np.nonzero(self.active)
        i, j, k = voxel // n**2, voxel // n % n, voxel % n
        first = (i * (n + 1) + j) * (n + 1) + k
        return self.rows[brick[:, None], first[:, None] + corner_offsets(n)]

    @cached_property
    def finest_voxel(self) -> np.ndarray:
        """(V,) float64 shortest side of the smallest voxel around each vertex, in the tree's frame."""
        brick = np.broadcast_to(self.width[:, None], self.used.shape)[self.used]
        finest = np.full(len(self.vertices), np.iinfo(np.int64).max)
        np.minimum.at(finest, self.rows[self.used], brick)
        return finest * self.tree.unit.min()

    @cached_property
    def spreading(self) -> tuple[np.ndarray, ...]:
        """(start, source, weight, target) as `sums_of_rows` takes them: hanging rows from free ones."""
        return (*csr(self.spread), np.arange(self.free, len(self.vertices)))

    @cached_property
    def gathering(self) -> tuple[np.ndarray, ...]:
        """The adjoint of `spreading`: what free rows gain from hanging ones."""
        start, source, weight = csr(self.spread.T)
        target = np.flatnonzero(np.diff(start))
        return np.append(start[target], start[-1]), source + self.free, weight, target

    def _keys(self) -> np.ndarray:
        """Keys of all used vertices, brick by brick."""
        width = self.width[:, None]
        inner = np.stack(np.meshgrid(*[np.arange(self.n + 1)] * 3, indexing="ij"), -1).reshape(-1, 3)
        # the key of a sum of places is the sum of their keys
        return (node_keys(self.tree.at * (self.n * width))[:, None] + node_keys(inner) * width)[self.used]

    def _constraints(self, vertices: np.ndarray, used: np.ndarray) -> tuple[np.ndarray, tuple]:
        """(V,) bool which vertices hang, and of those (rows' keys (H, 8), weights (H, 8)) of what they hang
        on; used: the keys of all used vertices, brick by brick."""
        tree, n = self.tree, self.n
        hanging = np.zeros(len(vertices), bool)
        nothing = np.zeros((0, 8), np.int64), np.zeros((0, 8))
        if len(np.unique(tree.level)) < 2:
            return hanging, nothing
        tried = np.flatnonzero(self._beside_wider(vertices, used))
        widest = np.zeros(len(tried), np.int64)
        holder = np.zeros((2, len(tried)), np.int64)
        for octant in OCTANTS:
            brick, voxel, active = tree.voxels_at(2 * vertices[tried] + 2 * octant - 1, n, self.active)
            width = np.where(active, self.width[brick], 0)
            wider = width > widest
            widest = np.where(wider, width, widest)
            holder = np.where(wider, [brick, voxel], holder)
        base = tree.at[holder[0]] * (n * widest)[:, None]
        voxel = np.stack([holder[1] // n**2, holder[1] // n % n, holder[1] % n], 1)
        low = base + voxel * widest[:, None]
        share = (vertices[tried] - low) / np.maximum(widest, 1)[:, None]
        hangs = ((share > 0) & (share < 1)).any(1)
        hanging[tried[hangs]] = True
        low, share, wide = low[hangs], share[hangs], widest[hangs]
        corners = low[:, None] + OCTANTS * wide[:, None, None]
        weights = np.where(OCTANTS == 1, share[:, None], 1 - share[:, None]).prod(2)
        return hanging, (node_keys(corners.reshape(-1, 3)).reshape(-1, 8), weights)

    def _beside_wider(self, vertices: np.ndarray, used: np.ndarray) -> np.ndarray:
        """(V,) bool, which vertices belong to bricks beside, or at a corner of, one of a coarser level; used
        as `_constraints` has it."""
        tree = self.tree
        span = 2 * SIDE << (tree.depth - tree.level.astype(np.int64))
        everywhere = np.ones((len(tree.level), 1), bool)
        has_wider = np.zeros(len(tree.level), bool)
        for step in np.argwhere(np.ones((3, 3, 3), bool)) - 1:
            beside = tree.at * span[:, None] + span[:, None] // 2 + step * span[:, None]
            brick, _, _ = tree.voxels_at(beside, 1, everywhere)
            has_wider |= (brick >= 0) & (tree.level[brick] < tree.level)
        keys = used[np.repeat(has_wider, self.used.sum(1))]
        return np.isin(node_keys(vertices), keys)

    def _spread(
        self, known: np.ndarray, rank: np.ndarray, hanging: np.ndarray, parents: tuple
    ) -> sparse.csr_matrix:
        """(H, F) weights by which hanging rows follow from free ones."""
        keys, weights = parents
        count, free = len(rank), self.free
        if not len(keys):
            return sparse.csr_matrix((0, free))
        needed, indices = keys[weights > 0], np.nonzero(weights > 0)[0]
        columns = rank[np.searchsorted(known, needed)]
        hanging_rows = rank[hanging] - free
        matrix = sparse.csr_matrix(
            (weights[weights > 0], (hanging_rows[indices], columns)), shape=(count - free, count)
        )
        direct, through = matrix[:, :free], matrix[:, free:]
        total, step = direct, direct
        while (
            step := through @ step
        ).nnz:  # a parent may hang on a wider voxel still: as often as there are levels
            total = total + step
        return total.tocsr()


def csr(matrix) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """(start, source, weight) of a sparse matrix, row by row."""
    rows = matrix.tocsr()
    return rows.indptr.astype(np.int64), rows.indices.astype(np.int64), rows.data


def corner_offsets(n: int) -> np.ndarray:
    """(8,) offsets of a voxel's corners from its first in a brick of n voxels a side, as `corner` of
    encodings/bricks.py."""
    return (OCTANTS * [(n + 1) ** 2, n + 1, 1]).sum(1)
