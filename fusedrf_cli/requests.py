"""What every verb is asked, with its defaults, in one object each: of the command line and of Python alike.

Sizes are bytes, times seconds, lengths world units, angles degrees. None is left to choose.
"""

import math
from dataclasses import KW_ONLY, dataclass
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from fusedrf_cli.errors import UsageProblem
from fusedrf_cli.import_request import ImportRequest as ImportRequest
from fusedrf_cli.request_parts import (
    Box,
    Count,
    Learning,
    Node,
    Placing,
    Positive,
    Precision,
    Running,
    Seed,
    Shape,
    Size,
    Sizing,
    Sphere,
    Vector,
    Writing,
    ending_of,
)
from fusedrf_cli.train_request import TrainRequest as TrainRequest


@dataclass(frozen=True)
class PoseRequest(Writing):
    """Photos to a capture, which says where they were taken."""

    folders: ClassVar[bool] = True
    photos: str
    output: str
    _: KW_ONLY
    threads: Annotated[int, Meta(ge=1, le=4096)] | None = None


@dataclass(frozen=True, kw_only=True)
class Input(Placing):
    """A bundle or a scene in a composed one."""

    path: str
    name: str | None = None
    """None: the file's stem."""
    background_node: bool = False
    crop: Shape | None = None
    opacity: Annotated[float, Meta(gt=0, le=1)] | None = None
    tint: Vector | None = None
    hidden: bool = False

    @property
    def node_name(self) -> str:
        return self.name or Path(self.path).stem or Path(self.path).resolve().stem or "source"


@dataclass(frozen=True)
class ComposeRequest(Writing):
    """Bundles and scenes to one scene graph."""

    stdout: ClassVar[bool] = True
    inputs: tuple[str | Input, ...]
    output: str
    _: KW_ONLY
    composition: Literal["max", "add"] = "max"
    allow_outside: bool = False


@dataclass(frozen=True)
class FuseRequest(Writing, Learning, Sizing):
    """A scene to one field."""

    scene: str
    output: str
    _: KW_ONLY
    kind: str = "auto"
    finetune: bool = True
    """Whether to finish on rendered rays."""
    from_scratch: bool = False
    keep_sources: bool = False
    allow_outside: bool = False
    resume: bool = False
    sources: str | None = None
    """A folder in which sources of a fused bundle are looked for."""


@dataclass(frozen=True)
class ConvertRequest(Writing, Learning, Sizing):
    """A field to one of another kind."""

    field: str
    output: str
    _: KW_ONLY
    kind: str


@dataclass(frozen=True, kw_only=True)
class EditRequest(Writing):
    """A bundle that is changed; `fused` is read, and may be the output itself."""

    undoable: bool = False
    """Whether to keep the bundle as it was, for `undo`."""
    memory: Count | None = None


@dataclass(frozen=True)
class AddRequest(EditRequest, Placing):
    """One more object."""

    fused: str
    source: str
    output: str
    _: KW_ONLY
    name: str
    precision: Precision | None = None
    """None: as it is stored in its source."""

    @property
    def node_name(self) -> str:
        return self.name


@dataclass(frozen=True, kw_only=True)
class HoleRequest(Writing, Learning):
    """What becomes of the hole that an object leaves."""

    refit: str | None = None
    """A capture of what was behind it."""
    fill: bool = False
    """Whether what is seen nowhere is filled smoothly."""


@dataclass(frozen=True)
class DeleteRequest(EditRequest, HoleRequest):
    """Objects to be taken out."""

    fused: str
    names: tuple[str, ...]
    output: str
    _: KW_ONLY
    finetune: bool = True
    """Whether what fills a hole finishes on pictures."""
    allow_outside: bool = False

    def __post_init__(self):
        if twice := [name for name in dict.fromkeys(self.names) if self.names.count(name) > 1]:
            raise UsageProblem(f"{', '.join(twice)}: is to be deleted twice; give each name once")


@dataclass(frozen=True)
class ReplaceRequest(EditRequest):
    """Another object in the place of one."""

    fused: str
    name: str
    source: str
    output: str
    _: KW_ONLY
    precision: Precision | None = None
    """None: as it is stored in its source."""
    allow_outside: bool = False


class ShowRequest(EditRequest):
    """An object that is shown otherwise: `event` of the history, and words of a node, `showing`
    (formats/scene.py: SHOWING_KEYS), of which None takes one away."""


@dataclass(frozen=True)
class CropRequest(ShowRequest):
    """What of an object is shown."""

    event: ClassVar[str] = "cropped"
    fused: str
    name: str
    output: str
    _: KW_ONLY
    shape: Shape | None = None
    """Of the object's own world; None: all of it."""

    @property
    def showing(self) -> dict:
        return {"crop": self.shape and list(self.shape)}


@dataclass(frozen=True)
class TintRequest(ShowRequest):
    """What an object's colours and density are multiplied by; None: nothing."""

    event: ClassVar[str] = "tinted"
    fused: str
    name: str
    output: str
    _: KW_ONLY
    colour: Vector | None = None
    opacity: Annotated[float, Meta(gt=0, le=1)] | None = None

    @property
    def showing(self) -> dict:
        return {"tint": self.colour and list(self.colour), "opacity": self.opacity}


@dataclass(frozen=True, kw_only=True)
class ArrangeRequest(EditRequest):
    """An object that is moved, copied or renamed."""

    @property
    def node_name(self) -> str:
        return self.name if self.new_name is None else self.new_name


@dataclass(frozen=True)
class MoveRequest(ArrangeRequest, Placing):
    """An object somewhere else."""

    fused: str
    name: str
    output: str
    new_name: ClassVar[None] = None

    def __post_init__(self):
        if not self.words:
            raise UsageProblem("say where to: -t, -r, -s or --matrix")
        super().__post_init__()


@dataclass(frozen=True)
class DuplicateRequest(ArrangeRequest, Placing):
    """An object once more, placed from where it stands."""

    fused: str
    name: str
    new_name: str
    output: str


@dataclass(frozen=True)
class RenameRequest(ArrangeRequest, Node):
    """Another name for an object."""

    fused: str
    name: str
    new_name: str
    output: str

    def __post_init__(self):
        if self.name == self.new_name:
            raise UsageProblem(f"'{self.name}' is its name already; give a new one")
        super().__post_init__()


@dataclass(frozen=True)
class UndoRequest(Writing):
    """A bundle as it was before its last edit."""

    fused: str
    output: str


@dataclass(frozen=True)
class ExtractRequest(HoleRequest):
    """An object out of a field; what tells of it is in world units and pixels."""

    field: str
    output: str
    _: KW_ONLY
    boxes: tuple[Box, ...] = ()
    spheres: tuple[Sphere, ...] = ()
    """Each a centre and a radius."""
    mesh: str | None = None
    """A closed hull."""
    masks: str | None = None
    """A folder."""
    cameras: str | None = None
    """Of the masked pictures; None: those that the bundle keeps."""
    points: tuple[tuple[str, float, float, bool], ...] = ()
    """Each the name of a view, column and row of a pixel, and whether it shows the object."""
    name: str | None = None
    """Of a part that the field holds apart."""
    invert: bool = False
    """Write what is left instead."""
    preview: str | None = None
    """A folder of pictures."""
    precision: Precision | None = None
    """None: the field's own, where an object's numbers stay what they are by it, else float16."""
    max_size: Count | None = None

    def beside(self) -> dict[str, bool]:
        return {self.preview: True} if self.preview else {}


@dataclass(frozen=True)
class RenderRequest(Writing, Running):
    """Pictures or a film of a scene."""

    folders: ClassVar[bool] = True
    endings: ClassVar[tuple[str, ...]] = (".png", ".gif", ".mp4")
    scene: str
    output: str
    _: KW_ONLY
    cameras: str | None = None
    path: str | None = None
    views: Literal["capture", "heldout"] | None = None
    """The cameras of the capture that the scene keeps, or those of them that were held out."""
    orbit: Count | None = None
    look_at: Vector | None = None
    view_from: tuple[float, float] | None = None
    """From where to look: azimuth and elevation in degrees."""
    zoom: Positive = 1.0
    """How many times nearer than the default."""
    up: Vector | None = None
    """Which way of the world is up, of any length but 0; None: as the scene tells."""
    near: Annotated[float, Meta(ge=0)] = 0.0
    """Distance from a camera, in the world's units, from which what stands there is shown."""
    far: Positive = math.inf
    """Distance up to which it is shown."""
    step: Positive | None = None
    """How far samples of a ray lie apart, in the world's units where nothing is contracted; of several
    fields, of the finest one. None: half the finest voxel."""
    size: Size | None = None
    background: Vector | None = (1.0, 1.0, 1.0)
    """None: transparent."""
    depth: bool = False
    fps: Positive = 24.0
    reference: bool = False
    """Ask every source of a scene at every sample."""
    allow_outside: bool = False

    def __post_init__(self):
        chosen = [name for name in ("cameras", "path", "views", "orbit") if getattr(self, name) is not None]
        if len(chosen) > 1:
            raise UsageProblem(
                "--cameras, --path, --views and --orbit each choose the views; give one of them"
            )
        aimed = any(part is not None for part in (self.look_at, self.view_from, self.up)) or self.zoom != 1
        if aimed and chosen and chosen != ["orbit"]:
            raise UsageProblem(
                f"--look-at, --view-from, --zoom and --up do not apply to --{chosen[0]}; leave them out"
            )
        if self.near >= self.far:
            raise UsageProblem(
                f"--near {self.near:g} leaves nothing before --far {self.far:g}; give a greater --far"
            )

    def beside(self) -> dict[str, bool]:
        from formats.filenames import depth_of

        single = ending_of(self.output) == ".png"
        return {str(depth_of(Path(self.output))): False} if self.depth and single else {}


@dataclass(frozen=True)
class EvaluateRequest(Running):
    """A bundle against photos or another scene."""

    bundle: str
    against: str
    _: KW_ONLY
    split: Literal["test", "train", "all"] = "test"
    """Of a capture."""
    size: Size | None = None
    allow_outside: bool = False


@dataclass(frozen=True)
class ChartRequest(Writing, Running):
    """A scene fused in the ways that are worth it."""

    folders: ClassVar[bool] = True
    scene: str
    output: str
    _: KW_ONLY
    budget: Positive = 300.0
    kinds: tuple[str, ...] = ("blocks", "sparse", "vm")
    least_psnr: Positive = 30.0
    size: Size = (400, 400)
    allow_outside: bool = False
    seed: Seed = 0


@dataclass(frozen=True)
class ValidateRequest:
    """Bundles and scenes to be checked, byte for byte."""

    scenes: tuple[str, ...]
    _: KW_ONLY
    allow_outside: bool = False


@dataclass(frozen=True)
class InfoRequest:
    """What is in a bundle or a scene, or what `train` would read."""

    scene: str


@dataclass(frozen=True)
class HistoryRequest:
    """What was done to a bundle."""

    fused: str


@dataclass(frozen=True)
class KindsRequest:
    """The kinds of field."""
