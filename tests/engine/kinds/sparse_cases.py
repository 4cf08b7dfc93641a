"""Small sparse fields of random bricks and numbers."""

import numpy as np
import torch

from fusedrf_cli.engine.encodings.bricks import SIDE
from fusedrf_cli.engine.kinds.sparse.bricks import BrickTree, children, node_keys
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape
from fusedrf_cli.engine.kinds.sparse.lattice import VertexLattice

LO, TOP, COUNTS = np.array([-1.0, -0.7, 0.2]), np.array([0.6, 0.7, 0.55]), (3, 2, 3)


def random_tree(depth: int, seed: int = 0, filled: float = 0.7) -> BrickTree:
    """Top cells of which some are split, and some of their nodes again, down to a depth."""
    rng = np.random.default_rng(seed)
    nodes, levels, places = np.argwhere(np.ones(COUNTS, bool)), [], []
    for level in range(depth + 1):
        draw = rng.random(len(nodes))
        split = (draw < 0.35) & (level < depth)
        if level < depth and len(nodes):
            split[0] = True
        leaf = ~split & (rng.random(len(nodes)) < filled)
        leaf[1:2] |= ~split[1:2]
        places.append(nodes[leaf])
        levels.append(np.full(len(places[-1]), level, np.uint8))
        nodes = children(nodes[split])
    level, at = np.concatenate(levels), np.concatenate(places)
    mask = rng.random((len(level), SIDE, SIDE, SIDE)) < 0.8
    mask[:, 0, 0, 0] = True
    assert len(np.unique(node_keys(at) * 8 + level)) == len(level)
    return BrickTree.of(LO, TOP, COUNTS, level, at, mask)


def random_sparse(
    degree: int = 2, depth: int = 2, dtype=torch.float64, seed: int = 0, scale: float = 4.0
) -> SparseField:
    """A sparse field of random numbers, dense enough to see. Tests ask for degrees 0 and 2 alone, since each
    is compiled."""
    bare = SparseField(SparseShape(degree), VertexLattice(random_tree(depth, seed), SIDE), scale)
    generator = torch.Generator().manual_seed(seed)
    field = bare.with_params(torch.randn(bare.size, generator=generator, dtype=torch.float64).to(dtype))
    held = bare.with_params(torch.zeros_like(field.params))
    held.rows[:], held.bands[:] = field.rows, field.bands  # what is there for alignment stays 0
    field = held
    field.settle()
    return field
