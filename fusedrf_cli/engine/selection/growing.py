"""Choosing by points: a random walker (Grady 2006) from the cells that were pointed at, which seldom steps
from one colour to another."""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, diags
from scipy.sparse.linalg import cg

from fusedrf_cli.engine.selection.cells import CellGrid, Selection
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class GrowingConfig:
    """How a random walker steps from cell to cell."""

    colour: float = 0.08
    """Difference of colour at which a step is 1/e as likely."""
    least: float = 1e-4
    reach: float = 1.8
    """Cells around a point that are as it is."""
    tolerance: float = 1e-4
    steps: int = 2000


def chosen_by_points(
    lattice: CellGrid, inside: np.ndarray, outside: np.ndarray, cut: np.ndarray
) -> Selection:
    """The cells from which a random walker more probably comes to points inside of the object (K, 3) than to
    points outside (L, 3), of the field's frame, or to cells `cut` (M,) bool, where density goes on that is
    not its; where there is neither, than to the border of the lattice."""
    dense = lattice.kept(lattice.dense)
    object_seeds = seeds(dense, inside)
    other = (seeds(dense, outside) | cut[lattice.dense]) & ~object_seeds
    if not other.any():
        other = at_border(dense) & ~object_seeds
    likely = walked(dense, object_seeds, other)
    mask = np.zeros(dense.grid.occupied.shape, bool)
    mask[dense.grid.occupied] = likely > 0.5
    # what is thin around it goes along
    grown = dense.grid.marked(mask).dilated().occupied & ~(dense.grid.occupied & ~mask)
    chosen = grown[lattice.grid.occupied]
    weights = lattice.spread(np.zeros(len(chosen)))
    weights[dense.grid.occupied] = object_seeds + 1e-6
    chosen = lattice.pieces(chosen, weights[lattice.grid.occupied])
    sure = float(np.abs(2 * likely[likely > 0.5] - 1).mean()) if (likely > 0.5).any() else 0.0
    return Selection(lattice, chosen, sure)


def seeds(lattice: CellGrid, points: np.ndarray) -> np.ndarray:
    """(M,) bool: the cells around points (K, 3) of the field's frame."""
    config = current(GrowingConfig)
    marked = np.zeros(len(lattice.points), bool)
    for point in points:
        away = np.linalg.norm(lattice.points - point, axis=1)
        marked |= away < np.maximum(config.reach * lattice.widths, away.min(initial=np.inf) * 1.001)
    return marked


def at_border(lattice: CellGrid) -> np.ndarray:
    """(M,) bool: the cells on the sides of the lattice's box."""
    last = np.array(lattice.grid.occupied.shape) - 1
    return ((lattice.index == 0) | (lattice.index == last)).any(1)


def walked(lattice: CellGrid, object_cells: np.ndarray, other: np.ndarray) -> np.ndarray:
    """(M,) the probability that a walker comes to one of its own cells before one of the others."""
    config = current(GrowingConfig)
    answer = object_cells.astype(float)
    free = ~object_cells & ~other
    if not free.any():
        return answer
    pairs, likely = steps(lattice)
    count = len(object_cells)
    ends = np.concatenate([pairs, pairs[:, ::-1]])
    graph = coo_matrix((np.tile(likely, 2), ends.T), shape=(count, count)).tocsr()
    degree = np.asarray(graph.sum(1)).ravel() + 1e-9
    inner = graph[free]
    system = diags(degree[free]) - inner[:, free]
    sources = inner[:, object_cells].sum(1)
    scale = diags(1 / degree[free])
    probability, _ = cg(
        system, np.asarray(sources).ravel(), rtol=config.tolerance, maxiter=config.steps, M=scale
    )
    answer[free] = probability
    return answer


def steps(lattice: CellGrid) -> tuple[np.ndarray, np.ndarray]:
    """(E, 2) pairs of cells that lie side by side, and (E,) how likely a step from one to the other is."""
    config = current(GrowingConfig)
    number = np.full(lattice.grid.occupied.shape, -1)
    number[lattice.grid.occupied] = np.arange(len(lattice.index))
    pairs = []
    for axis in range(3):
        low = np.delete(number, -1, axis)
        high = np.delete(number, 0, axis)
        both = (low >= 0) & (high >= 0)
        pairs.append(np.stack([low[both], high[both]], 1))
    edges, colours = np.concatenate(pairs), lattice.colours()
    differs = ((colours[edges[:, 0]] - colours[edges[:, 1]]) ** 2).sum(1)
    return edges, np.exp(-differs / config.colour**2) + config.least
