"""Nodes of the scene graph: names, placements, and what is shown of them.

Placement words are glTF's: `translation`, `rotation` (unit quaternion xyzw) and `scale`, scale applied first;
or `matrix`, four rows of four. Matrices are (4, 4) float64 and act on column points.
"""

import dataclasses
import math
import unicodedata
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from formats.errors import BadName, BadSchema, FormatWarning, LimitExceeded, NotFinite, SingularTransform
from formats.rotations import matrices

MAX_NAME_BYTES = 255
MAX_TRANSLATION = 1e13
SINGULAR_VALUES = 1e-12, 1e12
MAX_CONDITION = 1e6
WARN_CONDITION = 1e3
# A unit quaternion typed with two decimals is off by at most this.
QUATERNION_SLACK = 1e-2
# These could forge what a terminal shows; other format characters hold emoji together and stay.
BIDIRECTIONAL = "\u202a\u202b\u202c\u202d\u202e\u2066\u2067\u2068\u2069"
PLACEMENT_KEYS = ("translation", "rotation", "scale", "matrix")
WHITE = (1.0, 1.0, 1.0)  # the tint that changes nothing


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
    source_matrix: list[list[float]] | None = None
    """(4, 4) by which the field lay in the file that the node stands for, where not as it is; the placement
    holds it already."""
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
        if self.source_matrix is not None:
            check_affine(
                _numbers(self.source_matrix, (4, 4), self.name, "source_matrix"), f"node {self.name!r}"
            )
        object.__setattr__(self, "node_to_parent", matrix)

    @property
    def source_to_parent(self) -> np.ndarray:
        """(4, 4) by which the frame of the file that it stands for lies in its parent's; its own frame's,
        where there is no other."""
        return source_placement(self.node_to_parent, self.source_matrix)


def source_placement(object_to_world: np.ndarray, source_matrix: list[list[float]] | None) -> np.ndarray:
    """Where the frame of a file lies of which a field is that lay in it by a (4, 4), and lies by another one
    now; None: it lay in it as it is."""
    if source_matrix is None:
        return object_to_world
    at = object_to_world @ np.linalg.inv(source_matrix)
    at[3] = 0, 0, 0, 1
    return at


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
    source_matrix: list[list[float]] | None = None
    """See `Node`."""

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

    def within(self, matrix: np.ndarray) -> "Crop":
        """The crop for an object that lies in this one's by a (4, 4)."""
        return replace(self, object_to_shape=self.object_to_shape @ matrix)


def make_node(
    name: str,
    *,
    source: str | None = None,
    field: str | None = None,
    background: bool = False,
    children: tuple[Node, ...] = (),
    showing: dict | None = None,
    **placement,
) -> Node:
    """A node, placed by translation (3,), rotation (4,) quaternion xyzw and scale (3,), or by matrix (4, 4);
    showing are its SHOWING_KEYS.

    Raises BadName, BadSchema, NotFinite, SingularTransform, LimitExceeded.
    """
    placement = {key: np.asarray(value).tolist() for key, value in placement.items() if value is not None}
    return Node(name, field, source, placement, background, tuple(children), {}, showing or {})


def check_name(name: str) -> None:
    if not isinstance(name, str) or not name:
        raise BadName(f"node name {name!r} is no name; give one of at least one character")
    if (size := len(name.encode(errors="replace"))) > MAX_NAME_BYTES:
        raise BadName(f"node name '{name[:40]}…' has {size:,} bytes; give one of at most {MAX_NAME_BYTES}")
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
    turn = _numbers(placement.get("rotation", [0, 0, 0, 1]), (4,), name, "rotation")
    norm = math.hypot(*turn)
    if abs(norm - 1) > QUATERNION_SLACK:
        raise BadSchema(f"node {name!r}: rotation has length {norm:.6g}, expected a unit quaternion xyzw")
    scale = _numbers(placement.get("scale", [1, 1, 1]), (3,), name, "scale")
    if 0 in scale:
        raise SingularTransform(f"node {name!r}: scale {scale.tolist()} is not three numbers, none of them 0")
    matrix = np.eye(4)
    matrix[:3, :3] = matrices(turn / norm) * scale
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
    if not within(matrix, MAX_TRANSLATION, SINGULAR_VALUES) or not high / low <= MAX_CONDITION:
        smallest, largest = SINGULAR_VALUES
        raise SingularTransform(
            f"{who}: scales by {low:.3g} to {high:.3g}, expected {smallest:g} to {largest:g} "
            f"with a ratio of at most {MAX_CONDITION:g}; choose another unit, or stretch it less"
        )
    if high / low > WARN_CONDITION:
        text = f"{who}: stretched {high / low:.0f} times more along one axis than along another"
        warnings.warn(text, FormatWarning, 2)


def within(matrix: np.ndarray, farthest: float, sizes: tuple[float, float]) -> bool:
    """Whether an affine (4, 4) moves no farther and scales by no other than these."""
    high, _, low = np.linalg.svd(matrix[:3, :3], compute_uv=False)
    # The slack lets a scale of exactly the limit through the rounding of the decomposition.
    scales = low >= sizes[0] * (1 - 1e-9) and high <= sizes[1] * (1 + 1e-9)
    return bool(scales and np.abs(matrix[:3, 3]).max() <= farthest)
