"""The files that a scene names as sources, and scenes among them inlined."""

import dataclasses
import os
import re
import unicodedata
from dataclasses import dataclass, replace
from pathlib import Path

from formats.errors import (
    BadName,
    CyclicScene,
    FormatError,
    LimitExceeded,
    MissingFile,
    OutsideFolder,
)
from formats.graph import holding
from formats.nodes import Node
from formats.scene import MAX_DEPTH, MAX_NODES, SceneGraph, is_scene, read_scene


def resolve_source(scene_path: Path | str, source: str, allow_outside: bool = False, node: str = "") -> Path:
    """The existing file or folder that `source`, written in `scene_path`, means; node: whose it is.

    Raises OutsideFolder for anything that may lead out of the scene's folder (absolute, `..`, a drive, a
    link), MissingFile where nothing is there.
    """
    folder = Path(scene_path).parent
    plain = unicodedata.normalize("NFKC", source)
    where = f"{scene_path}: node {node!r}: source {source!r}" if node else f"{scene_path}: source {source!r}"
    if not source or not source.isprintable():
        raise BadName(f"{where} is not a path; expected printable characters")
    parts = re.split(r"[/\\]", plain)
    drive = re.match(r"[A-Za-z][A-Za-z0-9+.\-]*:", plain)
    path = folder / source
    inside = Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
    if not allow_outside and (".." in parts or parts[0] == "" or drive or not inside):
        raise OutsideFolder(
            f"{where} leads out of the scene's folder; move the file in, or give --allow-outside"
        )
    if not os.path.exists(path):
        raise MissingFile(
            f"{where} does not exist; put it at {os.path.abspath(path)}, or name another source"
        )
    return path


def expand_scene(path: Path | str, allow_outside: bool = False, most: int = MAX_NODES) -> SceneGraph:
    """The scene in `path` with sources that are scenes themselves inlined as groups of children.

    Inner names become `outer/inner`; inner sources become relative to the folder of `path`; an inner scene
    keeps its rule of composition. Raises what `read_scene` and `resolve_source` raise, CyclicScene where a
    scene leads back to itself, LimitExceeded for more than `most` nodes.
    """
    scene = read_scene(path)
    return inline_scenes(scene, path, allow_outside, most)


def inline_scenes(
    scene: SceneGraph, path: Path | str, allow_outside: bool = False, most: int = MAX_NODES
) -> SceneGraph:
    """As `expand_scene`, of a `scene` already read from `path`, which may be a bundle."""
    expansion = _Expansion(Path(path).parent, allow_outside, most)
    trail = (os.path.realpath(path),)
    nodes = expansion.nodes(scene.nodes, Path(path), "", trail, scene.composition)
    try:
        return replace(scene, nodes=nodes)
    except FormatError as error:
        raise error.within(str(path)) from error


@dataclass
class _Expansion:
    """One run of `inline_scenes`; `count` bounds its result, which doubles with every scene named twice."""

    folder: Path
    allow_outside: bool
    most: int
    count: int = 0
    found: dict[tuple[Path, str], tuple] = dataclasses.field(default_factory=dict)

    def nodes(self, nodes, path: Path, prefix: str, trail: tuple[str, ...], rule: str) -> tuple[Node, ...]:
        return tuple(self.node(node, path, prefix, trail, rule) for node in nodes)

    def node(self, node: Node, path: Path, prefix: str, trail: tuple[str, ...], rule: str) -> Node:
        self.count += 1
        if self.count > self.most or len(trail) > MAX_DEPTH:
            bound = f"{self.most:,} nodes or {MAX_DEPTH} levels"
            raise LimitExceeded(f"{path}: its nested scenes unfold to more than {bound}")
        rule = node.composition or rule
        children = self.nodes(node.children, path, prefix, trail, rule)
        node = replace(node, name=prefix + node.name, children=children)
        if node.source is None:
            return node
        target, real, inner = self.find(path, node)
        if inner is None:
            return node if path.parent == self.folder else replace(node, source=self.relative(target))
        if real in trail:
            loop = " -> ".join(Path(step).name for step in (*trail[trail.index(real) :], real))
            raise CyclicScene(f"{target}: leads back to itself ({loop}); remove one of these sources")
        nested = self.nodes(inner.nodes, target, node.name + "/", (*trail, real), inner.composition)
        return holding(node, nested, rule, inner.composition)

    def find(self, path: Path, node: Node) -> tuple[Path, str, SceneGraph | None]:
        """The path of a node's source as written, its real path, and its scene (None if it is none), looked
        up once."""
        if (path, node.source) not in self.found:
            target = resolve_source(path, node.source, self.allow_outside, node.name)
            inner = read_scene(target) if is_scene(target) else None
            self.found[path, node.source] = target, os.path.realpath(target), inner
        return self.found[path, node.source]

    def relative(self, target: Path) -> str:
        return Path(os.path.relpath(target, self.folder)).as_posix()
