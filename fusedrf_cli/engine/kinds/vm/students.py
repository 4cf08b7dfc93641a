"""A vm field as a student: one tensor over a scene's box, from the background's numbers where these can be
taken over."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import torch

from fusedrf_cli.engine.composition.affine import Placed
from fusedrf_cli.engine.composition.composed import ComposedField
from fusedrf_cli.engine.fields.computed import BRICK
from fusedrf_cli.engine.fields.hashed import PER_BLOCK, TOGETHER, WIDTH
from fusedrf_cli.engine.fields.occupancy import OccupancyConfig, OccupancyGrid, overlapped
from fusedrf_cli.engine.kinds import splitting
from fusedrf_cli.engine.kinds.kind import Kind
from fusedrf_cli.engine.kinds.reduction import Reduction, coarser
from fusedrf_cli.engine.kinds.student import (
    Contents,
    Plan,
    Section,
    Suits,
    Way,
    finest_within,
)
from fusedrf_cli.engine.kinds.vm import editing
from fusedrf_cli.engine.kinds.vm.blocks import LEARNT, common_shape, reshaped, without
from fusedrf_cli.engine.kinds.vm.field import MAX_RANK, Block, VMField, VMShape, VMTensor
from fusedrf_cli.engine.kinds.vm.trimming import (
    read_texels,
    smaller_shape,
    truncated,
    without_unasked,
    without_unread,
)
from fusedrf_cli.engine.selection.cells import Selection
from fusedrf_cli.engine.settings import current

SHAPE = VMShape(16, 24, 2)
MAX_DEGREE = 3
COARSER = 1.5  # times its own voxel: how coarse a tensor can get before it is left without its detail
BLOCKS, BRICKS = ".detail_blocks", ".occupancy.bricks"  # ends of names of arrays that tell what is stored
NOISE = 0.03  # of the factors of a student that takes over others' numbers


def shape_of(way: Way) -> VMShape:
    """The shape of a field in a way, SHAPE's where that leaves a choice."""
    ranks = way.ranks or (SHAPE.density_rank, SHAPE.colour_rank)
    return VMShape(*ranks, SHAPE.sh_degree if way.sh_degree is None else way.sh_degree)


def shape_within(way: Way) -> VMShape:
    """The most components and bands that a way lets a field have."""
    ranks = way.ranks or (MAX_RANK, MAX_RANK)
    return VMShape(*ranks, MAX_DEGREE if way.sh_degree is None else way.sh_degree)


def tensor_of(way: Way, resolution: tuple[int, int, int]) -> VMTensor:
    """A tensor in a way, somewhere."""
    return VMTensor(resolution, np.array([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]), 1.0, hashed=way.hashed)


class VMKind(Kind):
    """TensoRF's vector-matrix decomposition."""

    name = "vm"
    good_for = "Objects and scenes in their own axes: small, smooth, quick to train."
    field = VMField
    takes = frozenset({"ranks", "sh_degree"})
    takes_over = True
    hashes = True
    distilled = "int8"  # measured: four objects in 25 MB, 0.6 dB more than half the numbers in float16

    def sections(self, way: Way, resolution: tuple[int, int, int]) -> Sequence[Section]:
        """Planes, lines, the colour basis and the detail of one tensor."""
        return [Section(*named) for named in tensor_of(way, resolution).sections(shape_of(way))]

    def numbers(self, way: Way, resolution: tuple[int, int, int]) -> int:
        """Floats of one tensor, each section on a cache line."""
        return tensor_of(way, resolution).size(shape_of(way))

    def create(self, plan: Plan, generator: torch.Generator, name: str = "") -> VMField:
        """One tensor."""
        shape = shape_of(plan.way)
        return VMField.create(plan.box, plan.resolution, shape, generator, name, plan.way.hashed)

    def suits(self, scene: ComposedField) -> Suits:
        """It holds any scene, one that is not stretched and has its detail everywhere best."""
        return Suits(1.0, "one tensor over the scene learns any sources by any rule")

    def taken_over(
        self, background: Placed, plan: Plan, scene: ComposedField, generator: torch.Generator
    ) -> VMField | None:
        """A tensor over the scene's box that begins as the background does, where that is one, placed upright
        and scaled alike along all axes; a place's own tensor as it is, where the scene lies in it."""
        kept = place_of(background, plan, scene)
        if kept is not None:
            return kept
        moved = upright(background)
        if moved is None:
            return None
        if plan.way.ranks is not None:
            moved = truncated(moved, shape_of(plan.way))
        return widened(moved, plan, scene, generator)

    def reduction(self, outline: VMField, voxel: float, way: Way) -> Reduction:
        """See Kind: fewer texels, without the detail where they are more than COARSER times as wide; fewer
        components and bands, chosen by energy. What no occupied cell reads is 0."""
        (tensor,) = outline.tensors
        shape = smaller_shape(outline.shape, shape_within(way))
        resolution = coarser(tensor.aabb, tensor.resolution, voxel)
        wide = max(tensor.resolution) > COARSER * max(resolution)
        small = replace(tensor, resolution=resolution, **({"hashed": None, "held": None} if wide else {}))
        same = resolution == tensor.resolution

        def make(field: VMField) -> VMField:
            kept = without_detail(field) if wide else field
            return without_unread(truncated(kept if same else kept.resampled(tensor.aabb, resolution), shape))

        return Reduction(contents_of(shape, [small], 1), make, same and shape == outline.shape)

    def describe(self, field: VMField) -> dict:
        """Texels per axis of its tensor, or of each of its tensors, ranks, SH degree, and rows of detail."""
        texels = [list(t.resolution) for t in field.tensors]
        rows = sum(t.held[0] if t.held else t.hashed.shape[0] for t in field.tensors if t.hashed)
        return {
            "resolution": texels if len(field.blocks) > 1 else texels[0],
            "ranks": [field.shape.density_rank, field.shape.colour_rank],
            "sh_degree": field.shape.sh_degree,
        } | ({"detail_rows": rows} if rows else {})

    def held_bytes(self, decoded: int, shapes: Mapping[str, tuple[int, ...]]) -> int:
        """With all rows of details, and all cells, of which few are stored."""
        bits = {end: sum(8 * s[0] for n, s in shapes.items() if n.endswith(end)) for end in (BLOCKS, BRICKS)}
        return decoded + 4 * bits[BLOCKS] * TOGETHER * WIDTH + bits[BRICKS] // 2 * BRICK**3

    def without(self, field: VMField, names: set[str]) -> VMField | None:
        """Without the blocks of those names."""
        return without(field, names)

    def cut_out(self, field: VMField, selection: Selection) -> VMField | None:
        """See vm/editing.py."""
        return editing.cut_out(field, selection)

    def cut_away(self, field: VMField, selection: Selection) -> VMField | None:
        """See vm/editing.py."""
        return editing.cut_away(field, selection)

    def cropped(self, field: VMField, holds: splitting.Holds) -> VMField | None:
        """See vm/editing.py."""
        return editing.cropped(field, holds)

    def restricted(self, field: VMField, holds: splitting.Holds) -> VMField | None:
        """See vm/editing.py."""
        return editing.restricted(field, holds)

    def trimmed(self, field: VMField) -> VMField:
        """See vm/trimming.py."""
        return without_unasked(field)


def place_of(background: Placed, plan: Plan, scene: ComposedField) -> VMField | None:
    """The numbers of a place that gives a scene its frame, over the cells of the scene; None where they are
    more than planned, or matter of the scene lies outside of what they cover."""
    field, cells = background.field, scene.occupancy
    if type(field) is not VMField or len(field.blocks) != 1 or not background.unbounded:
        return None
    box, shape = field.tensors[0].aabb, common_shape([field.shape, shape_of(plan.way)])
    beyond = np.maximum(box[:3] - cells.centres(), cells.centres() - box[3:]).max()
    as_placed = np.allclose(background.object_to_world, np.eye(4), atol=1e-9)
    if not as_placed or beyond > cells.cell.max() or field.tensors[0].size(shape) > plan.numbers:
        return None
    if plan.way.ranks is not None and shape != shape_of(plan.way):
        return None
    grid = OccupancyGrid(box, overlapped(cells, current(OccupancyConfig).scene_cells, box), cells.space)
    own = reshaped(field, shape)
    return own.with_params(own.params.clone()).with_occupancy(grid)


def upright(background: Placed) -> VMField | None:
    """A placed field of one tensor in the frame it is placed in, without its detail, or None where its axes
    are others: a decomposition follows them, so it must only be moved and scaled alike along all of them."""
    linear = background.object_to_world[:3, :3]
    scale = linear[0, 0]
    field = background.field
    if type(field) is not VMField or len(field.blocks) != 1 or scale <= 0:
        return None
    if not np.allclose(linear, scale * np.eye(3), atol=1e-9 * scale):
        return None
    source = field.tensors[0]
    box = source.aabb * scale + np.tile(background.object_to_world[:3, 3], 2)
    tensor = VMTensor(source.resolution, box, source.scale / scale, source.shift)
    params = field.params[: tensor.size(field.shape)]  # the detail is the last section
    return VMField(field.shape, (tensor,), (Block(0, np.eye(4), LEARNT),), params, OccupancyGrid.full(box))


def without_detail(field: VMField) -> VMField:
    """A field of one tensor without what is finer than its texels."""
    tensor = replace(field.tensors[0], hashed=None, held=None)
    params = field.params[: tensor.size(field.shape)].clone()  # the detail is the last section
    return VMField(field.shape, (tensor,), field.blocks, params, tensor.occupancy)


def widened(field: VMField, plan: Plan, scene: ComposedField, generator: torch.Generator) -> VMField:
    """A field of one tensor over a scene's box, with as many components as planned at least."""
    shape, box = common_shape([field.shape, shape_of(plan.way)]), scene.occupancy.aabb
    resolution = finest_within(box, scene.voxel_size, shape.size, plan.allowed)
    student = reshaped(field, shape).resampled(box, resolution).with_occupancy(scene.occupancy)
    add_noise(student, generator)
    return student


def add_noise(student: VMField, generator: torch.Generator) -> None:
    """Small noise on every factor: where plane and line are both 0 the gradient of their product is too, for
    ever."""
    for name, section in student.sections(0).items():
        if name not in ("colour_basis", "detail"):
            section += NOISE * torch.randn(section.shape, generator=generator)


def contents_of(shape: VMShape, tensors: Sequence[VMTensor], blocks: int) -> Contents:
    """What a field of tensors without unread texels (trimming.py) is stored with."""
    sections, bits = [], 0
    for tensor in tensors:
        bits += tensor.occupancy.occupied.size + 8  # each is packed by itself
        for name, section in tensor.sections(shape):
            used = read_texels(tensor, int(name[-1])) if "_plane_" in name else None
            if name == "detail" and tensor.held:
                rows, of_blocks = tensor.held
                section = rows, WIDTH
                bits += tensor.hashed.shape[0] // TOGETHER + 8 * PER_BLOCK * of_blocks
            sections.append(Section(name, section, used))
    return Contents(sections, bits, len(tensors), blocks)
