"""A captured background that a learnt `fuse` keeps: it stays a node, and one field, with texels as fine as
the objects', learns all that stands in it. So what is far away costs nothing to fuse, and no object is
blurred to the texels of a background."""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.resolution_report import ResolutionReport, extent
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import placement
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import BuildRequest
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class BackgroundConfig:
    """How a background is taken over."""

    most_of_file: float = 0.7
    """That a background may take, so that what stands in it has numbers enough."""
    alike: float = 1e-3
    """Entries of two rotations that count as one."""


LEARNT = "fused"  # the node of what was learnt


@dataclass(frozen=True)
class Background:
    """What stays as it is of a scene, and what is learnt beside it."""

    placed: Placed
    """In the composed scene's frame; of the field of the source, or of one that is stored anew."""
    precision: str | None
    """In which its field is stored; None: with the bytes of its source."""
    bytes: int
    """Of the file."""
    turn: np.ndarray
    """(4, 4) from the frame in which the others are learnt to that of the composed scene."""
    objects: ComposedField
    """The others, turned as most of them are."""

    def with_learnt(self, field: StoredField) -> ComposedField:
        """The scene of the background and a field that stands for the others, in the composed scene's
        frame."""
        learnt = Placed(LEARNT, field, self.turn @ placement(self.objects.origin))
        return ComposedField([self.placed, learnt], origin=np.zeros(3))

    @property
    def start(self) -> str:
        """What a report says that learning began from."""
        return f"'{self.placed.name}' as it is"

    @property
    def detail(self) -> ResolutionReport:
        """That it is held as it is."""
        p = self.placed
        return ResolutionReport(
            p.name, p.condition, 0.0, p.voxel_size, p.voxel_size, extent(p) / p.voxel_size
        )


def background_for(kind: Kind, scene: ComposedField, request: BuildRequest) -> Background | None:
    """What a learnt field of a kind stands beside: the only unbounded field of a scene by `max`. None of any
    other scene, where numbers are not to be taken over, and where it would take too much of the file."""
    around = [p for p in scene.placed if p.unbounded]
    others = [p for p in scene.placed if not p.unbounded]
    if request.from_scratch or scene.rule != "max" or len(around) != 1 or not others:
        return None
    if not kind.beside_background or isinstance(around[0].field, ComposedField):
        return None
    turn = turn_of(others)
    back = np.linalg.inv(turn)
    objects = ComposedField([replace(p, object_to_world=back @ p.object_to_world) for p in others])
    for field, precision, size in storage_options(around[0].field, request):
        if size <= current(BackgroundConfig).most_of_file * (request.limit - request.overhead):
            return Background(replace(around[0], field=field), precision, size, turn, objects)
    return None


def storage_options(
    field: StoredField, request: BuildRequest
) -> Iterator[tuple[StoredField, str | None, int]]:
    """A field, the precision that it is stored in, and its bytes: as its source has it, then in fewer bits
    each time."""
    own = request.stored_bytes.get(id(field))
    if request.precision is None and own is not None:
        yield field, None, own
    trimmed = registry.kind(field.kind).trimmed(opened(field).to("cpu"))
    dearest_first = "float16", "int8", "int4"
    for precision in (request.precision,) if request.precision else dearest_first:
        yield trimmed, precision, request.sizes.exactly(trimmed, precision)


def turn_of(objects: list[Placed]) -> np.ndarray:
    """(4, 4) the turn by which most of the objects' texels are placed: a decomposition holds them best along
    their own axes. Of as many either way, one that does not depend on the objects' order."""
    config = current(BackgroundConfig)
    turns = [turned_only(p.object_to_world[:3, :3]) for p in objects]
    texels = np.array([(extent(p) / p.voxel_size) ** 2 for p in objects])
    alike = np.array([[np.abs(a - b).max() < config.alike for a in turns] for b in turns])
    ranked = [(float(f"{n:.6g}"), turn.tolist()) for n, turn in zip(alike @ texels, turns, strict=True)]
    rotation, most = np.eye(4), np.array(max(ranked)[1])
    if np.abs(most - np.eye(3)).max() >= config.alike:
        rotation[:3, :3] = most
    return rotation


def turned_only(linear: np.ndarray) -> np.ndarray:
    """(3, 3) the rotation nearest to a linear map, or, of one that mirrors, to it with the third axis
    reversed."""
    u, _, v = np.linalg.svd(linear)
    return u @ v @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))])
