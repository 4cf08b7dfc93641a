"""A composed scene of any kinds of field, answered and rendered by the compiled loops of its fields.

Rays go in waves: in each a ray goes on by its next segment (kernels/segments.py). One in which a single
instance has occupied cells is marched by that instance's own loops, in its frame and at its step; where
several meet, each leaves its samples, and these are merged by the scene's rule.
"""

from collections.abc import Iterable, Mapping
from functools import cached_property

import numpy as np
import torch
from numba import get_num_threads

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.base import RadianceField, sampling_step
from fusedrf_cli.engine.fields.computed import ComputedField, exact
from fusedrf_cli.engine.fields.occupancy import box_corners, squeezed
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kernels import segments
from fusedrf_cli.engine.kernels.instances import (
    FARTHEST,
    MAX_TRACED,
    Instances,
    PointAnswers,
    PointQuery,
    Slots,
    Traces,
)
from fusedrf_cli.engine.kernels.loops import POINTS_PER_TASK, RAYS_PER_TASK
from fusedrf_cli.engine.kernels.segments import RayBatch, Segments

MEETING = 8  # instances in one segment of a ray for which there is room at first
SLOTS_AT_ONCE = 1 << 14  # of which the samples are kept: 20 MB
ROUNDING = 1e-6  # share of a sphere's radius by which it is larger


def can_be_composite(placed: Iterable[Placed], rule: str = "max") -> bool:
    """Whether a Composite can be made of placed fields: not of those that only plain torch computes, nor of
    composed scenes of two more rules than its own."""
    try:
        leaves = [leaf for members, _ in groups_of(placed, rule) for leaf in members]
    except ValueError:
        return False
    fields = [opened(leaf.field) for leaf in leaves]
    return all(isinstance(f, ComputedField) and f.device_loops is not None for f in fields)


def groups_of(placed: Iterable[Placed], rule: str) -> list[tuple[list[Placed], str]]:
    """The fields of a scene in which some may be composed scenes themselves, as groups that each have a rule
    of their own. Scenes by the scene's rule are taken apart, since it is associative. Raises ValueError where
    groups would lie in groups."""
    groups: list[tuple[list[Placed], str]] = []
    for p in placed:
        scene = opened(p.field)
        if not isinstance(scene, ComposedField):
            groups.append(([p], rule))
            continue
        below = groups_of([q.within(p) for q in scene.placed], scene.rule)
        if scene.rule == rule:
            groups += below
        elif all(len(members) == 1 for members, _ in below):
            groups.append(([leaf for members, _ in below for leaf in members], scene.rule))
        else:
            raise ValueError(f"'{p.name}' holds groups of another rule than its own")
    return groups


def as_composite(scene: ComposedField) -> ComposedField:
    """A scene as a Composite in the same frame, where it can be one; else as it is."""
    if isinstance(scene, Composite) or not can_be_composite(scene.placed, scene.rule):
        return scene
    other = Composite.__new__(Composite)
    other.__dict__.update(scene.__dict__)
    return other


class Composite(ComposedField):
    """A scene of any kinds of field, mixed, that is answered as `ComposedField` answers it, and in far less
    time.

    Every instance is sampled along rays at the step at which it is sampled alone, not all of them at the
    finest of all. All fields stay in memory. Raises ValueError as ComposedField, and TypeError where it
    cannot be made (`can_be_composite`).
    """

    kind = "composite"
    rays_at_once = 1 << 16  # between which an interrupt is heard

    def __init__(self, placed: list[Placed], rule: str = "max", origin: np.ndarray | None = None):
        super().__init__(placed, rule, origin)
        if not can_be_composite(self.placed, rule):
            raise TypeError("compiled loops cannot compute every field of the scene; compose it as it is")

    def posed(self, poses: Mapping[str, np.ndarray]) -> "Composite":
        """See ComposedField."""
        other = super().posed(poses)
        for name in ("groups", "leaves", "instances", "sampling_step"):
            other.__dict__.pop(name, None)
        return other

    @cached_property
    def groups(self) -> list[tuple[list[Placed], str]]:
        """See `groups_of`; one of all where no two fields lie in a group."""
        groups = groups_of(self.placed, self.rule)
        if all(len(members) == 1 for members, _ in groups):
            return [([leaf for members, _ in groups for leaf in members], self.rule)]
        return groups

    @cached_property
    def leaves(self) -> list[Placed]:
        """The instances, in this frame."""
        return [leaf for members, _ in self.groups for leaf in members]

    @cached_property
    def group(self) -> np.ndarray:
        """(B,) int64: the group of each instance."""
        return np.repeat(np.arange(len(self.groups)), [len(members) for members, _ in self.groups])

    @cached_property
    def fields(self) -> list[ComputedField]:
        """The field of each instance."""
        return [opened(p.field) for p in self.leaves]

    @cached_property
    def field_of(self) -> np.ndarray:
        """(B,) int64: for each instance the first one with the same field."""
        first: dict[int, int] = {}
        return np.array([first.setdefault(id(field), b) for b, field in enumerate(self.fields)])

    @cached_property
    def instances(self) -> Instances:
        """What loops read of the cells that the instances occupy."""
        grids = [field.occupancy for field in self.fields]
        skip = {b: grids[b].skip.ravel() for b in np.unique(self.field_of)}
        first = dict(zip(skip, np.cumsum([0, *map(len, skip.values())]), strict=False))
        return Instances(
            np.stack([p.world_to_object[:3] for p in self.leaves]),
            *(
                np.stack(rows)
                for rows in zip(*((g.aabb[:3], g.aabb[3:], g.cell) for g in grids), strict=True)
            ),
            np.array([g.occupied.shape for g in grids], np.int64),
            np.array([first[b] for b in self.field_of], np.int64),
            np.concatenate(list(skip.values())),
            np.array([sampling_step(field) for field in self.fields]),
            np.stack([sphere_around(p, f) for p, f in zip(self.leaves, self.fields, strict=True)]),
            np.array([(p.opacity, *p.tint) for p in self.leaves]),
        )

    @cached_property
    def sampling_step(self) -> float:
        """The finest at which an instance is sampled, in this frame; see base.py."""
        pairs = zip(self.fields, self.leaves, strict=True)
        return min(sampling_step(field) * squeezed(p.object_to_world) for field, p in pairs)

    # -- points ----------------------------------------------------------------------------------------------

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See ComposedField."""
        points, dirs, n = exact(points), exact(dirs), len(points)
        sigma, rgb = np.zeros(n), np.zeros((n, 3))
        for g, (_, rule) in enumerate(self.groups):
            found = self.answers(np.flatnonzero(self.group == g), rule, points, dirs, with_colour)
            if len(self.groups) == 1:
                sigma, rgb = found.sigma, found.rgb
            elif self.rule == "add":
                share = found.sigma / np.maximum(sigma + found.sigma, 1e-300)
                sigma, rgb = sigma + found.sigma, rgb + share[:, None] * (found.rgb - rgb)
            else:
                rgb = np.where((found.sigma > sigma)[:, None], found.rgb, rgb)
                sigma = np.maximum(sigma, found.sigma)
        return torch.from_numpy(sigma).float(), torch.from_numpy(rgb).float()

    def answers(
        self, members: np.ndarray, rule: str, points: np.ndarray, dirs: np.ndarray, with_colour: bool
    ) -> PointAnswers:
        """What instances (M,) composed by a rule answer at points (N, 3) along dirs (N, 3)."""
        matrix, adds, n = self.instances.world_to_instance, rule == "add", len(points)
        asked = PointQuery(points, dirs, None, 0, matrix, self.instances.shown, adds, False)
        answers = PointAnswers(np.zeros(n), np.full(n, -1), np.empty(n, np.int64), np.zeros((n, 3)))
        near = {b: self.points_near(points, b) for b in members}
        for b, chosen in near.items():
            self.ask("densest_at", asked._replace(chosen=chosen, instance=b), answers)
        for b, chosen in near.items() if with_colour else ():
            shown = answers.sigma[chosen] > 0 if adds else answers.densest[chosen] == b
            coloured = asked._replace(chosen=chosen[shown], instance=b, with_colour=True)
            self.ask("colour_at", coloured, answers)
        return answers

    def points_near(self, points: np.ndarray, b: int) -> np.ndarray:
        """(M,) those of points (N, 3) that may lie in the occupied cells of an instance."""
        found = np.empty(len(points), np.int64)
        return found[: segments.points_in_sphere(points, self.instances.spheres[b], found)]

    def ask(self, item: str, query: PointQuery, answers: PointAnswers) -> None:
        """Let an instance enter its answers at the query's points."""
        if count := len(query.chosen):
            self.fields[query.instance].each(item, query, count, answers, POINTS_PER_TASK)

    # -- rays ------------------------------------------------------------------------------------------------

    def render_rays(
        self,
        rays_o: np.ndarray,
        rays_d: np.ndarray,
        reach: np.ndarray,
        step: float,
        early_stop: float,
        out: np.ndarray,
    ) -> None:
        """See ComputedField; instances are sampled at as many times their own steps as the step is times
        `sampling_step`."""
        rays = RayBatch(exact(rays_o), exact(rays_d), np.minimum(exact(reach), FARTHEST))
        march = Waves(self, rays, step / self.sampling_step, early_stop, out)
        while march.go_on():
            pass

    def rules(self, instance: np.ndarray) -> tuple[np.ndarray, np.ndarray, bool]:
        """The `groups` of `merge_samples` for slots of instances (S,)."""
        adds = np.array([rule == "add" for _, rule in self.groups])
        return self.group[instance], adds, self.rule == "add"

    @cached_property
    def traces(self) -> Traces:
        """Room for the samples of SLOTS_AT_ONCE slots, used again and again: fresh memory is slow to be
        had."""
        return room_for_traces(SLOTS_AT_ONCE)


class Waves:
    """Rays on their way through a scene."""

    def __init__(self, scene: Composite, rays: RayBatch, times: float, early_stop: float, out: np.ndarray):
        """times: how many times the instances' own steps their samples are apart."""
        self.scene, self.rays, self.early_stop, self.out = scene, rays, early_stop, out
        self.steps = times * scene.instances.step
        n = len(out)
        self.segments = Segments(
            *np.empty((2, n)), np.empty(n, np.int64), np.empty(n), rays.reach[:, 0].copy(),
            np.empty(n, np.int64), np.empty((n, MEETING), np.int64),
        )  # fmt: skip
        self.left = self.numbers = np.arange(n)
        unbounded = np.flatnonzero(scene.instances.spheres[:, 3] >= FARTHEST)
        self.unbounded = np.full(n, unbounded[0]) if len(unbounded) == 1 else None
        out[:] = 0

    def go_on(self) -> bool:
        """Take the rays that are left through their next segments; whether any are left behind them."""
        left, found = self.left, self.find(self.left)
        if self.unbounded is not None:
            alone = left[found.alone_to[left] > found.alone_from[left]]
            ends = found.alone_from, found.alone_to
            self.each("show_ray", alone, self.numbers, self.unbounded, ends, self.out)
        shared = self.each("show_ray", left, self.numbers, found.instance, (found.begin, found.end), self.out)
        for part in self.parts(shared):
            self.show_shared(part)
        after = np.empty_like(left)
        count = segments.rays_left(left, self.rays, found, self.out, self.early_stop, after)
        self.left = after[:count]
        return count > 0

    def find(self, left: np.ndarray) -> Segments:
        """The next segments of rays left (M,). Where more instances meet than there is room for, they are
        looked for again with more room."""
        arguments = self.rays, self.scene.instances
        segments.next_segments(*arguments, left, get_num_threads(), self.segments)
        shared = left[self.segments.instance[left] == segments.SHARED]
        found, room = self.segments.n_meeting[shared], self.segments.meeting.shape[1]
        if len(shared) and found.max() > room:
            again = shared[found > room]
            wider = np.empty((len(self.out), found.max()), np.int64)
            wider[:, :room] = self.segments.meeting
            self.segments = self.segments._replace(meeting=wider)
            self.segments.end[again] = self.segments.alone_from[again]
            segments.next_segments(*arguments, again, get_num_threads(), self.segments)
        return self.segments

    def parts(self, shared: np.ndarray) -> list[np.ndarray]:
        """Rays (M,) whose segments are shared in runs of about SLOTS_AT_ONCE slots."""
        slots = np.cumsum(self.segments.n_meeting[shared])
        cuts = np.flatnonzero(np.diff(slots // SLOTS_AT_ONCE)) + 1
        return np.split(shared, cuts) if len(shared) else []

    def show_shared(self, shared: np.ndarray) -> None:
        """The shared segments of rays (M,)."""
        found, counts = self.segments, self.segments.n_meeting[shared]
        start = np.concatenate([[0], np.cumsum(counts)])
        there = np.arange(found.meeting.shape[1]) < counts[:, None]
        slots = np.arange(start[-1]), np.repeat(shared, counts), found.meeting[shared][there]
        traces = self.scene.traces if start[-1] <= SLOTS_AT_ONCE else room_for_traces(start[-1])
        ends, groups = (found.begin, found.end), self.scene.rules(slots[2])
        self.each("trace_ray", *slots, ends, traces)
        segments.merge_samples(shared, start, self.early_stop, groups, traces, found.end, self.out)
        self.each("shade_ray", *slots, ends, traces)
        segments.add_colours(shared, start, traces, self.out)

    def each(
        self, item: str, chosen: np.ndarray, ray: np.ndarray, instance: np.ndarray, ends: tuple, out: object
    ) -> np.ndarray:
        """An item of work for slots chosen (M,), of ray (S,) and instance (S,), by the loops of each field;
        returns the slots that are SHARED. ends: from and to which distances (N,)."""
        scene, order = self.scene, np.empty_like(chosen)
        stops = np.empty(len(scene.fields) + 1, np.int64)
        segments.sort_slots(chosen, instance, scene.field_of, stops, order)
        for b in np.flatnonzero(np.diff(stops)):
            part = order[stops[b] : stops[b + 1]]
            slots = Slots(
                *self.rays, part, ray, instance, *ends, scene.instances.world_to_instance,
                scene.instances.shown,
                float(self.steps[b]), float(self.early_stop), self.out,
            )  # fmt: skip
            scene.fields[b].each(item, slots, len(part), out, RAYS_PER_TASK)
        return order[: stops[0]]


def room_for_traces(slots: int) -> Traces:
    """Room for the samples of so many slots."""
    count, cursor = np.empty((2, slots), np.int64)
    reals, cell = np.empty((5, slots, MAX_TRACED)), np.empty((slots, MAX_TRACED), np.int64)
    return Traces(count, np.empty(slots), *reals, cell, cursor, np.empty((slots, 3)))


def sphere_around(placed: Placed, field: RadianceField) -> np.ndarray:
    """(4,) centre and radius of a sphere around the occupied cells of a placed field, without end where they
    lie in unbounded space."""
    if placed.unbounded:
        return np.array([0, 0, 0, FARTHEST])
    corners, matrix = box_corners(field.occupancy.tight_aabb(0)), placed.object_to_world
    middle = corners.mean(0) @ matrix[:3, :3].T + matrix[:3, 3]
    radius = np.linalg.norm((corners - corners.mean(0)) @ matrix[:3, :3].T, axis=1).max()
    return np.array([*middle, radius * (1 + ROUNDING)])
