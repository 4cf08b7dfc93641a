"""What a bundle was made of, found again: `fuse FUSED.rfpack` fuses it once more from its sources."""

import os
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np

from formats.blocks import UNNAMED
from formats.bundle import OpenBundle, is_bundle, sha256_of
from formats.graph import belongs
from formats.history import check_history, distilled, sources
from formats.nodes import Leaf
from formats.scene import SceneGraph
from fusedrf_cli.bridge.memory import Memory
from fusedrf_cli.bridge.scene import FoundField, LoadedScene, load_found, load_scene
from fusedrf_cli.errors import InvalidInput, UsageProblem
from fusedrf_cli.requests import FuseRequest


def load_to_fuse(request: FuseRequest, memory: Memory, place: str, progress) -> LoadedScene:
    """The scene that is to be fused: of a fused bundle its objects as they were before, where all of them are
    found; with a warning the bundle's own fields, where not. Raises InvalidInput where a folder was named
    that lacks one, UsageProblem where there is nothing to be found."""
    bundle = None if request.scene == "-" or not is_bundle(request.scene) else OpenBundle(request.scene)
    graph = None if bundle is None else bundle.scene
    if graph is None or not was_fused(graph):
        if request.sources:
            raise UsageProblem(f"--sources applies to a fused bundle; {request.scene} tells of no sources")
        return load_scene(request.scene, request.allow_outside, memory, place)
    check_history(graph, request.scene)
    found, missing = all_sources(bundle, Elsewhere(request.sources), request.allow_outside)
    if not missing:
        progress.tell(f"{request.scene} is fused anew from its {len(found)} sources")
        inside = distilled(graph.history)
        composition = graph.history[0].get("composition", "max") if inside else graph.composition
        scene = replace(graph, history=(), composition=composition)
        return load_found(Path(request.scene), scene, found, memory, place)
    told = f"{request.scene}: the source of '{missing[0]}' is not found as it was"
    if request.sources:
        raise InvalidInput(f"{told}, neither where its history says nor in {request.sources}")
    progress.warn(f"{told}: what is fused are the fields that it has; --sources DIR looks elsewhere")
    return load_scene(request.scene, request.allow_outside, memory, place)


def as_it_is(request: FuseRequest, memory: Memory, place: str, progress) -> LoadedScene:
    """The scene or field that was named, whatever it was made of."""
    return load_scene(request.scene, request.allow_outside, memory, place)


def was_fused(graph: SceneGraph) -> bool:
    """Whether a bundle was made by `fuse`."""
    return bool(graph.history) and graph.history[0].get("event") == "fused"


def all_sources(
    bundle: OpenBundle, elsewhere: "Elsewhere", allow_outside: bool
) -> tuple[list[FoundField], list[str]]:
    """The objects that are in a fused bundle now, and the names of those of which no file is found. A node is
    its own source where its field is that of the source."""
    found, missing = [], []
    made_of, inside = sources(bundle.scene.history), distilled(bundle.scene.history)
    for leaf in bundle.scene.leaves():
        if leaf.field is None or inside and belongs(leaf.name, UNNAMED):  # which stands for those inside
            continue
        told = made_of.get(leaf.field)
        own = (
            [(leaf, bundle, leaf.field)]
            if told is None
            else source_of(told, leaf, bundle, elsewhere, allow_outside)
        )
        found += own
        missing += [] if own else [leaf.name]
    for node in inside.values():
        own = source_of(node, leaf_of(node), bundle, elsewhere, allow_outside)
        found += own
        missing += [] if own else [node["name"]]
    return found, missing


def leaf_of(node: dict) -> Leaf:
    """Where an object that was distilled into a field stands."""
    matrix = np.asarray(node["object_to_world"], np.float64)
    return Leaf(node["name"], node.get("field"), None, matrix, bool(node.get("background")))


def source_of(
    told: dict, leaf: Leaf, bundle: OpenBundle, elsewhere: "Elsewhere", allow_outside: bool
) -> list[FoundField]:
    """The fields that a leaf of a bundle was made of, as its history tells: kept inside, or in a file that is
    as it was. Nothing where it is not found."""
    kept = told.get("kept") or not told.get("sha256")
    file = bundle if kept and bundle.placed(told.get("field", "")) else None
    if file is None:
        file = source_bundle(told, bundle.path, elsewhere, allow_outside)
    parts = () if file is None else file.placed(told.get("field", ""))
    if wanted := told.get("instance"):
        parts = [part for part in parts if part.name == wanted]
    found = []
    for part in parts:
        name = leaf.name if len(parts) == 1 else f"{leaf.name}/{part.name}"
        inner = Leaf(name, part.member, None, part.object_to_field, False, tint=part.tint)
        at_rest = bool(wanted)  # the leaf stands where that part stood
        inner = replace(inner, object_to_world=np.eye(4), tint=(1.0, 1.0, 1.0)) if at_rest else inner
        found.append((inner.inside(leaf), file, part.member))
    return found


def source_bundle(told: dict, path: Path, elsewhere: "Elsewhere", allow_outside: bool) -> OpenBundle | None:
    """The bundle that a history names by its checksum: where it was, else in the folder given."""
    if not told.get("sha256"):
        return None
    folder = path.resolve().parent
    named = (folder / told.get("source", "")).resolve()
    may_be_read = allow_outside or named.is_relative_to(folder)
    if may_be_read and (bundle := unchanged(named, told["sha256"])):
        return bundle
    file = elsewhere.find(told["sha256"])
    return None if file is None else unchanged(file, told["sha256"])


def unchanged(path: Path, sha256: str) -> OpenBundle | None:
    """The bundle at a path, if there is one and it has that checksum."""
    if not os.path.isfile(path) or not is_bundle(path):
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
