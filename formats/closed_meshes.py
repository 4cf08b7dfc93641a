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

        parts = [trimesh.Trimesh(s.positions, s.faces, process=False) for s in mesh_surfaces(path)[0]]
        self.mesh = trimesh.util.concatenate(parts)
        self.box = np.asarray(self.mesh.bounds, np.float64).reshape(6)
        self.centre, self.size = (self.box[:3] + self.box[3:]) / 2, float(np.ptp(self.mesh.bounds, 0).max())
        self.mesh.vertices = self.seen(self.mesh.vertices)
        self.mesh.merge_vertices()
        if not self.mesh.is_watertight:
            raise BadMesh(f"{path}: the mesh is not closed, so that nothing lies inside; close its holes")

    def seen(self, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) about the middle of the mesh, in its size: trimesh has tolerances without a unit."""
        return (points - self.centre) / (self.size or 1.0)

    def contains(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: which points (N, 3) lie inside."""
        inside = np.zeros(len(points), bool)
        near = np.flatnonzero(((points >= self.box[:3]) & (points <= self.box[3:])).all(1))
        for part in np.array_split(near, -(-len(near) // ASKED_AT_ONCE) or 1):
            if len(part):
                inside[part] = self.mesh.contains(self.seen(points[part]))
        return inside
