"""A vm field as a student: over a scene's box, from a background's numbers where these can be taken over."""

from dataclasses import dataclass, replace

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.encodings.hash_runs import ROW, HashGrid
from fusedrf_cli.engine.fields.assembled import MAX_RANK
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, OccupancyGrid, overlapped
from fusedrf_cli.engine.fields.stored_rows import StoredRows
from fusedrf_cli.engine.kinds.box_kind import BoxKind
from fusedrf_cli.engine.kinds.builder import (
    BuildRequest,
    Contents,
    DistilledBuilder,
    Plan,
    Section,
    StorageSetting,
    Suitability,
    finest_within,
    numbers_in,
)
from fusedrf_cli.engine.kinds.reduction import Reduction, coarser
from fusedrf_cli.engine.kinds.vm.field import DETAIL, VMField, VMShape
from fusedrf_cli.engine.kinds.vm.trimming import (
    common_shape,
    components,
    read_texels,
    reshaped,
    smaller_shape,
    truncated,
    with_detail,
    without_detail,
    without_unqueried,
    without_unread,
)
from fusedrf_cli.engine.settings import current


@dataclass(frozen=True)
class VMBuilderConfig:
    """How students of planes and lines begin, and how coarse they get."""

    shape: VMShape = VMShape()
    """Where nothing else is asked."""
    coarser: float = 1.5
    """Times its own voxel: how coarse a field can get before it is left without its detail."""
    noise: float = 0.03
    """Of the factors of a student that takes over others' numbers."""
    detail_from: int = 2_000_000
    """Numbers of a student from which it has a detail."""
    detail_seconds: float = 120.0
    """Of learning from which it has one, where the time decides."""
    detail_share: float = 0.3
    """Of a student's numbers that its detail takes at most."""
    detail_spacings: tuple[float, ...] = (2.0, 1.0, 0.5)
    """Of the detail's levels, in the texels that the student would have without it."""


def shape_within(storage: StorageSetting) -> VMShape:
    """The most components and bands that a way lets a field have."""
    ranks = storage.ranks or (MAX_RANK, MAX_RANK)
    return VMShape(*ranks, 3 if storage.sh_degree is None else storage.sh_degree)


class VMKind(BoxKind):
    """TensoRF's vector-matrix decomposition."""

    name = "vm"
    good_for = "Objects and scenes in their own axes: small, smooth, quick to train."
    field = VMField
    takes = reduces = frozenset({"ranks", "sh_degree"})
    warm_starts = True
    hashes = True
    distilled = "int8"  # measured: four objects in 25 MB, 0.6 dB more than half the numbers in float16

    @property
    def usual(self) -> VMShape:
        """See BoxKind."""
        return current(VMBuilderConfig).shape

    def shape(self, storage: StorageSetting) -> VMShape:
        """See BoxKind."""
        return replace(super().shape(storage), hashed=storage.hashed)

    def builder(self, scene: ComposedField, request: BuildRequest) -> "VMStudentBuilder":
        """See Kind."""
        return VMStudentBuilder(self, scene, request)

    def suits(self, scene: ComposedField, limit: int | None = None) -> Suitability:
        """It holds any scene, one that is not stretched and has its detail everywhere best."""
        return Suitability(1.0, "one vm field over the scene learns any sources by any rule")

    def warm_start(
        self, background: Placed, plan: Plan, scene: ComposedField, generator: torch.Generator
    ) -> VMField | None:
        """A field over the scene's box that begins as the background does, where that is a vm field, placed
        upright and scaled alike along all axes; a place as it is, where the scene lies in it."""
        if plan.storage.hashed is not None:  # it learns no less from nothing
            return None
        kept = self.place_of(background, plan, scene)
        if kept is not None:
            return kept
        moved = upright(background)
        if moved is None:
            return None
        if plan.storage.ranks is not None:
            moved = truncated(moved, self.shape(plan.storage))
        return self.widened(moved, plan, scene, generator)

    def place_of(self, background: Placed, plan: Plan, scene: ComposedField) -> VMField | None:
        """The numbers of an unbounded scene that gives a scene its frame, over the cells of the scene; None
        where they are more than planned, or density of the scene lies outside of what they cover."""
        field, cells = background.field, scene.occupancy
        if type(field) is not VMField or not background.unbounded:
            return None
        box, wanted = field.box, self.shape(plan.storage)
        shape = common_shape([field.shape, wanted])
        beyond = np.maximum(box[:3] - cells.centres(), cells.centres() - box[3:]).max()
        as_placed = np.allclose(background.object_to_world, np.eye(4), atol=1e-9)
        too_many = VMField.size_of(shape, field.resolution) > plan.numbers
        if not as_placed or beyond > cells.cell.max() or too_many:
            return None
        if plan.storage.ranks is not None and components(shape) != components(wanted):
            return None
        longest = current(OccupancyConfig).scene_cells
        own = reshaped(field, shape)
        own = own.with_params(own.params.clone())
        return own.with_occupancy(OccupancyGrid(box, overlapped(cells, longest, box), cells.space))

    def grown(self, before: VMField, plan: Plan) -> VMField:
        """See Kind: a detail has other rows then, and begins anew."""
        moved = without_detail(before).resampled(plan.box, plan.resolution)
        return with_detail(moved, plan.storage.hashed)

    def widened(
        self, field: VMField, plan: Plan, scene: ComposedField, generator: torch.Generator
    ) -> VMField:
        """A field over a scene's box, with as many components as planned at least."""
        shape, box = common_shape([field.shape, self.shape(plan.storage)]), scene.occupancy.aabb
        resolution = finest_within(box, scene.voxel_size, lambda r: VMField.size_of(shape, r), plan.allowed)
        student = reshaped(field, shape).resampled(box, resolution).with_occupancy(scene.occupancy)
        add_noise(student, generator)
        return student

    # -- making smaller --------------------------------------------------------------------------------------

    def outline(self, field: VMField) -> VMField:
        """See Kind: it knows which rows of its hash grid are held."""
        outline = super().outline(field)
        outline.told = field.held
        return outline

    def reduction(self, outline: VMField, voxel: float, storage: StorageSetting) -> Reduction:
        """See Kind: fewer texels, without the detail where they are more than `coarser` times as wide; fewer
        components and bands, chosen by energy. What no occupied cell reads is 0."""
        box, resolution = outline.box, coarser(outline.box, outline.resolution, voxel)
        shape, same = smaller_shape(outline.shape, shape_within(storage)), resolution == outline.resolution
        wide = max(outline.resolution) > current(VMBuilderConfig).coarser * max(resolution)
        small = VMField(
            replace(shape, hashed=None) if wide else shape,
            box, resolution, outline.scale, outline.shift, outline.params, outline.occupancy,
        )  # fmt: skip

        def make(field: VMField) -> VMField:
            kept = without_detail(field) if wide else field
            return without_unread(truncated(kept if same else kept.resampled(box, resolution), shape))

        return Reduction(contents_of(small, outline.told), make, same and shape == outline.shape)

    def trimmed(self, field: VMField) -> VMField:
        """See vm/trimming.py."""
        return without_unqueried(field)

    # -- telling ---------------------------------------------------------------------------------------------

    def describe(self, field: VMField) -> dict:
        """Texels per axis, ranks, SH degree, and rows of its hash grid."""
        shape, held = field.shape, field.held
        description = super().describe(field)
        description |= {"ranks": [shape.density_rank, shape.colour_rank], "sh_degree": shape.sh_degree}
        if shape.hashed:
            description["detail_rows"] = held.count if held else shape.hashed.shape[0]
        return description


class VMStudentBuilder(DistilledBuilder):
    """A student of planes and lines, with a detail where it has numbers to spare and coarser texels than the
    scene: products over all of a scene cannot hold objects that have nothing in common."""

    def plan(self, storage: StorageSetting, numbers: int) -> Plan:
        """See `DistilledBuilder`."""
        config = current(VMBuilderConfig)
        plain = super().plan(replace(storage, hashed=None), numbers)
        around, seconds = any(p.unbounded for p in self.scene.placed), self.request.seconds
        hurried = seconds is not None and seconds < config.detail_seconds
        if around or hurried or numbers < config.detail_from or plain.voxel <= self.scene.voxel_size:
            return plain
        spacings = tuple(plain.voxel * times for times in config.detail_spacings)
        rows = 1 << int(np.log2(config.detail_share * numbers / (ROW * len(spacings))))
        return super().plan(replace(storage, hashed=HashGrid(spacings, rows)), numbers)


def upright(background: Placed) -> VMField | None:
    """A placed field in the frame it is placed in, without its detail, or None where its axes are others: a
    decomposition follows them, so it must only be moved and scaled alike along all of them."""
    linear = background.object_to_world[:3, :3]
    scale, field = linear[0, 0], background.field
    if type(field) is not VMField or scale <= 0:
        return None
    if not np.allclose(linear, scale * np.eye(3), atol=1e-9 * scale):
        return None
    own, box = without_detail(field), field.box * scale + np.tile(background.object_to_world[:3, 3], 2)
    return VMField(own.shape, box, own.resolution, own.scale / scale, own.shift, own.params)


def add_noise(student: VMField, generator: torch.Generator) -> None:
    """Small noise on every factor: where plane and line are both 0 the gradient of their product is too, for
    ever."""
    for name, section in student.sections().items():
        if "_plane_" in name or "_line_" in name:
            section += current(VMBuilderConfig).noise * torch.randn(section.shape, generator=generator)


def contents_of(field: VMField, held: StoredRows | None) -> Contents:
    """What a field without unread texels (trimming.py) is stored with, whatever its numbers are; held: which
    rows of its hash grid."""
    sections, bits = [], 8  # packed by itself
    for part in field.parts:
        used = read_texels(field, int(part.name[-1])) if "_plane_" in part.name else None
        shape = part.shape
        if part.name == DETAIL and held:
            shape = held.count, ROW
            bits += held.told(ROW)
        sections.append(Section(part.name, shape, used))
    return Contents(sections, bits + field.occupancy.stored_bits(numbers_in(sections)))
