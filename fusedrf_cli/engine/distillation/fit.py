"""Fit a field of any kind to posed pictures: rays in random order, coarse to fine, samples only where the
occupancy grid is set."""

from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from copy import deepcopy

import numpy as np
import torch

from fusedrf_cli.engine.distillation.config import TrainConfig
from fusedrf_cli.engine.distillation.depth_points import DepthConfig, DepthPoints, KnownPoints
from fusedrf_cli.engine.distillation.exposure import (
    ExposureConfig,
    matched,
    measured,
    rays_of_each,
    undone,
)
from fusedrf_cli.engine.distillation.nan_guard import NanGuard
from fusedrf_cli.engine.distillation.occupancy_update import (
    OccupancyUpdateConfig,
    occupancy_of,
    prune_low_density,
)
from fusedrf_cli.engine.distillation.optimiser import Adam, alike
from fusedrf_cli.engine.distillation.poses import (
    PoseConfig,
    Poses,
    changed,
    refined,
)
from fusedrf_cli.engine.distillation.ray_dataset import Pictures, RayDataset
from fusedrf_cli.engine.distillation.tv_loss import TVLossConfig, add_tv_gradient
from fusedrf_cli.engine.fields.base import StoredField
from fusedrf_cli.engine.fields.computed import AS_IT_IS, NONE_KNOWN, Batch
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, OccupancyGrid, cell_counts, texels
from fusedrf_cli.engine.kernels import working_time
from fusedrf_cli.engine.kinds import registry
from fusedrf_cli.engine.kinds.builder import BuilderConfig
from fusedrf_cli.engine.rendering.cameras import Camera
from fusedrf_cli.engine.settings import current


def fit(
    cameras: list[Camera],
    images: np.ndarray | Pictures,
    aabb: np.ndarray,
    config: TrainConfig,
    advance: Callable[[float, dict], None] = lambda share, figures: None,
    name: str = "",
) -> StoredField:
    """Train a field on pictures (n, H, W, 4) uint8 with straight alpha, or of several sizes, inside a box
    (6,).

    `advance(share, figures)` is told of progress in [0, 1]. The clock decides nothing unless a time budget is
    given, so that the same seed and number of threads gives the same numbers.
    """
    return FitRun.start(cameras, images, aabb, config, name).finish(advance)


class FitRun:
    """The moving parts of one fit, which can be saved between two steps and taken up again."""

    def __init__(
        self,
        field: StoredField,
        dataset: RayDataset,
        config: TrainConfig,
        generator: torch.Generator,
        limits: OccupancyGrid | None = None,
        known: DepthPoints | None = None,
    ):
        """limits: cells over the field's box that alone may are occupied, where something besides the
        pictures says so: wherever no ray tells that there is nothing, cells found anew would grow by one each
        time."""
        self.limits = limits
        self.field, self.pool, self.config, self.generator = field, dataset, config, generator
        self.depth_points = known
        self.optimiser = self.fresh_optimiser()
        self.started, self.steps = working_time(), 0
        self.stages, self.refreshes = list(config.stages[1:]), [*self.config.occupancy_at, 1.0]
        self.maps: np.ndarray | None = None
        """(n, 3, 3) what each picture makes of the field's colours (exposure.py); None: nothing."""
        if config.exposure:
            self.maps = matched(self.sampled()[1], dataset.poses)
        self.exposures = list(current(ExposureConfig).at) if config.exposure else []
        self.refinements = list(current(PoseConfig).at) if config.poses else []
        self.mse, self.rays = None, self.config.least_rays
        self.found_density, self.found_nothing = False, 0
        self.held: tuple[dict[str, np.ndarray], dict] | None = None
        """What `checkpoint` said before the refresh that is going on, which may take long and changes no
        array."""
        self.nan_guard = NanGuard(lambda: self.optimiser.numbers())

    @classmethod
    def start(
        cls,
        cameras: list[Camera],
        images: np.ndarray | Pictures,
        aabb: np.ndarray,
        config: TrainConfig,
        name: str = "",
        limits: OccupancyGrid | None = None,
        known: KnownPoints | None = None,
    ) -> "FitRun":
        """A fit before its first step; the arguments are those of `fit` and of FitRun, and which points its
        pictures are known to show."""
        generator = torch.Generator().manual_seed(config.seed)
        dataset = RayDataset(cameras, images, generator)
        coarse = max(current(BuilderConfig).least_texels, round(config.longest * config.stages[0][1]))
        kind = registry.kind(config.kind)
        field = kind.begun(aabb, config.longest, coarse, config.storage, generator, name).to(config.device)
        if limits is not None:
            field = field.with_occupancy(limits)
        ignored = None if dataset.ignored is None else dataset.ignored.numpy()
        shown = None if known is None else DepthPoints(cameras, known, ignored, generator)
        return cls(field, dataset, config, generator, limits, shown)

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
                self.turn(share)
            if self.steps % 20 == 0:
                advance(share, {"psnr": self.psnr})
        with uninterrupted():
            return self.end()

    def turn(self, share: float) -> None:
        """What is due after that share of the run, and one step."""
        if self.due(share):
            self.held = deepcopied(*self.checkpoint())
            self.refresh(share)
            self.held = None
        self.step(share)

    def end(self) -> StoredField:
        """The field after its last step, its occupancy made anew."""
        if self.refreshes:  # not where the run was interrupted after it
            self.held = deepcopied(*self.checkpoint())
            self.refreshes.clear()
            self.nan_guard.check()
            self.refresh_occupancy()
        self.held = None
        return self.field

    def reached(self) -> bool:
        """Whether the training rays show the asked PSNR at full resolution, by a margin for unseen views."""
        target = self.config.target_psnr
        return target is not None and not self.stages and self.psnr > target + self.config.target_margin

    def fresh_optimiser(self) -> Adam:
        """An optimiser of the field as it is now."""
        return Adam.of(self.field, self.config.unbounded_momentum if self.config.unbounded else None)

    def forget(self) -> None:
        """Let go of what only another step would need, several times the field's numbers."""
        self.optimiser = None
        self.nan_guard.renew()

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
        if any(group.lines is not None for group in self.field.groups()):
            arrays["params"] = self.field.params.cpu().numpy()  # cells may reach what `state` leaves out
        if self.maps is not None:
            arrays["exposure"] = self.maps
        order, drawn = self.pool.shuffle.state()
        arrays |= order
        if self.depth_points is not None:
            order, drawn_points = self.depth_points.shuffle.state()
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
            "found": [self.found_density, self.found_nothing],
            "mse": self.mse,
            "rays": self.rays,
            "guard": self.nan_guard.state(),
            **drawn,
            "keypoints": None if self.depth_points is None else drawn_points,
        }
        return arrays, state

    def restore(self, arrays: dict[str, np.ndarray], state: dict) -> None:
        """Take up a run that `checkpoint` saved, over the same pictures and config. Raises ValueError,
        KeyError, TypeError or RuntimeError for what is none."""
        self.field = type(self.field).from_state(part_of(arrays, "field."), state["field"])
        if "params" in arrays:
            self.field.params.copy_(torch.from_numpy(alike(arrays["params"], self.field.params, "params")))
        self.field = self.field.to(self.config.device)
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
        poses = {"rotation": self.pool.rotation, "position": self.pool.position}
        self.pool.set_poses(Poses(*(alike(arrays[name], part, name) for name, part in poses.items())))
        self.found_density, self.found_nothing = state["found"]
        self.mse, self.rays = state["mse"], state["rays"]
        self.started = working_time() - max(state["elapsed"], 0)
        self.nan_guard.restore(state["guard"])
        self.pool.shuffle.restore(arrays, state)
        if self.depth_points is not None:
            self.depth_points.shuffle.restore(part_of(arrays, "keypoints."), state["keypoints"])
        self.generator.set_state(torch.from_numpy(arrays["random"]))

    @property
    def psnr(self) -> float:
        """Running PSNR of the training rays, dB."""
        return float(-10 * np.log10(max(self.mse or 1.0, 1e-10)))

    @property
    def faded(self) -> float:
        """The share of the numbers that fade which a step at the first rate takes away."""
        fading = sum(group.high - group.low for group in self.field.groups() if group.fades)
        return min(self.config.most_faded, self.config.fade * (fading / self.pool.shuffle.count) ** 2)

    def share(self) -> float:
        """How much of the run is done, in [0, 1]."""
        if self.config.time_budget is not None:
            return (working_time() - self.started) / self.config.time_budget
        return self.steps / self.config.steps

    def shows(self) -> bool:
        """Whether the field shows where things are."""
        return self.steps >= self.config.steps_to_show and self.optimiser.steps >= self.config.calm_after

    def due(self, share: float) -> bool:
        """Whether `refresh` has anything to do."""
        refreshes = self.refreshes if self.shows() else []
        at = [*refreshes[:1], *(at for at, _ in self.stages[:1]), *self.exposures[:1], *self.refinements[:1]]
        return any(share >= due for due in at)

    def refresh(self, share: float) -> None:
        """Occupancy, box and resolution changes that are due."""
        if self.shows() and self.refreshes and share >= self.refreshes[0]:
            self.refreshes = [at for at in self.refreshes if at > share]
            self.nan_guard.check()
            self.refresh_occupancy()
        if self.stages and share >= self.stages[0][0]:
            _, part = self.stages.pop(0)
            self.nan_guard.check()
            self.resize(self.field.aabb, round(self.config.longest * part))
        if self.exposures and share >= self.exposures[0]:
            self.exposures.pop(0)
            rays, colours = self.sampled()
            self.maps = measured(self.field, rays, colours, self.config.near, self.maps)
        if self.refinements and share >= self.refinements[0]:
            self.refinements.pop(0)
            if self.found_density:
                self.refine_poses(share)

    def refine_poses(self, share: float) -> None:
        """Move each picture's camera to where the field shows it better."""
        dataset, how = self.pool, current(PoseConfig)
        most = int(np.clip(how.rays // len(dataset.pixel), *how.rays_of_each))
        *rays, colours = dataset.sample(most, self.generator)
        first, last = how.tried_by
        pixels = max(last, first * (last / first) ** (2 * share))
        colours = colours if self.maps is None else undone(self.maps, colours)
        change = refined(self.field, rays, colours, self.config.near, pixels * dataset.pixel)
        dataset.set_poses(changed(dataset.poses, change))

    def sampled(self) -> tuple[list[np.ndarray], torch.Tensor]:
        """Rays and colours of each picture from which its exposure is found. They are drawn apart, so that
        looking changes nothing."""
        apart = torch.Generator().manual_seed(self.steps)
        *rays, colours = self.pool.sample(rays_of_each(len(self.pool.pixel)), apart)
        return rays, colours

    def refresh_occupancy(self) -> None:
        """Mark the cells that are occupied, and cut the box down to them where that saves much; late in a run
        low density that no picture shows is left out. Where none does, nothing changes, and it is tried again
        later."""
        occupancy = self.shown_cells() if self.config.unbounded else occupancy_of(self.field)
        if not occupancy.occupied.any():
            self.found_nothing += 1
            retry = self.share() + self.config.retry_after
            if self.refreshes and self.refreshes[0] > retry:
                self.refreshes.insert(0, retry)
            return
        self.found_density = True
        self.occupy(occupancy)
        tight = occupancy.tight_aabb()
        bounded = self.field.over_texels and not self.config.unbounded
        if bounded and volume(tight) < self.config.shrink_below * volume(occupancy.aabb):
            before = self.field
            self.resize(tight, max(self.field.resolution))
            occupancy = occupancy_of(self.field, tight)
            if not occupancy.occupied.any():  # what there was lies between the new texels
                self.field = before
                self.optimiser = self.fresh_optimiser()
                return
            self.occupy(occupancy)
        if self.share() >= self.config.prune_low_density_from or not self.refreshes:
            rays_o, rays_d, *_ = self.pool.draw(current(OccupancyUpdateConfig).rays_that_judge)
            if self.refreshes:  # while what is left can make up for it
                self.field = registry.kind(self.config.kind).thinned(self.field)
            self.occupy(prune_low_density(self.field, rays_o, rays_d, self.config.near))

    def shown_cells(self) -> OccupancyGrid:
        """Cells of which some training ray shows anything, grown by one: low density that no photo shows, and
        what lies behind surfaces, is no density."""
        field = self.field
        grid = field.occupancy
        counts = cell_counts(grid.aabb, min(current(OccupancyConfig).cells, max(field.resolution)))
        if grid.occupied.shape != counts:  # as fine as those to be found, with the same cells occupied
            middles = OccupancyGrid.full(grid.aabb, max(counts)).centres()
            field = field.with_occupancy(grid.marked(grid.contains(middles).reshape(counts)))
            grid = field.occupancy  # bricks have counts of their own
        rays_o, rays_d, *_ = self.pool.draw(self.config.weighed_rays)
        jitter = torch.rand(len(rays_o), generator=self.generator, dtype=torch.float64).numpy()
        weights = field.weights_in_cells(rays_o, rays_d, jitter, self.config.near, field.voxel_size)
        return grid.marked(grid.marked(weights > self.config.shown_from).dilated().occupied & grid.occupied)

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
            self.nan_guard.renew()

    def resize(self, aabb: np.ndarray, longest: int) -> None:
        """Another box or resolution; the optimiser starts anew, since its moments belong to other texels."""
        self.field = self.field.resampled(aabb, texels(aabb, longest))
        self.optimiser = self.fresh_optimiser()
        self.nan_guard.renew()

    def step(self, share: float) -> None:
        """One batch of rays and one optimiser step."""
        config, field = self.config, self.field
        self.nan_guard.keep()
        rays_o, rays_d, pixels, pictures, depths = self.draw(share)
        jitter = torch.rand(len(rays_o), generator=self.generator, dtype=torch.float64).numpy()
        background = np.ones((len(rays_o), 3), np.float32)
        if config.unbounded:  # low density before any one colour would be wrong before the others
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
            config.opacity_weight,
            self.near(share),
            field.voxel_size,  # jittered; twice the rays of the step of pictures in the time: 0.2 dB
            config.unbounded_early_stop if config.unbounded else config.early_stop,
            min(1.0, share / config.settled) * config.distortion if config.unbounded else 0.0,
            config.light if share > config.settled else 0.0,
            current(DepthConfig).weight,
            depths,
            exposure,
        )
        sums = self.optimiser.learn_rays(batch)
        if self.nan_guard.accepts(sums, self.optimiser):
            self.learn(sums, len(rays_o), config.decay(share) * self.nan_guard.rate, len(depths))
        self.steps += 1

    def draw(self, share: float) -> tuple[np.ndarray, np.ndarray, torch.Tensor, np.ndarray, np.ndarray]:
        """Rays of a step with their pixels and pictures, as `RayDataset.draw` gives them, and the depths (m,)
        of the first m, which are known."""
        n_depth = 0 if self.depth_points is None else self.depth_points.wanted(self.rays, share)
        if not n_depth:
            return *self.pool.draw(self.rays), NONE_KNOWN
        chosen, points = self.depth_points.draw(n_depth)
        known, others = self.pool.of(chosen), self.pool.draw(self.rays - len(chosen))
        depths = np.linalg.norm(points - known[0], axis=1)
        rays_o, rays_d, pictures = (np.concatenate([known[k], others[k]]) for k in (0, 1, 3))
        return rays_o, rays_d, torch.cat([known[2], others[2]]), pictures, depths

    def near(self, share: float) -> float:
        """The distance from a camera before which nothing is learnt, which shrinks while the scene takes
        shape: what explains a photo most cheaply are floaters right before its camera."""
        config = self.config
        early = max(0.0, 1 - share / self.config.settled) if config.unbounded else 0.0
        return config.near * (1 + (self.config.early_near - 1) * early)

    def learn(self, sums: np.ndarray, rays: int, decay: float, known: int = 0) -> None:
        """Apply the gradient of a batch of so many rays, at `decay` times the first rate, and steer the size
        of the next. Of `known` of them depths are known, and their colour errors are not in the sums."""
        config = current(TVLossConfig)
        if self.config.smooth:
            strip = int(torch.randint(config.strips, (), generator=self.generator))
            add_tv_gradient(self.field, self.optimiser.gradient[0], config.weight * rays, strip)
        if self.steps % self.config.faded_each == 0:
            self.optimiser.fade(self.config.faded_each * decay * self.faded)
        self.optimiser.step(self.config.rate * decay)
        mse = sums[0] / (rays - known)
        self.mse = mse if self.mse is None else 0.98 * self.mse + 0.02 * mse
        per_ray = max(sums[2] / rays, 1.0)
        in_a_box = 1 if self.stages else self.config.fine_samples
        target = self.config.samples * (self.config.unbounded_samples if self.config.unbounded else in_a_box)
        most = self.config.most_per_sample * self.config.samples
        self.rays = int(np.clip(0.9 * self.rays + 0.1 * target / per_ray, self.config.least_rays, most))


def deepcopied(arrays: dict[str, np.ndarray], state: dict) -> tuple[dict[str, np.ndarray], dict]:
    """A checkpoint whose state goes its own way."""
    return arrays, deepcopy(state)


def part_of(arrays: dict[str, np.ndarray], prefix: str) -> dict[str, np.ndarray]:
    """The arrays whose names begin with a prefix, without it."""
    return {name.removeprefix(prefix): value for name, value in arrays.items() if name.startswith(prefix)}


def volume(aabb: np.ndarray) -> float:
    """Volume of a box (6,)."""
    return float(np.prod(aabb[3:] - aabb[:3]))
