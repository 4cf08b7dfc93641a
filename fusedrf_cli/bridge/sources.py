"""What a bundle was made of, found again: `fuse FUSED.rfpack` fuses it once more from its sources."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from formats.blocks import RULE, UNNAMED
from formats.bundle import OpenBundle, is_bundle, sha256_of
from formats.embedding import in_place_of
from formats.graph import belongs, placement_of, with_leaves, with_nodes
from formats.history import check_history, distilled, sources
from formats.nodes import WHITE, Leaf, Node
from formats.scene import SceneGraph
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.scene import FoundField, LoadedScene, load_fields, load_scene
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.requests import FuseRequest


def load_to_fuse(request: FuseRequest, memory: Memory, device: str, progress) -> LoadedScene:
    """The scene that is to be fused: of a fused bundle its objects as they were before, where all of them are
    found; with a warning the bundle's own fields, where not. Raises InvalidInput where a folder was named
    that lacks one, UsageProblem where there is nothing to be found."""
    bundle = None if request.scene == "-" or not is_bundle(request.scene) else OpenBundle(request.scene)
    graph = None if bundle is None else bundle.scene
    if graph is None or not is_fused(graph):
        if request.sources:
            raise UsageProblem(f"--sources applies to a fused bundle; {request.scene} tells of no sources")
        return load_scene(request.scene, request.allow_outside, memory, device)
    check_history(graph, request.scene)
    elsewhere = SourceFolder(request.sources) if request.sources else None
    anew, homes, missing = with_sources(bundle, elsewhere, request.allow_outside)
    if not missing:
        leaves = [(leaf, homes[leaf.field], leaf.field) for leaf in anew.leaves() if leaf.visible]
        progress.tell(f"{request.scene} is fused anew from its {len(leaves)} sources")
        return load_fields(Path(request.scene), anew, leaves, memory, device)
    problem = f"{request.scene}: the source of '{missing[0]}' is not found as it was"
    if request.sources:
        raise InvalidInput(f"{problem}, neither where its history says nor in {request.sources}")
    progress.warn(f"{problem}: what is fused are the fields that it has; --sources DIR looks elsewhere")
    return load_scene(request.scene, request.allow_outside, memory, device)


def scene_as_stored(request: FuseRequest, memory: Memory, device: str, progress) -> LoadedScene:
    """The scene or field that was named, whatever it was made of."""
    return load_scene(request.scene, request.allow_outside, memory, device)


def is_fused(graph: SceneGraph) -> bool:
    """Whether a bundle was made by `fuse`."""
    return bool(graph.history) and graph.history[0].get("event") == "fused"


def with_sources(
    bundle: OpenBundle, elsewhere: "SourceFolder | None", allow_outside: bool
) -> tuple[SceneGraph, dict[str, OpenBundle], list[str]]:
    """The scene of a fused bundle with the fields that it was made of, the bundle in which each member lies,
    and the names of objects of which no file is found. A node is its own source where its field is that of
    the source."""
    scene, homes, missing = bundle.scene, {}, []
    made_of, inside = sources(scene.history), distilled(scene.history)

    def placed(name: str, entry: dict) -> tuple[Node, ...]:
        own = source_of(entry, Leaf(name, None, None, np.eye(4), False), bundle, allow_outside, elsewhere)
        missing.extend([] if own else [name])
        homes.update({member: file for _, file, member in own})
        alone = f"{name}/source" if len(own) == 1 else None
        return tuple(node_of(leaf, alone or leaf.name, member) for leaf, _, member in own)

    def with_source(node: Node) -> Node | None:
        if inside and belongs(node.name, UNNAMED):  # it stands for those inside
            return None
        if node.field not in made_of:
            homes[node.field] = bundle
            return node
        own = placed(node.name, made_of[node.field])
        return in_place_of(replace(node, field=None), own, scene.composition, RULE) if own else node

    scene = with_leaves(scene, with_source)
    for name, entry in inside.items():
        matrix = np.asarray(entry["object_to_world"], np.float64)
        own = bool(entry.get("background")), entry.get("source_matrix")
        node = Node(name, None, None, placement_of(matrix), own[0], source_matrix=own[1])
        if own := placed(name, entry):
            scene = with_nodes(scene, [in_place_of(node, own, scene.composition, RULE)])
    composition = scene.history[0].get("composition", "max") if inside else scene.composition
    return replace(scene, history=(), composition=composition), homes, missing


def node_of(leaf: Leaf, name: str, member: str) -> Node:
    """A node of a member that lies as a leaf does."""
    tint = {} if leaf.tint == WHITE else {"tint": list(leaf.tint)}
    return Node(name, member, None, placement_of(leaf.object_to_world), leaf.background, (), {}, tint)


def leaf_of(node: dict) -> Leaf:
    """Where an object that was distilled into a field stands."""
    matrix = np.asarray(node["object_to_world"], np.float64)
    return Leaf(node["name"], node.get("field"), None, matrix, bool(node.get("background")))


def source_of(
    info: dict,
    leaf: Leaf,
    bundle: OpenBundle,
    allow_outside: bool,
    elsewhere: "SourceFolder | None" = None,
) -> list[FoundField]:
    """The fields that a leaf of a bundle was made of, as its history tells: kept inside, or in a file that is
    as it was, where it was or elsewhere. Nothing where it is not found."""
    is_inside = info.get("kept") or not info.get("sha256")
    file = bundle if is_inside and bundle.placed(info.get("field", "")) else None
    if file is None:
        file = source_bundle(info, bundle.path, allow_outside, elsewhere)
    parts = () if file is None else file.placed(info.get("field", ""))
    if instance := info.get("instance"):
        parts = [part for part in parts if part.name == instance]
    leaves = []
    for part in parts:
        name = leaf.name if len(parts) == 1 else f"{leaf.name}/{part.name}"
        inner = Leaf(name, part.member, None, part.object_to_field, False, tint=part.tint)
        at_rest = bool(instance)  # the leaf stands where that part stood
        inner = replace(inner, object_to_world=np.eye(4), tint=(1.0, 1.0, 1.0)) if at_rest else inner
        leaves.append((inner.inside(leaf), file, part.member))
    return leaves


def source_bundle(
    info: dict, path: Path, allow_outside: bool, elsewhere: "SourceFolder | None"
) -> OpenBundle | None:
    """The bundle that a history names by its checksum: where it was, else in the folder given."""
    if not info.get("sha256"):
        return None
    folder = path.resolve().parent
    named = (folder / info.get("source", "")).resolve()
    may_be_read = allow_outside or named.is_relative_to(folder)
    if may_be_read and (bundle := unchanged(named, info["sha256"])):
        return bundle
    file = elsewhere and elsewhere.find(info["sha256"])
    return None if file is None else unchanged(file, info["sha256"])


def unchanged(path: Path, sha256: str) -> OpenBundle | None:
    """The bundle at a path, if there is one and it has that checksum."""
    if not os.path.isfile(path) or not is_bundle(path):
        return None
    bundle = OpenBundle(path)
    return bundle if bundle.sha256 == sha256 else None


class SourceFolder:
    """The bundles of a folder and of those in it, by checksum, each read once and only when it is needed."""

    def __init__(self, folder: str):
        self.known: dict[str, Path] = {}
        self.left = bundles_in(folder)

    def find(self, sha256: str) -> Path | None:
        """The file of a checksum."""
        for path in self.left if sha256 not in self.known else ():
            checksum = sha256_of(path)
            self.known[checksum] = path
            if checksum == sha256:
                break
        return self.known.get(sha256)


def bundles_in(folder: str) -> Iterator[Path]:
    """The .rfpack files of a folder and of those in it, by name."""
    for where, inner, names in os.walk(folder):
        inner.sort()
        yield from (Path(where, name) for name in sorted(names) if name.endswith(".rfpack"))
