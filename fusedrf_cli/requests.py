"""What every command asks of the bridge: its words, checked by the command line, in one object each.

Sizes are bytes, times seconds, lengths world units.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, kw_only=True)
class Running:
    """Where to compute."""

    device: str
    threads: int | None


@dataclass(frozen=True, kw_only=True)
class Learning(Running):
    """How to learn."""

    time_budget: float | None
    """Seconds of learning in the whole command, all tries together."""
    seed: int


@dataclass(frozen=True, kw_only=True)
class PoseRequest:
    """Photos to a capture, which says where they were taken."""

    photos: str
    output: str
    overwrite: bool
    threads: int | None


@dataclass(frozen=True, kw_only=True)
class TrainRequest(Learning):
    """Photos or a mesh to one field."""

    source: str
    output: str
    overwrite: bool
    kind: str
    quality: str | None
    """None: as the time budget allows."""
    ranks: tuple[int, int] | None
    sh_degree: int | None
    precision: str | None
    """None: as suits the space."""
    max_size: int | None
    target_psnr: float | None
    holdout: int | None
    views: int
    size: int
    aabb: tuple[float, ...] | None
    unbounded: bool | None
    """Whether the field is to fill all of space; None: as the capture needs."""
    centre: tuple[float, float, float] | None
    radius: float | None
    """Of the core of unbounded space, whose detail is finest."""
    downscale: int | None
    """How many times smaller a side of photos is made; None: until it is no longer than photos need be."""
    masks: str
    """What the pixels mean that masks exclude: "ignore" or "alpha"."""
    refine_poses: bool
    """Whether to look for where the photos were taken from, near where they are said to have been."""
    memory: int | None
    resume: bool


@dataclass(frozen=True, kw_only=True)
class FuseRequest(Learning):
    """A scene to one field; None is left to choose."""

    scene: str
    output: str
    overwrite: bool
    kind: str
    max_size: int | None
    target_psnr: float | None
    precision: str | None
    ranks: tuple[int, int] | None
    """Components per mode of density and of colour at most."""
    sh_degree: int | None
    rgb: bool
    """Whether to finish on rendered rays."""
    from_scratch: bool
    keep_sources: bool
    memory: int | None
    allow_outside: bool
    resume: bool
    sources: str | None
    """A folder in which sources of a fused bundle are looked for."""


@dataclass(frozen=True, kw_only=True)
class ConvertRequest(Learning):
    """A field to one of another kind; None is left to choose."""

    field: str
    output: str
    overwrite: bool
    kind: str
    max_size: int | None
    target_psnr: float | None
    precision: str | None
    ranks: tuple[int, int] | None
    sh_degree: int | None
    memory: int | None


@dataclass(frozen=True, kw_only=True)
class EditRequest:
    """What edits have in common."""

    fused: str
    output: str
    overwrite: bool
    memory: int | None
    keep_history: bool
    """Whether to keep the bundle as it was, for `undo`."""


@dataclass(frozen=True, kw_only=True)
class AddRequest(EditRequest):
    """One more object."""

    precision: str | None
    """None: as it is stored in its source."""
    source: str
    name: str
    object_to_world: Any
    """(4, 4) float64."""


@dataclass(frozen=True, kw_only=True)
class MendingRequest(Learning):
    """What becomes of the hole that an object leaves."""

    output: str
    overwrite: bool
    memory: int | None
    refit: str | None
    """A capture of what was behind it."""
    fill: bool
    """Whether what is seen nowhere is filled smoothly."""


@dataclass(frozen=True, kw_only=True)
class DeleteRequest(EditRequest, MendingRequest):
    """Objects to be taken out."""

    names: tuple[str, ...]
    rgb: bool
    """Whether what fills a hole finishes on pictures."""
    allow_outside: bool


@dataclass(frozen=True, kw_only=True)
class ReplaceRequest(EditRequest):
    """Another object in the place of one."""

    name: str
    source: str
    precision: str | None
    """None: as it is stored in its source."""
    allow_outside: bool


@dataclass(frozen=True, kw_only=True)
class ShowRequest(EditRequest):
    """An object that is shown otherwise."""

    name: str
    event: str
    """Of the history."""
    showing: dict
    """Words of a node (formats/scene.py: SHOWING_KEYS); None takes one away."""


@dataclass(frozen=True, kw_only=True)
class ArrangeRequest(EditRequest):
    """An object that is moved, copied or renamed."""

    name: str
    new_name: str | None
    """None: the same."""
    matrix: Any
    """(4, 4) float64 of the world."""
    absolute: bool
    """Whether that turns and scales about the world's origin, not about the middle of the object."""


@dataclass(frozen=True, kw_only=True)
class ExtractRequest(MendingRequest):
    """An object out of a field; what tells of it is in world units and pixels."""

    field: str
    boxes: tuple[tuple[float, ...], ...]
    """Each (6,)."""
    spheres: tuple[tuple[float, ...], ...]
    """Each (4,): centre and radius."""
    mesh: str | None
    """A closed hull."""
    masks: str | None
    """A folder."""
    cameras: str | None
    """Of the masked pictures; None: those that the bundle keeps."""
    points: tuple[tuple[str, float, float, bool], ...]
    """Each the name of a view, column and row of a pixel, and whether it shows the object."""
    name: str | None
    """Of a part that the field holds apart."""
    invert: bool
    """Write what is left instead."""
    preview: str | None
    """A folder of pictures."""
    precision: str | None
    """None: the field's own, where an object's numbers stay what they are by it, else float16."""
    max_size: int | None


@dataclass(frozen=True, kw_only=True)
class RenderRequest(Running):
    """Pictures or a film of a scene."""

    scene: str
    output: str
    overwrite: bool
    cameras: str | None
    path: str | None
    views: str | None
    """"capture" or "heldout": the cameras of the capture that the scene keeps."""
    orbit: int | None
    look_at: tuple[float, float, float] | None
    direction: tuple[float, float] | None
    """From where to look: azimuth and elevation in degrees."""
    zoom: float
    """How many times nearer than the default."""
    up: tuple[float, float, float] | None
    """Which way of the world is up, of any length but 0; None: as the scene tells."""
    near: float
    """Distance from a camera, in the world's units, from which what stands there is shown."""
    far: float
    """Distance up to which it is shown."""
    size: tuple[int, int] | None
    background: tuple[float, float, float] | None
    """None: transparent."""
    depth: bool
    fps: float
    naive: bool
    """Ask every source of a scene at every sample."""
    memory: int | None
    allow_outside: bool


@dataclass(frozen=True, kw_only=True)
class EvaluateRequest(Running):
    """A bundle against photos or another scene."""

    bundle: str
    against: str
    split: str
    size: tuple[int, int] | None
    memory: int | None
    allow_outside: bool


@dataclass(frozen=True, kw_only=True)
class ChartRequest(Running):
    """A scene fused in the ways that are worth it."""

    scene: str
    output: str
    overwrite: bool
    budget: float
    kinds: tuple[str, ...]
    least_psnr: float
    size: tuple[int, int]
    memory: int | None
    allow_outside: bool
    seed: int
    fuse_request: Callable[[tuple[str, ...]], FuseRequest]
    """What `fusedrf fuse` makes of flags: so every label is the flags that gave the point."""
