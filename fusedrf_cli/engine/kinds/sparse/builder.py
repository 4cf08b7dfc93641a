"""A sparse field as a student: bricks where the scene has density, filled by asking it, and finished on
rays."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from math import prod

import numpy as np
import torch

from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.composition.resolution_report import ResolutionReport, extent, opacity_off
from fusedrf_cli.engine.encodings.bricks import COARSE, ROW, SIDE
from fusedrf_cli.engine.fields.box import DENSITY_SCALE_PER_EXTENT, DENSITY_SHIFT
from fusedrf_cli.engine.kinds import field_cutting
from fusedrf_cli.engine.kinds.builder import (
    BuildRequest,
    Candidate,
    Contents,
    DirectBuilder,
    MemoryEstimate,
    Plan,
    Section,
    StorageSetting,
)
from fusedrf_cli.engine.kinds.distil_config import DistilConfig
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.reduction import Reduction
from fusedrf_cli.engine.kinds.sparse import coarsening
from fusedrf_cli.engine.kinds.sparse.field import SparseField, SparseShape
from fusedrf_cli.engine.kinds.sparse.resample import TooFewNumbers, resampled
from fusedrf_cli.engine.kinds.sparse.training import whole_lattice
from fusedrf_cli.engine.kinds.sparse.visible_cells import visible_only
from fusedrf_cli.engine.kinds.sweeps import Sweep, SweepPoint
from fusedrf_cli.engine.selection.cells import Selection
from fusedrf_cli.engine.settings import current
from fusedrf_cli.engine.spaces import bounded


@dataclass(frozen=True)
class SparseConfig:
    """How large a student of bricks is, and how much it is told."""

    padded: float = 1.6
    """Floats in memory for each number that is stored: rows are padded, hanging vertices too."""
    whole_below: float = 0.8
    """Of the numbers allowed: fewer are taken where no object needs more."""
    per_number_filled: int = 150
    """Bytes, as seen, of vertices while they are sought, before any is left out: keys, positions and indices,
    of two sizes at once. Three objects in 25 MB took 180, five sixths of which is left (decision 034)."""
    bytes_per_brick: int = 10
    """Masks and nodes."""
    degree: int = 1
    """Measured at 5 million numbers: 35.7 dB, where a second degree leaves room for 34.0."""
    degree_in_place: int = 2
    """Places are photographed from few sides, and what they say to others is anything: fitted by a lower
    degree, it changes what photos do show. A park in 50 MB, before rays: 24.2 dB by degree 1, 30.0 by
    2."""
    degrees: tuple[int, ...] = (0, 1, 2)
    tries: int = 3
    """Where a file is larger than was reckoned."""
    smaller: float = 0.97
    """By that factor under what would do."""
    least_bytes: int = 20_000
    """Told where nothing fits: a few hundred vertices and their bricks."""
    held_share: float = 0.2
    """Of the vertices of a box: about what surfaces need."""
    told_by_rays: int = 3_000_000
    """Numbers of a field in memory, for which the lesson's rays do. Four objects in 21 million: 0.3 dB
    lost by it, 0.2 gained by three times the rays, 1.1 by seven times the rays and three times the steps.
    A park in 50 million: a fourth time the steps, and a fuller file, 33.8 to 34.4 dB."""
    told_by_steps: int = 6_000_000
    """The same for its steps."""
    most_rays: int = 7
    """Times those of the lesson."""
    most_steps: int = 4
    most_samples: int = 4
    ladder_bytes: tuple[int, ...] = (1_000_000, 3_000_000, 8_000_000)


class SparseKind(Kind):
    """Bricks of voxels."""

    name = "sparse"
    good_for = "Scenes of any sources and rule, with detail in few places: as much as vm, in more time."
    field = SparseField
    takes = reduces = frozenset({"sh_degree"})
    precisions = ("int8", "float16")
    beside_background = False  # its bricks are as coarse as the background where that is all there is
    faithful = "int8"  # measured: not 0.01 dB less than float16, in half the bytes
    photo_rate = 10.0  # measured: a chair after a minute 33.3 dB; at 1, after half a minute, 14.8

    def sections(self, storage: StorageSetting, resolution: tuple[int, int, int]) -> Sequence[Section]:
        """At most: the rows of all vertices of a box. What is empty is left out once that is known."""
        shape = shape_of(storage)
        fine, coarse = (prod(n * n_bricks + 1 for n_bricks in bricks(resolution)) for n in (SIDE, COARSE))
        rows = [Section("rows", (fine, ROW))]
        return [*rows, Section("bands", (coarse, shape.band_numbers))] if shape.sh_degree else rows

    def numbers(self, storage: StorageSetting, resolution: tuple[int, int, int]) -> int:
        """Floats of a field of surfaces in that box."""
        width = shape_of(storage).band_width * COARSE**3 / SIDE**3
        return int(current(SparseConfig).held_share * (ROW + width) * prod(resolution))

    def create(self, plan: Plan, generator: torch.Generator, name: str = "") -> SparseField:
        """All of the box in bricks of one level, thinly filled."""
        field = SparseField(
            shape_of(plan.storage),
            whole_lattice(plan.box, plan.resolution),
            DENSITY_SCALE_PER_EXTENT / float((plan.box[3:] - plan.box[:3]).mean()),
        )
        field.rows[:, 0] = DENSITY_SHIFT
        return field

    def builder(self, scene: ComposedField, request: BuildRequest) -> "SparseBuilder":
        """Bricks of a scene."""
        return SparseBuilder(self, scene, request)

    def reduction(self, outline: SparseField, voxel: float, storage: StorageSetting) -> Reduction:
        """See Kind and sparse/coarsening.py."""
        degree = outline.shape.sh_degree if storage.sh_degree is None else storage.sh_degree
        return coarsening.reduced(outline, voxel, degree)

    def describe(self, field: SparseField) -> dict:
        """The voxel and the bricks of every level, and how many vertices they have."""
        return {"levels": levels(field), "sh_degree": field.shape.sh_degree, "vertices": field.fine.free}

    def resolution_reports(self, scene: ComposedField, field: SparseField) -> list[ResolutionReport]:
        """What bricks hold of placed objects."""
        return [
            ResolutionReport(p.name, p.condition, opacity_off(p.condition), p.voxel_size, v, extent(p) / v)
            for p, v in zip(scene.leaves(), held_voxels(scene, field), strict=True)
        ]

    def sweeps(self, least_psnr: float) -> dict[str, list[Sweep]]:
        """One ladder."""
        return {self.name: [bricks_sweep()]}

    def cut_out(self, field: SparseField, selection: Selection) -> SparseField | None:
        """The voxels that cells of the object reach into."""
        return field.reaching(lambda at: selection.object.contains(selection.lattice_points(at, field.space)))

    def cut_away(self, field: SparseField, selection: Selection) -> SparseField | None:
        """The voxels that any other cell reaches into."""
        return field_cutting.cut_away(field, selection)

    def cropped(self, field: SparseField, holds: field_cutting.Holds) -> SparseField | None:
        """The voxels that lie there wholly."""
        return field.with_voxels(lambda corners: holds(field_cutting.to_frame(corners, field.space)))

    def restricted(self, field: SparseField, holds: field_cutting.Holds) -> SparseField | None:
        """A voxel is kept or not."""
        return self.cropped(field, holds)


class SparseBuilder(DirectBuilder):
    """Bricks about as fine as each object of a scene needs, all wider by one factor under a limit."""

    # what was asked needs no learning from points
    distil_config = DistilConfig(rays=150_000, steps=0, rgb_steps=400, rgb_rate=0.015)
    compares = False

    def distil_config_for(self, numbers: int, seconds: float | None = None) -> DistilConfig:
        """See `DistilledBuilder`: the more numbers, the more rays, steps and samples."""
        config = current(SparseConfig)
        distil_config, told = self.distil_config, (config.told_by_rays, config.told_by_steps)
        rays, more = (max(1.0, numbers / n) for n in told)
        return replace(
            distil_config,
            rays=round(distil_config.rays * min(rays, config.most_rays)),
            rgb_steps=round(distil_config.rgb_steps * min(more, config.most_steps)),
            rgb_samples=round(distil_config.rgb_samples * min(more, config.most_samples)),
            time_budget=seconds,
        )

    @cached_property
    def seen(self) -> ComposedField:
        """The scene without what no view of its place shows."""
        return visible_only(self.scene, self.request.views)

    def storage_settings(self) -> list[list[StorageSetting]]:
        """By precision, and degrees of the colour."""
        request = self.request
        precisions = (request.precision,) if request.precision else self.kind.precisions
        degrees = current(SparseConfig).degrees if request.sh_degree is None else (request.sh_degree,)
        return [[StorageSetting(p, None, degree) for degree in degrees] for p in precisions]

    def plain(self) -> StorageSetting:
        """The degree that was measured to be worth its bytes, of an unbounded scene that of its sources."""
        config = current(SparseConfig)
        request, in_place = self.request, self.scene.occupancy.space is not bounded
        usual = config.degree_in_place if in_place else config.degree
        degree = usual if request.sh_degree is None else request.sh_degree
        return StorageSetting(request.precision or self.kind.faithful, None, degree)

    def build(self, storage: StorageSetting, limit: int) -> Candidate | None:
        """Bricks filled by asking the scene."""
        config = current(SparseConfig)
        numbers = self.numbers_within(limit, storage.precision)
        per_brick = config.bytes_per_brick / self.request.sizes.per_number(storage.precision)
        for _ in range(config.tries):
            if numbers < 1:
                return None
            try:
                field = resampled(self.seen, SparseShape(storage.sh_degree), numbers, per_brick)
            except TooFewNumbers:
                return None
            size, bricks = self.bytes_of(field, storage), len(field.tree.level)
            if size <= limit:
                return Candidate(
                    field, size, field.numbers + per_brick * bricks < config.whole_below * numbers
                )
            numbers = int(config.smaller * numbers * limit / size)
        return None

    def numbers_within(self, limit: int, precision: str) -> int:
        """How many numbers a file of so many bytes holds if it has no bricks."""
        sizes = self.request.sizes
        bare = self.request.overhead + sizes.of(Contents((), parts=0, placements=0), precision)
        return max(0, int((limit - bare) / sizes.per_number(precision)))

    def smallest(self) -> int:
        """About so many bytes for the widest voxels."""
        return max(current(SparseConfig).least_bytes, self.request.limit + 1)

    def why(self, field: SparseField) -> str:
        """How fine the voxels are."""
        return "voxels as wide as each object needs where that fits"

    def needs(self) -> MemoryEstimate:
        """Vertices while they are filled, padded rows afterwards."""
        config = current(SparseConfig)
        numbers = self.numbers_within(self.request.limit, self.plain().precision)
        filling = {"vertices while they are found and filled": float(config.per_number_filled * numbers)}
        return MemoryEstimate(int(config.padded * numbers), making=filling, points=0)


def shape_of(storage: StorageSetting) -> SparseShape:
    """The shape of a field in a way."""
    return SparseShape(current(SparseConfig).degree if storage.sh_degree is None else storage.sh_degree)


def bricks(resolution: tuple[int, int, int]) -> list[int]:
    """Whole bricks per axis for so many vertices."""
    return [-(-(n - 1) // SIDE) for n in resolution]


def bricks_sweep() -> Sweep:
    """From few bricks to more, since many take minutes."""
    for finetune, size, degree in product((False, True), current(SparseConfig).ladder_bytes, (1, 0)):
        yield SweepPoint("int8", sh_degree=degree, max_size=size, finetune=finetune)


def levels(field: SparseField) -> list[dict]:
    """For the report: the voxel and the bricks of every level."""
    level, depth = field.tree.level, field.tree.depth
    return [
        {"voxel": float(field.voxel_size * 2 ** (depth - n)), "bricks": int(np.count_nonzero(level == n))}
        for n in range(depth + 1)
    ]


def held_voxels(scene: ComposedField, field: SparseField) -> list[float]:
    """The side of the voxels that hold most of each placed object."""
    tree, voxels = field.tree, []
    for p in scene.leaves():
        centres = p.field.occupancy.centres() @ p.object_to_world[:3, :3].T + p.object_to_world[:3, 3]
        halves = 2 * np.floor((centres - tree.lo) / tree.unit).astype(np.int64) + 1
        inside = ((halves > 0) & (halves < 2 * (field.aabb[3:] - tree.lo) / tree.unit)).all(1)
        brick = tree.voxels_at(halves[inside], SIDE, field.fine.active)[0]
        level = tree.level[brick[brick >= 0]].astype(np.int64)
        depth = np.median(level) if len(level) else 0
        voxels.append(float(field.voxel_size * 2.0 ** (tree.depth - depth)))
    return voxels
