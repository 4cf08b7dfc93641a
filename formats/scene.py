"""The scene graph: named fields placed in a tree of transforms, what pictures of it show, and its JSON.

Frames: `node_to_parent` and `object_to_world` are (4, 4) float64 and act on column points; the world's is the
product from the root down. Placement words are glTF's: `translation`, `rotation` (unit quaternion xyzw) and
`scale`, scale applied first; or `matrix`, four rows of four.
"""

import dataclasses
import json
import math
import os
import re
import unicodedata
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from formats.atomic import atomic_writer, check_writable
from formats.errors import (
    BadJson,
    BadName,
    BadSchema,
    CyclicScene,
    DuplicateName,
    FormatError,
    FormatWarning,
    LimitExceeded,
    MissingFile,
    NewerVersion,
    NotFinite,
    OutsideFolder,
    SingularTransform,
)
from formats.inputs import parse_json, read_input
from formats.rig import FARTHEST, RigSchema, read_rig
from formats.rotations import matrices

FORMAT = "rfpack"
VERSION = "1.4"
FAR_VERSION = "1.3"  # of scenes that require FAR
SHOWING_VERSION = "1.2"  # of scenes that show a node otherwise than it is
FRAMED_VERSION = "1.1"  # of scenes with cameras or a framing
PLAIN_VERSION = "1.0"  # of scenes that have neither
FAR = "far"
"""The feature that scenes beyond NEAR_TRANSLATION, NEAR_SINGULAR_VALUES or NEAR_CAMERAS require (1.3);
readers of earlier versions refuse what they do not know, with a sentence."""
RULES = "rules"
"""The feature that scenes in which a node has a rule of its own require (1.4)."""
MEMBER = r"fields/[0-9a-f]{16}\.safetensors"
MAX_SCENE_BYTES = 4 << 20
MAX_NODES = 10_000
MAX_DEPTH = 64
MAX_NAME_BYTES = 255
MAX_TRANSLATION, NEAR_TRANSLATION = 1e13, 1e6
SINGULAR_VALUES, NEAR_SINGULAR_VALUES = (1e-12, 1e12), (1e-4, 1e4)
NEAR_CAMERAS = 1e12
MAX_CONDITION = 1e6
WARN_CONDITION = 1e3
# A unit quaternion typed with two decimals is off by at most this.
QUATERNION_SLACK = 1e-2
# These could forge what a terminal shows; other format characters hold emoji together and stay.
BIDIRECTIONAL = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"

Vector3 = Annotated[list[float], msgspec.Meta(min_length=3, max_length=3)]
Vector4 = Annotated[list[float], msgspec.Meta(min_length=4, max_length=4)]
Matrix4 = Annotated[list[Vector4], msgspec.Meta(min_length=4, max_length=4)]
Box = Annotated[list[float], msgspec.Meta(min_length=6, max_length=6)]
Shape = Annotated[list[float], msgspec.Meta(min_length=4, max_length=6)]
Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Tint = Annotated[list[Annotated[float, msgspec.Meta(ge=0, le=1)]], msgspec.Meta(min_length=3, max_length=3)]
WHITE = (1.0, 1.0, 1.0)  # the tint that changes nothing
Text = Annotated[str, msgspec.Meta(min_length=1, max_length=4096)]


class NodeSchema(msgspec.Struct, forbid_unknown_fields=True, omit_defaults=True):
    """One placed object: a `field` of this bundle, a `source` file, or a group of `children`."""

    name: Annotated[str, msgspec.Meta(min_length=1, max_length=MAX_NAME_BYTES)]
    field: Annotated[str, msgspec.Meta(pattern=f"^{MEMBER}$")] | msgspec.UnsetType = msgspec.UNSET
    source: Text | msgspec.UnsetType = msgspec.UNSET
    background: bool = False
    translation: Vector3 | msgspec.UnsetType = msgspec.UNSET
    rotation: Vector4 | msgspec.UnsetType = msgspec.UNSET
    scale: Vector3 | msgspec.UnsetType = msgspec.UNSET
    matrix: Matrix4 | msgspec.UnsetType = msgspec.UNSET
    visible: bool = True
    crop: Shape | msgspec.UnsetType = msgspec.UNSET
    opacity: Share | msgspec.UnsetType = msgspec.UNSET
    tint: Tint | msgspec.UnsetType = msgspec.UNSET
    composition: Literal["max", "add"] | msgspec.UnsetType = msgspec.UNSET
    children: list["NodeSchema"] = []


class SceneSchema(msgspec.Struct, omit_defaults=True):
    """A scene graph: `scene.json` on disk, or the first member of a bundle."""

    format: Literal["rfpack"]
    version: Annotated[str, msgspec.Meta(pattern=r"^[0-9]{1,4}\.[0-9]{1,4}$")]
    nodes: list[NodeSchema]
    generator: str = ""
    composition: Literal["max", "add"] = "max"
    history: list[dict] = []
    requires: Annotated[list[Literal["far", "rules"]], msgspec.Meta(max_length=2)] = []
    framing: Box | msgspec.UnsetType = msgspec.UNSET
    cameras: RigSchema | msgspec.UnsetType = msgspec.UNSET


NODE_KEYS = NodeSchema.__struct_fields__
PLACEMENT_KEYS = ("translation", "rotation", "scale", "matrix")
SHOWING_KEYS = ("visible", "crop", "opacity", "tint")
SCENE_KEYS = (
    "format", "version", "requires", "generator", "composition", "nodes", "history", "framing", "cameras",
)  # fmt: skip


@dataclass(frozen=True)
class Node:
    """A placed object or group; `node_to_parent` (4, 4) follows from `placement`, kept as it was written."""

    name: str
    field: str | None = None
    source: str | None = None
    placement: dict = dataclasses.field(default_factory=dict)
    background: bool = False
    children: tuple["Node", ...] = ()
    extras: dict = dataclasses.field(default_factory=dict)
    showing: dict = dataclasses.field(default_factory=dict)
    """What is shown of it and of its children, as it was written: see `Leaf`."""
    composition: str | None = None
    """The rule by which what is in it is one field; None: that of what it is in."""
    node_to_parent: np.ndarray = dataclasses.field(init=False, compare=False, repr=False)

    def __post_init__(self):
        check_name(self.name)
        if self.field is not None and self.source is not None:
            raise BadSchema(f"node {self.name!r}: has both a field and a source, expected one of them")
        matrix = _placement_matrix(self.placement, self.name)
        check_affine(matrix, f"node {self.name!r}")
        matrix.flags.writeable = False
        _check_showing(self.showing, self.name)
        if self.composition not in (None, "max", "add"):
            raise BadSchema(
                f"node {self.name!r}: composition {self.composition!r} is neither 'max' nor 'add'"
            )
        object.__setattr__(self, "node_to_parent", matrix)


def multiplied(one: Sequence[float], other: Sequence[float]) -> tuple[float, float, float]:
    """Two tints, one upon the other."""
    red, green, blue = (a * b for a, b in zip(one, other, strict=True))
    return red, green, blue


@dataclass(frozen=True)
class Leaf:
    """A node with a field or a source; `object_to_world` is (4, 4) float64."""

    name: str
    field: str | None
    source: str | None
    object_to_world: np.ndarray
    background: bool
    visible: bool = True
    opacity: float = 1.0
    """Its density is multiplied by this."""
    tint: tuple[float, float, float] = WHITE
    """Its colours are multiplied by these, red, green and blue."""
    crops: tuple["Crop", ...] = ()
    """It is empty outside of any of them."""
    groups: tuple[tuple[str, str], ...] = ()
    """The nodes around it that have a rule of their own, from the root down, and their rules."""

    @property
    def whole(self) -> bool:
        """Whether all of it is shown as it is."""
        return self.visible and self.opacity == 1 and self.tint == WHITE and not self.crops

    def inside(self, outer: "Leaf") -> "Leaf":
        """A leaf of a bundle that an outer one names as its source."""
        return replace(
            self,
            object_to_world=outer.object_to_world @ self.object_to_world,
            background=outer.background,
            visible=outer.visible and self.visible,
            opacity=outer.opacity * self.opacity,
            tint=multiplied(outer.tint, self.tint),
            crops=(*(crop.within(self.object_to_world) for crop in outer.crops), *self.crops),
            groups=(*outer.groups, *((f"{outer.name}/{name}", rule) for name, rule in self.groups)),
        )


@dataclass(frozen=True, eq=False)
class Crop:
    """A box or a sphere in some frame."""

    shape: tuple[float, ...]
    """xmin to zmax, or x, y, z and a radius."""
    object_to_shape: np.ndarray
    """(4, 4) float64 from an object's frame to that of the shape."""

    def __repr__(self) -> str:
        return f"Crop({self.shape}, {self.object_to_shape.tolist()})"

    def within(self, matrix: np.ndarray) -> "Crop":
        """The crop for an object that lies in this one's by a (4, 4)."""
        return replace(self, object_to_shape=self.object_to_shape @ matrix)

    def holds(self, points: np.ndarray) -> np.ndarray:
        """(N,) bool: which points (N, 3) of the object's frame it keeps."""
        at = points @ self.object_to_shape[:3, :3].T + self.object_to_shape[:3, 3]
        shape = np.array(self.shape)
        if len(shape) == 4:
            return ((at - shape[:3]) ** 2).sum(1) <= shape[3] ** 2
        return ((at >= shape[:3]) & (at <= shape[3:])).all(1)


@dataclass(frozen=True)
class SceneGraph:
    """A valid tree of nodes: names unique, depth and count bounded, every world transform invertible."""

    nodes: tuple[Node, ...]
    composition: str = "max"
    history: tuple[dict, ...] = ()
    generator: str = "fusedrf"
    version: str = PLAIN_VERSION
    extras: dict = dataclasses.field(default_factory=dict)
    framing: tuple[float, ...] | None = None
    """(6,) the box in the world that pictures show, xmin to zmax; without one they show all there is."""
    cameras: dict | None = None
    """Of the capture that a field was learnt from, in the world, as `formats.rig.read_rig` takes them."""

    def __post_init__(self):
        if self.composition not in ("max", "add"):
            raise BadSchema(f"composition {self.composition!r} is neither 'max' nor 'add'")
        seen: set[str] = set()
        for count, (node, depth, object_to_world) in enumerate(self.walk(), 1):
            name = unicodedata.normalize("NFC", node.name)
            if name in seen:
                raise DuplicateName(f"node name {node.name!r} appears twice; give every node its own name")
            if count > MAX_NODES:
                raise LimitExceeded(f"more than {MAX_NODES:,} nodes")
            seen.add(name)
            if depth > 1:
                check_affine(object_to_world, f"node {node.name!r} in the world")

    def walk(self) -> Iterator[tuple[Node, int, np.ndarray]]:
        """Every node in document order with its depth (roots 1) and `object_to_world` (4, 4)."""
        stack = [(node, 1, node.node_to_parent) for node in reversed(self.nodes)]
        while stack:
            node, depth, object_to_world = stack.pop()
            if depth > MAX_DEPTH:
                raise LimitExceeded(f"node {node.name!r}: nested deeper than {MAX_DEPTH} levels")
            yield node, depth, object_to_world
            stack += [(c, depth + 1, object_to_world @ c.node_to_parent) for c in reversed(node.children)]

    def leaves(self) -> list[Leaf]:
        """The nodes that hold a field or a source, in document order."""
        found = []
        stack = [(node, node.node_to_parent, True, 1.0, WHITE, (), ()) for node in reversed(self.nodes)]
        while stack:
            node, object_to_world, visible, opacity, tint, crops, groups = stack.pop()
            groups = groups if node.composition is None else (*groups, (node.name, node.composition))
            visible = visible and node.showing.get("visible", True)
            opacity *= node.showing.get("opacity", 1.0)
            tint = multiplied(tint, node.showing.get("tint", WHITE))
            if "crop" in node.showing:
                crops = (*crops, Crop(tuple(node.showing["crop"]), np.eye(4)))
            if node.field is not None or node.source is not None:
                placed = node.name, node.field, node.source, object_to_world, node.background
                found.append(Leaf(*placed, visible, opacity, tint, crops, groups))
            for child in reversed(node.children):
                own = tuple(crop.within(child.node_to_parent) for crop in crops)
                shown = visible, opacity, tint, own, groups
                stack.append((child, object_to_world @ child.node_to_parent, *shown))
        return found

    @property
    def far(self) -> bool:
        """Whether a node, a camera or the framing lies, or a node scales, beyond what readers before FAR
        take."""
        if max(map(abs, self.framing or (0.0,))) >= NEAR_CAMERAS:
            return True
        if self.cameras is not None and read_rig(self.cameras).reach >= NEAR_CAMERAS:
            return True
        placed = (matrix for node, _, world in self.walk() for matrix in (node.node_to_parent, world))
        return not all(_within(matrix, NEAR_TRANSLATION, NEAR_SINGULAR_VALUES) for matrix in placed)


def make_node(
    name: str,
    *,
    source: str | None = None,
    field: str | None = None,
    translation=None,
    rotation=None,
    scale=None,
    matrix=None,
    background: bool = False,
    children: tuple[Node, ...] = (),
    showing: dict | None = None,
) -> Node:
    """A node by translation (3,), rotation (4,) quaternion xyzw and scale (3,), or by matrix (4, 4); showing
    are its SHOWING_KEYS.

    Raises BadName, BadSchema, NotFinite, SingularTransform, LimitExceeded.
    """
    words = zip(PLACEMENT_KEYS, (translation, rotation, scale, matrix), strict=True)
    placement = {key: np.asarray(value).tolist() for key, value in words if value is not None}
    return Node(name, field, source, placement, background, tuple(children), {}, showing or {})


def read_scene(path: Path | str) -> SceneGraph:
    """The scene graph in a plain `scene.json`, whose nodes name sources only."""
    scene = parse_scene(read_input(path, MAX_SCENE_BYTES), str(path))
    for node, _, _ in scene.walk():
        if node.field is not None:
            raise BadSchema(
                f"{path}: node {node.name!r} names a field, which only bundles hold; use a source"
            )
    return scene


def parse_scene(data: bytes, where: str) -> SceneGraph:
    """The scene graph in JSON bytes; `where` leads error sentences.

    Raises BadJson, BadSchema, NewerVersion, BadName, DuplicateName, NotFinite, SingularTransform,
    LimitExceeded; warns (FormatWarning) about a newer minor version, whose unknown keys are kept.
    """
    if len(data) > MAX_SCENE_BYTES:
        raise LimitExceeded(
            f"{where}: a scene of {len(data):,} bytes, but at most {MAX_SCENE_BYTES:,} are read"
        )
    content = parse_json(data, where)
    newer = _check_version(content, where)
    nodes = content.get("nodes")
    _check_extent(nodes, where)
    extras = {key: value for key, value in content.items() if key not in SCENE_KEYS}
    known = {**content, "nodes": _known(nodes)} if newer else content
    try:
        spec = msgspec.convert(known, SceneSchema)
        roots = tuple(_build_node(node) for node in nodes)
        shown = _framing(content), _cameras(content)
        history = tuple(spec.history)
        return SceneGraph(roots, spec.composition, history, spec.generator, spec.version, extras, *shown)
    except msgspec.ValidationError as error:
        raise BadSchema(f"{where}: {error}") from error
    except FormatError as error:
        raise error.within(where) from error


def dump_scene(scene: SceneGraph) -> bytes:
    """Canonical JSON of `scene`: UTF-8, indented, numbers of a list on one line, newline at the end.

    Read back before it is returned, so what is written can be read; raises as `parse_scene` where it cannot.
    """
    shown = {"framing": scene.framing and list(scene.framing), "cameras": scene.cameras}
    shown = {key: value for key, value in shown.items() if value is not None}
    least = FRAMED_VERSION if shown else PLAIN_VERSION
    if any(node.showing for node, _, _ in scene.walk()):
        least = SHOWING_VERSION
    requires = [FAR] if scene.far else []
    requires += [RULES] if any(node.composition for node, _, _ in scene.walk()) else []
    if requires:
        least = VERSION if RULES in requires else FAR_VERSION
    content = {
        "format": FORMAT,
        "version": max(scene.version, least, key=_numbered),
        **({"requires": requires} if requires else {}),
        "generator": scene.generator,
        "composition": scene.composition,
        "nodes": [_node_content(node) for node in scene.nodes],
        "history": list(scene.history),
        **shown,
        **{key: scene.extras[key] for key in sorted(scene.extras)},
    }
    try:
        text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False)
        text = re.sub(r"\[\n\s*([-+.\deE,\s]+?)\n\s*\]", lambda m: f"[{' '.join(m[1].split())}]", text)
        data = (text + "\n").encode()
    except (TypeError, ValueError, RecursionError) as error:
        raise BadJson(f"the scene cannot be written as JSON ({error})") from error
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", FormatWarning)
        parse_scene(data, "the scene")
    return data


def write_scene(path: Path | str, scene: SceneGraph, *, overwrite: bool = False) -> None:
    """`scene` as a plain `scene.json`, whole or not at all. Raises OutputExists, ResourceError."""
    check_writable(path, overwrite)
    with atomic_writer(path) as file:
        file.write(dump_scene(scene))


def is_scene(path: Path | str) -> bool:
    """Whether the file's content, not its name, is a scene graph; False for other JSON, valid or not."""
    try:
        data = read_input(path, MAX_SCENE_BYTES)
        content = parse_json(data, str(path)) if data.lstrip()[:1] == b"{" else None
    except FormatError:
        return False
    return isinstance(content, dict) and content.get("format") == FORMAT


def resolve_source(scene_path: Path | str, source: str, allow_outside: bool = False) -> Path:
    """The existing file or folder that `source`, written in `scene_path`, means.

    Raises OutsideFolder for anything that may lead out of the scene's folder (absolute, `..`, a drive, a
    link), MissingFile where nothing is there.
    """
    folder = Path(scene_path).parent
    plain = unicodedata.normalize("NFKC", source)
    if not source or not source.isprintable():
        raise BadName(f"{scene_path}: source {source!r} is not a path; expected printable characters")
    parts = re.split(r"[/\\]", plain)
    drive = re.match(r"[A-Za-z][A-Za-z0-9+.\-]*:", plain)
    path = folder / source
    inside = Path(os.path.realpath(path)).is_relative_to(os.path.realpath(folder))
    if not allow_outside and (".." in parts or parts[0] == "" or drive or not inside):
        raise _outside(scene_path, source)
    if not os.path.exists(path):
        raise MissingFile(f"{scene_path}: source {source!r} does not exist (looked for at {path})")
    return path


def expand_scene(path: Path | str, allow_outside: bool = False) -> SceneGraph:
    """The scene in `path` with sources that are scenes themselves inlined as groups of children.

    Inner names become `outer/inner`; inner sources become relative to the folder of `path`; an inner scene
    keeps its rule of composition. Raises what `read_scene` and `resolve_source` raise, CyclicScene where a
    scene leads back to itself.
    """
    scene = read_scene(path)
    return inline_scenes(scene, path, allow_outside)


def inline_scenes(scene: SceneGraph, path: Path | str, allow_outside: bool = False) -> SceneGraph:
    """As `expand_scene`, of a `scene` already read from `path`, which may be a bundle."""
    expansion = _Expansion(Path(path).parent, allow_outside)
    trail = (os.path.realpath(path),)
    nodes = expansion.nodes(scene.nodes, Path(path), "", trail, scene.composition)
    try:
        return replace(scene, nodes=nodes)
    except FormatError as error:
        raise error.within(str(path)) from error


def scene_schema() -> dict:
    """JSON Schema (draft 2020-12) of scene.json, the one in `formats/scene.schema.json`."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        "title": "rfpack scene graph",
        **msgspec.json.schema(SceneSchema),
    }


@dataclass
class _Expansion:
    """One run of `inline_scenes`; `count` bounds its result, which doubles with every scene named twice."""

    folder: Path
    allow_outside: bool
    count: int = 0
    found: dict[tuple[Path, str], tuple] = dataclasses.field(default_factory=dict)

    def nodes(self, nodes, path: Path, prefix: str, trail: tuple[str, ...], rule: str) -> tuple[Node, ...]:
        return tuple(self.node(node, path, prefix, trail, rule) for node in nodes)

    def node(self, node: Node, path: Path, prefix: str, trail: tuple[str, ...], rule: str) -> Node:
        self.count += 1
        if self.count > MAX_NODES or len(trail) > MAX_DEPTH:
            bound = f"{MAX_NODES:,} nodes or {MAX_DEPTH} levels"
            raise LimitExceeded(f"{path}: its nested scenes unfold to more than {bound}")
        rule = node.composition or rule
        children = self.nodes(node.children, path, prefix, trail, rule)
        node = replace(node, name=prefix + node.name, children=children)
        if node.source is None:
            return node
        target, real, inner = self.find(path, node.source)
        if inner is None:
            return node if path.parent == self.folder else replace(node, source=self.relative(target))
        if real in trail:
            loop = " -> ".join(Path(step).name for step in (*trail[trail.index(real) :], real))
            raise CyclicScene(f"{target}: leads back to itself ({loop}); remove one of these sources")
        nested = self.nodes(inner.nodes, target, node.name + "/", (*trail, real), inner.composition)
        if node.background:
            nested = tuple(replace(child, background=True) for child in nested)
        if inner.composition != rule:
            if children:
                rules = f"{inner.composition!r}, but that of the nodes beside it {rule!r}"
                raise BadSchema(f"{target}: its composition is {rules}; put them into a group of their own")
            node = replace(node, composition=inner.composition)
        return replace(node, source=None, background=False, children=(*nested, *node.children))

    def find(self, path: Path, source: str) -> tuple[Path, str, SceneGraph | None]:
        """The source's path as written, its real path, and its scene (None if it is none), looked up once."""
        if (path, source) not in self.found:
            target = resolve_source(path, source, self.allow_outside)
            inner = read_scene(target) if is_scene(target) else None
            self.found[path, source] = target, os.path.realpath(target), inner
        return self.found[path, source]

    def relative(self, target: Path) -> str:
        return Path(os.path.relpath(target, self.folder)).as_posix()


def _outside(scene_path: Path | str, source: str) -> OutsideFolder:
    what = f"{scene_path}: source {source!r} leads out of the scene's folder"
    return OutsideFolder(f"{what}; move the file in, or give --allow-outside")


def check_name(name: str) -> None:
    if not isinstance(name, str) or not 0 < len(name.encode(errors="replace")) <= MAX_NAME_BYTES:
        raise BadName(f"node name {str(name)[:40]!r} is empty or longer than {MAX_NAME_BYTES} bytes")
    if any(unicodedata.category(c) in ("Cc", "Cs", "Zl", "Zp") or c in BIDIRECTIONAL for c in name):
        raise BadName(f"node name {name!r} holds control characters; use printable ones")


def _check_showing(showing: dict, name: str) -> None:
    crop = showing.get("crop")
    if crop is not None:
        numbers = _numbers(crop, (len(crop),), name, "crop")
        box = len(crop) == 6 and (numbers[:3] < numbers[3:]).all()
        if not box and not (len(crop) == 4 and numbers[3] > 0):
            raise BadSchema(
                f"node {name!r}: crop {list(crop)} is neither a box, xmin,ymin,zmin,xmax,ymax,zmax with each "
                "minimum below its maximum, nor a sphere, x,y,z and a radius above 0"
            )
    opacity = showing.get("opacity", 1.0)
    if not 0 < opacity <= 1:
        raise BadSchema(f"node {name!r}: opacity {opacity}, expected a number above 0 and at most 1")
    tint = showing.get("tint")
    if tint is not None and not (len(tint) == 3 and all(0 <= share <= 1 for share in tint)):
        raise BadSchema(f"node {name!r}: tint {list(tint)}, expected red, green and blue from 0 to 1")


def _placement_matrix(placement: dict, name: str) -> np.ndarray:
    if set(placement) - set(PLACEMENT_KEYS):
        expected = ", ".join(PLACEMENT_KEYS)
        raise BadSchema(f"node {name!r}: has the placement {sorted(placement)}, expected {expected}")
    if "matrix" in placement:
        if len(placement) > 1:
            raise BadSchema(f"node {name!r}: has a matrix and {sorted(placement)[-1]}, expected one of them")
        return _numbers(placement["matrix"], (4, 4), name, "matrix")
    turn = _unit(_numbers(placement.get("rotation", [0, 0, 0, 1]), (4,), name, "rotation"), name)
    matrix = np.eye(4)
    matrix[:3, :3] = matrices(turn) * _numbers(placement.get("scale", [1, 1, 1]), (3,), name, "scale")
    matrix[:3, 3] = _numbers(placement.get("translation", [0, 0, 0]), (3,), name, "translation")
    return matrix


def _numbers(values, shape: tuple[int, ...], name: str, word: str) -> np.ndarray:
    try:
        array = np.array(values, np.float64)
    except (TypeError, ValueError) as error:
        raise BadSchema(f"node {name!r}: {word} should be a list of numbers") from error
    if array.shape != shape:
        raise BadSchema(f"node {name!r}: {word} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise NotFinite(f"node {name!r}: {word} holds NaN or infinity, expected finite numbers")
    return array


def _unit(quaternion: np.ndarray, name: str) -> np.ndarray:
    norm = math.hypot(*quaternion)
    if abs(norm - 1) > QUATERNION_SLACK:
        raise BadSchema(f"node {name!r}: rotation has length {norm:.6g}, expected a unit quaternion xyzw")
    return quaternion / norm


def check_affine(matrix: np.ndarray, who: str) -> None:
    """Refuse what cannot be inverted to float64 accuracy, or is beyond what the format holds; warn where an
    object is stretched extremely. Raises BadSchema, LimitExceeded, SingularTransform."""
    if not np.array_equal(matrix[3], [0, 0, 0, 1]):
        raise BadSchema(f"{who}: last row {matrix[3].tolist()}, expected [0, 0, 0, 1]; columns act on points")
    if np.abs(matrix[:3, 3]).max() > MAX_TRANSLATION:
        raise LimitExceeded(
            f"{who}: translation {matrix[:3, 3].tolist()} is beyond {MAX_TRANSLATION:g} units; "
            "move it nearer to the origin"
        )
    high, _, low = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    if not _within(matrix, MAX_TRANSLATION, SINGULAR_VALUES) or not high / low <= MAX_CONDITION:
        smallest, largest = SINGULAR_VALUES
        raise SingularTransform(
            f"{who}: scales by {low:.3g} to {high:.3g}, expected {smallest:g} to {largest:g} "
            f"with a ratio of at most {MAX_CONDITION:g}; choose another unit, or stretch it less"
        )
    if high / low > WARN_CONDITION:
        text = f"{who}: stretched {high / low:.0f} times more along one axis than along another"
        warnings.warn(text, FormatWarning, 2)


def _within(matrix: np.ndarray, farthest: float, sizes: tuple[float, float]) -> bool:
    """Whether an affine (4, 4) moves no farther and scales by no other than these."""
    high, _, low = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    # The slack lets a scale of exactly the limit through the rounding of the decomposition.
    scales = low >= sizes[0] * (1 - 1e-9) and high <= sizes[1] * (1 + 1e-9)
    return bool(scales and np.abs(matrix[:3, 3]).max() <= farthest)


def _check_version(content: object, where: str) -> bool:
    """Whether a minor version newer than ours wrote `content`."""
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise BadSchema(f'{where}: not a scene graph; expected a JSON object with "format": "{FORMAT}"')
    found = content.get("version")
    match = re.fullmatch(r"([0-9]{1,4})\.([0-9]{1,4})", found) if isinstance(found, str) else None
    if match is None:
        raise BadSchema(f"{where}: version {found!r}, expected a string such as {VERSION!r}")
    major, minor = _numbered(VERSION)
    if int(match[1]) != major:
        raise NewerVersion(f"{where}: version {found}, but this fusedrf reads {major}.x; update fusedrf")
    required = content.get("requires", [])
    if not isinstance(required, list) or any(word not in (FAR, RULES) for word in required):
        raise NewerVersion(
            f"{where}: requires {required!r}, which this version does not know; update fusedrf"
        )
    newer = int(match[2]) > minor
    if newer:
        text = f"{where}: version {found} is newer than {VERSION}; what is new is ignored"
        warnings.warn(text, FormatWarning, 3)
    return newer


def _numbered(version: str) -> tuple[int, ...]:
    """'1.10' -> (1, 10), which comes after (1, 9)."""
    return tuple(int(number) for number in version.split("."))


def _framing(content: dict) -> tuple[float, ...] | None:
    """The box that pictures show, checked."""
    box = content.get("framing")
    if box is None:
        return None
    if max(map(abs, box)) >= FARTHEST or not all(
        low < high for low, high in zip(box[:3], box[3:], strict=True)
    ):
        raise BadSchema(f"framing {box} is no box, expected each minimum below its maximum")
    return tuple(float(number) for number in box)


def _cameras(content: dict) -> dict | None:
    """The cameras as they stand in the file, once they are known to be readable."""
    if "cameras" in content:
        read_rig(content["cameras"])
    return content.get("cameras")


def _check_extent(nodes: object, where: str) -> None:
    """Count and depth on the raw JSON, before anything recurses into it."""
    level, count, depth = nodes if isinstance(nodes, list) else [], 0, 0
    while level:
        count, depth = count + len(level), depth + 1
        if count > MAX_NODES or depth > MAX_DEPTH:
            raise LimitExceeded(f"{where}: more than {MAX_NODES:,} nodes or {MAX_DEPTH} levels of children")
        lists = [node.get("children") for node in level if isinstance(node, dict)]
        level = [child for children in lists if isinstance(children, list) for child in children]


def _known(nodes: object) -> object:
    """`nodes` without the keys that a newer minor version may have added."""
    if not isinstance(nodes, list):
        return nodes
    return [_known_node(node) if isinstance(node, dict) else node for node in nodes]


def _known_node(node: dict) -> dict:
    known = {key: value for key, value in node.items() if key in NODE_KEYS}
    return known | {"children": _known(node["children"])} if "children" in node else known


def _build_node(content: dict) -> Node:
    return Node(
        content["name"],
        content.get("field"),
        content.get("source"),
        {key: content[key] for key in PLACEMENT_KEYS if key in content},
        content.get("background", False),
        tuple(_build_node(child) for child in content.get("children", ())),
        {key: value for key, value in content.items() if key not in NODE_KEYS},
        {key: content[key] for key in SHOWING_KEYS if key in content},
        content.get("composition"),
    )


def _node_content(node: Node) -> dict:
    content = {"name": node.name, "field": node.field, "source": node.source}
    content = {key: value for key, value in content.items() if value is not None}
    content |= {key: node.placement[key] for key in PLACEMENT_KEYS if key in node.placement}
    if node.background:
        content["background"] = True
    content |= {key: node.showing[key] for key in SHOWING_KEYS if key in node.showing}
    if node.composition is not None:
        content["composition"] = node.composition
    content |= {key: node.extras[key] for key in sorted(node.extras)}
    if node.children:
        content["children"] = [_node_content(child) for child in node.children]
    return content
