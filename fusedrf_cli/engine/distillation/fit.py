"""Fit a field of any kind to posed pictures: rays in random order, coarse to fine, samples only where the
occupancy grid is set."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy
from dataclasses import dataclass

import numpy as np
import torch

from fusedrf_cli.engine.distillation.exposure import (
    MEASURED_AT,
    matched,
    measured,
    rays_of_each,
    undone,
)
from fusedrf_cli.engine.distillation.guard import Guard
from fusedrf_cli.engine.distillation.keypoints import DEPTH_WEIGHT, KeyPoints, Known
from fusedrf_cli.engine.distillation.matter import RAYS_THAT_JUDGE, occupancy_of, without_haze
from fusedrf_cli.engine.distillation.optimiser import BETA1, Adam, alike
from fusedrf_cli.engine.distillation.pixels import Pictures, RayPool
from fusedrf_cli.engine.distillation.poses import (
    RAYS_OF_ALL,
    RAYS_OF_ONE,
    REFINED_AT,
    TRIED_BY,
    Poses,
    changed,
    refined,
)
from fusedrf_cli.engine.distillation.smoothness import STRIPS, WEIGHT, add_roughness
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.computed import AS_IT_IS, NONE_KNOWN, Batch
from fusedrf_cli.engine.fields.occupancy import DEFAULT_CELLS, OccupancyGrid, cell_counts, texels
from fusedrf_cli.engine.kernels import working_time
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.student import LEAST_TEXELS, Way
from fusedrf_cli.engine.rendering.cameras import Camera

RATE = 0.02
# Adam's β1 in unbounded space. A step meets few of a place's numbers, and where a number was last moved to is
# out of date by then: with TensoRF's 0.9 a park shows 0.2 dB less after as many steps, ferns 0.4, a room 0.6.
# Without it a step takes less time and memory, too. Objects end the same, but bear a wrong rate less well.
UNBOUNDED_MOMENTUM = 0.0
# The last step's share of the rate, and the share of the run after which it falls: until then large steps
# learn most, at the end what single rays say of a texel evens out. A rate that falls from the first step on
# shows 0.7 dB less of a chair after 4,000 steps, and 0.25 dB less of a park after three minutes.
FALL, FALLS_FROM = 0.1, 0.7
EARLY_STOP = 1e-3  # transmittance at which a ray ends
# The same in unbounded space. Behind what rays meet first there is more to sample there than in a box; by as
# many samples of other rays a park of 1,600 steps shows 0.17 dB more held out, ferns 0.09, and no place less.
UNBOUNDED_EARLY_STOP = 1e-2
# Weight under which a sample's gradient is followed back by chance (loops.py, `followed`), once there is more
# than fog. A pass over a place takes three quarters of the time and half as many numbers change: a park shows
# 0.15 dB more in the time; with 1/5 it loses as much.
LIGHT = 1 / 25
SETTLED = 0.25  # share of the run after which a scene has taken shape
EARLY_NEAR = 5.0  # times the near distance of such a scene, at first
DISTORTION = 0.012  # weight of that loss in unbounded space; in a box surfaces come out sharp without it
WEIGHED_RAYS = 1 << 17  # by which it is found what photos show
# Steps after which a field shows where things are. What is cut off before is lost: of a chair whose cells
# were looked for after 30 steps a corner was missing in every third run, and 0.9 dB in all.
STEPS_TO_SHOW = 100
# Weight on a ray from which a cell of unbounded space counts as shown. With 0.01 there are fewer cells to
# sample: the park gains 0.1 dB, the cup 0.05, but the fox's room loses 0.3.
SHOWN_FROM = 0.005
HAZE_LEFT_FROM = 0.5  # share of the run from which no more matter is to come into cells of haze
# (share of the run, share of final voxels per axis)
RESOLUTION_STAGES = ((0.0, 0.22), (0.05, 0.36), (0.12, 0.5), (0.22, 0.7), (0.36, 1.0))
# The same in unbounded space. Photos of a place say little of how far away things are, and fine voxels would
# explain each photo by itself: a start at a twentieth of the texels, not at a fifth, gained 3 dB held out.
UNBOUNDED_STAGES = ((0.0, 0.05), (0.06, 0.1), (0.12, 0.2), (0.2, 0.4), (0.35, 0.7), (0.5, 1.0))
# The same of a place with a hashed detail, which only learns beside fine texels: in 0.7 of those times. After
# ten minutes a park shows 0.11 dB more by it; in half of them, 0.08.
DETAIL_STAGES = ((0.0, 0.05), (0.04, 0.1), (0.08, 0.2), (0.14, 0.4), (0.25, 0.7), (0.35, 1.0))
UNBOUNDED_SAMPLES = 2.5  # times those of a step in a box, for longer rays; with twice that a fox shows less
# Times as many in a box at full resolution: what a step evens out counts for more then, and looking through
# all gradients, which any step does, takes two fifths of the time of small ones. A place learns less by it.
FINE_SAMPLES = 2
# shares of the run after which the occupancy is built anew
OCCUPANCY_AT = (0.03, 0.06, 0.13, 0.24, 0.38, 0.6)
# Steps of an optimiser that begins anew, whose first move every number by the whole rate, before what the
# numbers say of empty cells is believed: of a ball half was cut off three steps after a change of resolution.
CALM_AFTER = 8
RETRY_AFTER = 0.03  # share of the run after which an occupancy that found nothing is tried again
# What a step takes away of numbers that fade, at the first rate: this over the square of the photos' pixels
# for each such number, and at most so much. Few photos do not say enough of a hashed detail, which learns by
# heart then: a fox's 43 photos (0.44 pixels for each number) were shown 3.2 dB better than photos held out,
# and 2.5 to 3.0 dB with it, which lost nothing. Of a park's 84 larger ones (1.75) 0.23 dB would be lost by as
# much.
FADE, MOST_FADED = 1.4e-4, 9e-4
FADED_EACH = 16  # steps, each for all of them: going through the numbers takes as long as a small step
TARGET_MARGIN = 1.0  # dB that training rays are ahead of unseen views, about
# Rays of a step: at least so many, and at most so many for each sample it is to take. Where few meet anything
# there would be ever more of them.
LEAST_RAYS, MOST_PER_SAMPLE = 512, 2
# Share of the box's volume that its occupied part must fall under for the box to be cut down: haze that was
# over the chair for a third of a run made a box a sixth too long, and with it all texels.
SHRINK_BELOW = 0.9


@dataclass(frozen=True)
class FitSettings:
    """What a fit is asked for."""

    kind: str = registry.DEFAULT
    """Of the field."""
    way: Way = Way()
    """Its ranks and SH degree."""
    longest: int = 256
    """Texels on the longest axis at the end."""
    steps: int = 3000
    samples: int = 1 << 16
    """Samples per step that the number of rays is steered to."""
    time_budget: float | None = None
    """Seconds; when given, the schedule follows the clock and `steps` is not used."""
    opacity_weight: float = 0.1
    """Weight of the captured alpha against the colour; 0 for opaque photos."""
    near: float = 0.0
    """Distance from a camera, in units of the field's frame, before which nothing is learnt."""
    unbounded: bool = False
    """Whether the field fills all of space, seen in pictures without alpha."""
    exposure: bool = False
    """Whether pictures may differ in exposure and white balance, as a camera's own do. Not for views of an
    object from all around: of a side that few of them see nothing tells how bright it is."""
    smooth: bool = False
    """Whether planes are kept smooth (smoothness.py): photos of the real world contradict each other by more
    than a field of theirs should follow; rendered pictures do not, and lose by it."""
    poses: bool = False
    """Whether to look for where the pictures were taken from, near where they are said to have been."""
    target_psnr: float | None = None
    """dB of the training rays, less a margin, at which the fit may stop early."""
    seed: int = 0
    device: str = "cpu"
    """Where the field is trained, "cpu" or "cuda"."""

    @property
    def stages(self) -> tuple[tuple[float, float], ...]:
        """(share of the run, share of the final voxels per axis from then on)."""
        if self.way.hashed:
            return DETAIL_STAGES
        return UNBOUNDED_STAGES if self.unbounded else RESOLUTION_STAGES


def fit(
    cameras: list[Camera],
    images: np.ndarray | Pictures,
    aabb: np.ndarray,
    settings: FitSettings,
    advance: Callable[[float, dict], None] = lambda share, figures: None,
    name: str = "",
) -> StoredField:
    """Train a field on pictures (n, H, W, 4) uint8 with straight alpha, or of several sizes, inside a box
    (6,).

    `advance(share, figures)` is told of progress in [0, 1]. The clock decides nothing unless a time budget is
    given, so that the same seed and number of threads gives the same numbers.
    """
    return FitRun.start(cameras, images, aabb, settings, name).finish(advance)


class FitRun:
    """The moving parts of one fit, which can be saved between two steps and taken up again."""

    def __init__(
        self,
        field: StoredField,
        pool: RayPool,
        settings: FitSettings,
        generator: torch.Generator,
        limits: OccupancyGrid | None = None,
        known: KeyPoints | None = None,
    ):
        """limits: cells over the field's box that alone may hold matter, where something besides the pictures
        says so: wherever no ray tells that there is nothing, cells found anew would grow by one each time."""
        self.limits = limits
        self.field, self.pool, self.settings, self.generator = field, pool, settings, generator
        self.keypoints = known
        self.optimiser = self.fresh_optimiser()
        self.started, self.steps = working_time(), 0
        self.stages, self.refreshes = list(settings.stages[1:]), [*OCCUPANCY_AT, 1.0]
        self.maps: np.ndarray | None = None
        """(n, 3, 3) what each picture makes of the field's colours (exposure.py); None: nothing."""
        if settings.exposure:
            self.maps = matched(self.sampled()[1], pool.poses)
        self.exposures = list(MEASURED_AT) if settings.exposure else []
        self.refinements = list(REFINED_AT) if settings.poses else []
        self.mse, self.rays = None, LEAST_RAYS
        self.found_matter, self.found_nothing = False, 0
        self.held: tuple[dict[str, np.ndarray], dict] | None = None
        """What `checkpoint` said before the refresh that is going on, which may take long and changes no
        array."""
        self.guard = Guard(lambda: self.optimiser.numbers())

    @classmethod
    def start(
        cls,
        cameras: list[Camera],
        images: np.ndarray | Pictures,
        aabb: np.ndarray,
        settings: FitSettings,
        name: str = "",
        limits: OccupancyGrid | None = None,
        known: Known | None = None,
    ) -> "FitRun":
        """A fit before its first step; the arguments are those of `fit` and of FitRun, and which points its
        pictures are known to show."""
        generator = torch.Generator().manual_seed(settings.seed)
        pool = RayPool(cameras, images, generator)
        coarse = max(LEAST_TEXELS, round(settings.longest * settings.stages[0][1]))
        kind = registry.kind(settings.kind)
        field = kind.create(kind.untrained(aabb, coarse, settings.way), generator, name).to(settings.device)
        if limits is not None:
            field = field.with_occupancy(limits)
        ignored = None if pool.ignored is None else pool.ignored.numpy()
        shown = None if known is None else KeyPoints(cameras, known, ignored, generator)
        return cls(field, pool, settings, generator, limits, shown)

    def finish(
        self,
        advance: Callable[[float, dict], None] = lambda share, figures: None,
        uninterrupted: Callable[[], AbstractContextManager] = nullcontext,
    ) -> StoredField:
        """Run to the end, or to the target PSNR of the training rays where there is one. Every step happens
        inside an `uninterrupted()`, which may hold an interrupt back. Raises FloatingPointError on
        divergence."""
        while (share := self.share()) < 1.0 and not self.reached():
            with uninterrupted():
                if self.due(share):
                    self.held = deepcopied(*self.checkpoint())
                    self.refresh(share)
                    self.held = None
                self.step(share)
            if self.steps % 20 == 0:
                advance(share, {"psnr": self.psnr})
        with uninterrupted():
            if self.refreshes:  # not where the run was interrupted after it
                self.held = deepcopied(*self.checkpoint())
                self.refreshes.clear()
                self.guard.check()
                self.refresh_occupancy()
        self.held = None
        return self.field

    def reached(self) -> bool:
        """Whether the training rays show the asked PSNR at full resolution, by a margin for unseen views."""
        target = self.settings.target_psnr
        return target is not None and not self.stages and self.psnr > target + TARGET_MARGIN

    def fresh_optimiser(self) -> Adam:
        """An optimiser of the field as it is now."""
        return Adam.of(self.field, UNBOUNDED_MOMENTUM if self.settings.unbounded else BETA1)

    def forget(self) -> None:
        """Let go of what only another step would need, several times the field's numbers."""
        self.optimiser = None
        self.guard.renew()

    def checkpoint(self) -> tuple[dict[str, np.ndarray], dict]:
        """Arrays and JSON-able state from which `restore` goes on as if nothing had happened."""
        arrays, metadata = self.field.state()
        arrays = {f"field.{name}": np.asarray(value) for name, value in arrays.items()}
        arrays |= self.optimiser.state()
        arrays |= {
            "random": self.generator.get_state().numpy(),
            "rotation": self.pool.rotation.numpy(),
            "position": self.pool.position.numpy(),
        }
        if self.maps is not None:
            arrays["exposure"] = self.maps
        order, drawn = self.pool.epochs.state()
        arrays |= order
        if self.keypoints is not None:
            order, drawn_points = self.keypoints.epochs.state()
            arrays |= {f"keypoints.{name}": keys for name, keys in order.items()}
        state = {
            "command": "train",
            "kind": self.field.kind,
            "field": metadata,
            "steps": self.steps,
            "elapsed": working_time() - self.started,
            "adam_steps": self.optimiser.steps,
            "stages": len(self.stages),
            "refreshes": self.refreshes,
            "exposures": self.exposures,
            "refinements": self.refinements,
            "found": [self.found_matter, self.found_nothing],
            "mse": self.mse,
            "rays": self.rays,
            "guard": self.guard.state(),
            **drawn,
            "keypoints": None if self.keypoints is None else drawn_points,
        }
        return arrays, state

    def restore(self, arrays: dict[str, np.ndarray], state: dict) -> None:
        """Take up a run that `checkpoint` saved, over the same pictures and settings. Raises ValueError,
        KeyError, TypeError or RuntimeError for what is none."""
        self.field = type(self.field).from_state(part_of(arrays, "field."), state["field"])
        self.field = self.field.to(self.settings.device)
        self.optimiser = self.fresh_optimiser()
        self.optimiser.restore(arrays, state["adam_steps"])
        self.steps = state["steps"]
        self.stages = self.stages[len(self.stages) - state["stages"] :]
        self.refreshes, self.exposures, self.refinements = (
            [float(share) for share in state[name]] for name in ("refreshes", "exposures", "refinements")
        )
        if (self.maps is None) != ("exposure" not in arrays):
            raise ValueError("exposure is learnt in one of both runs")
        if self.maps is not None:
            self.maps = alike(arrays["exposure"], self.maps, "exposure")
        own = {"rotation": self.pool.rotation, "position": self.pool.position}
        self.pool.place(Poses(*(alike(arrays[name], part, name) for name, part in own.items())))
        self.found_matter, self.found_nothing = state["found"]
        self.mse, self.rays = state["mse"], state["rays"]
        self.started = working_time() - max(state["elapsed"], 0)
        self.guard.restore(state["guard"])
        self.pool.epochs.restore(arrays, state)
        if self.keypoints is not None:
            self.keypoints.epochs.restore(part_of(arrays, "keypoints."), state["keypoints"])
        self.generator.set_state(torch.from_numpy(arrays["random"]))

    @property
    def psnr(self) -> float:
        """Running PSNR of the training rays, dB."""
        return float(-10 * np.log10(max(self.mse or 1.0, 1e-10)))

    @property
    def faded(self) -> float:
        """The share of the numbers that fade which a step at the first rate takes away."""
        fading = sum(group.high - group.low for group in self.field.groups() if group.fades)
        return min(MOST_FADED, FADE * (fading / self.pool.epochs.count) ** 2)

    def share(self) -> float:
        """How much of the run is done, in [0, 1]."""
        if self.settings.time_budget is not None:
            return (working_time() - self.started) / self.settings.time_budget
        return self.steps / self.settings.steps

    def shows(self) -> bool:
        """Whether the field shows where things are."""
        return self.steps >= STEPS_TO_SHOW and self.optimiser.steps >= CALM_AFTER

    def due(self, share: float) -> bool:
        """Whether `refresh` has anything to do."""
        refreshes = self.refreshes if self.shows() else []
        at = [*refreshes[:1], *(at for at, _ in self.stages[:1]), *self.exposures[:1], *self.refinements[:1]]
        return any(share >= due for due in at)

    def refresh(self, share: float) -> None:
        """Occupancy, box and resolution changes that are due."""
        if self.shows() and self.refreshes and share >= self.refreshes[0]:
            self.refreshes = [at for at in self.refreshes if at > share]
            self.guard.check()
            self.refresh_occupancy()
        if self.stages and share >= self.stages[0][0]:
            _, part = self.stages.pop(0)
            self.guard.check()
            self.resize(self.field.aabb, round(self.settings.longest * part))
        if self.exposures and share >= self.exposures[0]:
            self.exposures.pop(0)
            rays, colours = self.sampled()
            self.maps = measured(self.field, rays, colours, self.settings.near, self.maps)
        if self.refinements and share >= self.refinements[0]:
            self.refinements.pop(0)
            if self.found_matter:
                self.refine_poses(share)

    def refine_poses(self, share: float) -> None:
        """Move each picture's camera to where the field shows it better."""
        pool = self.pool
        most = int(np.clip(RAYS_OF_ALL // len(pool.pixel), *RAYS_OF_ONE))
        *rays, colours = pool.sample(most, self.generator)
        first, last = TRIED_BY
        pixels = max(last, first * (last / first) ** (2 * share))
        colours = colours if self.maps is None else undone(self.maps, colours)
        change = refined(self.field, rays, colours, self.settings.near, pixels * pool.pixel)
        pool.place(changed(pool.poses, change))

    def sampled(self) -> tuple[list[np.ndarray], torch.Tensor]:
        """Rays and colours of each picture from which its exposure is found. They are drawn apart, so that
        looking changes nothing."""
        apart = torch.Generator().manual_seed(self.steps)
        *rays, colours = self.pool.sample(rays_of_each(len(self.pool.pixel)), apart)
        return rays, colours

    def refresh_occupancy(self) -> None:
        """Mark the cells that hold matter, and cut the box down to them where that saves much; late in a run
        haze that no picture shows is left out. Where none does, nothing changes, and it is tried again
        later."""
        occupancy = self.shown_cells() if self.settings.unbounded else occupancy_of(self.field)
        if not occupancy.occupied.any():
            self.found_nothing += 1
            retry = self.share() + RETRY_AFTER
            if self.refreshes and self.refreshes[0] > retry:
                self.refreshes.insert(0, retry)
            return
        self.found_matter = True
        self.occupy(occupancy)
        tight = occupancy.tight_aabb()
        if not self.settings.unbounded and volume(tight) < SHRINK_BELOW * volume(occupancy.aabb):
            before = self.field
            self.resize(tight, max(self.field.resolution))
            occupancy = occupancy_of(self.field, tight)
            if not occupancy.occupied.any():  # what there was lies between the new texels
                self.field = before
                self.optimiser = self.fresh_optimiser()
                return
            self.occupy(occupancy)
        if self.share() >= HAZE_LEFT_FROM or not self.refreshes:
            rays_o, rays_d, *_ = self.pool.draw(RAYS_THAT_JUDGE)
            self.occupy(without_haze(self.field, rays_o, rays_d, self.settings.near))

    def shown_cells(self) -> OccupancyGrid:
        """Cells of which some training ray shows anything, grown by one: haze that no photo shows, and what
        lies behind surfaces, is no matter."""
        field = self.field
        grid = field.occupancy
        counts = cell_counts(grid.aabb, min(DEFAULT_CELLS, max(field.resolution)))
        if grid.occupied.shape != counts:  # as fine as those to be found, with the same cells occupied
            middles = OccupancyGrid.full(grid.aabb, max(counts)).centres()
            field = field.with_occupancy(grid.marked(grid.contains(middles).reshape(counts)))
            grid = field.occupancy  # bricks have counts of their own
        rays_o, rays_d, *_ = self.pool.draw(WEIGHED_RAYS)
        jitter = torch.rand(len(rays_o), generator=self.generator, dtype=torch.float64).numpy()
        weights = field.weights_in_cells(rays_o, rays_d, jitter, self.settings.near, field.voxel_size)
        return grid.marked(grid.marked(weights > SHOWN_FROM).dilated().occupied & grid.occupied)

    def occupy(self, occupancy: OccupancyGrid) -> None:
        """Another occupancy grid, within the limits; the optimiser starts anew where the field has fewer
        numbers then."""
        if self.limits is not None:
            occupancy = occupancy.limited(self.limits)
        self.field = self.field.with_occupancy(occupancy)
        if len(self.field.params) == len(self.optimiser.field.params):
            self.optimiser.field = self.field
        else:
            self.optimiser = self.fresh_optimiser()
            self.guard.renew()

    def resize(self, aabb: np.ndarray, longest: int) -> None:
        """Another box or resolution; the optimiser starts anew, since its moments belong to other texels."""
        self.field = self.field.resampled(aabb, texels(aabb, longest))
        self.optimiser = self.fresh_optimiser()
        self.guard.renew()

    def step(self, share: float) -> None:
        """One batch of rays and one optimiser step."""
        settings, field = self.settings, self.field
        self.guard.keep()
        rays_o, rays_d, pixels, pictures, depths = self.draw(share)
        jitter = torch.rand(len(rays_o), generator=self.generator, dtype=torch.float64).numpy()
        background = np.ones((len(rays_o), 3), np.float32)
        if settings.unbounded:  # haze before any one colour would be wrong before the others
            background = torch.rand(len(rays_o), 3, generator=self.generator).numpy()
        target, behind, exposure = pixels.clone(), background, AS_IT_IS
        if self.maps is not None:
            exposure = self.maps[pictures]
            behind = (exposure[:, 0] * background + exposure[:, 1]).astype(np.float32)
        target[:, :3] = pixels[:, :3] * pixels[:, 3:] + torch.from_numpy(behind) * (1 - pixels[:, 3:])
        batch = Batch(
            rays_o,
            rays_d,
            jitter,
            target.numpy(),
            background,
            settings.opacity_weight,
            self.near(share),
            field.voxel_size,  # jittered; twice the rays of the step of pictures in the time: 0.2 dB
            UNBOUNDED_EARLY_STOP if settings.unbounded else EARLY_STOP,
            min(1.0, share / SETTLED) * DISTORTION if settings.unbounded else 0.0,
            LIGHT if share > SETTLED else 0.0,
            DEPTH_WEIGHT,
            depths,
            exposure,
        )
        loss = np.zeros((self.optimiser.parts, 3))
        field.train_rays(batch, self.optimiser.grads, loss)
        sums = loss.sum(0)
        if self.guard.accepts(sums, self.optimiser):
            self.learn(sums, len(rays_o), decay(share) * self.guard.rate, len(depths))
        self.steps += 1

    def draw(self, share: float) -> tuple[np.ndarray, np.ndarray, torch.Tensor, np.ndarray, np.ndarray]:
        """Rays of a step with their pixels and pictures, as RayPool.draw gives them, and the depths (m,) of
        the first m, which are known."""
        wanted = 0 if self.keypoints is None else self.keypoints.wanted(self.rays, share)
        if not wanted:
            return *self.pool.draw(self.rays), NONE_KNOWN
        chosen, points = self.keypoints.draw(wanted)
        known, others = self.pool.of(chosen), self.pool.draw(self.rays - len(chosen))
        depths = np.linalg.norm(points - known[0], axis=1)
        rays_o, rays_d, pictures = (np.concatenate([known[k], others[k]]) for k in (0, 1, 3))
        return rays_o, rays_d, torch.cat([known[2], others[2]]), pictures, depths

    def near(self, share: float) -> float:
        """The distance from a camera before which nothing is learnt, which shrinks while the scene takes
        shape: the cheapest explanation of a photo is fog right before its camera."""
        settings = self.settings
        early = max(0.0, 1 - share / SETTLED) if settings.unbounded else 0.0
        return settings.near * (1 + (EARLY_NEAR - 1) * early)

    def learn(self, sums: np.ndarray, rays: int, decay: float, known: int = 0) -> None:
        """Apply the gradient of a batch of so many rays, at `decay` times the first rate, and steer the size
        of the next. Of `known` of them depths are known, and their colour errors are not in the sums."""
        if self.settings.smooth:
            strip = int(torch.randint(STRIPS, (), generator=self.generator))
            add_roughness(self.field, self.optimiser.gradient[0], WEIGHT * rays, strip)
        if self.steps % FADED_EACH == 0:
            self.optimiser.fade(FADED_EACH * decay * self.faded)
        self.optimiser.step(RATE * decay)
        mse = sums[0] / (rays - known)
        self.mse = mse if self.mse is None else 0.98 * self.mse + 0.02 * mse
        per_ray = max(sums[2] / rays, 1.0)
        in_a_box = 1 if self.stages else FINE_SAMPLES
        wanted = self.settings.samples * (UNBOUNDED_SAMPLES if self.settings.unbounded else in_a_box)
        most = MOST_PER_SAMPLE * self.settings.samples
        self.rays = int(np.clip(0.9 * self.rays + 0.1 * wanted / per_ray, LEAST_RAYS, most))


def decay(share: float) -> float:
    """The rate after a share of the run, as a share of the first."""
    return FALL ** (max(0.0, share - FALLS_FROM) / (1 - FALLS_FROM))


def deepcopied(arrays: dict[str, np.ndarray], state: dict) -> tuple[dict[str, np.ndarray], dict]:
    """A checkpoint whose state goes its own way."""
    return arrays, deepcopy(state)


def part_of(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}


def volume(aabb: np.ndarray) -> float:
    """Volume of a box (6,)."""
    return float(np.prod(aabb[3:] - aabb[:3]))
