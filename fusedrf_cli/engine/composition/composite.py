"""A composed scene of any kinds of field, answered and rendered by the compiled loops of its fields.

Rays go in waves: in each a ray goes on by its next segment (kernels/segments.py). One in which a single
instance has occupied cells is marched by that instance's own loops, in its frame and at its step; where
several meet, each leaves its samples, and these are merged by the scene's rule.
"""

from collections.abc import Iterable, Mapping
from functools import cached_property
from types import ModuleType

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.base import RadianceField, sampling_step
from fusedrf_cli.engine.fields.computed import ComputedField, exact
from fusedrf_cli.engine.fields.occupancy import box_corners, squeezed
from fusedrf_cli.engine.fields.streamed import opened
from fusedrf_cli.engine.kernels.bundles import RayBatch
from fusedrf_cli.engine.kernels.instances import (
    MAX_TRACED,
    Instances,
    PointAnswers,
    PointQuery,
    Slots,
    Traces,
)
from fusedrf_cli.engine.kernels.loops import POINTS_PER_TASK, RAYS_PER_TASK
from fusedrf_cli.engine.kernels.primitives import FARTHEST
from fusedrf_cli.engine.kernels.segments import (
    SHARED,
    Groups,
    Segments,
    points_in_sphere,
    sort_slots,
)
from fusedrf_cli.engine.spaces import bounded

SLOTS_AT_ONCE = 1 << 14  # of which the samples are kept: 20 MB


def can_be_composite(placed: Iterable[Placed], rule: str = "max") -> bool:
    """Whether a Composite can be made of placed fields: not of those that only plain torch computes, or that
    lie on two devices, nor of composed scenes of two more rules than its own."""
    try:
        leaves = [leaf for members, _ in groups_of(placed, rule) for leaf in members]
    except ValueError:
        return False
    fields = [opened(leaf.field) for leaf in leaves]
    computed = all(isinstance(f, ComputedField) and f.device_loops is not None for f in fields)
    return computed and len({f.device_loops for f in fields}) == 1


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
        for name in ("groups", "parts", "instances", "placed_instances", "spaces", "sampling_step"):
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
    def parts(self) -> list[Placed]:
        """The instances, in this frame."""
        return [leaf for members, _ in self.groups for leaf in members]

    @cached_property
    def group(self) -> np.ndarray:
        """(B,) int64: the group of each instance."""
        return np.repeat(np.arange(len(self.groups)), [len(members) for members, _ in self.groups])

    @cached_property
    def fields(self) -> list[ComputedField]:
        """The field of each instance."""
        return [opened(p.field) for p in self.parts]

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
            np.stack([p.world_to_object[:3] for p in self.parts]),
            *(
                np.stack(rows)
                for rows in zip(*((g.aabb[:3], g.aabb[3:], g.cell) for g in grids), strict=True)
            ),
            np.array([g.occupied.shape for g in grids], np.int64),
            np.array([first[b] for b in self.field_of], np.int64),
            np.concatenate(list(skip.values())),
            np.array([sampling_step(field) for field in self.fields]),
            np.stack([sphere_around(p, f) for p, f in zip(self.parts, self.fields, strict=True)]),
            np.array([self.spaces.index(p.space) if p.space in self.spaces else -1 for p in self.parts]),
            np.array([(p.opacity, *p.tint) for p in self.parts]),
            np.cumsum([0, *(len(p.crops.items) for p in self.parts)]),
            np.array([row for p in self.parts for row in crop_rows(p)]).reshape(-1, 13),
        )

    @cached_property
    def spaces(self) -> tuple[ModuleType, ...]:
        """Those without end that instances lie in, by name."""
        spaces = {p.space for p in self.parts if p.space is not bounded}
        return tuple(sorted(spaces, key=lambda space: space.__name__))

    @cached_property
    def sampling_step(self) -> float:
        """The finest at which an instance is sampled, in this frame; see base.py."""
        pairs = zip(self.fields, self.parts, strict=True)
        return min(sampling_step(field) * squeezed(p.object_to_world) for field, p in pairs)

    # -- points ----------------------------------------------------------------------------------------------

    def query(
        self, points: torch.Tensor, dirs: torch.Tensor, with_colour: bool = True
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """See ComposedField."""
        points, dirs, n = exact(points), exact(dirs), len(points)
        sigma, rgb = np.zeros(n), np.zeros((n, 3))
        for g, (_, rule) in enumerate(self.groups):
            group_answers = self.answers(np.flatnonzero(self.group == g), rule, points, dirs, with_colour)
            if len(self.groups) == 1:
                sigma, rgb = group_answers.sigma, group_answers.rgb
            elif self.rule == "add":
                share = group_answers.sigma / np.maximum(sigma + group_answers.sigma, 1e-300)
                sigma, rgb = sigma + group_answers.sigma, rgb + share[:, None] * (group_answers.rgb - rgb)
            else:
                rgb = np.where((group_answers.sigma > sigma)[:, None], group_answers.rgb, rgb)
                sigma = np.maximum(sigma, group_answers.sigma)
        return torch.from_numpy(sigma).float(), torch.from_numpy(rgb).float()

    def answers(
        self, members: np.ndarray, rule: str, points: np.ndarray, dirs: np.ndarray, with_colour: bool
    ) -> PointAnswers:
        """What instances (M,) composed by a rule answer at points (N, 3) along dirs (N, 3)."""
        instances, adds, n = self.instances, rule == "add", len(points)
        loops = self.device_loops
        place = loops.on_device
        query = PointQuery(
            place(points), place(dirs), None, 0, instances.world_to_instance, instances.shown,
            instances.first_crop, instances.crops, adds, False,
        )  # fmt: skip
        answers = PointAnswers(np.zeros(n), np.full(n, -1), np.empty(n, np.int64), np.zeros((n, 3)))
        answers = place(answers)
        near = {b: self.points_near(points, b) for b in members}
        for b, chosen in near.items():
            self.ask("densest_at", query._replace(chosen=chosen, instance=b), answers)
        sigma, densest = loops.on_host(answers.sigma), loops.on_host(answers.densest)
        for b, chosen in near.items() if with_colour else ():
            shown = sigma[chosen] > 0 if adds else densest[chosen] == b
            coloured = query._replace(chosen=chosen[shown], instance=b, with_colour=True)
            self.ask("colour_at", coloured, answers)
        return answers._replace(sigma=sigma, rgb=loops.on_host(answers.rgb))

    def points_near(self, points: np.ndarray, b: int) -> np.ndarray:
        """(M,) those of points (N, 3) that may lie in the occupied cells of an instance."""
        inside = np.empty(len(points), np.int64)
        return inside[: points_in_sphere(points, self.instances.spheres[b], inside)]

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
        march = Waves(self, rays, step / self.sampling_step, early_stop, np.zeros_like(out))
        while march.go_on():
            pass
        out[:] = self.device_loops.on_host(march.out)

    @property
    def device_loops(self) -> ModuleType:
        """Of the device that all fields' numbers lie on."""
        return self.fields[0].device_loops

    def rules(self, instance: np.ndarray) -> Groups:
        """By which slots of instances (S,) are composed."""
        adds = np.array([rule == "add" for _, rule in self.groups])
        return Groups(self.group[instance], adds, self.rule == "add")

    @cached_property
    def placed_instances(self) -> Instances:
        """`instances` where the loops read them."""
        return self.device_loops.on_device(self.instances)

    @cached_property
    def traces(self) -> Traces:
        """Room for the samples of SLOTS_AT_ONCE slots, used again and again: fresh memory is slow to be
        had."""
        return self.device_loops.on_device(room_for_traces(SLOTS_AT_ONCE))


class Waves:
    """Rays on their way through a scene. Arrays lie where the loops read them, on a GPU or here; what comes
    here of them is which instances meet where, by which work is sorted."""

    def __init__(self, scene: Composite, rays: RayBatch, times: float, early_stop: float, out: np.ndarray):
        """times: how many times the instances' own steps their samples are apart. out (N, 5) is 0."""
        self.scene, self.early_stop, self.loops = scene, early_stop, scene.device_loops
        self.segment_loops, place = self.loops.segments(), self.loops.on_device
        self.steps = times * scene.instances.step
        n, meeting = len(out), 8  # instances in one segment of a ray for which there is room at first
        segments = Segments(
            *np.empty((2, n)), np.empty(n, np.int64), np.empty(n), rays.reach[:, 0].copy(),
            np.empty(n, np.int64), np.empty((n, meeting), np.int64),
        )  # fmt: skip
        self.rays, self.out, self.segments = place(rays), place(out), place(segments)
        self.left = np.arange(n)
        self.numbers = place(self.left)
        unbounded = np.flatnonzero(scene.instances.spheres[:, 3] >= FARTHEST)
        self.unbounded = place(np.full(n, unbounded[0])) if len(unbounded) == 1 else None

    def told(self, name: str) -> np.ndarray:
        """An array of the segments, here."""
        return self.loops.on_host(getattr(self.segments, name))

    def here(self) -> Segments:
        """The segments, here."""
        return Segments(*(self.told(name) for name in Segments._fields))

    def go_on(self) -> bool:
        """Take the rays that are left through their next segments; whether any are left behind them."""
        left = self.left
        self.find(left)
        next_segments = self.segments
        if self.unbounded is not None:
            alone = left[self.told("alone_to")[left] > self.told("alone_from")[left]]
            ends = next_segments.alone_from, next_segments.alone_to
            self.each("show_ray", alone, self.numbers, self.unbounded, ends, self.out)
        shared = self.each(
            "show_ray",
            left,
            self.numbers,
            next_segments.instance,
            (next_segments.begin, next_segments.end),
            self.out,
        )
        for part in self.parts(shared):
            self.show_shared(part)
        self.left = self.segment_loops.rays_left(left, self.rays, next_segments, self.out, self.early_stop)
        return len(self.left) > 0

    def find(self, left: np.ndarray) -> None:
        """The next segments of rays left (M,). Where more instances meet than there is room for, they are
        looked for again with more room."""
        arguments = self.rays, self.scene.placed_instances, self.scene.spaces
        self.segment_loops.next_segments(*arguments, left, self.segments)
        shared = left[self.told("instance")[left] == SHARED]
        if not len(shared):
            return
        meet, room = self.told("n_meeting")[shared], self.segments.meeting.shape[1]
        if meet.max() > room:
            again, segments = shared[meet > room], self.here()
            wider = np.empty((len(segments.end), meet.max()), np.int64)
            wider[:, :room] = segments.meeting
            segments.end[again] = segments.alone_from[again]
            self.segments = self.loops.on_device(segments._replace(meeting=wider))
            self.segment_loops.next_segments(*arguments, again, self.segments)

    def parts(self, shared: np.ndarray) -> list[np.ndarray]:
        """Rays (M,) whose segments are shared in runs of about SLOTS_AT_ONCE slots."""
        if not len(shared):
            return []
        slots = np.cumsum(self.told("n_meeting")[shared])
        return np.split(shared, np.flatnonzero(np.diff(slots // SLOTS_AT_ONCE)) + 1)

    def show_shared(self, shared: np.ndarray) -> None:
        """The shared segments of rays (M,)."""
        wave, counts, place = self.segments, self.told("n_meeting")[shared], self.loops.on_device
        start = np.concatenate([[0], np.cumsum(counts)])
        there = np.arange(wave.meeting.shape[1]) < counts[:, None]
        instance = self.told("meeting")[shared][there]
        slots = np.arange(start[-1]), place(np.repeat(shared, counts)), place(instance)
        few = start[-1] <= SLOTS_AT_ONCE
        traces = self.scene.traces if few else place(room_for_traces(start[-1]))
        ends, groups = (wave.begin, wave.end), self.scene.rules(instance)
        merged = self.early_stop, groups, traces, wave.end, self.out
        self.each("trace_ray", *slots, ends, traces)
        self.segment_loops.merge_samples(shared, start, *merged)
        self.add_samples(shared, start, slots, ends, traces)

    def add_samples(
        self, shared: np.ndarray, start: np.ndarray, slots: tuple, ends: tuple, traces: Traces
    ) -> None:
        """Add what the samples of rays shared (M,) show, by the weights that they were given."""
        self.each("shade_ray", *slots, ends, traces)
        self.segment_loops.add_colours(shared, start, traces, self.out)

    def each(self, item: str, chosen: np.ndarray, ray: object, instance: object, ends: tuple, out: object):
        """An item of work for slots chosen (M,), of ray (S,) and instance (S,), by the loops of each field;
        returns the slots (K,) that are SHARED. ends: from and to which distances (N,)."""
        scene, order = self.scene, np.empty_like(chosen)
        stops = np.empty(len(scene.fields) + 1, np.int64)
        sort_slots(chosen, self.loops.on_host(instance), scene.field_of, stops, order)
        placed = scene.placed_instances
        for b in np.flatnonzero(np.diff(stops)):
            part = order[stops[b] : stops[b + 1]]
            slots = Slots(
                *self.rays, part, ray, instance, *ends, placed.world_to_instance, placed.shown,
                placed.first_crop, placed.crops, float(self.steps[b]), float(self.early_stop), self.out,
            )  # fmt: skip
            scene.fields[b].each(item, slots, len(part), out, RAYS_PER_TASK)
        return order[: stops[0]]


def room_for_traces(slots: int) -> Traces:
    """Room for the samples of so many slots."""
    count, cursor = np.empty((2, slots), np.int64)
    reals, cell = np.empty((5, slots, MAX_TRACED)), np.empty((slots, MAX_TRACED), np.int64)
    return Traces(count, np.empty(slots), *reals, cell, cursor, np.empty((slots, 3)))


def crop_rows(placed: Placed) -> list[np.ndarray]:
    """(13,) of each crop of an instance: see kernels/instances.py."""
    return [
        np.append((crop.to_unit @ placed.world_to_object)[:3].ravel(), crop.is_ball)
        for crop in placed.crops.items
    ]


def sphere_around(placed: Placed, field: RadianceField) -> np.ndarray:
    """(4,) centre and radius of a sphere around the occupied cells that are shown of a placed field, without
    end where it is unbounded."""
    if placed.unbounded:
        return np.array([0, 0, 0, FARTHEST])
    grid, matrix = field.occupancy, placed.object_to_world
    corners = box_corners(placed.occupancy.look_at_box if placed.crops else grid.tight_aabb(0))
    middle = corners.mean(0) @ matrix[:3, :3].T + matrix[:3, 3]
    radius = np.linalg.norm((corners - corners.mean(0)) @ matrix[:3, :3].T, axis=1).max()
    return np.array([*middle, radius * (1 + 1e-6)])  # by a rounding
