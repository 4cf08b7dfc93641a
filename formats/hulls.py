"""Closed meshes as hulls: which points they hold. Axes are the file's own, but for glTF's (meshes.py)."""

from pathlib import Path

import numpy as np

from formats.errors import BadMesh
from formats.meshes import mesh_surfaces

ASKED_AT_ONCE = 1 << 18


class Hull:
    """A closed mesh."""

    def __init__(self, path: Path | str):
        """Raises BadMesh for what is no mesh or not closed, and what reading raises."""
        import trimesh

        parts = [trimesh.Trimesh(s.positions, s.faces) for s in mesh_surfaces(path)[0]]
        self.mesh = trimesh.util.concatenate(parts)
        self.mesh.merge_vertices()
        if not self.mesh.is_watertight:
            raise BadMesh(f"{path}: the mesh is not closed, so that nothing lies inside; close its holes")

    @property
    def box(self) -> np.ndarray:
        """(6,) around it."""
        return np.asarray(self.mesh.bounds, np.float64).reshape(6)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: which points (N, 3) lie inside."""
        found = np.zeros(len(points), bool)
        near = np.flatnonzero(((points >= self.box[:3]) & (points <= self.box[3:])).all(1))
        for part in np.array_split(near, -(-len(near) // ASKED_AT_ONCE) or 1):
            if len(part):
                found[part] = self.mesh.contains(points[part])
        return found
