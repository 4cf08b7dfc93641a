"""The scene graph: named fields placed in a tree of transforms, what pictures of it show, and its JSON.

Frames: `node_to_parent` and `object_to_world` are (4, 4) float64 and act on column points; the world's is the
product from the root down. Placement words are glTF's: `translation`, `rotation` (unit quaternion xyzw) and
`scale`, scale applied first; or `matrix`, four rows of four.
"""

import dataclasses
import json
import math
import re
import unicodedata
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Annotated, Literal

import msgspec
import numpy as np

from formats.atomic import atomic_writer, check_writable
from formats.camera_set import FARTHEST, RigSchema, read_camera_set
from formats.errors import (
    BadJson,
    BadSchema,
    DuplicateName,
    FormatError,
    FormatWarning,
    LimitExceeded,
    NewerVersion,
)
from formats.nodes import (
    MAX_NAME_BYTES,
    PLACEMENT_KEYS,
    WHITE,
    Crop,
    Leaf,
    Node,
    check_affine,
    multiplied,
    within,
)
from formats.nodes import make_node as make_node
from formats.other_files import HEAD, not_a_bundle
from formats.safe_input import open_input, parse_json, read_input

FORMAT = "rfpack"
VERSION = "1.6"
UPRIGHT_VERSION = "1.5"  # of scenes that say which way is up
RULED_VERSION = "1.4"  # of scenes that require RULES
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
NEAR_TRANSLATION = 1e6
NEAR_SINGULAR_VALUES = 1e-4, 1e4
NEAR_CAMERAS = 1e12

Vector3 = Annotated[list[float], msgspec.Meta(min_length=3, max_length=3)]
Vector4 = Annotated[list[float], msgspec.Meta(min_length=4, max_length=4)]
Matrix4 = Annotated[list[Vector4], msgspec.Meta(min_length=4, max_length=4)]
Box = Annotated[list[float], msgspec.Meta(min_length=6, max_length=6)]
Shape = Annotated[list[float], msgspec.Meta(min_length=4, max_length=6)]
Share = Annotated[float, msgspec.Meta(gt=0, le=1)]
Tint = Annotated[list[Annotated[float, msgspec.Meta(ge=0, le=1)]], msgspec.Meta(min_length=3, max_length=3)]
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
    source_matrix: Matrix4 | msgspec.UnsetType = msgspec.UNSET
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
    up: Vector3 | msgspec.UnsetType = msgspec.UNSET


NODE_KEYS = NodeSchema.__struct_fields__
SHOWING_KEYS = ("visible", "crop", "opacity", "tint")
SCENE_KEYS = SceneSchema.__struct_fields__


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
    """Of the capture that a field was learnt from, in the world, as `formats.camera_set.read_camera_set`
    takes them."""
    up: tuple[float, ...] | None = None
    """(3,) which way of the world is up in pictures, a unit vector; None: +z, or as cameras were held."""

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
        leaves = []
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
                leaves.append(Leaf(*placed, visible, opacity, tint, crops, groups, node.source_matrix))
            for child in reversed(node.children):
                all_crops = tuple(crop.within(child.node_to_parent) for crop in crops)
                shown = visible, opacity, tint, all_crops, groups
                stack.append((child, object_to_world @ child.node_to_parent, *shown))
        return leaves

    @property
    def far(self) -> bool:
        """Whether a node, a camera or the framing lies, or a node scales, beyond what readers before FAR
        take."""
        if max(map(abs, self.framing or (0.0,))) >= NEAR_CAMERAS:
            return True
        if self.cameras is not None and read_camera_set(self.cameras).reach >= NEAR_CAMERAS:
            return True
        placed = (matrix for node, _, world in self.walk() for matrix in (node.node_to_parent, world))
        return not all(within(matrix, NEAR_TRANSLATION, NEAR_SINGULAR_VALUES) for matrix in placed)


def read_scene(path: Path | str) -> SceneGraph:
    """The scene graph in a plain `scene.json`, whose nodes name sources only."""
    with open_input(path) as file:
        head = file.read(HEAD)
    if not head.lstrip().startswith(b"{") and (other := not_a_bundle(Path(path), head)) is not None:
        raise other
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
        if "cameras" in content:
            read_camera_set(content["cameras"])
        shown = _framing(content), content.get("cameras"), _up(content)
        history = tuple(spec.history)
        return SceneGraph(roots, spec.composition, history, spec.generator, spec.version, extras, *shown)
    except msgspec.ValidationError as error:
        word = "unknown field" in str(error) and _unknown_word(nodes)
        raise BadSchema(f"{where}: {word or error}") from error
    except FormatError as error:
        raise error.within(where) from error


def dump_scene(scene: SceneGraph) -> bytes:
    """Canonical JSON of `scene`: UTF-8, indented, numbers of a list on one line, newline at the end.

    Read back before it is returned, so what is written can be read; raises as `parse_scene` where it cannot.
    """
    shown = {"framing": scene.framing and list(scene.framing), "cameras": scene.cameras}
    shown = {key: value for key, value in shown.items() if value is not None}
    least = FRAMED_VERSION if shown else PLAIN_VERSION
    upright = {} if scene.up is None else {"up": list(scene.up)}
    if any(node.showing for node, _, _ in scene.walk()):
        least = SHOWING_VERSION
    requires = [FAR] if scene.far else []
    requires += [RULES] if any(node.composition for node, _, _ in scene.walk()) else []
    if requires:
        least = RULED_VERSION if RULES in requires else FAR_VERSION
    if upright:
        least = UPRIGHT_VERSION
    if any(node.source_matrix is not None for node, _, _ in scene.walk()):
        least = VERSION
    content = {
        "format": FORMAT,
        "version": max(scene.version, least, key=_numbered),
        **({"requires": requires} if requires else {}),
        "generator": scene.generator,
        "composition": scene.composition,
        "nodes": [_node_content(node) for node in scene.nodes],
        "history": list(scene.history),
        **shown,
        **upright,
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


def _check_version(content: object, where: str) -> bool:
    """Whether a minor version newer than ours wrote `content`."""
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise BadSchema(f'{where}: not a scene graph; expected a JSON object with "format": "{FORMAT}"')
    version = content.get("version")
    match = re.fullmatch(r"([0-9]{1,4})\.([0-9]{1,4})", version) if isinstance(version, str) else None
    if match is None:
        raise BadSchema(f"{where}: version {version!r}, expected a string such as {VERSION!r}")
    major, minor = _numbered(VERSION)
    if int(match[1]) != major:
        raise NewerVersion(f"{where}: version {version}, but this fusedrf reads {major}.x; update fusedrf")
    required = content.get("requires", [])
    if not isinstance(required, list) or any(word not in (FAR, RULES) for word in required):
        raise NewerVersion(
            f"{where}: requires {required!r}, which this version does not know; update fusedrf"
        )
    newer = int(match[2]) > minor
    if newer:
        text = f"{where}: version {version} is newer than {VERSION}; what is new is ignored"
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


def _up(content: dict) -> tuple[float, ...] | None:
    """Which way is up, checked."""
    up = content.get("up")
    if up is None:
        return None
    if not 0.99 <= math.hypot(*up) <= 1.01:
        raise BadSchema(f"up {up} should have a length of 1")
    return tuple(float(number) for number in up)


def _check_extent(nodes: object, where: str) -> None:
    """Count and depth on the raw JSON, before anything recurses into it."""
    count = 0
    for depth, level in enumerate(_levels(nodes), 1):
        count += len(level)
        if count > MAX_NODES or depth > MAX_DEPTH:
            raise LimitExceeded(f"{where}: more than {MAX_NODES:,} nodes or {MAX_DEPTH} levels of children")


def _levels(nodes: object) -> Iterator[list]:
    """What stands where nodes should, of raw JSON: the roots, their children, and so on."""
    level = nodes if isinstance(nodes, list) else []
    while level:
        yield level
        lists = [node.get("children") for node in level if isinstance(node, dict)]
        level = [child for children in lists if isinstance(children, list) for child in children]


def _unknown_word(nodes: object) -> str:
    """What is wrong with the first node that has a word which nodes do not have; nothing where none does."""
    for node in chain.from_iterable(_levels(nodes)):
        if isinstance(node, dict) and (unknown := sorted(node.keys() - set(NODE_KEYS))):
            words = ", ".join(NODE_KEYS)
            return f"node {node.get('name')!r} has the word {unknown[0]!r}, expected some of {words}"
    return ""


def _known(nodes: object) -> object:
    """Nodes without the keys that a newer minor version may have added."""
    if isinstance(nodes, list):
        return [_known(node) for node in nodes]
    if not isinstance(nodes, dict):
        return nodes
    known = {key: value for key, value in nodes.items() if key in NODE_KEYS}
    return known | {"children": _known(known["children"])} if "children" in known else known


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
        content.get("source_matrix"),
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
    if node.source_matrix is not None:
        content["source_matrix"] = node.source_matrix
    content |= {key: node.extras[key] for key in sorted(node.extras)}
    if node.children:
        content["children"] = [_node_content(child) for child in node.children]
    return content
