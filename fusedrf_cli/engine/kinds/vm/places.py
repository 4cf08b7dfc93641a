"""A vm student of a place in which objects stand: the place keeps its numbers, and one tensor, with texels as
fine as the objects', learns all that was put into it. So what is far away costs nothing to fuse, a frame
costs two tensors however many objects there are, and no object is blurred to the texels of a place."""

from dataclasses import replace
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.detail import Detail, details_at_voxel, extent
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.occupancy import placement
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kinds.student import Needs, Plan, Student, StudentRequest, Way
from fusedrf_cli.engine.kinds.vm.blocks import blocks_of, common_shape, reshaped
from fusedrf_cli.engine.kinds.vm.field import VMField, VMShape
from fusedrf_cli.engine.kinds.vm.trimming import without_unread

if TYPE_CHECKING:
    from fusedrf_cli.engine.kinds.vm.students import VMKind

MOST_OF_FILE = 0.7  # that a place may take, so that what stands in it has texels enough
PRECISIONS = ("float16", "int8", "int4")  # the dearest first
ALIKE = 1e-3  # entries of two rotations that count as one
COPIES = 2.5  # of the place, while it is joined to what was learnt


class PlaceStudent(Student):
    """One tensor for what stands in a place, beside the place; turned as most of that is."""

    def __init__(
        self, kind: "VMKind", place: Placed, objects: list[Placed], request: StudentRequest, shape: VMShape
    ):
        """The place and the objects in the frame of the composed scene; shape: of the field, which holds the
        place's."""
        self.turn = turn_of(objects)
        back = np.linalg.inv(self.turn)
        turned = [replace(p, object_to_world=back @ p.object_to_world) for p in objects]
        super().__init__(kind, ComposedField(turned), request)
        self.place, self.shape, self._bytes = place, shape, {}

    def place_bytes(self, precision: str) -> int:
        """Bytes of the file for the place."""
        if precision not in self._bytes:
            own = reshaped(opened(self.place.field).to("cpu"), self.shape)
            self._bytes[precision] = self.request.sizes.exactly(without_unread(own), precision)
        return self._bytes[precision]

    def fits(self, precision: str) -> bool:
        """Whether the place leaves enough of the file at a precision."""
        return self.place_bytes(precision) <= MOST_OF_FILE * (self.request.limit - self.request.overhead)

    def ways(self) -> list[list[Way]]:
        """In precisions that leave room beside the place: all that are tried for a target, else the dearest.
        Of the tensor the ranks and SH degree are the place's at least, since both are one field."""
        request = self.request
        choice = PRECISIONS if request.target is None else self.kind.precisions
        fitting = filter(self.fits, (request.precision,) if request.precision else choice)
        found = list(fitting if request.target is not None else islice(fitting, 1))
        ranks = self.shape.density_rank, self.shape.colour_rank
        return [[Way(p, ranks, self.shape.sh_degree)] for p in found]

    def bytes_of_plan(self, plan: Plan, way: Way) -> int:
        """See Student: with the place."""
        return self.place_bytes(way.precision) + super().bytes_of_plan(plan, way)

    def begun(
        self, plan: Plan, before: StoredField | None, background: Placed | None, generator: torch.Generator
    ) -> tuple[StoredField, str]:
        """See Student: the tensor alone."""
        field, start = super().begun(plan, before, None, generator)
        return field, start if before is not None else f"'{self.place.name}' as it is"

    def whole(self, field: StoredField) -> VMField:
        """The tensor in its place."""
        learnt = Placed("", field, self.turn @ placement(self.scene.origin))
        return without_unread(blocks_of([learnt, self.place]))

    def why(self, field: StoredField) -> str:
        """See Student."""
        return f"'{self.place.name}' as it is, and one vm tensor for all that stands in it"

    def details(self, field: VMField) -> list[Detail]:
        """See Student."""
        learnt, *own = field.voxel_sizes()
        place, held = self.place, min(own)
        kept = Detail(place.name, place.condition, 0.0, place.voxel_size, held, extent(place) / held)
        return [kept, *details_at_voxel(self.scene.placed, learnt)]

    def needs(self) -> Needs:
        """See Student: the tensor, and the place beside it."""
        place = opened(self.place.field).params.numel()
        return Needs(self.largest().numbers + place, COPIES, settled=place)


def turn_of(objects: list[Placed]) -> np.ndarray:
    """(4, 4) the turn by which most of the objects' texels are placed: a decomposition holds them best along
    their own axes. Of as many either way, one that does not depend on the objects' order."""
    turns = [turned_only(p.object_to_world[:3, :3]) for p in objects]
    texels = np.array([(extent(p) / p.voxel_size) ** 2 for p in objects])
    alike = np.array([[np.abs(a - b).max() < ALIKE for a in turns] for b in turns])
    ranked = [(float(f"{n:.6g}"), turn.tolist()) for n, turn in zip(alike @ texels, turns, strict=True)]
    found, most = np.eye(4), np.array(max(ranked)[1])
    if np.abs(most - np.eye(3)).max() >= ALIKE:
        found[:3, :3] = most
    return found


def turned_only(linear: np.ndarray) -> np.ndarray:
    """(3, 3) the rotation nearest to a linear map, or, of one that mirrors, to it with the third axis
    reversed."""
    u, _, v = np.linalg.svd(linear)
    return u @ v @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))])


def place_student(
    kind: "VMKind", scene: ComposedField, request: StudentRequest, asked: VMShape
) -> PlaceStudent | None:
    """The student of a scene in which bounded objects stand in one place of vm tensors. None of any other
    scene, where numbers are not to be taken over, where fewer ranks or SH bands than the place's are asked
    for, and where the place would take too much of the file.

    asked: the shape of a field as asked for, or as the kind has it.
    """
    around = [p for p in scene.placed if p.unbounded]
    objects = [p for p in scene.placed if not p.unbounded]
    if request.from_scratch or scene.rule != "max" or len(around) != 1 or not objects:
        return None
    (place,) = around
    if place.field.kind != VMField.kind or not place.as_it_is:
        return None
    shape = common_shape([opened(place.field).shape, asked])
    ranks = shape.density_rank, shape.colour_rank
    if request.ranks not in (None, ranks) or request.sh_degree not in (None, shape.sh_degree):
        return None
    student = PlaceStudent(kind, place, objects, request, shape)
    return student if student.ways() else None
