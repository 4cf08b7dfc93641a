"""What several requests share (requests.py)."""

import os
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from fusedrf_cli.placement import node_words

STDIO = "-"
Positive = Annotated[float, Meta(gt=0)]
Count = Annotated[int, Meta(ge=1)]
Seed = Annotated[int, Meta(ge=0, le=2**63 - 1)]
Vector = tuple[float, float, float]
Box = tuple[float, float, float, float, float, float]
Sphere = tuple[float, float, float, float]
Shape = Annotated[tuple[float, ...], Meta(min_length=4, max_length=6)]
"""A box, or a sphere's centre and radius."""
Row = tuple[float, float, float, float]
Size = tuple[Count, Count]
Precision = Literal["float16", "float32", "int8", "int4"]
ShDegree = Annotated[int, Meta(ge=0, le=3)]


@dataclass(frozen=True, kw_only=True)
class Running:
    """Where to compute."""

    device: Literal["auto", "cpu", "cuda"] = "auto"
    threads: Annotated[int, Meta(ge=1, le=4096)] | None = None
    """None: all cores."""
    memory: Count | None = None
    """None: 80 % of what is free."""


@dataclass(frozen=True, kw_only=True)
class Learning(Running):
    """How to learn."""

    time_budget: Positive | None = None
    """Seconds of learning in the whole command, all tries together."""
    seed: Seed = 0


@dataclass(frozen=True, kw_only=True)
class Writing:
    """What is written, as `output`, and what may not be replaced unasked."""

    folders: ClassVar[bool] = False
    """Whether the output may be a folder."""
    endings: ClassVar[tuple[str, ...]] = ()
    """Of files, where it may be a folder."""
    stdout: ClassVar[bool] = False
    """Whether an output of "-" is stdout."""
    overwrite: bool = False

    def beside(self) -> dict[str, bool]:
        """The other outputs, and which of them are folders."""
        return {}


@dataclass(frozen=True, kw_only=True)
class Sizing:
    """How large a field is to be, and how good."""

    max_size: Count | None = None
    target_psnr: Positive | None = None
    precision: Precision | None = None
    ranks: tuple[Count, Count] | None = None
    """Components per mode of density and of colour at most."""
    sh_degree: ShDegree | None = None


def ending_of(output: str) -> str:
    """The ending of a file's name, such as .png; "" of a folder, whose name has none or ends in a slash, or
    that is there."""
    ending = Path(output).suffix.lower()
    is_folder = output.endswith(("/", os.sep)) or os.path.isdir(output)
    return ending if ending[1:2].isalpha() and not is_folder else ""


class Node:
    """An object that gets a name, `node_name`; and a placement by `Placing`, which comes after this."""

    def __post_init__(self):
        self.object_to_world  # noqa: B018  (what is none is refused before any work)

    @cached_property
    def object_to_world(self):
        """(4, 4) float64. Raises BadSchema and its like for what is none."""
        from formats.scene import make_node

        return make_node(self.node_name, **self.words).node_to_parent

    @property
    def words(self) -> dict[str, tuple]:
        """Keywords of `formats.scene.make_node`."""
        return {}

    @property
    def absolute(self) -> bool:
        """Whether it turns and scales about the world's origin, not about the middle of the object."""
        return "matrix" in self.words


@dataclass(frozen=True, kw_only=True)
class Placing(Node):
    """Where an object is put: scaled, then turned, then moved; or by an affine alone."""

    translate: Vector | None = None
    rotate: Vector | None = None
    """About the world's x, then y, then z axis."""
    scale: float | Vector | None = None
    matrix: tuple[Row, Row, Row, Row] | None = None
    """By rows; columns act on points."""

    @property
    def words(self) -> dict[str, tuple]:
        """The same of where it is put. Raises UsageProblem where `matrix` is not alone."""
        scale = (self.scale,) * 3 if isinstance(self.scale, float) else self.scale
        return node_words(self.translate, self.rotate, scale, self.matrix)
