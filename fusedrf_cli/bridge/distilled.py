"""Objects that were distilled into a field with others: the history tells where they stand."""

import numpy as np

from formats.blocks import UNNAMED
from formats.bundle import OpenBundle
from formats.graph import belongs
from formats.scene import Leaf, SceneGraph
from fusedrf_cli.bridge.scene import make_field
from fusedrf_cli.bridge.sources import leaf_of, source_of
from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import shown_at
from fusedrf_cli.engine.kinds.field_cutting import CORNERS


def holders_in(graph: SceneGraph) -> list[Leaf]:
    """The nodes of the fields that objects were distilled into, and of what filled earlier cuts."""
    leaves = [leaf for leaf in graph.leaves() if leaf.field is not None]
    return [leaf for leaf in leaves if belongs(leaf.name, UNNAMED)] or leaves


class DistilledShape:
    """Where an object is that was distilled into a field with others: in the occupied cells of its source, or
    where that is not found in its box."""

    def __init__(self, entry: dict, bundle: OpenBundle, beside: float):
        """entry: what the history says of it; beside: how far from that, in the world, it may reach, since
        the field is coarser."""
        self.box, self.beside = np.asarray(entry["aabb"], np.float64), beside
        own = source_of(entry, leaf_of(entry), bundle, False)
        self.placed = [
            Placed(leaf.name, make_field(file.field(member), str(file.path)), leaf.object_to_world)
            for leaf, file, member in own
        ]

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: which points (N, 3) of the world may be its."""
        near = np.concatenate([np.zeros((1, 3)), self.beside * 2 * CORNERS])
        return np.any([self.covers(points + offset) for offset in near], 0)

    def covers(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: which points (N, 3) of the world lie in its source's cells, or in its box."""
        if not self.placed:
            return inside(points, self.box)
        return np.any([shown_at(one, points) for one in self.placed], 0)


def inside(points: np.ndarray, box: np.ndarray) -> np.ndarray:
    """(N,) bool: which points (N, 3) lie in a box (6,)."""
    return ((points >= box[:3]) & (points <= box[3:])).all(1)
