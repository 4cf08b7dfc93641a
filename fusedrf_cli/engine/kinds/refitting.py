"""Edits of a field that cannot be edited in a part of it: it learns the region anew, and beside it what it
showed before, so that it changes as little as it can elsewhere."""

import numpy as np

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.region import MaxOf, PatchedField
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.kinds.editing import Edited, Teach, enclosing
from fusedrf_cli.engine.spaces import bounded

HOW = "learnt again in the region, and held to what it showed elsewhere"


def added(field: StoredField, objects: list[Placed], teach: Teach) -> Edited:
    """The field with placed objects in it, where they are the densest."""
    region = enclosing([p.aabb for p in objects])
    return refitted(field, region, [Placed("", field, np.eye(4)), *objects], teach)


def refilled(field: StoredField, box: np.ndarray, rest: list[Placed], teach: Teach) -> Edited | None:
    """The field that shows in a box (6,) what the rest does there; None where nothing is left."""
    inside = [p for p in rest if p.reaches(box)]
    return refitted(field, box, inside, teach)


def refitted(field: StoredField, region: np.ndarray, inside: list[Placed], teach: Teach) -> Edited | None:
    """The field after learning to show, inside a region (6,), the densest of placed fields, and outside it
    what it showed; None where that is nothing at all."""
    own = field.occupancy.aabb
    grows = inside and field.occupancy.space is bounded  # unbounded space holds every region
    box = enclosing([own, region]) if grows else own
    teacher = PatchedField(field, box, region, MaxOf(inside))
    if not teacher.occupancy.occupied.any():
        return None
    student = field.with_params(field.params.clone())
    if not np.array_equal(box, own):
        grown = np.ceil((np.asarray(field.resolution) - 1) * (box[3:] - box[:3]) / (own[3:] - own[:3])) + 1
        student = student.resampled(box, tuple(int(n) for n in grown))
    student = student.with_occupancy(teacher.occupancy)
    taught, figures = teach(teacher, student, [teacher.occupancy.subject, region], False)
    return Edited(taught, region, HOW, False, figures)
