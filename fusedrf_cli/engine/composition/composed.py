"""A composed scene: several placed fields that together are one radiance field."""

from collections.abc import Callable, Mapping
from copy import copy
from dataclasses import replace
from functools import cached_property, reduce

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.fields.base import RadianceField, sampling_step
from fusedrf_cli.engine.fields.occupancy import (
    OccupancyConfig,
    OccupancyGrid,
    frame_around,
    mapped,
    placed_box,
    placed_cells,
    unbounded_cells,
)
from fusedrf_cli.engine.fields.step_size_grid import StepSizeGrid
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import unbounded

RULES = ("max", "add")


class ComposedField:
    """The naive composition that fusing is measured against: every field is asked at every sample.

    Under `max` (FusedRF, eq. 2) the field with the highest σ gives σ and colour, ties going to the lower
    index; since all share the step that is the highest alpha, without the ties that alpha has in float32.
    Under `add` (D2NeRF) σ = Σσ_i and c = Σσ_i c_i / Σσ_i. The frame's origin is the scene's centre, `origin`
    in the world, so that a scene far from the world's origin loses no digits: world points and ray origins
    have `origin` subtracted in float64 before they come here. Where a scene is of no ordinary size, `origin`
    is a placement (4, 4) with a unit (`frame_around`). Where a field fills all of space, the frame is that
    field's, of the largest core where there are several, and `origin` its placement (4, 4).
    """

    kind = "composed"

    def __init__(self, placed: list[Placed], rule: str = "max", origin: np.ndarray | None = None):
        """origin: where its frame lies, where that is settled.

        Raises ValueError when there is nothing to compose or the rule is unknown."""
        if not placed:
            raise ValueError("a composed scene needs at least one field")
        if rule not in RULES:
            raise ValueError(f"composition should be one of {', '.join(RULES)}, found '{rule}'")
        if origin is not None:
            self.origin = origin
        elif any(p.unbounded for p in placed):
            self.origin = largest(placed).object_to_world
        else:
            boxes = np.stack([p.aabb for p in placed])
            self.origin = frame_around(np.concatenate([boxes[:, :3].min(0), boxes[:, 3:].max(0)]))
        self.placed, self.rule = [p.moved(self.origin) for p in placed], rule

    def posed(self, poses: Mapping[str, np.ndarray]) -> "ComposedField":
        """The same fields in the same frame, those named placed otherwise: (4, 4) object to this frame.
        Raises ValueError for a placement that cannot be inverted."""
        other = copy(self)
        other.__dict__.pop("occupancy", None)
        other.placed = [
            replace(p, object_to_world=poses[p.name]) if p.name in poses else p for p in self.placed
        ]
        return other

    def leaves(self) -> list[Placed]:
        """The fields that it places, in this frame; of composed scenes among them those that these place."""
        leaves = []
        for p in self.placed:
            inner = p.field.leaves() if isinstance(p.field, ComposedField) else None
            leaves += [p] if inner is None else [replace(q.within(p), name=q.name) for q in inner]
        return leaves

    def with_fields(self, change: Callable[[RadianceField], RadianceField]) -> "ComposedField":
        """The same scene of other fields: what `change` makes of each distinct one, in the order of
        `leaves`."""
        changed: dict[int, RadianceField] = {}

        def of(scene: ComposedField) -> ComposedField:
            other = ComposedField.__new__(ComposedField)
            other.rule, other.origin, other.placed = scene.rule, scene.origin, []
            for p in scene.placed:
                if id(p.field) not in changed:
                    inner = isinstance(p.field, ComposedField)
                    changed[id(p.field)] = of(p.field) if inner else change(p.field)
                other.placed.append(replace(p, field=changed[id(p.field)]))
            return other

        return of(self)

    @cached_property
    def occupancy(self) -> OccupancyGrid:
        """Cells that any placed field's occupied cells reach. In unbounded space each is sampled as finely as
        those that reach it need: most of it is far from anything that is fine."""
        config = current(OccupancyConfig)
        grids = ((p.occupancy, p.object_to_world) for p in self.placed)
        if any(p.unbounded for p in self.placed):
            again = ((p.occupancy, p.object_to_world) for p in self.placed)
            steps = (sampling_step(p.field) for p in self.placed)
            pace = StepSizeGrid(OccupancyGrid.full(unbounded.WHOLE, config.scene_cells, unbounded))
            marks = pace.kept(unbounded_cells(grids, config.scene_cells), again, steps)
            return replace(pace.grid(reduce(np.logical_or, marks)), looked_at=self.look_at_box)
        aabb, marks = placed_cells(np.stack([p.aabb for p in self.placed]), grids, config.scene_cells)
        return OccupancyGrid(aabb, reduce(np.logical_or, marks))

    @property
    def look_at_box(self) -> np.ndarray:
        """(6,) box of this frame that views look at, as OccupancyGrid.look_at_box."""
        if not any(p.unbounded for p in self.placed):
            return self.occupancy.look_at_box
        around = largest(self.placed)
        return placed_box(around.occupancy.look_at_box, around.object_to_world)

    @property
    def aabb(self) -> np.ndarray:
        """(6,) box around all fields, in this frame, or in the coordinates of its space."""
        return self.occupancy.aabb

    @property
    def voxel_size(self) -> float:
        """The finest detail of any placed field, in world units."""
        return min(p.voxel_size for p in self.placed)

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """σ (N,) and rgb (N, 3) at points (N, 3) along unit dirs (N, 3)."""
        # Sums in double, rounded once: single ones would differ in the last bit with the order of the nodes.
        real = torch.float64 if self.rule == "add" else torch.float32
        sigma, rgb = torch.zeros(len(points), dtype=real), torch.zeros(len(points), 3, dtype=real)
        ask = self._densest if self.rule == "max" else self._sum
        for placed in self.placed:  # one after the other: not all of them need to be in memory
            box = torch.from_numpy(placed.aabb)
            within = ((points >= box[:3]) & (points <= box[3:])).all(1)
            inside = torch.nonzero(within | placed.unbounded)[:, 0]
            if len(inside):
                ask(placed, inside, points, dirs, with_colour, sigma, rgb)
        if self.rule == "add" and with_colour:
            rgb /= sigma.clamp_min(1e-30)[:, None]
        return sigma.float(), rgb.float()

    def _densest(self, placed: Placed, inside, points, dirs, with_colour: bool, sigma, rgb) -> None:
        """Where a field is denser than those before it (at points of indices `inside`), its answer is
        taken."""
        densities = placed.query(points[inside], dirs[inside], False)[0].float()
        denser = densities > sigma[inside]
        won = inside[denser]
        sigma[won] = densities[denser]
        if with_colour and len(won):
            rgb[won] = placed.query(points[won], dirs[won])[1]

    def _sum(self, placed: Placed, inside, points, dirs, with_colour: bool, sigma, rgb) -> None:
        """A field's density at points of indices `inside`, and its colour by that weight, added."""
        densities = placed.query(points[inside], dirs[inside], False)[0].float().double()
        sigma[inside] += densities
        shown = inside[densities > 0]
        if with_colour and len(shown):
            rgb[shown] += (
                densities[densities > 0, None] * placed.query(points[shown], dirs[shown])[1].double()
            )


def occupied_at(field: RadianceField, points: np.ndarray) -> np.ndarray:
    """(N,) bool: which points (N, 3) of its frame lie in occupied cells of a field, or of one of those that a
    composed scene places: the cells that each has of its own, as far as its crops hold them."""
    field = opened(field)
    if not isinstance(field, ComposedField):
        return field.occupancy.contains(mapped(points, field.occupancy.space))
    return np.any([shown_at(p, points) for p in field.placed], 0)


def shown_at(placed: Placed, points: np.ndarray) -> np.ndarray:
    """`occupied_at` of a placed field, of points (N, 3) of what it is placed in."""
    matrix = placed.world_to_object
    own = points @ matrix[:3, :3].T + matrix[:3, 3]
    occupied = occupied_at(placed.field, own)
    return occupied & placed.crops.hold(own) if placed.crops else occupied


def largest(placed: list[Placed]) -> Placed:
    """Of fields that fill all of space the one with the largest core."""
    around = [p for p in placed if p.unbounded]
    return max(around, key=lambda p: abs(np.linalg.det(p.object_to_world[:3, :3])))
