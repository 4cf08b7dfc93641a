"""glTF's nodes: which are shown, and where they lie."""

from pathlib import Path

import numpy as np

from formats.errors import BadMesh, LimitExceeded, listed
from formats.rotations import matrices
from formats.surfaces import gltf_schema as schema
from formats.surfaces.accessors import Buffers
from formats.surfaces.surface import Notes

INSTANCING = "EXT_mesh_gpu_instancing"
VISIBILITY = "KHR_node_visibility"
MAX_INSTANCES = 1_000_000


class Nodes:
    """The nodes of a document, as its default scene shows them. Raises BadMesh where they are no tree."""

    def __init__(self, document: schema.Document, path: Path | str, buffers: Buffers, notes: Notes):
        self.document, self.path, self.buffers, self.notes = document, path, buffers, notes
        self.hidden = 0
        self.worlds, order = self._worlds()
        """node_to_world (4, 4) of every node."""
        self.shown = self._shown(order)
        """Indices of the nodes that are shown, parents before their children."""

    def tell(self) -> None:
        """Notes about what is not shown."""
        document, shown = self.document, self.shown
        if document.animations:
            self.notes.add(
                f"{len(document.animations)} animations are not played; nodes and weights are as stored"
            )
        meshes = [document.nodes[index].mesh for index in shown if document.nodes[index].mesh is not None]
        placed = set(meshes)
        hidden = [mesh.name or f"mesh {i}" for i, mesh in enumerate(document.meshes) if i not in placed]
        stray = sum(node.mesh in placed for node in document.nodes) - len(meshes)
        if stray and len(document.scenes) < 2 and not self.hidden:
            self.notes.add(f"{stray} nodes with meshes that are shown elsewhere are not in the shown scene")
        if hidden:
            self.notes.add(f"meshes that are not in the shown scene: {listed(hidden)}")

    def _worlds(self) -> tuple[list[np.ndarray], list[int]]:
        """node_to_world (4, 4) of every node, and the nodes with parents before their children."""
        nodes = self.document.nodes
        parents: list[int | None] = [None] * len(nodes)
        for index, node in enumerate(nodes):
            for child in node.children:
                self.buffers.item("nodes", child)
                if parents[child] is not None:
                    raise BadMesh(f"{self.path}: node {child} has two parents; export the file again")
                parents[child] = index
        order = [index for index, parent in enumerate(parents) if parent is None]
        for index in order:  # grows while it is walked
            order.extend(nodes[index].children)
        if len(order) < len(nodes):
            raise BadMesh(f"{self.path}: nodes are their own children; export the file again")
        worlds = [np.eye(4)] * len(nodes)
        for index in order:
            parent = parents[index]
            local = _local(nodes[index])
            worlds[index] = local if parent is None else worlds[parent] @ local
        return worlds, order

    def _shown(self, order: list[int]) -> list[int]:
        """Nodes of the default scene, without those that are hidden."""
        document = self.document
        if document.scene is None and not document.scenes:
            roots = set(order) - {child for node in document.nodes for child in node.children}
        else:
            chosen = document.scene or 0
            scene = self.buffers.item("scenes", chosen)
            roots = set(scene.nodes)
            if len(document.scenes) > 1:
                others = [s.name or f"scene {i}" for i, s in enumerate(document.scenes) if i != chosen]
                self.notes.add(f"shows {scene.name or f'scene {chosen}'}; not shown: {listed(others)}")
        for root in roots:
            self.buffers.item("nodes", root)
        within, shown = set(roots), []
        for index in order:
            if index not in within:
                continue
            node = document.nodes[index]
            visibility = node.extension(VISIBILITY, schema.Visibility, self.path)
            if visibility is not None and not visibility.visible:
                self.hidden += 1
                continue
            within.update(node.children)
            shown.append(index)
        if self.hidden:
            self.notes.add(f"{self.hidden} nodes are hidden by {VISIBILITY} and left out")
        return shown

    def instances(self, index: int) -> list[np.ndarray]:
        """(4, 4) to the world, of each instance of a node."""
        node, world = self.document.nodes[index], self.worlds[index]
        instancing = node.extension(INSTANCING, schema.Instancing, self.path)
        if instancing is None:
            return [world]
        given = {
            name: self.buffers.numbers(instancing.attributes[name], (width,)).astype(np.float64)
            for name, width in (("TRANSLATION", 3), ("ROTATION", 4), ("SCALE", 3))
            if name in instancing.attributes
        }
        counts = {len(rows) for rows in given.values()}
        if len(counts) != 1:
            raise BadMesh(f"{self.path}: {INSTANCING} counts {sorted(counts)} instances, expected one number")
        n = counts.pop()
        if n > MAX_INSTANCES:
            raise LimitExceeded(f"{self.path}: {n:,} instances, at most {MAX_INSTANCES:,} are read")
        local = np.tile(np.eye(4), (n, 1, 1))
        local[:, :3, :3] = _rotations(given.get("ROTATION", np.tile([0.0, 0, 0, 1], (n, 1))))
        local[:, :3, :3] *= given.get("SCALE", np.ones((n, 3)))[:, None]
        local[:, :3, 3] = given.get("TRANSLATION", np.zeros((n, 3)))
        return list(world @ local)


def _local(node: schema.Node) -> np.ndarray:
    """node_to_parent."""
    if node.matrix is not None:
        return np.array(node.matrix).reshape(4, 4).T
    local = np.eye(4)
    if node.rotation is not None:
        local[:3, :3] = _rotations(np.array([node.rotation]))[0]
    if node.scale is not None:
        local[:3, :3] *= node.scale
    if node.translation is not None:
        local[:3, 3] = node.translation
    return local


def _rotations(quaternions: np.ndarray) -> np.ndarray:
    """(n, 3, 3) of (n, 4) xyzw of any length; none where it is zero."""
    lengths = np.linalg.norm(quaternions, axis=1, keepdims=True)
    return matrices(np.where(lengths > 0, quaternions / np.maximum(lengths, 1e-300), [0, 0, 0, 1]))
