"""What a fused field was made of, found again: `fuse FUSED.rfpack` builds anew from it."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from formats.bundle import OpenBundle, is_bundle, sha256_of
from formats.scene import Leaf, SceneGraph
from fusedrf_cli.bridge.editing import check_history
from fusedrf_cli.bridge.history import nodes_of
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.scene import FoundField, LoadedScene, load_found, load_scene
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.requests import FuseRequest


def load_to_fuse(request: FuseRequest, memory: Memory, place: str, progress) -> LoadedScene:
    """The scene that is to be fused: of a fused bundle its objects as they were before, where all of them are
    found; with a warning the fused field itself, where not. Raises InvalidInput where a folder was named that
    lacks one, UsageProblem where there is nothing to be found."""
    opened = None if request.scene == "-" or not is_bundle(request.scene) else OpenBundle(request.scene)
    graph = None if opened is None else opened.scene
    if graph is None or not was_fused(graph):
        if request.sources:
            raise UsageProblem(f"--sources applies to a fused bundle; {request.scene} tells of no sources")
        return load_scene(request.scene, request.allow_outside, memory, place)
    check_history(graph, request.scene)
    found, missing = sources_of(opened, request)
    if not missing:
        progress.tell(f"{request.scene} is fused anew from its {len(found)} sources")
        composition = graph.history[0].get("composition", "max")
        scene = replace(graph, history=(), composition=composition)
        return load_found(Path(request.scene), scene, found, memory, place)
    told = f"{request.scene}: the source of '{missing[0]}' is not found as it was"
    if request.sources:
        raise InvalidInput(f"{told}, neither where its history says nor in {request.sources}")
    progress.warn(f"{told}: what is fused is the field that was fused before; --sources DIR looks elsewhere")
    return load_scene(request.scene, request.allow_outside, memory, place)


def as_it_is(request: FuseRequest, memory: Memory, place: str, progress) -> LoadedScene:
    """The scene or field that was named, whatever it was made of."""
    return load_scene(request.scene, request.allow_outside, memory, place)


def was_fused(graph: SceneGraph) -> bool:
    """Whether a bundle's history tells of all that is in it."""
    return bool(graph.history) and graph.history[0].get("event") == "fused"


def sources_of(fused: OpenBundle, request: FuseRequest) -> tuple[list[FoundField], list[str]]:
    """The objects that are in a fused bundle now, and the names of those of which no file is found."""
    found, missing = [], []
    elsewhere = Elsewhere(request.sources)
    for node in nodes_of(fused.scene.history).values():
        member = node["field"]
        inside = node.get("kept") and member in fused.headers
        bundle = fused if inside else source_bundle(node, fused.path, elsewhere, request)
        if bundle is None or member not in bundle.headers:
            missing.append(node["name"])
            continue
        matrix = np.asarray(node["object_to_world"], np.float64)
        leaf = Leaf(node["name"], member, None, matrix, bool(node.get("background")))
        found.append((leaf, bundle, member))
    return found, missing


def source_bundle(
    node: dict, path: Path, elsewhere: "Elsewhere", request: FuseRequest
) -> OpenBundle | None:
    """The bundle that a node of a history names by its checksum: where it was, else in the folder given."""
    if not node.get("sha256"):
        return None
    folder = path.resolve().parent
    named = (folder / node.get("source", "")).resolve()
    may_be_read = request.allow_outside or named.is_relative_to(folder)
    if may_be_read and (bundle := unchanged(named, node["sha256"])):
        return bundle
    file = elsewhere.find(node["sha256"])
    return None if file is None else unchanged(file, node["sha256"])


def unchanged(path: Path, sha256: str) -> OpenBundle | None:
    """The bundle at a path, if there is one and it has that checksum."""
    if not path.is_file() or not is_bundle(path):
        return None
    bundle = OpenBundle(path)
    return bundle if bundle.sha256 == sha256 else None


class Elsewhere:
    """The bundles of a folder and of those in it, by checksum, each read once and only when it is needed."""

    def __init__(self, folder: str | None):
        self.known: dict[str, Path] = {}
        self.left = bundles_in(folder) if folder else iter(())

    def find(self, sha256: str) -> Path | None:
        """The file of a checksum."""
        for path in self.left if sha256 not in self.known else ():
            found = sha256_of(path)
            self.known[found] = path
            if found == sha256:
                break
        return self.known.get(sha256)


def bundles_in(folder: str) -> Iterator[Path]:
    """The .rfpack files of a folder and of those in it, by name."""
    for where, inner, names in os.walk(folder):
        inner.sort()
        yield from (Path(where, name) for name in sorted(names) if name.endswith(".rfpack"))
